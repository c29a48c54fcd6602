"""A graph that is advanced by hand: step by step, with inputs overridden, and back.

::

    row <- every component initialized with its inputs          # recorded
    step(K):
        where inputs were overridden or released since the last step:
            row <- its right limits; the jumps are recorded as events
        rows 0 to K <- row, and the same stages as in a run
        row <- row K; rows 1 to K are recorded

It is the engine of :func:`cosim.core.run`, called from outside: the same stages, the same bits. An
override takes effect at the communication point reached. The row that was recorded there keeps the
left limit; the next step starts from the right one, and the overridden input keeps its value at the
end of every step until it is released.
"""

from __future__ import annotations

from ctypes import addressof, c_char
from functools import cached_property
from math import isfinite
from threading import get_ident
from typing import Any, Final, final

import numpy as np

from cosim.arrays import Matrix, Nanoseconds, Vector
from cosim.core.arguments import check_type, kind_of
from cosim.core.clock import Clock, seconds
from cosim.core.contracts import Block, EventCause, Plan, Recorder, SignalEvent
from cosim.core.coupling import Cut
from cosim.core.graph import Graph
from cosim.core.master import TWO_SIMULATIONS
from cosim.core.member import Member
from cosim.core.native_stage import NativeStage, advancing_stages
from cosim.core.overrides import OverrideValue, checked_values
from cosim.core.pacing import Pacer
from cosim.core.port import Port
from cosim.core.ports import ConnectionEnd
from cosim.core.right_limits import END, GivenOutputs, RightLimits
from cosim.core.snapshots import SignalColumns, SimulationState, StepRows, graph_hash
from cosim.errors import GraphError, RunError, UsageError, listing, steps_text

POINTS: Final = 4096  # communication points whose times are computed at once
BLOCK_BYTES: Final = 2**24  # of the rows of one block where they are not kept
DOUBLE: Final = 8  # bytes
INTERRUPTED: Final = "it was interrupted inside a step"
NOTHING_GIVEN: Final[GivenOutputs] = {}


class _Input:
    """An input that can be overridden, or elements of it.

    Parameters
    ----------
    to : Port
        As it was named.
    end : ConnectionEnd
    member : Member
    follows : bool
        Whether something follows at once when it jumps.
    """

    __slots__ = ("columns", "end", "follows", "is_plain", "member", "name", "numbers", "whole")

    def __init__(self, to: Port, end: ConnectionEnd, member: Member, *, follows: bool) -> None:
        self.name = str(to)
        self.end = end
        self.whole = end.port
        self.member = member
        self.follows = follows
        self.columns = end.columns
        self.is_plain = end.size == 1 and end.signal.type == "real"
        self.numbers = range(end.columns.start, end.columns.stop)


