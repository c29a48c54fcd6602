"""Pictures of studies; they need the extra ``[plot]``.

* ``study_plot``: the kinds of pictures, and which one a study has by default.
* ``panels``: a panel for each metric. ``scales``: axes, logarithmic where values are spread so.
* ``distributions``, ``convergence``, ``over_key``, ``heat_map``, ``scatter``, ``sensitivity``,
  ``search_history``: the pictures.
"""

from __future__ import annotations

from cosim.studies.plots.study_plot import KINDS, plot_study

__all__ = ["KINDS", "plot_study"]
