"""The default network for a few poses at a time, with their gradients, without torch.

For one pose `GeometricNetwork` spends most of its time on passing from one operation of torch to
the next, and a program that only drags sliders would spend seconds on importing it. Here the same
compiled loops are called one after the other, and back again for the gradients.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.features import N_FEATURES
from lcollision_core.compiled import compiled, compiled_sums
from lcollision_core.embedding import Embedding
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.predictor import field_kernels as kernels
from lcollision_core.predictor.field_kernels import FULL, REACHES, SOME, SUMS_A_REACH
from lcollision_core.predictor.skin_geometry import SkinGeometry

State = Mapping[str, npt.NDArray[Any]]
_Product = Callable[[FloatArray, npt.NDArray[np.float32], FloatArray], None]
Float32Array = npt.NDArray[np.float32]


class FewPosesNetwork:
    """A trained default network that computes in double precision.

    Immutable, and safe to share between threads.

    Parameters
    ----------
    embedding : of the body
    state : the state dict of a `GeometricNetwork`, as arrays

    Raises
    ------
    KeyError, ValueError : the state does not fit the embedding.
    """

    def __init__(self, embedding: Embedding, state: State) -> None:
        sites = state["site_vertices"].astype(np.int64)
        _, n_points = state["body.points"].shape
        self._skin = skin = SkinGeometry.of(embedding, sites, n_points)
        n_points, n_sites = skin.n_points, len(sites)
        self._points = _shaped(state["body.points"], (3 * n_points, n_points), np.float32)
        self._origin = _shaped(state["body.origin"], (3, n_points))
        self._reach = np.array(REACHES)
        # Loops over numbers of two sizes are slow.
        self._apart = skin.apart.astype(np.float64)
        n_members = sites.shape[1]
        self._patch = _Perceptrons(state, "patch", n_points, SUMS_A_REACH * len(REACHES), 2)
        self._fold = _Perceptrons(state, "fold", n_sites, 9 * n_members, 2)
        sizes = 2 * (n_points + n_sites), embedding.n_domains + 2
        head = list(_read_layers(state, "head", (), *sizes))
        self._head = _Network(head, _add_product, _add_product_backward)
        self._any_hit = _shaped(state["any_hit"], (2,))

    def outputs(self, latent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (B, K) scaled energies of the domains, and (B,) logits, of (B, D) poses."""
        trace = self._forward(latent)
        root = np.maximum(trace.head.outputs[:, 1:-1], 0.0)
        return np.square(root), trace.logit

    def logit_and_gradient(self, latent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (B,) logits of (B, D) poses, and each one's (B, D) derivative by its codes."""
        trace = self._forward(latent)
        return trace.logit, self._backward(trace)

    def _forward(self, latent: FloatArray) -> _Trace:
        skin, n_rows = self._skin, len(latent)
        products = np.empty((n_rows, N_FEATURES * len(skin.target)))
        kernels.products(latent, skin.tables, skin.blocks, products)
        outputs = np.tanh(products, out=products).reshape(n_rows, len(skin.target), N_FEATURES)
        features = np.empty((n_rows, *skin.offset.shape))
        kernels.add_features(outputs, skin.target, skin.offset, skin.scale, features)
        n_skin = len(skin.offset)
        frame = np.empty((n_rows, len(skin.rest_frame), 3, 3))
        rows = np.empty((n_rows, 3, n_skin, 3))
        kernels.deform(features, skin.rest_frame, frame, rows)
        places = np.empty((n_rows, *self._origin.shape))
        _place(rows.reshape(n_rows, 3, 3 * n_skin), self._points, self._origin, places)
        sums = np.empty((skin.n_points, n_rows, len(self._reach), SUMS_A_REACH))
        kernels.contact_field(frame, places, self._apart, self._reach, sums)
        field = np.empty_like(sums)
        kernels.normalised(sums, self._reach, FULL, SOME, field)
        patch = self._patch.forward(field.reshape(skin.n_points, n_rows, self._patch.n_in))
        view = np.empty((len(skin.members), n_rows, self._fold.n_in))
        kernels.fold_view(frame, rows, skin.members, view)
        fold = self._fold.forward(view)
        hits = np.concatenate([patch.outputs, fold.outputs], axis=2)
        hit_logit = hits[:, 0]
        squashed = np.tanh(hit_logit / 4.0)
        head = self._head.forward(np.concatenate([squashed, hits[:, 1]], axis=1))
        # The logarithm of the summed exponentials, and its derivative, the softmax.
        largest = hit_logit.max(axis=1, keepdims=True)
        share = np.exp(hit_logit - largest)
        total = share.sum(axis=1, keepdims=True)
        any_logit = (largest + np.log(total))[:, 0] * self._any_hit[0] + self._any_hit[1]
        logit = head.outputs[:, 0] + any_logit
        share /= total
        return _Trace(
            outputs, features, frame, rows, places, sums, patch, fold, squashed, share, head, logit
        )

    def _backward(self, trace: _Trace) -> FloatArray:
        skin, n_rows = self._skin, len(trace.logit)
        by_head = np.zeros_like(trace.head.outputs)
        by_head[:, 0] = 1.0
        by_shape = 2, skin.n_points + len(skin.members)
        by_hits = self._head.backward(trace.head, by_head).reshape(n_rows, *by_shape)
        by_hits[:, 0] *= (1.0 - np.square(trace.squashed)) / 4.0
        by_hits[:, 0] += self._any_hit[0] * trace.share
        by_field = self._patch.backward(trace.patch, by_hits[..., : skin.n_points])
        by_view = self._fold.backward(trace.fold, by_hits[..., skin.n_points :])
        by_sums, by_frame, by_rows, by_places, by_features, by_outputs = map(
            np.zeros_like,
            (trace.sums, trace.frame, trace.rows, trace.places, trace.features, trace.outputs),
        )
        by_field = by_field.reshape(trace.sums.shape)
        kernels.normalised_backward(trace.sums, self._reach, by_field, FULL, SOME, by_sums)
        given = trace.frame, trace.places, self._apart, self._reach, by_sums
        kernels.contact_field_backward(*given, by_frame, by_places)
        kernels.fold_view_backward(
            trace.frame, trace.rows, skin.members, by_view, by_frame, by_rows
        )
        _place_backward(by_places, self._points, by_rows.reshape(n_rows, 3, 3 * len(skin.offset)))
        kernels.deform_backward(trace.features, skin.rest_frame, by_frame, by_rows, by_features)
        given_outputs = trace.outputs, skin.target, skin.scale
        kernels.add_features_backward(*given_outputs, by_features, by_outputs)
        by_latent = np.empty((n_rows, int(skin.blocks[-1, 1])))
        by_products = by_outputs.reshape(n_rows, N_FEATURES * len(skin.target))
        kernels.products_backward(by_products, skin.tables, skin.blocks, by_latent)
        return by_latent


@dataclass(frozen=True, eq=False)
class _Layers:
    """What networks made of their inputs.

    Attributes
    ----------
    before : (B, width, n) of each hidden layer, before the silu; of the head (B, width)
    outputs : (B, n_out, n); of the head (B, n_out)
    """

    before: list[FloatArray]
    outputs: FloatArray


@dataclass(frozen=True, eq=False)
class _Trace:
    """All of a forward pass that the way back needs, see `GeometricNetwork`."""

    outputs: FloatArray
    features: FloatArray
    frame: FloatArray
    rows: FloatArray
    places: FloatArray
    sums: FloatArray
    patch: _Layers
    fold: _Layers
    squashed: FloatArray
    share: FloatArray
    head: _Layers
    logit: FloatArray


class _Network:
    """Layers with silu between them.

    The weights stay in single precision: reading them takes the time.

    Parameters
    ----------
    layers : float32 weights and float64 biases, as `add` and `add_backward` want them
    add : adds inputs times weights to outputs
    add_backward : adds what it pulls back from the outputs to the derivatives by the inputs
    """

    def __init__(
        self, layers: list[tuple[Float32Array, FloatArray]], add: _Product, add_backward: _Product
    ) -> None:
        self._layers, self._add, self._add_backward = layers, add, add_backward

    def forward(self, values: FloatArray) -> _Layers:
        """Apply all layers to B poses' inputs."""
        before = []
        for number, (weight, bias) in enumerate(self._layers):
            if number:
                before.append(values)
                values = _silu(values)
            outputs = np.repeat(bias[None], len(values), axis=0)
            self._add(values, weight, outputs)
            values = outputs
        return _Layers(before, values)

    def backward(self, layers: _Layers, by_outputs: FloatArray) -> FloatArray:
        """Pull derivatives by the outputs back to the inputs."""
        by = by_outputs
        for number, (weight, _) in reversed(list(enumerate(self._layers))):
            by_inputs = np.zeros((len(by), weight.shape[0], *weight.shape[2:]))
            self._add_backward(by, weight, by_inputs)
            by = by_inputs
            if number:
                by *= _silu_slope(layers.before[number - 1])
        return by


class _Perceptrons:
    """n networks of one size, each with inputs of its own.

    Numbers of all networks lie side by side, as they are computed: (B, n_in, n) to (B, n_out, n).
    """

    def __init__(self, state: State, name: str, n: int, n_in: int, n_out: int) -> None:
        self.n_in = n_in
        layers = [
            (_side_by_side(weight), _side_by_side(bias)[0])
            for weight, bias in _read_layers(state, f"{name}.layers", (n,), n_in, n_out)
        ]
        self._network = _Network(layers, _add_products, _add_products_backward)
        self._mean, deviation = (
            _side_by_side(_shaped(state[f"{name}.{kind}"], (n, 1, n_in)))[0]
            for kind in ("mean", "deviation")
        )
        self._inverse = 1.0 / deviation

    def forward(self, inputs: FloatArray) -> _Layers:
        """Scale (n, B, n_in) inputs and apply to each its network."""
        return self._network.forward((inputs.transpose(1, 2, 0) - self._mean) * self._inverse)

    def backward(self, layers: _Layers, by_outputs: FloatArray) -> FloatArray:
        """Pull derivatives by the (B, n_out, n) outputs back to the (n, B, n_in) inputs."""
        by = self._network.backward(layers, by_outputs) * self._inverse
        return np.ascontiguousarray(by.transpose(2, 0, 1))


def _read_layers(
    state: State, name: str, stacked: tuple[int, ...], n_in: int, n_out: int
) -> Iterator[tuple[Float32Array, FloatArray]]:
    """Yield each layer's weight and bias, (n_in, n_out) and (n_out,) or so many of them stacked."""
    extra = (1,) if stacked else ()
    n_layers = sum(key.startswith(name) for key in state) // 2
    for number in range(n_layers):
        weight, bias = (state[f"{name}.{number}.{kind}"] for kind in ("weight", "bias"))
        width = n_out if number == n_layers - 1 else weight.shape[-1]
        yield (
            _shaped(weight, (*stacked, n_in, width), np.float32),
            _shaped(bias, (*stacked, *extra, width)),
        )
        n_in = width


def _side_by_side(stacked: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Move the first axis of (n, a, b) to the end."""
    return np.ascontiguousarray(stacked.transpose(1, 2, 0))


def _sigmoid(values: FloatArray) -> FloatArray:
    # Far below 0 the exponential is infinite, and the result 0 as it should be.
    with np.errstate(over="ignore"):
        result: FloatArray = 1.0 / (1.0 + np.exp(-values))
    return result


def _silu(values: FloatArray) -> FloatArray:
    result: FloatArray = values * _sigmoid(values)
    return result


def _silu_slope(values: FloatArray) -> FloatArray:
    sigmoid = _sigmoid(values)
    slope: FloatArray = sigmoid * (1.0 + values * (1.0 - sigmoid))
    return slope


def _shaped(
    values: npt.NDArray[Any], shape: tuple[int, ...], kind: npt.DTypeLike = np.float64
) -> npt.NDArray[Any]:
    """Copy an array to a type, or raise ValueError where its shape is another.

    Never read-only, which a model file's arrays are: loops would be compiled for both.
    """
    if values.shape != shape:
        raise ValueError(f"expected an array of shape {shape}, got {values.shape}")
    return np.array(values, dtype=kind, order="C")


@compiled
def _add_products(inputs: FloatArray, weight: Float32Array, outputs: FloatArray) -> None:
    """Add (B, n_in, n) inputs times (n_in, n_out, n) weights to the (B, n_out, n) outputs."""
    for i in range(weight.shape[0]):
        for j in range(weight.shape[1]):
            row = weight[i, j]
            for b in range(inputs.shape[0]):
                values, out = inputs[b, i], outputs[b, j]
                for n in range(len(row)):
                    out[n] += values[n] * row[n]


@compiled
def _add_products_backward(
    by_outputs: FloatArray, weight: Float32Array, by_inputs: FloatArray
) -> None:
    """Pull derivatives by `_add_products`' outputs back, adding to those by the inputs."""
    for i in range(weight.shape[0]):
        for j in range(weight.shape[1]):
            row = weight[i, j]
            for b in range(by_inputs.shape[0]):
                by, given = by_inputs[b, i], by_outputs[b, j]
                for n in range(len(row)):
                    by[n] += given[n] * row[n]


@compiled
def _add_product(inputs: FloatArray, weight: Float32Array, outputs: FloatArray) -> None:
    """Add (B, n_in) inputs times (n_in, n_out) weights to the (B, n_out) outputs."""
    for i in range(weight.shape[0]):
        row = weight[i]
        for b in range(inputs.shape[0]):
            value, out = inputs[b, i], outputs[b]
            for j in range(len(row)):
                out[j] += value * row[j]


@compiled_sums
def _add_product_backward(
    by_outputs: FloatArray, weight: Float32Array, by_inputs: FloatArray
) -> None:
    """Pull derivatives by `_add_product`'s outputs back, adding to those by the inputs."""
    for i in range(weight.shape[0]):
        row = weight[i]
        for b in range(by_inputs.shape[0]):
            given = by_outputs[b]
            total = 0.0
            for j in range(len(row)):
                total += given[j] * row[j]
            by_inputs[b, i] += total


@compiled
def _place(rows: FloatArray, points: Float32Array, origin: FloatArray, places: FloatArray) -> None:
    """Fill in places (B, 3, P): rows of gradients (B, 3, 3 P or more) times the (3 P, P) map."""
    for b in range(places.shape[0]):
        places[b] = origin
    for k in range(points.shape[0]):
        column = points[k]
        for b in range(places.shape[0]):
            for i in range(3):
                value, out = rows[b, i, k], places[b, i]
                for p in range(len(column)):
                    out[p] += value * column[p]


@compiled_sums
def _place_backward(by_places: FloatArray, points: Float32Array, by_rows: FloatArray) -> None:
    """Pull derivatives by `_place`'s places back, adding to those by the rows."""
    for k in range(points.shape[0]):
        column = points[k]
        for b in range(by_places.shape[0]):
            for i in range(3):
                given = by_places[b, i]
                total = 0.0
                for p in range(len(column)):
                    total += given[p] * column[p]
                by_rows[b, i, k] += total
