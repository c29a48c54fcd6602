"""Start values, and initialization mode.

FMI 2.0.4 sections 3.2.3 and 4.2.4, FMI 3.0 sections 2.3.2 and 2.3.3.

A start value is a number, a Boolean, the name or number of an enumeration's item, a string,
hexadecimal digits for a Binary, or a list of those for an array: flat in row-major order, or nested
as its dimensions are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, TypeAlias, TypeVar

import numpy as np

from cosim.arrays import Vector
from cosim.errors import FmuError, RunError, listing, nearest
from cosim.fmi.description import Description
from cosim.fmi.driving.clocks import EventClocks
from cosim.fmi.driving.diagnostics import Diagnostics
from cosim.fmi.instance import Instance
from cosim.fmi.references import ReferenceMap
from cosim.fmi.variable import Variable, is_exact

StartScalar: TypeAlias = bool | int | float | str
StartValue: TypeAlias = "StartScalar | Sequence[StartValue]"
Starts: TypeAlias = Mapping[str, StartValue]  # by variable name
Found = TypeVar("Found")
SINGLE: Final = 1e-6  # relative: what single precision leaves, also of units that are converted


class Initialization:
    """Keeps an instance in initialization mode as long as its inputs may still change.

    Parameters
    ----------
    instance : Instance
        Just instantiated; where there are structural parameters, with the description that
        ``resized`` returns for them.
    values : mapping of variable name to StartValue
        Start values to set instead of the FMU's own.
    diagnostics : Diagnostics
        Takes which values the FMU does not keep.
    clocks : EventClocks or None
        Asked for its first ticks in initialization mode.

    Attributes
    ----------
    mode_time : float or None
        Time [s] at which the instance is in initialization mode; None: it is not.

    Raises
    ------
    FmuError
        If a start value is not one; see ``check_start``.
    """

    def __init__(
        self,
        instance: Instance,
        values: Starts,
        diagnostics: Diagnostics,
        clocks: EventClocks | None = None,
    ) -> None:
        self._instance = instance
        self._diagnostics = diagnostics
        self._values = check_start(instance.description, values)
        self._clocks = clocks
        self._inputs = instance.description.values("input")
        self._outputs = instance.description.values("output")
        self._no_outputs = np.zeros(instance.description.references("output").size)
        self._instantiated = True  # and no more than that
        self._last: tuple[float, Vector] | None = None  # time and inputs of the last enter
        self._replaced: list[str] | None = None  # values that are not kept; None: not read yet
        self.mode_time: float | None = None

    def enter(self, t: float, u: Vector) -> Vector:
        """Enter initialization mode at ``t`` with inputs ``u``; return the outputs.

        Where the instance is in that mode at ``t`` already, only the inputs are set.
        """
        if self.mode_time != t:
            if not self._instantiated:
                # Start values can be set in the state Instantiated only (FMI 2.0.4 section 2.1.6,
                # FMI 3.0 section 2.3.1). This also takes those back that were set before.
                self._instance.reset()
            self._instantiated = False
            # Before start values: some FMUs of FMI 2 forget in it what was set before.
            self._instance.setup_experiment(t)
            # Before initialization mode: in it, those of variables with initial = "approx" must not
            # be set any more (FMI 2.0.4 section 3.2.3, FMI 3.0 section 2.3.3).
            self._set_start_values()
            self._instance.enter_initialization_mode()
            self.mode_time = t
        # Inputs have no attribute initial, so their place is the initialization mode itself. Here
        # they may be set and outputs read in turns, which algebraic loops need.
        u = np.array(u, np.float64)
        self._last = (t, u)
        self._instance.set_float64(self._inputs, self._inputs.take(u))
        return self._read()

    def _read(self) -> Vector:
        """Return the outputs; no clock ticks yet."""
        return self._outputs.put(self._instance.get_float64(self._outputs), self._no_outputs)

    def repeat(self) -> Vector:
        """Initialize a new instance as the last one was, to the end; return the outputs."""
        assert self._last is not None  # there was one
        t, u = self._last
        self._instantiated = True
        self.mode_time = None
        self.enter(t, u)
        self.leave()
        return self._read()

    def _set_start_values(self) -> None:
        values = self._values
        if values.structural:
            # First of all: structural parameters decide how many elements other variables have
            # (FMI 3.0 section 2.3.6).
            self._instance.enter_configuration_mode()
            self._set_numbers(values.structural)
            self._instance.exit_configuration_mode()
        self._set_numbers(values.numbers)
        for name, texts in values.texts.items():
            self._instance.set_text(self._instance.description[name], texts)

    def _set_numbers(self, numbers: Mapping[str, tuple[float, ...]]) -> None:
        if not numbers:
            return
        elements: list[float] = []
        for values in numbers.values():
            elements += values
        references = self._instance.description.references_of(numbers)
        self._instance.set_float64(references, np.array(elements, np.float64))

    def leave(self) -> bool:
        """Exit initialization mode; return False where it had been left before."""
        t = self.mode_time
        if t is None:
            return False
        if self._clocks is not None:
            self._clocks.ask_first_ticks(t)
        self.mode_time = None
        self._instance.exit_initialization_mode()
        if self._replaced is None:  # once: a reset sets the same values again
            self._replaced = list(self._read_back())
        if self._replaced:
            self._diagnostics.add(
                t,
                "values that are not kept",
                "does not keep values that were set before or in its initialization, and computes "
                f"with others: {listing(self._replaced)}",
            )
        return True

    def _read_back(self) -> Iterator[str]:
        """Yield the values that were set, are not computed by the FMU, and read back as others."""
        assert self._last is not None  # it was entered
        _, u = self._last
        description = self._instance.description
        numbers = {**self._values.structural, **self._values.numbers}
        kept = [name for name in numbers if _is_kept(description[name])]
        elements = [value for name in kept for value in numbers[name]]
        yield from self._differences(description.references_of(kept), np.array(elements))
        unclocked = self._inputs.select(self._inputs.where(lambda variable: not variable.clocks))
        yield from self._differences(unclocked, unclocked.take(self._inputs.take(u)))
        for name, texts in self._values.texts.items():
            if _is_kept(description[name]):
                found = self._ask(partial(self._instance.get_text, description[name]))
                if found not in (None, texts):
                    yield f"{name} is {found}, was set to {texts}"

    def _differences(self, references: ReferenceMap, wanted: Vector) -> Iterator[str]:
        """Yield the elements of variables that read back as others than those that were set."""
        if not references.size:
            return
        found = self._ask(partial(self._instance.get_float64, references))
        if found is None:
            return
        real = references.where(lambda variable: variable.signal_type == "real")
        # Whatever its type is: what an FMU computes with inside, nothing says.
        rounding = np.where(real, SINGLE, 0.0)
        same = np.isclose(found, wanted, rounding, 0.0, equal_nan=True)
        for i in np.flatnonzero(~same):
            variable = references.elements[i].variable
            index = f"[{references.elements[i].index}]" if variable.dimensions else ""
            yield f"{variable.name}{index} is {found[i]}, was set to {wanted[i]}"

    def _ask(self, get: Callable[[], Found]) -> Found | None:
        """Return what the FMU has for variables that no run needs; None where it refuses."""
        mark = self._instance.mark_messages()
        try:
            return get()
        except RunError:
            self._instance.forget_messages(mark)
            return None


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
    """Return the description with the structural parameters that are among start values.

    Raises
    ------
    FmuError
        If the value of one of those is wrong.
    """
    structural: dict[str, StartValue] = {}
    for name, value in values.items():
        if name in description and description[name].causality == "structuralParameter":
            structural[name] = value
    if not structural:
        return description
    checked = check_start(description, structural).structural
    sizes = {name: int(value) for name, (value,) in checked.items()}
    return description.resized(sizes)


def _is_kept(variable: Variable) -> bool:
    """Whether it has its start value at the end of the initialization; not where it is an input.

    Those of events, and what belongs to clocks, may be others by then.
    """
    changes = variable.variability == "discrete" or bool(variable.clocks)
    return variable.initial == "exact" and variable.causality != "input" and not changes


def check_start(description: Description, values: Starts) -> StartValues:
    """Check start values against what the description says of their variables.

    Raises
    ------
    FmuError
        All problems together: unknown variable, one that cannot be set, two names of one, another
        type, NaN or infinity, outside the range, too many or too few elements.
    """
    problems: list[str] = []
    structural: dict[str, tuple[float, ...]] = {}
    numbers: dict[str, tuple[float, ...]] = {}
    texts: dict[str, tuple[str, ...]] = {}
    set_by: dict[str, str] = {}
    for name, value in values.items():
        try:
            variable = _settable(description, name)
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


def _settable(description: Description, name: str) -> Variable:
    """Return the variable of that name; refuse one that cannot be set."""
    variable = description[name]
    first = variable.alias_of
    if first is not None and variable.negated:
        raise FmuError(f"{description.name}: {name!r} is {first!r} negated; set that one")
    if not variable.settable or variable.type == "Clock":
        attributes = (
            f"causality {variable.causality}, variability {variable.variability}, "
            f"initial {variable.initial}"
        )
        raise FmuError(
            f"{description.name}: {name!r} has no start value that can be set ({attributes})"
        )
    return variable


def _check_name(variable: Variable, set_by: dict[str, str]) -> None:
    """Refuse a second name of a variable that was set; ``set_by`` notes under which name."""
    first_name = variable.alias_of or variable.name
    if set_by.setdefault(first_name, variable.name) != variable.name:
        raise ValueError(f"it is another name of {set_by[first_name]!r}, which is given too")


def _elements(variable: Variable, value: StartValue) -> list[StartScalar]:
    """Return the elements of a value in row-major order."""
    if not variable.dimensions:
        if isinstance(value, Sequence) and not isinstance(value, str):
            raise ValueError(f"expected one value of type {variable.type}, got a list")
        return [value]
    scalars, shape = _flattened(value)
    flat_or_nested = len(shape) in (1, len(variable.dimensions))
    if math.prod(shape) != variable.size or not flat_or_nested:
        raise ValueError(f"expected a list of {variable.size} values, got {_counted(shape)}")
    return scalars


def _flattened(value: StartValue) -> tuple[list[StartScalar], tuple[int, ...]]:
    """Return the scalars of a nested list in row-major order, and its shape."""
    if isinstance(value, str) or not isinstance(value, Sequence):
        return [value], ()
    scalars: list[StartScalar] = []
    shapes: set[tuple[int, ...]] = set()
    for part in value:
        part_scalars, part_shape = _flattened(part)
        scalars += part_scalars
        shapes.add(part_shape)
    if len(shapes) > 1:
        raise ValueError("expected lists of equal lengths")
    part_shape = next(iter(shapes), ())
    return scalars, (len(value), *part_shape)


def _counted(shape: tuple[int, ...]) -> str:
    """Return how many values a value of that shape has, in words."""
    if not shape:
        return "one value"
    if len(shape) == 1:
        return f"{shape[0]} values"
    return f"lists of shape {' x '.join(map(str, shape))}"


def _text(variable: Variable, scalar: StartScalar) -> str:
    """Return the value of a String or, in hexadecimal, of a Binary."""
    if variable.type == "Binary":
        return _hexadecimal(scalar)
    if not isinstance(scalar, str):
        raise ValueError(f"expected a string, got {scalar!r}")
    if "\0" in scalar:
        raise ValueError(f"expected a string without the character 0, got {scalar!r}")
    return scalar


def _hexadecimal(scalar: StartScalar) -> str:
    if not isinstance(scalar, str):
        raise ValueError(f"expected a string of hexadecimal digits, got {scalar!r}")
    try:
        bytes.fromhex(scalar)
    except ValueError:
        raise ValueError(
            f"expected hexadecimal digits, two for each byte, got {scalar!r}"
        ) from None
    return scalar


def _number(variable: Variable, scalar: StartScalar) -> float:
    """Return the value of a variable that is carried as a number."""
    if isinstance(scalar, str):
        item = _item(variable, scalar)
        if not is_exact(item):
            raise ValueError(f"item {scalar!r} is {item}, which no float64 represents exactly")
        return float(item)
    if variable.type == "Boolean":
        if scalar not in (0, 1):
            raise ValueError(f"expected true or false, got {scalar}")
        return float(scalar)
    if isinstance(scalar, bool):
        raise ValueError(f"expected a number, got {str(scalar).lower()}")
    if not math.isfinite(scalar):
        raise ValueError(f"expected a finite number, got {scalar}")
    if variable.signal_type == "integer":
        _check_integer(variable, scalar)
    if not variable.minimum <= scalar <= variable.maximum:
        raise ValueError(f"expected {variable.minimum} to {variable.maximum}, got {scalar}")
    return float(scalar)


def _item(variable: Variable, name: str) -> int:
    """Return the number of an enumeration's item."""
    if not variable.items:
        expected = "true or false" if variable.type == "Boolean" else "a number"
        raise ValueError(f"expected {expected}, got {name!r}")
    if name not in variable.items:
        raise ValueError(f"no item {name!r}; {nearest(name, variable.items)}")
    return variable.items[name]


def _check_integer(variable: Variable, scalar: float) -> None:
    """Refuse what a variable of an integer type cannot take, or float64 cannot carry."""
    if scalar != int(scalar):
        raise ValueError(f"expected an integer, got {scalar}")
    limits = np.iinfo(variable.type.lower())
    if not limits.min <= scalar <= limits.max:
        raise ValueError(f"expected {limits.min} to {limits.max} ({variable.type}), got {scalar}")
    if not is_exact(int(scalar)):
        raise ValueError(
            f"expected an integer that a float64 represents exactly, got {scalar}; nearest: "
            f"{int(float(scalar))}"
        )
    if variable.items and scalar not in variable.items.values():
        items = [f"{number} ({name})" for name, number in variable.items.items()]
        raise ValueError(f"expected one of: {', '.join(items)}; got {scalar}")
