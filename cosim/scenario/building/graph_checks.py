"""What becomes of signals between components: jumps where none may be, inputs that come late."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.instants import StepNs, step_seconds
from cosim.scenario.parsing import Scenario
from cosim.scenario.places import Problem

_HELD_IN_LOOP: Final = (
    "{source} depends on what it drives, so that '{to}' takes it with a zero-order hold, on the "
    "mean {delay:g} s late: an error of first order in the step, which no identifier has in its "
    "model; needed a small step"
)


def jump_problems(scenario: Scenario, graph: Graph) -> list[Problem]:
    """Return the problems of inputs that must not jump."""
    problems: list[Problem] = []
    for to, connection in scenario.connections.items():
        way_out = scenario.specs[to.component].continuous_inputs.get(to.signal)
        if way_out is None:
            continue
        for source in connection.sources:
            jumping = graph.jumps(source)
            if jumping:
                text = f"{to.signal} '{source}' {_how(source, jumping)}; {way_out}"
                problems.append((("components", to.component), text))
    return problems


def _how(source: Port, jumping: Sequence[Port]) -> str:
    """Return how a signal jumps."""
    jumps = "is discrete and jumps"
    if source.whole not in jumping:
        jumps = f"jumps with {', '.join(map(str, jumping))} (direct feedthrough)"
    return f"{jumps}; linear interpolation would turn the jump into a ramp over one step"


def held_disturbances(
    scenario: Scenario, graph: Graph, step_ns: StepNs
) -> Iterator[tuple[str, str]]:
    """Yield (component, text) where a disturbance is in a loop, by signals among its alphas."""
    if graph.input_interpolation not in (None, "linear"):
        return
    delay = 0.5 * step_seconds(step_ns)
    for stage in graph.stages:
        loop = {member.name for member in stage.members}
        for to, connection in graph.connections.items():
            if to.component not in loop:
                continue
            end = graph.ports.input(to)
            first = end.columns.start - end.channel.inputs.start
            held = graph.held[to.component][first : first + end.size]
            for source in connection.sources:
                is_inside = source.component in loop
                if is_inside and held.any() and _is_modulated(scenario, graph, source.component):
                    text = _HELD_IN_LOOP.format(source=source, to=to, delay=delay)
                    yield source.component, text


def _is_modulated(scenario: Scenario, graph: Graph, name: str) -> bool:
    """Return whether a component has inputs that must not jump, such as alphas."""
    inputs = graph.components[name].interface.input_names
    return not inputs.isdisjoint(scenario.specs[name].continuous_inputs)
