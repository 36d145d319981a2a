"""Recognise the limbs of people and animals by the shape of their skeletons."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from operator import itemgetter

import numpy as np

from lcollision_core.files.character import Rig
from lcollision_core.meshes.joint_kinds import Role, Side
from lcollision_core.meshes.topology import FloatArray

LEG = (Role.THIGH, Role.SHIN, Role.FOOT, Role.TOE)
ARM = (Role.SHOULDER, Role.UPPER_ARM, Role.FOREARM, Role.HAND)
TRUNK = (Role.SPINE, Role.NECK, Role.HEAD)
FINGERS = (Role.PALM, Role.THUMB, Role.FINGER)

_ALIKE = 0.1
"""Largest difference of left and right bones, as a share of the limb's length."""

_SHORTEST = 0.12
"""Least length of a limb, as a share of the skeleton's extent."""

_APART = 0.05
"""Least distance between left and right, as a share of the limb's length."""

_ON_BONE = 0.15
"""Distance from a bone, as a share of its length, within which helpers belong to the limb."""

_LONGEST = {Role.FOOT: 0.45, Role.HAND: 0.55}
"""Largest length beyond the ankle or wrist, as a share of the limb's."""

_FOUR_FINGER_JOINTS = 4
"""Number of joints from which a finger begins in the palm."""

_MOST_JOINTS = 16
"""Longest chain in which a limb's hinge is searched for."""

_MOST_PAIRS = 32
"""Most pairs of branches in which legs and arms are searched for."""

_LEAST_VOTE = 0.15
"""Least weight of the evidence for the direction that a body faces."""


