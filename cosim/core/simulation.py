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

from collections.abc import Sequence
from numbers import Integral
from threading import get_ident
from typing import Final, final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.arguments import check_type, kind_of
from cosim.core.clock import Clock
from cosim.core.conditions import conditions_until
from cosim.core.contracts import Component, Transfer
from cosim.core.graph import Graph
from cosim.core.recorders import Nothing, end_of_run, error_text
from cosim.core.recording import EventCause, Plan, Recorder
from cosim.core.signals import FaultKind
from cosim.core.stages.engine import Engine
from cosim.core.stages.left_limits import record
from cosim.core.stages.overrides import OverrideValue
from cosim.core.stepping.actions import Agenda, ConditionalAction, Reactions, TimedAction
from cosim.core.stepping.fault_injection import VaryingFaults, faults_of
from cosim.core.stepping.jump_events import events_of
from cosim.core.stepping.jumps import Jumps, ParameterValues
from cosim.core.stepping.right_limits import NOTHING_GIVEN, GivenOutputs
from cosim.core.stepping.row_filler import RowFiller, StepTimes
from cosim.core.stepping.states import SimulationState, States
from cosim.core.stepping.step_rows import SignalColumns, StepRows, joined_rows
from cosim.errors import Interrupted, RunError, UsageError, quoted, steps_text

