"""How the components of a scenario advance: stages, loops, rates and feedthrough."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Final

from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.core.stages.coupling import Stage
from cosim.errors import UsageError, command
from cosim.instants import step_seconds
from cosim.report.plots.picture import LARGEST, Picture, PictureOptions
from cosim.report.tables.console import Shown, new_table
from cosim.scenario.building.build import describe
from cosim.scenario.document.document import find
from cosim.scenario.kinds.base import PeriodicKind
from cosim.scenario.kinds.values import Sampling

# what an input has within a communication step: in words, and color and dashes of its arrow
COURSES: Final[Mapping[str, tuple[str, str, str]]] = {
    "linear": ("linear interpolation", "#444444", "-"),
    "linear over period": ("linear interpolation over its period", "#444444", "-."),
    "mean": ("mean of both ends", "#444444", "-."),
    "latest": ("latest value, which may have jumped", "#444444", ":"),
    "zero-order hold": ("zero-order hold", "#1f6fb2", ":"),
    "sampled": ("zero-order hold of its samples", "#1f6fb2", "-."),
    "delayed": ("delayed, so its value at the start of the step is exact", "#1f6fb2", "--"),
    "extrapolated": ("extrapolated: held from the start of the step", "#c0392b", "--"),
    "solved": ("solved", "#2e7d32", "-"),
}
_CELL: Final = (4.6, 2.2)  # cm of a component and what is around it
_BOX: Final = (0.78, 0.72)  # of a component, of these
_MOST_LETTERS: Final = 24  # in a line of a box
_TURNING: Final = "angle,angleA=0,angleB=90,rad=6"
_TO_ITSELF: Final = "arc3,rad=1.0"


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
        "solved" for in every step. One of ``COURSES``.
    is_feedback : bool
        It leads to a component of its loop that advances before.
    """

    source: str
    to: str
    course: str
    is_feedback: bool


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
    scenario = described.scenario
    if described.unknown:
        unknown = sorted(scenario.specs.keys() - described.components.keys())
        raise UsageError(
            f"{name}: the ports of {', '.join(unknown)} are defined by user code, which is not "
            f"imported here; {command('run')} writes the schedule to its log"
        )
    graph = described.graph()
    step_ns = described.clock.step_ns
    stages = [_stage(number, stage) for number, stage in enumerate(graph.stages, start=1)]
    samplings = {}
    components = []
    for one in stages:
        for member in one.members:
            spec = scenario.specs[member]
            channel = graph.layout[member]
            interface = channel.interface
            feedthrough = {
                output.name: interface.feeds(output.name) if interface.knows(output.name) else None
                for output in interface.outputs
            }
            own = None
            if isinstance(spec, PeriodicKind):
                own = spec.sampling(spec.period_steps(member, step_ns))
            samplings[member] = own
            shown = own or Sampling(channel.period, 0, holds=False)
            period = step_seconds(shown.period * step_ns) if shown.period > 1 else None
            offset = step_seconds(shown.offset * step_ns)
            components.append(
                ScheduledComponent(member, spec.kind, one.number, period, offset, feedthrough)
            )
    loops = {member: stage for stage in graph.stages if stage.is_loop for _, member in stage.order}
    connections = []
    for to, written in graph.connections.items():
        for source in written.sources:
            loop = loops.get(to.component)
            loop = loop if loop is loops.get(source.component) else None
            connections.append(_connection(graph, loop, source, to, samplings[to.component]))
    return GraphSchedule(
        scenario.name, described.clock.h, tuple(stages), tuple(components), tuple(connections)
    )


def _stage(number: int, stage: Stage) -> ScheduledStage:
    return ScheduledStage(
        number,
        tuple(name for operation, name in stage.order if operation == "advance"),
        stage.coupling,
        tuple(
            f"advance {name}" if operation == "advance" else f"outputs of {name}"
            for operation, name in stage.order
        ),
        () if stage.torn is None else tuple(stage.torn.labels),
        stage.is_first_order,
        stage.controls[0].tolerance.min_ns / 1e9 if stage.controls else None,
        tuple(chain.from_iterable(control.components for control in stage.controls)),
    )


