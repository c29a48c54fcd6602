"""How two recorded runs differ: what a comparison of them returns."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final, Literal, TypeAlias

from cosim.log.comparison.event_difference import EventsDifference

DifferenceStatus: TypeAlias = Literal[
    "equal",
    "within",
    "outside",
    "other times",
    "other size",
    "only in a",
    "only in b",
    "not recorded in a",
    "not recorded in b",
]
# what a partial log does not have says nothing about its run
LEFT_OUT: Final = frozenset({"not recorded in a", "not recorded in b"})
NOT_COMPARED: Final = LEFT_OUT | {"other size", "only in a", "only in b"}


@dataclass(frozen=True, slots=True)
class ElementDifference:
    """One element of one signal at one instant of both runs."""

    signal: str  # component.signal, with the element's index
    time_ns: int
    a: float
    b: float

    @property
    def differing_bits(self) -> int:
        """How many of the 64 bits of the two values differ."""
        return (_bit_pattern(self.a) ^ _bit_pattern(self.b)).bit_count()

    @property
    def texts(self) -> tuple[str, str]:
        """Both values as texts that give their bits back: as Python writes them, NaN with these."""
        return _exact_text(self.a), _exact_text(self.b)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON values; the bits are those of both values, hexadecimal."""
        bits = [f"0x{_bit_pattern(value):016x}" for value in (self.a, self.b)]
        return {**asdict(self), "bits": bits, "differing_bits": self.differing_bits}


def _bit_pattern(value: float) -> int:
    """Return the 64 bits of a number as an integer."""
    (pattern,) = struct.unpack("<Q", struct.pack("<d", value))
    return int(pattern)


def _exact_text(value: float) -> str:
    # all NaN look the same, and differ in up to 52 bits
    return f"nan (0x{_bit_pattern(value):016x})" if math.isnan(value) else repr(value)


@dataclass(frozen=True, slots=True)
class SignalDifference:
    """How one signal compares.

    Parameters
    ----------
    signal : str
        ``component.signal``.
    status : str
        ``equal``: the same bits at the same times; ``within`` or ``outside`` the tolerance;
        ``other times``: within it where both have values, but their instants differ;
        ``other size``, ``only in a``, ``only in b``: not compared; ``not recorded in a`` or
        ``b``: neither, as that log is partial, which is no difference.
    rows : tuple of int
        Numbers of rows in a and in b, and at times they share.
    largest : float
        Largest |a - b|; infinite where only one is NaN or infinite.
    scale : float
        Largest finite |a|.
    tolerance : float
        What |a - b| was compared with.
    first : ElementDifference or None
        The first time outside the tolerance.
    """

    signal: str
    status: DifferenceStatus
    rows: tuple[int, int, int]
    largest: float = 0.0
    scale: float = 0.0
    tolerance: float = 0.0
    first: ElementDifference | None = None

    @property
    def ratio(self) -> float:
        """``largest`` as a part of ``scale``."""
        if self.largest == 0.0:
            return 0.0
        return self.largest / self.scale if self.scale else float("inf")


@dataclass(frozen=True, slots=True)
class LogDifference:
    """How two runs compare, signal by signal.

    Parameters
    ----------
    rows : tuple of SignalDifference
        The signals of a in their order, then those that only b has.
    atol, rtol : float
        The tolerances of :func:`diff`.
    events : EventsDifference
        How the jumps compare.
    tol : mapping of name or pattern to float
        The signals' own tolerances.
    """

    rows: tuple[SignalDifference, ...]
    atol: float
    rtol: float
    events: EventsDifference
    tol: Mapping[str, float] = field(default_factory=dict)

    @property
    def equal(self) -> bool:
        """Whether all signals have the same bits at the same times, and the same events."""
        return self.same_rows and self.events.equal

    @property
    def same_rows(self) -> bool:
        """Whether all signals have the same bits at the same times."""
        return all(row.status == "equal" for row in self._compared)

    @property
    def _compared(self) -> list[SignalDifference]:
        return [row for row in self.rows if row.status not in LEFT_OUT]

    @property
    def within(self) -> bool:
        """Whether both runs have all signals and events at the same times, within the tolerance."""
        same_rows = all(row.status in {"equal", "within"} for row in self._compared)
        return same_rows and not self.events.outside

    @property
    def first(self) -> ElementDifference | None:
        """The earliest time outside the tolerance; of several signals, the first row's."""
        candidates = [row.first for row in self.rows if row.first]
        return min(candidates, key=lambda element: element.time_ns, default=None)

    @property
    def worst(self) -> SignalDifference | None:
        """The signal that is farthest apart, measured by its tolerance; None: none is apart.

        Of those without a tolerance it is the one that is farthest apart as a part of its scale.
        """
        apart = [row for row in self.rows if row.largest > 0.0]
        return max(apart, key=_badness, default=None)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        first = self.first
        signals = []
        for row in self.rows:
            own = None if row.first is None else row.first.to_dict()
            signals.append({**asdict(row), "first": own, "ratio": row.ratio})
        return {
            "equal": self.equal,
            "within": self.within,
            "atol": self.atol,
            "rtol": self.rtol,
            "tol": dict(self.tol),
            "first": None if first is None else first.to_dict(),
            "signals": signals,
            "events": asdict(self.events),
        }


def _badness(row: SignalDifference) -> tuple[bool, float, float]:
    """Return what orders signals by how far they are apart."""
    is_outside = row.status == "outside"
    excess = row.largest / row.tolerance if row.tolerance else math.inf
    return is_outside, excess, row.ratio
