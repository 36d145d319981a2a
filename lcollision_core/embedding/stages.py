"""The stages of training an embedding, with torch.

Encoding is z = C tanh(conv(x)); decoding runs the same weights backwards, x̂ = tanh(convᵀ(Cᵀ z)).
With conv(x)_i = x_i W_self + mean(x_j, j in N(i)) W_ring and convᵀ(y)_i = y_i W_selfᵀ +
mean(y_j) W_ringᵀ, the decoder is tanh of one linear map of z, which `decoder_map` returns and the
decoder stores.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy
import torch
from torch.autograd.function import once_differentiable

from lcollision_core.acap.codec import AcapCodec
from lcollision_core.acap.features import N_FEATURES, FeatureScaling
from lcollision_core.embedding.bilevel import Embedding, LatentBox
from lcollision_core.embedding.decoder import (
    AutoencoderWeights,
    Float32Array,
    build_decoder,
    centre_features,
    ring_average,
    ring_mean,
    run_encoders,
)
from lcollision_core.embedding.seeding import (
    attention_mask,
    domain_distances,
    initial_components,
    keep_one_patch,
    moving_domains,
    principal_components,
    radius_of_overlap,
    vertex_areas,
)
from lcollision_core.embedding.training_run import EmbeddingConfig, Run
from lcollision_core.meshes.topology import FloatArray, evenly_spaced


class _RingMean(torch.autograd.Function):
    """Differentiable `ring_mean`; torch's sparse product warns and depends on the thread count."""

    @staticmethod
    def forward(ctx: Any, values: torch.Tensor, ring: scipy.sparse.csr_matrix) -> torch.Tensor:
        ctx.ring = ring
        return torch.from_numpy(ring_mean(values.detach().numpy(), ring))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_mean: torch.Tensor) -> tuple[torch.Tensor, None]:
        return torch.from_numpy(ring_mean(grad_mean.numpy(), ctx.ring.T)), None


def differentiable_ring_mean(values: torch.Tensor, ring: scipy.sparse.csr_matrix) -> torch.Tensor:
    """Average (m, n, 9) values over the one-rings, differentiably; `ring` is (n, n)."""
    mean: torch.Tensor = _RingMean.apply(values, ring)  # type: ignore[no-untyped-call]
    return mean


class TiedAutoencoder(torch.nn.Module):
    """Autoencoder from features on n vertices to m codes, with tied weights.

    Parameters
    ----------
    components : (m, n, 9) array, the fully connected layer C; used at unit norm per code, so that
        the features' norm bounds the codes and scaling does not evade a penalty on C
    ring : (n, n) sparse matrix that averages over one-rings

    Notes
    -----
    The convolution starts as the identity: W_self = I, W_ring = 0. Its two (9, 9) matrices are
    shared over the vertices, as in the paper; there is no bias.
    """

    def __init__(self, components: npt.NDArray[np.floating], ring: scipy.sparse.csr_matrix) -> None:
        super().__init__()
        weights = torch.tensor(components, dtype=torch.get_default_dtype())
        width = weights.shape[2]
        self.components = torch.nn.Parameter(weights)
        self.self_weight = torch.nn.Parameter(torch.eye(width))
        self.ring_weight = torch.nn.Parameter(torch.zeros(width, width))
        self.ring = ring.astype(np.float64 if weights.dtype == torch.float64 else np.float32)

    def unit_components(self) -> torch.Tensor:
        """Return C, (m, n, 9), with each code's weights at norm 1."""
        norms = self.components.flatten(1).norm(dim=1)
        unit: torch.Tensor = self.components / norms[:, None, None]
        return unit

    def encode(self, features: torch.Tensor, ring_features: torch.Tensor) -> torch.Tensor:
        """Return the (B, m) codes of (B, n, 9) features and their means over one-rings."""
        hidden = torch.tanh(features @ self.self_weight + ring_features @ self.ring_weight)
        codes: torch.Tensor = hidden.flatten(1) @ self.unit_components().flatten(1).T
        return codes

    def decoder_map(self) -> torch.Tensor:
        """Return convᵀ(Cᵀ), (m, n, 9): decoding is tanh of the codes times this."""
        components = self.unit_components()
        around = differentiable_ring_mean(components, self.ring)
        return components @ self.self_weight.T + around @ self.ring_weight.T

    def decode(self, codes: torch.Tensor) -> torch.Tensor:
        """Return the (B, n, 9) features of (B, m) codes."""
        weights = self.decoder_map()
        return torch.tanh(codes @ weights.flatten(1)).reshape(len(codes), *weights.shape[1:])

    def forward(self, features: torch.Tensor, ring_features: torch.Tensor) -> torch.Tensor:
        """Encode and decode."""
        return self.decode(self.encode(features, ring_features))


