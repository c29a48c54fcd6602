"""Array types and conversions that every layer shares."""

from __future__ import annotations

from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Scalar = TypeVar("_Scalar", bound=np.generic)

Vector: TypeAlias = NDArray[np.float64]  # shape (n,)
Matrix: TypeAlias = NDArray[np.float64]  # shape (n, m)
Mask: TypeAlias = NDArray[np.bool_]  # shape (n,)
Nanoseconds: TypeAlias = NDArray[np.int64]  # shape (n,)

# the one NaN: equal runs have equal bits
NAN = float(np.uint64(0x7FF8000000000000).view(np.float64))
# the NaN of an empty cell in a recording of another tool: there is no row of the signal
ABSENT = float(np.uint64(0x7FF80000000007A2).view(np.float64))
_ABSENT_BITS = np.float64(ABSENT).view(np.int64)


def is_absent(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which values are those of empty cells; any other NaN is a value."""
    absent: NDArray[np.bool_] = np.ascontiguousarray(values).view(np.int64) == _ABSENT_BITS
    return absent


def frozen(values: ArrayLike, ndim: int) -> NDArray[np.float64]:
    """Copy ``values`` to a C-ordered float64 array with ``ndim`` axes that cannot be written to.

    Raises
    ------
    ValueError
        If ``values`` has another number of axes.
    """
    array = np.array(values, dtype=np.float64, order="C")
    if array.ndim != ndim:
        axes = "one axis" if ndim == 1 else f"{ndim} axes"
        raise ValueError(f"expected an array with {axes}, got shape {array.shape}")
    array.setflags(write=False)
    return array


def as_columns(values: NDArray[np.float64]) -> Matrix:
    """Return a recorded signal as a matrix with one column per element.

    Its shape is ``(N, size)``, also where the size is 1 and ``values`` has the shape ``(N,)``.
    """
    return values[:, np.newaxis] if values.ndim == 1 else values


def read_only(array: NDArray[_Scalar]) -> NDArray[_Scalar]:
    """Return a view of an array that cannot be written to."""
    view = array.view()
    view.flags.writeable = False
    return view
