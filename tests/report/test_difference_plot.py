"""The picture of the signal in which two runs are farthest apart."""

import re

import numpy as np
import pytest

from cosim.errors import UsageError
from cosim.log import open_log
from cosim.log.comparison.diff import diff
from cosim.report.plots import plot_difference
from tests.log.recordings import STEP_NS, layout, record, table


@pytest.fixture
def rows():
    """Return rows of numbers."""
    return np.nan_to_num(table(layout(), 100), posinf=1.0, neginf=-1.0)


def compared(tmp_path, rows, changed, **options):
    """Return the comparison of two logs, and the logs."""
    record(tmp_path / "first.mcap", rows=rows)
    record(tmp_path / "second.mcap", rows=changed)
    logs = open_log(tmp_path / "first.mcap"), open_log(tmp_path / "second.mcap")
    return diff(*logs, **options), logs


def texts(path):
    """Return the texts of a picture in SVG."""
    return re.findall(r"<text[^>]*>([^<]*)</text>", path.read_text(encoding="utf-8"))


@pytest.fixture
def drawn(monkeypatch):
    """Return what will be drawn: the curves of each panel, and their lines."""
    from cosim.report.plots import difference as module

    original = module.draw_curves
    drawn = {"curves": [], "lines": []}

    def keep(panel, curves, *, styles):
        original(panel, curves, styles=styles)
        drawn["curves"].append(curves)
        drawn["lines"].append(list(panel.lines))

    monkeypatch.setattr(module, "draw_curves", keep)
    return drawn


def test_both_curves_and_their_difference_are_drawn(tmp_path, rows, drawn):
    """Of the element that is farthest apart, by the names of the runs, with the tolerance."""
    changed = rows.copy()
    changed[40:, 2] += 0.5
    difference, logs = compared(tmp_path, rows, changed, tol={"plant.*": 0.1})
    plot_difference(difference, logs, tmp_path / "a.svg")
    (first, second), (apart,) = drawn["curves"]
    assert np.array_equal(first.values, rows[:, 2])
    assert np.array_equal(second.values, changed[:, 2])
    assert np.array_equal(apart.values, changed[:, 2] - rows[:, 2])
    assert np.array_equal(apart.times, np.arange(101) * STEP_NS / 1e9)
    assert {line.get_drawstyle() for lines in drawn["lines"] for line in lines} == {"default"}
    shown = texts(tmp_path / "a.svg")
    for text in ("plant.x_a[1] (first)", "plant.x_a[1] (second)", "tolerance", "first outside"):
        assert text in shown
    assert "plant.x_a[1]: largest |a - b| = 0.5" in shown


def test_a_discrete_signal_and_its_difference_hold_between_rows(tmp_path, rows, drawn):
    """They are drawn as steps, such as n of the plant."""
    changed = rows.copy()
    changed[40:60, 4] += 2.0
    difference, logs = compared(tmp_path, rows, changed)
    plot_difference(difference, logs, tmp_path / "a.svg")
    (first, second), (apart,) = drawn["lines"]
    assert [line.get_drawstyle() for line in (first, second, apart)] == 3 * ["steps-post"]
    assert np.array_equal(apart.get_ydata(), changed[:, 4] - rows[:, 4])


def test_a_number_beside_none_is_drawn_where_it_is(tmp_path, rows):
    """The difference is infinite there; the element is the first that is outside."""
    changed = rows.copy()
    changed[30, 2] = np.nan
    rows[20, 1] = changed[20, 1] = np.inf
    difference, logs = compared(tmp_path, rows, changed)
    plot_difference(difference, logs, tmp_path / "a.svg")
    assert "plant.x_a[1]: largest |a - b| = inf" in texts(tmp_path / "a.svg")


def test_runs_of_other_steps_are_drawn(tmp_path, rows):
    """Each with its own rows; the difference at those that both have."""
    changed = rows[:51].copy()
    changed[10, 0] += 1.0
    difference, logs = compared(tmp_path, rows, changed)
    plot_difference(difference, logs, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_a_picture_of_an_unknown_format_is_refused(tmp_path, rows):
    """As every picture."""
    changed = rows + 1.0
    difference, logs = compared(tmp_path, rows, changed)
    with pytest.raises(UsageError, match=r"'\.doc'"):
        plot_difference(difference, logs, tmp_path / "a.doc")
