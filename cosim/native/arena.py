"""Memory that a compiled step reads, close together."""

from __future__ import annotations

from typing import Any, Final, TypeVar, final

import numpy as np
from numpy.typing import NDArray

CACHE_LINE: Final = 64  # bytes
ALIGNMENT: Final = 8  # of every array
SIZE: Final = 1024  # bytes that are shared

ScalarType = TypeVar("ScalarType", bound=np.generic)


@final
class Arena:
    """Small arrays one behind the other: those of a step fill few lines of the cache.

    The arrays live as long as the arena, and keep it.
    """

    def __init__(self) -> None:
        memory = np.zeros(SIZE + CACHE_LINE, np.uint8)
        first = -memory.ctypes.data % CACHE_LINE
        self._memory = memory[first : first + SIZE]
        self._end = 0
        self._others: list[NDArray[Any]] = []  # that do not fit

    def place(self, array: NDArray[ScalarType]) -> NDArray[ScalarType]:
        """Return a copy of an array in the arena; where that is full, one of its own."""
        begin = self._end
        end = begin + array.nbytes
        if end > SIZE:
            own = array.copy()
            self._others.append(own)
            return own
        self._end = -(-end // ALIGNMENT) * ALIGNMENT
        placed: NDArray[ScalarType] = self._memory[begin:end].view(array.dtype).reshape(array.shape)
        placed[...] = array
        return placed
