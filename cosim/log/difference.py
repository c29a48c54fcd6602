"""How two recorded runs differ: what a comparison of them returns."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final, Literal, NamedTuple, TypeAlias

from cosim.core.recording import EventCause

OF_COMPONENTS: Final = ("set", "swap")  # causes of events that name no signal

DifferenceStatus: TypeAlias = Literal[
    "equal",
    "within",
    "outside",
    "other times",
    "other size",
    "other unit",
    "only in a",
    "only in b",
    "not recorded in a",
    "not recorded in b",
    "not read",
]
# what a partial log does not have says nothing about its run
LEFT_OUT: Final = frozenset({"not recorded in a", "not recorded in b"})


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
        return (bit_pattern(self.a) ^ bit_pattern(self.b)).bit_count()

    @property
    def texts(self) -> tuple[str, str]:
        """Both values as texts that give their bits back: as Python writes them, NaN with these."""
        return _exact_text(self.a), _exact_text(self.b)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON values; the bits are those of both values, hexadecimal."""
        bits = [f"0x{bit_pattern(value):016x}" for value in (self.a, self.b)]
        return {**asdict(self), "bits": bits, "differing_bits": self.differing_bits}


def bit_pattern(value: float) -> int:
    """Return the 64 bits of a number as an integer."""
    return int.from_bytes(struct.pack("<d", value), "little")


def _exact_text(value: float) -> str:
    # all NaN look the same, and differ in up to 52 bits
    return f"nan (0x{bit_pattern(value):016x})" if math.isnan(value) else repr(value)


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
        ``other size``, ``other unit``, ``only in a``, ``only in b``: not compared; ``not recorded
        in a`` or ``b``: neither, as that log is partial, which is no difference; ``not read``:
        neither, as a file of another tool has it in a form that cannot be read.
    rows : tuple of int
        Numbers of rows in a and in b, and of those that were compared.
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
        return self.largest / self.scale if self.scale else math.inf


class ElementEvent(NamedTuple):
    """Why an element jumped, and where to."""

    cause: EventCause
    value: float


@dataclass(frozen=True, slots=True)
class ElementEventDifference:
    """An element that jumps otherwise in one run than in the other.

    Parameters
    ----------
    signal : str
        ``component.signal``, with the element's index.
    time_ns : int
    a, b : ElementEvent or None
        None: it does not jump there.
    """

    signal: str
    time_ns: int
    a: ElementEvent | None
    b: ElementEvent | None


@dataclass(frozen=True, slots=True)
class EventsDifference:
    """How the events of two runs compare.

    Parameters
    ----------
    events : tuple of int
        Numbers of events of the compared signals in a and in b.
    jumps : int
        Elements that jump, at the instants where they do, in one run or both.
    outside : int
        Those of them that jump in one run only, for another cause, or to a value outside the
        tolerance of their signals.
    equal : bool
        Whether all have the same causes and the same bits.
    first : ElementEventDifference or None
        The first of those outside.
    """

    events: tuple[int, int] = (0, 0)
    jumps: int = 0
    outside: int = 0
    equal: bool = True
    first: ElementEventDifference | None = None


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
    map : mapping of name to name
        The signals of b that have another name than those of a that they are compared with.
    tube : float or None
        Half its width [s], 0: none, where b was interpolated; None: it was not.
    not_compared : tuple of str
        What was not, and why: where one run has rows and the other none, what could not be read,
        events of a run and a file that has none.
    """

    rows: tuple[SignalDifference, ...]
    atol: float
    rtol: float
    events: EventsDifference
    tol: Mapping[str, float] = field(default_factory=dict)
    map: Mapping[str, str] = field(default_factory=dict)
    tube: float | None = None
    not_compared: tuple[str, ...] = ()

    @property
    def equal(self) -> bool:
        """Whether all signals have the same bits at the same times, and the same events."""
        return self.same_rows and self.events.equal

    @property
    def same_rows(self) -> bool:
        """Whether all signals have the same bits at the same times."""
        return self._all("equal")

    @property
    def within(self) -> bool:
        """Whether both runs have all signals and events at the same times, within the tolerance."""
        return self._all("equal", "within") and not self.events.outside

    def _all(self, *statuses: DifferenceStatus) -> bool:
        return all(row.status in statuses for row in self.rows if row.status not in LEFT_OUT)

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
        """Return everything as JSON values; what was not asked for has no key."""
        first = self.first
        signals = []
        for row in self.rows:
            own = None if row.first is None else row.first.to_dict()
            signals.append({**asdict(row), "first": own, "ratio": row.ratio})
        asked: dict[str, Any] = {"map": dict(self.map)} if self.map else {}
        if self.tube is not None:
            asked |= {"interpolate": True, "tube": self.tube}
        if self.not_compared:
            asked["not_compared"] = list(self.not_compared)
        return {
            "equal": self.equal,
            "within": self.within,
            "atol": self.atol,
            "rtol": self.rtol,
            "tol": dict(self.tol),
            "first": None if first is None else first.to_dict(),
            "signals": signals,
            "events": asdict(self.events),
            **asked,
        }


def _badness(row: SignalDifference) -> tuple[bool, float, float]:
    """Return what orders signals by how far they are apart."""
    excess = row.largest / row.tolerance if row.tolerance else math.inf
    return row.status == "outside", excess, row.ratio
