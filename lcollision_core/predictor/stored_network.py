"""Check the arrays of a trained network in a model file, without building the network.

Building a network needs geometry of the body's surface, and the paper's needs torch; both wait
until the first prediction. The arrays are checked before that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, assert_never

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.features import N_FEATURES
from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.model_file import required_array
from lcollision_core.predictor.config import Architecture, PredictorConfig
from lcollision_core.predictor.kernels import UNITS

ENCODER_SIZES = (512, 256, 256)
PREDICTOR_SIZES = (512, 256, 256, 128)
CLASSIFIER_SIZE = 64
UNDIVIDED_SIZE = 128
"""Sizes of the paper's layers."""

Arrays = Mapping[str, npt.NDArray[Any]]

_LARGEST_WEIGHT, _LEAST_DEVIATION = 1e4, 1e-6


def require_network(arrays: Arrays, embedding: Embedding, config: PredictorConfig) -> None:
    """Check that arrays are the state dict of a network for an embedding.

    Parameters
    ----------
    arrays : of the model file's section
    embedding : of the latent codes
    config : of the network

    Raises
    ------
    ValueError : an array is missing or unknown, has another type or shape, or holds numbers far
        beyond trained ones.
    """
    reader = _Reader(arrays)
    match config.architecture:
        case Architecture.PAPER:
            _require_paper(reader, embedding, config.by_domain)
        case Architecture.GEOMETRIC:
            if not config.by_domain:
                raise ValueError("only the preset paper has a network without domains")
            _require_geometric(reader, embedding)
        case unknown:
            assert_never(unknown)
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

    def layers(self, names: Sequence[str], sizes: Sequence[int | None], n: int | None) -> None:
        """Read the layers of n stacked networks, or of a single one, in order.

        Parameters
        ----------
        names : of the layers
        sizes : of the inputs and of each layer's outputs, None for any
        n : number of stacked networks; None for a single one
        """
        stacked, of_bias = ((), ()) if n is None else ((n,), (n, 1))
        width = sizes[0]
        for name, n_out in zip(names, sizes[1:], strict=True):
            width = self.array(f"{name}.weight", *stacked, width, n_out).shape[-1]
            self.array(f"{name}.bias", *of_bias, width)


def _require_geometric(reader: _Reader, embedding: Embedding) -> None:
    topology = embedding.topology
    n_points = reader.array("body.points", None, None).shape[1]
    reader.array("body.points", 3 * n_points, n_points)
    reader.array("body.origin", 3, n_points)
    if n_points > topology.n_vertices - len(topology.unused_vertices):
        raise ValueError(f"it has {n_points} points, more than the body's vertices")
    sites = reader.sites()
    if sites.size and not 0 <= sites.min() <= sites.max() < topology.n_vertices:
        raise ValueError("its array site_vertices refers to vertices that the body doesn't have")
    for name, n, n_in in (
        ("patch", n_points, UNITS.size),
        ("fold", len(sites), N_FEATURES * sites.shape[1]),
    ):
        reader.array(f"{name}.mean", n, 1, n_in)
        deviation = reader.array(f"{name}.deviation", n, 1, n_in)
        if n and deviation.min() < _LEAST_DEVIATION:
            raise ValueError(f"its array {name}.deviation must be over {_LEAST_DEVIATION:g}")
        names = [f"{name}.layers.{number}" for number in range(3)]
        reader.layers(names, (n_in, None, None, 2), n)
    sizes = (2 * (n_points + len(sites)), None, None, embedding.n_domains + 2)
    reader.layers([f"head.{number}" for number in range(3)], sizes, None)
    reader.array("any_hit", 2)


def _require_paper(reader: _Reader, embedding: Embedding, by_domain: bool) -> None:
    groups, state = embedding.group_sizes, ENCODER_SIZES[-1]
    names = [f"encoder.{2 * number}" for number in range(len(ENCODER_SIZES))]
    reader.layers(names, (sum(groups), *ENCODER_SIZES), None)
    n_outputs = embedding.n_domains if by_domain else 1
    if by_domain:
        wide = (state + max(groups[1:]), *PREDICTOR_SIZES, 1)
        names = [f"predictors.{number}" for number in range(len(PREDICTOR_SIZES) + 1)]
        reader.layers(names, wide, n_outputs)
    else:
        reader.layers(["undivided.0", "undivided.2"], (state, UNDIVIDED_SIZE, 1), None)
    reader.layers(["classifier.0", "classifier.2"], (n_outputs, CLASSIFIER_SIZE, 1), None)
