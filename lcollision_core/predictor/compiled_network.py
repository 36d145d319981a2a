"""The default network on the CPU: compiled loops in single precision, without torch.

For a single pose, `GeometricNetwork` spends most of its time on the overhead of torch's operations,
and a program that only drags sliders would spend seconds on importing torch. Here compiled loops
compute the same network, and its gradients by a backward pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.acap.features import N_FEATURES
from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.embedding.seeding import bridged_edges
from lcollision_core.jobs import for_blocks
from lcollision_core.meshes.normals import vertex_normals
from lcollision_core.meshes.topology import FloatArray, length_graph
from lcollision_core.predictor import kernels
from lcollision_core.predictor.kernels import BLOCK, UNITS, Workspace, Workspaces, in_blocks


def body_points(embedding: Embedding, n_points: int) -> npt.NDArray[np.int64]:
    """Return (P,) ascending vertices spread over the body, which depend only on the embedding.

    Parameters
    ----------
    embedding : of the body
    n_points : P, or the number of used vertices if that is less
    """
    rest, topology = embedding.rest_vertices, embedding.topology
    used = np.setdiff1d(np.arange(len(rest)), topology.unused_vertices)
    positions = rest[used]
    outermost = int(np.linalg.norm(positions - positions.mean(axis=0), axis=1).argmax())
    return np.sort(used[farthest_points(positions, outermost, min(n_points, len(used)))])


def farthest_points(positions: FloatArray, first: int, n_points: int) -> npt.NDArray[np.int64]:
    """Return the indices of a farthest-point sampling of (n, 3) positions.

    Once all are chosen, the first is repeated.
    """
    points = [first]
    nearest = np.linalg.norm(positions - positions[first], axis=1)
    while len(points) < n_points:
        best = int(nearest.argmax())
        points.append(best)
        nearest = np.minimum(nearest, np.linalg.norm(positions - positions[best], axis=1))
    return np.array(points)


def neighbour_order(positions: FloatArray, block: int) -> npt.NDArray[np.int32]:
    """Order (n, 3) positions so that successive blocks of `block` positions are compact.

    They are split in half along their longest extent, recursively. The last one is repeated to fill
    its block.
    """

    def ordered(index: npt.NDArray[np.intp]) -> list[npt.NDArray[np.intp]]:
        n_blocks = -(-len(index) // block)
        if n_blocks < 2:
            return [index]
        vertex_position = positions[index]
        along = vertex_position[:, np.ptp(vertex_position, axis=0).argmax()].argsort(kind="stable")
        half = n_blocks // 2 * block
        return ordered(index[along[:half]]) + ordered(index[along[half:]])

    order = np.concatenate(ordered(np.arange(len(positions))))
    return np.append(order, np.repeat(order[-1], -len(order) % block)).astype(np.int32)


def skin_graph(embedding: Embedding) -> scipy.sparse.csr_matrix:
    """Return the (V, V) lengths of the reference's edges, in normalised length."""
    return length_graph(embedding.topology.edges, embedding.rest_vertices)


def skin_distances(
    graph: scipy.sparse.csr_matrix, vertex: npt.NDArray[np.integer], limit: float = np.inf
) -> FloatArray:
    """Return (n, V) normalised lengths of the shortest edge paths from n vertices.

    They are infinite between components, and beyond the limit.
    """
    distance: FloatArray = scipy.sparse.csgraph.dijkstra(
        graph, directed=False, indices=vertex, limit=limit
    )
    return distance


