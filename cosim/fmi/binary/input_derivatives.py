"""SetRealInputDerivatives, which FMI 1.0 and 2.0 have alike: du/dt of inputs for the next step."""

from __future__ import annotations

from ctypes import c_size_t, c_void_p
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector
from cosim.fmi.binary.binding import NO_INPUT_DERIVATIVES
from cosim.fmi.binary.library import Library, pointer
from cosim.fmi.references import Group
from cosim.native.fmi.fmu import SlopesStruct

FUNCTION: Final = "SetRealInputDerivatives"


@final
class RealInputDerivatives:
    """Sets the first derivatives of inputs, from Python and for compiled code.

    Parameters
    ----------
    library : Library
    available : bool
        Whether the FMU interpolates inputs; else every call is an error.
    """

    def __init__(self, library: Library, *, available: bool) -> None:
        self._library = library
        self._orders = np.ones(0, np.int32)
        if available:
            self._set = library.call(FUNCTION, c_void_p, c_size_t, c_void_p, c_void_p)
        else:
            self._set = library.unavailable(NO_INPUT_DERIVATIVES)

    def set(self, group: Group, slopes: Vector) -> None:
        """Set du/dt for the next step."""
        if len(self._orders) != group.count:
            self._orders = np.ones(group.count, np.int32)
        self._set(group.address, group.count, pointer(self._orders), pointer(slopes))

    def struct(self, group: Group, columns: NDArray[np.intp]) -> SlopesStruct:
        """Return the slopes of inputs for compiled code."""
        self._compiled_orders = np.ones(group.count, np.int32)
        self._compiled_slopes = np.zeros(group.count)
        struct = SlopesStruct(self._library.call_address(FUNCTION), group.address)
        struct.count = group.count
        struct.size = len(columns)
        struct.orders = self._compiled_orders.ctypes.data
        struct.columns = columns.ctypes.data
        struct.values = self._compiled_slopes.ctypes.data
        return struct
