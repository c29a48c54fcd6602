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

Where what a component reads jumps at the end of a step, it takes the left limit there; its outputs
are evaluated again for the right one (:mod:`cosim.core.stages.left_limits`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, TypeAlias

import numpy as np

from cosim.arrays import Matrix, Vector, read_only
from cosim.core.contracts import Block, Stopped
from cosim.core.stages.member import END, Member, NonFinite, first_non_finite
from cosim.core.stages.substep_control import SubstepControl
from cosim.core.stages.torn_inputs import KeptInputs, TornInputs
from cosim.core.structure.order import OperationKind
from cosim.errors import RunError
from cosim.native.stages.loop_solver import SOLVED, SWEEP

OperationName: TypeAlias = Literal[
    "keep",
    "gather",
    "advance",
    "refresh",
    "right",
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

    @property
    def controls(self) -> tuple[SubstepControl, ...]:
        """What chooses its substeps; empty: it takes communication steps."""
        ...

    @property
    def nested(self) -> NestedStages | None:
        """The stages of those of its components that take substeps; None: all do, or none."""
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
    controls: tuple[SubstepControl, ...] = ()
    nested: None = None
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
        operations = with_limits("advance", self.member)
        return (*((kind, self.members) for kind in operations), ("check", self.members))

    def advance(self, block: Block, signals: Matrix) -> None:
        """Advance the whole block in one call; in several where an input jumps between them."""
        # Row 0 is the last row of the block before: its inputs are there.
        self.member.gather(signals, slice(1, None))
        begin = 0
        for end in self._ends(signals):
            try:
                self._advance(block.part(begin, end), signals[begin : end + 1])
            except Cut as cut:
                raise Cut(begin + cut.steps, cut.error, cut.component) from cut
            begin = end

    def _ends(self, signals: Matrix) -> list[int]:
        """Return the rows up to which each call advances."""
        steps = len(signals) - 1
        if self.member.takes_latest:
            return list(range(1, steps + 1))
        ends = []
        if self.member.jumps is not None:
            ends = (np.flatnonzero(self.member.jumps.jumps(signals)) + 1).tolist()
        return ends if ends and ends[-1] == steps else [*ends, steps]

    def _advance(self, block: Block, signals: Matrix) -> None:
        """Advance in one call; where what it reads jumps at its end, by the left limits there."""
        member = self.member
        last = signals[-2:]
        jumps = member.reads_jumps(last)
        if jumps:
            member.gather_left(last)
        steps, stop = self._call(block, signals)
        if jumps and steps == block.steps:
            member.gather(last, END)
            try:
                u = read_only(last)[:, member.inputs]
                last[1, member.outputs] = call("right", member, block.time[-2:], block.h, u)
            except Stopped as error:
                stop = error
                steps -= 1
        check_finite(self.members, block.part(0, steps), signals)
        if stop is not None:
            raise Cut(steps, stop, member.name) from stop

    def _call(self, block: Block, signals: Matrix) -> tuple[int, Stopped | None]:
        """Advance in one call; return how many steps are completed, and what stopped it."""
        member = self.member
        u = member.inputs_over(read_only(signals))
        steps = block.steps
        stopped: Stopped | None = None
        try:
            signals[1:, member.outputs] = member.component.advance(block.time, block.h, u)
        except RunError as error:
            stopped = stop_of(error, member, block.time)
            steps = stopped.steps
            if steps:
                signals[1 : steps + 1, member.outputs] = stopped.outputs
        time = block.time[: steps + 1]
        failure = keep_limits("advance", member, time, signals[: steps + 1])
        return (steps, stopped) if failure is None else (0, failure)


@dataclass(frozen=True, slots=True)
class NestedStages:
    """What a loop does where some of its components keep to communication steps.

    Parameters
    ----------
    early, late : frozenset of str
        Those, which advance before and behind the others.
    stages : tuple of Stage
        Of the others, in their order.
    """

    early: frozenset[str]
    late: frozenset[str]
    stages: tuple[Stage, ...]


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
    controls: tuple[SubstepControl, ...] = ()
    nested: NestedStages | None = None
    is_loop: bool = True
    # the operations of a sweep, and behind them those for right limits
    sweep_operations: tuple[tuple[OperationName, Member], ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        operations: list[tuple[OperationName, Member]] = []
        for kind, member in self.operations:
            operations += [(name, member) for name in with_limits(kind, member)]
        object.__setattr__(self, "sweep_operations", tuple(operations))

    @property
    def is_first_order(self) -> bool:
        """Whether an input or an output lags behind by a part of a step, or may."""
        if self.nested is not None:
            return any(stage.is_first_order for stage in self.nested.stages)
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
        if self.nested is not None:
            inner = [stage.description for stage in self.nested.stages]
            words.append(f"(inside a step: {'; '.join(inner)})")
        elif self.controls:
            words.append("(substeps)")
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
        for kind, member in self.sweep_operations:
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
        for kind, member in self.sweep_operations:
            program.append(("advance together" if kind == "advance" else kind, (member,)))
        program.append(("record", self.members))
        return tuple(program)

    def _sources(self) -> dict[str, set[str]]:
        """Return the components of the loop that drive each of them, other than what is torn.

        What may jump is looked at even so.
        """
        torn = set() if self.torn is None else set(self.torn.columns)
        writers: dict[int, str] = {}
        for member in self.members:
            outputs = range(member.outputs.start, member.outputs.stop)
            writers.update(dict.fromkeys(outputs, member.name))
        sources: dict[str, set[str]] = {}
        for member in self.members:
            columns: set[int] = set()
            for wire in member.wires:
                for to, driving in wire.sources_by_column.items():
                    if to not in torn or member.jumps is not None:
                        columns |= driving
            sources[member.name] = {writers[column] for column in columns & writers.keys()}
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
        columns = np.concatenate([member.column_numbers for member in self.members])
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
        for kind, member in self.sweep_operations:
            if kind == "right" and not member.reads_jumps(rows):
                continue
            if self.kept is None or kind != "advance":
                self._gather(kind, member, rows)
            y, stop = perform(kind, member, time, h, rows, known)
            if y is not None:
                results.append((member, y))
            if stop is not None:
                stopped = stop
                if not stop.steps:
                    return stop
        # What is recorded as applied at the end of the step is what the sources gave there at last.
        for member in self.members:
            member.gather(rows, END)
            if self.torn is not None:  # they were given what was tried, not what the sources gave
                self.torn.put(rows, member)
        return stopped

    def _keep(self, rows: Matrix) -> None:
        """Extrapolated inputs read row 1 before their source has written it: first, it is row 0."""
        for member in self.members:
            member.keep_outputs(rows)

    def _gather(self, kind: OperationName, member: Member, rows: Matrix) -> None:
        """Bring the inputs of a component at the end of the step up to date."""
        gather(kind, member, rows)
        if self.torn is not None:
            self.torn.put(rows, member)
        if self.kept is not None:
            self.kept.put(rows, member)


def with_limits(kind: OperationName, member: Member) -> tuple[OperationName, ...]:
    """Return an operation that takes inputs, and behind it the one for their right limits."""
    has_sources = member.jumps is not None and member.jumps.has_sources
    return (kind, "right") if has_sources else (kind,)


def gather(kind: OperationName, member: Member, rows: Matrix) -> None:
    """Bring the inputs of a component at the end of a step up to date, for an operation."""
    if kind == "right":
        member.gather(rows, END)
    else:
        member.gather_left(rows)


def perform(
    kind: OperationName, member: Member, time: Vector, h: float, rows: Matrix, known: Matrix
) -> tuple[Vector | None, Stopped | None]:
    """Advance a component over one step, or evaluate its outputs at the end; fill row 1 with them.

    Parameters
    ----------
    kind : {"advance", "advance together", "refresh", "right"}
    member : Member
    time : Vector, shape (2,)
    h : float
    rows, known : Matrix, shape (2, width)
        The signals at both ends; ``known`` are the same, which cannot be written to.

    Returns
    -------
    Vector or None
        Its outputs; None: it does not complete the step.
    Stopped or None
        What stopped it, with component and time: with a row of outputs where the step is complete.
    """
    stop: Stopped | None = None
    try:
        y = call(kind, member, time, h, member.inputs_over(known))
    except Stopped as error:
        if not error.steps:
            return None, error
        stop = error
        y = error.outputs[0]
    rows[1, member.outputs] = y
    failure = keep_limits(kind, member, time, rows)
    return y, stop if failure is None else failure


def keep_limits(kind: OperationName, member: Member, time: Vector, rows: Matrix) -> Stopped | None:
    """Keep the left limits of what a component has advanced to, from row 1 on.

    Returns
    -------
    Stopped or None
        With component and time, and without rows, where the component does not tell them.
    """
    if member.jumps is None or kind == "right":
        return None
    try:
        left_outputs = member.component.left_limits(time[1:])
    except RunError as error:
        return stop_of(error, member, time)
    member.jumps.keep(rows, left_outputs)
    return None


def call(kind: OperationName, member: Member, time: Vector, h: float, u: Matrix) -> Vector:
    """Advance a component over one step, or evaluate its outputs at the end; return these.

    Parameters
    ----------
    kind : {"advance", "advance together", "refresh", "right"}
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
        if kind in ("refresh", "right"):
            return member.component.outputs(float(time[1]), u[1])
        y: Vector = member.component.advance(time, h, u)[0]
        return y
    except RunError as error:
        raise stop_of(error, member, time) from error


def check_finite(members: Sequence[Member], block: Block, signals: Matrix) -> None:
    """Raise a cut before the first row of a block that is not finite."""
    bad = first_non_finite(members, signals[1 : block.steps + 1])
    if bad is not None:
        raise Cut(bad.row, bad.error(float(block.time[bad.row + 1])), members[0].name)


def _origin(results: Iterable[tuple[Member, Vector]]) -> NonFinite | None:
    """Return the first value of a step that is not finite: in a loop it goes around from there."""
    for member, y in results:
        non_finite = member.first_non_finite_output(y)
        if non_finite is not None:
            return non_finite
    return None


def stop_of(error: RunError, member: Member, time: Vector) -> Stopped:
    """Return an error as a stop, with component and time.

    One that does not say how far it came stopped before any step.
    """
    stop = error if isinstance(error, Stopped) else Stopped(np.empty((0, 0)), str(error))
    located = stop.at(member.name, float(time[stop.steps]))
    located.__cause__ = error
    return located
