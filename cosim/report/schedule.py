"""How the components of a scenario advance: stages, loops, rates and feedthrough."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any, Final

from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.core.stages.coupling import Stage
from cosim.errors import UsageError, command
from cosim.instants import step_seconds
from cosim.report.plots.picture import LARGEST, Picture, PictureOptions
from cosim.report.tables.console import Section, Shown, section_tables
from cosim.scenario.building.build import describe
from cosim.scenario.document.document import find
from cosim.scenario.kinds.base import PeriodicKind
from cosim.scenario.kinds.values import Sampling

# What an input has within a communication step: in words, and color and dashes of its arrow. Of
# co-simulation without input derivatives it is "mean", or "latest" where its source may jump
# inside of a step; of a component with a period "linear over period" or "sampled"; in a loop also
# "extrapolated", "delayed" (only its value at the start of the step counts), "solved".
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


def describe_schedule(name: str) -> Section:
    """Describe how the components of a scenario advance; nothing of FMUs and users' classes runs.

    Returns
    -------
    dict
        ``stages`` and ``components`` in their order: a stage is one component that advances a
        whole block at once, or a loop, step by step. ``connections``: with one of ``COURSES``, and
        whether they lead to a component of their loop that advances before.

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
    stages: dict[str, tuple[int, Stage]] = {}  # of components, in their order, with numbers
    for number, stage in enumerate(graph.stages, start=1):
        members = [member for operation, member in stage.order if operation == "advance"]
        stages |= dict.fromkeys(members, (number, stage))
    samplings = {}
    components = []
    for member, (number, _) in stages.items():
        spec = scenario.specs[member]
        channel = graph.layout[member]
        interface = channel.interface
        own = None
        if isinstance(spec, PeriodicKind):
            own = spec.sampling(spec.period_steps(member, step_ns))
        samplings[member] = own
        shown = own or Sampling(channel.period, 0, holds=False)
        row = {
            "name": member,
            "kind": spec.kind,
            "stage": number,
            "period": step_seconds(shown.period * step_ns) if shown.period > 1 else None,
            "offset": step_seconds(shown.offset * step_ns),
            "feedthrough": {
                output.name: interface.feeds(output.name) if interface.knows(output.name) else None
                for output in interface.outputs
            },
        }
        components.append(row)
    connections = []
    for to, written in graph.connections.items():
        number, stage = stages[to.component]
        for source in written.sources:
            loop = stage if stage.is_loop and stages[source.component][0] == number else None
            connections.append(_connection(graph, loop, source, to, samplings[to.component]))
    return {
        "scenario": scenario.name,
        "step": described.clock.h,
        "stages": [_stage(number, stage) for number, stage in enumerate(graph.stages, start=1)],
        "components": components,
        "connections": connections,
    }


def _stage(number: int, stage: Stage) -> Section:
    return {
        "number": number,
        "members": [name for operation, name in stage.order if operation == "advance"],
        "coupling": stage.coupling,
        # outputs are evaluated again where their inputs came late
        "operations": [
            f"advance {name}" if operation == "advance" else f"outputs of {name}"
            for operation, name in stage.order
        ],
        "solved": [] if stage.torn is None else list(stage.torn.labels),
        "is_first_order": stage.is_first_order,
        "shortest_substep": stage.controls[0].tolerance.min_ns / 1e9 if stage.controls else None,
        # which take substeps; the others keep to the steps
        "substeps": list(chain.from_iterable(control.components for control in stage.controls)),
    }


def _connection(
    graph: Graph, loop: Stage | None, source: Port, to: Port, sampling: Sampling | None
) -> Section:
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
    return {"source": str(source), "to": str(to), "course": course, "is_feedback": is_feedback}


# --- as tables ---


def show_schedule(schedule: Section) -> Shown:
    """Show stages, components and connections."""
    yield schedule
    title = f"{schedule['scenario']}: stages in order, communication step {schedule['step']:g} s"
    stages = [
        {"": one["number"], "components": ", ".join(one["members"]), "advance": _way(one)}
        for one in schedule["stages"]
    ]
    components = [
        {
            "": one["name"],
            "stage": one["stage"],
            "kind": one["kind"],
            "outputs change": _rate(one),
            "direct feedthrough": _feedthrough_text(one["feedthrough"]),
        }
        for one in schedule["components"]
    ]
    connections = [
        {"from": one["source"], "to": one["to"], "within a step": COURSES[one["course"]][0]}
        for one in schedule["connections"]
    ]
    sections = {title: stages, "components": components, "connections": connections}
    yield section_tables(sections.items())


def _way(stage: Section) -> str:
    """Return how the components of a stage advance."""
    if not stage["coupling"]:
        return "in blocks of steps"
    text = f"step by step, {stage['coupling']}: {', '.join(stage['operations'])}"
    if stage["solved"]:
        text += f"; solved in every step: {', '.join(stage['solved'])}"
    if stage["is_first_order"]:
        text += "; coupling error: first order"
    if stage["shortest_substep"] is not None:
        some = len(stage["substeps"]) < len(stage["members"])
        names = f"{', '.join(stage['substeps'])} " if some else ""
        text += f"; {names}in substeps of at least {stage['shortest_substep']:g} s"
    return text


def _rate(component: Section) -> str:
    """Return how often the outputs of a component change."""
    if component["period"] is None:
        return "every step"
    offset = component["offset"]
    later = f", first {offset:g} s after the start" if offset else ""
    return f"every {component['period']:g} s{later}"


