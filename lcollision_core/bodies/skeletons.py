"""Recognise a rig's joints, by names and by shape: roles, sides and axes."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import LCollisionError
from lcollision_core.files.character import Character, Rig
from lcollision_core.meshes.extents import front_direction
from lcollision_core.meshes.joint_kinds import (
    JOINT_KINDS,
    Role,
    Side,
    joint_labels,
    part_labels,
    part_names,
)
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
        _, legs, arms = max(candidates, key=lambda one: one[0])
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
        return max(fronts, key=lambda one: one[0])[1] if fronts else None

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
        """Return the joints of neck and head, which continue the trunk between the arms."""
        arm_roots = {chain[0] for chain in arms.chains}
        best: list[int] = []
        for child in self._children[arms.trunk]:
            way = self._places[child] - arms.middle
            aside = abs(way @ _unit(arms.across)) > 0.2 * np.linalg.norm(arms.across)
            top = (self._places[list(self.below(child))] @ up).max()
            rises = top > self._places[arms.trunk] @ up
            if child not in arm_roots and not aside and rises:
                best = max(best, self._chain(child), key=lambda one: self._shares[one[:1]].sum())
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


_BENT = np.radians(6.0)
"""Angle between a hinge's bones at rest above which it turns about their common normal."""

_CLEARLY_BENT = np.radians(25.0)
"""Angle above which it does so even against the body's front."""

_PARALLEL = 0.9
"""Cosine above which a bone is too parallel to a direction to bend towards it."""

_MIDDLE = 0.02
"""Distance from the middle plane, as a share of the extent, within which joints have no side."""

_SHORT = 1e-6
"""Length of a bone, relative to the rig's size, below which it has no direction."""


_BONES = {
    Role.UPPER_ARM: Role.FOREARM,
    Role.FOREARM: Role.HAND,
    Role.THIGH: Role.SHIN,
    Role.SHIN: Role.FOOT,
}
"""The role at the far end of each limb bone."""

_ENDS = {Role.SHIN: Role.FOOT, Role.FOREARM: Role.HAND}
"""The role of a loose end of a limb's last bone: see `loose_ends`."""


def joint_roles(rig: Rig) -> tuple[Role, ...]:
    """Return each joint's role by the names of the rig.

    A forearm must be below an arm, a shin below a thigh and a finger below a hand, so that a
    misleading name gets no hinge limits. A forearm's parent is the upper arm even if it is named
    shoulder, and a one-sided hip above a shin is the thigh. If a rig names both halves of a limb,
    a joint with the same role as its parent bone is a piece of it, a twist; in the same position
    it may repeat the joint, see `_repeats`.
    """
    named = [role_of_word(name) for name in rig.joint_names]
    parts = part_names(rig.joint_names)
    for joint, role in enumerate(named):
        above = rig.parents[joint]
        while above >= 0 and named[above] is Role.TWIST:
            above = rig.parents[above]
        bone = named[above] if above >= 0 else None
        if bone is Role.SHOULDER and role is Role.FOREARM:
            named[above] = Role.UPPER_ARM
        elif bone is Role.OTHER and role is Role.SHIN and "thigh" in (parts[above] or ""):
            named[above] = Role.THIGH
    repeats = _repeats(rig, named)
    halves = {Role.FOREARM: Role.UPPER_ARM, Role.SHIN: Role.THIGH}
    halves |= {above: below for below, above in halves.items()}
    roles: list[Role] = []
    in_hand: list[bool] = []
    for joint, (role, parent) in enumerate(zip(named, rig.parents, strict=True)):
        in_hand.append(role is Role.HAND or bool(parent >= 0 and in_hand[parent]))
        above = parent
        while above >= 0 and roles[above] is Role.TWIST:
            above = rig.parents[above]
        bone = roles[above] if above >= 0 else None
        if repeats[joint]:
            role = roles[parent]
        elif parent != rig.own_parents[joint] and bone in _ENDS:
            # An IK target, whatever its name, such as "IK leg".
            role = _ENDS[bone]
        elif role in halves and role is bone and halves[role] in named:
            role = Role.TWIST
        elif role in (Role.FOREARM, Role.SHIN):
            role = role if bone is halves[role] else Role.OTHER
        elif role in (Role.PALM, Role.THUMB, Role.FINGER):
            role = role if in_hand[joint] else Role.OTHER
        elif role is bone is Role.FOOT and "ankle" in plain_name(rig.joint_names[above]):
            # As SMPL has it: what its foot turns about is the ball.
            role = Role.TOE
        elif role in (Role.OTHER, Role.TOE) and parts[joint] == "Head":
            # The "ball" of a hair strand does not belong to a foot.
            role = Role.FACE
        roles.append(role)
    return tuple(roles)


