"""The arrays of the compiled loops: the tree, workspace of one pose, and results."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int32]


class FaceTree(NamedTuple):
    """A binary tree over the faces, whose leaves hold `kernels.LEAF_SIZE` slots of faces each.

    Nodes are stored parents before children, so a refit walks them backwards. S is the number
    of slots, a multiple of `kernels.LEAF_SIZE`; n the number of nodes.

    Attributes
    ----------
    slot_face : (S,) int32, the face in each slot, -1 in the unused slots of the last leaf
    corners : (3 S,) int32, leaf by leaf the first corners of its faces, then the second, then
        the third, as vertex indices; -1 in unused slots
    left, right : (n,) int32, the children of a node, -1 at a leaf
    leaf : (n,) int32, the number of the leaf, -1 at an inner node
    size : (n,) int32, faces below the node
    """

    slot_face: IntArray
    corners: IntArray
    left: IntArray
    right: IntArray
    leaf: IntArray
    size: IntArray


class Exclusions(NamedTuple):
    """Which pairs of faces do not count, by `ContactRules` on one mesh.

    Two faces are near each other at rest where a corner of one is a corner of the other or near it:
    the vertices near vertex v and after it are ``near[near_start[v]:near_start[v + 1]]``. What
    touches at rest is listed by faces: those of face f with faces after it are
    ``face[start[f]:start[f + 1]]``. Pairs of groups are kept by region, as two groups relate too
    many faces for a list. The joints about which face f lies are
    ``joint[joint_start[f]:joint_start[f + 1]]``: two faces about one joint do not count. What
    nearly always touches is listed as what touches at rest. Lists are ascending, and all of one
    kind may be missing.

    Attributes
    ----------
    corners : (F, 3) int32, vertex indices
    near_start : (V + 1,) or (1,) int64
    near : (m,) int32, vertex indices
    start : (F + 1,) or (1,) int64
    face : (n,) int32, face indices
    region : (F,) int32, the region of each face: faces of one region are of the same groups; (0,)
        where the rules name no groups
    ignored : (R, R) bool, symmetric, which pairs of regions are ignored
    squared_tolerance : (R, R) float64, symmetric, of the depth that pairs of regions tolerate, in
        normalised length squared; (1, 1) where the rules name no groups
    joint_start : (F + 1,) or (1,) int64
    joint : (k,) int32, joints by number
    touching_start : (F + 1,) or (1,) int64
    touching : (t,) int32, face indices
    """

    corners: IntArray
    near_start: npt.NDArray[np.int64]
    near: IntArray
    start: npt.NDArray[np.int64]
    face: IntArray
    region: IntArray
    ignored: npt.NDArray[np.bool_]
    squared_tolerance: npt.NDArray[np.float64]
    joint_start: npt.NDArray[np.int64]
    joint: IntArray
    touching_start: npt.NDArray[np.int64]
    touching: IntArray


class Nearness(NamedTuple):
    """How near two faces may come: see `contact.distance`.

    Attributes
    ----------
    clearance : > 0, in normalised length, required of faces that skin does not join
    corners : (F, 3) int32, vertex indices
    rest : (V, 3) float64, the rest pose in normalised length; (0, 3) where it is unknown
    touching : normalised length, from which on a distance at rest is one, and not rounding
    joined_start : (V + 1,) or (1,) int64, where there is no rest pose
    joined : (m,) int32, the vertices after each that skin joins to it; lists are ascending
    region : (F,) int32, the region of each face: faces of one region are of the same groups; (0,)
        where no groups may touch
    may_touch : (R, R) bool, symmetric, which pairs of regions may come to distance 0
    """

    clearance: float
    corners: IntArray
    rest: npt.NDArray[np.float64]
    touching: float
    joined_start: npt.NDArray[np.int64]
    joined: IntArray
    region: IntArray
    may_touch: npt.NDArray[np.bool_]


class UncountedNodes(NamedTuple):
    """Pairs of nodes of a `FaceTree` below which no pair of faces can count.

    Either the two faces share a vertex or a contact rule excludes them, whatever the pose. Nodes of
    one level have a table: inner nodes of one depth, and all leaves.

    Attributes
    ----------
    level : (n,) int32, the table of each node
    number : (n,) int32, its row and column in it
    start : (levels,) int64, the first byte of each table
    stride : (levels,) int64, the bytes of a row
    bits : (m,) uint8, eight columns a byte, the lowest bit first; (0,) where nothing is known
    """

    level: IntArray
    number: IntArray
    start: npt.NDArray[np.int64]
    stride: npt.NDArray[np.int64]
    bits: npt.NDArray[np.uint8]


class PoseWork(NamedTuple):
    """The workspace of one pose, kept between poses.

    Attributes
    ----------
    middle : (3,) float64, the middle of the pose's bounding box, in its unit
    vertices : (V, 3) float64, in normalised length about that middle
    rounded : (V, 3) float32, the same
    pair : (2, 3, 3) float64, the corners of two triangles
    boxes : (6 S,) float32, leaf by leaf the lower x of its slots, lower y, lower z, upper x, ...
    node_boxes : (n, 6) float32, lower x, y, z, upper x, y, z
    stack : (depth bound, 2) int32, pairs of nodes still to be visited
    fraction : (depth bound,) float64, what fraction of the search each of these is guessed to be
    """

    middle: npt.NDArray[np.float64]
    vertices: npt.NDArray[np.float64]
    rounded: npt.NDArray[np.float32]
    pair: npt.NDArray[np.float64]
    boxes: npt.NDArray[np.float32]
    node_boxes: npt.NDArray[np.float32]
    stack: IntArray
    fraction: npt.NDArray[np.float64]


class Found(NamedTuple):
    """A buffer for penetrating pairs of one pose, filled from the front, emptied when full.

    With a clearance, for pairs that are too near; their depth is what they lack.

    Attributes
    ----------
    slots : (P, 2) int32, the slots of the two faces
    squared_depth : (P,) float64, in normalised length squared
    rule : (P,) uint8, why the pair does not count: `kernels.NEAR` and so on, `kernels.COUNTED`
        where it does
    """

    slots: IntArray
    squared_depth: npt.NDArray[np.float64]
    rule: npt.NDArray[np.uint8]
