"""What members say: against numpy, scipy and SALib, closed forms, and how often intervals hold."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy import stats

import cosim
from cosim.errors import UsageError
from cosim.studies import statistics
from cosim.studies.design import plan_design
from cosim.studies.layout import StudyLayout, drawn_members
from cosim.studies.sensitivity import sobol_indices
from cosim.studies.statistics import NO_INTERVAL, mean_interval, passed_share, study_statistics
from cosim.studies.study_file import StudyOptions, read_study
from tests.studies.made import columns_of, rows_of_matrices, saltelli

RANDOM = StudyLayout("random", samples=1000)
THETA = {"delta.terms[0].theta": {"uniform": [-0.2, -0.1]}}
RATE = {"observer.filter_rate": [100.0, 300.0, 1000.0]}


def statistics_of(values, layout=RANDOM, **others):
    return study_statistics(columns_of({"a": values}, **others), layout)["a"]


def correlations_of(values, parameters, layout=RANDOM):
    return statistics.rank_correlations(columns_of({"m": values}, parameters=parameters), layout)


def planned(**options):
    study = read_study("academic-noisy").with_options(StudyOptions(**options))
    return plan_design(study, cosim.load("academic-noisy"))


def share_that_hold(intervals, true):
    lower, upper = np.array(intervals, float).T  # NaN: an end that is not known excludes nothing
    return 1.0 - np.mean((true < lower) | (true > upper))


def most_by_chance(share, count):
    """Return the share that 999 of 1000 binomial samples do not exceed."""
    return share + 3.3 * math.sqrt(share * (1.0 - share) / count)


def t_interval(values):
    return stats.ttest_1samp(values, 0.0).confidence_interval(0.95)


# members, and what of them was drawn together


def test_every_member_is_counted_once():
    """Numbers, failures, no value, infinity, texts: together all members."""
    values = [1.0, None, np.nan, np.inf, 2.5, -np.inf, 7.0]
    texts = ["yes", "no", "yes", None, "no", "yes", "no"]
    columns = columns_of({"rms": values, "verdict": texts}, failed=[6])
    one = columns.metric("rms")
    members = [of.tolist() for of in (one.numbers, one.failed, one.without_value, one.infinite)]
    assert (one.values.tolist(), members) == ([1.0, 2.5], [[0, 4], [6], [1, 2], [3, 5]])
    assert columns.metrics["verdict"].texts == {"yes": 3, "no": 2}
    assert columns.metrics["verdict"].without_value.tolist() == [3]


SALTELLI = {"vary": THETA, "samples": 4, "sampling": "saltelli"}
MIXED = {"vary": {**THETA, **RATE}, "samples": 8, "seeds": 2, "sampling": "sobol"}


@pytest.mark.parametrize(
    ("options", "text", "units", "shared"),
    [
        ({"vary": RATE}, "grid of 3", 1, 3),
        ({"vary": {}, "seeds": 5}, "5 seeds", 5, 1),
        ({"vary": RATE, "seeds": 5}, "grid of 3 x 5 seeds", 5, 1),
        (MIXED, "sobol: 8 samples x grid of 3 x 2 seeds", 8, 1),
        (SALTELLI, "saltelli: 4 base points x 3", 12, 1),
        ({**SALTELLI, "seeds": 2}, "saltelli: 4 base points x 3 x 2 seeds", 4, 2),
    ],
)
def test_members_of_one_unit_share_what_was_drawn(options, text, units, shared):
    """Of a sample its values; of a seed of a grid, or a base point with seeds, their noise."""
    design = planned(**options)
    assert (design.layout.text, design.layout.is_drawn) == (text, units > 1)
    numbers = np.arange(len(design))
    found = design.layout.units_of(numbers)
    found = numbers if found is None else found
    assert len(np.unique(found)) == units
    key = "delta.terms[0].theta" if "sobol" in text else [*design.columns][-1]
    values = np.array(design.column(key))
    assert {len(np.unique(values[found == unit])) for unit in np.unique(found)} == {shared}


def test_a_grid_has_no_interval_and_one_with_seeds_has_that_of_its_seeds():
    """The points of a grid were chosen: only seeds vary the mean over all points."""
    of_point = np.linspace(0.0, 5.0, 6)
    of_seed = np.random.default_rng(1).normal(size=40)
    for chosen in (StudyLayout("grid", grid=6), StudyLayout("cases", samples=6)):
        found = statistics_of(of_point, chosen)
        share = passed_share(columns_of({"a": of_point}), chosen, "a < 3")
        intervals = {found["mean_interval"], found["quantiles"][1]["interval"], share["interval"]}
        assert (intervals, found["basis"][:4]) == ({NO_INTERVAL}, "none")
    values = (of_seed[:, np.newaxis] + of_point).ravel()
    for layout, basis in (
        (StudyLayout("grid", seeds=40, grid=6), "40 seeds drawn independently"),
        (StudyLayout("random", seeds=6, samples=40), "6 members of a sample count as one"),
    ):
        found = statistics_of(values, layout)
        assert found["mean_interval"] == pytest.approx(t_interval(of_seed + of_point.mean()))
        assert basis in found["basis"]


# figures and their intervals


def test_too_few_values_have_no_figure_or_no_interval():
    """One unit has none of its mean; four values, or equal ones, none of their deviation."""
    for raw, failed in (([None] * 3, ()), ([1.0, 2.0, 3.0], (0, 1, 2)), ([np.inf] * 3, ())):
        found = statistics_of(raw, failed=failed)
        assert (found["count"], found["quantiles"], found["mean"]) == (0, [], None)
        assert found["failed"] + found["without_value"] + found["infinite"] == 3
    intervals = [mean_interval(np.ones(1)), mean_interval(np.ones(4), np.zeros(4, np.int64))]
    intervals += [statistics.deviation_interval(one) for one in (np.arange(4.0), np.full(100, 0.1))]
    assert set(intervals) == {NO_INTERVAL}
    assert np.ptp(mean_interval(np.full(6, 0.1))) == 0.0


def test_a_quantile_has_the_interval_of_its_order_statistics():
    """As scipy has it: NaN there is no end here."""
    for count, probability in product((1, 5, 58, 59, 200, 10_000), (0.05, 0.5, 0.99)):
        values = np.sort(np.random.default_rng(count).exponential(size=count))
        expected = stats.quantile_test(values, p=probability).confidence_interval(0.95)
        found = np.array(statistics.quantile_interval(values, probability, count), float)
        assert np.array_equal(found, [expected.low, expected.high], equal_nan=True)


def of_laplace(rng):
    """Return independent values, whose kurtosis is twice that of normal ones."""
    return rng.laplace(size=200)


def of_units(rng):
    """Return 80 values with 4 seeds each: the sample moves the value as the seed does."""
    return np.repeat(rng.normal(size=80), 4) + rng.normal(size=320)


def of_hypercube(rng):
    """Return 40 points of p + q, which has a triangular distribution: 5 % are below 0.1**0.5."""
    return stats.qmc.LatinHypercube(2, rng=rng).random(40).sum(axis=1)


HYPERCUBE = StudyLayout("latin-hypercube", samples=40)
QUANTILES = np.array([0.05, 0.5, 0.95])
LAPLACE = (0.0, math.sqrt(2.0), stats.laplace.ppf(QUANTILES))
NORMAL = (0.0, math.sqrt(2.0), stats.norm(0.0, math.sqrt(2.0)).ppf(QUANTILES))
TRIANGULAR = (1.0, math.sqrt(1.0 / 6.0), (math.sqrt(0.1), 1.0, 2.0 - math.sqrt(0.1)))


@pytest.mark.parametrize(
    ("layout", "draw", "truth"),
    [
        (RANDOM, of_laplace, LAPLACE),
        (StudyLayout("random", samples=80, seeds=4), of_units, NORMAL),
        (HYPERCUBE, of_hypercube, TRIANGULAR),
    ],
)
def test_95_percent_of_the_intervals_hold(layout, draw, truth):
    """Of mean, deviation, a share and quantiles, whatever members have in common."""
    rng = np.random.default_rng(9)
    mean, deviation, quantiles = truth
    found, careless = [], []
    for _ in range(200):
        values = draw(rng)
        one = statistics_of(values, layout)
        share = passed_share(columns_of({"a": values}), layout, f"a < {quantiles[2]}")
        own = [quantile["interval"] for quantile in one["quantiles"]]
        found.append((one["mean_interval"], one["deviation_interval"], share["interval"], *own))
        careless.append(mean_interval(values))
    every = (mean, deviation, 0.95, *quantiles)
    held = [share_that_hold(*pair) for pair in zip(zip(*found, strict=True), every, strict=True)]
    assert min(held) >= 1.0 - most_by_chance(0.05, 200)
    if layout.kind == "random":  # a hypercube helps the mean of a sum more than is known
        assert max(held[:2]) < 1.0
    if layout.seeds > 1:  # as if seeds of one sample were independent
        assert share_that_hold(careless, mean) < 0.85


def test_where_too_few_intervals_of_a_mean_hold_they_are_rough():
    """Of 40 values with a long tail less than 88 % do; of as many normal ones no word is said."""
    rng = np.random.default_rng(12)
    skewed = rng.lognormal(0.0, 1.5, (500, 40))
    assert share_that_hold([*map(mean_interval, skewed)], math.exp(1.125)) < 0.88
    assert np.mean([*map(statistics.is_rough, skewed)]) > 0.9
    normal = rng.normal(size=(500, 40))
    assert np.mean([*map(statistics.is_rough, normal)]) < 0.02
    assert statistics.is_rough(normal[0, :9])
    assert statistics.is_rough(normal.ravel()[:90], np.arange(90) // 10)
    assert not statistics.is_rough(np.ones(5))


def test_units_of_the_same_sum_have_no_spread():
    """Of a metric that seeds do not change nothing is left but rounding."""
    cases = np.random.default_rng(6).normal(size=5)
    columns, layout = columns_of({"a": cases.repeat(8)}), StudyLayout("cases", seeds=8, samples=5)
    found = study_statistics(columns, layout)["a"]
    assert np.ptp(found["mean_interval"]) == 0.0
    shares = [passed_share(columns, layout, f"a < {one}") for one in np.sort(cases) + 1e-9]
    ends = [share["interval"].lower for share in shares]
    assert ends == sorted(ends)  # the more pass, the higher
    assert ends[-1] < stats.binomtest(8, 8).proportion_ci(method="wilson").low  # of few units


# shares, means over members, groups, extremes, reasons


def test_a_member_without_a_value_does_not_pass():
    """Nor does one that failed; infinity is compared as any other number."""
    raw = [0.05, 0.2, None, 0.01, np.inf, 0.03]
    columns = columns_of({"rms": raw, "verdict": ["a", "a", "a", "b", "a", "a"]}, failed=[5])
    layout = StudyLayout("random", samples=6)
    found = passed_share(columns, layout, "rms < 0.1")
    counts = [found[key] for key in ("passed", "of", "failed", "without_value")]
    assert (counts, found["first_not_passed"]) == ([2, 6, 1, 1], [1, 2, 4, 5])
    for condition, passed in (
        ("rms < 0.1 and verdict == 'a'", 1),
        ("rms != 0.2 and verdict != b", 2),
        ("rms >= 0.2", 2),
    ):
        assert passed_share(columns, layout, condition)["passed"] == passed
    for wrong in ("rms", "rms < small", "rms < nan", "verdict < a", "verdict < 1"):
        with pytest.raises(UsageError, match=f"expected METRIC COMPARISON.*got '{wrong}'"):
            passed_share(columns, layout, wrong)


@pytest.mark.parametrize("kind", ["random", "latin-hypercube"])
@pytest.mark.parametrize("seeds", [1, 4])
def test_the_running_mean_is_that_of_the_first_members(kind, seeds):
    """With its interval; a large offset costs no digits; units enter whole, of whatever size."""
    rng = np.random.default_rng(5)
    values = 1e6 + np.repeat(rng.normal(size=160 // seeds), seeds) + rng.normal(size=160)
    values[rng.integers(160, size=30)] = np.nan
    layout = StudyLayout(kind, seeds=seeds, samples=160 // seeds)
    found = statistics.running_mean(columns_of({"a": values}).metric("a"), layout)
    for first in (8, 80, 160):
        needed = statistics_of(values[:first], layout)
        (row,) = np.flatnonzero(found.counts == needed["count"])
        assert found.means[row] == pytest.approx(needed["mean"], rel=1e-14)
        half_width = 0.5 * np.ptp(needed["mean_interval"])
        assert found.half_widths[row] == pytest.approx(half_width, rel=1e-6)
    assert np.isnan(found.half_widths[0])


def test_members_with_the_own_value_are_a_group():
    """An empty cell of a case comes last."""
    columns = columns_of({"a": [1.0, 2.0, 3.0, 4.0]}, parameters={"k": [3.0, np.nan, 1.0, np.nan]})
    groups = statistics.statistics_by(columns, StudyLayout("cases", samples=4), "k")
    assert [(one["value"], one["members"]) for one in groups] == [(1.0, 1), (3.0, 1), (None, 2)]


def test_the_extremes_are_the_largest_or_smallest_values():
    """Infinity first; the smaller number first of equal ones; no failed member."""
    columns = columns_of({"a": [3.0, 9.0, None, 9.0, np.inf, 50.0]}, failed=[5])
    found = statistics.extremes(columns, "a", 9)
    assert list(found.items()) == [(4, np.inf), (1, 9.0), (3, 9.0), (0, 3.0)]
    assert list(statistics.extremes(columns, "a", 2, largest=False)) == [0, 1]


def test_texts_that_differ_in_numbers_only_are_one():
    """The text is that of the first; a member counts once; ten are listed, and how many more."""
    pairs = [(4, "leaks"), (1, "slow at 3 s"), (2, "slow at -4.5e-3 s"), (2, "slow at 5 s")]
    first, second = statistics.grouped(pairs)
    assert first == {"reason": "slow at 3 s", "count": 2, "first_members": [1, 2]}
    assert statistics.warning_lines([first, second], 9) == [
        "2 of 9 members warn, such as 1: slow at 3 s",
        "1 of 9 members warns, 4: leaks",
    ]
    many = statistics.warning_lines(statistics.grouped((k, "x" * (k + 1)) for k in range(12)), 12)
    assert (len(many), many[-1].split()[0]) == (11, "2")


# rank correlations


def test_the_rank_correlation_is_that_of_scipy():
    """With ties, of the members that have a value, and a parameter; texts have none."""
    rng = np.random.default_rng(5)
    first, other = rng.integers(0, 8, 300).astype(float), rng.normal(size=300)
    values = first + 0.1 * other + rng.normal(size=300)
    values[7] = other[8] = np.nan
    texts = np.array(["a.fmu"] * 300, object)
    found = correlations_of(values, {"p": first, "q": other, "x": texts, "same": np.ones(300)})
    pairs = [(one["parameter"], one["count"]) for one in found]
    assert pairs == [("p", 299), ("q", 298), ("same", 299)]
    for one, numbers in zip(found, (first, other), strict=False):
        expected = stats.spearmanr(numbers, values, nan_policy="omit").statistic
        assert one["value"] == pytest.approx(expected, rel=1e-12)
    assert found[2]["value"] is None
    assert [one["parameter"] for one in statistics.strongest(found, "m")] == ["p", "q"]


@pytest.mark.parametrize(
    ("metric", "true"),
    [
        (lambda x: 0.6 * x[0] + 0.8 * x[1], 6.0 / np.pi * np.arcsin(0.6 / 2.0)),
        (lambda x: x[0] ** 2, 0.0),  # those of normal columns hold in 86 %, of however many
        (lambda x: np.floor(3.0 * x[0] ** 2 + x[1]), 0.0),
    ],
)
def test_95_percent_of_the_intervals_of_rank_correlations_hold(metric, true):
    """Of normal values, also of metrics that rise and fall."""
    rng = np.random.default_rng(8)
    samples = rng.normal(size=(400, 2, 150))
    intervals = [correlations_of(metric(x), {"p": x[0]})[0]["interval"] for x in samples]
    assert 0.914 <= share_that_hold(intervals, true) <= 0.986


def test_few_members_or_seeds_have_no_distinct_correlation():
    """However strong it is: of nine members, of rounding, of four seeds."""
    for values, of_key, layout, value in (
        (np.arange(9.0), np.arange(9.0), RANDOM, None),
        (1.0 + 2.0**-52 * np.arange(40.0), np.arange(40.0), RANDOM, None),
        (*[np.tile(np.arange(10.0), 4)] * 2, StudyLayout("grid", grid=10, seeds=4), 1.0),
    ):
        (found,) = correlations_of(values, {"p": of_key}, layout)
        assert (found["value"], found["count"], found["is_distinct"]) == (value, len(values), False)


def test_noise_of_a_seed_that_grows_with_a_key_makes_no_correlation_and_a_trend_does():
    """All members of a seed have the same noise, times the key: the true correlation is 0."""
    rng = np.random.default_rng(11)
    for grid, seeds in ((5, 5), (10, 20)):
        key = np.geomspace(1e-4, 1e-2, grid)
        noise = {f"m{n}": (key * rng.normal(size=(seeds, 1))).ravel() for n in range(200)}
        layout = StudyLayout("grid", grid=grid, seeds=seeds)
        parameters = {"p": np.tile(key, seeds)}
        found = statistics.rank_correlations(columns_of(noise, parameters=parameters), layout)
        assert np.mean([one["is_distinct"] for one in found]) <= most_by_chance(0.05, 200)
        trend = np.tile(np.arange(grid), seeds) + 0.1 * rng.normal(size=grid * seeds)
        assert correlations_of(trend, parameters, layout)[0]["is_distinct"]


def test_chance_alone_is_distinct_in_1_of_20_correlations():
    """At most, of 200 parameters that change nothing; a sample counts once, however many seeds."""
    values, *keys = np.repeat(np.random.default_rng(8).normal(size=(201, 100)), 5, axis=1)
    layout = StudyLayout("random", samples=100, seeds=5)
    found = correlations_of(values, {f"p{k}": key for k, key in enumerate(keys)}, layout)
    assert np.mean([one["is_distinct"] for one in found]) <= most_by_chance(0.05, 200)
    assert correlations_of(values, {"p": values + 0.1}, layout)[0]["is_distinct"]


# Sobol indices


def layout_of(dimension, count, **others):
    names = tuple(f"p{k}" for k in range(dimension))
    return StudyLayout("saltelli", parameters=names, samples=(dimension + 2) * count, **others)


def indices_in(values, **others):
    """Return the Sobol indices of values in the rows of the matrices."""
    layout = layout_of(len(values) - 2, values.shape[1])
    return sobol_indices(columns_of({"y": values.ravel()}, **others), layout, "y")


def ishigami(u):
    x = np.pi * (2.0 * u - 1.0)
    return np.sin(x[0]) + 7.0 * np.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * np.sin(x[0])


# the closed form of Ishigami and Homma (1990), for a = 7 and b = 0.1
ISHIGAMI = np.array([[0.313905, 0.442411, 0.0], [0.557589, 0.442411, 0.243684]])


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (ishigami, ISHIGAMI),
        (lambda u: 3.0 * u[0] + 2.0 * u[1] + 1.0, (np.array([9.0, 4.0, 0.0]) / 13.0,) * 2),
        (lambda u: (u[0] - 0.5) * (u[1] - 0.5), ([0.0, 0.0, 0.0], [1.0, 1.0, 0.0])),
    ],
)
def test_the_indices_of_a_planned_design_are_those_of_the_closed_form(function, expected):
    """Within 0.02 of it, of 4096 base points; the intervals hold them, and nothing is remarked."""
    keys = ("delta.terms[0].theta", "delta.terms[1].theta", "observer.filter_rate")
    vary = {key: {"uniform": [-1.0, 1.0]} for key in keys}
    design = planned(vary=vary, samples=4096, sampling="saltelli", seed=3)
    values = function(0.5 * np.array([design.column(key) for key in keys]) + 0.5)
    found = sobol_indices(columns_of({"y": values}), design.layout, "y")
    assert (found.parameters, found.base_points, found.remark) == (keys, 4096, "")
    both = (found.first_order, found.total_order), (found.first_intervals, found.total_intervals)
    for order, intervals, true in zip(*both, expected, strict=True):
        assert order == pytest.approx(true, abs=0.02)
        lower, upper = np.array(intervals).T
        assert np.all(((lower <= true) & (true <= upper)) | (abs(order - true) < 1e-3))
    drawn = drawn_members(columns_of({"y": values}), design.layout).metric("y").values
    assert np.array_equal(drawn, values[: 2 * 4096])  # those of A and B


@pytest.mark.external
def test_sobol_indices_are_those_of_salib():
    """Of the 255 base points of 256 that are complete."""
    salib = pytest.importorskip("SALib.analyze.sobol")
    _, results = saltelli()
    found = sobol_indices(results.columns, results.layout, "y")
    matrices = np.delete(results.columns.numeric("y").reshape(4, 256), found.omitted, axis=1)
    of_a, of_b, *mixed = matrices - matrices[:2].mean()
    for k, of_ab in enumerate(mixed):
        needed = [one(of_a, of_ab, of_b).item() for one in (salib.first_order, salib.total_order)]
        assert [found.first_order[k], found.total_order[k]] == pytest.approx(needed, rel=1e-12)


def test_a_base_point_with_a_member_that_failed_or_is_missing_is_left_out():
    """With all its members, and it is named; the others have the indices of theirs."""
    values = ishigami(rows_of_matrices(3, 256))
    raw = values.copy()
    raw[3, 17], raw[0, 200] = np.nan, np.inf
    found = indices_in(raw, failed=[256 + 30])
    assert found.omitted.tolist() == [17, 30, 200]
    others = indices_in(np.delete(values, [17, 30, 200], axis=1))
    assert found.to_dict()["parameters"] == others.to_dict()["parameters"]
    unfinished = sobol_indices(columns_of({"y": values.ravel()[:-2]}), layout_of(3, 256), "y")
    assert unfinished.omitted.tolist() == [254, 255]


def test_a_study_without_indices_says_why():
    """The design, its members, or the metric."""
    rounding = 0.3 + 2.0**-54 * np.arange(32.0)
    for layout, values, message in (
        (StudyLayout("random", samples=32), np.arange(32.0), r"'saltelli'.*got 'random'"),
        (layout_of(2, 4, seeds=2), np.arange(32.0), r"one member per sample.*got 2"),
        (layout_of(2, 8), rounding, r"'y': .*got the same value in all"),
        (layout_of(2, 4), np.arange(16.0), r"'y': .*base points.*got 4 of 4"),
    ):
        with pytest.raises(UsageError, match=message):
            sobol_indices(columns_of({"y": values}), layout, "y")


def test_few_base_points_have_indices_without_intervals():
    """64 have the same ones whenever asked for; sums that no function has are remarked."""
    values = rows_of_matrices(1, 64)[0]
    few, found = indices_in(values[:, :63]), indices_in(values)
    assert (few.has_intervals, found.has_intervals) == (False, True)
    assert few.to_dict()["parameters"]["p0"]["first_interval"] == NO_INTERVAL
    assert found.to_dict() == indices_in(values).to_dict()
    assert [*found.first_order, *found.total_order] == pytest.approx([1.0, 1.0], abs=0.05)
    assert "1.20, above 1" in replace(found, first_order=np.array([0.7, 0.5])).remark
    small = replace(found, total_order=np.array([0.33, 0.3]), omitted=np.array([3]))
    assert "left out: total orders sum to 0.63, below 1" in small.remark


@pytest.mark.parametrize(("points", "independent"), [(512, True), (64, False)])
def test_intervals_of_indices_hold_roughly(points, independent):
    """On the average 95 % do: of independent base points, and of few Sobol points."""
    held = []
    for seed in range(30):
        rows = rows_of_matrices(3, points, seed, independent=independent)
        found = indices_in(ishigami(rows))
        lower, upper = np.moveaxis([found.first_intervals, found.total_intervals], -1, 0)
        held.append((lower <= ISHIGAMI) & (upper >= ISHIGAMI))
    assert 0.9 <= np.mean(held) < 1.0
