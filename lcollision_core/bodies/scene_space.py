"""The product of several bodies' pose spaces, as one pose space."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence, Set
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.bodies.rig_space import ROOT_CODES
from lcollision_core.meshes import RigidTransform, Topology
from lcollision_core.meshes.limbs import Limbs
from lcollision_core.meshes.topology import FloatArray, consecutive, length_graph
from lcollision_core.posing import PoseSpace
from lcollision_core.posing.pose_space import DisplacementMetrics

_Indices = npt.NDArray[np.intp]

_REACH = 1.0
"""Normalised: bound on the bodies' shift, beyond the extent of their scene."""


class StillSpace:
    """The single pose of a static mesh, such as a floor, as a `PoseSpace` without codes.

    Parameters
    ----------
    topology : of the mesh
    vertices : (V, 3) float64 array, normalised
    """

    def __init__(self, topology: Topology, vertices: FloatArray) -> None:
        self.topology, self.rest_vertices = topology, vertices
        self.low = self.high = np.zeros(0)
        self.group_sizes, self.n_shapes, self.n_domains = (0, 0), 0, 1
        self.vertex_domain: _Indices = np.zeros(len(vertices), dtype=np.intp)
        self.metric = self.precision = np.zeros((0, 0))
        self.domain_metrics = DisplacementMetrics(0, [np.zeros(0, np.intp)], [np.zeros((0, 0))])
        self.longest_edges: FloatArray = 1.25 * topology.edge_lengths(vertices)
        none = np.zeros(0, dtype=np.int64)
        leads = np.zeros(len(vertices), dtype=np.int64)
        self.limbs = Limbs(np.array([-1]), np.zeros(1, np.bool_), np.zeros(1), leads, none, True)

    @cached_property
    def surface_graph(self) -> scipy.sparse.csr_matrix:
        """(V, V) lengths of the edges."""
        return length_graph(self.topology.edges, self.rest_vertices)

    def codes_of(self, domains: Iterable[int]) -> npt.NDArray[np.bool_]:  # noqa: ARG002
        """Return an empty mask."""
        return np.zeros(0, dtype=np.bool_)

    def price(self, moved: FloatArray, held: Set[int], whole_body: bool) -> FloatArray:  # noqa: ARG002
        """Return an empty price."""
        return np.zeros((0, 0))

    def shifted(self, codes: FloatArray, way: FloatArray) -> FloatArray:  # noqa: ARG002
        """Return the codes: nothing moves."""
        return codes

    def decode(self, codes: FloatArray) -> FloatArray:
        """Return the vertices, (B, V, 3)."""
        return np.broadcast_to(self.rest_vertices, (len(codes), *self.rest_vertices.shape))

    def gpu_decoder(self, body_size: float) -> None:
        """None: decoded on the CPU only; see `PoseSpace.gpu_decoder`."""

    def decode_some(self, codes: FloatArray, chosen: npt.NDArray[np.integer]) -> FloatArray:
        """Return chosen vertices, (B, n, 3)."""
        return self.decode(codes)[:, chosen]

    def shaped_as(self, codes: FloatArray, vertices: FloatArray) -> StillSpace:  # noqa: ARG002
        """Return another static mesh."""
        return StillSpace(self.topology, vertices)

    def pull_back(self, codes: FloatArray, by_vertices: FloatArray) -> FloatArray:  # noqa: ARG002
        """Return empty derivatives, (n, 0)."""
        return np.zeros((len(by_vertices), 0))

    def mean_slopes(
        self, weights: scipy.sparse.csr_matrix
    ) -> Callable[[FloatArray, FloatArray], FloatArray]:
        """Return a function that gives empty derivatives."""
        n = 3 * weights.shape[0]
        return lambda _, by_vertices: np.zeros((n + len(by_vertices), 0))


