"""Pictures of runs; they need the extra ``[plot]``.

* ``picture``: figure, panels, colors, format and file.
* ``curves``: what is drawn into a panel, with names, units and bands.
* ``runs``, ``identification``, ``schedule``: the pictures.
"""

from __future__ import annotations

from cosim.report.plots.identification import plot_identification
from cosim.report.plots.picture import PictureOptions, need_plot
from cosim.report.plots.runs import plot_comparison, plot_difference, plot_run, plot_signals

__all__ = [
    "PictureOptions",
    "need_plot",
    "plot_comparison",
    "plot_difference",
    "plot_identification",
    "plot_run",
    "plot_signals",
]
