"""The calls of FMI 3.0 for clocks (section 2.2.9)."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import byref, c_bool, c_double, c_int, c_size_t, c_uint, c_uint64, c_void_p
from decimal import Decimal
from fractions import Fraction
from typing import Final, final

from cosim.errors import RunError
from cosim.fmi.binary.library import Library
from cosim.fmi.instance import ClockInterval
from cosim.fmi.variable import Variable

NOT_YET_KNOWN: Final = 0  # fmi3IntervalNotYetKnown
CHANGED: Final = 2  # fmi3IntervalChanged


@final
class Fmi3Clocks:
    """Clocks of one instance; see :class:`cosim.fmi.instance.ClockCalls`.

    Parameters
    ----------
    library : Library
    with_fractions : bool
        Whether a clock gives its times as fractions.
    """

    def __init__(self, library: Library, *, with_fractions: bool) -> None:
        call = library.call
        references = (c_void_p, c_size_t)
        self._library = library
        self._set = call("SetClock", *references, c_void_p)
        self._get = call("GetClock", *references, c_void_p)
        self._interval = call("GetIntervalDecimal", *references, c_void_p, c_void_p)
        self._shift = call("GetShiftDecimal", *references, c_void_p)
        if with_fractions:
            numbers = (c_void_p, c_void_p)
            self._interval_fraction = call("GetIntervalFraction", *references, *numbers, c_void_p)
            self._shift_fraction = call("GetShiftFraction", *references, *numbers)

    def activate(self, clocks: Sequence[Variable]) -> None:
        """Activate input clocks, in event mode."""
        n = len(clocks)
        values = (c_bool * n)(*[True] * n)
        self._set(_references(clocks), n, values)

    def active(self, clocks: Sequence[Variable]) -> list[bool]:
        """Return which clocks are active, in event mode."""
        n = len(clocks)
        values = (c_bool * n)()
        self._get(_references(clocks), n, values)
        return list(values)

    def interval(self, clock: Variable) -> ClockInterval:
        """Return the interval of a clock, and whether it is known and changed."""
        reference = byref(c_uint(clock.reference))
        qualifier = c_int()
        if _has_fractions(clock):
            counter = c_uint64()
            resolution = c_uint64()
            numbers = (byref(counter), byref(resolution))
            self._interval_fraction(reference, 1, *numbers, byref(qualifier))
            if qualifier.value == NOT_YET_KNOWN:
                return ClockInterval(None, changed=False)
            interval = self._fraction(clock, "interval", counter.value, resolution.value)
        else:
            decimal = c_double()
            self._interval(reference, 1, byref(decimal), byref(qualifier))
            if qualifier.value == NOT_YET_KNOWN:
                return ClockInterval(None, changed=False)
            interval = self._decimal(clock, "interval", decimal.value)
        return ClockInterval(interval, changed=qualifier.value == CHANGED)

    def shift(self, clock: Variable) -> Fraction:
        """Return the time from the start of the run to the first tick of a clock [s]."""
        reference = byref(c_uint(clock.reference))
        if _has_fractions(clock):
            counter = c_uint64()
            resolution = c_uint64()
            self._shift_fraction(reference, 1, byref(counter), byref(resolution))
            return self._fraction(clock, "shift", counter.value, resolution.value)
        decimal = c_double()
        self._shift(reference, 1, byref(decimal))
        return self._decimal(clock, "shift", decimal.value)

    def _fraction(self, clock: Variable, what: str, counter: int, resolution: int) -> Fraction:
        if resolution == 0:
            raise RunError(
                f"{self._library.name}: {what} of clock {clock.name!r}: expected a resolution "
                "of at least 1, got 0"
            )
        return Fraction(counter, resolution)

    def _decimal(self, clock: Variable, what: str, value: float) -> Fraction:
        """Return the shortest decimal number that has this value, which the FMU meant."""
        decimal = Decimal(repr(value))
        if not decimal.is_finite():
            raise RunError(
                f"{self._library.name}: {what} of clock {clock.name!r}: expected a finite time, "
                f"got {value} s"
            )
        return Fraction(decimal)


def _references(clocks: Sequence[Variable]) -> object:
    return (c_uint * len(clocks))(*[clock.reference for clock in clocks])


def _has_fractions(clock: Variable) -> bool:
    return clock.timing is not None and clock.timing.supports_fraction
