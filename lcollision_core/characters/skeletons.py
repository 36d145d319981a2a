"""What the joints of a person are by the tree and the lengths of its skeleton, however called."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np

from lcollision_core.files.character import Rig
from lcollision_core.meshes.joint_kinds import Role
from lcollision_core.meshes.topology import FloatArray

LEG = (Role.THIGH, Role.SHIN, Role.FOOT, Role.TOE)
ARM = (Role.SHOULDER, Role.UPPER_ARM, Role.FOREARM, Role.HAND)
TRUNK = (Role.SPINE, Role.NECK, Role.HEAD)
FINGERS = (Role.PALM, Role.THUMB, Role.FINGER)

_ALIKE = 0.1
"""By which the bones of a left and a right limb may differ, of the limb's length."""

_SHORTEST = 0.12
"""Of the skeleton's extent: shorter branches are no limbs."""

_APART = 0.05
"""Of a limb's length: what is nearer is in one place, as left and right are not."""

_ON_BONE = 0.15
"""Of a bone's length: helpers nearer to it than this are pieces of the limb."""

_LONGEST = {Role.FOOT: 0.45, Role.HAND: 0.55}
"""What follows the ankle or the wrist is not longer than this share of the limb before it."""

_FOUR_FINGER_JOINTS = 4
"""A finger of so many joints begins in the palm."""

_MOST_JOINTS = 16
"""Of a limb's chain, among which its hinge is sought."""

_MOST_PAIRS = 32
"""Pairs of branches among which legs and arms are sought."""

_LEAST_VOTE = 0.15
"""Of signs that a body faces one way and not the other."""


@dataclass(frozen=True, eq=False)
class Person:
    """What joints are by the skeleton alone.

    Attributes
    ----------
    roles : of the joints that are known
    limbs : for the first joint of each leg and arm the order of the roles along it
    up : (3,) unit vector, from the hips to the shoulders
    front : (3,) unit vector, level where the body stands; None where nothing says where it faces
    """

    roles: dict[int, Role]
    limbs: dict[int, tuple[Role, ...]]
    up: FloatArray
    front: FloatArray | None


@dataclass(frozen=True, eq=False)
class _Pair:
    """A left and a right branch of a joint, which of them is left is open.

    Attributes
    ----------
    trunk : the joint that they hang on
    chains : the joints of each from the trunk to its far end
    reach : length of the shorter
    middle : (3,) between their first joints
    across : (3,) from one to the other
    direction : (3,) unit vector, the mean of where they point
    """

    trunk: int
    chains: tuple[list[int], list[int]]
    reach: float
    middle: FloatArray
    across: FloatArray
    direction: FloatArray


