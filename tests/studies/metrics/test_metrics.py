"""Metrics against numpy over the same rows, and against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.studies.measuring import MetricRecorder
from cosim.studies.metrics import parse_metrics
from tests.studies.metrics.rows import STEP_NS, columns, memory_of, value, write

numbers = st.floats(-1e3, 1e3, allow_subnormal=False)
gaps = st.one_of(numbers, st.just(math.nan))
ALL = {
    "last": "last(plant.gap)",
    "initial": "initial(plant.gap)",
    "max": "max(plant.gap)",
    "min": "min(plant.gap, plant.u > 0)",
    "mean": "mean(plant.gap)",
    "rms": "rms(plant.gap - plant.u, plant.u >= 0)",
    "std": "std(plant.gap)",
    "integral": "integral(plant.gap)",
    "count": "count(plant.gap, plant.u > 0)",
    "first": "first(t, plant.gap > 0 for 2 ms)",
    "share": "share(plant.gap > 0 for 1 ms)",
    "settling": "settling(plant.gap)",
    "within": "settling(plant.gap, 0.1*max(abs(plant.gap)), plant.u > 0)",
    "overshoot": "overshoot(plant.gap)",
    "slow": "mean(slow.y)",
    "both": "integral(slow.y - plant.u)",
    "joined": "max(last(t), 2.0) - sqrt(abs(mean(plant.u)))**2/3",
}


def bits(values):
    return {name: None if v is None else v.hex() for name, v in values.items()}


@given(st.lists(st.tuples(gaps, numbers), min_size=1, max_size=300), st.data())
@settings(max_examples=60)
def test_values_have_the_same_bits_however_the_run_is_cut(pairs, data):
    """And are those of the recorded run; a recorder takes one run after the other."""
    gap, u = np.array(pairs).T
    rows = columns(gap=gap, u=u, slow=u + 1.0)
    metrics = parse_metrics(ALL)
    recorder = MetricRecorder(metrics)
    whole = bits(write(recorder, rows).values())
    sizes = data.draw(st.lists(st.integers(1, 150), max_size=10))
    assert bits(write(recorder, rows, sizes).values()) == whole
    assert bits(write(recorder, rows, [1] * len(rows)).values()) == whole
    assert bits(metrics.of(memory_of(rows))) == whole


REFERENCES = {
    "last": lambda x: x[-1],
    "max": np.max,
    "min": np.min,
    "mean": np.mean,
    "rms": lambda x: np.sqrt(np.mean(x * x)),
    "std": np.std,
    "count": len,
}


@pytest.mark.parametrize("name", REFERENCES)
@given(pairs=st.lists(st.tuples(gaps, numbers), min_size=1, max_size=300))
@settings(max_examples=40)
def test_a_reduction_is_that_of_the_rows_that_have_a_value(name, pairs):
    """Where the condition is true; numpy's pairwise sums differ by n roundings of 1e3 at most.

    A mean of squares, which does not cancel, by n 2^-52 of itself; that of differences to the first
    value is up to n + 1 times the variance, which loses as much more, and numpy's mean as it is
    rounded is another origin.
    """
    gap, u = np.array(pairs).T
    rows = columns(gap=gap, u=u)
    chosen = gap[~np.isnan(gap) & (u > 0)]
    found = value(f"{name}(plant.gap, plant.u > 0)", rows)
    if len(chosen) == 0:
        assert found == (0.0 if name == "count" else None)
        return
    n = len(chosen)
    relative = {"rms": n, "std": n * (n + 1)}.get(name, 0) * 2.0**-52
    absolute = 1e3 * n * 2.0**-52 if name in ("mean", "std") else 0.0
    assert found == pytest.approx(REFERENCES[name](chosen), abs=absolute, rel=relative)


def test_the_reductions_of_a_sine_have_their_closed_forms():
    """Over whole periods of 1 s: rms 1/sqrt 2, mean 0, a half is positive; trapezoids lose h^2.

    Sums over whole periods of a trigonometric polynomial are exact but for roundings, n 2^-53.
    """
    t = np.arange(1000) * STEP_NS / 1e9
    rows = columns(y=np.sin(2.0 * np.pi * t))
    rounding = 1000 * 2.0**-52
    assert value("rms(plant.y)", rows) == pytest.approx(math.sqrt(0.5), abs=rounding)
    assert value("std(plant.y)", rows) == pytest.approx(math.sqrt(0.5), abs=rounding)
    assert value("mean(plant.y)", rows) == pytest.approx(0.0, abs=rounding)
    assert value("share(plant.y > 0.5)", rows) == pytest.approx(1 / 3, abs=2e-3)  # two rows of 1000
    half = value("integral(plant.y, t <= 0.5)", rows)
    assert half == pytest.approx(1.0 / np.pi, abs=1e-6 / 12 * 0.5 * (2 * np.pi) ** 2)
    assert value("max(abs(plant.y)) - min(plant.y)", rows) == pytest.approx(2.0, abs=1e-15)
    last = pytest.approx(-math.sin(2.0 * math.pi / 1000), rel=1e-12)
    assert value("max(plant.y, t > 0.5)", rows) == last
    assert value("last(t)", rows) == 0.999
    assert value("count(t, t > 0.5)", rows) == 499.0
    assert value("first(t, plant.y < 0)", rows) == 0.501


def test_settling_is_where_a_lag_comes_within_its_band():
    """y = 1 - exp(-t/T): |y - y_end| <= b at t = -T ln(b + exp(-t_end/T)), rounded up to a row."""
    t = np.arange(10_001) * STEP_NS / 1e9
    T = 0.7
    rows = columns(y=5.0 + 3.0 * (1.0 - np.exp(-t / T)))
    end = math.exp(-10.0 / T)

    def instant(band):
        return math.ceil(-T * math.log(band + end) * 1e3) / 1e3

    assert value("settling(plant.y)", rows) == instant(0.02 * (1.0 - end))
    assert value("settling(plant.y, 0.3)", rows) == instant(0.1)
    assert value("settling(plant.y, 3*0.05)", rows) == instant(0.05)
    assert value("settling(plant.y, 0.1*(last(plant.y) - 5))", rows) == instant(0.1 * (1.0 - end))
    assert value("settling(plant.y, 100)", rows) == 0.0
    assert value("settling(plant.y, 0.3, t >= 6)", rows) == 6.0
    assert value("settling(plant.y, 0.3, t >= 6) - first(t, t >= 6)", rows) == 0.0
    assert value("settling(plant.y, 0)", rows) == 10.0
    assert value("settling(plant.y, 0 - max(plant.y))", rows) is None


def test_the_overshoot_of_a_second_order_lag_is_that_of_its_damping():
    """exp(-pi zeta/sqrt(1 - zeta^2)) of the change, up and down.

    Its peak is flat: a row off costs h^2/2 times the second derivative, which is below w^2.
    """
    t = np.arange(40_000) * STEP_NS / 1e9
    zeta, w = 0.3, 5.0
    damped = w * math.sqrt(1.0 - zeta**2)
    wave = np.cos(damped * t) + zeta * w / damped * np.sin(damped * t)
    y = 1.0 - np.exp(-zeta * w * t) * wave
    needed = pytest.approx(
        math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2)), abs=w**2 / 2 * 1e-6
    )
    assert value("overshoot(plant.y)", columns(y=y)) == needed
    assert value("overshoot(7 - 3*plant.y)", columns(y=y)) == needed
    assert value("overshoot(plant.y, t < 0.1)", columns(y=y)) == 0.0
    assert value("overshoot(plant.u)", columns(y=y)) is None  # it has not changed


def test_an_integral_is_between_rows_that_follow_each_other():
    """Not across a row without a value, or where the condition is not true."""
    gap = np.array([1.0, 3.0, math.nan, 5.0, 7.0, 100.0])
    rows = columns(gap=gap)
    assert value("integral(plant.gap)", rows) == pytest.approx((2.0 + 6.0 + 53.5) * 1e-3, rel=1e-15)
    assert value("integral(plant.gap, plant.gap < 50)", rows) == pytest.approx(8e-3, rel=1e-15)
    assert value("integral(plant.gap, plant.gap > 50)", rows) == 0.0
    assert value("integral(plant.gap, plant.gap > 500)", rows) is None
    infinite = "(1e308 * 10) * (t - 0.1005)"  # of either sign, of which there is no sum
    assert value(f"integral({infinite}, t >= 0.1 and t < 0.1015)", rows) is None


def test_a_duration_is_that_of_conditions_everywhere():
    """True at the rows up to which it held so long, of equal conditions each its own."""
    y = np.array([0, 1, 1, 0, 1, 1, 1, 1, 0], float)
    rows = columns(y=y)
    assert value("first(t, plant.y > 0)", rows) == 0.001
    assert value("first(t, plant.y > 0 for 1 ms)", rows) == 0.002
    assert value("first(t, plant.y > 0 for 2 ms)", rows) == 0.006
    assert value("first(t, (plant.y > 0) for 0.002)", rows) == 0.006
    assert value("first(t, not plant.y <= 0 for 1500 us)", rows) == 0.006
    assert value("first(t, plant.y > 0 for 1 h)", rows) is None
    assert value("share(plant.y > 0 for 1 ms)", rows) == 4 / 9
    assert value("share(plant.y > 0 for 1 ms, t > 0.004 for 2 ms)", rows) == 1 / 2
    both = "first(t, plant.y > 0 for 2 ms) - first(t, plant.y > 0 for 1 ms)"
    assert value(both, rows) == 0.006 - 0.002


def test_components_of_several_rates_have_the_rows_that_all_have():
    """``slow`` has one in four: what stands between in the row is not its."""
    rows = columns(y=np.arange(9.0), slow=np.arange(9.0) * 10.0)
    assert value("count(plant.y)", rows) == 9.0
    assert value("count(slow.y)", rows) == 3.0
    assert value("count(plant.y + slow.y)", rows) == 3.0
    assert value("max(plant.y, slow.y < 50)", rows) == 4.0
    assert value("last(slow.y)", rows[:8]) == 40.0
    assert value("count(t)", rows) == 9.0


def test_a_reduction_of_no_values_is_none():
    """Also what is not finite; a count is 0."""
    rows = columns(y=[0.0, 2.0], gap=[math.nan, math.nan])
    assert value("last(plant.gap)", rows) is None
    assert value("1 + max(last(plant.gap), 2)", rows) is None
    assert value("min(2, last(plant.gap))", rows) is None
    assert value("count(plant.gap)", rows) == 0.0
    assert value("1/min(plant.y)", rows) is None
    assert value("max(1/plant.y)", rows) is None
    assert value("share(plant.gap > 0)", rows) == 0.0
    assert value("share(plant.gap > 0, plant.y > 5)", rows) is None
    assert value("settling(plant.y, last(plant.gap))", rows) is None


def test_names_in_quotes_elements_and_arithmetic():
    """As in all expressions; the functions between reductions are those inside."""
    rows = columns(v0=[1.0, 4.0], v1=[2.0, 3.0], part=[5.0, -9.0])
    assert value("last(plant.v[0]) - last('plant.v[1]')", rows) == 1.0
    assert value("max(abs('my-part.der(x)'))", rows) == 9.0
    assert value("max(max(plant.v[0], plant.v[1]))", rows) == 4.0
    assert value("max(max(plant.v[1]), min(plant.v[0]))", rows) == 3.0
    assert value("-sqrt(last(plant.v[0]))**3/2 + pi", rows) == math.pi - 4.0
    assert value("max(\n  plant.v[0],\n  t > 0 for 1 ms\n)", rows) is None
    assert value("max(plant.v[0]\n)", rows) == 4.0