class _Decode(torch.autograd.Function):
    """Differentiable `AcapCodec.decode`, in float64 on the CPU, where the factor is."""

    @staticmethod
    def forward(ctx: Any, features: torch.Tensor, codec: AcapCodec) -> torch.Tensor:
        ctx.codec = codec
        ctx.save_for_backward(features)
        return torch.from_numpy(codec.decode(features.detach().numpy())).to(features)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_vertices: torch.Tensor) -> tuple[torch.Tensor, None]:
        (features,) = ctx.saved_tensors
        grad_features = ctx.codec.decode_vjp(features.detach().numpy(), grad_vertices.numpy())
        return torch.from_numpy(grad_features).to(features), None


def decode_features(features: torch.Tensor, codec: AcapCodec) -> torch.Tensor:
    """Rebuild the (B, V, 3) poses of (B, V, 9) unscaled features, with first derivatives."""
    vertices: torch.Tensor = _Decode.apply(features, codec)  # type: ignore[no-untyped-call]
    return vertices


_LOCALITY_START = 0.25
"""Fraction of the windows' radius from which the locality loss rises."""

_SAMPLED_POSES = 16
_EPOCHS_BETWEEN_SAMPLES = 10


class BilevelTrainer:
    """Learn level 1, then the masks, then level 2 from poses.

    Parameters
    ----------
    codec : of the reference
    vertices : (N, V, 3) float64 array, aligned poses, in normalised lengths
    features : (N, V, 9) float64 array, their unscaled features
    config : how to train
    seed : of the order of level 2's batches
    model : see `TrainingStatus`
    run : yields and stores the steps of the stages
    """

    def __init__(
        self,
        codec: AcapCodec,
        vertices: FloatArray,
        features: FloatArray,
        config: EmbeddingConfig,
        seed: int,
        model: str,
        run: Run,
    ) -> None:
        self._codec, self._config, self._seed = codec, config, seed
        self._model, self._run = model, run
        self._topology, self._rest = codec.topology, codec.rest_vertices
        self._vertices, self._features = vertices, features
        self._scaling = FeatureScaling.fit(features)
        self._mean = self._scaling.apply(features).mean(axis=0).astype(np.float32)
        self._centred = centre_features(features, self._scaling, self._mean)
        self._ring = ring_average(self._topology)
        self._unscaling = build_decoder((), self._scaling, self._mean, self._topology)
        self._sample = evenly_spaced(len(features), _SAMPLED_POSES)

    def train(self) -> Embedding:
        """Run both stages, from the checkpoint if there is one; the codes are the encoders' own.

        Raises
        ------
        CancelledError : the job was cancelled; the checkpoint holds the last epoch.
        """
        level1, output = self._train_level1()
        mask = attention_mask(level1.components, self._topology, self._rest)
        level2 = self._train_level2(mask, output)
        latent = run_encoders(self._centred, level1, level2, mask, self._topology)
        return Embedding(
            topology=self._topology,
            rest_vertices=self._rest,
            alignment_weights=self._codec.anchor_weights,
            scaling=self._scaling,
            mean_features=self._mean,
            level1=level1,
            level2=level2,
            attention_mask=mask,
            training_latent=latent,
            box=LatentBox.around(latent),
            metrics=None,
            config=asdict(self._config),
            seed=self._seed,
            bridges=self._codec.bridges if len(self._codec.bridges) else None,
        )

    def _train_level1(self) -> tuple[AutoencoderWeights, Float32Array]:
        config, topology = self._config, self._topology
        domain_of = moving_domains(self._features, topology, self._rest, config.n_domains)
        areas = vertex_areas(topology, self._rest)
        distances = domain_distances(domain_of, topology, self._rest)
        radius = radius_of_overlap(distances, config.window_overlap)
        start = initial_components(self._centred, distances, areas, radius)
        # Measure from the domain, not from its strongest vertex as in the literature: a torso may
        # be large and a hand small, and a domain cannot drift over the body.
        rise_start = _LOCALITY_START * radius
        rise = (distances - rise_start) / (radius - rise_start)
        locality = torch.from_numpy(np.clip(rise, 0.0, 1.0).astype(np.float32))
        network = TiedAutoencoder(_of_mean_square_1(start), self._ring)
        features = torch.from_numpy(self._centred)
        around = differentiable_ring_mean(features, network.ring)
        n_poses, n_vertices = self._centred.shape[:2]
        self._run.level1_error = self._run.both_error = None
        for number, optimiser in self._epochs(
            "level 1", [network], config.level1_rate, 0.0, config.level1_epochs
        ):
            optimiser.zero_grad()
            rebuilt = network(features, around)
            feature_loss = ((rebuilt - features) ** 2).sum() / (n_poses * n_vertices)
            # The small number keeps the norm's slope finite where a component is 0.
            strength = (network.unit_components().square().sum(dim=2) + 1e-12).sqrt()
            locality_loss = (locality * strength).sum() / n_vertices**0.5
            (feature_loss + config.locality_weight * locality_loss).backward()
            optimiser.step()
            if self._run.level1_error is None or number % _EPOCHS_BETWEEN_SAMPLES == 0:
                self._run.level1_error = self._sampled_error(rebuilt.detach().numpy())
        with torch.no_grad():
            components = network.components.numpy()
            components[:] = keep_one_patch(components, topology, self._rest)
        trained = _weights_of(network, np.arange(n_vertices, dtype=np.int32))
        with torch.no_grad():
            output: Float32Array = network(features, around).numpy()
        self._run.level1_error = self._sampled_error(output)
        return trained, output

    def _train_level2(
        self, mask: Float32Array, level1_output: Float32Array
    ) -> tuple[AutoencoderWeights, ...]:
        config = self._config
        n_poses, n_vertices = self._centred.shape[:2]
        residual = self._centred - level1_output
        networks, inputs, arounds, supports = [], [], [], []
        for share in mask:
            support = np.flatnonzero(share).astype(np.int32)
            masked = residual[:, support] * share[support][:, None]
            leading = principal_components(
                np.tanh(masked.reshape(n_poses, -1)), config.n_domain_codes
            )
            components = leading.reshape(len(leading), -1, N_FEATURES)
            network = TiedAutoencoder(
                _of_mean_square_1(components), self._ring[support][:, support]
            )
            networks.append(network)
            inputs.append(torch.from_numpy(masked))
            arounds.append(differentiable_ring_mean(inputs[-1], network.ring))
            supports.append(support)
        indices = [torch.from_numpy(support.astype(np.int64)) for support in supports]
        base, target_output = torch.from_numpy(level1_output), torch.from_numpy(self._centred)
        offset = torch.from_numpy(self._unscaling.offset.astype(np.float32))
        scale = torch.from_numpy(self._unscaling.scale.astype(np.float32))
        targets = torch.from_numpy(self._vertices.astype(np.float32))

        for number, optimiser in self._epochs(
            "level 2", networks, config.level2_rate, 1.0, config.level2_epochs
        ):
            order = np.random.default_rng([self._seed, number]).permutation(n_poses)
            distance = 0.0
            for start in range(0, n_poses, config.batch_poses):
                batch = torch.from_numpy(order[start : start + config.batch_poses])
                optimiser.zero_grad()
                rebuilt = base[batch]
                for network, values, around, index in zip(
                    networks, inputs, arounds, indices, strict=True
                ):
                    rebuilt = rebuilt.index_add(1, index, network(values[batch], around[batch]))
                feature_loss = ((rebuilt - target_output[batch]) ** 2).sum() / (
                    len(batch) * n_vertices
                )
                decoded = decode_features(offset + scale * rebuilt, self._codec)
                squared = ((decoded - targets[batch]) ** 2).sum(dim=2)
                (feature_loss + config.vertex_weight * squared.mean()).backward()
                optimiser.step()
                distance += float(squared.detach().sqrt().mean(dim=1).sum())
            self._run.both_error = distance / n_poses
        return tuple(
            _weights_of(network, support)
            for network, support in zip(networks, supports, strict=True)
        )

    def _epochs(
        self,
        stage: str,
        networks: list[TiedAutoencoder],
        rate: float,
        decline: float,
        n_epochs: int,
    ) -> Iterator[tuple[int, torch.optim.Optimizer]]:
        """Yield the epochs that the checkpoint lacks, with the networks' optimiser.

        The step sizes fall along a cosine, by the fraction `decline` at the end.
        """
        layers = [network.components for network in networks]
        convolutions = [
            weight for network in networks for weight in (network.self_weight, network.ring_weight)
        ]
        optimiser = torch.optim.Adam(
            [
                {"params": layers, "lr": rate},
                {"params": convolutions, "lr": self._config.convolution_rate},
            ]
        )
        parameters = layers + convolutions
        full_rates = [group["lr"] for group in optimiser.param_groups]

        def save() -> dict[str, npt.NDArray[Any]]:
            states = optimiser.state_dict()["state"]
            return {
                f"{number}_{key}": tensor.numpy().copy()
                for number, parameter in enumerate(parameters)
                for key, tensor in {"value": parameter.detach(), **states[number]}.items()
            }

        def load(arrays: Mapping[str, npt.NDArray[Any]]) -> None:
            for number, parameter in enumerate(parameters):
                tensors = {
                    key: torch.tensor(arrays[f"{number}_{key}"])
                    for key in ("value", "exp_avg", "exp_avg_sq", "step")
                }
                parameter.data.copy_(tensors.pop("value"))
                optimiser.state[parameter] = tensors

        for number in self._run.steps(self._model, stage, n_epochs, load, save):
            fade = 1.0 - decline * 0.5 * (1.0 - np.cos(np.pi * number / n_epochs))
            for group, full_rate in zip(optimiser.param_groups, full_rates, strict=True):
                group["lr"] = full_rate * fade
            yield number, optimiser

    def _sampled_error(self, output: npt.NDArray[np.floating]) -> float:
        """Return the normalised mean vertex error of a sample of poses, rebuilt as `output`."""
        features = self._unscaling.offset + self._unscaling.scale * output[self._sample]
        distance = self._codec.decode(features) - self._vertices[self._sample]
        return float(np.linalg.norm(distance, axis=2).mean())


def _of_mean_square_1(components: npt.NDArray[np.floating]) -> Float32Array:
    """Scale each code's weights to a root mean square of 1, so that one step size fits any mesh."""
    flat = components.reshape(len(components), -1)
    roots = np.sqrt((flat.astype(np.float64) ** 2).mean(axis=1))
    scaled: Float32Array = (components / roots[:, None, None]).astype(np.float32)
    return scaled


def _weights_of(network: TiedAutoencoder, support: npt.NDArray[np.int32]) -> AutoencoderWeights:
    with torch.no_grad():
        return AutoencoderWeights(
            components=network.unit_components().numpy().copy(),
            self_weight=network.self_weight.numpy().copy(),
            ring_weight=network.ring_weight.numpy().copy(),
            support=support,
        )