def plain_name(name: str) -> str:
    """Return a joint's name in lower case letters and digits, without its namespace."""
    last = unicodedata.normalize("NFKC", re.split("[:|]", name)[-1])
    return re.sub(r"[\W_]", "", last.lower())


def role_of_word(name: str) -> Role:
    """Return a joint's role by its name alone."""
    plain = plain_name(name)
    return next(role for role in Role if re.search(JOINT_KINDS[role].words, plain))


def _repeats(rig: Rig, roles: Sequence[Role]) -> npt.NDArray[np.bool_]:
    """Return a (J,) mask of joints that duplicate their parents, such as exported controls.

    They have the parent's position and role, and the parent has no skin of its own. In the trunk,
    where legs may be attached to one of two such joints, their names must be equal too.
    """
    skinned = np.isin(np.arange(len(roles)), rig.joint_of[rig.weights > 0.0])
    places = rig.rest[:, :3, 3]
    near = _SHORT * float(np.ptp(places, axis=0).max())
    plain = [re.sub("^(def|org|mch)|[^a-z0-9]", "", name.lower()) for name in rig.joint_names]
    repeats = np.zeros(len(roles), dtype=np.bool_)
    for joint, parent in enumerate(rig.parents.tolist()):
        if parent < 0 or skinned[parent] or roles[parent] is not roles[joint]:
            continue
        is_shared = roles[joint] in (Role.SPINE, Role.OTHER, Role.FACE)
        repeats[joint] = bool(np.linalg.norm(places[joint] - places[parent]) <= near) and (
            not is_shared or plain[joint] == plain[parent]
        )
    return repeats


def joint_sides(rig: Rig, left: FloatArray, known: Mapping[int, Side]) -> list[Side]:
    """Return the side of each of the rig's J joints, that on which its limb leaves the trunk.

    Parameters
    ----------
    left : (3,) unit vector
    known : sides of some joints
    """
    places = rig.rest[:, :3, 3] @ left
    places = (places - np.median(places)) / float(np.ptp(rig.rest[:, :3, 3], axis=0).max() or 1.0)
    sides: list[Side] = []
    for joint, (parent, place) in enumerate(zip(rig.parents.tolist(), places, strict=True)):
        side = Side.LEFT if place > _MIDDLE else Side.RIGHT if place < -_MIDDLE else Side.MIDDLE
        above = sides[parent] if parent >= 0 else Side.MIDDLE
        side = known.get(joint, side)
        sides.append(side if above is Side.MIDDLE else above)
    return sides


def limb_children(rig: Rig, roles: Sequence[Role]) -> dict[int, int]:
    """Return the joint at the far end of each thigh, shin, upper arm and forearm."""
    next_joint: dict[int, int] = {}
    for joint, role in enumerate(roles):
        above = int(rig.parents[joint])
        while above >= 0 and roles[above] is Role.TWIST:
            above = int(rig.parents[above])
        if above >= 0 and _BONES.get(roles[above]) is role:
            next_joint.setdefault(above, joint)
    return next_joint


