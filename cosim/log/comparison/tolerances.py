"""Tolerances of a comparison: one for all signals, and others for some of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np

from cosim.core.recorded.selection import matches
from cosim.errors import UsageError, nearest, option


@final
@dataclass(frozen=True, slots=True)
class Tolerances:
    """The tolerances of a comparison.

    Parameters
    ----------
    atol : float
        In the unit of each signal.
    rtol : float
        As a part of each signal's largest |a|.
    own : mapping of name or pattern to float
        Instead of both for the signals that it matches; of several the last. 0: their bits are
        compared.

    Raises
    ------
    UsageError
        If one is not a finite number >= 0.
    """

    atol: float = 0.0
    rtol: float = 0.0
    own: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_tolerance(option("atol"), self.atol)
        _check_tolerance(option("rtol"), self.rtol)
        if not isinstance(self.own, Mapping):
            raise UsageError(
                f"{option('tol')}: expected a mapping such as {{'plant.y': 1e-6}}, got {self.own!r}"
            )
        for name, value in self.own.items():
            _check_tolerance(option("tol", name), value)

    def of(self, signal: str) -> tuple[float, float]:
        """Return the absolute and the relative tolerance of a signal."""
        chosen = [value for pattern, value in self.own.items() if matches(pattern, signal)]
        return (chosen[-1], 0.0) if chosen else (self.atol, self.rtol)

    def check_used(self, signals: Sequence[str]) -> None:
        """Check that every tolerance is of a signal that is compared.

        Raises
        ------
        UsageError
            If one is not; names the nearest signal.
        """
        for pattern in self.own:
            if not any(matches(pattern, signal) for signal in signals):
                raise UsageError(
                    f"{option('tol', pattern)}: no compared signal has this name; "
                    f"{nearest(pattern, signals)}"
                )


def _check_tolerance(name: str, value: object) -> None:
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not is_number or not 0.0 <= value < math.inf:  # type: ignore[operator]
        raise UsageError(f"{name}: expected a finite number >= 0, got {value!r}")
