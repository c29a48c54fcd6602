"""Variables as the elements of one float64 vector, with their value references for FMI calls."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Vector
from cosim.fmi.variable import Variable, VariableType


@dataclass(frozen=True, slots=True)
class VectorElement:
    """One element of a vector: an element of a variable, numbered in row-major order."""

    variable: Variable
    index: int


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Variables of one type, and where their elements stand in the vector."""

    type: VariableType
    references: NDArray[np.uint32]  # (number of variables,)
    columns: NDArray[np.intp]  # (number of elements,)
    address: int  # of the references, for C
    count: int  # of the references

    @staticmethod
    def of(
        variable_type: VariableType,
        references: Sequence[int] | NDArray[np.uint32],
        columns: NDArray[np.intp],
    ) -> Group:
        """Build a group from its value references."""
        array = np.array(references, np.uint32)
        return Group(variable_type, array, columns, array.ctypes.data, len(array))

    def __reduce__(self) -> tuple[Any, ...]:
        """Be built anew by another process, which has other addresses."""
        return Group.of, (self.type, self.references, self.columns)


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceMap:
    """Variables that are set or read together, as the elements of one float64 vector.

    This class alone knows their order: the variables stand one behind the other, the elements of an
    array in row-major order.

    Parameters
    ----------
    variables : tuple of Variable
    size : int
        Number of elements.
    groups : tuple of Group
        The variables by type, for the calls that set and read values.
    ungrouped : Group
        All variables in their order, for the calls with derivatives: those are Float64 whatever the
        variables are.
    all_float64 : bool
        Whether every variable is Float64 (and there is one), so that the vector is handed over as
        it is.
    columns : array of int, shape (size,)
        Of a selection: where its elements stand in the vector that it was selected from; else 0,
        1, ...
    is_part : bool
        Whether it is a selection that leaves out some of that vector.
    opposite : array of float64, shape (size,), or None
        Of negated variables, what they and the values behind their references add up to; NaN for
        all others. None: there are none.
    """

    variables: tuple[Variable, ...]
    size: int
    groups: tuple[Group, ...]
    ungrouped: Group
    all_float64: bool
    columns: NDArray[np.intp]
    is_part: bool = False
    opposite: Vector | None = None

    @staticmethod
    def of(variables: Iterable[Variable]) -> ReferenceMap:
        """Build the map of variables, in their order."""
        variables = tuple(variables)
        opposite = None
        if any(variable.negated for variable in variables):
            sums = [float(v.type == "Boolean") if v.negated else np.nan for v in variables]
            opposite = np.array(sums)  # there are no arrays in FMI 1
        sizes = [variable.size for variable in variables]
        columns = np.arange(sum(sizes), dtype=np.intp)
        groups = []
        for variable_type in dict.fromkeys(variable.type for variable in variables):
            in_group = [variable.type == variable_type for variable in variables]
            references = [v.reference for v in variables if v.type == variable_type]
            group_columns = columns[np.repeat(in_group, sizes)]
            groups.append(Group.of(variable_type, references, group_columns))
        ungrouped = Group.of("Float64", [v.reference for v in variables], columns)
        all_float64 = len(groups) == 1 and groups[0].type == "Float64"
        size = len(columns)
        return ReferenceMap(
            variables, size, tuple(groups), ungrouped, all_float64, columns, opposite=opposite
        )

    @staticmethod
    def of_distinct(variables: Iterable[Variable]) -> ReferenceMap:
        """Build the map of variables without aliases: each value reference of a type once."""
        distinct = {_key(variable): variable for variable in variables}
        return ReferenceMap.of(distinct.values())

    @property
    def elements(self) -> tuple[VectorElement, ...]:
        """What stands at each place of the vector."""
        elements: list[VectorElement] = []
        for variable in self.variables:
            elements += [VectorElement(variable, index) for index in range(variable.size)]
        return tuple(elements)

    def where(self, condition: Callable[[Variable], bool]) -> Mask:
        """Return which elements belong to variables that meet a condition, shape (size,)."""
        meets = np.array([condition(variable) for variable in self.variables], np.bool_)
        sizes = np.array([variable.size for variable in self.variables], np.intp)
        return np.repeat(meets, sizes)

    def select(self, mask: Mask) -> ReferenceMap:
        """Return the map of the variables whose elements a mask of shape (size,) chooses.

        The mask chooses all elements of a variable or none.
        """
        chosen = []
        column = 0
        for variable in self.variables:
            if mask[column]:
                chosen.append(variable)
            column += variable.size
        selection = ReferenceMap.of(chosen)
        columns = np.flatnonzero(mask)
        assert len(columns) == selection.size
        return replace(selection, columns=columns, is_part=not mask.all())

    def negated(self, values: Vector) -> Vector:
        """Return what the FMU has for values of the variables, or they for values that it has.

        That is ``values`` itself where no variable is the opposite of what its reference has.
        """
        if self.opposite is None:
            return values
        return np.where(np.isnan(self.opposite), values, self.opposite - values)

    def take(self, values: Vector) -> Vector:
        """Return a selection's elements of the vector that it was selected from.

        That is the vector itself, not a copy, where the selection leaves nothing out.
        """
        return values[self.columns] if self.is_part else values

    def put(self, values: Vector, others: Vector) -> Vector:
        """Return the vector that a selection was selected from, with new elements for it.

        That is ``values`` itself where the selection leaves nothing out.
        """
        if not self.is_part:
            return values
        completed = others.copy()
        completed[self.columns] = values
        return completed

    def columns_of(self, elements: Iterable[VectorElement]) -> NDArray[np.intp]:
        """Return where elements stand in the vector; an alias stands where its variable does."""
        firsts: dict[tuple[VariableType, int, bool], int] = {}
        first = 0
        for variable in self.variables:
            firsts[_key(variable)] = first
            first += variable.size
        columns = [firsts[_key(element.variable)] + element.index for element in elements]
        return np.array(columns, np.intp)


def _key(variable: Variable) -> tuple[VariableType, int, bool]:
    return variable.type, variable.reference, variable.negated
