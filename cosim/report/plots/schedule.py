"""The picture of a schedule: components in layers, loops in frames, connections as arrows.

A stage stands right of all that drive it. The components of a loop stand below each other, in the
order in which they advance. A connection over several layers has a place of its own in each layer
between, so that it runs beside what stands there. Within a layer, what is connected to the layer
before comes in the order that this has there, by the mean place of its sources (barycenters;
K. Sugiyama, S. Tagawa, M. Toda, IEEE Trans. SMC 11, 1981), and in a second sweep by that of what
it drives.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from cosim.core.port import Port
from cosim.report.plots.picture import LARGEST, Picture, PictureOptions
from cosim.report.schedule import GraphSchedule, InputCourse, ScheduledComponent, ScheduledStage

WIDTH: Final = 6.4  # cm of a layer
HEIGHT: Final = 2.1  # cm of a component
BOX: Final = (0.56, 0.66)  # of a component, of these
STYLES: Final[Mapping[InputCourse, tuple[str, str]]] = {  # color, line
    "linear": ("#444444", "-"),
    "linear over period": ("#444444", "-."),
    "mean": ("#444444", "-."),
    "latest": ("#444444", ":"),
    "zero-order hold": ("#1f6fb2", ":"),
    "sampled": ("#1f6fb2", "-."),
    "delayed": ("#1f6fb2", "--"),
    "extrapolated": ("#c0392b", "--"),
    "solved": ("#2e7d32", "-"),
}
MOST_LETTERS: Final = 24  # in a line of a box
_OF_COMPONENT: Final = {
    "boxstyle": "round,pad=0,rounding_size=0.03",
    "facecolor": "white",
    "edgecolor": "#333333",
    "zorder": 3,
}
_OF_LOOP: Final = {
    "boxstyle": "round,pad=0,rounding_size=0.05",
    "facecolor": "#f3f1e7",
    "edgecolor": "#b8b08d",
    "zorder": 0,
}
_SWEEPS: Final = 4
_LANE: Final = 0.3  # height of the place of a connection, of that of a component
_LOOP: Final = 0.35  # more height of a loop, for its frame and its title


def plot_schedule(schedule: GraphSchedule, out: Path) -> None:
    """Draw stages, loops, rates and feedthrough to a file (.png, .svg, .pdf).

    Raises
    ------
    UsageError
        If there is no matplotlib, or the file cannot be written.
    """
    from matplotlib.lines import Line2D

    layout = layout_of(schedule)
    width = min(LARGEST, WIDTH * max(layout.layers, 2))
    height = min(LARGEST, HEIGHT * layout.height + 2.5)
    picture = Picture(1, PictureOptions((width, max(height, 5.0))), shares_time=False)
    panel = picture.panels[0]
    panel.set_axis_off()
    panel.set_xlim(-0.5, layout.layers - 0.5)
    panel.set_ylim(layout.height + 0.1, -0.1)
    orders: dict[str, str] = {}  # of the components of loops
    for stage in schedule.stages:
        if stage.coupling:
            _draw_frame(panel, stage, layout.frames[stage.number])
            orders |= {name: f"{i}  " for i, name in enumerate(stage.members, start=1)}
    for component in schedule.components:
        order = orders.get(component.name, "")
        _draw_component(panel, component, layout.places[component.name], order)
    arrows = _arrows(schedule, layout)
    for arrow in arrows:
        _draw_arrow(panel, arrow, layout)
    courses = {arrow.course for arrow in arrows}
    lines = []
    for course, (color, line) in STYLES.items():
        if course in courses:
            lines.append(Line2D([], [], color=color, linestyle=line, label=course))
    if lines:
        place = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0)}
        panel.legend(handles=lines, ncols=5, frameon=False, **place)
    picture.save(out, title=f"{schedule.scenario}: communication step {schedule.step:g} s")


# --- places ---


@dataclass(frozen=True, slots=True)
class SchedulePlaces:
    """Places of components and the ways of connections.

    Parameters
    ----------
    places : mapping of component name to (layer, height from the top)
        Heights are counted in components.
    frames : mapping of stage number to (layer, top, bottom)
        Of the loops.
    lanes : mapping of (source, target) to sequence of (layer, height)
        What a connection between stages passes on its way, by the components at its ends.
    layers : int
    height : float
    """

    places: Mapping[str, tuple[int, float]]
    frames: Mapping[int, tuple[int, float, float]]
    lanes: Mapping[tuple[str, str], Sequence[tuple[int, float]]]
    layers: int
    height: float


@dataclass(slots=True)
class _Block:
    """What stands in a layer: a stage, or the place of a connection."""

    layer: int
    height: float
    before: list[_Block] = field(default_factory=list)
    behind: list[_Block] = field(default_factory=list)
    top: float = 0.0

    @property
    def middle(self) -> float:
        return self.top + 0.5 * self.height


def layout_of(schedule: GraphSchedule) -> SchedulePlaces:
    """Place the components of a schedule."""
    stage_of: dict[str, int] = {}
    for stage in schedule.stages:
        stage_of |= dict.fromkeys(stage.members, stage.number)
    pairs = dict.fromkeys(connection.components for connection in schedule.connections)
    between = [(a, b) for a, b in pairs if stage_of[a] != stage_of[b]]
    layers = _layers(schedule, [(stage_of[a], stage_of[b]) for a, b in between])
    columns: list[list[_Block]] = [[] for _ in range(max(layers.values(), default=0) + 1)]
    blocks: dict[int, _Block] = {}
    for stage in schedule.stages:
        extra = _LOOP if stage.coupling else 0.0
        block = blocks[stage.number] = _Block(layers[stage.number], len(stage.members) + extra)
        columns[block.layer].append(block)
    passed: dict[tuple[str, str], list[_Block]] = {}
    for source, target in between:
        first = blocks[stage_of[source]]
        last = blocks[stage_of[target]]
        lane = [_Block(layer, _LANE) for layer in range(first.layer + 1, last.layer)]
        for block in lane:
            columns[block.layer].append(block)
        for one, other in pairwise([first, *lane, last]):
            one.behind.append(other)
            other.before.append(one)
        passed[source, target] = lane
    height = _arrange(columns)
    places: dict[str, tuple[int, float]] = {}
    frames: dict[int, tuple[int, float, float]] = {}
    for stage in schedule.stages:
        block = blocks[stage.number]
        bottom = block.top + block.height
        for row, name in enumerate(reversed(stage.members)):
            places[name] = (block.layer, bottom - row - 0.5)
        if stage.coupling:
            frames[stage.number] = (block.layer, block.top, bottom)
    lanes = {pair: [(one.layer, one.middle) for one in lane] for pair, lane in passed.items()}
    return SchedulePlaces(places, frames, lanes, len(columns), height)


def _layers(schedule: GraphSchedule, edges: Sequence[tuple[int, int]]) -> dict[int, int]:
    """Return the layer of every stage; sources stand just before what they drive."""
    layers: dict[int, int] = {}
    for stage in schedule.stages:  # in topological order
        before = [layers[source] for source, target in edges if target == stage.number]
        layers[stage.number] = max(before, default=-1) + 1
    driven = {target for _, target in edges}
    for stage in reversed(schedule.stages):
        behind = [layers[target] for source, target in edges if source == stage.number]
        if behind and stage.number not in driven:
            layers[stage.number] = min(behind) - 1
    return layers


def _arrange(columns: Sequence[list[_Block]]) -> float:
    """Order the blocks of every layer, and give them their heights; return that of the whole."""
    whole = max(sum(block.height for block in column) for column in columns)
    for column in columns:
        _stack(column, whole)
    for sweep in range(_SWEEPS):
        is_forward = sweep % 2 == 0
        for column in columns if is_forward else reversed(columns):
            ranks = {}
            for block in column:
                others = (block.before if is_forward else block.behind) or [block]
                ranks[id(block)] = sum(other.middle for other in others) / len(others)
            column.sort(key=lambda block, ranks=ranks: ranks[id(block)])  # type: ignore[misc]
            _stack(column, whole)
    return whole


def _stack(column: Sequence[_Block], whole: float) -> None:
    """Put the blocks of a layer below each other, around the middle."""
    top = 0.5 * (whole - sum(block.height for block in column))
    for block in column:
        block.top = top
        top += block.height


# --- what stands there ---


def _draw_box(panel: Any, x: float, top: float, size: tuple[float, float], style: Any) -> None:
    """Draw a box with round corners, ``x`` in its middle."""
    from matplotlib.patches import FancyBboxPatch

    panel.add_patch(FancyBboxPatch((x - 0.5 * size[0], top), *size, **style))


def _draw_frame(panel: Any, stage: ScheduledStage, frame: tuple[int, float, float]) -> None:
    layer, top, bottom = frame
    _draw_box(panel, layer, top + 0.06, (0.94, bottom - top - 0.12), _OF_LOOP)
    order = "first order" if stage.is_first_order else "second order"
    title = f"loop: {stage.coupling}, {order}"
    panel.text(layer, top + 0.22, title, ha="center", va="center", fontsize=8, color="#6b6440")


def _draw_component(
    panel: Any, component: ScheduledComponent, place: tuple[int, float], order: str
) -> None:
    layer, middle = place
    _draw_box(panel, layer, middle - 0.5 * BOX[1], BOX, _OF_COMPONENT)
    style: dict[str, Any] = {"ha": "center", "va": "center", "zorder": 4}
    name = _cut(f"{order}{component.name}")
    panel.text(layer, middle - 0.19, name, fontsize=9, weight="bold", **style)
    panel.text(layer, middle, _cut(_kind_and_rate(component)), fontsize=7, **style)
    panel.text(layer, middle + 0.19, _cut(_feedthrough(component)), fontsize=7, **style)


def _kind_and_rate(component: ScheduledComponent) -> str:
    """Return kind and period in a line; of a period with an offset both, where there is room."""
    if component.period is None:
        return component.kind
    rate = f"every {component.period:g} s"
    if component.offset:
        rate += f" + {component.offset:g} s"
    text = f"{component.kind}, {rate}"
    return text if len(text) <= MOST_LETTERS or not component.offset else rate


def _feedthrough(component: ScheduledComponent) -> str:
    """Return in a line which inputs feed through, to any of the outputs."""
    fed: dict[str, None] = {}
    for inputs in component.feedthrough.values():
        if inputs is None:
            return "feedthrough not known"
        fed |= dict.fromkeys(inputs)
    return f"feedthrough: {' '.join(fed)}" if fed else "no feedthrough"


def _cut(text: str) -> str:
    return text if len(text) <= MOST_LETTERS else f"{text[: MOST_LETTERS - 1]}…"


# --- arrows ---


@dataclass(slots=True)
class _Arrow:
    """An arrow for all connections of two components with the same course.

    ``ends`` are the heights where it leaves and arrives, ``sides`` the sides of the components
    there: +1 right, -1 left. ``names`` are the inputs it leads to.
    """

    components: tuple[str, str]
    course: InputCourse
    sides: tuple[int, int]
    names: list[str] = field(default_factory=list)
    ends: list[float] = field(default_factory=lambda: [0.0, 0.0])


def _arrows(schedule: GraphSchedule, layout: SchedulePlaces) -> list[_Arrow]:
    """Return the arrows; their ends are spread over the sides, in the order of the other ends."""
    arrows: dict[tuple[tuple[str, str], InputCourse], _Arrow] = {}
    for connection in schedule.connections:
        pair = connection.components
        sides = (1, -1)
        if pair not in layout.lanes:
            is_down = layout.places[pair[1]][1] > layout.places[pair[0]][1]
            sides = (1, 1) if is_down else (-1, -1)
        arrow = arrows.setdefault((pair, connection.course), _Arrow(pair, connection.course, sides))
        arrow.names.append(Port.parse(connection.to).name)
    by_side: dict[tuple[str, int], list[tuple[float, _Arrow, int]]] = {}
    for arrow in arrows.values():
        source, target = arrow.components
        way = [
            layout.places[source],
            *layout.lanes.get(arrow.components, ()),
            layout.places[target],
        ]
        by_side.setdefault((source, arrow.sides[0]), []).append((way[1][1], arrow, 0))
        by_side.setdefault((target, arrow.sides[1]), []).append((way[-2][1], arrow, 1))
    for (name, _), ends in by_side.items():
        ends.sort(key=lambda end: end[0])
        for number, (_, arrow, end) in enumerate(ends, start=1):
            part = number / (len(ends) + 1) - 0.5
            arrow.ends[end] = layout.places[name][1] + BOX[1] * part
    return list(arrows.values())


def _draw_arrow(panel: Any, arrow: _Arrow, layout: SchedulePlaces) -> None:
    """Draw an arrow, and name the inputs at its end."""
    from matplotlib.patches import FancyArrowPatch
    from matplotlib.path import Path as Curve

    vertices = _way(arrow, layout)
    codes = [Curve.MOVETO, *[Curve.CURVE4] * (len(vertices) - 1)]
    color, line = STYLES[arrow.course]
    patch = FancyArrowPatch(
        path=Curve(vertices, codes),
        arrowstyle="-|>",
        mutation_scale=8,
        color=color,
        linestyle=line,
        linewidth=1.0,
        shrinkA=0.0,
        shrinkB=0.0,
        zorder=2,
    )
    panel.add_patch(patch)
    x, y = vertices[-1]
    side = arrow.sides[1]
    panel.text(
        x + side * 0.045,
        y - 0.045,
        _cut(", ".join(dict.fromkeys(arrow.names))),
        ha="left" if side > 0 else "right",
        va="bottom",
        fontsize=6.5,
        color=color,
        zorder=5,
        bbox={"facecolor": "white", "alpha": 0.6, "edgecolor": "none", "pad": 0.3},
    )


def _way(arrow: _Arrow, layout: SchedulePlaces) -> list[tuple[float, float]]:
    """Return the way of an arrow: ends of Bezier curves, each after its two handles.

    Between stages it leads through its lanes; inside a loop down on the right side, or back up on
    the left.
    """
    half = 0.5 * BOX[0]
    source, target = arrow.components
    begin = (layout.places[source][0] + arrow.sides[0] * half, arrow.ends[0])
    end = (layout.places[target][0] + arrow.sides[1] * half, arrow.ends[1])
    if arrow.components not in layout.lanes:
        distance = abs(layout.places[target][1] - layout.places[source][1])
        bulge = begin[0] + arrow.sides[0] * min(0.06 + 0.035 * distance, 0.22)
        return [begin, (bulge, begin[1]), (bulge, end[1]), end]
    points = [begin]
    for layer, height in layout.lanes[arrow.components]:
        points += [(layer - half, height), (layer + half, height)]
    vertices = [begin]
    for (x0, y0), (x1, y1) in pairwise([*points, end]):
        middle = 0.5 * (x0 + x1)
        vertices += [(middle, y0), (middle, y1), (x1, y1)]
    return vertices
