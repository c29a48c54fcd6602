"""Sobol indices: against closed forms and scipy."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import stats

from cosim.errors import UsageError
from cosim.studies.analysis.confidence import NO_INTERVAL
from cosim.studies.analysis.independence import StudyLayout
from cosim.studies.analysis.sensitivity import bootstrap, indices_of, sobol_indices
from tests.studies.analysis.made import columns_of


def saltelli(function, dimension, count, rng, *, independent=False):
    """Return a function of points in the unit cube, in the rows A, B, AB_1, ..., AB_d."""
    if independent:
        points = rng.random((count, 2 * dimension))
    else:
        points = stats.qmc.Sobol(2 * dimension, rng=rng).random(count)
    of_a, of_b = points[:, :dimension], points[:, dimension:]
    matrices = [of_a, of_b]
    for column in range(dimension):
        mixed = of_a.copy()
        mixed[:, column] = of_b[:, column]
        matrices.append(mixed)
    return np.array([function(matrix.T) for matrix in matrices])


def layout_of(dimension, count, **others):
    names = tuple(f"p{k}" for k in range(dimension))
    return StudyLayout("saltelli", parameters=names, samples=(dimension + 2) * count, **others)


def ishigami(u):
    x = np.pi * (2.0 * u - 1.0)
    return np.sin(x[0]) + 7.0 * np.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * np.sin(x[0])


def ishigami_indices():
    """Return the closed form (Ishigami and Homma, 1990) for a = 7, b = 0.1."""
    a, b = 7.0, 0.1
    alone = np.array([0.5 * (1.0 + b * np.pi**4 / 5.0) ** 2, a**2 / 8.0, 0.0])
    pair = b**2 * np.pi**8 * (1.0 / 18.0 - 1.0 / 50.0)  # of the first and the third
    together = np.array([pair, 0.0, pair])
    variance = alone.sum() + pair
    return alone / variance, (alone + together) / variance


WEIGHTS = np.array([0.0, 1.0, 4.5, 9.0, 99.0])


def g_function(u):
    return np.prod(
        (abs(4.0 * u - 2.0) + WEIGHTS[:, np.newaxis]) / (1.0 + WEIGHTS[:, np.newaxis]), 0
    )


def g_indices():
    """Return the closed form (Saltelli and Sobol, 1995)."""
    alone = 1.0 / (3.0 * (1.0 + WEIGHTS) ** 2)
    variance = np.prod(1.0 + alone) - 1.0
    others = np.prod(1.0 + alone) / (1.0 + alone)
    return alone / variance, alone * others / variance


def linear(u):
    return 3.0 * u[0] + 2.0 * u[1] + 1.0


def product(u):
    return (u[0] - 0.5) * (u[1] - 0.5)


CLOSED = [
    (ishigami, 3, ishigami_indices()),
    (g_function, 5, g_indices()),
    (linear, 2, (np.array([9.0, 4.0]) / 13.0,) * 2),
    (product, 2, (np.zeros(2), np.ones(2))),
]


@pytest.mark.parametrize(("function", "dimension", "expected"), CLOSED)
def test_the_indices_are_those_of_the_closed_form(function, dimension, expected):
    """Within 0.02 of it, of 4096 base points; the intervals hold them."""
    values = saltelli(function, dimension, 4096, np.random.default_rng(0))
    columns = columns_of({"y": values.ravel()})
    found = sobol_indices(columns, layout_of(dimension, 4096), "y")
    first, total = expected
    assert abs(found.first_order - first).max() < 0.02
    assert abs(found.total_order - total).max() < 0.02
    for index in range(dimension):
        interval = found.first_intervals[index]
        assert interval.lower <= first[index] <= interval.upper
        interval = found.total_intervals[index]
        assert interval.lower <= total[index] <= interval.upper
    assert found.base_points == 4096
    assert list(found.to_dict()["parameters"]) == list(found.parameters)


def test_the_indices_and_intervals_are_those_of_scipy(monkeypatch):
    """Indices but for rounding; intervals as far as two kinds of bootstrap agree."""
    values = saltelli(ishigami, 3, 1024, np.random.default_rng(1)) + 5.0
    found = sobol_indices(columns_of({"y": values.ravel()}), layout_of(3, 1024), "y")
    matrices = {"f_A": values[:1], "f_B": values[1:2], "f_AB": values[2:, np.newaxis]}
    expected = stats.sobol_indices(func=matrices, n=1024)
    assert np.allclose(found.first_order, expected.first_order, rtol=0.0, atol=1e-12)
    assert np.allclose(found.total_order, expected.total_order, rtol=0.0, atol=1e-12)
    seeded = partial(stats.bootstrap, rng=np.random.default_rng(0))
    monkeypatch.setattr("scipy.stats._sensitivity_analysis.bootstrap", seeded)
    resampled = expected.bootstrap()
    for own, other in (
        (found.first_intervals, resampled.first_order),
        (found.total_intervals, resampled.total_order),
    ):
        # an end of 1000 resamples is known to a tenth of the standard error
        tolerance = 0.5 * other.standard_error
        low = np.array([interval.lower for interval in own])
        high = np.array([interval.upper for interval in own])
        assert (abs(low - other.confidence_interval.low) < tolerance).all()
        assert (abs(high - other.confidence_interval.high) < tolerance).all()


def test_a_base_point_with_a_member_that_failed_is_left_out():
    """With all its members, and it is named; the others have the indices of theirs."""
    values = saltelli(ishigami, 3, 256, np.random.default_rng(2))
    raw = values.copy()
    raw[3, 17] = np.nan
    raw[0, 200] = np.inf
    columns = columns_of({"y": raw.ravel()}, failed=[256 + 30])
    found = sobol_indices(columns, layout_of(3, 256), "y")
    assert found.omitted.tolist() == [17, 30, 200]
    kept = np.setdiff1d(np.arange(256), [17, 30, 200])
    first, total = indices_of(values[:, kept], np.ones((1, 253)))
    assert np.array_equal(found.first_order, first[0])
    assert np.array_equal(found.total_order, total[0])


def test_members_that_are_not_done_leave_their_base_points_out():
    """A study that was stopped has indices of what is complete."""
    values = saltelli(linear, 2, 64, np.random.default_rng(3)).ravel()
    columns = columns_of({"y": values[:-5]})
    found = sobol_indices(columns, layout_of(2, 64), "y")
    assert found.omitted.tolist() == [59, 60, 61, 62, 63]


def test_one_parameter_has_all_of_the_variance():
    """Which scipy does not compute."""
    values = saltelli(lambda u: u[0], 1, 1024, np.random.default_rng(4))
    found = sobol_indices(columns_of({"y": values.ravel()}), layout_of(1, 1024), "y")
    assert found.first_order == pytest.approx([1.0], abs=0.02)
    assert found.total_order == pytest.approx([1.0], abs=0.02)


@pytest.mark.parametrize(
    ("layout", "raw", "message"),
    [
        (
            StudyLayout("random", samples=32),
            np.arange(32.0),
            r"'saltelli'.*got 'random'",
        ),
        (layout_of(2, 4, seeds=2), np.arange(32.0), r"one member per sample.*got 2"),
        (layout_of(2, 8), np.ones(32), r"'y': .*got the same value in all"),
        (layout_of(2, 8), 0.3 + 2.0**-54 * np.arange(32.0), r"'y': .*got the same value in all"),
        (layout_of(2, 4), np.arange(16.0), r"'y': .*base points.*got 4 of 4"),
    ],
)
def test_a_study_without_indices_says_why(layout, raw, message):
    """The design, its members, or the metric."""
    with pytest.raises(UsageError, match=message):
        sobol_indices(columns_of({"y": raw}), layout, "y")


@pytest.mark.parametrize("count", [150, pytest.param(2000, marks=pytest.mark.campaign)])
def test_few_base_points_have_indices_without_intervals(count):
    """Of 16 Sobol points fewer than 90 % of the intervals would hold those of the g function."""
    rng = np.random.default_rng(8)
    hold = []
    for _ in range(count):
        values = saltelli(g_function, 5, 16, rng)
        for resampled, true in zip(bootstrap(values, resamples=200), g_indices(), strict=True):
            lower, upper = np.quantile(resampled, [0.025, 0.975], axis=0)
            hold.append((lower <= true) & (true <= upper))
    assert np.mean(hold) < 0.9
    found = sobol_indices(columns_of({"y": values.ravel()}), layout_of(5, 16), "y")
    assert {*found.first_intervals, *found.total_intervals} == {NO_INTERVAL}
    assert np.isfinite(found.total_order).all()
    content = found.to_dict()["parameters"]["p0"]
    assert content["first_interval"] == [None, None]


@pytest.mark.parametrize("points", [64, pytest.param(512, marks=pytest.mark.campaign)])
def test_intervals_of_sobol_points_hold_roughly(points):
    """Of each index of the Ishigami function 80 % at least, of 100 studies: not 95 %."""
    rng = np.random.default_rng(9)
    hold = []
    for _ in range(100):
        values = saltelli(ishigami, 3, points, rng)
        both = zip(bootstrap(values, resamples=300), ishigami_indices(), strict=True)
        quantiles = [
            (np.quantile(resampled, [0.025, 0.975], axis=0), true) for resampled, true in both
        ]
        hold.append([(ends[0] <= true) & (true <= ends[1]) for ends, true in quantiles])
    assert np.mean(hold, axis=0).min() >= 0.75


def test_the_same_study_has_the_same_intervals():
    """The bootstrap has a seed."""
    values = saltelli(linear, 2, 64, np.random.default_rng(5))
    first, _ = bootstrap(values, resamples=20)
    again, _ = bootstrap(values, resamples=20)
    assert np.array_equal(first, again)


@pytest.mark.slow
@pytest.mark.parametrize("count", [200, pytest.param(2000, marks=pytest.mark.campaign)])
def test_95_percent_of_the_intervals_of_independent_base_points_hold(count):
    """On the average over the indices of the Ishigami function."""
    rng = np.random.default_rng(6)
    first, total = ishigami_indices()
    hold = []
    for _ in range(count):
        values = saltelli(ishigami, 3, 512, rng, independent=True)
        for resampled, true in zip(bootstrap(values, resamples=400), (first, total), strict=True):
            lower, upper = np.quantile(resampled, [0.025, 0.975], axis=0)
            hold.append((lower <= true) & (true <= upper))
    low, high = (0.91, 0.98) if count < 1000 else (0.93, 0.97)
    assert low <= np.mean(hold) <= high


@pytest.mark.parametrize("factor", [2.0**-700, 2.0**1000])
def test_the_indices_of_huge_and_tiny_values_are_those_of_others(factor):
    """They are shares of a variance that no number holds."""
    values = saltelli(linear, 2, 64, np.random.default_rng(7)).ravel()
    found = sobol_indices(columns_of({"y": values}), layout_of(2, 64), "y")
    scaled = sobol_indices(columns_of({"y": values * factor}), layout_of(2, 64), "y")
    assert np.array_equal(found.first_order, scaled.first_order)
    assert found.total_intervals == scaled.total_intervals


@pytest.mark.parametrize(("function", "dimension", "expected"), CLOSED)
def test_sums_that_no_function_has_are_remarked(function, dimension, expected):
    """Never where there are points enough; such sums come of few."""
    rng = np.random.default_rng(3)
    values = saltelli(function, dimension, 4096, rng)
    whole = sobol_indices(columns_of({"y": values.ravel()}), layout_of(dimension, 4096), "y")
    assert whole.remark == ""
    first = whole.first_order * (1.2 / max(whole.first_order.sum(), 1e-9))
    assert "first orders sum to 1.20, above 1" in replace(whole, first_order=first).remark
    total = whole.total_order * (0.63 / whole.total_order.sum())
    few = replace(whole, total_order=total)
    assert few.remark == "too few base points: total orders sum to 0.63, below 1"
    assert few.to_dict()["remark"] == few.remark
    omitted = replace(few, omitted=np.array([3]))
    assert omitted.remark.startswith("too few base points, or those that were left out: total")
