"""Pictures of logs made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.errors import UsageError
from cosim.log import open_log
from cosim.report.plots import plot_signals
from tests.log.recordings import layout, record


def test_a_picture_of_any_values_is_drawn_or_refused(tmp_path, subtests):
    """Where an axis cannot hold them, the signal is named."""
    for values in ([np.nan, np.inf, -np.inf], [5e-324, -5e-324], [1e308, -1e308]):
        rows = np.zeros((21, layout().width))
        for number, value in enumerate(values):
            rows[5 + 3 * number : 8 + 3 * number] = value
        path = tmp_path / f"{values[0]}.mcap"
        record(path, rows=rows)
        picture = path.with_suffix(".png")
        with subtests.test(case=values):
            if values[0] == 1e308:
                with pytest.raises(UsageError, match=r"plant\.u: .*1e\+308"):
                    plot_signals(open_log(path), ["plant.u"], picture)
            else:
                plot_signals(open_log(path), ["plant.u"], picture)
                assert picture.stat().st_size > 0


def test_a_picture_of_no_signals_is_refused(tmp_path, subtests):
    """As is a path that none can be written to."""
    path = tmp_path / "a.mcap"
    record(path, steps=20)
    for signals in ([], [3], ["plant"], "plant.u"):
        with subtests.test(case=signals), pytest.raises(UsageError):
            plot_signals(open_log(path), signals, path.with_suffix(".png"))
    with pytest.raises(UsageError, match="cannot be written"):
        plot_signals(open_log(path), ["plant.u"], path / "x.png")
