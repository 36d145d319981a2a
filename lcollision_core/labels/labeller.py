"""Label latent codes by the exact check, and identify the labelled data."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled, compiled_part
from lcollision_core.devices import uses_gpu
from lcollision_core.embedding.bilevel import (
    ROWS_PER_BLOCK,
    Embedding,
    LatentBox,
    numbers_of,
)
from lcollision_core.meshes import STRICT, ContactRules, FaceGroup
from lcollision_core.meshes.face_groups import ignored_faces_digest
from lcollision_core.options import SampleDistribution

if TYPE_CHECKING:
    from lcollision_core.contact import CollisionDetector
    from lcollision_core.labels.gpu_labeller import GpuLabeller

BOX_ROWS = 16
"""Number of rows of a mixed block, the first ones, that are samples of the box."""


def measures(
    index: npt.ArrayLike, draws: SampleDistribution = SampleDistribution.BOX
) -> npt.NDArray[np.bool_]:
    """Return which samples measure a predictor: the held-out samples of the box.

    Parameters
    ----------
    index : (B,) integer array, the samples' indices in the store
    draws : how they are drawn
    """
    return is_held_out(index) & is_of_box(index, draws)


def is_of_box(index: npt.ArrayLike, draws: SampleDistribution) -> npt.NDArray[np.bool_]:
    """Return which samples, by (B,) indices in a store, are uniform samples of the latent box."""
    of_box: npt.NDArray[np.bool_] = np.asarray(index) % ROWS_PER_BLOCK < BOX_ROWS
    return of_box if draws is SampleDistribution.MIXED else np.ones_like(of_box)


def is_held_out(index: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Return which samples only test a predictor: those whose index ends in 7, 8 or 9.

    The 30 % are fixed, so that a row stays held out when its store grows. Samples are independent,
    so any fixed choice is as random as another.

    Parameters
    ----------
    index : (B,) integer array, the samples' indices in the store
    """
    held_out: npt.NDArray[np.bool_] = np.asarray(index) % 10 >= 7
    return held_out


_NOISY_BLENDS, _MIXED_PARTS = 4, 4
_BISECTIONS, _KEPT_BISECTIONS, _SEGMENTS = 7, 4, 2
"""Bisections of each segment between a free and a colliding row, those kept, and the number of
segments; the kept ones fill up a block."""

MIXED_COST = 1.0 + _SEGMENTS * (_BISECTIONS - _KEPT_BISECTIONS) / ROWS_PER_BLOCK
"""Poses that are decoded and checked per mixed sample."""


def blocks_of(rows: range, size: int = ROWS_PER_BLOCK) -> Iterator[range]:
    """Split rows that start at a multiple of `ROWS_PER_BLOCK` into blocks, one per task."""
    for first in range(rows.start, rows.stop, size):
        yield range(first, min(first + size, rows.stop))