@dataclass(frozen=True, eq=False)
class PlacedSpace:
    """The pose space of one body of a scene.

    Attributes
    ----------
    space : of the body
    place : from its normalised coordinates to the scene's
    """

    space: PoseSpace
    place: RigidTransform

    @property
    def has_place(self) -> bool:
        """Whether codes of its own move the whole body, as those of a learned model do not."""
        return self.space.group_sizes[0] == ROOT_CODES and self.space.limbs.is_relative

    @cached_property
    def _turns(self) -> bool:
        return not np.array_equal(self.place.rotation, np.eye(3))

    def placed(self, vertices: FloatArray) -> FloatArray:
        """Return (..., n, 3) vertices of the body, all or some, in scene coordinates."""
        if self._turns:
            return self.place.apply(vertices)
        # Most bodies are only shifted, and a drag places all vertices at each event.
        shifted: FloatArray = self.place.scale * vertices
        shifted += self._shifts[: shifted.shape[-2]]
        return shifted

    @cached_property
    def _shifts(self) -> FloatArray:
        """(V, 3) copies of the translation: NumPy adds a single one five times as slowly."""
        return np.tile(self.place.translation, (self.space.topology.n_vertices, 1))

    def turned_back(self, ways: FloatArray) -> FloatArray:
        """Turn derivatives by (..., 3) scene coordinates into those by the body's own."""
        vectors: FloatArray = self.place.scale * (ways @ self.place.rotation)
        return vectors