def _connection(
    graph: Graph, loop: Stage | None, source: Port, to: Port, sampling: Sampling | None
) -> ScheduledConnection:
    """Return the connection of a source with an input: what this has within a step."""
    end = graph.ports.input(to)
    name = end.signal.name
    interface = end.channel.interface
    first = end.columns.start - end.channel.inputs.start
    elements = slice(first, first + end.size)
    is_held = bool(graph.held[to.component][elements].all())
    has_period = sampling is not None and sampling.period > 1
    course = "zero-order hold" if is_held else "linear"
    if sampling is not None and (sampling.holds or (is_held and has_period)):
        course = "sampled"
    elif has_period:
        course = "linear over period"
    if name in interface.one_value and course.startswith("linear"):
        course = "latest" if graph.latest[to.component][elements].any() else "mean"
    is_feedback = loop is not None and name in loop.extrapolated.get(to.component, ())
    solved = () if loop is None or loop.torn is None else loop.torn.labels
    if any(label == str(end.port) or label.startswith(f"{end.port}[") for label in solved):
        course = "solved"
    elif is_feedback and course != "sampled":  # that is late, and nothing lost
        if name in interface.delayed:
            course = "delayed"
        elif graph.variability(source) != "discrete":
            course = "extrapolated"
    return ScheduledConnection(str(source), str(to), course, is_feedback)


# --- as tables ---


def show_schedule(schedule: GraphSchedule) -> Shown:
    """Show stages, components and connections."""
    yield asdict(schedule)
    title = f"{schedule.scenario}: stages in order, communication step {schedule.step:g} s"
    stages = [(str(one.number), ", ".join(one.members), _way(one)) for one in schedule.stages]
    components = [
        (one.name, str(one.stage), one.kind, one.rate, _feedthrough_text(one))
        for one in schedule.components
    ]
    connections = [(one.source, one.to, COURSES[one.course][0]) for one in schedule.connections]
    headings = ("", "stage", "kind", "outputs change", "direct feedthrough")
    yield [
        new_table(title, ("", "components", "advance"), stages),
        new_table("components", headings, components),
        new_table("connections", ("from", "to", "within a step"), connections),
    ]


def _way(stage: ScheduledStage) -> str:
    """Return how the components of a stage advance."""
    if not stage.coupling:
        return "in blocks of steps"
    text = f"step by step, {stage.coupling}: {', '.join(stage.operations)}"
    if stage.solved:
        text += f"; solved in every step: {', '.join(stage.solved)}"
    if stage.is_first_order:
        text += "; coupling error: first order"
    if stage.shortest_substep is not None:
        some = len(stage.substeps) < len(stage.members)
        names = f"{', '.join(stage.substeps)} " if some else ""
        text += f"; {names}in substeps of at least {stage.shortest_substep:g} s"
    return text


def _feedthrough_text(component: ScheduledComponent) -> str:
    """Return on which inputs the outputs of a component depend directly."""
    texts = []
    without = []
    for output, inputs in component.feedthrough.items():
        if inputs is None:
            texts.append(f"{output}: not known")
        elif inputs:
            texts.append(f"{output} from {' '.join(inputs)}")
        else:
            without.append(output)
    if texts and without:
        texts.append(f"none: {' '.join(without)}")
    return ", ".join(texts) or "none"


# --- as a picture ---


def plot_schedule(schedule: GraphSchedule, out: Path) -> None:
    """Draw stages, loops, rates and feedthrough to a file (.png, .svg, .pdf).

    It is an N2 chart (A. B. Lambe and J. R. R. A. Martins, Struct. Multidiscip. Optim. 46, 2012):
    the components stand on the diagonal, in the order in which they advance. An arrow leaves a
    component to the right and enters the one that it drives from above: it leads on in the order.
    One that leads back, in a loop, leaves to the left and enters from below. Where it turns stand
    the inputs that it drives. So no two arrows lie on each other, and none runs through a
    component.

    Raises
    ------
    UsageError
        If there is no matplotlib, or the file cannot be written.
    """
    from matplotlib.lines import Line2D

    count = len(schedule.components)
    width, height = (min(LARGEST, length * count + 2.5) for length in _CELL)
    picture = Picture(1, PictureOptions((width, height)), shares_time=False)
    (panel,) = picture.panels
    panel.set_axis_off()
    panel.set(xlim=(-0.5, count - 0.5), ylim=(count - 0.5, -0.5))
    order = {one.name: place for place, one in enumerate(schedule.components)}
    numbers: dict[str, str] = {}  # of components, in their loops
    for stage in schedule.stages:
        if stage.coupling:
            numbers |= {name: f"{k}  " for k, name in enumerate(stage.members, start=1)}
            first, size = order[stage.members[0]], len(stage.members)
            _draw_box(panel, first, first, (size - 0.04, size - 0.04), ("#f3f1e7", "#b8b08d", 0))
            title = f"loop: {stage.coupling}, {'first' if stage.is_first_order else 'second'} order"
            panel.text(first - 0.45, first + size - 0.54, title, fontsize=7, color="#6b6440")
    for place, component in enumerate(schedule.components):
        _draw_box(panel, place, place, _BOX, ("white", "#333333", 3))
        style: dict[str, Any] = {"ha": "center", "zorder": 4}
        name = _cut(f"{numbers.get(component.name, '')}{component.name}")
        panel.text(place, place - 0.12, name, fontsize=9, weight="bold", va="bottom", **style)
        panel.text(place, place - 0.08, _about(component), fontsize=7, va="top", **style)
    _draw_arrows(panel, schedule, order)
    courses = {connection.course for connection in schedule.connections}
    lines = [
        Line2D([], [], color=color, linestyle=dashes, label=course)
        for course, (_, color, dashes) in COURSES.items()
        if course in courses
    ]
    if lines:
        picture.legend(lines, below=True)
    picture.save(out, title=f"{schedule.scenario}: communication step {schedule.step:g} s")