@dataclass(frozen=True, eq=False)
class Person:
    """Human joints recognised from the skeleton alone.

    Attributes
    ----------
    roles : of the recognised joints
    limbs : order of the roles along each leg and arm, by its first joint
    up : (3,) unit vector, from the hips to the shoulders
    front : (3,) unit vector, orthogonal to up; None if undetermined
    """

    roles: dict[int, Role]
    limbs: dict[int, tuple[Role, ...]]
    up: FloatArray
    front: FloatArray | None


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two matching branches of a joint; which one is left is undecided.

    Attributes
    ----------
    trunk : the joint that they are attached to
    chains : the joints of each from the trunk to its far end
    reach : length of the shorter branch
    middle : (3,) midpoint of their first joints
    across : (3,) from one to the other
    direction : (3,) unit vector, their mean direction
    """

    trunk: int
    chains: tuple[list[int], list[int]]
    reach: float
    middle: FloatArray
    across: FloatArray
    direction: FloatArray


class Skeleton:
    """The tree of the joints that move skin.

    Parameters
    ----------
    rig : of the character
    named : J roles by the joints' names, which only help to choose between candidates
    lefts : J numbers, 1 for left by name, -1 for right, 0 for neither
    up : (3,) unit vector
    """

    def __init__(
        self, rig: Rig, named: Sequence[Role], lefts: Sequence[int], up: FloatArray
    ) -> None:
        self._named, self._lefts, self._up = named, lefts, up
        n_joints, rows = len(rig.parents), np.arange(len(rig.joint_of))
        # The last entry is a virtual parent of all roots.
        self._parents: list[int] = [*rig.parents.tolist(), -1]
        places, roots = rig.rest[:, :3, 3], rig.parents < 0
        self._places: FloatArray = np.concatenate([places, [places[roots].mean(axis=0)]])
        largest = rig.weights.argmax(axis=1)
        self._skin = np.bincount(rig.heaviest, minlength=n_joints)
        used = np.bincount(rig.joint_of[rig.weights > 0.0], minlength=n_joints) > 0
        # A last bone points to the centre of its skin.
        self._tips = self._places.copy()
        for joint in np.flatnonzero(self._skin).tolist():
            self._tips[joint] = rig.points[rows, largest][rig.heaviest == joint].mean(axis=0)
        self._children: list[list[int]] = [[] for _ in self._parents]
        self._reach, self._next = np.zeros(n_joints + 1), [-1] * (n_joints + 1)
        self._shares = np.append(self._skin, 0) / max(1, len(rows))
        for joint in range(n_joints - 1, -1, -1):
            below, parent = self._children[joint], self._parents[joint]
            reaches = [self._reach[child] + self._distance(joint, child) for child in below]
            self._reach[joint] = np.linalg.norm(self._tips[joint] - self._places[joint])
            if reaches:
                self._reach[joint] = max(reaches)
                self._next[joint] = below[int(np.argmax(reaches))]
            if used[joint] or below:
                self._children[parent].insert(0, joint)
                self._shares[parent] += self._shares[joint]
        moving = [joint for joint in range(n_joints) if used[joint] or self._children[joint]]
        self._size = float(np.ptp(self._places[moving], axis=0).max(initial=0.0))
        self._pairs = self._find_pairs()

    def person(self) -> Person | None:
        """Return a person's joints, or None if the skeleton is not a person's.

        Legs continue the trunk, arms do not, and both have the same two sides.
        """
        candidates = [
            (score, legs, arms)
            for legs, arms in permutations(self._pairs, 2)
            if (score := self._likeness(legs, arms)) > 0.0
        ]
        if not candidates:
            return None
        _, legs, arms = max(candidates, key=itemgetter(0))
        roles: dict[int, Role] = {}
        hinges = []
        for pair, end in ((legs, Role.FOOT), (arms, Role.HAND)):
            # The other hand may hold a sword.
            hinge = self._hinge(min(pair.chains, key=lambda chain: self._reach[chain[0]]), end)
            hinges += [self._name_limb(roles, chain, hinge, end) for chain in pair.chains]
        self._name_trunk(roles, legs, arms)
        limbs: dict[int, tuple[Role, ...]] = {chain[0]: LEG for chain in legs.chains}
        limbs |= {chain[0]: (*ARM, *FINGERS) for chain in arms.chains}
        trunk = _unit(arms.middle - legs.middle)
        up = self._up if trunk @ self._up > 0.5 else trunk
        return Person(roles, limbs, up, self._front(legs.across, up, roles, hinges))

    def sides_of(self, person: Person, left: FloatArray) -> dict[int, Side]:
        """Return the sides of limbs whose names agree, by their first joints, and of the trunk.

        A limb is compared with the other of its pair, as the trunk may lean to a side at rest.
        """
        sides, roots = dict[int, Side](), list(person.limbs)
        for pair in (roots[:2], roots[2:]):
            chains = sorted(
                (self._chain(root)[:3] for root in pair),
                key=lambda chain: float((self._places[chain] @ left).mean()),
            )
            right, other = (sum(self._lefts[joint] for joint in chain) for chain in chains)
            if right < 0 < other:
                sides |= {above: Side.MIDDLE for chain in chains for above in self.above(chain[0])}
                sides |= {chains[0][0]: Side.RIGHT, chains[1][0]: Side.LEFT}
        return sides

    def front_of_four_legs(self) -> FloatArray | None:
        """Return where an animal faces whose two pairs of limbs hang from a level trunk.

        Its neck rises at the forelegs. None for other skeletons.
        """
        fronts: list[tuple[float, FloatArray]] = []
        for hind, fore in permutations(self._pairs, 2):
            trunk = fore.middle - hind.middle
            shorter, longer = sorted((hind.reach, fore.reach))
            if (
                2.0 * shorter > longer
                and 0.3 * longer < np.linalg.norm(trunk)
                and abs(_unit(trunk) @ self._up) < 0.5
                and min(hind.direction @ -self._up, fore.direction @ -self._up) > 0.7
                and abs(_unit(hind.across) @ _unit(fore.across)) > 0.8
                and not self._overlap(hind, fore)
            ):
                neck = max(float(self._tips[joint] @ self._up) for joint in self.below(fore.trunk))
                fronts.append((neck, _unit(trunk - (trunk @ self._up) * self._up)))
        return max(fronts, key=itemgetter(0))[1] if fronts else None

    def _distance(self, a: int, b: int) -> float:
        return float(np.linalg.norm(self._places[a] - self._places[b]))

    def below(self, joint: int) -> Iterator[int]:
        """Iterate over a joint and its descendants that move skin."""
        waiting = [joint]
        while waiting:
            yield (joint := waiting.pop())
            waiting += self._children[joint]

    def above(self, joint: int) -> Iterator[int]:
        """Iterate over a joint's ancestors, from near to far."""
        while (joint := self._parents[joint]) >= 0:
            yield joint

    def _chain(self, joint: int) -> list[int]:
        chain = [joint]
        while self._next[chain[-1]] >= 0 and len(chain) < _MOST_JOINTS:
            chain.append(self._next[chain[-1]])
        return chain

    def _find_pairs(self) -> list[_Pair]:
        """Find pairs of branches of one joint with equal bone lengths, like left and right."""
        pairs = []
        for trunk, children in enumerate(self._children):
            long = [child for child in children if self._reach[child] > _SHORTEST * self._size]
            for ends in combinations(long, 2):
                first, second = chains = self._chain(ends[0]), self._chain(ends[1])
                n = min(3, len(first), len(second))
                bones = [
                    [self._distance(*bone) for bone in zip([trunk, *chain], chain, strict=False)]
                    for chain in chains
                ]
                reach = float(self._reach[list(ends)].min())
                gaps = np.abs(np.subtract(bones[0][:n], bones[1][:n]))
                places = [self._places[chain[:n]] for chain in chains]
                gap = places[1] - places[0]
                # Use the first joints, as they hardly move, unless they coincide.
                across = gap[0] if np.linalg.norm(gap[0]) > _APART * reach else gap.mean(axis=0)
                tips = [self._tips[chain[-1]] for chain in chains]
                ways = [_unit(tip - own[0]) for tip, own in zip(tips, places, strict=True)]
                named = {self._named[joint] for chain in chains for joint in chain}
                if (
                    n > 1
                    and named != {Role.FACE}
                    and gaps.max() < _ALIKE * reach
                    and np.linalg.norm(across) > _APART * reach
                ):
                    middle = 0.5 * (places[0][0] + places[1][0])
                    pairs.append(
                        _Pair(trunk, chains, reach, middle, across, _unit(ways[0] + ways[1]))
                    )
        # Limbs have more skin than strands of hair or pleats.
        pairs.sort(key=lambda pair: -sum(self._shares[chain[0]] for chain in pair.chains))
        return pairs[:_MOST_PAIRS]

    def _overlap(self, a: _Pair, b: _Pair) -> bool:
        """Whether two pairs share joints, or one is attached to the other."""
        mine = {joint for chain in a.chains for joint in self.below(chain[0])}
        others = {joint for chain in b.chains for joint in self.below(chain[0])}
        return bool(mine & others) or a.trunk in others or b.trunk in mine

    def _likeness(self, legs: _Pair, arms: _Pair) -> float:
        """Return a score for two pairs being a person's legs and arms, 0 if they are not."""
        trunk = arms.middle - legs.middle
        length, way = float(np.linalg.norm(trunk)), _unit(trunk)
        if (
            not 0.2 * legs.reach < length < 1.6 * legs.reach
            or not 0.3 * legs.reach < arms.reach < 2.0 * legs.reach
            or legs.direction @ -way < 0.5
            or arms.direction @ way > 0.7
            or abs(_unit(legs.across) @ _unit(arms.across)) < 0.8
            or abs(_unit(legs.across) @ way) > 0.4
            or self._overlap(legs, arms)
            # An animal's second legs.
            or (self._names_of(arms) & {*LEG} and not self._names_of(arms) & {*ARM})
        ):
            return 0.0
        roots = [chain[0] for pair in (legs, arms) for chain in pair.chains]
        score = float(self._shares[roots].sum()) + (legs.reach + 0.5 * arms.reach) / self._size
        score += 0.5 * float(way @ self._up) + 0.5 * bool(self._head_chain(arms, way))
        score += 0.25 * sum(
            any(len(self._children[joint]) > 2 for joint in chain) for chain in arms.chains
        )
        for pair, kinds in ((legs, LEG), (arms, ARM)):
            score += 0.1 * len(self._names_of(pair).intersection(kinds))
        return score + 1.0

    def _names_of(self, pair: _Pair) -> set[Role]:
        """Return the roles by name along both branches."""
        return {self._named[joint] for chain in pair.chains for joint in chain}

    def _head_chain(self, arms: _Pair, up: FloatArray) -> list[int]:
        """Return the joints of neck and head, which continue the trunk between the arms."""
        arm_roots = {chain[0] for chain in arms.chains}
        best: list[int] = []
        for child in self._children[arms.trunk]:
            way = self._places[child] - arms.middle
            aside = abs(way @ _unit(arms.across)) > 0.2 * np.linalg.norm(arms.across)
            top = (self._places[list(self.below(child))] @ up).max()
            rises = top > self._places[arms.trunk] @ up
            if child not in arm_roots and not aside and rises:
                best = max(
                    best, self._chain(child), key=lambda chain: self._shares[chain[:1]].sum()
                )
        return best

    def _hinge(self, chain: list[int], end: Role) -> tuple[int, int, int]:
        """Return the indices in a chain of a limb's start, hinge and end.

        Both bones are of similar length, joints between lie on them, and a foot turns off or
        fingers branch off. The end is one beyond the chain if it has no joint there.
        """
        places = np.concatenate([self._places[chain], self._tips[chain[-1:]]])
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        total, n = float(along[-1]), len(chain)
        kinds = LEG if end is Role.FOOT else ARM[1:]

        def score(hinge: tuple[int, int, int]) -> float:
            first, middle, last = hinge
            upper = float(np.linalg.norm(places[middle] - places[first]))
            lower = float(np.linalg.norm(places[last] - places[middle]))
            if min(upper, lower) < 0.05 * total:
                return -np.inf
            rest = float(along[-1] - along[last]) / (upper + lower)
            value = min(upper, lower) / max(upper, lower) + (upper + lower) / total
            value -= 2.0 * max(0.0, rest - _LONGEST[end])
            for start, stop in ((first, middle), (middle, last)):
                value -= 2.0 * max(
                    (_beside(place, places[start], places[stop]) for place in places[start:stop]),
                    default=0.0,
                )
            if last == n:
                return value - 0.5
            if end is Role.FOOT:
                shin, foot = places[last] - places[middle], places[last + 1] - places[last]
                value += 0.4 * (1.0 - max(0.0, float(_unit(shin) @ _unit(foot))))
            else:
                value += 0.4 * float(np.clip(len(self._children[chain[last]]) - 1, 0, 2))
            value += 0.01 * sum(bool(self._skin[chain[place]]) for place in hinge)
            named = zip(hinge, kinds, strict=False)
            return value + 0.1 * sum(self._named[chain[place]] is kind for place, kind in named)

        return max(combinations(range(n + 1), 3), key=score, default=(0, 1, n))

    def _name_limb(
        self, roles: dict[int, Role], chain: list[int], hinge: tuple[int, int, int], end: Role
    ) -> list[FloatArray]:
        """Set the roles along a limb; return positions of its main joints and its foot's tip."""
        first, middle, last = hinge
        places = np.concatenate([self._places[chain], self._tips[chain[-1:]]])
        ends = [places[first], places[middle], places[last], places[min(last + 1, len(chain))]]
        upper, lower = (Role.THIGH, Role.SHIN) if end is Role.FOOT else ARM[1:3]
        for number, joint in enumerate(chain[:last]):
            roles[joint] = {first: upper, middle: lower}.get(number, Role.TWIST)
            apart = float(np.linalg.norm(places[number] - ends[0])) > _APART * self._reach[joint]
            if end is Role.HAND and number < first and apart:
                roles[joint] = Role.SHOULDER
            start, stop = ends[:2] if number < middle else ends[1:3]
            for branch in {*self._children[joint]}.difference(chain):
                is_piece = _beside(self._places[branch], start, stop) < _ON_BONE
                role = Role.TWIST if is_piece else Role.OTHER
                roles.update((helper, role) for helper in self.below(branch))
        if last < len(chain):
            roles[chain[last]] = end
            limb = sum(float(np.linalg.norm(ends[k + 1] - ends[k])) for k in (0, 1))
            self._name_end(roles, chain[last], end, limb)
        return ends

    def _name_end(self, roles: dict[int, Role], joint: int, end: Role, limb: float) -> None:
        """Set the roles of fingers or toes."""
        if end is Role.FOOT:
            roles.update((toe, Role.TOE) for toe in self.below(joint) if toe != joint)
            return
        fingers = []
        for root in self._children[joint]:
            is_finger = self._reach[root] < _LONGEST[end] * limb and len(self._chain(root)) > 1
            for below in self.below(root):
                roles[below] = Role.FINGER if is_finger else Role.OTHER
            if is_finger:
                fingers.append(root)
            if is_finger and len(self._chain(root)) >= _FOUR_FINGER_JOINTS:
                roles[root] = Role.PALM
        if len(fingers) > 2:
            ways = [_unit(self._tips[self._chain(root)[-1]] - self._places[root])
                    for root in fingers]  # fmt: skip
            hand = _unit(np.median(ways, axis=0))
            apart = [1.0 - way @ hand for way in ways]
            roles.update((below, Role.THUMB) for below in self.below(fingers[np.argmax(apart)]))

    def _name_trunk(self, roles: dict[int, Role], legs: _Pair, arms: _Pair) -> None:
        hips = {legs.trunk, *self.above(legs.trunk)}
        spine = [arms.trunk, *self.above(arms.trunk)]
        roles.update((joint, Role.SPINE) for joint in spine if joint not in hips)
        roles.pop(len(self._parents) - 1, None)
        chain = self._head_chain(arms, _unit(arms.middle - legs.middle))
        if chain:
            # The head is the middle joint with the most skin.
            head = max(range(len(chain)), key=lambda place: self._skin[chain[place]])
            head = max(head, min(1, len(chain) - 1))
            roles.update((below, Role.FACE) for below in self.below(chain[0]))
            roles.update((joint, Role.NECK) for joint in chain[:head])
            roles[chain[head]] = Role.HEAD

    def _front(
        self,
        across: FloatArray,
        up: FloatArray,
        roles: dict[int, Role],
        hinges: list[list[FloatArray]],
    ) -> FloatArray | None:
        """Return the front by a vote of feet, knees, elbows and names of sides."""
        front = _unit(np.cross(across, up))
        left, vote = np.cross(up, front), 0.0
        middle = float(np.mean([hinge[0] @ left for hinge in hinges]))
        for number, (start, hinge, end, tip) in enumerate(hinges):
            line, is_leg = end - start, number < 2
            bend = float((hinge - 0.5 * (start + end)) @ front) / (np.linalg.norm(line) or 1.0)
            vote += float(np.clip(10.0 * bend, -0.5, 0.5)) * (1.0 if is_leg else -1.0)
            if is_leg and (tip != end).any():
                vote += float(_unit(tip - end) @ front)
        sides = [
            self._lefts[joint] * np.sign(self._places[joint] @ left - middle)
            for joint in roles
            if self._lefts[joint]
        ]
        vote += 0.75 * float(np.mean(sides)) if sides else 0.0
        if abs(vote) < _LEAST_VOTE:
            return None
        return front if vote > 0.0 else -front


def _unit(vector: FloatArray) -> FloatArray:
    length = float(np.linalg.norm(vector))
    unit: FloatArray = vector / length if length > 0.0 else np.zeros(3)
    return unit


def _beside(place: FloatArray, start: FloatArray, stop: FloatArray) -> float:
    """Return a place's distance from a line segment, relative to the segment's length."""
    line = stop - start
    share = float(np.clip((place - start) @ line / (line @ line), 0.0, 1.0)) if line.any() else 0.0
    far = float(np.linalg.norm(place - start - share * line))
    return far / max(float(np.linalg.norm(line)), np.finfo(np.float64).tiny)
