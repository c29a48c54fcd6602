"""Gaussian numbers from random words: ``noise.c``."""

from __future__ import annotations

from ctypes import c_int64, c_void_p
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector
from cosim.native.library import declare, library, pointer

WORDS_PER_NORMAL: Final = 2  # random words that one Gaussian number takes

declare({"cosim_normal": (None, (c_int64, c_void_p, c_void_p))})


def normal(words: NDArray[np.uint64]) -> Vector:
    """Compute Gaussian numbers of mean 0 and deviation 1 from random words, two for each.

    numpy's own take the logarithm of the C library, and may change with its version.
    """
    count = len(words) // WORDS_PER_NORMAL
    y = np.empty(count)
    library.cosim_normal(count, pointer(words), pointer(y))
    return y
