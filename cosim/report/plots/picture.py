"""A figure of panels over time, and the file it is written to."""

from __future__ import annotations

import math
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import UsageError
from cosim.files import check_writable
from cosim.filters import collected_warnings
from cosim.report.plots.fitting import fit_labels, fit_legend, fit_ticks, fit_title

CENTIMETER: Final = 1.0 / 2.54  # inches
SMALLEST: Final = 3.0  # cm
LARGEST: Final = 200.0  # cm
_DOTS_PER_INCH: Final = 150
_MOST_ROWS: Final = 4  # where a picture chooses its columns itself: more would not fit a screen
_NO_ROOM: Final = "constrained_layout not applied"  # a warning of matplotlib
# text stays text: it can be searched and edited, and set in the font of the page
_TEXT_AS_TEXT: Final = {"svg.fonttype": "none", "pdf.fonttype": 42}


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
            if not all(SMALLEST <= length <= LARGEST for length in (width, height)):
                raise UsageError(
                    f"size: expected {SMALLEST:g} to {LARGEST:g} cm each, "
                    f"got {width:g} x {height:g} cm"
                )
        for name, time in (("start", self.start), ("stop", self.stop)):
            if time is not None and not math.isfinite(time):
                raise UsageError(f"{name}: expected a finite number, got {time} s")
        if self.start is not None and self.stop is not None and self.stop <= self.start:
            raise UsageError(
                f"stop: expected a time after start = {self.start:g} s, got {self.stop:g} s"
            )

    def check_shows(self, times: Vector) -> None:
        """Check that something of a signal with rows at ``times`` is shown.

        Raises
        ------
        UsageError
            If the signal begins after the last time shown, or ends before the first.
        """
        if not len(times):
            return
        too_late = self.start is not None and self.start > times[-1]
        too_early = self.stop is not None and self.stop < times[0]
        if too_late or too_early:
            raise UsageError(
                "start, stop: no rows in this interval; expected a part of "
                f"{times[0]:g} s to {times[-1]:g} s"
            )


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
        if columns is None:
            columns = -(-count // _MOST_ROWS)  # rounded up
        rows = -(-count // columns)
        self._options = options
        self._shares_time = shares_time
        self._rows = rows
        self._columns = columns
        self._figure = _new_figure()
        if options.size is None:
            width = 22.0 if columns == 1 else 32.0
            height = 3.0 + (5.0 if columns == 1 else 6.0) * rows
        else:
            width, height = options.size
        self._figure.set_size_inches(width * CENTIMETER, height * CENTIMETER)
        self._figure.set_layout_engine("constrained")
        grid = self._figure.subplots(rows, columns, sharex=shares_time, squeeze=False)
        places: list[Any] = list(np.ravel(grid))
        self.panels = places[:count]
        for empty in places[count:]:
            empty.set_visible(False)
        for panel in self.panels:
            panel.ticklabel_format(useOffset=False)  # numbers as they are, not from 1e-5+4

    def legend(self, lines: list[Any], *, below: bool = False, title: str = "") -> None:
        """Show a legend of all panels above them; below them where the picture has a title."""
        place = "outside lower center" if below else "outside upper center"
        fit_legend(self._figure, lines, place=place, title=title)

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
            fit_title(self._figure, shown_title)
        for panel in self.panels:
            panel.grid(alpha=0.3)
        if self._shares_time:
            for panel in self.panels[-self._columns :]:
                panel.set_xlabel("t [s]")
                panel.tick_params(labelbottom=True)  # also above an empty place
            self.panels[0].set_xlim(self._options.start, self._options.stop)
        picture = BytesIO()  # a file that is there stays whole if this is interrupted
        try:
            with rc_context(_TEXT_AS_TEXT), collected_warnings(_NO_ROOM) as problems:
                fit_ticks(self._figure)
                fit_labels(self._figure, rows=self._rows, columns=self._columns)
                self._figure.savefig(picture, format=_format(out), dpi=_DOTS_PER_INCH)
            if problems:
                width, height = self._figure.get_size_inches() / CENTIMETER
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


def _format(out: Path) -> str:
    """Return the format of a picture, by its ending."""
    return out.suffix.lower().removeprefix(".")


def _new_figure() -> Any:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UsageError(
            "plots need matplotlib, which is not installed: pip install matplotlib, or, "
            "in a clone of cosim, pip install -e '.[plot]'"
        ) from error
    return Figure()