def bone_directions(rig: Rig, origins: FloatArray, roles: Sequence[Role]) -> FloatArray:
    """Return the unit vectors of the joints' bones in the rest pose: (J, 3).

    They point to the limb's next joint, else to the mean of the children, else to the mean of the
    vertices that the joint moves, else as the parent's.

    Parameters
    ----------
    origins : (J, 3) of the joints
    roles : of J joints
    """
    size = float(np.ptp(origins, axis=0).max()) + float(np.ptp(rig.points, axis=(0, 1)).max())
    directions = np.zeros_like(origins)
    next_of = limb_children(rig, roles)
    for joint, parent in enumerate(rig.parents):
        following = rig.parents == joint
        if joint in next_of:
            following = np.arange(len(origins)) == next_of[joint]
        ends = origins[following] - origins[joint]
        ends = ends[np.linalg.norm(ends, axis=1) > _SHORT * size]
        led = np.flatnonzero(rig.heaviest == joint)
        if len(ends):
            way = ends.mean(axis=0)
        elif len(led):
            way = rig.points[led].mean(axis=(0, 1)) - origins[joint]
        else:
            way = np.zeros(3)
        length = float(np.linalg.norm(way))
        if length > _SHORT * size:
            directions[joint] = way / length
        else:
            directions[joint] = directions[parent] if parent >= 0 else np.eye(3)[1]
    return directions


def axes_of(up: FloatArray, front: FloatArray) -> FloatArray:
    """Return left, up and front as columns."""
    return np.stack([np.cross(up, front), up, front], axis=1)


def front_of(
    roles: Sequence[Role], origins: FloatArray, directions: FloatArray, up: FloatArray
) -> FloatArray | None:
    """Return the horizontal unit vector along which a body faces; None if undetermined.

    It is the direction of the feet or, if the trunk is more level than upright, as an animal's
    whose hooves point down, that of the spine towards the head.

    Parameters
    ----------
    roles : of J joints
    origins : (J, 3) positions at rest
    directions : (J, 3) bone directions at rest
    up : (3,) unit vector
    """

    def level(way: FloatArray) -> FloatArray:
        flat: FloatArray = way - (way @ up) * up
        return flat

    if Role.HEAD in roles and Role.SPINE in roles:
        way = origins[roles.index(Role.HEAD)] - origins[roles.index(Role.SPINE)]
        length = float(np.linalg.norm(level(way)))
        if length > abs(way @ up):
            return level(way) / length
    feet = [joint for joint, role in enumerate(roles) if role is Role.FOOT]
    way = level(directions[feet].sum(axis=0))
    length = float(np.linalg.norm(way))
    return way / length if length > 0.5 * len(feet) * (1 - _PARALLEL) and feet else None


def front_by_sides(
    lefts: Sequence[int], origins: FloatArray, up: FloatArray, front: FloatArray
) -> FloatArray:
    """Return the horizontal unit vector that has the joints named left on its left.

    Parameters
    ----------
    lefts : J numbers, 1 for left by name, -1 for right, 0 for neither
    origins : (J, 3) positions at rest
    up, front : (3,) unit vectors; `front`, by which poses are stored, stays if no name contradicts
    """
    named = np.array(lefts)
    if not ((named > 0).any() and (named < 0).any()):
        return front
    left = origins[named > 0].mean(axis=0) - origins[named < 0].mean(axis=0)
    way = np.cross(left, up)
    length = float(np.linalg.norm(way))
    is_known = length > _MIDDLE * np.ptp(origins, axis=0).max()
    return way / length if is_known and way @ front < _SAME_WAY * length else front


def joint_axes(
    rig: Rig,
    roles: tuple[Role, ...],
    origins: FloatArray,
    directions: FloatArray,
    up: FloatArray,
    front: FloatArray,
) -> FloatArray:
    """Return the joints' axes in the rest pose: (J, 3, 3), as columns.

    The first bends the bone forward (fingers towards the palm, hinges in their direction), the
    second lies along the bone, the third turns it sideways.
    """
    middle = origins.mean(axis=0)
    above = {hinge: joint for joint, hinge in limb_children(rig, roles).items()}
    axes = np.empty((len(origins), 3, 3))
    for joint, (role, bone) in enumerate(zip(roles, directions, strict=True)):
        towards = front
        if role is Role.SHIN:
            towards = -front
        elif role is Role.FINGER:
            # Palms face down in a T pose, and towards the body if the arms hang.
            towards = -up
            if abs(bone @ up) > _PARALLEL:
                towards = middle - origins[joint]
        if abs(bone @ towards) > _PARALLEL * np.linalg.norm(towards):
            towards = up if abs(bone @ up) <= _PARALLEL else front
        bend = np.cross(bone, towards)
        if role in (Role.FOREARM, Role.SHIN):
            normal = np.cross(directions[above.get(joint, rig.parents[joint])], bone)
            angle = float(np.linalg.norm(normal))
            # A nearly straight hinge may be slightly overextended or skewed.
            is_sure = angle > np.sin(_CLEARLY_BENT)
            if angle > np.sin(_BENT) and (is_sure or normal @ bend > 0.5 * angle):
                bend = normal
        bend /= np.linalg.norm(bend)
        axes[joint] = np.stack([bend, bone, np.cross(bend, bone)], axis=1)
    return axes


