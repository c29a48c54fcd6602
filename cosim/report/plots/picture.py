"""A figure of panels, its colors, its texts in lines that fit, and the file it is written to."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from itertools import product
from pathlib import Path
from textwrap import TextWrapper
from typing import Any, Final, TypeAlias

import numpy as np

from cosim.errors import UsageError, optional_library
from cosim.files import check_writable
from cosim.filters import collected_warnings
from cosim.report.printable import printable_line

Style: TypeAlias = Mapping[str, Any]

LARGEST: Final = 200.0  # cm
LARGEST_DRAWN: Final = 1e300  # an axis has margins: the difference of its ends must be a number
WIDTH: Final = 1.2  # of a line [points]
# Okabe and Ito, without yellow: the color-blind can distinguish them
COLORS: Final = ("#0072B2", "#D55E00", "#000000", "#009E73", "#E69F00", "#56B4E9", "#CC79A7")
DASHES: Final = ("-", (0, (6, 2)), (0, (2, 2)), (0, (7, 2, 1, 2)), (0, (1, 1)))
_SMALLEST: Final = 3.0  # cm
_CENTIMETER: Final = 1.0 / 2.54  # inches
_DOTS_PER_INCH: Final = 150
_MOST_ROWS: Final = 4  # where a picture chooses its columns itself: more would not fit a screen
_NO_ROOM: Final = "constrained_layout not applied"  # a warning of matplotlib
# text stays text: it can be searched and edited, and set in the font of the page
_TEXT_AS_TEXT: Final = {"svg.fonttype": "none", "pdf.fonttype": 42}
_MOST_NAMES: Final = 24  # in the legend of a panel
_NAMES_IN_COLUMN: Final = 8  # of it, at the standard height of a panel
_MARGIN: Final = 0.97  # of the room of a text, that is used
_ROOMY: Final = 0.5  # of the part of a picture that a panel has: its axes have more mostly
_LETTER: Final = 0.22  # cm, the mean width of one in a legend
_HANDLE: Final = 1.5  # cm of an entry of a legend beside its text
_MOST_COLUMNS: Final = 6  # of a legend


@dataclass(frozen=True, slots=True)
class PictureOptions:
    """How a picture looks.

    Parameters
    ----------
    size : tuple of float or None
        Width and height [cm]; None: as the panels need.
    start, stop : float or None
        First and last time shown [s]; None: that of the run.
    title : str or None
        None: the standard one of the picture.

    Raises
    ------
    UsageError
        If the size is none that can be drawn, or ``stop`` is not after ``start``.
    """

    size: tuple[float, float] | None = None
    start: float | None = None
    stop: float | None = None
    title: str | None = None

    def __post_init__(self) -> None:
        if self.size is not None:
            width, height = self.size
            if not all(_SMALLEST <= length <= LARGEST for length in self.size):
                raise UsageError(
                    f"size: expected {_SMALLEST:g} to {LARGEST:g} cm each, "
                    f"got {width:g} x {height:g} cm"
                )
        for name, time in (("start", self.start), ("stop", self.stop)):
            if time is not None and not math.isfinite(time):
                raise UsageError(f"{name}: expected a finite number, got {time} s")
        if self.start is not None and self.stop is not None and self.stop <= self.start:
            raise UsageError(
                f"stop: expected a time after start = {self.start:g} s, got {self.stop:g} s"
            )

    @property
    def window(self) -> tuple[float, float]:
        """First and last time shown [s], infinite where they are those of the run."""
        start = -math.inf if self.start is None else self.start
        return start, math.inf if self.stop is None else self.stop


STANDARD: Final = PictureOptions()


def need_plot(out: Path) -> None:
    """Refuse a picture that could not be drawn, before anything is run for it.

    Raises
    ------
    UsageError
        If there is no matplotlib, or if ``out`` does not end as a picture does or cannot be
        written.
    """
    formats = _new_figure().canvas.get_supported_filetypes()
    if _format(out) not in formats:
        known = ", ".join(sorted(formats))
        raise UsageError(f"{out}: unknown file type {out.suffix!r}; available: {known}")
    try:
        check_writable(out)
    except OSError as error:
        raise UsageError(f"{out} cannot be written: {error.strerror}") from error


class Picture:
    """A figure of panels.

    Parameters
    ----------
    count : int
        Of panels.
    options : PictureOptions
    columns : int, optional
        By default as few as make at most four rows.
    shares_time : bool
        Whether all panels have one axis of time; else each has its own, which its drawer labels.

    Attributes
    ----------
    panels : list
        Axes of matplotlib, row by row; places of the last row may stay empty.

    Raises
    ------
    UsageError
        If there is no matplotlib.
    """

    def __init__(
        self,
        count: int,
        options: PictureOptions,
        *,
        columns: int | None = None,
        shares_time: bool = True,
    ) -> None:
        self._options = options
        self._shares_time = shares_time
        self._columns = columns or math.ceil(count / _MOST_ROWS)
        self._rows = math.ceil(count / self._columns)
        width, height = (22.0, 5.0) if self._columns == 1 else (32.0, 6.0)
        self._size = np.array(options.size or (width, 3.0 + height * self._rows))
        self._figure = _new_figure(figsize=self._size * _CENTIMETER, layout="constrained")
        grid = self._figure.subplots(self._rows, self._columns, sharex=shares_time, squeeze=False)
        places = list(grid.flat)
        self.panels = places[:count]
        for empty in places[count:]:
            empty.set_visible(False)
        for panel in self.panels:
            panel.ticklabel_format(axis="y", useOffset=False)  # as they are, not from 1e-5+4
            panel.grid(alpha=0.3)

    def legend(self, lines: list[Any], *, below: bool = False, title: str = "") -> None:
        """Show a legend of all panels above them; below them where the picture has a title.

        It has as many columns as fit side by side.
        """
        names = [line.get_label() for line in lines]
        columns = int(self._size[0] / (_HANDLE + _LETTER * max(map(len, names))))
        self._figure.legend(
            lines,
            [broken(name, int((self._size[0] - _HANDLE) / _LETTER)) for name in names],
            loc="outside lower center" if below else "outside upper center",
            ncols=min(max(columns, 1), _MOST_COLUMNS, len(lines)),
            frameon=False,
            title=broken(title, int(self._size[0] / _LETTER)) or None,
        )

    def save(self, out: Path, *, title: str = "") -> None:
        """Write the picture to a file; ``title`` is its standard one.

        Raises
        ------
        UsageError
            If the file cannot be written, or there is no room for what is beside the panels.
        """
        from matplotlib import rc_context

        shown_title = title if self._options.title is None else self._options.title
        if shown_title:
            _fit(self._figure.suptitle(shown_title), self._figure.bbox.width)
        if self._shares_time:
            for panel in self.panels[-self._columns :]:
                panel.set_xlabel("t [s]")
                panel.tick_params(labelbottom=True)  # also above an empty place
            self.panels[0].set_xlim(self._options.start, self._options.stop)
        picture = BytesIO()  # a file that is there stays whole if this is interrupted
        try:
            with rc_context(_TEXT_AS_TEXT), collected_warnings(_NO_ROOM) as problems:
                self._fit_axes()
                self._figure.savefig(picture, format=_format(out), dpi=_DOTS_PER_INCH)
            if problems:
                width, height = self._size
                raise UsageError(
                    f"size: {width:g} x {height:g} cm is too small for the axis labels of this "
                    "picture"
                )
            out.parent.mkdir(parents=True, exist_ok=True)
            out.write_bytes(picture.getvalue())
        except ValueError as error:
            raise UsageError(f"{out}: {error}") from error
        except OSError as error:
            raise UsageError(f"{out} cannot be written: {error.strerror}") from error

    def _fit_axes(self) -> None:
        """Break long names at the axes; write numbers between powers of ten as short as can be."""
        from matplotlib.ticker import LogFormatter

        share = _ROOMY * self._figure.bbox.size / (self._columns, self._rows)
        axes = [axis for panel in self._figure.axes for axis in (panel.xaxis, panel.yaxis)]
        labels = [axis.label.get_text() for axis in axes]
        for is_drawn in (False, True):  # how long axes and numbers are is known only then
            for axis, text in zip(axes, labels, strict=True):
                upright = int(axis.axis_name == "y")
                length = axis.axes.get_window_extent().size[upright] if is_drawn else 0.0
                axis.label.set_text(text)
                _fit(axis.label, max(length, share[upright]), is_upright=bool(upright))
            if not is_drawn:
                self._figure.draw_without_rendering()
        for axis in axes:
            if axis.get_scale() == "log":
                axis.set_minor_formatter(LogFormatter())


def show_legend(panel: Any) -> None:
    """Name the curves of a panel beside it, where they hide nothing; of many only the first."""
    lines, names = panel.get_legend_handles_labels()
    shown = lines[:_MOST_NAMES]
    panel.legend(
        shown,
        names[:_MOST_NAMES],
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
        frameon=False,
        fontsize="small",
        ncols=-(-len(shown) // _NAMES_IN_COLUMN),  # rounded up
        title=f"the first {len(shown)} of {len(lines)}" if len(shown) < len(lines) else None,
        title_fontsize="small",
    )


def distinguish_lines(panel: Any) -> None:
    """Give the lines that follow colors, then dashes too."""
    dashes, colors = zip(*product(DASHES, COLORS), strict=True)
    panel.set_prop_cycle(color=colors, linestyle=dashes, linewidth=[WIDTH] * len(colors))


def shown_text(name: str) -> str:
    """Return a name as matplotlib shows it: no mathematics, no control characters."""
    return printable_line(name).replace("$", r"\$")


class _NameWrapper(TextWrapper):
    """Wraps after blanks, and after the dots and bars of names."""

    wordsep_re = re.compile(r"(\s+|[^\s._/]+[._/]*|[._/]+)")


def broken(text: str, count: int) -> str:
    """Return a text in lines of at most so many characters, broken after blanks, dots and bars.

    A part of a name that is longer is broken anywhere.
    """
    wrapper = _NameWrapper(max(count, 1))
    lines = [part for line in text.split("\n") for part in wrapper.wrap(line) or [""]]
    return "\n".join(map(str.rstrip, lines))


def _fit(artist: Any, room: float, *, is_upright: bool = False) -> None:
    """Break the text of an artist into lines that are not longer than ``room`` [dots]."""
    text = artist.get_text()
    count = len(text)
    while count > 1:
        extent = artist.get_window_extent()
        length = extent.height if is_upright else extent.width
        if length <= room:
            return
        longest = max(map(len, artist.get_text().split("\n")))
        count = max(min(int(_MARGIN * longest * room / length), count - 1), 1)
        artist.set_text(broken(text, count))


def _format(out: Path) -> str:
    """Return the format of a picture, by its ending."""
    return out.suffix.lower().removeprefix(".")


def _new_figure(**options: Any) -> Any:
    return optional_library("matplotlib.figure", "plots need", "plot").Figure(**options)
