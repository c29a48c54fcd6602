"""How the components of a scenario advance: stages, loops, rates and feedthrough."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias

from cosim.core.connections import Connection
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.core.signals import Interface
from cosim.core.stages.coupling import Stage
from cosim.errors import UsageError, command
from cosim.instants import step_seconds
from cosim.scenario.building.build import DescribedScenario, describe
from cosim.scenario.document.document import find
from cosim.scenario.kinds.base import Sampling

InputCourse: TypeAlias = Literal[
    "linear",
    "linear over period",
    "mean",
    "latest",
    "zero-order hold",
    "sampled",
    "delayed",
    "extrapolated",
    "solved",
]


@dataclass(frozen=True)
class ScheduledComponent:
    """A component in the schedule.

    Parameters
    ----------
    name, kind : str
    stage : int
        Number of its stage, from 1 on.
    period : float or None
        Its own [s]; None: every communication step.
    offset : float
        From the start of the run to the first instant of its period [s].
    feedthrough : mapping of output to tuple of str, or None
        On which inputs each output depends directly; None: not known.
    """

    name: str
    kind: str
    stage: int
    period: float | None
    offset: float
    feedthrough: Mapping[str, tuple[str, ...] | None]

    @property
    def rate(self) -> str:
        """How often its outputs change, in words."""
        if self.period is None:
            return "every step"
        text = f"every {self.period:g} s"
        if self.offset:
            text += f", first {self.offset:g} s after the start"
        return text


@dataclass(frozen=True)
class ScheduledConnection:
    """A connection in the schedule.

    Parameters
    ----------
    source, to : str
        Ports, or elements of them.
    course : str
        What the input has within a communication step: "linear" interpolation, or a "zero-order
        hold". Of co-simulation without input derivatives: the "mean" of both ends, or the "latest"
        value known where its source may jump inside of a step. Of a component with a period:
        "linear over period", or "sampled", with a zero-order hold over the period. In a loop also:
        "extrapolated" from the start of the step; "delayed", so that only its value there counts;
        "solved" for in every step.
    is_feedback : bool
        It leads to a component of its loop that advances before.
    """

    source: str
    to: str
    course: InputCourse
    is_feedback: bool

    @property
    def components(self) -> tuple[str, str]:
        """The components at both ends."""
        return Port.parse(self.source).component, Port.parse(self.to).component


@dataclass(frozen=True)
class ScheduledStage:
    """A stage: one component that advances a whole block at once, or a loop, step by step.

    Parameters
    ----------
    number : int
        From 1 on.
    members : tuple of str
        Its components, in the order in which they advance.
    coupling : str
        How they are coupled; empty for one outside every loop.
    operations : tuple of str
        Of one step, in their order; outputs are evaluated again where their inputs came late.
    solved : tuple of str
        The inputs that are solved for in every step.
    is_first_order : bool
        Whether its error is one of first order in the step.
    shortest_substep : float or None
        How short the parts may be into which it divides its steps [s]; None: it does not.
    substeps : tuple of str
        The components that take such parts; the others keep to its steps.
    """

    number: int
    members: tuple[str, ...]
    coupling: str
    operations: tuple[str, ...]
    solved: tuple[str, ...]
    is_first_order: bool
    shortest_substep: float | None = None
    substeps: tuple[str, ...] = ()


@dataclass(frozen=True)
class GraphSchedule:
    """How the components of a scenario advance.

    Parameters
    ----------
    scenario : str
    step : float
        Communication step [s].
    stages : tuple of ScheduledStage
        In their order.
    components : tuple of ScheduledComponent
        In the order of the stages.
    connections : tuple of ScheduledConnection
    """

    scenario: str
    step: float
    stages: tuple[ScheduledStage, ...]
    components: tuple[ScheduledComponent, ...]
    connections: tuple[ScheduledConnection, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)


def schedule_of(name: str) -> GraphSchedule:
    """Return how the components of a scenario advance; nothing of FMUs and users' classes runs.

    Raises
    ------
    ScenarioError
        With every problem of the file.
    UsageError
        If the ports of some components are not known.
    """
    described = describe(find(name))
    graph = described.graph
    if graph is None:
        unknown = sorted(described.scenario.specs.keys() - described.components.keys())
        raise UsageError(
            f"{name}: the ports of {', '.join(unknown)} are defined by user code, which is not "
            f"imported here; {command('run')} writes the schedule to its log"
        )
    stages = tuple(_stage(number, stage) for number, stage in enumerate(graph.stages, start=1))
    components = []
    for stage in stages:
        for member in stage.members:
            components.append(_component(described, graph, member, stage.number))
    connections = tuple(_connections(described, graph))
    step = described.clock.h
    title = described.scenario.name
    return GraphSchedule(title, step, stages, tuple(components), connections)


def _stage(number: int, stage: Stage) -> ScheduledStage:
    members = []
    operations = []
    for operation, name in stage.order:
        if operation == "advance":
            members.append(name)
            operations.append(f"advance {name}")
        else:
            operations.append(f"outputs of {name}")
    solved = () if stage.torn is None else tuple(stage.torn.labels)
    substeps: list[str] = []
    for control in stage.controls:
        substeps += control.components
    return ScheduledStage(
        number,
        tuple(members),
        stage.coupling,
        tuple(operations),
        solved,
        stage.is_first_order,
        stage.controls[0].tolerance.min_ns / 1e9 if stage.controls else None,
        tuple(substeps),
    )


def _component(
    described: DescribedScenario, graph: Graph, name: str, stage: int
) -> ScheduledComponent:
    channel = graph.layout[name]
    step_ns = described.clock.step_ns
    sampling = _sampling(described, name)
    steps = channel.period if sampling is None else sampling.period
    period = step_seconds(steps * step_ns) if steps > 1 else None
    offset = 0.0 if sampling is None else step_seconds(sampling.offset * step_ns)
    kind = described.scenario.specs[name].kind
    return ScheduledComponent(name, kind, stage, period, offset, _feedthrough(channel.interface))


def _sampling(described: DescribedScenario, name: str) -> Sampling | None:
    spec = described.scenario.specs[name]
    return spec.sampling(spec.period_steps(name, described.clock.step_ns))


def _feedthrough(interface: Interface) -> dict[str, tuple[str, ...] | None]:
    feedthrough: dict[str, tuple[str, ...] | None] = {}
    for output in interface.outputs:
        is_known = interface.knows(output.name)
        feedthrough[output.name] = interface.feeds(output.name) if is_known else None
    return feedthrough


def _connections(described: DescribedScenario, graph: Graph) -> Iterator[ScheduledConnection]:
    """Yield the connections, one for each source."""
    loops: dict[str, Stage] = {}
    for stage in graph.stages:
        if stage.is_loop:
            loops |= {member.name: stage for member in stage.members}
    for to, connection in graph.connections.items():
        sampling = _sampling(described, to.component)
        yield from _by_sources(graph, loops.get(to.component), to, connection, sampling)


def _by_sources(
    graph: Graph,
    loop: Stage | None,
    to: Port,
    connection: Connection,
    sampling: Sampling | None,
) -> Iterator[ScheduledConnection]:
    end = graph.ports.input(to)
    first = end.columns.start - end.channel.inputs.start
    elements = slice(first, first + end.size)
    is_held = bool(graph.held[to.component][elements].all())
    late: frozenset[str] = frozenset()
    if loop is not None:
        late = loop.extrapolated.get(to.component, frozenset())
    for source in connection.sources:
        is_inside = loop is not None and source.component in {
            member.name for member in loop.members
        }
        is_feedback = is_inside and end.signal.name in late
        course = _own_course(sampling, is_held=is_held)
        if end.signal.name in end.channel.interface.one_value and course.startswith("linear"):
            course = "latest" if graph.latest[to.component][elements].any() else "mean"
        if loop is not None and is_inside and _is_solved(loop, end.port):
            course = "solved"
        elif course == "sampled":
            pass  # late in a loop, and nothing lost
        elif is_feedback and end.signal.name in end.channel.interface.delayed:
            course = "delayed"
        elif is_feedback and graph.variability(source) != "discrete":
            course = "extrapolated"
        yield ScheduledConnection(str(source), str(to), course, is_feedback)


def _own_course(sampling: Sampling | None, *, is_held: bool) -> InputCourse:
    """Return what an input has outside a loop."""
    if sampling is None:
        return "zero-order hold" if is_held else "linear"
    if sampling.holds:
        return "sampled"
    if sampling.period == 1:
        return "zero-order hold" if is_held else "linear"
    return "sampled" if is_held else "linear over period"


def _is_solved(loop: Stage, to: Port) -> bool:
    """Return whether a loop solves for an input, or elements of it."""
    labels = () if loop.torn is None else loop.torn.labels
    return any(label == str(to) or label.startswith(f"{to}[") for label in labels)
