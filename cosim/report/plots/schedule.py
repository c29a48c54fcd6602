"""The picture of a schedule: components in layers, loops in frames, connections as arrows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from cosim.core.port import Port
from cosim.report.plots.picture import LARGEST, Picture, PictureOptions
from cosim.report.plots.schedule_layout import SchedulePlaces, layout_of
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


def plot_schedule(schedule: GraphSchedule, out: Path) -> None:
    """Draw stages, loops, rates and feedthrough to a file (.png, .svg, .pdf).

    Raises
    ------
    UsageError
        If there is no matplotlib, or the file cannot be written.
    """
    layout = layout_of(schedule)
    width = min(LARGEST, WIDTH * max(layout.layers, 2))
    height = min(LARGEST, HEIGHT * layout.height + 2.5)
    picture = Picture(1, PictureOptions((width, max(height, 5.0))), shares_time=False)
    panel = picture.panels[0]
    panel.set_axis_off()
    panel.set_xlim(-0.5, layout.layers - 0.5)
    panel.set_ylim(layout.height + 0.1, -0.1)
    for stage in schedule.stages:
        if stage.number in layout.frames:
            _draw_frame(panel, stage, layout.frames[stage.number])
    orders = _orders(schedule)
    for component in schedule.components:
        place = layout.places[component.name]
        _draw_component(panel, component, place, orders.get(component.name, ""))
    courses = _draw_connections(panel, schedule, layout)
    lines = [_legend_line(course) for course in STYLES if course in courses]
    if lines:
        panel.legend(
            handles=lines, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=5, frameon=False
        )
    picture.save(out, title=f"{schedule.scenario}: communication step {schedule.step:g} s")


def _orders(schedule: GraphSchedule) -> dict[str, str]:
    """Return the numbers of the components of loops, in the order in which they advance."""
    orders = {}
    for stage in schedule.stages:
        if stage.coupling:
            for number, name in enumerate(stage.members, start=1):
                orders[name] = f"{number}  "
    return orders


def _draw_frame(panel: Any, stage: ScheduledStage, frame: tuple[int, float, float]) -> None:
    from matplotlib.patches import FancyBboxPatch

    layer, top, bottom = frame
    patch = FancyBboxPatch(
        (layer - 0.47, top + 0.06),
        0.94,
        bottom - top - 0.12,
        boxstyle="round,pad=0,rounding_size=0.05",
        facecolor="#f3f1e7",
        edgecolor="#b8b08d",
        zorder=0,
    )
    panel.add_patch(patch)
    order = "first order" if stage.is_first_order else "second order"
    title = f"loop: {stage.coupling}, {order}"
    panel.text(layer, top + 0.22, title, ha="center", va="center", fontsize=8, color="#6b6440")


def _draw_component(
    panel: Any, component: ScheduledComponent, place: tuple[int, float], order: str
) -> None:
    from matplotlib.patches import FancyBboxPatch

    layer, middle = place
    width, height = BOX
    patch = FancyBboxPatch(
        (layer - 0.5 * width, middle - 0.5 * height),
        width,
        height,
        boxstyle="round,pad=0,rounding_size=0.03",
        facecolor="white",
        edgecolor="#333333",
        zorder=3,
    )
    panel.add_patch(patch)
    lines = [(f"{order}{component.name}", 9, "bold"), (_kind_and_rate(component), 7, "normal")]
    lines.append((_feedthrough(component), 7, "normal"))
    for row, (text, size, weight) in enumerate(lines):
        panel.text(
            layer,
            middle + (row - 1) * 0.19,
            _cut(text),
            ha="center",
            va="center",
            fontsize=size,
            weight=weight,
            zorder=4,
        )


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


@dataclass(slots=True)
class _Arrow:
    """An arrow for all connections of two components with the same course.

    ``begin`` and ``end`` are the heights of its ends, ``sides`` the sides of the components that
    they are on: +1 right, -1 left.
    """

    source: str
    target: str
    course: InputCourse
    label: str
    sides: tuple[int, int]
    begin: float = 0.0
    end: float = 0.0


def _draw_connections(
    panel: Any, schedule: GraphSchedule, layout: SchedulePlaces
) -> set[InputCourse]:
    """Draw all connections; return the courses that there are."""
    arrows = _arrows(schedule, layout)
    _spread_ends(arrows, layout)
    for arrow in arrows:
        if (arrow.source, arrow.target) in layout.lanes:
            _draw(panel, arrow, _forward_points(arrow, layout))
        else:
            _draw(panel, arrow, _points_inside(arrow, layout))
        _draw_label(panel, arrow, layout)
    return {arrow.course for arrow in arrows}


def _arrows(schedule: GraphSchedule, layout: SchedulePlaces) -> list[_Arrow]:
    inputs: dict[tuple[str, str, InputCourse], list[str]] = {}
    for connection in schedule.connections:
        source, target = connection.components
        names = inputs.setdefault((source, target, connection.course), [])
        names.append(Port.parse(connection.to).name)
    arrows = []
    for (source, target, course), names in inputs.items():
        sides = (1, -1)
        if (source, target) not in layout.lanes:
            is_down = layout.places[target][1] > layout.places[source][1]
            sides = (1, 1) if is_down else (-1, -1)
        label = _cut(", ".join(dict.fromkeys(names)))
        arrows.append(_Arrow(source, target, course, label, sides))
    return arrows


def _spread_ends(arrows: Sequence[_Arrow], layout: SchedulePlaces) -> None:
    """Spread the ends of arrows over the sides of the components, in the order of the others."""
    by_side: dict[tuple[str, int], list[tuple[float, _Arrow, bool]]] = {}
    for arrow in arrows:
        lane = layout.lanes.get((arrow.source, arrow.target), ())
        target = lane[0][1] if lane else layout.places[arrow.target][1]
        source = lane[-1][1] if lane else layout.places[arrow.source][1]
        by_side.setdefault((arrow.source, arrow.sides[0]), []).append((target, arrow, True))
        by_side.setdefault((arrow.target, arrow.sides[1]), []).append((source, arrow, False))
    for (name, _), ends in by_side.items():
        ends.sort(key=lambda end: end[0])
        middle = layout.places[name][1]
        for number, (_, arrow, is_begin) in enumerate(ends, start=1):
            height = middle + BOX[1] * (number / (len(ends) + 1) - 0.5)
            if is_begin:
                arrow.begin = height
            else:
                arrow.end = height


def _forward_points(arrow: _Arrow, layout: SchedulePlaces) -> list[tuple[float, float]]:
    """Return the way of an arrow to a later layer, through its places: ends of Bezier curves."""
    half = 0.5 * BOX[0]
    points = [(layout.places[arrow.source][0] + half, arrow.begin)]
    for layer, height in layout.lanes[arrow.source, arrow.target]:
        points += [(layer - half, height), (layer + half, height)]
    points.append((layout.places[arrow.target][0] - half, arrow.end))
    vertices = [points[0]]
    for (x0, y0), (x1, y1) in pairwise(points):
        middle = 0.5 * (x0 + x1)
        vertices += [(middle, y0), (middle, y1), (x1, y1)]
    return vertices


def _points_inside(arrow: _Arrow, layout: SchedulePlaces) -> list[tuple[float, float]]:
    """Return the way of an arrow inside a loop: down on the right side, back up on the left."""
    side = arrow.sides[0]
    middle, source_height = layout.places[arrow.source]
    _, target_height = layout.places[arrow.target]
    x = middle + side * 0.5 * BOX[0]
    distance = abs(target_height - source_height)
    bulge = x + side * min(0.06 + 0.035 * distance, 0.22)
    return [
        (x, arrow.begin),
        (bulge, arrow.begin),
        (bulge, arrow.end),
        (x, arrow.end),
    ]


def _draw(panel: Any, arrow: _Arrow, vertices: Sequence[tuple[float, float]]) -> None:
    from matplotlib.patches import FancyArrowPatch
    from matplotlib.path import Path as Curve

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


def _draw_label(panel: Any, arrow: _Arrow, layout: SchedulePlaces) -> None:
    """Name the inputs at the end of an arrow."""
    side = arrow.sides[1]
    x = layout.places[arrow.target][0] + side * (0.5 * BOX[0] + 0.045)
    panel.text(
        x,
        arrow.end - 0.045,
        arrow.label,
        ha="left" if side > 0 else "right",
        va="bottom",
        fontsize=6.5,
        color=STYLES[arrow.course][0],
        zorder=5,
        bbox={"facecolor": "white", "alpha": 0.6, "edgecolor": "none", "pad": 0.3},
    )


def _legend_line(course: InputCourse) -> Any:
    from matplotlib.lines import Line2D

    color, line = STYLES[course]
    return Line2D([], [], color=color, linestyle=line, label=course)
