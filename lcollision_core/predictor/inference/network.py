"""The default network on the CPU by compiled loops, in single precision, without torch.

`GeometricNetwork` spends most of a single pose's time on passing from one operation of torch to the
next, and a program that only drags sliders would spend seconds on importing it. Here the same loops
are called one after the other on arrays that are used again, and back again for the gradients.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.embedding import Embedding
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.predictor.inference import field_kernels, network_kernels
from lcollision_core.predictor.inference.field_kernels import FULL, REACHES, SOME, SUMS_A_REACH
from lcollision_core.predictor.inference.network_kernels import SQUASHED
from lcollision_core.predictor.inference.posed_skin import PosedSkin, SkinMap
from lcollision_core.predictor.inference.skin_geometry import SkinGeometry

State = Mapping[str, npt.NDArray[Any]]
Array = npt.NDArray[np.float32]

_ROWS_AT_ONCE = 64
"""Poses that are computed together: their arrays, half a megabyte a pose, stay in the caches."""

_SPARE_WORKSPACES = 2
"""Kept for later calls: of the editor's one pose and the solver's few, or of two threads."""


class CompiledNetwork:
    """A trained default network.

    Immutable but for scratch memory, and safe to share between threads.

    Parameters
    ----------
    embedding : of the body
    state : the state dict of a `GeometricNetwork`, as arrays

    Raises
    ------
    KeyError, ValueError : the state does not fit the embedding.

    Attributes
    ----------
    skin : what it looks at
    """

    def __init__(self, embedding: Embedding, state: State) -> None:
        sites = state["site_vertices"].astype(np.int64)
        _, n_points = state["body.points"].shape
        self.skin = skin = SkinGeometry.of(embedding, sites, n_points)
        n_points, n_sites = skin.n_points, len(sites)
        weight = _shaped(state["body.points"], (3 * n_points, n_points))
        self._skin_map = SkinMap(skin, weight, _shaped(state["body.origin"], (3, n_points)))
        self._reach = np.array(REACHES, dtype=np.float32)
        self._steepness = (1.0 / np.square(REACHES)).astype(np.float32)
        self._apart = field_kernels.by_blocks(skin.apart, skin.order)
        n_members = sites.shape[1]
        n_sums = SUMS_A_REACH * len(REACHES)
        self._patch = _Network.read(state, "patch", n_points, n_sums, 2)
        self._fold = _Network.read(state, "fold", n_sites, 9 * n_members, 2)
        sizes = 2 * (n_points + n_sites), embedding.n_domains + 2
        self._head = _Network(list(_read_layers(state, "head", None, *sizes)))
        self._any_hit = _shaped(state["any_hit"], (2,))
        self._spare_workspaces: list[_Trace] = []
        self._guard = Lock()

    def outputs(self, latent: npt.NDArray[Any]) -> tuple[FloatArray, FloatArray]:
        """Return (B, K) scaled energies of the domains, and (B,) logits, of (B, D) poses."""
        n_rows = len(latent)
        energy = np.empty((n_rows, self._head.n_out - 2))
        logit = np.empty(n_rows)
        for rows, codes, trace in self._parts(latent):
            logit[rows] = self._forward(codes, trace)
            energy[rows] = np.square(np.maximum(trace.head.outputs[0, :, 1:-1], 0.0))
        return energy, logit

    def logit_and_gradient(self, latent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (B,) logits of (B, D) poses, and each one's (B, D) derivative by its codes."""
        logit, gradient = np.empty(len(latent)), np.empty(latent.shape)
        for rows, codes, trace in self._parts(latent):
            logit[rows] = self._forward(codes, trace)
            gradient[rows] = self._backward(trace)
        return logit, gradient

    def _parts(self, latent: npt.NDArray[Any]) -> Iterator[tuple[slice, Array, _Trace]]:
        """Yield parts of some poses, all of one size, their codes, and a workspace for each."""
        n_rows = len(latent)
        if not n_rows:
            return
        codes = latent.astype(np.float32)
        n_parts = -(-n_rows // _ROWS_AT_ONCE)
        size = -(-n_rows // n_parts)
        trace = self._take_workspace(size)
        for part in range(n_parts):
            # The last part has some rows of the one before.
            start = min(part * size, n_rows - size)
            rows = slice(start, start + size)
            yield rows, codes[rows], trace
        with self._guard:
            self._spare_workspaces = [trace, *self._spare_workspaces[: _SPARE_WORKSPACES - 1]]

    def _take_workspace(self, n_rows: int) -> _Trace:
        """Take what an earlier call left, as new memory costs as much as filling it, or make it."""
        with self._guard:
            for place, trace in enumerate(self._spare_workspaces):
                if len(trace.hits) == n_rows:
                    return self._spare_workspaces.pop(place)
        return self._workspace(n_rows)

    def _workspace(self, n_rows: int) -> _Trace:
        skin = self.skin

        def empty(*shape: int) -> Array:
            return np.empty(shape, dtype=np.float32)

        n_hits = skin.n_points + len(skin.members)
        return _Trace(
            skin=PosedSkin(self._skin_map, n_rows),
            sums=empty(skin.n_points, n_rows, len(REACHES), SUMS_A_REACH),
            field=empty(skin.n_points, n_rows, len(REACHES), SUMS_A_REACH),
            patch=self._patch.workspace(n_rows),
            fold=self._fold.workspace(n_rows),
            hits=empty(n_rows, n_hits),
            share=empty(n_rows, n_hits),
            values=empty(1, n_rows, 2 * n_hits),
            head=self._head.workspace(n_rows),
        )

    def _forward(self, latent: Array, trace: _Trace) -> Array:
        """Fill in all of the trace, and return (B,) logits of (B, D) codes."""
        skin, n_rows, posed = self.skin, len(latent), trace.skin
        posed.set_codes(latent)
        given = posed.frame, posed.places, skin.order, self._apart, self._steepness
        field_kernels.contact_field(*given, trace.sums)
        field_kernels.normalised(trace.sums, self._reach, FULL, SOME, trace.field)
        n_points = skin.n_points
        field = trace.field.reshape(n_points, n_rows, self._patch.n_in)
        patch = self._patch.forward(field, trace.patch)
        fold = self._fold.forward(posed.view, trace.fold)
        hits, values = trace.hits, trace.values[0]
        n_hits = hits.shape[1]
        for found, start, stop in ((patch, 0, n_points), (fold, n_points, n_hits)):
            hits[:, start:stop] = found[..., 0].T
            values[:, n_hits + start : n_hits + stop] = found[..., 1].T
        np.tanh(hits / SQUASHED, out=values[:, :n_hits])
        head = self._head.forward(trace.values, trace.head)
        # The logarithm of the summed exponentials, and its derivative, the softmax.
        largest = hits.max(axis=1, keepdims=True)
        share = np.exp(hits - largest, out=trace.share)
        total = share.sum(axis=1, keepdims=True)
        share /= total
        any_logit = (largest + np.log(total))[:, 0] * self._any_hit[0] + self._any_hit[1]
        logit: Array = head[0, :, 0] + any_logit
        return logit

    def _backward(self, trace: _Trace) -> Array:
        skin, posed = self.skin, trace.skin
        n_points, n_hits = skin.n_points, trace.hits.shape[1]
        grad_head = np.zeros_like(trace.head.outputs)
        grad_head[..., 0] = 1.0
        grad_values = self._head.backward(trace.head, grad_head)[0]
        grad_hits = grad_values[:, :n_hits] * (
            (1.0 - np.square(trace.values[0, :, :n_hits])) / SQUASHED
        )
        grad_hits += self._any_hit[0] * trace.share
        grad_both = np.stack([grad_hits, grad_values[:, n_hits:]], axis=2).transpose(1, 0, 2)
        grad_patch, grad_fold = map(np.ascontiguousarray, np.split(grad_both, [n_points]))
        grad_field = self._patch.backward(trace.patch, grad_patch).reshape(trace.sums.shape)
        grad_view = self._fold.backward(trace.fold, grad_fold)
        grad_sums = np.empty_like(trace.sums)
        grad_frame, grad_places = np.zeros_like(posed.frame), np.zeros_like(posed.places)
        field_kernels.normalised_backward(
            trace.sums, self._reach, grad_field, FULL, SOME, grad_sums
        )
        given = posed.frame, posed.places, skin.order, self._apart, self._steepness, grad_sums
        field_kernels.contact_field_backward(*given, grad_frame, grad_places)
        return posed.grad_codes(grad_frame, grad_places, grad_view)


@dataclass(frozen=True, eq=False)
class _Trace:
    """All that a forward pass of B poses makes, and the way back needs.

    Attributes
    ----------
    skin : where it is and how it is deformed
    sums, field : (P, B, 2, 8) what the points feel, before and after `normalised`
    patch, fold, head : the small networks'
    hits : (B, P + S) logits of patches and folds being hit
    share : likewise, their softmax
    values : (1, B, 2 (P + S)) the squashed logits, then the roots of the energies
    """

    skin: PosedSkin
    sums: Array
    field: Array
    patch: _Activations
    fold: _Activations
    hits: Array
    share: Array
    values: Array
    head: _Activations


class _Layer:
    """The same layer of n networks side by side.

    Parameters
    ----------
    weight : (n, n_in, n_out) float32 array
    bias : (n, n_out) array
    """

    def __init__(self, weight: Array, bias: Array) -> None:
        self.weight, self.bias = weight, bias

    def multiply(self, inputs: Array, outputs: Array) -> None:
        """Fill in (n, B, n_out) outputs of (n, B, n_in) inputs, without the bias.

        Both may be wider; what is beyond is left alone.
        """
        network_kernels.multiply(inputs, self.weight, outputs)

    def multiply_back(self, grad_outputs: Array, grad_inputs: Array) -> None:
        """Fill in derivatives by the inputs."""
        network_kernels.multiply(grad_outputs, self._transposed, grad_inputs)

    @cached_property
    def _transposed(self) -> Array:
        """Of which the way back reads rows, too."""
        return np.ascontiguousarray(self.weight.transpose(0, 2, 1))


@dataclass(frozen=True, eq=False)
class _Activations:
    """What n networks made of their inputs.

    Attributes
    ----------
    before, after : (n, B, width) of each hidden layer, before and after the silu
    outputs : (n, B, n_out)
    """

    before: list[Array]
    after: list[Array]
    outputs: Array


class _Network:
    """n networks of one size side by side, each with inputs of its own.

    Parameters
    ----------
    layers : one after the other, with silu between them
    """

    def __init__(self, layers: list[_Layer]) -> None:
        self._layers = layers
        self.n_in, self.n_out = layers[0].weight.shape[1], layers[-1].weight.shape[2]

    @classmethod
    def read(cls, state: State, name: str, n: int, n_in: int, n_out: int) -> _Network:
        """Take n networks, with the means and deviations of their inputs, from a state dict."""
        layers = list(_read_layers(state, f"{name}.layers", n, n_in, n_out))
        mean, deviation = (
            _shaped(state[f"{name}.{what}"], (n, 1, n_in), np.float64)
            for what in ("mean", "deviation")
        )
        # The first layer standardises the inputs.
        weight = layers[0].weight / deviation.transpose(0, 2, 1)
        bias = layers[0].bias - (mean @ weight)[:, 0]
        return cls([_Layer(weight.astype(np.float32), bias.astype(np.float32)), *layers[1:]])

    def workspace(self, n_rows: int) -> _Activations:
        """Return memory for what B poses need."""
        n, hidden = len(self._layers[0].weight), self._layers[:-1]

        def empty(layer: _Layer) -> Array:
            return np.empty((n, n_rows, layer.weight.shape[2]), dtype=np.float32)

        return _Activations(
            [empty(layer) for layer in hidden],
            [empty(layer) for layer in hidden],
            empty(self._layers[-1]),
        )

    def forward(self, inputs: Array, workspace: _Activations) -> Array:
        """Apply to (n, B, n_in) inputs, and return the (n, B, n_out) outputs."""
        for layer, before, after in zip(
            self._layers[:-1], workspace.before, workspace.after, strict=True
        ):
            layer.multiply(inputs, before)
            network_kernels.add_and_silu(before, layer.bias, after)
            inputs = after
        last = self._layers[-1]
        last.multiply(inputs, workspace.outputs)
        workspace.outputs[:] += last.bias[:, None]
        return workspace.outputs

    def backward(self, workspace: _Activations, grad_outputs: Array) -> Array:
        """Pull derivatives by the outputs back to the inputs."""
        by = grad_outputs
        for layer, before in zip(self._layers[:0:-1], workspace.before[::-1], strict=True):
            grad_hidden = np.empty_like(before)
            layer.multiply_back(by, grad_hidden)
            network_kernels.silu_backward(before.reshape(-1), grad_hidden.reshape(-1))
            by = grad_hidden
        grad_inputs = np.empty((*by.shape[:2], self.n_in), dtype=by.dtype)
        self._layers[0].multiply_back(by, grad_inputs)
        return grad_inputs


def _read_layers(state: State, name: str, n: int | None, n_in: int, n_out: int) -> Iterator[_Layer]:
    """Yield the layers of n networks, or of one that is not stacked."""
    stacked, of_bias = ((), ()) if n is None else ((n,), (n, 1))
    n_layers = sum(key.startswith(name) for key in state) // 2
    for number in range(n_layers):
        weight, bias = (state[f"{name}.{number}.{what}"] for what in ("weight", "bias"))
        width = n_out if number == n_layers - 1 else weight.shape[-1]
        yield _Layer(
            _shaped(weight, (*stacked, n_in, width)).reshape(-1, n_in, width),
            _shaped(bias, (*of_bias, width)).reshape(-1, width),
        )
        n_in = width


def _shaped(
    values: npt.NDArray[Any], shape: tuple[int, ...], dtype: npt.DTypeLike = np.float32
) -> npt.NDArray[Any]:
    """Copy an array to a type, or raise ValueError where its shape is another.

    Never read-only, which a model file's arrays are: loops would be compiled for both.
    """
    if values.shape != shape:
        raise ValueError(f"expected an array of shape {shape}, got {values.shape}")
    return np.array(values, dtype=dtype, order="C")
