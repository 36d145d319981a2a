"""Arrays of the compiled loops: the tree, the workspace of one pose, and results."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int32]


class FaceTree(NamedTuple):
    """A binary tree over the faces; each leaf has `kernels.LEAF_SIZE` slots for faces.

    Nodes are stored parents before children, so a refit walks them backwards. S is the number
    of slots, a multiple of `kernels.LEAF_SIZE`; n the number of nodes.

    Attributes
    ----------
    slot_face : (S,) int32, the face in each slot, -1 in the unused slots of the last leaf
    corners : (3 S,) int32, vertex indices; for each leaf the first corners of its faces, then the
        second, then the third; -1 in unused slots
    left, right : (n,) int32, the children of a node, -1 at a leaf
    leaf : (n,) int32, the number of the leaf, -1 at an inner node
    size : (n,) int32, the number of faces below the node
    start, vertex : (leaves + 1,) and (m,) int32; leaf i has the vertices
        ``vertex[start[i]:start[i + 1]]``, each once
    """

    slot_face: IntArray
    corners: IntArray
    left: IntArray
    right: IntArray
    leaf: IntArray
    size: IntArray
    start: IntArray
    vertex: IntArray


class Lists(NamedTuple):
    """Lists of faces or vertices, each ascending; list i is ``entry[start[i]:start[i + 1]]``.

    Attributes
    ----------
    start : (n + 1,) int64
    entry : (m,) int32
    """

    start: npt.NDArray[np.int64]
    entry: IntArray


class Exclusions(NamedTuple):
    """The pairs of faces of one mesh that do not count by `ContactRules`.

    Two faces are near each other at rest if a corner of one is a corner of the other or near it.
    Two faces about one joint do not count. Pairs of groups are kept by region, as two groups relate
    too many faces for a list. All lists of one kind may be missing.

    Attributes
    ----------
    corners : (F, 3) int32, vertex indices
    near : for each of V vertices, the later ones near it
    rest, touching, shape : for each of F faces, the later ones that touch it at rest, in nearly
        every pose, or in shapes
    joint : for each of F faces, the numbers of the joints that it lies about
    region : (F,) int32, the region of each face: faces of one region are in the same groups; (0,)
        if the rules name no groups
    ignored : (R, R) bool, symmetric, whether a pair of regions is ignored
    squared_tolerance : (R, R) float64, symmetric, square of the tolerated depth of a pair of
        regions, in normalised length squared; (1, 1) if the rules name no groups
    """

    corners: IntArray
    near: Lists
    rest: Lists
    touching: Lists
    shape: Lists
    joint: Lists
    region: IntArray
    ignored: npt.NDArray[np.bool_]
    squared_tolerance: npt.NDArray[np.float64]


class ClearanceRule(NamedTuple):
    """How near two faces may come: see `contact.distance`.

    Attributes
    ----------
    clearance : > 0, in normalised length, required of faces that skin does not join
    corners : (F, 3) int32, vertex indices
    rest : (V, 3) float64, the rest pose in normalised length; (0, 3) if it is unknown
    touching : normalised length; a smaller distance at rest is taken as rounding
    joined_start : (V + 1,) or (1,) int64, used without a rest pose
    joined : (m,) int32, for each vertex the later ones that skin joins to it; lists are ascending
    region : (F,) int32, the region of each face: faces of one region are in the same groups; (0,)
        if no groups may touch
    may_touch : (R, R) bool, symmetric, whether a pair of regions may come to distance 0
    """

    clearance: float
    corners: IntArray
    rest: npt.NDArray[np.float64]
    touching: float
    joined_start: npt.NDArray[np.int64]
    joined: IntArray
    region: IntArray
    may_touch: npt.NDArray[np.bool_]


class SkippableNodes(NamedTuple):
    """Pairs of nodes of a `FaceTree` below which no pair of faces can count.

    All pairs of faces below them share a vertex or are excluded by a contact rule, whatever the
    pose. Each level of nodes has a table: the inner nodes of one depth, or all leaves.

    Attributes
    ----------
    level : (n,) int32, the table of each node
    number : (n,) int32, the node's row and column in its table
    start : (levels,) int64, the first byte of each table
    stride : (levels,) int64, the bytes of a row
    bits : (m,) uint8, eight columns a byte, the lowest bit first; (0,) if there are no tables
    """

    level: IntArray
    number: IntArray
    start: npt.NDArray[np.int64]
    stride: npt.NDArray[np.int64]
    bits: npt.NDArray[np.uint8]


class PoseWorkspace(NamedTuple):
    """The workspace of one pose, kept between poses.

    Attributes
    ----------
    middle : (3,) float64, the middle of the pose's bounding box, in the pose's unit
    vertices : (V, 3) float64, in normalised length about that middle
    pair : (2, 3, 3) float64, the corners of two triangles
    boxes : (6 S,) float32; for each leaf the lower x of its slots, lower y, lower z, upper x, ...
    has_boxes : (leaves,) bool, whether these are filled in for a leaf
    node_boxes : (n, 6) float32, lower x, y, z, upper x, y, z
    stack : (depth bound, 2) int32, pairs of nodes still to be visited
    fraction : (depth bound,) float64, the estimated fraction of the search that each of these is
    """

    middle: npt.NDArray[np.float64]
    vertices: npt.NDArray[np.float64]
    pair: npt.NDArray[np.float64]
    boxes: npt.NDArray[np.float32]
    has_boxes: npt.NDArray[np.bool_]
    node_boxes: npt.NDArray[np.float32]
    stack: IntArray
    fraction: npt.NDArray[np.float64]


class PairBuffer(NamedTuple):
    """A buffer for penetrating pairs of one pose, filled from the front, emptied when full.

    With a clearance it holds pairs that are too near; their depth is the missing distance.

    Attributes
    ----------
    slots : (P, 2) int32, the slots of the two faces
    squared_depth : (P,) float64, in normalised length squared
    rule : (P,) uint8, the rule that excludes the pair: `kernels.NEAR` and so on, or
        `kernels.COUNTED`
    """

    slots: IntArray
    squared_depth: npt.NDArray[np.float64]
    rule: npt.NDArray[np.uint8]
