"""A trained predictor, and its section of the model file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import numpy.typing as npt
import scipy
from msgspec import Meta

from lcollision_core.devices import has_gpu_kernels
from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.errors import LCollisionError, ModelFileError, ShapeError
from lcollision_core.json_values import from_json, quoted
from lcollision_core.labels.labeller import LabelRows, StoreIdentity
from lcollision_core.meshes.topology import FloatArray, latent_array
from lcollision_core.model_file import Section
from lcollision_core.predictor.compiled_network import CompiledNetwork
from lcollision_core.predictor.config import PRESETS, Architecture, PredictorConfig
from lcollision_core.predictor.metrics import KindScores, PredictorMetrics
from lcollision_core.predictor.stored_network import require_network

if TYPE_CHECKING:
    from lcollision_core.predictor.gpu_graph import ReplayedNetwork
    from lcollision_core.predictor.network_base import PredictorNetwork

BATCH_ROWS = 500
"""Rows predicted at a time: their hidden layers stay in the caches."""

_ROWS_PER_LOOK = 50 * BATCH_ROWS

_LEAST_ENERGY, _LARGEST_FACT = 1e-18, 1e6
"""Limits of stored facts, far beyond trained values and far from overflow."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predictions of B poses; read-only arrays.

    Attributes
    ----------
    domain_energy : (B, K) float64 array, S_k >= 0, in normalised length squared; a predictor
        without domains distributes its sum equally
    energy : (B,) float64 array, S_sum, their sum
    collision_logit : (B,) float64 array
    collision_probability : (B,) float64 array, its sigmoid; above 0.5 the pose is called colliding
    """

    domain_energy: FloatArray
    energy: FloatArray
    collision_logit: FloatArray
    collision_probability: FloatArray


@dataclass(frozen=True)
class TrainingFacts:
    """Facts about the data that a predictor was trained on.

    Attributes
    ----------
    rows : M, number of labelled rows, including held-out ones
    training_rows : number of rows that trained
    colliding_share : share of colliding rows among those of the latent box
    seed : of the initial weights and the order
    energy_scale : mean PDe-sum of the colliding training rows, in normalised length squared;
        energies are divided by it
    margin : alpha of the ranking loss, scaled
    store : identity of the rows' store, None if they came without one
    logit_shift : added to the network's logit, which makes 0 the decision threshold
    """

    rows: Annotated[int, Meta(ge=1)]
    training_rows: Annotated[int, Meta(ge=0)]
    colliding_share: Annotated[float, Meta(ge=0.0, le=1.0)]
    seed: Annotated[int, Meta(ge=0)]
    energy_scale: Annotated[float, Meta(ge=_LEAST_ENERGY, le=_LARGEST_FACT)]
    margin: Annotated[float, Meta(ge=0.0, le=_LARGEST_FACT)]
    store: StoreIdentity | None
    logit_shift: Annotated[float, Meta(ge=-_LARGEST_FACT, le=_LARGEST_FACT)] = 0.0

    def __post_init__(self) -> None:
        if self.training_rows > self.rows:
            raise ValueError("there are more training_rows than rows")


@dataclass(frozen=True)
class PredictorRecord:
    """Metadata of a predictor besides the weights.

    Attributes
    ----------
    config : how it was trained
    facts : about its training data
    metrics : measured on held-out rows, None before
    kinds : scores on poses of several kinds, if measured
    """

    config: PredictorConfig
    facts: TrainingFacts
    metrics: PredictorMetrics | None = None
    kinds: tuple[KindScores, ...] = ()

    @classmethod
    def of_section(cls, section: Section, embedding: Embedding) -> PredictorRecord:
        """Read the record and check the weights, without torch.

        Parameters
        ----------
        section : of the model file
        embedding : of the same file

        Raises
        ------
        ModelFileError : the preset is unknown, a value is missing or wrong, or the weights do not
            fit the embedding.
        """
        metadata = section.metadata
        preset = metadata.get("preset")
        if not isinstance(preset, str) or preset not in PRESETS:
            raise ModelFileError(
                "the model's predictor has an unknown preset",
                "update the program or train the predictor again",
                expected=" or ".join(PRESETS),
                got=quoted(preset),
            )
        try:
            record = from_json(cls, metadata, "predictor")
            if record.config.preset != preset:
                got = quoted(record.config.preset)
                raise ValueError(f"config.preset must be {preset!r}, got {got}")
            require_network(section.arrays, embedding, record.config)
        except (ValueError, LCollisionError) as error:
            what, next_step = "does not fit its latent space", "train the predictor again"
            raise ModelFileError.because("the model's predictor", what, error, next_step) from error
        return record


@dataclass(frozen=True, eq=False)
class CollisionPredictor:
    """Predict energies per domain and collision from latent codes.

    Immutable and safe to share between threads. Made by `train_predictor` or `from_section`. All
    presets but `paper` compute in single precision on the CPU, where they need no torch.

    Attributes
    ----------
    embedding : of the latent codes
    arrays : the network's state dict
    config : how it was trained
    facts : about its training data
    metrics : measured on held-out rows, None before
    kinds : scores on poses of several kinds, if measured
    device : "cpu" or "cuda"
    """

    embedding: Embedding
    arrays: Mapping[str, npt.NDArray[Any]]
    config: PredictorConfig
    facts: TrainingFacts
    metrics: PredictorMetrics | None = None
    kinds: tuple[KindScores, ...] = ()
    device: str = "cpu"

    @property
    def needs_torch(self) -> bool:
        """Whether predictions need torch."""
        return self._compiled is None

    def predict(self, latent: npt.NDArray[Any]) -> Prediction:
        """Predict the collisions of latent poses.

        Parameters
        ----------
        latent : (B, D) finite array, used as float32

        Raises
        ------
        ShapeError : another shape, or a number that is not finite.
        """
        scaled, logit = self.scaled_outputs(latent)
        domain_energy = np.maximum(scaled, 0.0) * self.facts.energy_scale
        n_domains = self.embedding.n_domains
        if domain_energy.shape[1] != n_domains:
            domain_energy = np.repeat(domain_energy / n_domains, n_domains, axis=1)
        results = (domain_energy, domain_energy.sum(axis=1), logit, scipy.special.expit(logit))
        for array in results:
            array.flags.writeable = False
        return Prediction(*results)

    def sure_verdicts(
        self, latent: npt.NDArray[Any], error_bound: float
    ) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """Judge the latent poses of which the predictor is sure.

        Parameters
        ----------
        latent : (B, D) finite array
        error_bound : > 0, share of wrong verdicts among poses of the distribution on which it was
            measured; the next smaller one of `ERROR_BOUNDS` is used

        Returns
        -------
        free, colliding : (B,) bool arrays; both False for a pose that needs the exact check

        Raises
        ------
        ShapeError : another shape, or a number that is not finite.
        """
        logit = self.scaled_outputs(latent)[1]
        measured = () if self.metrics is None else self.metrics.sure
        accepted_ranges = [
            sure_range for sure_range in measured if sure_range.error_bound <= error_bound
        ]
        if not accepted_ranges:
            return np.zeros(len(logit), dtype=np.bool_), np.zeros(len(logit), dtype=np.bool_)
        return logit < accepted_ranges[-1].free_below, logit > accepted_ranges[-1].colliding_above

    def scaled_outputs(self, latent: npt.NDArray[Any]) -> tuple[FloatArray, FloatArray]:
        """Return the network's outputs: scaled energies, maybe below 0, and the shifted logit.

        Parameters
        ----------
        latent : (B, D) finite array, used as float32

        Returns
        -------
        domain_energy : (B, K) float64 array; (B, 1) from a predictor without domains
        collision_logit : (B,) float64 array

        Raises
        ------
        ShapeError : another shape, or a number that is not finite.
        """
        codes = np.ascontiguousarray(self._checked(latent), dtype=np.float32)
        if self._compiled is not None:
            domain_energy, logit = self._compiled.outputs(codes)
        elif runs_as_graph(self.config, self.device):
            domain_energy, logit = self._replayed.outputs(codes)
        else:
            domain_energy, logit = self._torch_outputs(codes)
        return domain_energy, logit + self.facts.logit_shift

    def _torch_outputs(self, codes: npt.NDArray[np.float32]) -> tuple[FloatArray, FloatArray]:
        """Return the network's scaled energies and unshifted logits, by torch."""
        import torch

        with torch.inference_mode():
            parts = [
                self._network(torch.tensor(codes[start : start + BATCH_ROWS], device=self.device))
                for start in range(0, max(len(codes), 1), BATCH_ROWS)
            ]
        energy = np.concatenate([part.domain_energy.double().cpu().numpy() for part in parts])
        return energy, np.concatenate([part.logit.double().cpu().numpy() for part in parts])

    def logit_and_gradient(self, latent: npt.NDArray[Any]) -> tuple[FloatArray, FloatArray]:
        """Return the logit of the collision probability and its derivative.

        Parameters
        ----------
        latent : (B, D) finite array

        Returns
        -------
        collision_logit : (B,) float64 array
        gradient : (B, D) float64 array, of each pose's logit by its codes

        Raises
        ------
        ShapeError : another shape, or a number that is not finite.
        """
        # A writable copy: Numba would compile its loops again for read-only arrays.
        poses = np.array(self._checked(latent), dtype=np.float64)
        if self._compiled is not None:
            logit, gradient = self._compiled.logit_and_gradient(poses)
        else:
            logit, gradient = self._differentiated(poses)
        return logit + self.facts.logit_shift, gradient

    def _differentiated(self, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the network's unshifted logits and their gradients, by torch."""
        import torch

        codes = torch.tensor(poses, device=self.device)
        with torch.enable_grad():
            codes.requires_grad_()
            logit = self._exact_network(codes).logit
            (gradient,) = torch.autograd.grad(logit.sum(), codes)
        return logit.detach().cpu().numpy(), gradient.cpu().numpy()

    def flops(self, n_rows: int) -> int:
        """Count the floating-point operations of the matrix products that predict `n_rows` poses.

        A multiplication and its addition count as two.
        """
        import torch
        from torch.utils.flop_counter import FlopCounterMode

        size = n_rows, self.embedding.latent_size
        # In single precision the default network has compiled loops, which are not counted.
        with torch.no_grad(), FlopCounterMode(display=False) as counter:
            self._exact_network(torch.zeros(size, device=self.device, dtype=torch.float64))
        return int(counter.get_total_flops())

    def to_section(self) -> Section:
        """Return the section of the model file: the weights in float32, and JSON values."""
        record = PredictorRecord(self.config, self.facts, self.metrics, self.kinds)
        return Section(self.arrays, {"preset": self.config.preset, **asdict(record)})

    @classmethod
    def from_section(cls, section: Section, embedding: Embedding) -> CollisionPredictor:
        """Rebuild a predictor from the section of `to_section`.

        Parameters
        ----------
        section : of the model file
        embedding : of the same file

        Raises
        ------
        ModelFileError : the preset is unknown, or the weights do not fit the embedding.
        """
        record = PredictorRecord.of_section(section, embedding)
        return cls(
            embedding,
            dict(section.arrays),
            record.config,
            record.facts,
            record.metrics,
            record.kinds,
        )

    def __getstate__(self) -> dict[str, Any]:
        networks = ("_compiled", "_network", "_exact_network", "_replayed")
        return {name: value for name, value in vars(self).items() if name not in networks}

    @cached_property
    def _compiled(self) -> CompiledNetwork | None:
        """The network for the CPU, without torch; None for the paper's network and on a GPU."""
        if self.device != "cpu":
            return None
        match self.config.architecture:
            case Architecture.GEOMETRIC:
                return CompiledNetwork(self.embedding, self.arrays)
            case Architecture.PAPER:
                return None

    def network(self) -> PredictorNetwork:
        """Return a new torch network in single precision on the CPU, with fixed weights."""
        import torch

        state = {name: torch.tensor(array) for name, array in self.arrays.items()}
        network = network_of(self.config.architecture).restore(self.embedding, self.config, state)
        return network.requires_grad_(False).eval()

    @cached_property
    def _network(self) -> PredictorNetwork:
        return self.network().to(self.device)

    @cached_property
    def _replayed(self) -> ReplayedNetwork:
        from lcollision_core.predictor.gpu_graph import ReplayedNetwork

        return ReplayedNetwork(self._network, BATCH_ROWS)

    @cached_property
    def _exact_network(self) -> PredictorNetwork:
        """The network in double precision, which solvers need close to their solution."""
        from copy import deepcopy

        return deepcopy(self._network).double()

    def _checked(self, latent: npt.NDArray[Any]) -> npt.NDArray[Any]:
        codes = latent_array(latent)
        if codes.ndim != 2 or codes.shape[1] != self.embedding.latent_size:
            raise ShapeError.must_be(
                "latent", f"of shape (B, {self.embedding.latent_size})", codes.shape
            )
        if not np.isfinite(codes).all():
            raise ShapeError("a latent pose contains NaN or infinity")
        return codes


def runs_as_graph(config: PredictorConfig, device: str) -> bool:
    """Whether a network runs as a CUDA graph, with its inputs by our kernels: `gpu_inputs`.

    Otherwise torch computes everything on a GPU, operation by operation.
    """
    is_geometric = config.architecture is Architecture.GEOMETRIC
    return device == "cuda" and is_geometric and has_gpu_kernels()


def network_of(architecture: Architecture) -> type[PredictorNetwork]:
    """Return the class of a network, which needs torch."""
    match architecture:
        case Architecture.GEOMETRIC:
            from lcollision_core.predictor.geometric_network import GeometricNetwork

            return GeometricNetwork
        case Architecture.PAPER:
            from lcollision_core.predictor.paper_network import PaperNetwork

            return PaperNetwork


def require_model(rows: LabelRows, embedding: Embedding) -> None:
    """Check that rows are of the embedding's latent space, and finite.

    Raises
    ------
    ShapeError : another latent space, or a number that is not finite; names the first such row.
    """
    n_domains, latent_size = rows.domain_energy.shape[1], rows.latent.shape[1]
    if (n_domains, latent_size) != (embedding.n_domains, embedding.latent_size):
        raise ShapeError(
            f"the labelled rows have {latent_size} codes and {n_domains} domains, the "
            f"model has {embedding.latent_size} and {embedding.n_domains}",
            "label samples of this model",
        )
    for start in range(0, len(rows), _ROWS_PER_LOOK):
        part = slice(start, start + _ROWS_PER_LOOK)
        finite = np.isfinite(rows.energy[part])
        for values in (rows.latent[part], rows.domain_energy[part]):
            finite &= np.isfinite(values).all(axis=1)
        if not finite.all():
            row = start + int(np.flatnonzero(~finite)[0])
            raise ShapeError(
                f"row {row} (from 0) contains NaN or infinity", "label the samples again"
            )
