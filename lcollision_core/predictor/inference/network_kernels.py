"""The compiled loops of small networks side by side: products and activations."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled, compiled_sums

Array = npt.NDArray[np.float32]

SQUASHED = 4.0
"""A patch's logit is divided by this and squashed before the head sees it."""

_LOG2_E = np.float32(1.0 / math.log(2.0))
_POWER = tuple(np.float32(math.log(2.0) ** n / math.factorial(n)) for n in range(6, -1, -1))
"""Taylor's coefficients of 2^r, the highest first: enough for single precision up to 1/2."""

_AT_ONCE = 4
"""Inputs whose products are summed up before the outputs are touched again."""

_FEW_ROWS = 8
"""Up to so many, reading the weights takes the time, and a library's threads would take more."""


def multiply(inputs: Array, weight: Array, outputs: Array) -> None:
    """Fill in n products: (n, B, n_in) inputs times (n, n_in, n_out) weights.

    Inputs and outputs may be wider; what is beyond is left alone.
    """
    if inputs.shape[1] <= _FEW_ROWS:
        _multiply_few(inputs, weight, outputs)
    else:
        _, n_in, n_out = weight.shape
        np.matmul(inputs[..., :n_in], weight, out=outputs[..., :n_out])


@compiled
def _multiply_few(inputs: Array, weight: Array, outputs: Array) -> None:
    n_rows, n_in, n_out = inputs.shape[1], weight.shape[1], weight.shape[2]
    whole = n_in - n_in % _AT_ONCE
    for n in range(weight.shape[0]):
        for b in range(n_rows):
            for j in range(n_out):
                outputs[n, b, j] = np.float32(0.0)
        for i in range(0, whole, _AT_ONCE):
            for b in range(0, n_rows - 1, 2):
                x0, x1 = inputs[n, b, i], inputs[n, b, i + 1]
                x2, x3 = inputs[n, b, i + 2], inputs[n, b, i + 3]
                y0, y1 = inputs[n, b + 1, i], inputs[n, b + 1, i + 1]
                y2, y3 = inputs[n, b + 1, i + 2], inputs[n, b + 1, i + 3]
                for j in range(n_out):
                    w0, w1 = weight[n, i, j], weight[n, i + 1, j]
                    w2, w3 = weight[n, i + 2, j], weight[n, i + 3, j]
                    outputs[n, b, j] += x0 * w0 + x1 * w1 + x2 * w2 + x3 * w3
                    outputs[n, b + 1, j] += y0 * w0 + y1 * w1 + y2 * w2 + y3 * w3
            for b in range(n_rows - n_rows % 2, n_rows):
                x0, x1 = inputs[n, b, i], inputs[n, b, i + 1]
                x2, x3 = inputs[n, b, i + 2], inputs[n, b, i + 3]
                for j in range(n_out):
                    w0, w1 = weight[n, i, j], weight[n, i + 1, j]
                    w2, w3 = weight[n, i + 2, j], weight[n, i + 3, j]
                    outputs[n, b, j] += x0 * w0 + x1 * w1 + x2 * w2 + x3 * w3
        for i in range(whole, n_in):
            for b in range(n_rows):
                x = inputs[n, b, i]
                for j in range(n_out):
                    outputs[n, b, j] += x * weight[n, i, j]


@compiled_sums
def add_and_silu(values: Array, bias: Array, outputs: Array) -> None:
    """Add biases (n, m) to (n, B, m) values in place, and fill in x sigmoid(x) of the sums."""
    one = np.float32(1.0)
    for n in range(values.shape[0]):
        for b in range(values.shape[1]):
            for i in range(values.shape[2]):
                x = values[n, b, i] + bias[n, i]
                values[n, b, i] = x
                outputs[n, b, i] = x / (one + _exponential(-x))


@compiled_sums
def silu_backward(values: Array, by: Array) -> None:
    """Turn derivatives by the outputs x sigmoid(x) into those by flat values x, in place."""
    one = np.float32(1.0)
    for n in range(len(values)):
        x = values[n]
        sigmoid = one / (one + _exponential(-x))
        by[n] *= sigmoid * (one + x * (one - sigmoid))


@compiled_sums
def _exponential(x: np.float32) -> np.float32:
    """Return exp(x), between those of +-87.3: several at a time, as the library's is not."""
    y = min(max(x * _LOG2_E, np.float32(-126.0)), np.float32(126.0))
    whole = np.floor(y + np.float32(0.5))
    rest = y - whole
    power = np.float32(0.0)
    for term in _POWER:
        power = power * rest + term
    # A power of two by its bits.
    return power * np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32)
