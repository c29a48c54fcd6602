"""Read the clocks of FMI 3 and the variables that belong to them.

FMI 3.0 sections 2.2.9, 2.4.7.4 (the attribute clocks) and 2.4.7.5 (ClockType). Times are kept as
the fractions that the file writes: 0.1 s is a tenth of a second, and no float64.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from typing import Final, cast, get_args
from xml.etree.ElementTree import Element

from cosim.errors import quoted
from cosim.fmi.reading.markup import Attributes, flag
from cosim.fmi.variable import ClockTiming, IntervalVariability, Variable

VARIABILITIES: Final[tuple[str, ...]] = get_args(IntervalVariability)
PERIODIC: Final = ("constant", "fixed", "tunable")
LARGEST_EXPONENT: Final = 100  # of ten, of a time [s]


def read_timing(
    element: Element, declared: Element, attributes: Attributes, where: str
) -> ClockTiming | None:
    """Read when a clock ticks; None, with a problem: the file does not say it.

    Parameters
    ----------
    element : Element
        Of the variable.
    declared : Element
        Of its type, with the attributes that it takes where it has none of its own.
    attributes : Attributes
    where : str
        Names the variable.
    """
    merged = Element(element.tag, {**declared.attrib, **element.attrib})
    variability = merged.get("intervalVariability", "")
    if variability not in VARIABILITIES:
        expected = f"one of: {', '.join(VARIABILITIES)}"
        attributes.report(f"{where}: intervalVariability", quoted(variability), expected)
        return None
    interval = None
    shift = Fraction(0)
    if variability in PERIODIC:
        interval = _read_time(merged, "interval", attributes, where)
        shift = _read_time(merged, "shift", attributes, where) or Fraction(0)
    if interval is None and variability == "constant":
        attributes.problems.append(f"{where}: a constant clock needs the attribute intervalDecimal")
    if interval is not None and interval <= 0:
        attributes.report(f"{where}: interval", f"{float(interval)} s", "more than 0 s")
    if shift < 0:
        attributes.report(f"{where}: shift", f"{float(shift)} s", "0 s or more")
    return ClockTiming(
        variability=cast(IntervalVariability, variability),
        interval=interval,
        shift=shift,
        supports_fraction=flag(merged, "supportsFraction"),
    )


def _read_time(element: Element, name: str, attributes: Attributes, where: str) -> Fraction | None:
    """Read an interval or a shift [s]: a counter over the resolution, or a decimal number."""
    counter = attributes.integer(element, f"{name}Counter", where)
    if counter is not None:
        resolution = attributes.integer(element, "resolution", where)
        if resolution is not None and resolution > 0:
            return Fraction(counter, resolution)
        attributes.report(f"{where}: resolution", resolution, f"1 or more, with {name}Counter")
        return None
    text = element.get(f"{name}Decimal")
    if text is None:
        return None
    time = _decimal(text)
    if time is None:
        attributes.report(f"{where}: {name}Decimal", quoted(text), "a finite number")
    return time


def _decimal(text: str) -> Fraction | None:
    """Return the number that a text writes, exactly; None: it is none."""
    try:
        decimal = Decimal(text.strip())
    except InvalidOperation:
        return None
    if "_" in text or not decimal.is_finite() or abs(decimal.adjusted()) > LARGEST_EXPONENT:
        return None
    return Fraction(decimal)


def with_clocks(
    variables: Sequence[Variable], references: Mapping[int, Sequence[int]], attributes: Attributes
) -> list[Variable]:
    """Return the variables with the names of the clocks that they belong to.

    Parameters
    ----------
    variables : sequence of Variable
        Aliases stand behind all others.
    references : mapping of int to sequence of int
        The attribute ``clocks`` of the variables that have it, by their positions from 0.
    attributes : Attributes
    """
    if not references:
        return list(variables)
    clocks = {v.reference: v.name for v in reversed(variables) if v.type == "Clock"}
    names: dict[str, tuple[str, ...]] = {}
    for position, own_references in references.items():
        name = variables[position].name
        names[name] = tuple(clocks[own] for own in own_references if own in clocks)
        unknown = [str(own) for own in own_references if own not in clocks]
        if unknown:
            found = f"value reference {', '.join(unknown)}"
            attributes.report(f"variable {name!r}: clocks", found, "those of clocks")
    clocked = []
    for variable in variables:
        own_names = names.get(variable.alias_of or variable.name, ())
        clocked.append(replace(variable, clocks=own_names) if own_names else variable)
    return clocked
