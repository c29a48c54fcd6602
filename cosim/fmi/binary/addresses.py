"""The addresses of a loaded FMU, for steps in compiled code (``fmu.h``)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from ctypes import addressof
from typing import final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cosim.errors import RunError
from cosim.fmi.binary.library import Library
from cosim.fmi.references import Group, ReferenceMap
from cosim.fmi.variable import VariableType
from cosim.native.fmu import DirectionalStruct, GroupStruct, VariablesStruct, carrier


@final
class InstanceAddresses:
    """Where compiled code finds an instance, its functions and its variables.

    What it returns lives as long as this object.

    Parameters
    ----------
    library : Library
    version : int
        First digit of the FMI version.
    dtypes : mapping of VariableType to data type
        How the FMU carries each type.
    type_name : callable
        What the functions that get and set a type are named after.
    functions : mapping of str to str
        Names of functions that differ in nothing else between the versions, by those of FMI 3.
    """

    def __init__(
        self,
        library: Library,
        version: int,
        *,
        dtypes: Mapping[str, DTypeLike],
        type_name: Callable[[VariableType], str],
        functions: Mapping[str, str],
    ) -> None:
        self.version = version
        self.fmu = library.address
        self._library = library
        self._dtypes = dtypes
        self._type_name = type_name
        self._functions = functions
        self._keep: list[object] = []

    def call(self, name: str) -> int:
        """Return the address of a function of the instance (``cosim_fmu_call``).

        ``name`` is that of FMI 3 where the versions differ in nothing else; the function is one
        that the instance has.
        """
        return self._library.call_address(self._functions.get(name, name))

    def variables(self, references: ReferenceMap) -> VariablesStruct:
        """Return variables that are set or read together.

        Of a selection the vector is the one that it was selected from.
        """
        array_type = GroupStruct * len(references.groups)
        groups = array_type(*[self._group(references, group) for group in references.groups])
        self._keep.append(groups)
        return VariablesStruct(addressof(groups), len(groups))

    def _group(self, references: ReferenceMap, group: Group) -> GroupStruct:
        name = self._type_name(group.type)
        columns = np.ascontiguousarray(references.columns[group.columns], np.intp)
        first = int(columns[0]) if len(columns) else 0
        in_order = bool((np.diff(columns) == 1).all())
        dtype = np.dtype(self._dtypes[group.type])
        values: NDArray[np.uint8] = np.zeros(max(1, len(columns)) * dtype.itemsize, np.uint8)
        self._keep += [group, columns, values]
        return GroupStruct(
            self.call(f"Get{name}"),
            self.call(f"Set{name}"),
            group.address,
            group.count,
            len(columns),
            None if in_order else columns.ctypes.data,
            first,
            carrier(dtype),
            int(group.type == "Boolean"),
            values.ctypes.data,
        )

    def directional(self, unknowns: ReferenceMap, knowns: ReferenceMap) -> DirectionalStruct:
        """Return the directional derivatives of variables, all of them Float64."""
        self._keep += [unknowns, knowns]
        rows = unknowns.ungrouped
        columns = knowns.ungrouped
        return DirectionalStruct(
            self.call("GetDirectionalDerivative"),
            rows.address,
            columns.address,
            rows.count,
            columns.count,
            unknowns.size,
            knowns.size,
        )

    def failure(self) -> tuple[str, RunError] | None:
        """Return the call that failed in compiled code, by its name, as an error; None: none did.

        It is returned once.
        """
        return self._library.failure_of_compiled_code()