class SceneSpace:
    """The poses of several bodies, as a `posing.PoseSpace`; lengths are normalised by the scene's.

    The first group of codes moves each body as a whole, in order. Then come the codes of all body
    parts, by body, and at last those of shapes, by body. Body parts, segments and vertices are in
    the same order.

    Parameters
    ----------
    members : at least one

    Attributes
    ----------
    members : as given
    codes : indices of each member's (D_k,) codes among all
    vertices : slice of each member's vertices
    domains : range of each member's body parts
    """

    def __init__(self, members: Sequence[PlacedSpace]) -> None:
        self.members = tuple(members)
        spaces = [member.space for member in members]
        self.vertices = consecutive(space.topology.n_vertices for space in spaces)
        faces = [
            space.topology.faces + rows.start
            for space, rows in zip(spaces, self.vertices, strict=True)
        ]
        self.topology = Topology(np.concatenate(faces), self.vertices[-1].stop)
        self.rest_vertices: FloatArray = np.concatenate(
            [member.placed(member.space.rest_vertices) for member in members]
        )
        domains = consecutive(space.n_domains for space in spaces)
        self.domains = [range(own.start, own.stop) for own in domains]
        self.n_domains: int = self.domains[-1].stop
        self.vertex_domain: _Indices = np.concatenate(
            [
                space.vertex_domain + own.start
                for space, own in zip(spaces, self.domains, strict=True)
            ]
        )
        firsts = [space.group_sizes[0] for space in spaces]
        others = [size for space in spaces for size in space.group_sizes[1:]]
        self.group_sizes: tuple[int, ...] = (sum(firsts), *others)
        self.codes: list[_Indices] = []
        starts_of = [0, sum(firsts), sum(self.group_sizes)]
        for space, n_first in zip(spaces, firsts, strict=True):
            sizes_of = n_first, sum(space.group_sizes[1:]), space.n_shapes
            code_ranges = [np.arange(n) + at for at, n in zip(starts_of, sizes_of, strict=True)]
            self.codes.append(np.concatenate(code_ranges))
            starts_of = [at + n for at, n in zip(starts_of, sizes_of, strict=True)]
        self.n_shapes = sum(space.n_shapes for space in spaces)
        self.low, self.high = (
            self._joined([getattr(space, end).copy() for space in spaces])
            for end in ("low", "high")
        )
        reach = _REACH + float(np.ptp(self.rest_vertices, axis=0).max())
        for member, places in zip(members, self.codes, strict=True):
            if member.has_place:
                self.high[places[:3]] = reach / member.place.scale
                self.low[places[:3]] = -reach / member.place.scale

    def _joined(self, own: Sequence[FloatArray]) -> FloatArray:
        """Join the members' (..., D_k) codes, or derivatives by them, into (..., D)."""
        rows = own[0].shape[:-1]
        joined = np.zeros((*rows, sum(map(len, self.codes))))
        for places, values in zip(self.codes, own, strict=True):
            joined[..., places] = values
        return joined

    def _matrix(self, own: Sequence[FloatArray]) -> FloatArray:
        size = sum(map(len, self.codes))
        joined: FloatArray = np.zeros((size, size))
        for places, block in zip(self.codes, own, strict=True):
            joined[np.ix_(places, places)] = block
        return joined

    def _each(self) -> zip[tuple[PlacedSpace, _Indices, slice]]:
        return zip(self.members, self.codes, self.vertices, strict=True)

    def with_spaces(self, spaces: Sequence[PoseSpace]) -> SceneSpace:
        """Return the same poses of bodies with other shapes, given by their pose spaces."""
        other = copy(self)
        other.__dict__.pop("longest_edges", None)
        other.members = tuple(
            PlacedSpace(space, member.place)
            for space, member in zip(spaces, self.members, strict=True)
        )
        return other

    def of(self, codes: FloatArray, member: int) -> FloatArray:
        """Return one member's (..., D_k) of (..., D) codes."""
        weights: FloatArray = codes[..., self.codes[member]]
        return weights

    @cached_property
    def attention_mask(self) -> npt.NDArray[np.float32]:
        """(K, V) 1 for the part that leads each vertex, 0 for all others."""
        mask = np.zeros((self.n_domains, self.topology.n_vertices), dtype=np.float32)
        mask[self.vertex_domain, np.arange(self.topology.n_vertices)] = 1.0
        return mask

    @cached_property
    def domain_metrics(self) -> DisplacementMetrics:
        """The members' metrics; each member has equal weight, whatever its vertex count."""
        codes: list[_Indices] = []
        blocks: list[FloatArray] = []
        for member, space, _ in self._each():
            metrics, weight = member.space.domain_metrics, member.place.scale**2
            codes += [space[part] for part in metrics.codes]
            blocks += [weight / len(self.members) * block for block in metrics.blocks]
        return DisplacementMetrics(len(self.low), codes, blocks)

    @property
    def metric(self) -> FloatArray:
        """The sum of `domain_metrics`, slightly regularised on the diagonal."""
        return self.domain_metrics.definite

    @cached_property
    def precision(self) -> FloatArray:
        """(D, D) block-diagonal matrix of the members'."""
        return self._matrix([member.space.precision for member in self.members])

    @cached_property
    def longest_edges(self) -> FloatArray:
        """(E,) the longest length of each edge in plausible poses."""
        longest = np.empty(len(self.topology.edges))
        of_edge = self.topology.edges[:, 0]
        for member, _, rows in self._each():
            member_edges = np.flatnonzero((of_edge >= rows.start) & (of_edge < rows.stop))
            longest[member_edges] = member.place.scale * member.space.longest_edges
        return longest

    @cached_property
    def surface_graph(self) -> scipy.sparse.csr_matrix:
        """(V, V) lengths of the edges in the reference."""
        graphs = [member.place.scale * member.space.surface_graph for member in self.members]
        return scipy.sparse.csr_matrix(scipy.sparse.block_diag(graphs, format="csr"))

    def codes_of(self, domains: Iterable[int]) -> npt.NDArray[np.bool_]:
        """Return a (D,) mask of body parts' codes; all of a body's codes if all parts are given."""
        wanted_domains = set(domains)
        owned = np.zeros(len(self.low), dtype=np.bool_)
        for (member, own, _), parts in zip(self._each(), self.domains, strict=True):
            inside = [part - parts.start for part in parts if part in wanted_domains]
            owned[own] = member.space.codes_of(inside) | (len(inside) == len(parts))
        return owned

    @cached_property
    def limbs(self) -> Limbs:
        """The trees of all members, side by side."""
        trees = [member.space.limbs for member in self.members]
        scales = [member.place.scale for member in self.members]
        starts = np.cumsum([0, *(len(tree.parents) for tree in trees)])[:-1].tolist()
        owner = np.zeros(len(self.low), dtype=np.int64)
        for tree, member_codes, at in zip(trees, self.codes, starts, strict=True):
            owner[member_codes] = np.where(tree.owner >= 0, tree.owner + at, -1)
        return Limbs(
            parents=np.concatenate(
                [
                    np.where(tree.parents >= 0, tree.parents + at, -1)
                    for tree, at in zip(trees, starts, strict=True)
                ]
            ),
            branches=np.concatenate([tree.branches for tree in trees]),
            lengths=np.concatenate(
                [scale * tree.lengths for tree, scale in zip(trees, scales, strict=True)]
            ),
            leads=np.concatenate([tree.leads + at for tree, at in zip(trees, starts, strict=True)]),
            owner=owner,
            is_relative=True,
            bases=frozenset(
                base + at for tree, at in zip(trees, starts, strict=True) for base in tree.bases
            ),
        )

    def price(self, moved: FloatArray, held: Set[int], whole_body: bool) -> FloatArray:
        """Return the block-diagonal matrix of the members' prices; see `PoseSpace.price`."""
        prices, start = [], 0
        for number, member in enumerate(self.members):
            n_segments = len(member.space.limbs.parents)
            fixed_segments = {part - start for part in held if start <= part < start + n_segments}
            prices.append(member.space.price(self.of(moved, number), fixed_segments, whole_body))
            start += n_segments
        return self._matrix(prices)

    def shifted(self, codes: FloatArray, way: FloatArray) -> FloatArray:
        """Move all movable bodies by a (3,) displacement."""
        return self.moved_apart(codes, [way] * len(self.members))

    def moved_apart(self, codes: FloatArray, ways: Sequence[FloatArray]) -> FloatArray:
        """Move each body as a whole by its own (3,) displacement; static ones stay."""
        moved = codes.copy()
        for (member, own, _), way in zip(self._each(), ways, strict=True):
            back = way @ member.place.rotation / member.place.scale
            moved[own] = member.space.shifted(codes[own], back)
        return moved

    def decode(self, codes: FloatArray) -> FloatArray:
        """Turn (B, D) codes into (B, V, 3) vertices, on the calling thread."""
        poses = np.asarray(codes, dtype=np.float64)
        decoded = np.empty((len(poses), self.topology.n_vertices, 3))
        for member, own, rows in self._each():
            decoded[:, rows] = member.placed(member.space.decode(poses[:, own]))
        return decoded

    def gpu_decoder(self, body_size: float) -> None:
        """None: decoded on the CPU only; see `PoseSpace.gpu_decoder`."""

    def decode_some(self, codes: FloatArray, chosen: npt.NDArray[np.integer]) -> FloatArray:
        """Turn (B, D) codes into (B, n, 3) chosen vertices."""
        poses = np.asarray(codes, dtype=np.float64)
        decoded = np.empty((len(poses), len(chosen), 3))
        for member, own, rows in self._each():
            inside = np.flatnonzero((chosen >= rows.start) & (chosen < rows.stop))
            if len(inside):
                some = member.space.decode_some(poses[:, own], chosen[inside] - rows.start)
                decoded[:, inside] = member.placed(some)
        return decoded

    def shaped_as(self, codes: FloatArray, vertices: FloatArray) -> SceneSpace:
        """Return the same poses of bodies shaped so that a pose has given vertices."""
        return self.with_spaces(
            [
                member.space.shaped_as(codes[own], member.place.inverse().apply(vertices[rows]))
                for member, own, rows in self._each()
            ]
        )

    def pull_back(self, codes: FloatArray, by_vertices: FloatArray) -> FloatArray:
        """Turn derivatives by one pose's vertices, (n, V, 3), into those by its codes, (n, D)."""
        joined = []
        for member, own, rows in self._each():
            back = by_vertices[:, rows]
            # Most contacts are within one body.
            by_own = np.zeros((len(back), len(own)))
            if back.any():
                by_own = member.space.pull_back(codes[own], member.turned_back(back))
            joined.append(by_own)
        return self._joined(joined)

    def mean_slopes(
        self, weights: scipy.sparse.csr_matrix
    ) -> Callable[[FloatArray, FloatArray], FloatArray]:
        """Prepare the derivatives of patches' means by the codes; see `PoseSpace.mean_slopes`."""
        n, columns = weights.shape[0], scipy.sparse.csr_matrix(weights).tocsc()
        own_weights = [scipy.sparse.csr_matrix(columns[:, rows]) for rows in self.vertices]
        prepared = [
            member.space.mean_slopes(own) if own.nnz else None
            for member, own in zip(self.members, own_weights, strict=True)
        ]

        def slopes(codes: FloatArray, by_vertices: FloatArray) -> FloatArray:
            joined = []
            for (member, own, rows), of_means in zip(self._each(), prepared, strict=True):
                back = member.turned_back(by_vertices[:, rows])
                if of_means is None:
                    means = np.zeros((3 * n, len(own)))
                    further = member.space.pull_back(codes[own], back)
                else:
                    both = of_means(codes[own], back)
                    turned = member.place.rotation @ both[: 3 * n].reshape(n, 3, -1)
                    means = member.place.scale * turned.reshape(3 * n, -1)
                    further = both[3 * n :]
                joined.append(np.concatenate([means, further]))
            return self._joined(joined)

        return slopes