def _feedthrough_text(feedthrough: Mapping[str, tuple[str, ...] | None]) -> str:
    """Return on which inputs the outputs of a component depend directly."""
    texts = []
    for output, inputs in feedthrough.items():
        if inputs is None:
            texts.append(f"{output}: not known")
        elif inputs:
            texts.append(f"{output} from {' '.join(inputs)}")
    without = [output for output, inputs in feedthrough.items() if inputs == ()]
    if texts and without:
        texts.append(f"none: {' '.join(without)}")
    return ", ".join(texts) or "none"


# --- as a picture ---


def plot_schedule(schedule: Section, out: Path) -> None:
    """Draw stages, loops, rates and feedthrough to a file (.png, .svg, .pdf).

    It is an N2 chart (A. B. Lambe and J. R. R. A. Martins, Struct. Multidiscip. Optim. 46, 2012):
    the components stand on the diagonal, in the order in which they advance. An arrow leaves a
    component to the right and enters the one that it drives from above: it leads on in the order.
    One that leads back, in a loop, leaves to the left and enters from below. Where it turns stand
    the inputs that it drives. Arrows of different courses never lie on each other.

    Raises
    ------
    UsageError
        If there is no matplotlib, or the file cannot be written.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Rectangle

    components = schedule["components"]
    count = len(components)
    width, height = (min(LARGEST, length * count + 2.5) for length in _CELL)
    picture = Picture(1, PictureOptions((width, height)), shares_time=False)
    (panel,) = picture.panels
    panel.set_axis_off()
    panel.set(xlim=(-0.5, count - 0.5), ylim=(count - 0.5, -0.5))
    places = {one["name"]: place for place, one in enumerate(components)}
    numbers: dict[str, str] = {}  # of components, in their loops
    for stage in schedule["stages"]:
        if stage["coupling"]:
            numbers |= {name: f"{k}  " for k, name in enumerate(stage["members"], start=1)}
            first, size = places[stage["members"][0]], len(stage["members"])
            look: dict[str, Any] = {"facecolor": "#f3f1e7", "edgecolor": "#b8b08d"}
            panel.add_patch(
                Rectangle((first - 0.48, first - 0.48), size - 0.04, size - 0.04, **look)
            )
            order = "first" if stage["is_first_order"] else "second"
            title = f"loop: {stage['coupling']}, {order} order"
            panel.text(first - 0.45, first + size - 0.54, title, fontsize=7, color="#6b6440")
    style: dict[str, Any] = {"ha": "center", "zorder": 4}
    for place, one in enumerate(components):
        corner = (place - 0.5 * _BOX[0], place - 0.5 * _BOX[1])
        panel.add_patch(Rectangle(corner, *_BOX, facecolor="white", edgecolor="#333333", zorder=3))
        name = _cut(f"{numbers.get(one['name'], '')}{one['name']}")
        panel.text(place, place - 0.12, name, fontsize=9, weight="bold", va="bottom", **style)
        fed = [("not known",) if on is None else on for on in one["feedthrough"].values()]
        inputs = " ".join(dict.fromkeys(chain.from_iterable(fed))) or "none"
        lines = (one["kind"], _rate(one), f"feedthrough: {inputs}")
        about = "\n".join(map(_cut, lines))
        panel.text(place, place - 0.08, about, fontsize=7, va="top", **style)
    _draw_arrows(panel, schedule["connections"], places)
    present = {connection["course"] for connection in schedule["connections"]}
    courses = [
        Line2D([], [], color=color, linestyle=dashes, label=course)
        for course, (_, color, dashes) in COURSES.items()
        if course in present
    ]
    if courses:
        picture.legend(courses, below=True)
    picture.save(out, title=f"{schedule['scenario']}: communication step {schedule['step']:g} s")


def _cut(text: str) -> str:
    return text if len(text) <= _MOST_LETTERS else f"{text[: _MOST_LETTERS - 1]}…"


def _draw_arrows(panel: Any, connections: list[Section], places: Mapping[str, int]) -> None:
    """Draw an arrow for all connections of two components with the same course."""
    arrows: dict[tuple[int, int, str], list[str]] = {}  # source, target, course: inputs
    for one in connections:
        start, end = Port.parse(one["source"]), Port.parse(one["to"])
        arrow = (places[start.component], places[end.component], one["course"])
        arrows.setdefault(arrow, []).append(end.name)
    courses = [course for course in COURSES if any(course == own for *_, own in arrows)]
    for (source, target, course), names in arrows.items():
        share = (courses.index(course) + 1) / (len(courses) + 1) - 0.5  # of a side of a box
        x = target + _BOX[0] * share
        y = source + _BOX[1] * share
        sign = 1 if target > source else -1
        is_own = source == target
        tip = (x, target - sign * 0.5 * _BOX[1])
        _, color, dashes = COURSES[course]
        style = {
            "arrowstyle": "-|>",
            "connectionstyle": "arc3,rad=1.0" if is_own else "angle,angleA=0,angleB=90,rad=6",
            "color": color,
            "linestyle": dashes,
            "shrinkA": 0.0,
            "shrinkB": 0.0,
            "mutation_scale": 8,
        }
        panel.annotate("", tip, (source + sign * 0.5 * _BOX[0], y), arrowprops=style, zorder=2)
        look = {"ha": "right" if sign > 0 else "left", "va": "bottom", "color": color, "zorder": 5}
        text = _cut(", ".join(dict.fromkeys(names)))
        panel.text(x - sign * 0.03, tip[1] + 0.26 if is_own else y, text, fontsize=6.5, **look)
