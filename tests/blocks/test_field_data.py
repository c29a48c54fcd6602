"""Recorded samples as a component: straight lines at the points, and the samples beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.blocks.field_data import (
    FieldData,
    FieldRecording,
    FieldSignal,
    at_points,
    check_covers,
    check_step,
    elements_named,
)
from cosim.core.contracts import Stopped
from cosim.errors import GraphError, UsageError
from cosim.testing import check_component, check_rollback

H = 1e-3
POINTS = np.arange(101) * H
NONE = np.zeros(0)


def recorded(t, *signals) -> FieldData:
    return FieldData("the file", np.asarray(t, np.float64), signals)


def signal(name, *columns) -> FieldSignal:
    return FieldSignal(name, None, np.column_stack(columns))


def jittered(seed=0) -> FieldData:
    """Return two signals, of which the second, of size 2, is not always measured."""
    rng = np.random.default_rng(seed)
    t = np.sort([*rng.uniform(-0.01, 0.11, 399), POINTS[20]])
    second = np.column_stack([np.cos(t), t**2])
    second[rng.random(400) < 0.2, 0] = np.nan
    return recorded(t, signal("y", np.sin(t)), FieldSignal("x", "m", second))


def rows_of(data, points=POINTS):
    component = FieldRecording(data, most=data.most_in_a_step(points))
    first = component.initialize(points[0], NONE)
    rows = component.advance(points, H, np.zeros((len(points), 0)))
    return component, np.vstack([first, rows])


def test_it_keeps_the_contract():
    """As every component does, and it goes back."""
    data = jittered()
    most = data.most_in_a_step(POINTS)
    check_component(lambda: FieldRecording(data, most=most))
    check_rollback(lambda: FieldRecording(data, most=most))


def test_at_the_points_its_outputs_are_on_straight_lines_between_measured_samples():
    """What numpy interpolates, each element between its own samples."""
    data = jittered()
    _, rows = rows_of(data)
    for column, values in enumerate((data["y"][:, 0], *data["x"].T)):
        there = np.isfinite(values)
        expected = np.interp(POINTS, data.t[there], values[there])
        np.testing.assert_allclose(rows[:, column], expected, rtol=1e-13)


def test_with_a_hold_its_outputs_are_the_last_samples():
    """Of each element the last measured one up to the point; the outputs are discrete."""
    data = jittered()
    most = data.most_in_a_step(POINTS)
    component = FieldRecording(data, most=most, hold=True)
    assert [component.interface.by_name[name].variability for name in "yx"] == ["discrete"] * 2
    no_inputs = np.zeros((len(POINTS), 0))
    first = component.initialize(POINTS[0], NONE)
    rows = np.vstack([first, component.advance(POINTS, H, no_inputs)])
    for column, values in enumerate((data["y"][:, 0], *data["x"].T)):
        there = np.isfinite(values)
        before = np.searchsorted(data.t[there], POINTS, side="right") - 1
        np.testing.assert_array_equal(rows[:, column], values[there][before])
    check_component(lambda: FieldRecording(data, most=most, hold=True))
    check_rollback(lambda: FieldRecording(data, most=most, hold=True))


@given(st.integers(0, 100))
def test_every_sample_of_the_run_is_shown_once_with_its_time(seed):
    """In the step that it belongs to, in the order of time; those before the start are not."""
    data = jittered(seed)
    component, rows = rows_of(data)
    columns = component.interface.output_columns()
    times = rows[:, columns["sample_times"]]
    shown = times[np.isfinite(times)]
    in_run = (data.t > POINTS[0]) & (data.t <= POINTS[-1])
    np.testing.assert_array_equal(shown, data.t[in_run])
    steps = np.where(np.isfinite(times), times, POINTS[:, np.newaxis])
    assert (steps <= POINTS[:, np.newaxis]).all()
    assert (steps[1:] > POINTS[:-1, np.newaxis]).all()
    most = times.shape[1]
    samples = rows[:, columns["x_samples"]].reshape(len(rows), 2, most)
    shown_x = samples.transpose(0, 2, 1)[np.isfinite(times)]
    np.testing.assert_array_equal(shown_x, data["x"][in_run])


def test_a_sample_at_the_start_belongs_to_it():
    """And none before it: there is no step before the first."""
    data = recorded([-1e-4, 0.0, 5e-4, 0.2], signal("y", [0.0, 1.0, 2.0, 3.0]))
    component, rows = rows_of(data)
    columns = component.interface.output_columns()
    np.testing.assert_array_equal(rows[0, columns["sample_times"]], [0.0])
    np.testing.assert_array_equal(rows[0, columns["y_samples"]], [1.0])
    np.testing.assert_array_equal(rows[1, columns["sample_times"]], [5e-4])


def test_a_time_stamp_within_a_nanosecond_of_a_point_is_that_point():
    """The last bit of a product or a sum puts no sample into the next step; 2 ns do."""
    points = np.arange(2001) / 50
    products = np.arange(2001) * 0.02
    sums = np.add.accumulate(np.append(0.0, np.full(2000, 0.02)))
    for t in (products, sums):
        assert np.count_nonzero(t != points) > 200
        data = at_points(recorded(t, signal("y", t)), points)
        np.testing.assert_array_equal(data.t, points)
        assert data.most_in_a_step(points) == 1
    apart = at_points(recorded(points + 2e-9, signal("y", points)), points)
    np.testing.assert_array_equal(apart.t, points + 2e-9)


def test_two_samples_of_one_point_are_refused():
    """None of them would be seen otherwise."""
    with pytest.raises(
        UsageError, match=r"the file: expected .* 1 ns apart, got 0\.02 s and 0\.02"
    ):
        at_points(recorded([0.0, 0.02, 0.0200000004], signal("y", NONE)), np.arange(3) * 0.02)


def test_it_stops_where_the_samples_end():
    """With the rows before that."""
    data = recorded([0.0, 0.0105], signal("y", [1.0, 2.0]))
    component = FieldRecording(data, most=1)
    component.initialize(0.0, NONE)
    with pytest.raises(Stopped, match=r"the samples end at 0.0105 s") as stop:
        component.advance(POINTS, H, np.zeros((101, 0)))
    assert len(stop.value.outputs) == 10
    with pytest.raises(GraphError, match=r"from 0\.0 s to 0\.0105 s.*1\.0 s"):
        component.initialize(1.0, NONE)


def test_more_samples_than_places_are_never_dropped():
    """The component was made for other communication points."""
    data = recorded([0.0, 1e-4, 2e-4, 1.0], signal("y", np.arange(4.0)))
    component = FieldRecording(data, most=1)
    component.initialize(0.0, NONE)
    with pytest.raises(GraphError, match="more than 1 samples in a step"):
        component.advance(POINTS, H, np.zeros((101, 0)))


@pytest.mark.parametrize(
    ("t", "maximum_gap", "text"),
    [
        ([0.0, 0.0995], None, "start_time = 0.0 and stop = 0.099 of"),
        (
            [0.0004, 0.2],
            None,
            "got 0.0004 s to 0.2 s, as 'y' begins at 0.0004 s: start_time = 0.001",
        ),
        ([7.0, 8.0], None, 'offset = "first" makes its first time 0'),
        (
            [*np.arange(0.0, 0.05, 1e-3), *np.arange(0.062, 0.11, 1e-3)],
            None,
            "'y' has no sample between 0.049 s and 0.062 s",
        ),
        ([0.0, 0.04, 0.1], 0.05, "s no sample between 0.04 s and 0.1 s"),
    ],
)
def test_samples_that_do_not_cover_the_run_are_refused_with_the_way_out(t, maximum_gap, text):
    """Before the run, and with the times."""
    data = recorded(t, signal("y", np.ones(len(t))))
    with pytest.raises(UsageError) as refused:
        check_covers(data, POINTS, maximum_gap)
    assert text in str(refused.value)


def test_a_gap_outside_of_the_run_does_not_matter():
    """Nor one that is allowed."""
    t = [-5.0, -1e-3, *np.arange(0.0, 0.1005, 1e-3), 5.0]
    check_covers(recorded(t, signal("y", np.ones(len(t)))), POINTS, None)
    check_covers(recorded([0.0, 0.1], signal("y", [1.0, 2.0])), POINTS, 0.1)


def test_what_begins_late_or_ends_early_is_named():
    """With its column, where that has another name."""
    t = np.arange(0.0, 0.11, 0.01)
    late = FieldSignal("z", None, np.where(t < 0.03, np.nan, t)[:, np.newaxis], ("level",))
    early = signal("x", np.ones(11), np.where(t > 0.05, np.nan, t))
    with pytest.raises(UsageError) as refused:
        check_covers(recorded(t, signal("y", t), late, early), POINTS, None)
    named = "as 'z' (level) begins at 0.03 s, 'x' ends at 0.05 s: start_time = 0.03 and"
    assert named in str(refused.value)


def test_held_samples_hold_to_the_end_of_the_recording():
    """Of the run where that is asked for; with a limit on the distance, not beyond it."""
    once = recorded([0.0, 0.05], FieldSignal("y", None, np.array([[3.0], [np.nan]]), ("/map.n",)))
    cases = [
        (once, {}, r"'y' \(/map.n\) ends at 0.0 s: extrapolation = \"hold\" keeps"),
        (replace(once, end=0.1), {}, r'interpolation = "zero-order" holds a sample'),
        (once, {"hold": True}, r"stop = 0.05 .*, or extrapolation"),
        (replace(once, end=0.0999), {"hold": True}, r"got 0.0 s to 0.0999 s"),
    ]
    for data, options, text in cases:
        with pytest.raises(UsageError, match=text):
            check_covers(data, POINTS, None, **options)
    assert check_covers(replace(once, end=0.1), POINTS, None, hold=True) == []
    assert check_covers(once, POINTS, None, extrapolate=True) == []
    with pytest.raises(UsageError, match=r"no sample between 0.0 s and 0.1 s.* maximum_gap = 0.06"):
        check_covers(replace(once, end=0.1), POINTS, 0.06, hold=True)
    component = FieldRecording(replace(once, end=0.1), most=1, hold=True)
    component.initialize(0.0, NONE)
    rows = component.advance(POINTS, H, np.zeros((101, 0)))
    assert rows[:, 0].tolist() == [3.0] * 100
    with pytest.raises(Stopped, match=r"the samples end at 0\.1 s"):
        component.advance(np.array([0.1, 0.101]), H, np.zeros((2, 0)))


def test_samples_on_change_may_be_held_for_long():
    """It is said; straight lines over such a gap are refused."""
    t = [*np.arange(0.0, 0.02, 1e-3), 0.1]
    data = recorded(t, signal("mode", np.arange(21)))
    (note,) = check_covers(data, POINTS, None, hold=True)
    assert "'mode' is held from 0.019 s to 0.1 s" in note
    with pytest.raises(UsageError, match=r"no sample between 0\.019 s and 0\.1 s"):
        check_covers(data, POINTS, None)


def test_after_a_first_stamp_of_zero_the_offset_is_the_way_out():
    """Not a gap of 54 years."""
    t = [0.0, *(1.7e9 + np.arange(3))]
    data = replace(recorded(t, signal("y", np.ones(4))), restart=(0.0, "1700000000"))
    with pytest.raises(UsageError, match=r"0.0 s and 1700000000.0 s; .*; offset = 1700000000 is"):
        check_covers(data, POINTS, None)


def test_a_signal_that_is_never_measured_is_refused():
    """By its name."""
    data = recorded([0.0, 1.0], signal("y", [np.nan, np.nan]))
    with pytest.raises(UsageError, match="the file has no measured value of 'y'"):
        check_covers(data, POINTS, None)


def test_elements_are_grouped_where_all_are_there():
    """From 0 on; else each is a signal of its own name, as in FMUs that count from 1."""
    names = ["x[1]", "y", "x[0]", "z[1]", "z[2]", "w[a]"]
    expected = {"x": ["x[0]", "x[1]"], "y": ["y"], "z[1]": ["z[1]"], "z[2]": ["z[2]"]}
    assert elements_named(names) == {**expected, "w[a]": ["w[a]"]}
    assert list(elements_named(["x", "x[0]"])) == ["x", "x[0]"]  # neither is lost


def test_a_step_is_finer_than_samples_that_come_less_often_than_once_in_it():
    """By the median distance, with a tenth for clocks that drift; of one sample nothing is said."""
    t = np.arange(100) * 1.05 * H
    t[50:] += 0.3  # a gap is no matter of the step
    check_step(recorded(t, signal("y", t)), H)
    check_step(recorded([0.0], signal("y", [1.0])), H)
    sparse = recorded(np.arange(100) * 1.2 * H, signal("y", t))
    with pytest.raises(UsageError, match=r"step of 0\.001 s is.*of 'y'.*s.*step of.*s"):
        check_step(sparse, H)