@final
class Simulation:
    """Advances a graph by hand.

    Parameters
    ----------
    graph : Graph
    clock : Clock
    plan : Plan, optional
        Returned by ``graph.prepare``; left out, the graph is prepared here.
    recorder : Recorder, optional
        Takes the rows and the events. It has begun, and is closed elsewhere.
    identity : str, optional
        What states of this graph are known by, beside its structure; left out: its designs.

    Attributes
    ----------
    index : int
        Number of the communication point that is reached.
    error : RunError or None
        What the simulation ended with.
    rows : StepRows or None
        What the last call advanced over, also where it came to an end before its last step; None:
        it has not been advanced.

    Raises
    ------
    NonFiniteError
        If an initial value is not finite.
    """

    def __init__(
        self,
        graph: Graph,
        clock: Clock,
        plan: Plan | None = None,
        *,
        recorder: Recorder | None = None,
        identity: str | None = None,
    ) -> None:
        check_type("graph", graph, Graph, UsageError)
        check_type("clock", clock, Clock, UsageError)
        self.index = 0
        self._graph = graph
        self._clock = clock
        self._plan = graph.prepare(clock.step_ns) if plan is None else plan
        self._recorder = recorder
        self._identity = identity
        self._columns = SignalColumns(graph.layout, clock.step_ns)
        self._members: dict[str, Member] = {}
        for stage in graph.stages:
            for member in stage.members:
                self._members[member.name] = member
        self._inputs: dict[str | Port, _Input] = {}
        self._right_limits = RightLimits(graph)
        self._width = graph.layout.width
        self._h = clock.step
        self._thread = get_ident()
        self._closed = False
        self._begin()

    def _begin(self) -> None:
        """Initialize the graph; the row of the start is recorded."""
        graph = self._graph
        row = np.zeros(self._width)
        self._ended = "its initialization failed"
        graph.initialize(self._clock.start_time, row)
        self._ended = ""
        self.error: RunError | None = None
        self.rows: StepRows | None = None
        self._initialization = graph.initializations
        stages = advancing_stages(graph)
        self._pacer = Pacer(stages, divide=True)
        self._native = [stage for stage in stages if isinstance(stage, NativeStage)]
        if len(self._native) < len(stages):
            self._native = []
        self._points_begin = 0
        self._times_ns: Nanoseconds = np.empty(0, np.int64)
        self._times: Vector = np.empty(0)
        self._times_address = 0
        self.index = 0
        self._given: GivenOutputs = NOTHING_GIVEN
        self._stand_at(row)
        if self._recorder is not None:
            self._recorder.write(self._block(0), row[np.newaxis])

    def _stand_at(self, row: Vector) -> None:
        """Take a row as that of the point reached, without jumps so far."""
        self._row = row
        self._left_row = row
        self._jumped: set[Port] = set()  # inputs, since the right limits were evaluated
        self._changes: dict[_Input, EventCause] = {}  # at this point

    # --- time ---

    @property
    def t_ns(self) -> int:
        """The time that is reached [ns]."""
        return self._clock.start_ns + self.index * self._clock.step_ns

    @property
    def t(self) -> float:
        """The time that is reached [s]."""
        return self.t_ns / 1e9

    @property
    def steps_left(self) -> int:
        """Communication steps up to the stop of the clock."""
        return self._clock.steps - self.index

    # --- advancing ---

    def step(self, count: int = 1) -> StepRows:
        """Advance over some communication steps; return their rows by the names of signals.

        Raises
        ------
        UsageError
            If ``count`` is no whole number from 1 on, or goes beyond the stop of the clock; if the
            simulation has ended, or is that of another thread.
        NonFiniteError, Stopped
            Where the graph cannot go on, or a component asks for the end; what was completed before
            is recorded, and the simulation has ended there.
        """
        if type(count) is not int or count < 1:
            raise UsageError(f"step: found {kind_of(count)} steps; needed a whole number from 1 on")
        self._check_ready("step")
        if count > self._clock.steps - self.index:
            self._refuse("step", f"{steps_text(count)}")
        return self._advance(count)

    def run_until(self, t: float) -> StepRows:
        """Advance up to an instant [s]; return the rows.

        Raises
        ------
        ClockError
            If it is no communication point.
        UsageError
            If it is before the time reached, or as from :meth:`step`.
        NonFiniteError, Stopped
            As from :meth:`step`.
        """
        end = self._clock.steps_until(t, "run_until")
        self._check_ready("run_until")
        if end < self.index:
            raise UsageError(
                f"run_until: found {t} s, which is before the time reached, {self.t} s; needed a "
                "later one; a saved state or reset() goes back"
            )
        if end > self._clock.steps:
            self._refuse("run_until", f"{t} s")
        return self._advance(end - self.index)

    def pass_to(self, index: int) -> None:
        """Advance up to a communication point; its rows are recorded, and not kept.

        Raises
        ------
        NonFiniteError, Stopped
            As from :meth:`step`.
        """
        limit = max(1, BLOCK_BYTES // (8 * self._width + 8))
        while self.index < index:
            self._advance(min(limit, index - self.index))

    def _advance(self, count: int) -> StepRows:
        """Advance over some steps."""
        if self._changes:
            self.complete_jumps()
        signals = np.empty((count + 1, self._width))
        signals[0] = self._row
        self._ended = INTERRUPTED  # unless the end of this is reached
        if count == 1 and self._native and self._recorder is None:
            reached, error = self._pass_one(signals)
        else:
            reached, error = self._pass_through(self._block(count), signals)
        signals.flags.writeable = False  # who keeps the rows sees them as they are
        if reached < count:
            signals = signals[: reached + 1]
        self.rows = StepRows(self._columns, signals, self.t_ns)
        self.index += reached
        self._row = self._left_row = signals[reached]
        if error is not None:
            self._end_with(error)
            raise error
        self._ended = ""
        return self.rows

    def _pass_one(self, signals: Matrix) -> tuple[int, RunError | None]:
        """Fill row 1 by stages in compiled code alone, where a pacer and a block would cost more.

        Returns
        -------
        (int, RunError or None)
            The row that is reached, and what stopped there.
        """
        first = self.index - self._points_begin
        if not 0 <= first < len(self._times) - 1:
            self._block(1)  # computes the times
            first = 0
        memory: Any = signals
        rows = addressof(c_char.from_buffer(memory))  # a tenth of what .ctypes costs
        addresses = (self._times_address + first * DOUBLE, rows)
        reached = 1
        error: RunError | None = None
        for stage in self._native:
            try:
                stage.advance_at(addresses, signals, self._h, self._next_step)
            except Cut as cut:
                reached = cut.steps
                error = cut.error
                if not reached:
                    break
        return reached, error

    def _next_step(self) -> Block:
        return self._block(1)

    def _pass_through(self, block: Block, signals: Matrix) -> tuple[int, RunError | None]:
        """Fill and record rows 1 to K; return the last one that is complete, and what stopped."""
        pacer = self._pacer
        pacer.begin(block)
        begin = 0
        reached = -1
        while reached < pacer.end:
            reached = pacer.advance(block, signals)
            if self._recorder is not None and reached > begin:
                part = block.part(begin, reached)
                self._recorder.write(part, signals[begin : reached + 1])
                begin = reached
        return reached, pacer.error

    def _block(self, count: int) -> Block:
        """Return the next steps; their times are computed for many of them at once."""
        first = self.index - self._points_begin
        if not 0 <= first <= len(self._times) - count - 1:
            self._points_begin = self.index
            first = 0
            points = min(max(count + 1, POINTS), self.steps_left + 1)
            numbers = np.arange(self.index, self.index + points, dtype=np.int64)
            self._times_ns = self._clock.start_ns + numbers * self._clock.step_ns
            self._times = seconds(self._times_ns)
            self._times_address = self._times.ctypes.data
            for array in (self._times_ns, self._times):
                array.setflags(write=False)  # components see them
        rows = slice(first, first + count + 1)
        return Block(self.index, self._times_ns[rows], self._times[rows], self._clock.step)

    def _end_with(self, error: RunError) -> None:
        """Take no further steps."""
        self._ended = str(error)
        self.error = error

    @property
    def signals(self) -> tuple[str, ...]:
        """The names of all signals."""
        return self._columns.signals

    def check_thread(self) -> None:
        """Check that it is the thread of the simulation that calls.

        Raises
        ------
        UsageError
            If it is another one.
        """
        if get_ident() != self._thread:
            raise UsageError(
                "this simulation was started in another thread; needed a simulation of its own "
                "for every thread, with a graph of its own"
            )

    def _check_current(self) -> None:
        """Check that the state of the components is that of this simulation, and thread.

        Raises
        ------
        UsageError
            If it is not.
        """
        if get_ident() != self._thread:
            self.check_thread()
        if self._closed:
            raise UsageError("this simulation is closed; needed another one: start it again")
        if self._graph.initializations != self._initialization:
            raise UsageError(TWO_SIMULATIONS)

    def _check_ready(self, what: str) -> None:
        """Check that the simulation can go on.

        Raises
        ------
        UsageError
            If it cannot.
        """
        self._check_current()
        if self._ended:
            raise UsageError(
                f"{what}: the simulation ended at t = {self.t} s: {self._ended}; needed reset(), "
                "or a saved state to go on from"
            )

    def _refuse(self, what: str, found: str) -> None:
        """Refuse to go beyond the stop of the clock.

        Raises
        ------
        UsageError
            Always.
        """
        stop = self._clock.stop
        if not self.steps_left:
            raise UsageError(
                f"{what}: the simulation is at its stop, t = {stop} s; needed reset(), a saved "
                "state to go on from, or a later stop"
            )
        raise UsageError(
            f"{what}: found {found}; needed at most {steps_text(self.steps_left)}, from t = "
            f"{self.t} s to the stop at {stop} s"
        )

    def close(self) -> None:
        """Evaluate and record the jumps at the point reached; what is there can be read on.

        Raises
        ------
        NonFiniteError, Stopped
            If what follows the jumps cannot be evaluated.
        """
        if not (self._closed or self._ended):
            self._check_current()
            self.complete_jumps()
        self._closed = True

    # --- signals ---

    def __getitem__(self, signal: str) -> Vector:
        """Return what a signal is at the time reached, behind its jumps; shape (size,).

        Raises
        ------
        UnknownSignalError
            If there is no such component, signal or element; names the nearest.
        UsageError
            If it is the simulation of another thread.
        """
        columns = self._columns[signal]
        if self._jumped or get_ident() != self._thread:
            self._check_ready("read")
            self._evaluate()
        return self._row[columns].copy()

    def __setitem__(self, to: str, value: OverrideValue) -> None:
        """Override an input, or elements of it, from the time reached on.

        Raises
        ------
        GraphError
            If there is no such input, or the value does not fit it.
        UsageError
            If the simulation has ended, or is that of another thread.
        """
        overridden = self._input(to)
        if overridden.is_plain and type(value) is float and isfinite(value):
            values = [value]  # as most are; any other is checked in full
        else:
            values = checked_values(to, value, overridden.end)
        self._check_ready("override")
        self._start_jump(overridden, "override")
        overrides = overridden.member.overrides
        for column, element in zip(overridden.numbers, values, strict=True):
            overrides[column] = element
            self._row[column] = element

    def release(self, to: str) -> None:
        """Release an override, of an input or of elements of it: its connection drives it again.

        Raises
        ------
        GraphError
            If there is no such input, or it is not overridden.
        UsageError
            If the simulation has ended, or is that of another thread.
        """
        released = self._input(to)
        self._check_ready("release")
        member = released.member
        if not all(column in member.overrides for column in released.numbers):
            names = listing(list(self.overrides)) or "nothing is"
            raise GraphError(f"release: '{to}' is not overridden, as a whole; overridden: {names}")
        self._start_jump(released, "release")
        for column in released.numbers:
            del member.overrides[column]
        member.gather(self._row[np.newaxis], END)

    @property
    def overrides(self) -> dict[str, float]:
        """The elements of inputs that are overridden, and their values."""
        values: dict[str, float] = {}
        for member in self._members.values():
            for column, value in member.overrides.values().items():
                values[member.label(column - member.columns.start)] = value
        return values

    def _input(self, to: str) -> _Input:
        try:
            return self._inputs[to]
        except (KeyError, TypeError):  # not asked for before, or no input at all
            port = to if isinstance(to, Port) else Port.parse(to)
        end = self._graph.ports.input(port)
        member = self._members[port.component]
        follows = self._right_limits.reach_more(end.port)
        self._inputs[to] = _Input(port, end, member, follows=follows)
        return self._inputs[to]

    def _start_jump(self, changed: _Input, cause: EventCause) -> None:
        """Note that an input jumps; the row before the jump is recorded, and kept."""
        if self._row is self._left_row:
            self._row = self._left_row.copy()
        self._changes.pop(changed, None)  # the last change of an input comes last
        self._changes[changed] = cause
        if changed.follows:
            self._jumped.add(changed.whole)

    def _evaluate(self) -> None:
        """Evaluate what follows the inputs that have jumped."""
        jumped = frozenset(self._jumped)
        self._jumped.clear()
        try:
            self._right_limits.evaluate(self.t, self._row, jumped, self._given)
        except RunError as error:
            self._end_with(error)
            raise

    def complete_jumps(self, given: GivenOutputs = NOTHING_GIVEN) -> None:
        """Evaluate and record the jumps at the point reached.

        Parameters
        ----------
        given : mapping of component name to columns with their values
            Right limits that are known, of components that are not evaluated.

        Raises
        ------
        NonFiniteError, Stopped
            If what follows cannot be evaluated.
        """
        self._given = given
        if self._jumped:
            self._evaluate()
        self._given = NOTHING_GIVEN
        if self._recorder is not None:
            for event in self._events():
                self._recorder.event(event)
        self._changes.clear()

    def _events(self) -> list[SignalEvent]:
        """Return the jumps at the point reached: overrides and releases, then what followed."""
        t_ns = self.t_ns
        events = []
        own: set[Port] = set()
        for changed, cause in self._changes.items():
            own.add(changed.whole)
            values = tuple(self._row[changed.columns].tolist())
            events.append(SignalEvent(t_ns, cause, changed.name, values))
        for channel in self._graph.layout.channels:
            if self._row[channel.columns].tobytes() == self._left_row[channel.columns].tobytes():
                continue
            for name, columns in channel.signal_columns.items():
                before = self._left_row[columns]
                values_now = self._row[columns]
                is_own = Port(channel.name, name) in own
                if not is_own and before.tobytes() != values_now.tobytes():
                    values = tuple(values_now.tolist())
                    events.append(SignalEvent(t_ns, "follow", f"{channel.name}.{name}", values))
        return events

    # --- states ---

    @cached_property
    def graph_hash(self) -> str:
        """What states of this graph are known by."""
        return graph_hash(self._graph, self._clock, self._plan, self._identity)

    @property
    def state(self) -> SimulationState:
        """The state at the time reached: time, rows, overrides, and the state of every component.

        Raises
        ------
        UsageError
            If components cannot go back, or the simulation has ended.
        """
        self._check_ready("state")
        self._check_rollback()
        if self._jumped:
            self._evaluate()
        overrides: dict[int, float] = {}
        components = {}
        for name, member in self._members.items():
            overrides.update(member.overrides.values())
            components[name] = member.component.save()
        row = self._row.copy()
        row.flags.writeable = False
        return SimulationState(self.graph_hash, self.index, row, overrides, components, self)

    @state.setter
    def state(self, state: SimulationState) -> None:
        """Go back to a state of this graph.

        Raises
        ------
        UsageError
            If it is none, is that of another graph, or cannot leave its simulation; if a recorder
            takes the rows.
        """
        self._check_current()
        check_type("state", state, SimulationState, UsageError)
        if self._recorder is not None:
            raise UsageError(
                "state: a log is open, which goes forward in time only; needed a simulation "
                "without a log to go back in, or reset(), which begins the next log"
            )
        if state.graph != self.graph_hash:
            raise UsageError(
                f"state: found one of another graph ({state.graph[:12]}; this one is "
                f"{self.graph_hash[:12]}); needed a state of a simulation of the same scenario, "
                "with the same values"
            )
        if state.origin is not self:
            state.check_portable()
        self._ended = "its state could not be set"
        for name, member in self._members.items():
            member.component.restore(state.components[name])
            member.overrides.clear()
            for column, value in state.overrides.items():
                if member.inputs.start <= column < member.inputs.stop:
                    member.overrides[column] = value
        self.index = state.index
        self._stand_at(state.row.copy())
        self._pacer.error = None
        self.error = None
        self._ended = ""

    def _check_rollback(self) -> None:
        names = []
        for name, member in self._members.items():
            if not member.channel.interface.rollback:
                names.append(name)
        if names:
            raise UsageError(
                f"state: {listing(names)} cannot go back (rollback is not declared); needed "
                "components that can, or reset() and the same steps again"
            )

    def reset(self) -> None:
        """Initialize again, without overrides.

        Raises
        ------
        UsageError
            If it is the simulation of another thread, or a recorder takes the rows.
        """
        self._check_current()
        if self._recorder is not None:
            raise UsageError("reset: a recorder takes one run; needed another simulation")
        self._begin()
