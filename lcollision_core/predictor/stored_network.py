"""Check the arrays of a trained network in a model file, without building the network.

Building a network needs geometry of the body's surface, and the paper's needs torch; both wait
until the first prediction. The arrays are checked before that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.features import N_FEATURES
from lcollision_core.embedding import Embedding
from lcollision_core.model_file import required_array
from lcollision_core.predictor.kernels import UNITS

ENCODER_SIZES = (512, 256, 256)
PREDICTOR_SIZES = (512, 256, 256, 128)
CLASSIFIER_SIZE = 64
UNDIVIDED_SIZE = 128
"""Sizes of the paper's layers."""

Arrays = Mapping[str, npt.NDArray[Any]]

_LARGEST_WEIGHT, _LEAST_DEVIATION = 1e4, 1e-6
_LARGEST_OUTPUT = 1e18
"""Largest number that float32 can square."""

_INPUTS_PER_FEATURE = 10.0
"""A network's inputs are at most this many times the largest deformation feature."""


def require_network(arrays: Arrays, embedding: Embedding, preset: str, by_domain: bool) -> None:
    """Check that arrays are the state dict of a preset's network for an embedding.

    Parameters
    ----------
    arrays : of the model file's section
    embedding : of the latent codes
    preset : of `PRESETS`
    by_domain : whether the network has a predictor for each domain

    Raises
    ------
    ValueError : an array is missing or unknown, has another type or shape, or holds numbers that
        would overflow.
    """
    reader = _Reader(arrays)
    if preset == "paper":
        _require_paper(reader, embedding, by_domain)
    elif by_domain:
        _require_default(reader, embedding)
    else:
        raise ValueError("only the preset paper has a network without domains")
    others = arrays.keys() - reader.names
    if others:
        raise ValueError(f"it has an unknown array {min(others)[:60]}")


class _Reader:
    """Read arrays of a section, and record their names."""

    def __init__(self, arrays: Arrays) -> None:
        self._arrays = arrays
        self.names: set[str] = set()

    def array(
        self, name: str, *shape: int | None, dtype: npt.DTypeLike = np.float32
    ) -> npt.NDArray[Any]:
        self.names.add(name)
        largest = _LARGEST_WEIGHT if dtype == np.float32 else np.inf
        return required_array(self._arrays, name, dtype, shape, largest)

    def sites(self) -> npt.NDArray[np.int32]:
        """Read the fold sites, if any."""
        vertices = self._arrays.get("site_vertices", np.empty(()))
        n_sites = 0 if vertices.ndim == 2 and not len(vertices) else None
        return self.array("site_vertices", n_sites, None, dtype=np.int32)

    def layers(
        self, names: Sequence[str], sizes: Sequence[int | None], n: int | None, bound: float
    ) -> float:
        """Read the layers of n stacked networks, or of a single one, in order.

        Parameters
        ----------
        names : of the layers
        sizes : of the inputs and of each layer's outputs, None for any
        n : number of stacked networks; None for a single one
        bound : of the inputs

        Returns
        -------
        bound : of the outputs, from the sums of absolute weights
        """
        stacked, of_bias = ((), ()) if n is None else ((n,), (n, 1))
        width = sizes[0]
        for name, n_out in zip(names, sizes[1:], strict=True):
            weight = self.array(f"{name}.weight", *stacked, width, n_out)
            width = weight.shape[-1]
            bias = self.array(f"{name}.bias", *of_bias, width)
            if weight.size:
                sums = np.abs(weight).sum(axis=-2, dtype=np.float64)
                bound = float(sums.max()) * bound + float(np.abs(bias).max())
            if bound > _LARGEST_OUTPUT:
                raise ValueError(f"its array {name}.weight would make numbers that overflow")
        return bound


def _require_default(reader: _Reader, embedding: Embedding) -> None:
    topology = embedding.topology
    n_points = reader.array("body.points", None, None).shape[1]
    reader.array("body.points", 3 * n_points, n_points)
    reader.array("body.origin", 3, n_points)
    if n_points > topology.n_vertices - len(topology.unused_vertices):
        raise ValueError(f"it has {n_points} points, more than the body's vertices")
    sites = reader.sites()
    if sites.size and not 0 <= sites.min() <= sites.max() < topology.n_vertices:
        raise ValueError("its array site_vertices refers to vertices that the body doesn't have")
    decoder = embedding.scaling
    # Every autoencoder adds at most its scale, as |tanh| does not exceed 1.
    largest = max(
        abs(centre) + 2.0 * (embedding.n_domains + 2) / scale
        for centre, scale in (
            (decoder.rotation_centre, decoder.rotation_scale),
            (decoder.stretch_centre, decoder.stretch_scale),
        )
    )
    bound = 1.0
    for name, n, n_in in (
        ("patch", n_points, UNITS.size),
        ("fold", len(sites), N_FEATURES * sites.shape[1]),
    ):
        mean = reader.array(f"{name}.mean", n, 1, n_in)
        deviation = reader.array(f"{name}.deviation", n, 1, n_in)
        standardised = 0.0
        if n:
            if deviation.min() < _LEAST_DEVIATION:
                raise ValueError(f"its array {name}.deviation must be over {_LEAST_DEVIATION:g}")
            inputs = _INPUTS_PER_FEATURE * largest + float(np.abs(mean).max())
            standardised = inputs / float(deviation.min())
        names = [f"{name}.layers.{number}" for number in range(3)]
        bound = max(bound, reader.layers(names, (n_in, None, None, 2), n, standardised))
    sizes = (2 * (n_points + len(sites)), None, None, embedding.n_domains + 2)
    reader.layers([f"head.{number}" for number in range(3)], sizes, None, bound)
    reader.array("any_hit", 2)


def _require_paper(reader: _Reader, embedding: Embedding, by_domain: bool) -> None:
    groups, state = embedding.group_sizes, ENCODER_SIZES[-1]
    codes = float(max(-embedding.box.low.min(), embedding.box.high.max()))
    names = [f"encoder.{2 * number}" for number in range(len(ENCODER_SIZES))]
    bound = reader.layers(names, (sum(groups), *ENCODER_SIZES), None, codes)
    if by_domain:
        n_outputs = embedding.n_domains
        wide = (state + max(groups[1:]), *PREDICTOR_SIZES, 1)
        names = [f"predictors.{number}" for number in range(len(PREDICTOR_SIZES) + 1)]
        bound = reader.layers(names, wide, n_outputs, max(bound, codes))
    else:
        n_outputs = 1
        names = ["undivided.0", "undivided.2"]
        bound = reader.layers(names, (state, UNDIVIDED_SIZE, 1), None, bound)
    names = ["classifier.0", "classifier.2"]
    reader.layers(names, (n_outputs, CLASSIFIER_SIZE, 1), None, bound)
