"""Memory that compiled steps read, close together.

What the steps of many components read in turn should fill few lines of the cache and few pages:
small arrays and structs that are allocated one by one lie scattered over the heap, and finding
their pages costs more than the steps themselves.
"""

from __future__ import annotations

import threading
from ctypes import Structure, sizeof
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

CACHE_LINE: Final = 64  # bytes
ALIGNMENT: Final = 8  # of arrays
SLAB: Final = 2**16  # bytes
LARGEST: Final = 2**10  # bytes of what is allocated here

ScalarType = TypeVar("ScalarType", bound=np.generic)
Struct = TypeVar("Struct", bound=Structure)


class _Slab:
    """Memory of which parts are handed out one behind the other; none comes back.

    It is freed with the last array or struct in it.
    """

    def __init__(self) -> None:
        memory = np.zeros(SLAB + CACHE_LINE, np.uint8)
        first = -memory.ctypes.data % CACHE_LINE
        self.memory = memory[first : first + SLAB]
        self.end = 0


_lock = threading.Lock()
_slab = _Slab()


def _allocated(size: int, alignment: int) -> NDArray[np.uint8]:
    """Return memory of some bytes, zeros; large ones on their own."""
    global _slab
    if size > LARGEST:
        return np.zeros(size, np.uint8)
    with _lock:
        begin = -(-_slab.end // alignment) * alignment
        if begin + size > SLAB:
            _slab = _Slab()
            begin = 0
        _slab.end = begin + size
        return _slab.memory[begin : begin + size]


def place(array: NDArray[ScalarType]) -> NDArray[ScalarType]:
    """Copy an array there."""
    memory = _allocated(array.nbytes, ALIGNMENT)
    placed: NDArray[Any] = memory.view(array.dtype).reshape(array.shape)
    placed[...] = array
    return placed


def place_struct(struct: type[Struct]) -> Struct:
    """Make a struct there, of zeros."""
    memory: Any = _allocated(sizeof(struct), CACHE_LINE)
    return struct.from_buffer(memory)
