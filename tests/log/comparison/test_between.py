"""Runs of different instants compared between them, and in a tube."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.core.signals import Channel, Interface, Signal
from cosim.errors import UsageError
from cosim.log.diff import diff
from tests.log.comparison.runs import Run
from tests.log.recordings import STEP_NS

STEP = STEP_NS / 1e9


def row(a, b, **options):
    """Compare two runs of one signal; return its row."""
    (found,) = diff(a, b, **options).rows
    return found


def discrete(values, times):
    """Return a run of a signal that is held."""
    run = Run({"y": values}, times)
    run.channels = {"c": Channel("c", Interface((), (Signal("y", variability="discrete"),)), 0)}
    return run


def test_a_straight_line_is_itself_at_any_instants():
    """It is compared at all instants of the first run that lie within the second."""
    fine = np.arange(0, 101)
    coarse = np.arange(0, 101, 7)
    a, b = Run({"y": 3.0 * fine}, fine), Run({"y": 3.0 * coarse}, coarse)
    assert row(a, b, atol=1e-9).status == "other times"
    found = row(a, b, atol=1e-9, interpolate=True)
    assert found.rows == (101, 99, 99)  # b ends at 98
    assert found.status == "other times"
    assert found.largest <= 1e-12
    whole = Run({"y": [0.0, 300.0]}, [0, 100])
    assert row(a, whole, atol=1e-9, interpolate=True).status == "within"


def test_a_value_that_is_held_is_no_line():
    """A discrete signal keeps its value until the next row."""
    a = discrete([0.0, 0.0, 1.0], [0, 5, 10])
    b = discrete([0.0, 1.0], [0, 10])
    assert row(a, b, interpolate=True).status == "equal"
    lines = Run({"y": [0.0, 0.0, 1.0]}, [0, 5, 10]), Run({"y": [0.0, 1.0]}, [0, 10])
    found = row(*lines, interpolate=True)
    assert (found.status, found.largest) == ("outside", 0.5)
    assert found.first.time_ns == 5 * STEP_NS


def test_a_delayed_signal_is_within_a_tube_as_wide_as_the_delay():
    """And outside of a narrower one."""
    times = np.arange(0, 300)
    a, b = (Run({"y": np.clip((times - begin) / 100, 0, 1)}, times) for begin in (100, 120))
    assert row(a, b, rtol=0.005).status == "outside"
    assert row(a, b, tube=20 * STEP).status == "within"
    assert row(a, b, tube=19 * STEP).largest == pytest.approx(0.01)
    assert row(a, b, tube=19 * STEP, rtol=0.005).status == "outside"
    assert row(a, b, tube=19 * STEP, rtol=0.011).status == "within"


def test_a_tube_looks_at_all_rows_near_an_instant():
    """The largest and the smallest of them bound what is right."""
    a = Run({"y": [0.0, 5.0, 0.0]}, [0, 50, 100])
    b = Run({"y": [0.0, 0.0, 5.0, 0.0, 0.0]}, [0, 57, 58, 59, 100])
    assert row(a, b, tube=7 * STEP).status == "outside"
    assert row(a, b, tube=8 * STEP).status == "within"
    assert row(a, b, tube=8 * STEP).largest == 0.0
    assert row(a, b, tube=7.5 * STEP, atol=2.5).status == "within"


def test_both_limits_of_a_jump_are_in_a_tube():
    """At the instant of the jump any value between them is right."""
    a = Run({"y": [0.0, 0.4, 1.0]}, [0, 50, 100])
    b = Run({"y": [0.0, 0.0, 1.0, 1.0]}, [0, 50, 50, 100])
    assert row(a, b, interpolate=True).largest == pytest.approx(0.6)
    assert row(a, b, tube=1e-9).status == "within"


def test_what_is_no_number_is_right_only_where_both_are_none():
    """NaN and infinity are not interpolated away."""
    times = [0, 1, 2, 3]
    a = Run({"y": [0.0, np.nan, np.inf, 1.0]}, times)
    assert row(a, a, interpolate=True).status == "equal"
    assert row(a, a, tube=STEP).status == "equal"
    b = Run({"y": [0.0, 0.0, 0.0, 1.0]}, times)
    assert row(a, b, tube=STEP, atol=1e9).status == "outside"
    assert row(b, a, tube=0.4 * STEP, atol=1e9).status == "outside"


def test_runs_that_do_not_overlap_are_not_called_equal():
    """Nothing was compared."""
    a, b = Run({"y": [0.0, 0.0]}, [0, 1]), Run({"y": [0.0, 0.0]}, [5, 6])
    for options in ({"interpolate": True}, {"tube": STEP}):
        found = diff(a, b, **options)
        assert [one.status for one in found.rows] == ["other times"]
        assert not found.within
        assert not found.equal


def test_wrong_widths_are_refused():
    """With what was found."""
    a = Run({"y": [0.0]}, [0])
    for tube in (-1.0, np.nan, np.inf, "x"):
        with pytest.raises(UsageError, match="tube"):
            diff(a, a, tube=tube)


def test_random_runs_agree_with_a_search_instant_by_instant():
    """The tube of random steps, against the definition."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        times_a = np.sort(rng.choice(200, 40, replace=False))
        times_b = np.sort(rng.choice(np.arange(-5, 210), 60, replace=False))
        times_b[[0, -1]] = -5, 210
        values_a, values_b = rng.normal(size=40), rng.normal(size=60)
        tube = int(rng.integers(1, 8))
        found = row(Run({"y": values_a}, times_a), Run({"y": values_b}, times_b), tube=tube * STEP)
        largest = 0.0
        for time, value in zip(times_a, values_a, strict=True):
            ends = (max(time - tube, -5), min(time + tube, 210))
            near = np.union1d(times_b[(times_b >= ends[0]) & (times_b <= ends[1])], ends)
            known = np.interp(near, times_b, values_b)
            largest = max(largest, known.min() - value, value - known.max())
        assert found.largest == pytest.approx(largest, abs=1e-12)
