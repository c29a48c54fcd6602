"""Memory that compiled steps read: aligned, of zeros, apart from each other."""

from ctypes import Structure, addressof, c_double, c_int32

import numpy as np

from cosim.native.memory import CACHE_LINE, LARGEST, SLAB, place, place_struct


class Pair(Structure):
    _fields_ = (("number", c_int32), ("value", c_double))


def test_arrays_keep_their_values_and_types_whatever_comes_after():
    """More of them than one piece of memory holds; large and empty ones too."""
    random = np.random.default_rng(1)
    sizes = [0, 1, 3, 8, LARGEST // 8, LARGEST]
    arrays = [random.standard_normal(size) for size in sizes * (2 * SLAB // LARGEST)]
    arrays += [np.array([True, False]), np.array([3], np.uint32)]
    placed = [place(array) for array in arrays]
    for copy, array in zip(placed, arrays, strict=True):
        assert copy.dtype == array.dtype
        assert copy.tolist() == array.tolist()
        assert copy.flags.writeable
        assert copy.ctypes.data % array.itemsize == 0


def test_structs_begin_with_a_cache_line_and_are_zero():
    first = place_struct(Pair)
    first.value = 2.5
    place(np.ones(3))
    second = place_struct(Pair)
    assert (second.number, second.value, first.value) == (0, 0.0, 2.5)
    assert addressof(first) % CACHE_LINE == addressof(second) % CACHE_LINE == 0
