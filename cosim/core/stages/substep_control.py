"""How the substeps of a loop are chosen; how they are taken: :mod:`cosim.core.stages.substeps`."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector
from cosim.core.recording import Recording, Substep
from cosim.core.stages.divided_step import OutsideColumns
from cosim.core.stages.member import Member
from cosim.core.stages.spans import Span, StepPart
from cosim.documents import STRICT
from cosim.errors import GraphError, LogError
from cosim.instants import NANOSECONDS, StepNs, step_value

SUBSTEP_COUNTS: Final = "substeps"  # result: how many each loop took
EASY: Final = 0.5  # of the tolerance: below it a part twice as long is tried


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
                raise GraphError(f"{name}: expected a number >= 0, got {value!r}")
        if self.rtol == self.atol == 0.0:
            raise GraphError("expected rtol > 0 or atol > 0, got rtol = atol = 0")
        if type(self.min_ns) is not int or self.min_ns < 1:
            raise GraphError(f"min_ns: expected an integer >= 1 [ns], got {self.min_ns!r}")

    def finest_level(self, step_ns: StepNs) -> int:
        """Return the last level whose parts are not shorter than the shortest substep.

        Raises
        ------
        GraphError
            If not even half a communication step is.
        """
        if isinstance(step_ns, Fraction):
            raise GraphError(
                "substeps: expected a step of whole nanoseconds, which their parts are, too; got "
                f"{step_value(step_ns)} s"
            )
        level = (step_ns // self.min_ns).bit_length() - 1
        if level < 1:
            shortest = self.min_ns / NANOSECONDS
            step = step_ns / NANOSECONDS
            raise GraphError(
                f"min: expected at most {step_ns // 2 / NANOSECONDS} s, half the step of {step} "
                f"s, got {shortest} s"
            )
        return level

    def lengths(self, step_ns: StepNs) -> tuple[float, ...]:
        """Return the lengths of all substeps that there may be [s], the longest first."""
        lengths: list[int] = []
        finest = self.finest_level(step_ns)
        assert isinstance(step_ns, int)
        for level in range(1, finest + 1):
            shorter = step_ns >> level
            longer = -(-step_ns >> level)
            lengths += [longer, shorter] if longer > shorter else [shorter]
        return tuple(length / NANOSECONDS for length in dict.fromkeys(lengths))


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
    events : int
        Of the accepted ones: those that an event ends.
    shortest : float
        Of the accepted ones, but for those that an event begins or ends [s].
    worst_error : float
        Of the accepted ones, in units of what is tolerated.
    worst_time : float
        Where that one begins [s].
    """

    __pydantic_config__ = STRICT

    components: tuple[str, ...]
    accepted: int = 0
    rejected: int = 0
    missed: int = 0
    events: int = 0
    shortest: float = 0.0
    worst_error: float = 0.0
    worst_time: float = 0.0

    def add(self, substep: Substep, *, begins_at_event: bool = False) -> None:
        """Count a substep."""
        if not substep.accepted:
            self.rejected += 1
            return
        self.accepted += 1
        self.events += bool(substep.event)
        is_chosen = not (substep.event or begins_at_event)
        if is_chosen and not 0.0 < self.shortest <= substep.length:
            self.shortest = substep.length
        if substep.error is None:
            return
        if substep.error > 1.0:
            self.missed += 1
        if substep.error > self.worst_error:
            self.worst_error = substep.error
            self.worst_time = substep.begin


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
        self._begins = np.array([kept.begin for kept in self._substeps])
        accepted = [kept for kept in self._substeps if kept.accepted]
        begins = np.array([kept.begin for kept in accepted])
        ends = np.array([kept.end for kept in accepted])
        width = sum(member.columns.stop - member.columns.start for member in members)
        width += sum(len(m.jumps.own_limits) for m in members if m.jumps is not None)
        is_whole = (
            len(accepted) > 0
            and begins[0] == recording.time_ns(loop)[0] / NANOSECONDS
            and bool((ends[:-1] == begins[1:]).all())
            and ends[-1] >= recording.end_ns / NANOSECONDS
            and all(len(kept.values) == width for kept in accepted)
        )
        if not is_whole:
            raise LogError(
                f"{recording.label}: the substeps of the loop of {loop!r} in /cosim/step are "
                "incomplete; a replay of a loop with recorded components requires those of every "
                "communication step"
            )

    def between(self, begin: float, end: float) -> list[Substep]:
        """Return the substeps that begin in a communication step, between two times [s]."""
        first, last = np.searchsorted(self._begins, [begin, end])
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
        self._last_event = -math.inf

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
        """Forget everything, and begin with whole communication steps."""
        self.memory[:] = 0.0
        self.counts = SubstepCounts(self.components)
        self._substeps.clear()
        self._last_event = -math.inf

    def first(self, step: Span) -> StepPart:
        """Return the first part of a communication step."""
        return StepPart(step, int(self.memory[0]), 0)

    def next(self, part: StepPart, error: float | None) -> list[StepPart]:
        """Return the part behind another one; none where the span ends there.

        Parameters
        ----------
        part : StepPart
        error : float or None
            Of the latter, in units of what is tolerated; None: there is no estimate.
        """
        level = part.level
        is_easy = error is not None and error * 2.0 ** (self.order + 1) <= EASY
        if is_easy and part.ends_a_longer_one:
            level -= 1
        if part.span.is_step:
            self.memory[0] = level
        following = part.following(level)
        return [] if following is None else [following]

    def tolerated(self, size: Vector) -> Vector:
        """Return what the errors of the compared columns may be, for values of this size."""
        return self._atol + self.tolerance.rtol * size

    def can_refine(self, part: StepPart) -> bool:
        """Return whether the halves of a part may be halved."""
        span = part.span
        return (span.last_ns - span.first_ns) >> (part.level + 2) >= self.tolerance.min_ns

    def add(self, substep: Substep) -> None:
        """Keep a substep."""
        self._substeps.append(substep)

    def forget_from(self, time_ns: int) -> None:
        """Forget the substeps from an instant [ns] on: they are taken again."""
        self._substeps = [kept for kept in self._substeps if kept.begin_ns < time_ns]

    def drain(self, end_ns: int) -> list[Substep]:
        """Return the substeps since the last call, up to an instant [ns], and count them."""
        substeps = [kept for kept in self._substeps if kept.begin_ns < end_ns]
        self._substeps = [kept for kept in self._substeps if kept.begin_ns >= end_ns]
        for substep in substeps:
            self.counts.add(substep, begins_at_event=substep.begin == self._last_event)
            if substep.accepted and substep.event:
                self._last_event = substep.end
        return substeps
