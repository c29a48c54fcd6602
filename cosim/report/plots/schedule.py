"""The picture of a schedule: components on the diagonal, in the order in which they advance.

An arrow leaves a component to the side and enters the one that it drives from above: it leads on
in the order. One that leads back, in a loop, leaves to the left and enters from below. Where it
turns stand the inputs that it drives. So no two arrows lie on each other, and none runs through a
component (an N2 chart, as of systems engineering: A. B. Lambe and J. R. R. A. Martins, Struct.
Multidiscip. Optim. 46, 2012).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from cosim.core.port import Port
from cosim.report.plots.picture import LARGEST, Picture, PictureOptions
from cosim.report.schedule import COURSES, GraphSchedule, ScheduledComponent

_CELL: Final = (4.6, 2.2)  # cm of a component and what is around it
_BOX: Final = (0.78, 0.72)  # of a component, of these
_MOST_LETTERS: Final = 24  # in a line of a box
_TURNING: Final = "angle,angleA=0,angleB=90,rad=6"
_TO_ITSELF: Final = "arc3,rad=1.0"


def plot_schedule(schedule: GraphSchedule, out: Path) -> None:
    """Draw stages, loops, rates and feedthrough to a file (.png, .svg, .pdf).

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
