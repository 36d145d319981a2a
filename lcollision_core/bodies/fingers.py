"""Match joints to finger segments by their names."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.skeletons import plain_name
from lcollision_core.meshes.joint_kinds import Role, Side

FINGERS = {
    "thumb": "thumb|親指",
    "index": "index|人[指差]",
    "middle": "mid|中指",
    "ring": "ring|薬指",
    "little": "little|pink|小指",
}
"""A pattern of each finger's names, lower case without separators: English, and MMD's."""

N_SEGMENTS = 3
_TIP = re.compile(r"((end|tip|nub)(site)?\d*[lr]?|先)$")
_PALM = re.compile("carpal|palm")

Segment = tuple[Side, str, int]
"""A side, a key of `FINGERS`, and 1 to 3 from the palm on; 0 lies in the palm, 4 is a tip."""


def finger_joints(
    names: Sequence[str],
    parents: npt.NDArray[np.integer],
    roles: Sequence[Role],
    sides: Sequence[Side],
) -> dict[Segment, int]:
    """Return the joint of each finger segment; fingers with unknown names are left out.

    Parameters
    ----------
    names, parents, roles, sides : of J joints; parents come before children
    """
    chains: dict[tuple[Side, str], list[int]] = defaultdict(list)
    in_hand: list[bool] = []
    plain = [plain_name(name) for name in names]
    for joint, parent in enumerate(parents.tolist()):
        is_below = parent >= 0 and (in_hand[parent] or roles[parent] is Role.HAND)
        in_hand.append(is_below)
        finger = next(
            (finger for finger, words in FINGERS.items() if re.search(words, plain[joint])), ""
        )
        if is_below and (finger or roles[joint] is Role.THUMB):
            chains[sides[joint], finger or "thumb"].append(joint)
    above = set(parents.tolist())
    joints: dict[Segment, int] = {}
    for (side, finger), chain in chains.items():
        # Rigify's controls lie beside the bones that deform.
        deforming = [joint for joint in chain if plain[joint].startswith("def")] or chain
        bones = [joint for joint in deforming if not _TIP.search(plain[joint])]
        n_palm = sum(finger != "thumb" and bool(_PALM.search(plain[joint])) for joint in bones)
        while len(bones) > N_SEGMENTS + n_palm and bones[-1] not in above:
            bones.pop()
        n_palm = max(n_palm, len(bones) - N_SEGMENTS)
        tips = [joint for joint in deforming if joint not in bones]
        numbered = [(place + 1 - n_palm, joint) for place, joint in enumerate(bones)]
        numbered += [(N_SEGMENTS + 1, joint) for joint in tips[:1]]
        joints |= {(side, finger, number): joint for number, joint in numbered if number >= 0}
    return joints