class Skeleton:
    """The tree of the joints that move a skin.

    Parameters
    ----------
    rig : of the character
    named : J roles by the joints' names, which only help to choose among what is possible
    lefts : J numbers, 1 for what is called left, -1 for right, 0 for neither
    up : (3,) unit vector
    """

    def __init__(
        self, rig: Rig, named: Sequence[Role], lefts: Sequence[int], up: FloatArray
    ) -> None:
        self._named, self._lefts, self._up = named, lefts, up
        n_joints, rows = len(rig.parents), np.arange(len(rig.joint_of))
        # The last one stands for what all roots hang on.
        self._parents: list[int] = [*rig.parents.tolist(), -1]
        places, roots = rig.rest[:, :3, 3], rig.parents < 0
        self._places: FloatArray = np.concatenate([places, [places[roots].mean(axis=0)]])
        largest = rig.weights.argmax(axis=1)
        heaviest = rig.joint_of[rows, largest]
        self._skin = np.bincount(heaviest, minlength=n_joints)
        used = np.bincount(rig.joint_of[rig.weights > 0.0], minlength=n_joints) > 0
        # Where a last bone points: to the middle of its skin.
        self._tips = self._places.copy()
        for joint in np.flatnonzero(self._skin).tolist():
            self._tips[joint] = rig.points[rows, largest][heaviest == joint].mean(axis=0)
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
        """Return what the joints are if they are those of a person, else None.

        Legs go on where the trunk comes from, arms do not, and both are on the same two sides.
        """
        found = [
            (score, legs, arms)
            for legs, arms in permutations(self._pairs, 2)
            if (score := self._likeness(legs, arms)) > 0.0
        ]
        if not found:
            return None
        _, legs, arms = max(found, key=lambda one: one[0])
        roles: dict[int, Role] = {}
        hinges = []
        for pair, end in ((legs, Role.FOOT), (arms, Role.HAND)):
            # In the other hand may be a sword.
            hinge = self._hinge(min(pair.chains, key=lambda chain: self._reach[chain[0]]), end)
            hinges += [self._name_limb(roles, chain, hinge, end) for chain in pair.chains]
        self._name_trunk(roles, legs, arms)
        limbs: dict[int, tuple[Role, ...]] = {chain[0]: LEG for chain in legs.chains}
        limbs |= {chain[0]: (*ARM, *FINGERS) for chain in arms.chains}
        trunk = _unit(arms.middle - legs.middle)
        up = self._up if trunk @ self._up > 0.5 else trunk
        return Person(roles, limbs, up, self._front(legs.across, up, roles, hinges))

    def front_of_four_legs(self) -> FloatArray | None:
        """Return where an animal faces whose two pairs of limbs hang from a level trunk.

        Its neck rises at the fore legs. None for what has no such limbs.
        """
        found: list[tuple[float, FloatArray]] = []
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
                found.append((neck, _unit(trunk - (trunk @ self._up) * self._up)))
        return max(found, key=lambda one: one[0])[1] if found else None

    def _distance(self, a: int, b: int) -> float:
        return float(np.linalg.norm(self._places[a] - self._places[b]))

    def below(self, joint: int) -> Iterator[int]:
        """Iterate over a joint and those of its branch that move a skin."""
        waiting = [joint]
        while waiting:
            yield (joint := waiting.pop())
            waiting += self._children[joint]

    def above(self, joint: int) -> Iterator[int]:
        """Iterate over what a joint hangs on, from near to far."""
        while (joint := self._parents[joint]) >= 0:
            yield joint

    def _chain(self, joint: int) -> list[int]:
        chain = [joint]
        while self._next[chain[-1]] >= 0 and len(chain) < _MOST_JOINTS:
            chain.append(self._next[chain[-1]])
        return chain

    def _find_pairs(self) -> list[_Pair]:
        """Find branches of a joint that are equally long bone by bone, as left and right are."""
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
                # A limb's first joint hardly moves; but both may be one above the other.
                across = gap[0] if np.linalg.norm(gap[0]) > _APART * reach else gap.mean(axis=0)
                tips = [self._tips[chain[-1]] for chain in chains]
                ways = [_unit(tip - own[0]) for tip, own in zip(tips, places, strict=True)]
                if (
                    n > 1
                    and gaps.max() < _ALIKE * reach
                    and np.linalg.norm(across) > _APART * reach
                ):
                    middle = 0.5 * (places[0][0] + places[1][0])
                    pairs.append(
                        _Pair(trunk, chains, reach, middle, across, _unit(ways[0] + ways[1]))
                    )
        # Limbs have more skin than strands of hair and the pleats of a skirt.
        pairs.sort(key=lambda pair: -sum(self._shares[chain[0]] for chain in pair.chains))
        return pairs[:_MOST_PAIRS]

    def _overlap(self, a: _Pair, b: _Pair) -> bool:
        """Whether one pair hangs on the other, or is in part the same."""
        mine = {joint for chain in a.chains for joint in self.below(chain[0])}
        others = {joint for chain in b.chains for joint in self.below(chain[0])}
        return bool(mine & others) or a.trunk in others or b.trunk in mine

    def _likeness(self, legs: _Pair, arms: _Pair) -> float:
        """Return how much two pairs are a person's legs and arms, 0 for not."""
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
        ):
            return 0.0
        roots = [chain[0] for pair in (legs, arms) for chain in pair.chains]
        score = float(self._shares[roots].sum()) + (legs.reach + 0.5 * arms.reach) / self._size
        score += 0.5 * float(way @ self._up) + 0.5 * bool(self._head_chain(arms, way))
        score += 0.25 * sum(
            any(len(self._children[joint]) > 2 for joint in chain) for chain in arms.chains
        )
        for pair, kinds in ((legs, LEG), (arms, ARM)):
            hints = {self._named[joint] for chain in pair.chains for joint in chain}
            score += 0.1 * len(hints.intersection(kinds))
        return score + 1.0

    def _head_chain(self, arms: _Pair, up: FloatArray) -> list[int]:
        """Return the joints of neck and head, which go on from the trunk between the arms."""
        taken = {chain[0] for chain in arms.chains}
        best: list[int] = []
        for child in self._children[arms.trunk]:
            way = self._places[child] - arms.middle
            aside = abs(way @ _unit(arms.across)) > 0.2 * np.linalg.norm(arms.across)
            top = (self._places[list(self.below(child))] @ up).max()
            rises = top > self._places[arms.trunk] @ up
            if child not in taken and not aside and rises:
                best = max(best, self._chain(child), key=lambda one: self._shares[one[:1]].sum())
        return best

    def _hinge(self, chain: list[int], end: Role) -> tuple[int, int, int]:
        """Return where in a chain the limb begins, where its hinge is and where it ends.

        Both bones are about equally long, joints between lie on them, and a foot points another
        way, or fingers branch off. The end is one beyond the chain where it has no joint there.
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
        """Name the joints of a limb, and return where its main ones and the end of its foot are."""
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
        """Name fingers or toes."""
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
            # Of the joints in the middle the head leads most.
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
        """Return where feet point, to where knees bend, elbows do not, and names of sides say."""
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
    """Return how far from a line between two places another is, of the line's length."""
    line = stop - start
    share = float(np.clip((place - start) @ line / (line @ line), 0.0, 1.0)) if line.any() else 0.0
    far = float(np.linalg.norm(place - start - share * line))
    return far / max(float(np.linalg.norm(line)), np.finfo(np.float64).tiny)