def _draw_box(
    panel: Any, x: float, y: float, size: tuple[float, float], look: tuple[str, str, int]
) -> None:
    """Draw a box whose first cell has its middle in ``x`` and ``y``, with round corners."""
    from matplotlib.patches import FancyBboxPatch

    face, edge, zorder = look
    corner = (x - 0.5 * min(size[0], 0.96), y - 0.5 * min(size[1], 0.96))
    shape = "round,pad=0,rounding_size=0.03"
    panel.add_patch(
        FancyBboxPatch(corner, *size, shape, facecolor=face, edgecolor=edge, zorder=zorder)
    )


def _about(component: ScheduledComponent) -> str:
    """Return what a box says of its component: kind, period with offset, and feedthrough."""
    lines = [component.kind]
    if component.period is not None:
        offset = f" + {component.offset:g} s" if component.offset else ""
        lines.append(f"every {component.period:g} s{offset}")
    fed = [name for inputs in component.feedthrough.values() for name in inputs or ()]
    if None in component.feedthrough.values():
        lines.append("feedthrough not known")
    else:
        lines.append(f"feedthrough: {' '.join(dict.fromkeys(fed))}" if fed else "no feedthrough")
    return "\n".join(map(_cut, lines))


def _cut(text: str) -> str:
    return text if len(text) <= _MOST_LETTERS else f"{text[: _MOST_LETTERS - 1]}…"


def _draw_arrows(panel: Any, schedule: GraphSchedule, order: dict[str, int]) -> None:
    """Draw an arrow for all connections of two components with the same course."""
    arrows: dict[tuple[int, int, str], list[str]] = {}  # source, target, course: inputs
    for one in schedule.connections:
        start, end = Port.parse(one.source), Port.parse(one.to)
        arrow = (order[start.component], order[end.component], one.course)
        arrows.setdefault(arrow, []).append(end.name)
    for arrow, names in arrows.items():
        source, target, course = arrow
        # Along a side the arrows stand in such an order that those of a component do not cross.
        is_forward = target > source
        beside = [one for one in arrows if (one[1] > one[0]) == is_forward]
        leaving = sorted([one[1:] for one in beside if one[0] == source], reverse=True)
        entering = sorted([(-one[0], one[2]) for one in beside if one[1] == target])
        y = source + _BOX[1] * _share(leaving, (target, course))
        x = target + _BOX[0] * _share(entering, (-source, course))
        sign = 1 if is_forward else -1
        _, color, dashes = COURSES[course]
        style = {
            "arrowstyle": "-|>",
            "connectionstyle": _TURNING if source != target else _TO_ITSELF,
            "color": color,
            "linestyle": dashes,
            "shrinkA": 0.0,
            "shrinkB": 0.0,
            "mutation_scale": 8,
        }
        tip = (x, target - sign * 0.5 * _BOX[1])
        panel.annotate("", tip, (source + sign * 0.5 * _BOX[0], y), arrowprops=style, zorder=2)
        panel.text(
            x - sign * 0.03,
            y if source != target else tip[1] + 0.26,
            _cut(", ".join(dict.fromkeys(names))),
            ha="right" if is_forward else "left",
            va="bottom",
            fontsize=6.5,
            color=color,
            zorder=5,
        )


def _share(places: list[Any], place: Any) -> float:
    """Return where one of several places along a side is, from -0.5 to 0.5."""
    return (places.index(place) + 1) / (len(places) + 1) - 0.5
