"""The compiled kernels, loaded through ctypes."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from ctypes import c_void_p
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.errors import UsageError
from cosim.native.build import HERE, LIBRARY

Signature: TypeAlias = tuple[Any, tuple[Any, ...]]  # result, arguments


def _load() -> Any:
    path = HERE / LIBRARY
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise UsageError(
            f"the compiled kernels {path} cannot be loaded ({error}); run 'pip install -e .' again"
        ) from error
    return library


library = _load()


def declare(signatures: Mapping[str, Signature]) -> None:
    """Declare functions of the library, as in its headers."""
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype = result
        function.argtypes = arguments


def address(function: str) -> int:
    """Return the address of a function of the library, for C."""
    value = ctypes.cast(getattr(library, function), c_void_p).value
    assert value is not None
    return value


def pointer(array: NDArray[Any]) -> int:
    """Return the address of a contiguous array's data; the array must outlive its use."""
    assert array.flags.c_contiguous
    return array.ctypes.data


def int32(values: Any) -> NDArray[np.int32]:
    """Copy to a contiguous int32 array."""
    return np.ascontiguousarray(values, np.int32)
