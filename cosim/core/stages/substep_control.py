"""How the substeps of a loop are chosen; how they are taken: :mod:`cosim.core.stages.substeps`.

The parts of a communication step are those of a binary tree: part ``number`` of ``2**level``, with
ends rounded down to whole nanoseconds. So there are two lengths a level at most, all of them known
before the run, and what components compute for them is recorded like the rest of their designs.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector
from cosim.core.recording import Recording, Substep
from cosim.core.stages.member import Member
from cosim.errors import GraphError, LogError

SUBSTEP_COUNTS: Final = "substeps"  # result: how many each loop took
EASY: Final = 0.5  # of the tolerance: below it a part twice as long is tried


class Subinterval(NamedTuple):
    """Part ``number`` of the ``2**level`` parts of a communication step."""

    level: int
    number: int

    @property
    def halves(self) -> tuple[Subinterval, Subinterval]:
        """Its first and its second half."""
        first = 2 * self.number
        return Subinterval(self.level + 1, first), Subinterval(self.level + 1, first + 1)

    def begin_ns(self, step_ns: int) -> int:
        """Return where it begins in a communication step [ns]."""
        return self.number * step_ns >> self.level

    def end_ns(self, step_ns: int) -> int:
        """Return where it ends in a communication step [ns]."""
        return (self.number + 1) * step_ns >> self.level


@dataclass(frozen=True, slots=True)
class SubstepTolerance:
    """What the error of a substep may be, and how short one may become.

    Parameters
    ----------
    rtol : float
        Of the size of an output.
    atol : float
        In the unit of the output, times its nominal value; both are added.
    min_ns : int
        Shortest substep [ns].

    Raises
    ------
    GraphError
        If a tolerance is no finite number, 0 or more; if both are 0; or if the shortest substep is
        not at least 1 ns.
    """

    rtol: float = 1e-6
    atol: float = 1e-9
    min_ns: int = 1000

    def __post_init__(self) -> None:
        for name in ("rtol", "atol"):
            value = getattr(self, name)
            if not (isinstance(value, float) and 0.0 <= value < math.inf):
                raise GraphError(f"{name}: found {value!r}, needed a number, 0 or more")
        if self.rtol == self.atol == 0.0:
            raise GraphError("found rtol = atol = 0, needed one of them above 0")
        if type(self.min_ns) is not int or self.min_ns < 1:
            raise GraphError(
                f"min_ns: found {self.min_ns!r}, needed a whole number of nanoseconds, at least 1"
            )

    def finest_level(self, step_ns: int) -> int:
        """Return the last level whose parts are not shorter than the shortest substep.

        Raises
        ------
        GraphError
            If not even half a communication step is.
        """
        level = (step_ns // self.min_ns).bit_length() - 1
        if level < 1:
            raise GraphError(
                f"min: found {self.min_ns / 1e9} s, longer than half a step of {step_ns / 1e9} s; "
                f"needed at most {step_ns // 2 / 1e9} s"
            )
        return level

    def lengths(self, step_ns: int) -> tuple[float, ...]:
        """Return the lengths of all substeps that there may be [s], the longest first."""
        lengths: list[int] = []
        for level in range(1, self.finest_level(step_ns) + 1):
            shorter = step_ns >> level
            longer = -(-step_ns >> level)
            lengths += [longer, shorter] if longer > shorter else [shorter]
        return tuple(length / 1e9 for length in dict.fromkeys(lengths))


@dataclass(slots=True)
class SubstepCounts:
    """How many substeps a loop took.

    Parameters
    ----------
    components : tuple of str
        Of the loop.
    accepted, rejected : int
    missed : int
        Of the accepted ones: those that miss the tolerance, as they cannot be shorter.
    shortest_ns : int
        Of the accepted ones.
    worst_error : float
        Of the accepted ones, in units of what is tolerated.
    worst_ns : int
        Where that one begins.
    """

    components: tuple[str, ...]
    accepted: int = 0
    rejected: int = 0
    missed: int = 0
    shortest_ns: int = 0
    worst_error: float = 0.0
    worst_ns: int = 0

    def add(self, substep: Substep) -> None:
        """Count a substep."""
        if not substep.accepted:
            self.rejected += 1
            return
        self.accepted += 1
        if not self.shortest_ns or substep.length_ns < self.shortest_ns:
            self.shortest_ns = substep.length_ns
        if substep.error > 1.0:
            self.missed += 1
        if substep.error > self.worst_error:
            self.worst_error = substep.error
            self.worst_ns = substep.begin_ns


@dataclass(frozen=True, slots=True)
class OutsideColumns:
    """The columns of a row that drive a loop from outside.

    Between communication points those of ``linear`` are interpolated, those of ``start`` keep their
    values from the start of the step, those of ``end`` have them from its end. Those of ``jumping``
    have left limits at its end, in ``limits``.
    """

    linear: NDArray[np.intp]
    start: NDArray[np.intp]
    end: NDArray[np.intp]
    jumping: NDArray[np.intp]
    limits: NDArray[np.intp]


@final
class RecordedSubsteps:
    """The substeps of a loop in a recording, to be taken again.

    Parameters
    ----------
    recording : Recording
    members : sequence of Member
        The components of the loop.
    recorded : collection of component names
        Those that only have recorded values.

    Attributes
    ----------
    live : tuple of Member
        The components that take them again.
    copied : tuple of Member
        Those that do not.

    Raises
    ------
    LogError
        If substeps of the loop are missing, or have other values than its components.
    """

    def __init__(
        self, recording: Recording, members: Sequence[Member], recorded: Collection[str]
    ) -> None:
        self.live = tuple(member for member in members if member.name not in recorded)
        self.copied = tuple(member for member in members if member.name in recorded)
        loop = members[0].name
        self._substeps = [kept for kept in recording.substeps() if kept.loop == loop]
        self._begins = np.array([kept.begin_ns for kept in self._substeps], np.int64)
        accepted = [kept for kept in self._substeps if kept.accepted]
        begins = np.array([kept.begin_ns for kept in accepted], np.int64)
        lengths = np.array([kept.length_ns for kept in accepted], np.int64)
        ends = begins + lengths
        width = sum(member.columns.stop - member.columns.start for member in members)
        width += sum(len(m.jumps.own_limits) for m in members if m.jumps is not None)
        is_whole = (
            len(accepted) > 0
            and begins[0] == recording.time_ns(loop)[0]
            and bool((ends[:-1] == begins[1:]).all())
            and int(ends[-1]) >= recording.end_ns
            and all(len(kept.values) == width for kept in accepted)
        )
        if not is_whole:
            raise LogError(
                f"{recording.label}: the substeps of the loop of {loop!r} in /cosim/step are not "
                "whole; needed those of every communication step, to replay a loop of which some "
                "components are recorded"
            )

    def between(self, begin_ns: int, end_ns: int) -> list[Substep]:
        """Return the substeps that begin in a communication step."""
        first, last = np.searchsorted(self._begins, [begin_ns, end_ns])
        return self._substeps[first:last]


@final
class SubstepControl:
    """Chooses the substeps of a loop, and keeps them until they are recorded.

    Parameters
    ----------
    components : tuple of str
        Of the loop.
    tolerance : SubstepTolerance
    order : int
        Of the loop.
    outside : OutsideColumns
    compared : array of int
        The columns whose errors are estimated.
    nominal : Vector
        What size they usually have.

    Attributes
    ----------
    memory : Vector, shape (1,)
        The level of the next part: what it keeps from step to step.
    counts : SubstepCounts
    recorded : RecordedSubsteps or None
        Those to take; None: they are chosen.
    """

    def __init__(
        self,
        components: tuple[str, ...],
        tolerance: SubstepTolerance,
        order: int,
        *,
        outside: OutsideColumns,
        compared: NDArray[np.intp],
        nominal: Vector,
    ) -> None:
        self.components = components
        self.tolerance = tolerance
        self.order = order
        self.outside = outside
        self.compared = compared
        self._atol = tolerance.atol * nominal
        self.memory = np.zeros(1)
        self.recorded: RecordedSubsteps | None = None
        self.counts = SubstepCounts(self.components)
        self._substeps: list[Substep] = []

    def take(
        self, recording: Recording, members: Sequence[Member], recorded: Collection[str]
    ) -> None:
        """Take the substeps that a run has recorded from now on, with their values.

        Parameters
        ----------
        recording : Recording
        members : sequence of Member
            The components of the loop.
        recorded : collection of component names
            Those that only have recorded values.

        Raises
        ------
        LogError
            If substeps of the loop are missing.
        """
        self.recorded = RecordedSubsteps(recording, members, recorded)

    def reset(self) -> None:
        """Begin with whole communication steps."""
        self.memory[:] = 0.0
        self.counts = SubstepCounts(self.components)
        self._substeps.clear()

    def first(self) -> Subinterval:
        """Return the first part of a communication step."""
        return Subinterval(int(self.memory[0]), 0)

    def next(self, part: Subinterval, error: float) -> Subinterval | None:
        """Return the part behind one that was accepted; None: the communication step ends there."""
        level = part.level
        index = part.number + 1
        grows = error * 2.0 ** (self.order + 1) <= EASY
        if grows and level > 0 and index % 2 == 0:
            level -= 1
            index //= 2
        self.memory[0] = level
        return None if index == 2**level else Subinterval(level, index)

    def tolerated(self, size: Vector) -> Vector:
        """Return what the errors of the compared columns may be, for values of this size."""
        return self._atol + self.tolerance.rtol * size

    def can_refine(self, part: Subinterval, step_ns: int) -> bool:
        """Return whether the halves of a part may be halved."""
        return part.level + 2 <= self.tolerance.finest_level(step_ns)

    def add(self, substep: Substep) -> None:
        """Keep a substep."""
        self._substeps.append(substep)

    def forget_from(self, time_ns: int) -> None:
        """Forget the substeps from an instant [ns] on: they are taken again."""
        self._substeps = [kept for kept in self._substeps if kept.begin_ns < time_ns]

    def drain(self) -> list[Substep]:
        """Return the substeps since the last call."""
        substeps = self._substeps
        self._substeps = []
        for substep in substeps:
            self.counts.add(substep)
        return substeps
