"""The values of fields of messages, as float64."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

from cosim.arrays import NAN
from cosim.instants import NANOSECONDS
from cosim.log.foreign.field_path import FieldPath, FieldProblem


class StampNs(int):
    """A time or duration in ns, which is s as a value of a field."""


class EnumNumber(int):
    """The number of an enumeration: there is nothing between two of them."""


class Picker(Protocol):
    """Takes the values of some fields out of a message.

    Each is a number, a sequence of numbers, or None where the message has none.
    """

    def __call__(self, data: bytes) -> Sequence[Any]:
        """Return the values.

        Raises
        ------
        FieldProblem
            If a field is missing, or the message cannot be decoded.
        """
        ...


class MessageFormat(Protocol):
    """How the messages of a channel are decoded."""

    def fields(self, sample: bytes) -> dict[str, str]:
        """Return the types of the numeric fields by name; ``x[]`` may have any length.

        ``sample`` is a message of the channel; empty: there is none.
        """
        ...

    def picker(self, paths: Sequence[FieldPath]) -> Picker:
        """Return what takes fields out of messages.

        Raises
        ------
        FieldProblem
            If it is known without a message that one is missing, or no number.
        """
        ...


def numbers(value: Any) -> list[float]:
    """Return the value of a field as numbers; NaN: the message has none.

    Raises
    ------
    FieldProblem
        If it is not a number, infinite, or an integer that no float64 is.
    """
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [_number(item) for item in value]
    return [_number(value)]


def _number(value: Any) -> float:
    if value is None:
        return NAN
    if isinstance(value, StampNs):
        return value / NANOSECONDS
    if isinstance(value, int):  # bool, enumerations too
        return _exact(value)
    if not isinstance(value, float):
        raise FieldProblem(f"expected a number, got {_what(value)}")
    if value in (float("inf"), -float("inf")):
        raise FieldProblem(f"expected a finite number, got {value}")
    return value


def _exact(value: int) -> float:
    try:
        number = float(value)
    except OverflowError:
        number = NAN
    if number != value:
        raise FieldProblem(
            f"expected an integer that a float64 represents (up to 2**53), got {value}"
        )
    return number


def _what(value: Any) -> str:
    match value:
        case None:
            return "missing"
        case str():
            return "text"
        case bytes():
            return "bytes"
        case dict():
            return "an object of several fields"
        case list() | tuple():
            return "a list"
    return f"of type {type(value).__name__}"


def nanoseconds_in(value: Any, unit_ns: int) -> int:
    """Return a time that a message has in ns; a number counts units of ``unit_ns``.

    Raises
    ------
    FieldProblem
        If it is not a time.
    """
    if isinstance(value, StampNs):
        return int(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FieldProblem(f"expected a time, got {_what(value)}")
    if isinstance(value, int):
        return value * unit_ns
    if not abs(value * unit_ns) < 2**63:
        raise FieldProblem("expected a time, got a number that is not finite or too large")
    # apart: the product of both, of 19 digits, would be rounded to 16
    rest, whole = math.modf(value)
    return int(whole) * unit_ns + round(rest * unit_ns)