def joint_limits(rig: Rig, roles: tuple[Role, ...]) -> tuple[FloatArray, FloatArray]:
    """Return bounds of the joints' rotation vectors in their axes, (J, 3) each, in radians.

    Both are 0 for joints that do not turn.
    """
    bounds = np.radians(np.array([JOINT_KINDS[role].limits for role in roles], dtype=np.float64))
    for joint, (role, parent) in enumerate(zip(roles, rig.parents, strict=True)):
        # Only the first joint of a finger turns sideways.
        if role is Role.FINGER and parent >= 0 and roles[parent] is Role.FINGER:
            bounds[joint, 2] = 0.0
    bounds[_repeats(rig, roles)] = 0.0
    return bounds[:, :, 0], bounds[:, :, 1]


ROLE_NAMES: Mapping[str, tuple[Role, Side]] = {
    f"{kind.label}-{side.value}" if kind.is_paired else kind.label: (role, side)
    for role, kind in JOINT_KINDS.items()
    for side in ((Side.LEFT, Side.RIGHT) if kind.is_paired else (Side.MIDDLE,))
}
"""Roles that a user can assign to joints."""


def role_name(role: Role, side: Side) -> str:
    """Return a joint's entry of `ROLE_NAMES`; "unknown" also for a limb joint without a side."""
    return next(
        (
            name
            for name, (entry, own) in ROLE_NAMES.items()
            if entry is role and own in (side, Side.MIDDLE)
        ),
        "unknown",
    )


_LIMBS = frozenset(role for role, kind in JOINT_KINDS.items() if kind.part) - {*TRUNK, Role.FACE}
_LIMB_BONES = frozenset((Role.UPPER_ARM, Role.FOREARM, Role.THIGH, Role.SHIN))
_ONE_OF_A_LIMB = _LIMBS - {Role.TOE, *FINGERS} | {Role.HEAD}

_ABOVE_THIGHS = (" shin", " leg", " hind shoulder")
"""Endings of part names that cannot apply above a thigh."""

_SAME_WAY = 0.9
"""Least cosine between feet and front for them to agree."""

_UNKNOWN = (
    "its joints are not recognised as a person's, so random poses turn them little; set their "
    "roles in the menus of their sliders, or with `lcollision domains --role`"
)
_FOUR_LEGS = "it stands on four legs, so random poses turn its limbs only a little"


@dataclass(frozen=True, eq=False)
class Anatomy:
    """Roles of a rig's J joints, and the direction that the body faces.

    Attributes
    ----------
    roles, sides : of each joint
    labels : J names of body parts
    front : (3,) horizontal unit vector
    axes : (J, 3, 3): see `joint_axes`
    notes : sentences about unknown joints
    """

    roles: tuple[Role, ...]
    sides: tuple[Side, ...]
    labels: tuple[str, ...]
    front: FloatArray
    axes: FloatArray
    notes: tuple[str, ...]