def skin_cells(embedding: Embedding, centre: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
    """Return (V,) the index of the centre nearest to each vertex along the surface, -1 without any.

    A component without a centre, such as an eye, is reached from its neighbour.
    """
    rest = embedding.rest_vertices
    if not len(centre):
        return np.full(len(rest), -1)
    graph = length_graph(bridged_edges(embedding.topology, rest), rest)
    nearest: npt.NDArray[np.int64] = skin_distances(graph, centre).argmin(axis=0)
    return nearest


def tangent_frames(embedding: Embedding, vertex: npt.NDArray[np.integer]) -> FloatArray:
    """Return (P, 3, 3) frames at vertices of the reference: columns normal and two tangents."""
    normal = vertex_normals(embedding.rest_vertices, embedding.topology.faces)[vertex]
    normal[~normal.any(axis=1)] = [1.0, 0.0, 0.0]
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    tangent = np.cross(normal, axis)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.stack([normal, tangent, np.cross(normal, tangent)], axis=2)


DISTANT = 0.10
"""Normalised length along the surface beyond which two points count in each other's field."""

Float32Array = npt.NDArray[np.float32]


class CodeGroup(NamedTuple):
    """The points that a group of codes moves.

    Attributes
    ----------
    codes : the group's codes, of D
    table : (codes, 9 n) float32 array, to the outputs of the n points that they move
    """

    codes: slice
    table: Float32Array


@dataclass(frozen=True, eq=False)
class SkinGeometry:
    """The points of the body and the fold sites, which depend on the embedding and the sites.

    Attributes
    ----------
    point_vertices : (P,) int64 array, ascending, the vertices that are points of the body
    members : (S, M) int32 array, each site's vertices as indices into the skin
    geodesic_neighbours : (P, P) float32 array, added to squared distances: 1 for pairs so near
        along the surface that they do not count in each other's field, else 0
    order : (O,) int32 array, all points of the body, with neighbours near each other; the last is
        repeated until O is a multiple of `BLOCK`
    neighbour_blocks : `geodesic_neighbours` in that order, see `in_blocks`
    rest_frame : (N, 3, 3) float32 array, frames of the first N points of the skin on the reference,
        as columns, the outer normal first; the skin is the P points, then the other centres of
        sites, then the sites' other vertices, which need no frame
    groups : groups of codes; their outputs follow each other, nine for each point that they move
    target : (T,) int32 array, the point of the skin that nine outputs belong to
    offset : (Q, 9) float32 array, deformation features of codes 0
    scale : (9,) float32 array, of the outputs
    """

    point_vertices: npt.NDArray[np.int64]
    members: npt.NDArray[np.int32]
    geodesic_neighbours: Float32Array
    order: npt.NDArray[np.int32]
    neighbour_blocks: Float32Array
    rest_frame: Float32Array
    groups: list[CodeGroup]
    target: npt.NDArray[np.int32]
    offset: Float32Array
    scale: Float32Array

    @property
    def n_points(self) -> int:
        """P."""
        return len(self.point_vertices)

    @classmethod
    def of(
        cls, embedding: Embedding, sites: npt.NDArray[np.integer], n_points: int
    ) -> SkinGeometry:
        """Choose the points of an embedding's body.

        Parameters
        ----------
        embedding : of the body
        sites : (S, M) vertices around each fold site, see `find_fold_sites`
        n_points : P, unless the mesh has fewer vertices

        Raises
        ------
        ValueError : the sites are not of this body.
        """
        n_vertices = len(embedding.rest_vertices)
        is_table = sites.ndim == 2 and sites.shape[1] > 0
        if not is_table or (sites.size and not 0 <= sites.min() <= sites.max() < n_vertices):
            raise ValueError("the fold sites are not of this body")
        vertex = body_points(embedding, n_points)
        framed = np.append(vertex, np.setdiff1d(sites[:, 0], vertex))
        skin = np.append(framed, np.setdiff1d(sites, framed))
        distance = skin_distances(skin_graph(embedding), vertex, limit=DISTANT)[:, vertex]
        neighbours = np.isfinite(distance).astype(np.float32)
        order = neighbour_order(embedding.rest_vertices[vertex], BLOCK)
        index = np.zeros(n_vertices, dtype=np.int32)
        index[skin] = np.arange(len(skin))
        groups, targets, code = [], [], 0
        for group in embedding.decoder.groups:
            n_codes = len(group.weights)
            _, moved, support_rows = np.intersect1d(skin, group.support, return_indices=True)
            weights = group.weights.reshape(n_codes, -1, N_FEATURES)[:, support_rows]
            table = np.ascontiguousarray(weights.reshape(n_codes, -1), dtype=np.float32)
            groups.append(CodeGroup(slice(code, code + n_codes), table))
            targets.append(moved)
            code += n_codes
        return cls(
            point_vertices=vertex,
            members=index[sites],
            geodesic_neighbours=neighbours,
            order=order,
            neighbour_blocks=in_blocks(neighbours, order),
            rest_frame=tangent_frames(embedding, framed).astype(np.float32),
            groups=groups,
            target=np.concatenate(targets).astype(np.int32),
            offset=embedding.decoder.offset[skin].astype(np.float32),
            scale=embedding.decoder.scale.astype(np.float32),
        )


class PosedSkin(NamedTuple):
    """The skin of B poses.

    Attributes
    ----------
    frame : (B, N, 3, 3) local frames of the first N points of the skin, as columns
    positions : (B, 3, P) of the points of the body, in normalised length
    field : (P, B, 2, 8) contact features, see `geometric_network.ContactField`
    folds : (S, B, 9 M) the deformation around the fold sites
    outputs, features, turns, rows : needed for the derivatives: (B, T, 9) tanh of each group's
        outputs, (B, Q, 9) deformation features, the result of `kernels.rodrigues`, and
        (B, 3, Q, 3) rows of the deformation gradients
    """

    frame: Float32Array
    positions: Float32Array
    field: Float32Array
    folds: Float32Array
    outputs: Float32Array
    features: Float32Array
    turns: Float32Array
    rows: Float32Array


class CompiledSkin:
    """A reduced body posed by latent codes.

    Parameters
    ----------
    geometry : the points of the body
    weight : (3 P, P) float32 array, from the points' deformation gradients to their positions
    origin : (3, P) offset of the positions, in normalised length
    """

    def __init__(self, geometry: SkinGeometry, weight: Float32Array, origin: Float32Array) -> None:
        self._geometry, self._weight, self._origin = geometry, weight, origin

    def forward(self, codes: Float32Array, workspace: Workspace) -> PosedSkin:
        """Pose the skin by (B, D) codes, in the memory of a workspace."""
        geometry, n_rows, empty = self._geometry, len(codes), workspace.empty
        (n_skin, _), (n_sites, n_members) = geometry.offset.shape, geometry.members.shape
        outputs = empty("outputs", n_rows, N_FEATURES * len(geometry.target))
        stop = 0
        for group in geometry.groups:
            start, stop = stop, stop + group.table.shape[1]
            np.matmul(codes[:, group.codes], group.table, out=outputs[:, start:stop])
        np.tanh(outputs, out=outputs)
        outputs = outputs.reshape(n_rows, -1, N_FEATURES)
        features = empty("features", n_rows, n_skin, N_FEATURES)
        kernels.add_features(outputs, geometry.target, geometry.offset, geometry.scale, features)
        turns = kernels.rodrigues(features)
        frame = empty("frame", n_rows, *geometry.rest_frame.shape)
        rows = empty("rows", n_rows, 3, n_skin, 3)
        kernels.deform(features, turns, geometry.rest_frame, frame, rows)
        point_rows = rows[:, :, : geometry.n_points].reshape(3 * n_rows, -1)
        moved = np.matmul(
            point_rows, self._weight, out=empty("moved", 3 * n_rows, geometry.n_points)
        )
        positions = moved.reshape(n_rows, 3, -1) + self._origin
        field = empty("field", geometry.n_points, n_rows, *UNITS.shape)
        kernels.contact_field(frame, positions, geometry.order, geometry.neighbour_blocks, field)
        folds = empty("folds", n_sites, n_rows, N_FEATURES * n_members)
        kernels.fold_view(frame, rows, geometry.members, folds)
        return PosedSkin(frame, positions, field, folds, outputs, features, turns, rows)

    def backward(
        self,
        skin: PosedSkin,
        grad_field: Float32Array,
        grad_folds: Float32Array,
    ) -> Float32Array:
        """Pull derivatives by contact features and folds back to (B, D) codes."""
        geometry, n_rows = self._geometry, len(skin.frame)
        grad_frame, grad_positions = np.zeros_like(skin.frame), np.zeros_like(skin.positions)
        kernels.contact_field_backward(
            skin.frame,
            skin.positions,
            geometry.order,
            geometry.neighbour_blocks,
            skin.field,
            grad_field,
            grad_frame,
            grad_positions,
        )
        grad_rows = np.zeros_like(skin.rows)
        grad_own = grad_positions.reshape(3 * n_rows, -1) @ self._weight.T
        grad_rows[:, :, : geometry.n_points] = grad_own.reshape(n_rows, 3, -1, 3)
        kernels.fold_view_backward(
            skin.frame, skin.rows, geometry.members, grad_folds, grad_frame, grad_rows
        )
        grad_features = np.empty_like(skin.features)
        kernels.deform_backward(
            skin.features, skin.turns, geometry.rest_frame, grad_frame, grad_rows, grad_features
        )
        grad_products = np.empty((n_rows, skin.outputs[0].size), dtype=np.float32)
        kernels.add_features_backward(
            skin.outputs, geometry.target, geometry.scale, grad_features, grad_products
        )
        grad_codes, start = [], 0
        for group in geometry.groups:
            stop = start + group.table.shape[1]
            grad_codes.append(grad_products[:, start:stop] @ group.table.T)
            start = stop
        return np.concatenate(grad_codes, axis=1)


State = Mapping[str, npt.NDArray[Any]]
Array = npt.NDArray[np.float32]

SQUASHED = 4.0
"""Divisor of a patch's logit before tanh, whose result is an input of the head."""

_ROWS_AT_ONCE = 64
"""Poses computed together: their arrays, half a megabyte per pose, stay in the caches."""


class CompiledNetwork:
    """A trained default network, immutable.

    Parameters
    ----------
    embedding : of the body
    state : the state dict of a `GeometricNetwork`, as arrays that fit the embedding

    Attributes
    ----------
    skin : the points of the body and the fold sites
    """

    def __init__(self, embedding: Embedding, state: State) -> None:
        sites, points = state["site_vertices"].astype(np.int64), _copied(state["body.points"])
        self.skin = SkinGeometry.of(embedding, sites, points.shape[1])
        self._body = CompiledSkin(self.skin, points, _copied(state["body.origin"]))
        self._patch, self._fold = (_Networks(state, f"{name}.") for name in ("patch", "fold"))
        self._head = _Networks(state)
        self._any_contact = _copied(state["any_hit"])
        self._workspaces = Workspaces()

    def outputs(self, latent: npt.NDArray[Any]) -> tuple[FloatArray, FloatArray]:
        """Return (B, K) scaled energies of the domains and (B,) logits of (B, D) poses."""
        root, logit = np.empty((len(latent), self._head.n_out - 2)), np.empty(len(latent))

        def fill(start: int, stop: int) -> None:
            with self._workspaces.lent() as workspace:
                trace = self._forward(latent[start:stop].astype(np.float32), workspace)
                root[start:stop], logit[start:stop] = trace.head[-1][0, :, 1:-1], trace.logit

        for_blocks(fill, len(latent), _ROWS_AT_ONCE)
        return np.square(np.maximum(root, 0.0)), logit

    def logit_and_gradient(self, latent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (B,) logits of (B, D) poses, and their (B, D) derivatives by the codes."""
        logit, gradient = np.empty(len(latent)), np.empty(latent.shape)

        def fill(start: int, stop: int) -> None:
            with self._workspaces.lent() as workspace:
                trace = self._forward(latent[start:stop].astype(np.float32), workspace)
                logit[start:stop], gradient[start:stop] = trace.logit, self._backward(trace)

        for_blocks(fill, len(latent), _ROWS_AT_ONCE)
        return logit, gradient

    def _forward(self, codes: Array, workspace: Workspace) -> _Trace:
        body = self._body.forward(codes, workspace)
        patch = self._patch.forward(body.field.reshape(*body.field.shape[:2], -1), workspace)
        fold = self._fold.forward(body.folds, workspace)
        contact, root = np.concatenate([patch[-1], fold[-1]]).transpose(2, 1, 0)
        squashed = np.tanh(contact / SQUASHED)
        head = self._head.forward(np.concatenate([squashed, root], axis=1)[None], workspace)
        # Log-sum-exp, and its derivative, the softmax.
        largest = contact.max(axis=1, keepdims=True)
        softmax = np.exp(contact - largest)
        total = softmax.sum(axis=1, keepdims=True)
        softmax /= total
        scale, offset = self._any_contact
        logit = head[-1][0, :, 0] + (largest + np.log(total))[:, 0] * scale + offset
        return _Trace(body, patch, fold, squashed, softmax, head, logit)

    def _backward(self, trace: _Trace) -> Array:
        n_points, n_contacts = self.skin.n_points, trace.softmax.shape[1]
        grad_head = np.zeros_like(trace.head[-1])
        grad_head[..., 0] = 1.0
        grad_values = self._head.backward(trace.head, grad_head)[0]
        slope = (1.0 - np.square(trace.squashed)) / SQUASHED
        grad_contact = grad_values[:, :n_contacts] * slope + self._any_contact[0] * trace.softmax
        grad_both = np.stack([grad_contact, grad_values[:, n_contacts:]], axis=2)
        grad_patch, grad_fold = map(
            np.ascontiguousarray, np.split(grad_both.transpose(1, 0, 2), [n_points])
        )
        grad_field = self._patch.backward(trace.patch, grad_patch)
        grad_folds = self._fold.backward(trace.fold, grad_fold)
        return self._body.backward(
            trace.body, grad_field.reshape(trace.body.field.shape), grad_folds
        )


class _Trace(NamedTuple):
    """The results of a forward pass of B poses that the backward pass needs.

    Attributes
    ----------
    body : the posed skin
    patch, fold, head : each layer's values in the networks
    squashed, softmax : (B, P + S) of the contact logits of patches and folds
    logit : (B,)
    """

    body: PosedSkin
    patch: list[Array]
    fold: list[Array]
    squashed: Array
    softmax: Array
    head: list[Array]
    logit: Array


class _Networks:
    """n stacked networks of one size, each with its own inputs; silu between layers.

    Parameters
    ----------
    state : the state dict
    name : prefix of the networks, whose inputs are standardised; empty for the head
    """

    def __init__(self, state: State, name: str = "") -> None:
        self._name = name
        prefix = f"{name}layers." if name else "head."
        self._layers: list[tuple[Array, Array]] = []
        while f"{prefix}{len(self._layers)}.weight" in state:
            weight = _copied(state[f"{prefix}{len(self._layers)}.weight"])
            bias = state[f"{prefix}{len(self._layers)}.bias"]
            weight = weight.reshape(-1, *weight.shape[-2:])
            self._layers.append((weight, _copied(bias.reshape(len(weight), weight.shape[2]))))
        if name:
            # The first layer standardises the inputs.
            weight, bias = self._layers[0]
            mean, deviation = (state[name + what].astype(float) for what in ("mean", "deviation"))
            scaled = weight / deviation.transpose(0, 2, 1)
            self._layers[0] = _copied(scaled), _copied(bias - (mean @ scaled)[:, 0])
        self._back = [_copied(weight.transpose(0, 2, 1)) for weight, _ in self._layers]
        self.n_out = self._layers[-1][0].shape[2]

    def forward(self, inputs: Array, workspace: Workspace) -> list[Array]:
        """Apply to (n, B, n_in) inputs; return each layer's values, before the silu."""
        values: list[Array] = []
        for number, (weight, bias) in enumerate(self._layers):
            shape = len(weight), inputs.shape[1], weight.shape[2]
            before, after = (
                workspace.empty(f"{self._name}{number} {what}", *shape) for what in ("in", "out")
            )
            values.append(np.matmul(inputs, weight, out=before))
            kernels.add_and_silu(before, bias, after)
            inputs = after
        return values

    def backward(self, values: list[Array], grad_outputs: Array) -> Array:
        """Pull derivatives by the outputs back to the inputs."""
        grad = grad_outputs
        for number, weight in reversed(list(enumerate(self._back))):
            if number < len(values) - 1:
                kernels.silu_backward(values[number].reshape(-1), grad.reshape(-1))
            grad = grad @ weight
        return grad


def _copied(values: npt.NDArray[Any]) -> Array:
    """Copy an array to writable float32.

    A model file's arrays are read-only, and Numba would compile its loops for both kinds.
    """
    return np.array(values, dtype=np.float32, order="C")
