"""Run a graph with actions, or again with the events of its recording, each at its instant."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby

import numpy as np

from cosim.arrays import Vector
from cosim.core.clock import Clock
from cosim.core.contracts import Design, Stopped
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.core.recording import Plan, Recorder, SignalEvent
from cosim.core.simulation import Simulation
from cosim.core.stepping.actions import Action, ConditionalAction, TimedAction
from cosim.errors import LogError, UsageError


def run_with_actions(
    graph: Graph,
    clock: Clock,
    recorder: Recorder,
    plan: Plan | None = None,
    *,
    actions: Sequence[TimedAction],
    reactions: Sequence[ConditionalAction] = (),
    until: str | None = None,
) -> None:
    """Run a graph from the start of a clock to its stop, with actions on the way.

    Parameters
    ----------
    graph, clock, recorder, plan, until
        As of :func:`cosim.core.run`.
    actions : sequence of TimedAction
        At communication points.
    reactions : sequence of ConditionalAction
        Where conditions are met first.

    Raises
    ------
    NonFiniteError, Stopped
        As from :func:`cosim.core.run`.
    """
    try:
        with recorder:
            if plan is None:
                plan = graph.prepare(clock.step_ns)
            recorder.begin(plan)
            simulation = Simulation(
                graph,
                clock,
                plan,
                recorder=recorder,
                actions=actions,
                reactions=reactions,
                until=until,
            )
            try:
                simulation.pass_to(clock.steps)
            finally:
                simulation.close()
    except Stopped as stop:
        if stop.failed:
            raise


@dataclass(frozen=True, eq=False)
class RecordedChanges:
    """What happened to a run, to be applied to another one.

    Parameters
    ----------
    events : sequence of SignalEvent
        In order of time; those behind the stop are left out.
    copied : collection of str
        Components that return what was recorded: what followed in them is taken from the events.
    settings : mapping of (int, str) to Action
        What sets the parameters of the other components, by time [ns] and component.
    """

    events: Sequence[SignalEvent]
    copied: Collection[str] = ()
    settings: Mapping[tuple[int, str], Action] = field(default_factory=dict)


def repeat(
    graph: Graph,
    clock: Clock,
    recorder: Recorder,
    plan: Plan | None = None,
    *,
    changes: RecordedChanges,
    designs: Mapping[str, Design] | None = None,
    until: str | None = None,
) -> None:
    """Run a graph from the start of a clock to its stop, and apply recorded events on the way.

    Parameters
    ----------
    graph, clock, recorder, plan, designs, until
        As of :func:`cosim.core.run`.
    changes : RecordedChanges

    Raises
    ------
    LogError
        If an event is at no communication point, or fits nothing that there is.
    NonFiniteError, Stopped
        As from :func:`cosim.core.run`.
    """
    try:
        with recorder:
            if plan is None:
                plan = graph.prepare(clock.step_ns, designs)
            recorder.begin(plan)
            simulation = Simulation(graph, clock, plan, recorder=recorder, until=until)
            for time_ns, jumps in groupby(changes.events, key=lambda event: event.time_ns):
                index = _point(clock, time_ns)
                if index > clock.steps:
                    break
                if index < simulation.index:
                    t = time_ns / 1e9
                    raise LogError(
                        f"the event at t = {t} s comes after a later one; sort the events by time"
                    )
                simulation.pass_to(index)
                _apply(simulation, list(jumps), graph, changes)
            simulation.pass_to(clock.steps)
    except Stopped as stop:
        if stop.failed:
            raise


def _point(clock: Clock, time_ns: int) -> int:
    """Return the communication point of an event."""
    index = clock.grid.number(time_ns)
    if index < 0 or clock.grid.stamp(index) != time_ns:
        raise LogError(f"the event at t = {time_ns / 1e9} s is not at a communication point")
    return index


def _apply(
    simulation: Simulation,
    jumps: Sequence[SignalEvent],
    graph: Graph,
    changes: RecordedChanges,
) -> None:
    """Set parameters, override inputs, inject faults, release, and let the rest follow."""
    values: dict[tuple[int, str], dict[str, tuple[float, ...]]] = {}  # that were set
    given = _followed(graph, jumps, changes.copied)
    try:
        for jump in jumps:
            port = Port.parse(jump.signal)
            if jump.cause == "set":
                own = values.setdefault((jump.time_ns, port.component), {})
                own[port.name] = jump.values
            elif jump.cause == "swap":
                # a swapped component is always recorded
                outputs = given.get(port.component, ())
                simulation.take_outputs(port.component, {port.name: ()}, outputs, cause="swap")
        for key, set_values in values.items():
            _, name = key
            if name in changes.copied:
                simulation.take_outputs(name, set_values, given.get(name, ()))
            else:
                changes.settings[key].perform(simulation)
        for jump in jumps:
            _change_input(simulation, jump)
    except UsageError as error:
        raise _misfit(jump, error) from error
    for name, outputs in given.items():  # what they followed may not be here
        simulation.take_outputs(name, {}, outputs)
    simulation.complete_jumps(given)


def _change_input(simulation: Simulation, jump: SignalEvent) -> None:
    match jump.cause:
        case "override":
            simulation[jump.signal] = jump.values
        case "release":
            simulation.release(jump.signal)
        case "set" | "swap" | "follow" | "jump":
            pass
        case kind:
            simulation.inject(jump.signal, kind, jump.parameters)


def _followed(
    graph: Graph, jumps: Sequence[SignalEvent], copied: Collection[str]
) -> dict[str, list[tuple[slice, Vector]]]:
    """Return the outputs of recorded components that followed; an input follows its source here."""
    followed: dict[str, list[tuple[slice, Vector]]] = {}
    for jump in jumps:
        port = Port.parse(jump.signal)
        if jump.cause != "follow" or port.component not in copied:
            continue
        outputs = followed.setdefault(port.component, [])
        if port.name in graph.layout[port.component].interface.input_names:
            continue
        try:
            end = graph.ports.output(port)
        except UsageError as error:
            raise _misfit(jump, error) from error
        if end.size != len(jump.values):
            raise _misfit(jump, f"expected {end.size} values, got {len(jump.values)}")
        outputs.append((end.columns, np.array(jump.values)))
    return followed


def _misfit(jump: SignalEvent, problem: object) -> LogError:
    where = f"'{jump.signal}' at t = {jump.time_ns / 1e9} s"
    return LogError(f"the event of {where} does not fit: {problem}")
