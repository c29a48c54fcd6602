"""Compare two components, before one takes the other's place: port by port, then as a whole; and propose renamed ports.

A row holds one aspect of one port against the same aspect of the other side. Its verdict is "error" where the difference stops
the run, "differs" where it does not, "unknown" where one side does not say, and "ok".
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core.signals import Interface, Signal
from cosim.fmi.linearizing.linearization import poles, static_gain
from cosim.scenario.kinds.base import LinearSystem
from cosim.units import Conversion, conversion

Verdict: TypeAlias = Literal["ok", "unknown", "differs", "error"]
Causality: TypeAlias = Literal["input", "output"]
Pair: TypeAlias = tuple[
    str | None, str | None
]  # a port before and the one that takes its place; None: there is none

SAME = 1e-9  # relative difference of two numbers that are told to be different


@dataclass(frozen=True, slots=True)
class Ability:
    """What a component can do for who drives it; None: unknown.

    Parameters
    ----------
    kind : str
        ``"model exchange"``, ``"co-simulation"``, ``"recording"``, or the kind of a component of ours.
    rollback, variable_step, interpolation, directional_derivatives : bool or None
        Goes back to a saved state; takes steps of any length; inputs move inside a step; gives its Jacobians.
    """

    kind: str
    rollback: bool | None = None
    variable_step: bool | None = None
    interpolation: bool | None = None
    directional_derivatives: bool | None = None

    def items(self) -> list[tuple[str, Any]]:
        """Give (aspect, value)."""
        return [(name.replace("_", " "), getattr(self, name)) for name in self.__slots__]


@dataclass(frozen=True, slots=True)
class NearStart:
    """A component near its start.

    Parameters
    ----------
    poles : array of complex [1/s]
    gain : Matrix, shape (n_y, n_u), or None
        Static gain; None: A is singular.
    error : float
        Of the numbers; 0: rounding.
    """

    poles: NDArray[np.complex128]
    gain: Matrix | None
    error: float

    @staticmethod
    def of(system: LinearSystem) -> NearStart:
        """Return poles and static gain D - C A^-1 B."""
        A, B, C, D = system.A, system.B, system.C, system.D
        return NearStart(poles(A), static_gain(A, B, C, D, error=system.error), system.error)


@dataclass(frozen=True, slots=True)
class Side:
    """What is known of a component before it runs.

    Parameters
    ----------
    interface : Interface
    ability : Ability
    start : mapping of input name to Vector
        What it takes as long as nothing drives it; unknown where not named.
    initial : mapping of output name to Vector
        Outputs at the start for the scenario's inputs; unknown where not named.
    near_start : NearStart or None
        What it is near its start; None: it does not linearize.
    """

    interface: Interface
    ability: Ability
    start: Mapping[str, Vector] = field(default_factory=dict)
    initial: Mapping[str, Vector] = field(default_factory=dict)
    near_start: NearStart | None = None

    def port(self, name: str | None) -> ComparedPort | None:
        """Find a port, or one element of it; None: there is none."""
        if name is None:
            return None
        whole, element = _split(self.interface, name)
        for causality, signals in (
            ("input", self.interface.inputs),
            ("output", self.interface.outputs),
        ):
            for signal in signals:
                if signal.name == whole and (element is None or element < signal.size):
                    return ComparedPort(
                        self, signal, "input" if causality == "input" else "output", element
                    )
        return None

    @property
    def ports(self) -> list[str]:
        """Names of the inputs, then of the outputs."""
        return [signal.name for signal in (*self.interface.inputs, *self.interface.outputs)]


@dataclass(frozen=True, slots=True)
class ComparedPort:
    """A port of a side, or one element of it."""

    side: Side
    signal: Signal
    causality: Causality
    element: int | None = None

    @property
    def size(self) -> int:
        """Number of elements."""
        return self.signal.size if self.element is None else 1

    @property
    def start(self) -> list[float] | None:
        """Start value of an input; None: unknown."""
        return self._part(self.side.start.get(self.signal.name))

    @property
    def initial(self) -> list[float] | None:
        """First value of an output; None: unknown."""
        return self._part(self.side.initial.get(self.signal.name))

    @property
    def through(self) -> tuple[str, ...] | None:
        """What an output depends on directly, or which outputs depend so on an input; None: unknown."""
        face = self.side.interface
        if self.causality == "output":
            return face.feeds(self.signal.name) if face.knows(self.signal.name) else None
        if not all(face.knows(signal.name) for signal in face.outputs):
            return None
        return tuple(
            signal.name for signal in face.outputs if self.signal.name in face.feeds(signal.name)
        )

    @property
    def gains(self) -> list[float] | None:
        """Static gains to or from it, in rising order; None: unknown."""
        near, face = self.side.near_start, self.side.interface
        gain = None if near is None else near.gain
        if gain is None:
            return None
        columns = face.output_columns() if self.causality == "output" else face.input_columns()
        part = columns[self.signal.name]
        rows = range(part.start, part.stop) if self.element is None else [part.start + self.element]
        return sorted((gain if self.causality == "output" else gain.T)[rows].ravel().tolist())

    def _part(self, values: Vector | None) -> list[float] | None:
        if values is None:
            return None
        return [
            float(value)
            for value in (
                values if self.element is None else values[self.element : self.element + 1]
            )
        ]


@dataclass(frozen=True, slots=True)
class ComparedAspect:
    """One aspect of a port, or of the whole component where ``port`` is empty.

    Parameters
    ----------
    port : str
        Name before, and after ``->`` the name after where it is another.
    aspect : str
    before, after : plain value; None: unknown, or there is none
    verdict : Verdict
    connected : bool
        Whether the scenario connects the port.
    """

    port: str
    aspect: str
    before: Any
    after: Any
    verdict: Verdict
    connected: bool


@dataclass(frozen=True, slots=True)
class Proposal:
    """A port that may be the one that is missing, with the reasons."""

    port: str
    name: str
    reasons: tuple[str, ...]


def pairs_of(before: Side, after: Side, renamed: Collection[tuple[str, str]]) -> list[Pair]:
    """Pair the ports: those that a map renames, the others by name, then what is only in ``after``."""
    moved = {old for old, _ in renamed}
    found: list[Pair] = []
    for old in before.ports:
        names = [pair for pair in renamed if _split(before.interface, pair[0])[0] == old]
        found += names
        if old not in moved and not (names and after.port(old) is None):
            found.append((old, old if after.port(old) else None))
    used = {_split(after.interface, new)[0] for _, new in found if new is not None}
    return [*found, *((None, new) for new in after.ports if new not in used)]


def compare_sides(
    before: Side,
    after: Side,
    pairs: Sequence[Pair],
    *,
    connected: Collection[str] = (),
    refused: Collection[str] = (),
) -> tuple[ComparedAspect, ...]:
    """Hold ``after`` against ``before``.

    Parameters
    ----------
    before, after : Side
    pairs : sequence of Pair
    connected : collection of str
        Ports that the scenario connects, by their names in ``after``.
    refused : collection of str
        Those of them whose connection stops the run: only they can be errors.
    """
    names = {old: new for old, new in pairs if old is not None and new is not None}
    rows: list[ComparedAspect] = []
    for old, new in pairs:
        port = new or old or ""
        bad: Verdict = "error" if port in refused else "differs"
        shown = f"{old} -> {new}" if old and new and old != new else port
        sides = (before.port(old), after.port(new))
        rows += [
            ComparedAspect(shown, *found, port in connected)
            for found in _aspects(*sides, names, bad)
        ]
    return (*rows, *(ComparedAspect("", *found, True) for found in _whole(before, after)))


Aspect: TypeAlias = tuple[str, Any, Any, Verdict]


def _aspects(
    old: ComparedPort | None, new: ComparedPort | None, names: Mapping[str, str], bad: Verdict
) -> Iterator[Aspect]:
    if old is None or new is None:
        yield "causality", old and old.causality, new and new.causality, bad
        return
    yield "causality", old.causality, new.causality, "ok" if old.causality == new.causality else bad
    yield (
        "type",
        old.signal.kind,
        new.signal.kind,
        "ok" if old.signal.kind == new.signal.kind else "differs",
    )
    yield "size", old.size, new.size, "ok" if old.size == new.size else bad
    yield "unit", old.signal.unit, new.signal.unit, _unit(old.signal, new.signal, bad)
    varies = old.signal.variability, new.signal.variability
    yield "variability", *varies, "ok" if varies[0] == varies[1] else "differs"
    if old.causality != new.causality:
        return
    if old.causality == "input":
        yield (
            "start value",
            old.start,
            new.start,
            _numbers(old.start, _in_unit_of(old, new, new.start)),
        )
        return
    wanted = None if old.through is None else sorted(names.get(name, name) for name in old.through)
    found = None if new.through is None else sorted(new.through)
    known = ["unknown" if side is None else side for side in (wanted, found)]
    yield "feedthrough", known[0], known[1], "ok" if wanted == found else "differs"
    yield (
        "initial output",
        old.initial,
        new.initial,
        _numbers(old.initial, _in_unit_of(old, new, new.initial)),
    )
    if old.gains is not None or new.gains is not None:
        yield (
            "static gain",
            old.gains,
            new.gains,
            _numbers(old.gains, new.gains, _error(old.side, new.side)),
        )


def _whole(before: Side, after: Side) -> Iterator[Aspect]:
    for (aspect, old), (_, new) in zip(before.ability.items(), after.ability.items(), strict=True):
        yield (
            aspect,
            old,
            new,
            "ok" if old == new else "unknown" if None in (old, new) else "differs",
        )
    if before.near_start is not None or after.near_start is not None:
        poles = [
            None if near is None else near.poles.view(np.float64)
            for near in (before.near_start, after.near_start)
        ]
        yield (
            "poles",
            _pairs(poles[0]),
            _pairs(poles[1]),
            _numbers(poles[0], poles[1], _error(before, after)),
        )


def _error(*sides: Side) -> float:
    """How far numbers of linearized sides may be apart: ten times what their derivatives may be wrong by."""
    return max(
        SAME, *(10.0 * side.near_start.error for side in sides if side.near_start is not None)
    )


def _pairs(poles: Vector | None) -> list[list[float]] | None:
    return None if poles is None else poles.reshape(-1, 2).tolist()


def _unit(old: Signal, new: Signal, bad: Verdict) -> Verdict:
    if (old.unit is None) != (new.unit is None):
        return "unknown"
    found = _converts(old, new)
    return bad if found is None else "ok" if found.copies else "differs"


def _converts(old: Signal, new: Signal) -> Conversion | None:
    """Say how values of ``new`` become values in the unit of ``old``; None: they cannot."""
    return conversion(new.measure, old.measure)


def _in_unit_of(
    old: ComparedPort, new: ComparedPort, values: Sequence[float] | None
) -> Vector | None:
    convert = _converts(old.signal, new.signal)
    return (
        None
        if values is None
        else np.array(values)
        if convert is None
        else convert(np.array(values))
    )


def _numbers(
    old: Sequence[float] | Vector | None, new: Sequence[float] | Vector | None, error: float = SAME
) -> Verdict:
    if old is None or new is None:
        return "ok" if old is new else "unknown"
    return "ok" if _close(old, new, error) else "differs"


def _close(old: Sequence[float] | Vector, new: Sequence[float] | Vector, error: float) -> bool:
    if len(old) != len(new):
        return False
    a, b = np.array(old), np.array(new)
    scale = max(1.0, np.nanmax(np.abs(a), initial=0.0))
    return bool(np.allclose(a, b, rtol=0.0, atol=error * scale, equal_nan=True))


def _split(face: Interface, name: str) -> tuple[str, int | None]:
    """Take ``y[1]`` apart, unless that is the name of a port."""
    found = re.fullmatch(r"(.*)\[(\d+)\]", name)
    if found is None or name in (signal.name for signal in (*face.inputs, *face.outputs)):
        return name, None
    return found[1], int(found[2])


# --- renamed ports ---


def propose(
    before: Side, after: Side, pairs: Sequence[Pair], missing: Collection[str]
) -> tuple[Proposal, ...]:
    """Look among the unused ports of ``after`` for those that may be the ``missing`` ones; several where they are equally likely.

    A candidate has the causality, size and type of the missing port and a unit that can be its own. The likeliest agree in most
    of: declared unit, number of direct dependencies, initial output, static gains.
    """
    free = [new for old, new in pairs if old is None and new is not None]
    found: list[Proposal] = []
    for name in missing:
        old = before.port(name)
        if old is None:
            continue
        fitting = {
            new: _reasons(old, port)
            for new, port in _candidates(after, free, old)
            if _fits(old, port)
        }
        most = max(map(len, fitting.values()), default=0)
        found += [
            Proposal(name, new, reasons) for new, reasons in fitting.items() if len(reasons) == most
        ]
    return tuple(found)


def _candidates(
    after: Side, free: Sequence[str], old: ComparedPort
) -> Iterator[tuple[str, ComparedPort]]:
    for name in free:
        port = after.port(name)
        if port is None:
            continue
        yield name, port
        if port.causality == "output" and old.size == 1 < port.size:
            yield from (
                (f"{name}[{i}]", ComparedPort(after, port.signal, "output", i))
                for i in range(port.size)
            )


def _fits(old: ComparedPort, new: ComparedPort) -> bool:
    same = (old.causality, old.size, old.signal.kind) == (new.causality, new.size, new.signal.kind)
    return same and _converts(old.signal, new.signal) is not None


def _reasons(old: ComparedPort, new: ComparedPort) -> tuple[str, ...]:
    reasons = [f"{new.causality} of size {new.size}, {new.signal.kind}"]
    if old.signal.unit is not None and new.signal.unit is not None:
        reasons.append(f"unit {new.signal.unit!r}")
    if old.through is not None and new.through is not None and len(old.through) == len(new.through):
        reasons.append(
            f"feeds through {'from' if new.causality == 'output' else 'to'} {_some(new.through)}"
        )
    if (
        old.initial is not None
        and new.initial is not None
        and _numbers(old.initial, _in_unit_of(old, new, new.initial)) == "ok"
    ):
        reasons.append(f"initial output {_shown(new.initial)}")
    if old.gains and new.gains and _close(old.gains, new.gains, _error(old.side, new.side)):
        reasons.append(f"static gains {_shown(new.gains)}")
    return tuple(reasons)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) or "nothing"


def _shown(values: Sequence[float]) -> str:
    return " ".join(f"{value:.6g}" for value in values)
