"""The default network on the CPU by compiled loops, in single precision, without torch.

`GeometricNetwork` spends most of a single pose's time on passing from one operation of torch to the
next, and a program that only drags sliders would spend seconds on importing it. Here the same
network is computed by compiled loops, and back again for the gradients.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lcollision_core.embedding import Embedding
from lcollision_core.jobs import for_blocks
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.predictor.inference import network_kernels
from lcollision_core.predictor.inference.network_kernels import Workspace, Workspaces
from lcollision_core.predictor.inference.skin import CompiledSkin, PosedSkin
from lcollision_core.predictor.inference.skin_geometry import SkinGeometry

State = Mapping[str, npt.NDArray[Any]]
Array = npt.NDArray[np.float32]

SQUASHED = 4.0
"""A patch's logit is divided by this and squashed before the head sees it."""

_ROWS_AT_ONCE = 64
"""Poses that are computed together: their arrays, half a megabyte a pose, stay in the caches."""


class CompiledNetwork:
    """A trained default network, immutable.

    Parameters
    ----------
    embedding : of the body
    state : the state dict of a `GeometricNetwork`, as arrays that fit the embedding

    Attributes
    ----------
    skin : what it looks at
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
        """Return (B, K) scaled energies of the domains, and (B,) logits, of (B, D) poses."""
        root, logit = np.empty((len(latent), self._head.n_out - 2)), np.empty(len(latent))

        def fill(start: int, stop: int) -> None:
            with self._workspaces.lent() as workspace:
                trace = self._forward(latent[start:stop].astype(np.float32), workspace)
                root[start:stop], logit[start:stop] = trace.head[-1][0, :, 1:-1], trace.logit

        for_blocks(fill, len(latent), _ROWS_AT_ONCE)
        return np.square(np.maximum(root, 0.0)), logit

    def logit_and_gradient(self, latent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (B,) logits of (B, D) poses, and each one's (B, D) derivative by its codes."""
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
    """What a forward pass of B poses makes, and the backward pass needs.

    Attributes
    ----------
    body : where the skin is, what comes near it and how it is deformed
    patch, fold, head : each layer's values in the small networks
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
    """n networks of one size side by side, each with separate inputs; silu between layers.

    Parameters
    ----------
    state : the state dict
    name : of the networks in it, whose inputs are standardised; without one, it is the head
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
        """Apply to (n, B, n_in) inputs; returns each layer's values, before the silu."""
        values: list[Array] = []
        for number, (weight, bias) in enumerate(self._layers):
            shape = len(weight), inputs.shape[1], weight.shape[2]
            before, after = (
                workspace.empty(f"{self._name}{number} {what}", *shape) for what in ("in", "out")
            )
            values.append(np.matmul(inputs, weight, out=before))
            network_kernels.add_and_silu(before, bias, after)
            inputs = after
        return values

    def backward(self, values: list[Array], grad_outputs: Array) -> Array:
        """Pull derivatives by the outputs back to the inputs."""
        grad = grad_outputs
        for number, weight in reversed(list(enumerate(self._back))):
            if number < len(values) - 1:
                network_kernels.silu_backward(values[number].reshape(-1), grad.reshape(-1))
            grad = grad @ weight
        return grad


def _copied(values: npt.NDArray[Any]) -> Array:
    """Copy an array to float32; never read-only, as a model file's arrays are.

    Loops would be compiled for both.
    """
    return np.array(values, dtype=np.float32, order="C")
