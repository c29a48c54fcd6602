"""The addresses of a loaded FMU, for steps in compiled code (``fmu.h``)."""

from __future__ import annotations

from ctypes import addressof, c_void_p
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from cosim.errors import RunError
from cosim.fmi.binary.binding import Calls
from cosim.fmi.references import Group, ReferenceMap
from cosim.native.fmi.fmu import (
    FLOAT64,
    DirectionalStruct,
    GroupStruct,
    SlopesStruct,
    StepStruct,
    VariablesStruct,
    carrier,
)
from cosim.native.memory import place


@final
class InstanceAddresses:
    """Where compiled code finds an instance, its functions and its variables.

    What it returns lives as long as this object.

    Parameters
    ----------
    calls : Calls
    """

    def __init__(self, calls: Calls) -> None:
        self.version = calls.version
        self.fmu = calls.library.address
        self._calls = calls
        self._library = calls.library
        self._keep: list[object] = []

    def call(self, name: str) -> int:
        """Return the address of a function of the instance (``cosim_fmu_call``).

        ``name`` is that of FMI 3 where the versions differ in nothing else; the function is one
        that the instance has.
        """
        return self._library.call_address(self._calls.functions.get(name, name))

    def variables(self, references: ReferenceMap) -> VariablesStruct:
        """Return variables that are set or read together.

        Of a selection the vector is the one that it was selected from.
        """
        array_type = GroupStruct * len(references.groups)
        groups = array_type(*[self._group(references, group) for group in references.groups])
        self._keep.append(groups)
        struct = VariablesStruct(addressof(groups), len(groups))
        if len(groups) == 1 and groups[0].carrier == FLOAT64 and not groups[0].columns:
            (group,) = groups
            name = self._calls.type_name("Float64")
            struct.get = self._library.function_address(f"Get{name}")
            struct.set = self._library.function_address(f"Set{name}")
            struct.references = group.references
            struct.n_references = group.count
            struct.size = group.size
            struct.first = group.first
        return struct

    def _group(self, references: ReferenceMap, group: Group) -> GroupStruct:
        name = self._calls.type_name(group.type)
        columns = references.columns[group.columns]
        first = int(columns[0]) if len(columns) else 0
        in_order = bool((np.diff(columns) == 1).all())
        dtype = np.dtype(self._calls.dtypes[group.type])
        values: NDArray[np.uint8] = np.zeros(max(1, len(columns)) * dtype.itemsize, np.uint8)
        return GroupStruct(
            self.call(f"Get{name}"),
            self.call(f"Set{name}"),
            self._copied(group.references),
            group.count,
            len(columns),
            None if in_order else self._copied(columns),
            first,
            carrier(dtype),
            int(group.type == "Boolean"),
            self._copied(values),
        )

    def _copied(self, array: NDArray[Any]) -> int:
        """Copy an array behind those that a step reads beside it; return its address."""
        placed = place(np.ascontiguousarray(array))
        self._keep.append(placed)
        return placed.ctypes.data

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

    def step(self) -> StepStruct:
        """Return do_step of co-simulation."""
        return self._calls.step_struct()

    def slopes(self, references: ReferenceMap) -> SlopesStruct:
        """Return the slopes of inputs, a selection of all of them."""
        columns = np.ascontiguousarray(references.columns, np.intp)
        self._keep += [references, columns]
        return self._calls.slopes_struct(references.ungrouped, columns)

    def state(self, state: object) -> int:
        """Return where the pointer of a copied FMU state is."""
        assert isinstance(state, c_void_p)
        return addressof(state)

    def failure(self) -> RunError | None:
        """Return the call that failed in compiled code as an error; None: none did.

        It is returned once.
        """
        return self._library.failure_of_compiled_code()