def anatomy_of(character: Character) -> Anatomy:
    """Recognise the joints of a character's rig.

    Names and skeleton are compared limb by limb: names that cannot follow each other along a limb
    are ignored there. If the skeleton is not a person's, only names count.

    Raises
    ------
    LCollisionError : the character has no rig.
    """
    rig, up = rig_of(character), character.up
    chosen_roles = {
        rig.joint_names.index(name): ROLE_NAMES[role] for name, role in rig.chosen.items()
    }
    parts = list(part_names(rig.joint_names))
    lefts = [
        -1 if part.startswith("Right ") else int(part.startswith("Left "))
        for part in (part or "" for part in parts)
    ]
    for joint, (_, side) in chosen_roles.items():
        lefts[joint] = {Side.LEFT: 1, Side.RIGHT: -1, Side.MIDDLE: 0}[side]
    named = list(joint_roles(rig))
    _rename_ends(rig, parts)
    skeleton = Skeleton(rig, named, lefts, up)
    person, notes = skeleton.person(), []
    for joint in _numbered_spine(rig.joint_names, named, person):
        named[joint] = Role.OTHER
        if person is not None and joint in person.roles:
            parts[joint] = None
    roles, by_name = _merged(named, person, skeleton)
    for joint, (role, _) in chosen_roles.items():
        roles[joint] = role
    directions = bone_directions(rig, rig.rest[:, :3, 3], roles)
    front = front_of(roles, rig.rest[:, :3, 3], directions, up)
    if person is not None and person.front is not None:
        level = person.front - (person.front @ up) * up
        length = float(np.linalg.norm(level))
        if length > 0.5 and (front is None or front @ level < _SAME_WAY * length):
            front = level / length
    animal = skeleton.front_of_four_legs() if person is None else None
    front = animal if front is None else front
    if front is None:
        upwards = int(np.abs(up).argmax())
        front = front_direction(character.rest_vertices * up[upwards], upwards) * up[upwards]
    if person is None:  # Like the sides below.
        front = front_by_sides(lefts, rig.rest[:, :3, 3], up, front)
    if animal is not None:
        roles = [
            Role.OTHER if role in _LIMBS and joint not in chosen_roles else role
            for joint, role in enumerate(roles)
        ]
        notes.append(_FOUR_LEGS)
    if not notes and len(roles) > 1 and not _LIMBS.intersection(roles):
        notes.append(_UNKNOWN)
    own_up, own_front = (up, front)
    if person is not None and person.front is not None and person.up @ up < 0.5:
        # It lies down, or the file is wrong about the up axis.
        own_up, own_front = person.up, person.front
    axes = joint_axes(rig, tuple(roles), rig.rest[:, :3, 3], directions, own_up, own_front)
    left = np.cross(own_up, own_front)
    sides = joint_sides(rig, left, skeleton.sides_of(person, left) if person else {})
    for joint, named_left in enumerate(lefts):
        # Without a trunk in the middle, names are more reliable than positions.
        if named_left and (person is None or joint in chosen_roles):
            sides[joint] = Side.LEFT if named_left > 0 else Side.RIGHT
    trusted_parts = [
        part if trusted and joint not in chosen_roles else None
        for joint, (part, trusted) in enumerate(zip(parts, by_name, strict=True))
    ]
    labels = joint_labels(
        rig.joint_names,
        rig.parents,
        [
            part or _part(role, side)
            for part, role, side in zip(trusted_parts, roles, sides, strict=True)
        ],
    )
    return Anatomy(tuple(roles), tuple(sides), labels, front, axes, tuple(notes))


def _rename_ends(rig: Rig, parts: list[str | None]) -> None:
    """Rename shins above a thigh, and loose ends of shins and forearms as feet and hands."""
    is_above = np.zeros(len(parts), dtype=np.bool_)
    for joint in range(len(parts) - 1, -1, -1):
        parent = int(rig.parents[joint])
        if parent >= 0:
            is_above[parent] |= is_above[joint] or (parts[joint] or "").endswith(" thigh")
    for joint, part in enumerate(parts):
        parent, part = int(rig.parents[joint]), part or ""
        if is_above[joint] and part.endswith(_ABOVE_THIGHS):
            name = "shoulder" if " front " in part else "haunch" if " hind " in part else "hip"
            parts[joint] = f"{part.split(' ')[0]} {name}"
        elif parent >= 0 and parent != rig.own_parents[joint] and parts[parent] == part:
            for bone, end in ((" shin", " foot"), (" forearm", " hand")):
                if part.endswith(bone):
                    parts[joint] = part.removesuffix(bone) + end


def _part(role: Role, side: Side) -> str | None:
    kind = JOINT_KINDS[role]
    of_side = f"{side.value} " if kind.is_paired else ""
    return None if kind.part is None else f"{of_side}{kind.part}".strip().capitalize()


