"""How the components of one stage advance over a block.

A cascade is one component: one call. The components of a loop advance step by step, by operations
whose order is fixed before the run (:mod:`cosim.core.structure.order`). At each step the input of a
component from one that has not reached the end of the step yet is *extrapolated*: it keeps its
value from the start of the step (first order). Outputs that feed through from it are evaluated
again as soon as it is known.

Components that advance together (Jacobi) take their inputs before any of them advances, whatever
the order of their names (:mod:`cosim.core.stages.torn_inputs`).

A loop that iterates extrapolates nothing: the inputs at which it is torn are unknowns. Its
components advance with what is tried for these, go back, and advance again, until it is what their
sources give (:mod:`cosim.core.stages.torn_inputs`). Every input then follows its source through the
step (second order), and an algebraic loop is solved with it. The row keeps what the components were
given, which is as far from the outputs of the sources as the residual.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector, read_only
from cosim.core.contracts import Block, Stopped
from cosim.core.stages.member import Member, NonFinite, driving_groups, first_non_finite
from cosim.core.stages.torn_inputs import END, KeptInputs, TornInputs
from cosim.core.structure.order import OperationKind
from cosim.errors import RunError
from cosim.native.stages.loop_solver import SOLVED, SWEEP

OperationName: TypeAlias = Literal[
    "keep",
    "gather",
    "advance",
    "refresh",
    "check",
    "save",
    "begin",
    "restore",
    "solve",
    "gather together",
    "advance together",
    "record",
]
ProgramOperation: TypeAlias = tuple[OperationName, tuple[Member, ...]]
StageProgram: TypeAlias = tuple[ProgramOperation, ...]


class Cut(Exception):
    """A stage came to an end before the end of its block.

    Parameters
    ----------
    steps : int
        Communication steps that all of its components have completed.
    error : RunError
        What ended it, with component and time.
    component : str
        A component of the stage that it ended in.
    """

    def __init__(self, steps: int, error: RunError, component: str) -> None:
        super().__init__(str(error))
        self.steps = steps
        self.error = error
        self.component = component


class Advancing(Protocol):
    """Advances components over a block."""

    def advance(self, block: Block, signals: Matrix) -> None:
        """Fill rows 1 to K of their columns.

        Raises
        ------
        Cut
            With the number of rows that are filled; also before the first value that is not finite.
        """
        ...


class Stage(Advancing, Protocol):
    """The components that belong together: one outside every loop, or those of a loop."""

    @property
    def members(self) -> tuple[Member, ...]:
        """The components of the stage."""
        ...

    @property
    def extrapolated(self) -> Mapping[str, frozenset[str]]:
        """Inputs by component that are known only after the component has advanced."""
        ...

    @property
    def warnings(self) -> tuple[tuple[str, str], ...]:
        """What was assumed, as (component, text)."""
        ...

    @property
    def is_first_order(self) -> bool:
        """Whether its error is one of first order in the communication step, or may be."""
        ...

    @property
    def description(self) -> str:
        """The components and the order of their operations, for the log."""
        ...

    @property
    def coupling(self) -> str:
        """How its components are coupled; empty for one outside every loop."""
        ...

    @property
    def order(self) -> tuple[tuple[OperationKind, str], ...]:
        """The operations of a step in their order, by the names of their components."""
        ...

    @property
    def program(self) -> StageProgram:
        """What ``advance`` does at every step, for compiled code."""
        ...

    @property
    def is_loop(self) -> bool:
        """Whether its components advance step by step."""
        ...

    @property
    def torn(self) -> TornInputs | None:
        """The unknowns that it solves for; None: it does not iterate."""
        ...

    @property
    def kept(self) -> KeptInputs | None:
        """The inputs of components that advance together; None: they do not."""
        ...


@dataclass(frozen=True, slots=True)
class Cascade:
    """One component outside every loop."""

    member: Member
    extrapolated: Mapping[str, frozenset[str]] = field(default_factory=dict)
    warnings: tuple[tuple[str, str], ...] = ()
    is_first_order: bool = False
    is_loop: bool = False
    torn: None = None
    kept: None = None
    coupling: str = ""

    @property
    def members(self) -> tuple[Member, ...]:
        """The component."""
        return (self.member,)

    @property
    def description(self) -> str:
        """The component, for the log."""
        return f"cascade {self.member.name}"

    @property
    def order(self) -> tuple[tuple[OperationKind, str], ...]:
        """It advances."""
        return (("advance", self.member.name),)

    @property
    def program(self) -> StageProgram:
        """Advance, look at the row."""
        return ("advance", self.members), ("check", self.members)

    def advance(self, block: Block, signals: Matrix) -> None:
        """Advance the whole block in one call; by steps where an input jumps between them."""
        # Row 0 is the last row of the block before: its inputs are there.
        self.member.gather(signals, slice(1, None))
        if not self.member.takes_latest:
            self._advance(block, signals)
            return
        for k in range(block.steps):
            try:
                self._advance(block.part(k, k + 1), signals[k : k + 2])
            except Cut as cut:
                raise Cut(k + cut.steps, cut.error, cut.component) from cut

    def _advance(self, block: Block, signals: Matrix) -> None:
        member = self.member
        u = member.inputs_over(read_only(signals))
        try:
            signals[1:, member.outputs] = member.component.advance(block.time, block.h, u)
        except RunError as error:
            stop = _stop_of(error, member, block.time)
            if stop.steps:
                signals[1 : stop.steps + 1, member.outputs] = stop.outputs
            check_finite(self.members, block.part(0, stop.steps), signals)
            raise Cut(stop.steps, stop, member.name) from error
        check_finite(self.members, block, signals)


@dataclass(frozen=True, slots=True)
class Loop:
    """Components of a cycle of the graph, advanced step by step in a fixed order of operations.

    ``broken`` connections are extrapolated; ``kept``: the inputs of components that advance
    together; ``lags``: inputs hold their values over a step, or outputs belong to inputs inside it.
    """

    coupling: str
    members: tuple[Member, ...]
    operations: tuple[tuple[OperationKind, Member], ...]
    extrapolated: Mapping[str, frozenset[str]]
    broken: int
    warnings: tuple[tuple[str, str], ...]
    torn: TornInputs | None
    kept: KeptInputs | None
    lags: bool
    is_loop: bool = True

    @property
    def is_first_order(self) -> bool:
        """Whether an input or an output lags behind by a part of a step, or may."""
        is_cut_short = self.torn is not None and self.torn.solver.iterations > 0
        return bool(self.broken or self.warnings or self.lags or is_cut_short)

    @property
    def description(self) -> str:
        """The operations in order, for the log.

        In parentheses: outputs are evaluated again; in brackets: inputs that are solved for.
        """
        words = [self.coupling]
        for kind, member in self.operations:
            words.append(member.name if kind == "advance" else f"({member.name})")
        if self.torn is not None:
            words.append(f"[{', '.join(self.torn.labels)}]")
            iterations = self.torn.solver.iterations
            if iterations:
                words.append(f"({iterations} iterations)")
        if not self.is_first_order:
            words.append("(second order)")
        return " ".join(words)

    @property
    def order(self) -> tuple[tuple[OperationKind, str], ...]:
        """The operations of a sweep in their order, by the names of their components."""
        return tuple((kind, member.name) for kind, member in self.operations)

    @property
    def program(self) -> StageProgram:
        """What :meth:`_solve` does, without copies that nothing reads or that change nothing."""
        check: ProgramOperation = ("check", self.members)
        if self.kept is not None:
            return (*self._sweep_together_program, check)
        if self.torn is None:
            return (*self._sweep_program, check)
        program: list[ProgramOperation] = []
        for member in self.members:
            program.append(("save", (member,)))
            if self.torn.solver.iterations:  # the first sweep takes what the outputs are so far
                program.append(("keep", (member,)))
        program.append(("begin", self.members))
        program += [("restore", (member,)) for member in self.members]
        return (*program, *self._sweep_program, ("solve", self.members), check)

    @property
    def _sweep_program(self) -> StageProgram:
        """What :meth:`_sweep` does."""
        sources = self._sources()
        read_early: set[str] = set()
        gathered: dict[str, int] = {}  # number of the last operation
        written: dict[str, int] = {}
        for number, (_, member) in enumerate(self.operations):
            read_early |= sources[member.name] - written.keys()
            gathered[member.name] = number
            written[member.name] = number
        program: list[ProgramOperation] = []
        for member in self.members:
            if member.name in read_early:
                program.append(("keep", (member,)))
        for kind, member in self.operations:
            program.append((kind, (member,)))
        for member in self.members:
            last = gathered[member.name]
            if any(written[source] >= last for source in sources[member.name]):
                program.append(("gather", (member,)))
        return tuple(program)

    @property
    def _sweep_together_program(self) -> StageProgram:
        """What :meth:`_sweep` does where components advance together."""
        program: list[ProgramOperation] = [("keep", (member,)) for member in self.members]
        program.append(("gather together", self.members))
        for kind, member in self.operations:
            program.append((kind if kind == "refresh" else "advance together", (member,)))
        program.append(("record", self.members))
        return tuple(program)

    def _sources(self) -> dict[str, set[str]]:
        """Return the components of the loop that drive each of them."""
        drivers = driving_groups([(member,) for member in self.members])
        sources: dict[str, set[str]] = {}
        for member, driving in zip(self.members, drivers, strict=True):
            sources[member.name] = {self.members[number].name for number in driving}
        return sources

    def advance(self, block: Block, signals: Matrix) -> None:
        """Advance step by step."""
        try:
            self._advance(block, signals)
        except Cut as cut:
            check_finite(self.members, block.part(0, cut.steps), signals)
            raise
        check_finite(self.members, block, signals)

    def _advance(self, block: Block, signals: Matrix) -> None:
        known = read_only(signals)
        columns = np.concatenate([_numbers(member.columns) for member in self.members])
        for k in range(block.steps):
            step = slice(k, k + 2)
            results: list[tuple[Member, Vector]] = []
            rows = signals[step]
            stop = self._solve(block.time[step], block.h, rows, known[step], results)
            values = signals[k + 1, columns]
            if stop is not None or not math.isfinite(values.dot(values)):  # of all at once, in time
                origin = _origin(results)
                if origin is not None and not math.isfinite(signals[k + 1, origin.column]):
                    error = origin.error(float(block.time[k + 1]))
                    raise Cut(k, error, self.members[0].name)
            if stop is not None:
                raise Cut(k + stop.steps, stop, self.members[0].name)

    def _solve(
        self,
        time: Vector,
        h: float,
        rows: Matrix,
        known: Matrix,
        results: list[tuple[Member, Vector]],
    ) -> Stopped | None:
        """Sweep until the torn inputs are what their sources give; return as the last sweep did.

        Where no solution is found, that stops it.
        """
        if self.torn is None:
            return self._sweep(time, h, rows, known, results)
        states = [(member, member.component.save()) for member in self.members]
        if self.torn.solver.iterations:  # the first sweep takes what the outputs are so far
            self._keep(rows)
        self.torn.begin(float(time[1]), rows)
        while True:
            results.clear()
            stop = self._sweep(time, h, rows, known, results)
            if stop is not None and not stop.steps:
                return stop
            status = self.torn.next(rows)
            if status == SOLVED:
                return stop
            if status != SWEEP:
                return self.torn.stop(status, float(time[1]))
            for member, state in states:
                member.component.restore(state)

    def _sweep(
        self,
        time: Vector,
        h: float,
        rows: Matrix,
        known: Matrix,
        results: list[tuple[Member, Vector]],
    ) -> Stopped | None:
        """Fill row 1; return what stopped it, with a row of outputs if the step is complete.

        ``known`` shows the same rows to the components, which cannot write to it. What each returns
        is appended to ``results``.
        """
        stopped: Stopped | None = None
        self._keep(rows)
        if self.kept is not None:
            self.kept.gather(rows)
        for kind, member in self.operations:
            if self.kept is None or kind == "refresh":
                self._gather(member, rows)
            try:
                y = call(kind, member, time, h, member.inputs_over(known))
            except Stopped as stop:
                stopped = stop
                if not stopped.steps:
                    return stopped
                y = stopped.outputs[0]
            rows[1, member.outputs] = y
            results.append((member, y))
        # What is recorded as applied at the end of the step is what the sources gave there at last.
        for member in self.members:
            member.gather(rows, END)
            if self.torn is not None:  # they were given what was tried, not what the sources gave
                self.torn.put(rows, member)
        return stopped

    def _keep(self, rows: Matrix) -> None:
        """Extrapolated inputs read row 1 before their source has written it: first, it is row 0."""
        for member in self.members:
            rows[1, member.outputs] = rows[0, member.outputs]

    def _gather(self, member: Member, rows: Matrix) -> None:
        """Bring the inputs of a component at the end of the step up to date."""
        member.gather(rows, END)
        if self.torn is not None:
            self.torn.put(rows, member)
        if self.kept is not None:
            self.kept.put(rows, member)


def call(kind: OperationName, member: Member, time: Vector, h: float, u: Matrix) -> Vector:
    """Advance a component over one step, or evaluate its outputs at the end; return these.

    Parameters
    ----------
    kind : {"advance", "advance together", "refresh"}
    member : Member
    time : Vector, shape (2,)
    h : float
    u : Matrix, shape (2, n_u)
        The inputs at both ends, which cannot be written to.

    Raises
    ------
    Stopped
        With component and time, and with a row of outputs where the step is complete.
    """
    try:
        if kind == "refresh":
            return member.component.outputs(float(time[1]), u[1])
        y: Vector = member.component.advance(time, h, u)[0]
        return y
    except RunError as error:
        raise _stop_of(error, member, time) from error


def check_finite(members: Sequence[Member], block: Block, signals: Matrix) -> None:
    """Raise a cut before the first row of a block that is not finite."""
    bad = first_non_finite(members, signals[1 : block.steps + 1])
    if bad is not None:
        raise Cut(bad.row, bad.error(float(block.time[bad.row + 1])), members[0].name)


def _numbers(columns: slice) -> NDArray[np.intp]:
    return np.arange(columns.start, columns.stop)


def _origin(results: Iterable[tuple[Member, Vector]]) -> NonFinite | None:
    """Return the first value of a step that is not finite: in a loop it goes around from there."""
    for member, y in results:
        non_finite = member.first_non_finite_output(y)
        if non_finite is not None:
            return non_finite
    return None


def _stop_of(error: RunError, member: Member, time: Vector) -> Stopped:
    """Return an error as a stop, with component and time.

    One that does not say how far it came stopped before any step.
    """
    stop = error if isinstance(error, Stopped) else Stopped(np.empty((0, 0)), str(error))
    located = stop.at(member.name, float(time[stop.steps]))
    located.__cause__ = error
    return located
