"""The compiled loops of small networks side by side: products and activations."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled, compiled_sums

Array = npt.NDArray[np.float32]

_LOG2_E = np.float32(1.0 / math.log(2.0))
_POWER = tuple(np.float32(math.log(2.0) ** n / math.factorial(n)) for n in range(6, -1, -1))
"""Taylor's coefficients of 2^r, the highest first: enough for single precision up to 1/2."""

_AT_ONCE = 4
"""Inputs whose products are summed up before the outputs are touched again."""

_SMALL = 2**15
"""Size of an array up to which new memory is cheap."""

_FEW_ROWS = 8
"""Up to so many, reading the weights takes the time, and a library's threads would take more."""


class Workspace:
    """Large arrays that the next pass fills again: new memory costs as much as filling it."""

    def __init__(self) -> None:
        self._memory: dict[str, Array] = {}

    def empty(self, name: str, *shape: int) -> Array:
        """Return an array whose values are no longer needed."""
        size = math.prod(shape)
        if size < _SMALL:
            return np.empty(shape, dtype=np.float32)
        if name not in self._memory or self._memory[name].size < size:
            self._memory[name] = np.empty(size, dtype=np.float32)
        return self._memory[name][:size].reshape(shape)


def multiply(inputs: Array, weight: Array, outputs: Array) -> Array:
    """Fill in and return n products: (n, B, n_in) inputs times (n, n_in, n_out) weights."""
    if inputs.shape[1] <= _FEW_ROWS:
        _multiply_few(inputs, weight, outputs)
    else:
        np.matmul(inputs, weight, out=outputs)
    return outputs


def multiply_back(grad_outputs: Array, weight: Array) -> Array:
    """Pull derivatives by the outputs of `multiply` back to its inputs."""
    n, n_rows, _ = grad_outputs.shape
    grad_inputs = np.empty((n, n_rows, weight.shape[1]), dtype=np.float32)
    if n_rows > _FEW_ROWS:
        np.matmul(grad_outputs, weight.transpose(0, 2, 1), out=grad_inputs)
    else:
        _multiply_few_back(grad_outputs, weight, grad_inputs)
    return grad_inputs


@compiled
def _multiply_few(inputs: Array, weight: Array, outputs: Array) -> None:
    n_in, n_out = weight.shape[1:]
    whole = n_in - n_in % _AT_ONCE
    for n in range(weight.shape[0]):
        for b in range(inputs.shape[1]):
            for j in range(n_out):
                outputs[n, b, j] = np.float32(0.0)
        for i in range(0, whole, _AT_ONCE):
            for b in range(inputs.shape[1]):
                x0, x1 = inputs[n, b, i], inputs[n, b, i + 1]
                x2, x3 = inputs[n, b, i + 2], inputs[n, b, i + 3]
                for j in range(n_out):
                    w0, w1 = weight[n, i, j], weight[n, i + 1, j]
                    w2, w3 = weight[n, i + 2, j], weight[n, i + 3, j]
                    outputs[n, b, j] += x0 * w0 + x1 * w1 + x2 * w2 + x3 * w3
        for i in range(whole, n_in):
            for b in range(inputs.shape[1]):
                for j in range(n_out):
                    outputs[n, b, j] += inputs[n, b, i] * weight[n, i, j]


@compiled_sums
def _multiply_few_back(grad_outputs: Array, weight: Array, grad_inputs: Array) -> None:
    for n in range(weight.shape[0]):
        for i in range(weight.shape[1]):
            for b in range(grad_outputs.shape[1]):
                total = np.float32(0.0)
                for j in range(weight.shape[2]):
                    total += grad_outputs[n, b, j] * weight[n, i, j]
                grad_inputs[n, b, i] = total


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
def silu_backward(values: Array, grad: Array) -> None:
    """Turn derivatives by the outputs x sigmoid(x) into those by flat values x, in place."""
    one = np.float32(1.0)
    for n in range(len(values)):
        x = values[n]
        sigmoid = one / (one + _exponential(-x))
        grad[n] *= sigmoid * (one + x * (one - sigmoid))


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