@dataclass(frozen=True, eq=False)
class LabelRows:
    """B labelled samples.

    Attributes
    ----------
    latent : (B, D) float32 array, Z_all
    domain_energy : (B, K) float64 array, S_k, sums to `energy`, in normalised length squared
    energy : (B,) float64 array, PDe-sum, in normalised length squared
    n_pairs : (B,) int32 array, number of colliding pairs of faces
    """

    latent: npt.NDArray[np.float32]
    domain_energy: npt.NDArray[np.float64]
    energy: npt.NDArray[np.float64]
    n_pairs: npt.NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.latent)

    @property
    def colliding(self) -> npt.NDArray[np.bool_]:
        """(B,) whether each pose intersects itself."""
        return self.n_pairs > 0

    def taken(self, index: npt.NDArray[Any] | slice) -> LabelRows:
        """Return the rows of an index, a boolean array or, as views, of a slice."""
        return LabelRows(*(getattr(self, field.name)[index] for field in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[LabelRows]) -> LabelRows:
        """Concatenate rows with a single copy."""
        return cls(
            *(
                np.concatenate([getattr(part, field.name) for part in parts])
                for field in fields(cls)
            )
        )


_Asking = Generator[npt.NDArray[np.float32], LabelRows, LabelRows]
"""A generator that yields codes, is sent their labels, and finally returns rows."""


@dataclass(frozen=True, eq=False)
class Labeller:
    """Decode latent poses and find their exact labels; may be shared between threads.

    Vertices are tested as `LearnedBody` exports them: in the data's unit, rounded to float32. So a
    label agrees with every other exact check of the same pose.

    Attributes
    ----------
    embedding : decodes the poses
    body_size : in the data's unit
    rules : which pairs of faces do not count
    groups : groups of faces that the rules may name
    fingerprint : identifies the model
    draws : how samples are drawn
    """

    embedding: Embedding
    body_size: float
    rules: ContactRules
    groups: tuple[FaceGroup, ...]
    fingerprint: str
    draws: SampleDistribution = SampleDistribution.BOX

    @cached_property
    def detector(self) -> CollisionDetector:
        """The exact check, in the data's unit."""
        from lcollision_core.contact import CollisionDetector

        return CollisionDetector(
            self.embedding.topology,
            self.embedding.rest_vertices * self.body_size,
            self.rules,
            self.groups,
        )

    @cached_property
    def _shares(self) -> npt.NDArray[np.float64]:
        return self.embedding.attention_mask.astype(np.float64)

    @cached_property
    def _on_gpu(self) -> GpuLabeller:
        from lcollision_core.labels.gpu_labeller import GpuLabeller

        return GpuLabeller(self.embedding, self.body_size, self.detector, self._shares)

    def prepare(self) -> None:
        """Build the lazy parts once, before threads use them."""
        _ = self.detector, self._shares, self.embedding.codec, self.embedding.decoder

    def label_rows(self, seed: int, rows: range) -> LabelRows:
        """Draw samples and label them, on the calling thread.

        Parameters
        ----------
        seed : of the samples
        rows : their indices, at least one, starting at a multiple of `ROWS_PER_BLOCK`
        """
        done, waiting = {}, {block: self._label_block(seed, block) for block in blocks_of(rows)}
        labels_of_block = {block: next(labelled) for block, labelled in waiting.items()}
        # Label the requests of all blocks together: a GPU labels many poses in the time of a few.
        while labels_of_block:
            labels = self.label(np.concatenate(list(labels_of_block.values())))
            stops = np.cumsum([len(codes) for codes in labels_of_block.values()])
            for block, stop in zip(list(labels_of_block), stops.tolist(), strict=True):
                block_labels = labels.taken(slice(stop - len(labels_of_block[block]), stop))
                try:
                    labels_of_block[block] = waiting[block].send(block_labels)
                except StopIteration as end:
                    done[block] = end.value
                    del labels_of_block[block]
        return LabelRows.joined([done[block] for block in waiting])

    def _label_block(self, seed: int, rows: range) -> _Asking:
        """Draw a block and yield codes to label: samples of the box or, if mixed, half of these.

        A quarter of a mixed block consists of blends with noise and mixed parts, and a quarter lies
        near the border of the free set: bisections of segments from a free to a colliding row.
        """
        number = rows.start // ROWS_PER_BLOCK
        box = self.embedding.box.draw(seed, number)
        if self.draws is SampleDistribution.BOX:
            return (yield box[: len(rows)])
        numbers, draws = numbers_of(seed, number, 1), self.embedding.draws
        drawn = yield np.concatenate(
            [
                box[:BOX_ROWS],
                draws.noisy_blends(_NOISY_BLENDS, numbers),
                draws.mixed_parts(_MIXED_PARTS, numbers),
            ]
        )
        # Held-out samples of the box measure: keep training rows off segments that end there.
        ends = drawn.taken(~measures(np.arange(rows.start, rows.start + len(drawn)), self.draws))
        near = yield from self._near_border(ends, box[len(drawn) :])
        return LabelRows.joined([drawn, near]).taken(slice(len(rows)))

    def _near_border(self, ends: LabelRows, others: npt.NDArray[np.float32]) -> _Asking:
        """Bisect segments between free and colliding rows; without either, label the others."""
        free, colliding = ends.latent[~ends.colliding], ends.latent[ends.colliding]
        if not len(free) or not len(colliding):
            return (yield others)
        bad = colliding[np.arange(_SEGMENTS) % len(colliding)]
        away = np.linalg.norm((free[None] - bad[:, None]) / self.embedding.latent_deviation, axis=2)
        good = free[away.argmin(axis=1)]
        border_codes = []
        for _ in range(_BISECTIONS):
            middle = yield 0.5 * (good + bad)
            good = np.where(middle.colliding[:, None], good, middle.latent)
            bad = np.where(middle.colliding[:, None], middle.latent, bad)
            border_codes.append(middle)
        return LabelRows.joined(border_codes[-_KEPT_BISECTIONS:])

    def label(self, latent: npt.NDArray[Any]) -> LabelRows:
        """Label latent poses exactly, on the calling thread.

        Parameters
        ----------
        latent : (B, D) array, used as float32

        Returns
        -------
        rows : LabelRows; the batch does not change the bits of a pose, but a GPU may: its energies
            agree with the CPU's up to rounding

        Raises
        ------
        ShapeError : another shape, or a pose that does not decode to finite vertices.
        """
        codes = np.ascontiguousarray(latent, dtype=np.float32)
        if not uses_gpu(len(codes), self.embedding.topology.n_faces):
            return self._label_here(codes)
        n_pairs, energy, left = self._on_gpu.label(codes)
        rows = LabelRows(codes, energy[:, :-1].copy(), energy[:, -1].copy(), n_pairs)
        if left:
            here = self._label_here(codes[left])
            for field in fields(rows):
                getattr(rows, field.name)[left] = getattr(here, field.name)
        return rows

    def _label_here(self, codes: npt.NDArray[np.float32]) -> LabelRows:
        vertices = self.embedding.decode(codes, n_threads=1)
        vertices *= self.body_size
        collisions = self.detector.detect_batch(
            vertices.astype(np.float32), workers=1, counted_only=True
        )
        domain_energy = np.zeros((len(codes), self.embedding.n_domains))
        energy = np.zeros(len(codes))
        _sum_energies(collisions.vertex_energy, self._shares, domain_energy, energy)
        return LabelRows(
            latent=codes,
            domain_energy=domain_energy,
            energy=energy,
            n_pairs=collisions.n_pairs.astype(np.int32),
        )

    def __getstate__(self) -> dict[str, Any]:
        # The detector holds work arrays of threads and is not pickled; the embedding is pickled
        # with its factored matrix, as another machine might factor it to other bits.
        self.prepare()
        return {field.name: getattr(self, field.name) for field in fields(self)}


@compiled_part
def _pairwise_sum(terms: npt.NDArray[np.float64]) -> float:
    """Sum numbers with the same bits as NumPy: in eight lanes, long arrays by halves."""
    n = len(terms)
    if n < 8:
        total = 0.0
        for term in terms:
            total += term
        return total
    if n > 128:
        half = n // 2 - n // 2 % 8
        return _pairwise_sum(terms[:half]) + _pairwise_sum(terms[half:])
    lanes = terms[:8].copy()
    for first in range(8, n - n % 8, 8):
        for lane in range(8):
            lanes[lane] += terms[first + lane]
    total = ((lanes[0] + lanes[1]) + (lanes[2] + lanes[3])) + (
        (lanes[4] + lanes[5]) + (lanes[6] + lanes[7])
    )
    for term in terms[n - n % 8 :]:
        total += term
    return float(total)


@compiled
def _sum_energies(
    vertex_energy: npt.NDArray[np.float64],
    shares: npt.NDArray[np.float64],
    domain_energy: npt.NDArray[np.float64],
    energy: npt.NDArray[np.float64],
) -> None:
    """Fill in (B, K) energies of domains and (B,) energies of poses.

    A matrix product would not do: BLAS sums in an order that depends on the CPU, its threads and
    the batch, but rows must be the same on every machine.

    Parameters
    ----------
    vertex_energy : (B, V)
    shares : (K, V) share of each domain in the vertices
    """
    touched = np.empty(vertex_energy.shape[1], dtype=np.int64)
    terms = np.empty(vertex_energy.shape[1])
    for row in range(len(vertex_energy)):
        n = 0
        for vertex in range(vertex_energy.shape[1]):
            if vertex_energy[row, vertex] != 0.0:
                touched[n], terms[n] = vertex, vertex_energy[row, vertex]
                n += 1
        energy[row] = _pairwise_sum(terms[:n])
        for domain in range(len(shares)):
            for k in range(n):
                terms[k] = shares[domain, touched[k]] * vertex_energy[row, touched[k]]
            domain_energy[row, domain] = _pairwise_sum(terms[:n])


@dataclass(frozen=True)
class StoreIdentity:
    """The identity of a store's labels; stores with equal identities have interchangeable rows.

    Attributes
    ----------
    model : fingerprint of the model
    seed : of the samples
    n_domains : K
    height : the body size, in the data's unit, in which vertices are rounded to float32
    near_exclusion : normalised
    box_low, box_high : D numbers each
    rules : which pairs of faces do not count; older stores have the near exclusion only
    ignored_faces : digest of the groups in ignored pairs, empty if there are none
    draws : how samples are drawn; older stores have samples of the box

    Raises
    ------
    ValueError : there is no box or no domain.
    """

    model: str
    seed: int
    n_domains: int
    height: float
    near_exclusion: float
    box_low: tuple[float, ...]
    box_high: tuple[float, ...]
    rules: ContactRules = STRICT
    ignored_faces: str = ""
    draws: SampleDistribution = SampleDistribution.BOX

    def __post_init__(self) -> None:
        rules = replace(self.rules, near_exclusion=self.near_exclusion)
        object.__setattr__(self, "rules", rules)
        if not 0 < len(self.box_low) == len(self.box_high) or self.n_domains < 1:
            raise ValueError("there is no latent box, or no domain")

    @classmethod
    def of(cls, labeller: Labeller, seed: int) -> StoreIdentity:
        """Return the identity of the samples of a model drawn with a seed."""
        return cls(
            model=labeller.fingerprint,
            seed=seed,
            n_domains=labeller.embedding.n_domains,
            height=labeller.body_size,
            near_exclusion=labeller.rules.near_exclusion,
            box_low=tuple(labeller.embedding.box.low.tolist()),
            box_high=tuple(labeller.embedding.box.high.tolist()),
            rules=labeller.rules,
            ignored_faces=ignored_faces_digest(labeller.rules, labeller.groups),
            draws=labeller.draws,
        )

    @property
    def box(self) -> LatentBox:
        """The latent box."""
        return LatentBox(np.array(self.box_low), np.array(self.box_high))
