"""Two runs compared signal by signal."""

from __future__ import annotations

import json

import numpy as np
import pytest

from cosim.core.contracts import Block
from cosim.core.recorders import Memory
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import LogError
from cosim.log import open_log
from cosim.log.diff import diff
from cosim.log.difference import ElementDifference
from tests.log.comparison.runs import Run
from tests.log.recordings import STEP_NS, layout, record


def only_row(a, b, **tolerance):
    """Compare two runs of one signal; return its row."""
    (row,) = diff(a, b, **tolerance).rows
    return row


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Record a run, and another that differs in two elements; return logs and rows."""
    folder = tmp_path_factory.mktemp("pair")
    rows = record(folder / "a.mcap", steps=100)
    changed = rows.copy()
    changed[60, 0] += 1.0
    changed[40, 6] = np.nextafter(rows[40, 6], np.inf)
    record(folder / "b.mcap", rows=changed)
    return open_log(folder / "a.mcap"), open_log(folder / "b.mcap"), rows, changed


def test_a_log_equals_itself(pair):
    """Bit for bit, odd values too."""
    a, *_ = pair
    assert diff(a, a).equal
    assert diff(a, a).first is None


def test_the_first_difference_is_found(pair):
    """One bit of one element of one row is a difference, with its time and both values."""
    a, b, rows, changed = pair
    difference = diff(a, b)
    assert not difference.equal
    assert not difference.within
    first = ElementDifference("identifier.y[1]", 40 * STEP_NS, rows[40, 6], changed[40, 6])
    assert difference.first == first
    status = {row.signal: row.status for row in difference.rows}
    changed_signals = {name for name in status if status[name] != "equal"}
    assert changed_signals == {"plant.u", "identifier.y"}
    assert {status[name] for name in changed_signals} == {"outside"}
    as_json = json.loads(json.dumps(difference.to_dict()))
    assert as_json["first"]["time_ns"] == 40 * STEP_NS


def test_a_difference_of_one_bit_is_within_a_tolerance(pair):
    """A signal is judged for itself."""
    a, b, *_ = pair
    status = {row.signal: row.status for row in diff(a, b, rtol=1e-12).rows}
    assert status["identifier.y"] == "within"


def test_tolerances_are_absolute_plus_relative_to_the_signals_scale(subtests):
    """|a - b| <= atol + rtol max|a|, here with max|a| = 4 from another row."""
    for a, b, tolerance, status, largest in [
        (0.0, -0.0, {}, "outside", 0.0),
        (0.0, -0.0, {"atol": 1e-300}, "within", 0.0),
        (np.nan, np.nan, {}, "equal", 0.0),
        (np.nan, -np.nan, {"atol": 1.0}, "within", 0.0),
        (np.nan, 1.0, {"atol": 1.0}, "outside", np.inf),
        (np.inf, np.inf, {"atol": 1.0}, "equal", 0.0),
        (np.inf, 1.0, {"rtol": 1.0}, "outside", np.inf),
        (1.0, 1.5, {"atol": 0.5}, "within", 0.5),
        (1.0, 1.5, {"atol": 0.49}, "outside", 0.5),
        (1.0, 1.5, {"rtol": 0.125}, "within", 0.5),
        (1.0, 1.5, {"rtol": 0.12}, "outside", 0.5),
        (1.0, 1.5, {"atol": 0.25, "rtol": 0.0625}, "within", 0.5),
    ]:
        row = only_row(Run({"y": [4.0, a]}), Run({"y": [4.0, b]}), **tolerance)
        with subtests.test(case=(a, b, tolerance)):
            assert (row.status, row.largest, row.scale) == (status, largest, 4.0)
            assert row.ratio == largest / 4
            assert (row.first is not None) == (status == "outside")


def test_runs_of_other_length_compare_where_both_have_values():
    """Other times are reported, even if all values agree."""
    a = Run({"y": [1, 2, 3, 4]})
    b = Run({"y": [3, 4, 5]}, times=[2, 3, 4])
    row = only_row(a, b)
    assert (row.status, row.rows, row.largest) == ("other times", (4, 3, 2), 0.0)
    assert not diff(a, b, atol=1.0).within
    row = only_row(a, Run({"y": [3, 9]}, times=[2, 3]))
    assert row.status == "outside"
    assert row.first == ElementDifference("c.y", 3 * STEP_NS, 4.0, 9.0)
    row = only_row(a, Run({"y": [3]}, times=[9]))
    assert (row.status, row.rows) == ("other times", (4, 1, 0))


def test_both_limits_of_a_jump_are_compared_with_their_own():
    """Rows of one instant pair up in their order."""
    a = Run({"y": [0, 1, 2, 3]}, times=[0, 1, 1, 2])
    b = Run({"y": [0, 1, 7]}, times=[0, 1, 1])
    row = only_row(a, b)
    assert row.rows == (4, 3, 3)
    assert row.first == ElementDifference("c.y", STEP_NS, 2.0, 7.0)


def test_signals_that_only_one_run_has_are_listed():
    """Also a size that changed."""
    a = Run({"x": [1.0], "y": [1.0]})
    b = Run({"y": [[1.0, 2.0]], "z": [1.0]})
    difference = diff(a, b)
    assert [(row.signal, row.status) for row in difference.rows] == [
        ("c.x", "only in a"),
        ("c.y", "other size"),
        ("c.z", "only in b"),
    ]
    assert not difference.within


def test_components_that_only_one_run_has_are_listed(tmp_path):
    """A whole component may be missing."""
    without_identifier = Layout(layout().channels[:1])
    record(tmp_path / "a.mcap", steps=10)
    record(tmp_path / "b.mcap", steps=10, lay=without_identifier, rows=np.zeros((11, 5)))
    difference = diff(open_log(tmp_path / "b.mcap"), open_log(tmp_path / "a.mcap"))
    assert [row.status for row in difference.rows[4:]] == ["only in b", "only in b"]
    assert difference.rows[4].rows == (0, 3, 0)


def test_the_ratio_without_a_scale_is_infinite():
    """Any difference is large beside a signal that is zero."""
    row = only_row(Run({"y": [0.0]}), Run({"y": [1.0]}))
    assert row.ratio == np.inf


def test_only_the_signals_given_are_compared():
    """Signals, elements and slices by their names; what differs elsewhere does not matter."""
    a = Memory()
    b = Memory()
    for run, shift in ((a, 0.0), (b, 1.0)):
        channel = Channel("c", Interface((), (Signal("p"), Signal("x", 3))), 0)
        run.begin(Plan(Layout((channel,)), STEP_NS, {}, {}, ()))
        steps = np.arange(5)
        rows = np.repeat(steps[:, np.newaxis], 4, axis=1).astype(float)
        rows[3, 3] += shift
        run.write(Block(0, steps * STEP_NS, steps * STEP_NS / 1e9, STEP_NS / 1e9), rows)
    assert not diff(a, b).equal
    chosen = diff(a, b, signals=["c.x[0:2]", "c.p", "c.x[0]"])
    assert chosen.equal
    assert [row.signal for row in chosen.rows] == ["c.x[0:2]", "c.p", "c.x[0]"]
    (row,) = diff(a, b, signals=["c.x[1:3]"]).rows
    assert row.status == "outside"
    assert row.first == ElementDifference("c.x[2]", 3 * STEP_NS, 3.0, 4.0)
    assert row.scale == 4.0


def test_signals_that_neither_run_has_are_refused():
    """With the nearest; one that a single run has is a row as without a choice."""
    a = Run({"p": np.zeros(4), "x": np.zeros((4, 3))})
    b = Run({"p": np.zeros(4), "x": np.zeros((4, 2)), "q": np.zeros(4)})
    rows = diff(a, b, signals=["c.q", "c.x[2]", "c.x"]).rows
    assert [row.status for row in rows] == ["only in b", "only in a", "other size"]
    with pytest.raises(LogError, match=r"'c\.y'.*: p, x"):
        diff(a, b, signals=["c.p", "c.y"])
    with pytest.raises(LogError, match="component 'd'"):
        diff(a, b, signals=["d.p"])
    with pytest.raises(LogError, match=r"'c\.x'.*3 elements"):
        diff(a, b, signals=["c.x[3]"])
