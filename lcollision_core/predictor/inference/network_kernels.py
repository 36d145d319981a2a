"""The compiled loops of small networks side by side: their activations."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled_sums

Array = npt.NDArray[np.float32]

_LOG2_E = np.float32(1.0 / math.log(2.0))
_POWER = tuple(np.float32(math.log(2.0) ** n / math.factorial(n)) for n in range(6, -1, -1))
"""Taylor's coefficients of 2^r, the highest first: enough for single precision up to 1/2."""

_SMALL = 2**15
"""Size of an array up to which new memory is cheap."""


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


class Workspaces:
    """Workspaces kept from pass to pass: of one pose and the solver's few, or of two threads."""

    def __init__(self) -> None:
        self._spare: deque[Workspace] = deque(maxlen=2)

    @contextmanager
    def lent(self) -> Iterator[Workspace]:
        """Lend the workspace of an earlier pass, or a new one."""
        try:
            workspace = self._spare.pop()
        except IndexError:
            workspace = Workspace()
        yield workspace
        self._spare.append(workspace)


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
