"""Pictures of runs; they need the extra ``[plot]``.

* ``picture``: figure, panels, format and file.
* ``curves``: what is drawn into a panel, with names and units.
* ``intervals``: bands around curves.
* ``signals``, ``estimates``, ``comparison``, ``difference``, ``identification``: the pictures.
* ``schedule_layout``, ``schedule``: the picture of stages and loops.
"""

from __future__ import annotations

from cosim.report.plots.comparison import plot_comparison
from cosim.report.plots.difference import plot_difference
from cosim.report.plots.estimates import plot_run
from cosim.report.plots.identification import plot_identification
from cosim.report.plots.picture import PictureOptions, need_plot
from cosim.report.plots.signals import plot_signals

__all__ = [
    "PictureOptions",
    "need_plot",
    "plot_comparison",
    "plot_difference",
    "plot_identification",
    "plot_run",
    "plot_signals",
]
