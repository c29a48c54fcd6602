"""Texts that fit a picture: titles, legends and names at axes, broken into lines where needed."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, Final

_WORDS: Final = re.compile(r"\S+\s*|\s+")
_PARTS: Final = re.compile(r"[^._/]+[._/]*|[._/]+")  # of a name, with what ends them
_MARGIN: Final = 0.97  # of the room, that is used
_MOST_COLUMNS: Final = 6  # of a legend
_APART: Final = 1.25  # of the length of a number: from one to the next
_GAP: Final = 3.0  # between numbers [dots]
_ROOMY: Final = 0.5  # of the part of a picture that a panel has: its axes have more mostly


def broken(text: str, count: int) -> str:
    """Return a text in lines of at most so many characters, broken after blanks.

    A name that is longer is broken after its dots and bars, and a part of it anywhere.
    """
    lines = []
    for line in text.split("\n"):
        current = ""
        for piece in _pieces(line, count):
            if current and len((current + piece).rstrip()) > count:
                lines.append(current.rstrip())
                current = ""
            current += piece
        lines.append(current.rstrip())
    return "\n".join(lines)


def fit_title(figure: Any, text: str) -> None:
    """Write the title of a figure, in as many lines as it needs."""
    title = figure.suptitle(text)
    _fit(title, text, figure.bbox.width)


def fit_legend(figure: Any, lines: Sequence[Any], *, place: str, title: str = "") -> None:
    """Show a legend in as many columns as fit side by side."""
    texts = [line.get_label() for line in lines]
    for columns in range(min(_MOST_COLUMNS, len(lines)), 0, -1):
        legend = figure.legend(
            handles=list(lines),
            labels=texts,
            loc=place,
            ncols=columns,
            frameon=False,
            title=title or None,
        )
        _fit(legend.get_title(), title, _MARGIN * figure.bbox.width)
        width = legend.get_window_extent().width
        if width <= figure.bbox.width:
            return
        if columns > 1:
            legend.remove()
    handles = width - max(text.get_window_extent().width for text in legend.get_texts())
    for text in legend.get_texts():
        _fit(text, text.get_text(), figure.bbox.width - handles)


def fit_ticks(figure: Any) -> None:
    """Leave out numbers at the axes of a figure that would run into others."""
    from matplotlib.ticker import MaxNLocator

    figure.draw_without_rendering()  # how long numbers are is known only then
    for panel in figure.axes:
        for axis in (panel.xaxis, panel.yaxis):
            if axis.get_scale() == "log":
                _thin_out(axis)
        locator = panel.xaxis.get_major_locator()
        widths = [label.get_window_extent().width for label in panel.xaxis.get_majorticklabels()]
        room = panel.get_window_extent().width / max(_APART * max(widths, default=0.0), 1.0)
        if isinstance(locator, MaxNLocator) and room < len(widths):
            locator.set_params(nbins=max(int(room), 1))


def _thin_out(axis: Any) -> None:
    """Write the numbers between powers of ten only where they have room."""
    direction = 0 if axis.axis_name == "x" else 1
    taken = [label.get_window_extent() for label in axis.get_majorticklabels()]
    texts = {}
    for label in axis.get_minorticklabels():
        extent = label.get_window_extent().padded(_GAP)
        if label.get_text() and not any(extent.overlaps(other) for other in taken):
            taken.append(extent)
            texts[label.get_position()[direction]] = label.get_text()
    axis.set_minor_formatter(lambda value, _: texts.get(value, ""))


def fit_labels(figure: Any, *, rows: int, columns: int) -> None:
    """Break the names at the axes of a figure that are longer than these."""
    shown = [panel for panel in figure.axes if panel.get_visible()]
    across = _ROOMY * figure.bbox.width / columns
    down = _ROOMY * figure.bbox.height / rows
    labels = [(panel, panel.get_xlabel(), panel.get_ylabel()) for panel in shown]
    is_long = [_fit(panel.xaxis.label, text, across) for panel, text, _ in labels]
    is_long += [_fit(panel.yaxis.label, text, down, is_upright=True) for panel, _, text in labels]
    if not any(is_long):
        return
    figure.draw_without_rendering()  # how long axes are is known only then
    for panel, of_x, of_y in labels:
        room = panel.get_window_extent()
        panel.set(xlabel=of_x, ylabel=of_y)
        _fit(panel.xaxis.label, of_x, max(room.width, across))
        _fit(panel.yaxis.label, of_y, max(room.height, down), is_upright=True)


def _fit(artist: Any, text: str, room: float, *, is_upright: bool = False) -> bool:
    """Break the text of an artist into lines that are not longer than ``room`` [dots].

    Return whether it was longer.
    """
    count = len(text)
    while count > 1:
        extent = artist.get_window_extent()
        length = extent.height if is_upright else extent.width
        if length <= room:
            break
        longest = max(map(len, artist.get_text().split("\n")))
        count = max(min(int(_MARGIN * longest * room / length), count - 1), 1)
        artist.set_text(broken(text, count))
    return count < len(text)


def _pieces(line: str, count: int) -> list[str]:
    """Return what a line may be broken into; without its blanks, none is longer than ``count``."""
    pieces = []
    for word in _WORDS.findall(line):
        parts = [word] if len(word.rstrip()) <= count else _PARTS.findall(word)
        for part in parts:
            pieces += [part[k : k + count] for k in range(0, len(part.rstrip()), count)]
    return pieces