def _numbered_spine(
    names: Sequence[str], named: Sequence[Role], person: Person | None
) -> list[int]:
    """Return the joints of a spine that is one numbered word up to the head, as Rigify's."""
    roles = {} if person is None else person.roles
    words = [re.sub(r"[\W\d_]", "", name) for name in names]
    spine = {words[joint] for joint, role in roles.items() if named[joint] is role is Role.SPINE}
    top = [joint for joint, role in roles.items() if role in (Role.NECK, Role.HEAD)]
    if {named[joint] for joint in top} & {Role.NECK, Role.HEAD}:
        return []
    spine &= {words[joint] for joint in top}
    return [joint for joint, word in enumerate(words) if word in spine]


def _merged(
    named: Sequence[Role], person: Person | None, skeleton: Skeleton
) -> tuple[list[Role], list[bool]]:
    """Return merged roles of names and skeleton, and whether to trust each joint's name."""
    roles, trusted = list(named), [True] * len(named)
    if person is None:
        return roles, trusted
    branches = [(list(skeleton.below(root)), order) for root, order in person.limbs.items()]
    in_limbs = {joint for branch, _ in branches for joint in branch}
    trunk = [joint for joint in sorted(person.roles) if joint not in in_limbs]
    n_wrong = 0
    for joints, order in (*branches, (trunk, (*TRUNK, Role.FACE))):
        is_right, counted = _is_in_order(named, joints, order, person, skeleton)
        n_wrong += not is_right
        for joint in joints:
            role = person.roles.get(joint, Role.OTHER)
            if not is_right:
                roles[joint], trusted[joint] = role, named[joint] is Role.OTHER
            elif named[joint] is Role.OTHER and role is not Role.FACE:
                roles[joint] = Role.OTHER if role in counted & _ONE_OF_A_LIMB else role
    if n_wrong > len(branches) // 2:
        # Distrust the remaining names too.
        for joint in set(range(len(named))) - in_limbs - set(trunk):
            roles[joint], trusted[joint] = Role.OTHER, named[joint] is Role.OTHER
    return roles, trusted


def _is_in_order(
    named: Sequence[Role],
    joints: Sequence[int],
    order: Sequence[Role],
    person: Person,
    skeleton: Skeleton,
) -> tuple[bool, set[Role]]:
    """Return whether the names along a limb may be right, and the roles that they name."""
    named_joints = [joint for joint in joints if named[joint] not in (Role.TWIST, Role.OTHER)]
    counted = {named[joint] for joint in named_joints}
    if not counted <= set(order):
        return False, counted
    for joint in named_joints:
        above = next((higher for higher in skeleton.above(joint) if higher in named_joints), joint)
        if order.index(named[above]) > order.index(named[joint]):
            return False, counted
    # If both bones of a limb are named, the skeleton may be wrong about it.
    bones = _LIMB_BONES.intersection(order)
    if bones and bones <= counted:
        return True, counted
    # A neck or a head has no arms.
    pairs = [(named[joint], person.roles[joint]) for joint in joints if joint in person.roles]
    contradicts = any(
        (name is not role and name in _ONE_OF_A_LIMB | {Role.TWIST} and role in _ONE_OF_A_LIMB)
        or (name in (Role.NECK, Role.HEAD) and role is Role.SPINE)
        for name, role in pairs
    )
    return not contradicts, counted


def joint_parts(character: Character, anatomy: Anatomy | None = None) -> npt.NDArray[np.str_]:
    """Return the name of each vertex's body part, by the largest weight.

    Parameters
    ----------
    anatomy : of the character, if already known

    Returns
    -------
    (V,) array, as "Left forearm"; fingers and toes belong to hands and feet, and unknown parts
    are named after their joints

    Raises
    ------
    LCollisionError : the character has no rig.
    """
    joint_anatomy, rig = anatomy or anatomy_of(character), rig_of(character)
    return part_labels(joint_anatomy.labels, rig.joint_of, rig.weights)


def rig_of(character: Character) -> Rig:
    """Return a character's rig.

    Raises
    ------
    LCollisionError : it has none.
    """
    if character.rig is None:
        raise LCollisionError(character.no_rig, "choose a rigged character", where=character.source)
    return character.rig
