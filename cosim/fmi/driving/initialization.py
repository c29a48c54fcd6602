"""Start values, and the way of a unit through initialization mode (FMI 2.0.4 sections 3.2.3 and 4.2.4, FMI 3.0 section 2.3).

A start value is a number, a Boolean, the name or number of an enumeration's item, a text, hexadecimal digits for a Binary, or a
list of those for an array: flat in row-major order, or nested as its dimensions are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from cosim.arrays import Vector
from cosim.errors import FmuError, nearest
from cosim.fmi.description import Description
from cosim.fmi.instance import Instance
from cosim.fmi.variable import LARGEST_EXACT, Variable

StartScalar: TypeAlias = bool | int | float | str
StartValue: TypeAlias = "StartScalar | Sequence[StartValue]"
Starts: TypeAlias = Mapping[str, StartValue]  # by variable name


class Initialization:
    """Keeps a unit in initialization mode as long as its inputs may still change.

    Parameters
    ----------
    unit : Unit
        Just instantiated; where there are structural parameters, with the description that ``resized`` gives for them.
    values : mapping of variable name to StartValue
        Start values to set instead of the unit's own.

    Raises
    ------
    FmuError
        If a start value is not one; see ``check_start``.
    """

    def __init__(self, instance: Instance, values: Starts) -> None:
        self._instance, self._values = instance, check_start(instance.description, values)
        self._inputs = instance.description.references("input")
        self._outputs = instance.description.references("output")
        self._fresh = True
        self.t: float | None = None  # not None: in initialization mode at that time

    def enter(self, t: float, u: Vector) -> Vector:
        """Start at ``t`` with inputs ``u``, from the beginning unless still there; give the outputs."""
        if self.t != t:
            if not self._fresh:
                self._instance.reset()
            self._fresh = False
            self._set()
            self._instance.enter_initialization_mode(t)
            self.t = t
        self._instance.set_float64(self._inputs, np.array(u, np.float64))
        return self._instance.get_float64(self._outputs)

    def _set(self) -> None:
        given = self._values
        if given.structural:
            self._instance.enter_configuration_mode()
            self._set_numbers(given.structural)
            self._instance.exit_configuration_mode()
        self._set_numbers(given.numbers)
        for name, texts in given.texts.items():
            self._instance.set_text(self._instance.description[name], texts)

    def _set_numbers(self, numbers: Mapping[str, tuple[float, ...]]) -> None:
        if numbers:
            values = np.array([value for found in numbers.values() for value in found], np.float64)
            self._instance.set_float64(self._instance.description.references_of(numbers), values)

    def leave(self) -> bool:
        """Exit initialization mode; False: it had been left before."""
        if self.t is None:
            return False
        self.t = None
        self._instance.exit_initialization_mode()
        return True


@dataclass(frozen=True, slots=True)
class StartValues:
    """Checked start values by variable name, arrays in row-major order.

    Parameters
    ----------
    structural, numbers : mapping of str to tuple of float
        Of structural parameters (FMI 3), and of all other numbers and Booleans.
    texts : mapping of str to tuple of str
        Of Strings, and of Binaries in hexadecimal.
    """

    structural: Mapping[str, tuple[float, ...]]
    numbers: Mapping[str, tuple[float, ...]]
    texts: Mapping[str, tuple[str, ...]]


def resized(description: Description, values: Starts) -> Description:
    """Give the description with the structural parameters that are among start values.

    Raises
    ------
    FmuError
        If one of those is not one.
    """
    structural = {
        n: v
        for n, v in values.items()
        if n in description and description[n].causality == "structuralParameter"
    }
    checked = check_start(description, structural).structural
    return (
        description.resized({name: int(value) for name, (value,) in checked.items()})
        if checked
        else description
    )


def check_start(description: Description, values: Starts) -> StartValues:
    """Check start values against what the description says of their variables.

    Raises
    ------
    FmuError
        All problems together: unknown variable, one that cannot be set, two names of one, another type, NaN or infinity, outside
        the range, too many or too few elements.
    """
    problems: list[str] = []
    structural: dict[str, tuple[float, ...]] = {}
    numbers: dict[str, tuple[float, ...]] = {}
    texts: dict[str, tuple[str, ...]] = {}
    set_by: dict[str, str] = {}
    for name, value in values.items():
        try:
            variable = description[name]
            if not variable.settable or variable.type == "Clock":
                how = f"causality {variable.causality}, variability {variable.variability}, initial {variable.initial}"
                raise FmuError(f"{description.name}: {name!r} cannot be set at the start ({how})")
            _check_name(variable, set_by)
            scalars = _elements(variable, value)
            if variable.type in ("String", "Binary"):
                texts[name] = tuple(_text(variable, scalar) for scalar in scalars)
            else:
                target = structural if variable.causality == "structuralParameter" else numbers
                target[name] = tuple(_number(variable, scalar) for scalar in scalars)
        except FmuError as error:
            problems.append(str(error))
        except ValueError as error:
            problems.append(f"{description.name}: start value of {name!r}: {error}")
    if problems:
        raise FmuError("\n".join(problems))
    return StartValues(structural, numbers, texts)


def _check_name(variable: Variable, set_by: dict[str, str]) -> None:
    first = variable.alias_of or variable.name
    if set_by.setdefault(first, variable.name) != variable.name:
        raise ValueError(f"it is another name of {set_by[first]!r}, which is given too")


def _elements(variable: Variable, value: StartValue) -> list[StartScalar]:
    """Give the elements of a value in row-major order."""
    if not variable.dimensions:
        if isinstance(value, Sequence) and not isinstance(value, str):
            raise ValueError(f"found a list, needed one value of type {variable.type}")
        return [value]
    found, shape = _flattened(value)
    if math.prod(shape) != variable.size or len(shape) not in (1, len(variable.dimensions)):
        raise ValueError(f"found {_size(shape)}, needed a list of {variable.size} values")
    return found


def _flattened(value: StartValue) -> tuple[list[StartScalar], tuple[int, ...]]:
    if isinstance(value, str) or not isinstance(value, Sequence):
        return [value], ()
    parts = [_flattened(part) for part in value]
    shapes = {shape for _, shape in parts}
    if len(shapes) > 1:
        raise ValueError("found lists of different lengths, needed equal ones")
    return [scalar for found, _ in parts for scalar in found], (len(parts), *next(iter(shapes), ()))


def _size(shape: tuple[int, ...]) -> str:
    return (
        f"lists of shape {' x '.join(map(str, shape))}"
        if len(shape) > 1
        else f"{shape[0]} values"
        if shape
        else "one value"
    )


def _text(variable: Variable, scalar: StartScalar) -> str:
    if not isinstance(scalar, str):
        raise ValueError(
            f"found {scalar!r}, needed a text{' of hexadecimal digits' * (variable.type == 'Binary')}"
        )
    if variable.type == "Binary":
        try:
            bytes.fromhex(scalar)
        except ValueError:
            raise ValueError(
                f"found {scalar!r}, needed hexadecimal digits, two for every byte"
            ) from None
    elif "\0" in scalar:
        raise ValueError(f"found {scalar!r}, needed a text without the character 0, which ends it")
    return scalar


def _number(variable: Variable, scalar: StartScalar) -> float:
    if isinstance(scalar, str):
        return float(_item(variable, scalar))
    if variable.type == "Boolean":
        if scalar not in (0, 1):
            raise ValueError(f"found {scalar}, needed true or false")
        return float(scalar)
    if isinstance(scalar, bool):
        raise ValueError(f"found {str(scalar).lower()}, needed a number")
    if not math.isfinite(scalar):
        raise ValueError(f"found {scalar}, needed a finite number")
    if variable.kind == "integer":
        _check_integer(variable, scalar)
    if not variable.minimum <= scalar <= variable.maximum:
        raise ValueError(f"found {scalar}, needed {variable.minimum} to {variable.maximum}")
    return float(scalar)


def _item(variable: Variable, name: str) -> int:
    if not variable.items:
        raise ValueError(
            f"found {name!r}, needed {'true or false' if variable.type == 'Boolean' else 'a number'}"
        )
    if name not in variable.items:
        raise ValueError(f"no item {name!r}; {nearest(name, variable.items)}")
    return variable.items[name]


def _check_integer(variable: Variable, scalar: float) -> None:
    if scalar != int(scalar):
        raise ValueError(f"found {scalar}, needed a whole number")
    limits = np.iinfo(variable.type.lower())
    low, high = max(limits.min, -LARGEST_EXACT), min(limits.max, LARGEST_EXACT)
    if not low <= scalar <= high:
        raise ValueError(
            f"found {scalar}, needed {low} to {high} ({variable.type}, carried exactly)"
        )
    if variable.items and scalar not in variable.items.values():
        known = ", ".join(f"{number} ({name})" for name, number in variable.items.items())
        raise ValueError(f"found {scalar}, needed one of: {known}")
