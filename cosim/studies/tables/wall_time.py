"""How long a member takes, as a text."""

from __future__ import annotations

import numpy as np

from cosim.studies.analysis.results import StudyResults


def wall_time_text(results: StudyResults) -> str:
    """Return how long a member takes: one that hung, or crashed, says nothing of the others."""
    failed = results.columns.failed
    times = results.wall_times
    if failed.all():
        return f"wall time: median {np.median(times):.3g} s per failed member"
    median = f"wall time: median {np.median(times[~failed]):.3g} s per member"
    if not failed.any():
        return median
    return f"{median} that completed; at most {times[failed].max():.3g} s per failed member"


def median_time(results: StudyResults) -> float | None:
    """Return the median wall time of the members that were completed [s]; None: there are none."""
    times = results.wall_times[~results.columns.failed]
    return float(np.median(times)) if len(times) else None