NEVER_TRUE: Final = "never_came_true"  # result: the conditions of actions that were not performed
INTERRUPTED: Final = "it was interrupted inside a step"


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
    actions : sequence of TimedAction
        What happens at communication points, beside what is done by hand.
    reactions : sequence of ConditionalAction
        What happens where conditions are met first.
    until : str, optional
        A condition (:mod:`cosim.core.conditions`): where it is met the simulation ends.

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
        actions: Sequence[TimedAction] = (),
        reactions: Sequence[ConditionalAction] = (),
        until: str | None = None,
    ) -> None:
        check_type("graph", graph, Graph, UsageError)
        check_type("clock", clock, Clock, UsageError)
        self.index = 0
        self._graph = graph
        self._clock = clock
        plan = graph.prepare(clock.step_ns) if plan is None else plan
        self._is_recorded = recorder is not None
        self._recorder: Recorder = Nothing() if recorder is None else recorder
        self._columns = SignalColumns(graph.layout, clock)
        self._states = States(graph, clock, plan, identity)
        self._jumps = Jumps(graph, are_recorded=self._is_recorded)
        self._varying = VaryingFaults(graph, clock.h)
        self._agenda = Agenda(actions)
        self._reactions = Reactions(reactions)
        texts = self._reactions.texts
        self._conditions = conditions_until(until, graph.layout, clock, texts)
        self._components = dict(graph.components)  # those that actions may exchange
        self._width = graph.layout.row_width
        self._times = StepTimes(clock)
        self._h = clock.h
        self._thread = get_ident()
        self._closed = False
        self._begin()

    def _begin(self) -> None:
        """Initialize the graph; the row of the start is recorded."""
        self._ended = "its initialization failed"
        self._reactions.performed = ()
        self._put_back()
        self._engine = Engine(
            self._graph, self._clock, self._recorder, divide=True, conditions=self._conditions
        )
        self._ended = ""
        self.index = 0
        self.error: RunError | None = None
        self.rows: StepRows | None = None
        self._filler = RowFiller(
            self._engine,
            self._graph.layout,
            self._recorder,
            self._varying,
            self._times,
            h=self._h,
            is_recorded=self._is_recorded,
        )
        row = self._engine.first_row
        self._jumps.stand_at(row)
        self._varying.find()
        record(self._recorder, self._graph.layout, self._times.block(0, 0), row[np.newaxis])
        if not self._conditions.is_over:
            self._act()

    # --- time ---

    @property
    def t_ns(self) -> int:
        """The time that is reached [ns]."""
        return self._clock.grid.stamp(self.index)

    @property
    def t(self) -> float:
        """The time that is reached [s]."""
        return self._clock.grid.instant(self.index)

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
        if type(count) is not int:
            count = _whole(count)
        if count < 1:
            raise UsageError(f"step: expected an integer >= 1, got {count} steps")
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
                f"run_until: expected a time after the current {self.t} s, got {t} s; go back "
                "with a saved state or reset()"
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
        while self.index < index:
            if self._jumps.are_pending:
                self.complete_jumps()
            end = self._agenda.next_point(self.index, index)
            most = min(self._clock.block or end, self._engine.limit)
            block = self._times.block(self.index, min(most, end - self.index))
            if self._jumps.are_there:  # row 0 in the memory of a recorder keeps the left limits
                signals = self._rows_behind(block.steps)
            else:
                signals = self._engine.rows(block, self._jumps.row)
            try:
                error = self._filler.fill_block(block, signals)
            except BaseException as raised:
                self._break_off(signals, raised)
                raise
            reached = self._filler.reached
            self.rows = None
            self._arrive(signals[reached], reached, error)

    def _advance(self, count: int) -> StepRows:
        """Advance over some steps, from one action to the next; return their rows."""
        end = self.index + count
        if not self._reactions and self._agenda.next_point(self.index, end) == end:
            return self._advance_at_once(count)
        parts: list[StepRows | None] = []
        try:
            while self.index < end:
                self.rows = None
                here = self.index
                self._advance_at_once(self._agenda.next_point(here, end) - here)
                parts.append(self.rows)
        except BaseException:
            parts.append(self.rows)  # what was completed before it failed
            raise
        finally:
            self.rows = joined_rows(parts)
        assert self.rows is not None
        return self.rows

    def _advance_at_once(self, count: int) -> StepRows:
        """Advance over some steps without actions between them; return their rows."""
        if self._jumps.are_pending:
            self.complete_jumps()
        signals = self._rows_behind(count)
        try:
            error = self._filler.fill(self.index, signals)
        except BaseException as raised:
            self._break_off(signals, raised)
            raise
        reached = self._filler.reached
        signals.flags.writeable = False  # who keeps the rows sees them as they are
        if reached < count:
            signals = signals[: reached + 1]
        self.rows = StepRows(self._columns, signals, self.index)
        self._arrive(signals[reached], reached, error)
        return self.rows

    def _rows_behind(self, count: int) -> Matrix:
        """Return memory for the rows of some steps, behind the right limits in row 0."""
        signals = np.empty((count + 1, self._width))
        signals[0] = self._jumps.row
        return signals

    def _break_off(self, signals: Matrix, raised: BaseException) -> None:
        """Stand at the last row that is recorded, and end: components may be ahead of it."""
        reached = self._filler.reached
        completed = signals[: reached + 1]
        completed.flags.writeable = False
        self.rows = StepRows(self._columns, completed, self.index)
        self.index += reached
        self._jumps.stand_at(completed[-1])
        if end_of_run(raised).status == "interrupted":
            self._ended = INTERRUPTED
            self.error = Interrupted("interrupted inside a step")
        elif isinstance(raised, RunError):
            self._end_with(raised)
        else:
            self._end_with(RunError(error_text(raised)))

    def _arrive(self, row: Vector, steps: int, error: RunError | None) -> None:
        """Stand at the row that was reached in some steps; raise what stopped there."""
        self.index += steps
        self._jumps.stand_at(row)
        self._ended = ""
        if error is not None:
            self._end_with(error)
            raise error
        self._act()

    def _act(self) -> None:
        """Perform the actions at the point reached, then those of conditions that came true."""
        if not (self._agenda or self._reactions):
            return
        due = [*self._agenda.at(self.index)]
        came_true = [condition.text for condition in self._conditions.came_true]
        for reaction in self._reactions.due(came_true):
            text = f"when {quoted(reaction.when)}: came true"
            self._recorder.message(self.t_ns, "info", "run", text)
            due += reaction.actions
        for action in due:
            try:
                action.perform(self)
            except RunError as error:
                self._end_with(error)
                raise

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
                "this simulation was started in another thread; use one simulation per thread, "
                "with a graph of its own"
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
            raise UsageError("this simulation is closed; start a new one")
        self._engine.check_current()

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
                f"{what}: the simulation ended at t = {self.t} s: {self._ended}; call reset(), or "
                "continue from a saved state"
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
                f"{what}: the simulation is at its stop, t = {stop} s; call reset(), continue "
                "from a saved state, or set a later stop"
            )
        raise UsageError(
            f"{what}: expected at most {steps_text(self.steps_left)}, from t = {self.t} s to the "
            f"stop at {stop} s, got {found}"
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
        if not self._closed:
            self._record_left()
        self._closed = True
        self._reactions.performed = ()
        self._put_back()

    def _record_left(self) -> None:
        """Record which conditions of actions never came true."""
        left = self._reactions.left()
        for text in left:
            message = f"when {quoted(text)}: never came true"
            self._recorder.message(self.t_ns, "warning", "run", message)
        if self._reactions:
            self._recorder.result({NEVER_TRUE: left})

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
        if self._jumps.waiting or get_ident() != self._thread:
            self._check_ready("read")
            self._evaluate()
        return self._jumps.row[columns].copy()

    def __setitem__(self, to: str, value: OverrideValue) -> None:
        """Override an input, or elements of it, from the time reached on.

        Raises
        ------
        GraphError
            If there is no such input, or the value does not fit it.
        UsageError
            If the simulation has ended, or is that of another thread.
        """
        overridden = self._jumps.input(to)
        values = overridden.checked(value)
        self._check_ready("override")
        self._jumps.override(overridden, values)
        if self._varying.are_there:
            self._varying.find()

    def inject(self, to: str, kind: FaultKind, parameters: Sequence[float] = ()) -> None:
        """Inject a fault into an input, or elements of it, from the time reached on.

        Parameters
        ----------
        to : str
        kind : FaultKind
        parameters : sequence of float
            Of the fault of every element, one behind the other; see
            :mod:`cosim.core.stages.faults`.

        Raises
        ------
        GraphError
            If there is no such input, or the fault does not fit it.
        UsageError
            If the simulation has ended, or is that of another thread.
        """
        overridden = self._jumps.input(to)
        faults = faults_of(overridden.end, kind, parameters)
        self._check_ready("inject")
        self._jumps.inject(overridden, faults, index=self.index, h=self._h)
        self._varying.find()

    def release(self, to: str) -> None:
        """Release an override or a fault, of an input or of elements of it.

        Its connection drives it again.

        Raises
        ------
        GraphError
            If there is no such input, or it is not overridden.
        UsageError
            If the simulation has ended, or is that of another thread.
        """
        released = self._jumps.input(to)
        self._check_ready("release")
        self._jumps.release(released)
        if self._varying.are_there:
            self._varying.find()

    def release_overridden(self, to: str) -> None:
        """Release those elements of an input that are overridden; see :meth:`release`."""
        for element in self._jumps.input(to).overridden:
            self.release(element)

    @property
    def overrides(self) -> dict[str, float]:
        """The elements of inputs that are overridden, and their values."""
        return self._jumps.overrides

    def _evaluate(self, given: GivenOutputs = NOTHING_GIVEN) -> None:
        """Evaluate what follows the inputs that have jumped."""
        try:
            self._jumps.evaluate(self.t, given)
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
        if self._jumps.waiting:
            self._evaluate(given)
        if self._is_recorded:
            for event in events_of(self._jumps, self._graph.layout, self.t_ns):
                self._recorder.event(event)
        self._jumps.clear_changes()

    # --- parameters ---

    def exchange(
        self,
        name: str,
        component: Component,
        settings: ParameterValues,
        *,
        cause: EventCause = "set",
        transfer: Transfer | None = None,
    ) -> None:
        """Put a component in the place of another one, from the time reached on, with its state.

        Parameters
        ----------
        name : str
        component : Component
            As :meth:`Graph.prepare_variant` prepared it.
        settings : mapping of parameter to values
            What is other in it, for the record.
        cause : {"set", "swap"}
        transfer : Transfer, optional
            Left out: it takes the state that the other one saves.

        Raises
        ------
        NonFiniteError, Stopped
            If its outputs cannot be evaluated.
        """
        self._check_ready("exchange")
        self._graph.hand_over(name, component, self.t, self._jumps.row, transfer=transfer)
        self._filler.compile()
        self.change(name, settings, cause=cause)

    def change(self, name: str, settings: ParameterValues, *, cause: EventCause = "set") -> None:
        """Evaluate the outputs of a component, whose parameters were set.

        Raises
        ------
        NonFiniteError, Stopped
            If its outputs cannot be evaluated.
        """
        self._check_ready("change")
        try:
            self._jumps.change(name, self.t, settings, cause)
        except RunError as error:
            self._end_with(error)
            raise

    def take_outputs(
        self,
        name: str,
        settings: ParameterValues,
        given: Sequence[tuple[slice, Vector]],
        *,
        cause: EventCause = "set",
    ) -> None:
        """Set outputs of a recorded component, whose parameters were set, to their right limits."""
        self._jumps.take_outputs(name, settings, given, cause)

    def _put_back(self, index: int = -1) -> None:
        """Put the components in their places that are there behind the actions at a point."""
        there = {**self._components, **self._agenda.variants(index), **self._reactions.variants()}
        for name, component in there.items():
            if self._graph.components[name] is not component:
                self._graph.put(name, component)

    # --- states ---

    @property
    def state(self) -> SimulationState:
        """The state at the time reached: time, rows, overrides, and the state of every component.

        Raises
        ------
        UsageError
            If components cannot go back, or the simulation has ended.
        """
        self._check_ready("state")
        self._states.check_rollback()
        if self._jumps.waiting:
            self._evaluate()
        return self._states.save(
            self.index,
            self._jumps.row,
            self._conditions.held,
            performed=self._reactions.performed,
            origin=self,
        )

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
        if self._is_recorded:
            raise UsageError(
                "state: a log is open, which cannot go back; use a simulation without a log, or "
                "reset(), which begins the next log"
            )
        self._states.check(state, self)
        self._ended = "its state could not be set"
        self._reactions.performed = state.performed
        if self._agenda or self._reactions:
            self._put_back(state.index)
            self._filler.compile()
        self._states.restore(state)
        self._conditions.held = state.conditions
        self.index = state.index
        self._jumps.stand_at(state.row.copy())
        self._varying.find()
        self.error = None
        self._ended = ""

    def reset(self) -> None:
        """Initialize again, without overrides.

        Raises
        ------
        UsageError
            If it is the simulation of another thread, or a recorder takes the rows.
        """
        self._check_current()
        if self._is_recorded:
            raise UsageError("reset: this recorder takes only one run; start a new simulation")
        self._begin()


def _whole(count: object) -> int:
    """Return a number of steps that is no ``int``, such as one of numpy.

    Raises
    ------
    UsageError
        If it is no whole number.
    """
    if isinstance(count, bool) or not isinstance(count, Integral):
        raise UsageError(f"step: expected an integer >= 1, got {kind_of(count)} steps")
    return int(count)
