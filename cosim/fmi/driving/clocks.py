"""Activate the clocks of an FMU in its events, and read what belongs to them.

FMI 3.0 sections 2.2.9 and 2.3.5. A clock ticks at an instant; what belongs to it may be set and
read in the event at that instant only. One event, in Event Mode::

    for each instant of super-dense time:
        activate time-based clocks that are due, and input clocks that others trigger
        set the inputs that belong to them
        ask which output clocks are active; set the inputs that belong to those
        read the outputs that belong to an active clock
        update_discrete_states                      (ends the instant, and deactivates all clocks)
        ask for the intervals that may be others now
    until no update is needed and no clock is due

Between its ticks an output that belongs to a clock keeps the value that was read last. A clock that
triggers or is triggered is a signal, 1 at the communication point at which it ticks: an output
clock at the end of the communication step in which it did.

A periodic clock keeps the interval that the file gives, so that none is set: that is the one that
holds where ``fmi3SetInterval`` is not called. Where the file gives none, the FMU is asked for it.

Instants are integer nanoseconds: that of the k-th tick of a periodic clock is start + shift + k
interval, and nothing accumulates. A countdown clock counts from an event, whose time is the FMU's:
there the instant is the exact sum of that double and the interval.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import Final, NamedTuple, final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import FmuError, RunError
from cosim.fmi.driving.diagnostics import Diagnostics
from cosim.fmi.driving.events import ITERATIONS, close, endless_iteration
from cosim.fmi.instance import (
    ClockCalls,
    ClockInterval,
    CoSimulationInstance,
    DiscreteStates,
    ModelExchangeInstance,
)
from cosim.fmi.references import ReferenceMap
from cosim.fmi.variable import Variable
from cosim.instants import NANOSECONDS

ROUNDINGS: Final = 8 * 2.0**-53  # relative, of an interval that the FMU computed in doubles
NEVER: Final = math.inf


class TickSchedule(NamedTuple):
    """When a time-based clock ticks next.

    Attributes
    ----------
    first : Fraction
        A tick [ns].
    interval : int
        From there to the next [ns]; 0: to be asked for.
    ticks : int
        How many there were since then.
    """

    first: Fraction
    interval: int = 0
    ticks: int = 0

    @property
    def next(self) -> Fraction:
        """The next tick [ns]."""
        return self.first + self.ticks * self.interval

    @property
    def time(self) -> float:
        """The next tick [s]."""
        return float(self.next / NANOSECONDS)


class Event(NamedTuple):
    """When an event happens, with which inputs, and which clocks may tick in it.

    Parameters
    ----------
    t : float
        [s]
    u : Vector, shape (n_u,)
        Inputs; those that belong to a clock are set where it ticks.
    ticks : bool
        Whether time-based clocks tick: at the end of a communication step they wait for the inputs
        there.
    triggers : bool
        Whether input clocks tick: at communication points.
    """

    t: float
    u: Vector
    ticks: bool = True
    triggers: bool = True


class ClockState(NamedTuple):
    """A copy of the state of ``EventClocks``; what it holds is never written to."""

    schedules: dict[str, TickSchedule]  # of the time-based clocks whose next tick is known
    outputs: Vector  # of all: those that belong to clocks as read last, clocks as they ticked
    ticks: dict[str, int]  # of the clocks that are shown, since the communication step began
    handled_at: float  # the communication point [s] at which these ...
    handled: frozenset[str]  # ... input clocks were triggered already


@final
class EventClocks:
    """The clocks of one FMU; of one without clocks, nothing but its events.

    Parameters
    ----------
    instance : ModelExchangeInstance or CoSimulationInstance
    diagnostics : Diagnostics
        Takes ticks that a signal cannot show.

    Attributes
    ----------
    next_time : float
        Of the next tick of a time-based clock [s]; infinity: none is known.

    Raises
    ------
    FmuError
        If an interval or a shift in the file is not a whole number of nanoseconds.
    """

    def __init__(
        self, instance: ModelExchangeInstance | CoSimulationInstance, diagnostics: Diagnostics
    ) -> None:
        description = instance.description
        self._instance = instance
        self._diagnostics = diagnostics
        self._name = description.name
        self._calls: ClockCalls | None = None
        self._time_based: list[Variable] = []
        self._triggered: list[tuple[int, Variable]] = []  # with their columns
        self._asked: list[Variable] = []  # whether they are active
        self._inputs = description.references("input")
        self._outputs = description.references("output")
        self._unclocked_outputs = description.unclocked("output")
        self._shown: dict[str, int] = {}  # clocks among the outputs, with their columns
        self._belonging_to: dict[tuple[ReferenceMap, frozenset[str]], ReferenceMap] = {}
        self.state = ClockState({}, np.zeros(self._outputs.size), {}, math.nan, frozenset())
        self.next_time = NEVER
        if description.drives_clocks:
            self._calls = instance.clock_calls()
            self._find_clocks()

    def _find_clocks(self) -> None:
        description = self._instance.description
        outputs = self._outputs.variables
        needed: set[str] = set()
        for variable in outputs:
            needed.add(variable.name)
            needed.update(variable.clocks)
        for name in description.clocks:
            clock = description[name]
            assert clock.timing is not None  # reading the file refuses a clock without
            if clock.alias_of is not None:
                continue
            if clock.causality == "input" and not clock.is_triggered:
                self._time_based.append(clock)
                self._check_times(clock)
            elif clock.causality == "output" or (clock.causality == "local" and name in needed):
                self._asked.append(clock)
        self._triggered = _clocks(self._inputs)
        self._shown = {clock.name: column for column, clock in _clocks(self._outputs)}

    def _check_times(self, clock: Variable) -> None:
        timing = clock.timing
        if timing is None or timing.interval is None:
            return
        try:
            self._nanoseconds(clock, "interval", timing.interval)
            self._nanoseconds(clock, "shift", timing.shift)
        except RunError as error:
            raise FmuError(str(error)) from error

    def _nanoseconds(self, clock: Variable, what: str, time: Fraction) -> int:
        """Convert a time [s] to nanoseconds; refuse what is no whole number of them.

        Doubles that the FMU computed may be a few roundings off.
        """
        exact = time * NANOSECONDS
        whole = round(exact)
        if abs(exact - whole) > ROUNDINGS * abs(exact):
            raise RunError(
                f"{self._name}: {what} of clock {clock.name!r}: expected a whole number of "
                f"nanoseconds, got {float(time)} s ({time})"
            )
        return whole

    # --- state ---

    def begin(self, y: Vector) -> None:
        """Begin anew with the outputs of Initialization Mode, where first ticks are asked for."""
        outputs = np.array(y, np.float64)
        self._set(ClockState(self.state.schedules, outputs, {}, math.nan, frozenset()))

    def restore(self, state: ClockState) -> None:
        """Go back to a copied state."""
        self._set(state)

    def _set(self, state: ClockState) -> None:
        self.state = state
        times = [schedule.time for schedule in state.schedules.values()]
        self.next_time = min(times, default=NEVER)

    def begin_step(self) -> None:
        """Begin a communication step: no clock has ticked in it."""
        if not self.state.ticks:
            return
        outputs = self.state.outputs.copy()
        for name in self.state.ticks:
            outputs[self._shown[name]] = 0.0
        self.state = self.state._replace(outputs=outputs, ticks={})

    def outputs(self) -> Vector:
        """Return all outputs: those of clocks as they were read last, the others as they are."""
        references = self._unclocked_outputs
        return references.put(self._instance.get_float64(references), self.state.outputs)

    # --- when clocks tick ---

    def ask_first_ticks(self, t: float) -> None:
        """Ask when the time-based clocks tick first, in Initialization Mode at ``t`` [s].

        Raises
        ------
        RunError
            If a time is not one that a clock can have, or not a whole number of nanoseconds.
        """
        start = _instant(t)
        schedules: dict[str, TickSchedule] = {}
        for clock in self._time_based:
            schedule = self._first_ticks(clock, start)
            if schedule is not None:
                schedules[clock.name] = schedule
        self._set(self.state._replace(schedules=schedules))

    def _first_ticks(self, clock: Variable, start: Fraction) -> TickSchedule | None:
        timing = clock.timing
        assert timing is not None
        if timing.variability in ("changing", "countdown"):
            interval = self._ask_interval(clock).interval
            return self._once(clock, start, interval)
        assert self._calls is not None
        interval = timing.interval
        shift = timing.shift
        if interval is None:
            interval = self._ask_interval(clock).interval
            shift = self._calls.shift(clock)
        interval_ns = self._nanoseconds(clock, "interval", self._positive(clock, interval))
        return TickSchedule(start + self._nanoseconds(clock, "shift", shift), interval_ns)

    def _once(
        self, clock: Variable, begin: Fraction, interval: Fraction | None
    ) -> TickSchedule | None:
        """Return the one tick after an interval that is counted from ``begin`` [ns]."""
        assert clock.timing is not None
        if interval is None and clock.timing.variability == "countdown":
            return None
        if interval is None or interval < 0:
            found = "none" if interval is None else f"{float(interval)} s"
            raise RunError(
                f"{self._name}: interval of clock {clock.name!r}: expected 0 s or more, got {found}"
            )
        return TickSchedule(begin + self._nanoseconds(clock, "interval", interval))

    def _positive(self, clock: Variable, interval: Fraction | None) -> Fraction:
        if interval is None or interval <= 0:
            found = "none" if interval is None else f"{float(interval)} s"
            raise RunError(
                f"{self._name}: interval of clock {clock.name!r}: expected more than 0 s, "
                f"got {found}"
            )
        return interval

    def _ask_interval(self, clock: Variable) -> ClockInterval:
        assert self._calls is not None
        return self._calls.interval(clock)

    def is_due(self, t: float, u: Vector) -> bool:
        """Return whether a clock ticks at a communication point ``t`` [s], with inputs ``u``."""
        if self._calls is None:
            return False
        return self.ticks_by(t) or bool(self._triggers(t, u))

    def ticks_by(self, t: float) -> bool:
        """Return whether a time-based clock is due at ``t`` [s]."""
        return self.next_time != NEVER and self.next_time - t <= close(t)

    def fraction(self, t: float, h: float) -> float:
        """Return the next tick as a fraction of a communication step [s]; infinity: not in it."""
        if self.next_time == NEVER:
            return NEVER
        ticks = (schedule.next for schedule in self.state.schedules.values())
        elapsed = min(ticks) - _instant(t)
        step = _instant(h)
        return float(elapsed / step) if elapsed < step else NEVER

    def _triggers(self, t: float, u: Vector) -> list[Variable]:
        """Return the input clocks that the inputs trigger, but for those that they did trigger."""
        clocks = []
        for column, clock in self._triggered:
            value = u[column]
            if value not in (0.0, 1.0):
                raise RunError(
                    f"{self._name}: clock {clock.name!r}: expected 1 (the clock ticks) "
                    f"or 0, got {value}"
                )
            handled = t == self.state.handled_at and clock.name in self.state.handled
            if value and not handled:
                clocks.append(clock)
        return clocks

    def _take_due(self, t: float) -> dict[str, Fraction]:
        """Return the time-based clocks that tick at ``t`` [s], with their instants [ns]."""
        if not self.ticks_by(t):
            return {}
        schedules = dict(self.state.schedules)
        due: dict[str, Fraction] = {}
        for name, schedule in self.state.schedules.items():
            if schedule.time - t > close(t):
                continue
            due[name] = schedule.next
            if schedule.interval:
                schedules[name] = schedule._replace(ticks=schedule.ticks + 1)
            else:
                del schedules[name]
        self._set(self.state._replace(schedules=schedules))
        return due

    # --- events ---

    def iterate(self, event: Event) -> DiscreteStates:
        """Iterate the discrete states in event mode, with the clocks that tick in it.

        FMI 2.0.4 section 3.2.2 (fmi2NewDiscreteStates), FMI 3.0 section 2.3.5
        (fmi3UpdateDiscreteStates).

        Returns
        -------
        DiscreteStates
            Of the last iteration; the changes are those of all iterations together.

        Raises
        ------
        RunError
            If the event iteration does not converge, or an interval is none.
        """
        t = event.t
        is_clocked = self._calls is not None
        values_changed = False
        nominals_changed = False
        triggered = self._take_triggers(t, event.u) if is_clocked and event.triggers else []
        due: dict[str, Fraction] = {}
        for _ in range(ITERATIONS):
            if is_clocked:
                due = self._take_due(t) if event.ticks else {}
                clocks = [clock for clock in self._time_based if clock.name in due]
                self._activate(event, [*clocks, *triggered])
                triggered = []
            states = self._instance.update_discrete_states()
            # Each call reports its own changes only: those of an earlier one would be lost.
            values_changed = values_changed or states.values_changed
            nominals_changed = nominals_changed or states.nominals_changed
            states = states._replace(
                values_changed=values_changed, nominals_changed=nominals_changed
            )
            if states.terminate:
                return states
            if is_clocked:
                self._ask_next_ticks(t, due)
            if not states.need_update and not (event.ticks and self.ticks_by(t)):
                return states
        raise endless_iteration(self._name, t)

    def _take_triggers(self, t: float, u: Vector) -> list[Variable]:
        clocks = self._triggers(t, u)
        names = frozenset(clock.name for clock in clocks)
        before = self.state.handled if t == self.state.handled_at else frozenset()
        self.state = self.state._replace(handled_at=t, handled=before | names)
        return clocks

    def _activate(self, event: Event, clocks: Sequence[Variable]) -> None:
        """Activate clocks, and exchange what belongs to those that are active then."""
        assert self._calls is not None
        active = [clock.name for clock in clocks]
        if active:
            self._calls.activate(clocks)
            self._set_inputs(event.u, active)
        if self._asked:
            answers = zip(self._asked, self._calls.active(self._asked), strict=True)
            outgoing = [clock.name for clock, is_active in answers if is_active]
            self._set_inputs(event.u, outgoing)
            active += outgoing
        if not active:
            return
        outputs = self.state.outputs.copy()
        references = self._belonging(self._outputs, active)
        outputs[references.columns] = self._instance.get_float64(references)
        counts = dict(self.state.ticks)
        for name in active:
            if name in self._shown:
                outputs[self._shown[name]] = 1.0
                counts[name] = counts.get(name, 0) + 1
                self._report_repetition(event.t, name, counts[name])
        self.state = self.state._replace(outputs=outputs, ticks=counts)

    def _set_inputs(self, u: Vector, active: Iterable[str]) -> None:
        references = self._belonging(self._inputs, active)
        if references.size:
            self._instance.set_float64(references, references.take(u))

    def _belonging(self, references: ReferenceMap, active: Iterable[str]) -> ReferenceMap:
        """Return the inputs or outputs that belong to one of these clocks."""
        names = frozenset(active)
        known = self._belonging_to.get((references, names))
        if known is None:
            known = references.select(
                references.where(lambda v: v.is_signal and not names.isdisjoint(v.clocks))
            )
            self._belonging_to[references, names] = known
        return known

    def _report_repetition(self, t: float, name: str, count: int) -> None:
        if count == 2:
            self._diagnostics.add(
                t,
                f"clock {name}",
                f"clock {name!r} ticks more than once in the communication step to or from "
                f"t = {t} s; its signal shows one tick, and what it triggers gets one",
            )

    def _ask_next_ticks(self, t: float, due: dict[str, Fraction]) -> None:
        """Ask for the intervals that may be others after an update, and begin to count them."""
        schedules = dict(self.state.schedules)
        for clock in self._time_based:
            timing = clock.timing
            assert timing is not None
            now = due.get(clock.name, _instant(t))
            if timing.variability == "changing" and clock.name in due:
                schedule = self._once(clock, now, self._ask_interval(clock).interval)
                assert schedule is not None
                schedules[clock.name] = schedule
            elif timing.variability == "countdown":
                answer = self._ask_interval(clock)
                schedule = self._once(clock, now, answer.interval) if answer.changed else None
                if schedule is not None:
                    schedules[clock.name] = schedule
            elif timing.variability == "tunable" and timing.interval is None:
                answer = self._ask_interval(clock)
                if answer.changed:
                    interval = self._positive(clock, answer.interval)
                    interval_ns = self._nanoseconds(clock, "interval", interval)
                    last = schedules[clock.name]
                    # A tick that waits for the inputs of a communication point is not lost.
                    first = last.next if last.time - t <= close(t) else now + interval_ns
                    schedules[clock.name] = TickSchedule(first, interval_ns)
        self._set(self.state._replace(schedules=schedules))


def _clocks(references: ReferenceMap) -> list[tuple[int, Variable]]:
    """Return the clocks among inputs or outputs, with their columns."""
    clocks = []
    column = 0
    for variable in references.variables:
        if variable.type == "Clock":
            clocks.append((column, variable))
        column += variable.size
    return clocks


def _instant(t: float) -> Fraction:
    """Return a time [s] in nanoseconds: the whole number whose time it is, else exactly."""
    whole = round(t * NANOSECONDS)
    if whole / NANOSECONDS == t:
        return Fraction(whole)
    return Fraction(t) * NANOSECONDS
