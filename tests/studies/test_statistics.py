"""What members say: against numpy, scipy and SALib, closed forms, and how often intervals hold."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import cosim
from cosim.errors import UsageError
from cosim.studies.design import plan_design
from cosim.studies.layout import StudyLayout, drawn_members
from cosim.studies.sensitivity import bootstrap, sobol_indices
from cosim.studies.statistics import (
    NO_INTERVAL,
    deviation_interval,
    effective_count,
    extremes,
    grouped,
    is_rough,
    mean_interval,
    passed_share,
    proportion_interval,
    quantile_interval,
    rank_correlations,
    running_mean,
    statistics_by,
    strongest,
    study_statistics,
    warning_lines,
)
from cosim.studies.study_file import read_study
from tests.studies.made import columns_of, saltelli_study, tolerances

RANDOM = StudyLayout("random", samples=1000)
THETA = {"delta.terms[0].theta": {"uniform": [-0.2, -0.1]}}
RATE = {"observer.filter_rate": [100.0, 300.0, 1000.0]}
SCENARIO = cosim.load("academic-noisy")


def statistics_of(values, layout=RANDOM, **others):
    return study_statistics(columns_of({"a": values}, **others), layout)["a"]


def correlations_of(values, parameters, layout=RANDOM):
    return rank_correlations(columns_of({"m": values}, parameters=parameters), layout)


def planned(**options):
    return plan_design(read_study("academic-noisy").with_options(**options), SCENARIO)


def share_that_hold(intervals, true):
    lower, upper = np.array(intervals, float).T  # NaN: an end that is not known excludes nothing
    return 1.0 - np.mean((true < lower) | (true > upper))


def most_by_chance(share, count):
    """Return the share that 999 of 1000 binomial samples do not exceed."""
    return share + 3.3 * math.sqrt(share * (1.0 - share) / count)


def t_interval(values):
    return list(stats.ttest_1samp(values, 0.0).confidence_interval(0.95))


# members, and what of them was drawn together


def test_every_member_is_counted_once():
    """Numbers, failures, no value, infinity, texts: together all members."""
    values = [1.0, None, np.nan, np.inf, 2.5, -np.inf, 7.0]
    texts = ["yes", "no", "yes", None, "no", "yes", "no"]
    columns = columns_of({"rms": values, "verdict": texts}, failed=[6])
    column = columns.metric("rms")
    assert (column.values.tolist(), column.numbers.tolist()) == ([1.0, 2.5], [0, 4])
    others = (column.failed, column.without_value, column.infinite)
    assert [one.tolist() for one in others] == [[6], [1, 2], [3, 5]]
    assert columns.metrics["verdict"].texts == {"yes": 3, "no": 2}
    assert columns.metrics["verdict"].without_value.tolist() == [3]
    for name, message in (("verdict", "texts"), ("verdit", "did you mean 'verdict'")):
        with pytest.raises(UsageError, match=message):
            columns.metric(name)


MIXED = {"vary": {**THETA, **RATE}, "samples": 8, "seeds": 2}
SALTELLI = {"vary": THETA, "samples": 4, "sampling": "saltelli"}


@pytest.mark.parametrize(
    ("options", "text", "units", "shared"),
    [
        ({"vary": RATE}, "grid of 3", None, 3),
        ({"vary": {}, "seeds": 5}, "5 seeds", 5, 1),
        ({"vary": RATE, "seeds": 5}, "grid of 3 x 5 seeds", 5, 1),
        ({"vary": THETA, "samples": 1}, "random: 1 sample", 1, 1),
        ({**MIXED, "sampling": "sobol"}, "sobol: 8 samples x grid of 3 x 2 seeds", 8, 1),
        (SALTELLI, "saltelli: 4 base points x 3", 12, 1),
        ({**SALTELLI, "seeds": 2}, "saltelli: 4 base points x 3 x 2 seeds", 4, 2),
    ],
)
def test_members_of_one_unit_share_what_was_drawn(options, text, units, shared):
    """Of a sample its values; of a seed of a grid, or a base point with seeds, their noise."""
    design = planned(**options)
    layout = design.layout
    assert layout.text == text
    assert layout.is_drawn == (units is not None)
    numbers = np.arange(len(design))
    found = layout.units_of(numbers)
    found = numbers if found is None else found
    assert len(np.unique(found)) == (units or 1)
    key = "delta.terms[0].theta" if "sobol" in text else [*design.columns][-1]
    values = np.array(design.column(key))
    assert {len(np.unique(values[found == unit])) for unit in np.unique(found)} == {shared}


def test_a_grid_has_no_interval_and_one_with_seeds_has_that_of_its_seeds():
    """The points of a grid were chosen: only seeds vary the mean over all points."""
    of_point = np.linspace(0.0, 5.0, 6)
    of_seed = np.random.default_rng(1).normal(size=40)
    values = (of_seed[:, np.newaxis] + of_point).ravel()
    for chosen in (StudyLayout("grid", grid=6), StudyLayout("cases", samples=6)):
        found = statistics_of(values[:6], chosen)
        share = passed_share(columns_of({"a": values[:6]}), chosen, "a < 3")
        intervals = {found["mean_interval"], found["quantiles"][1]["interval"], share["interval"]}
        assert intervals == {NO_INTERVAL}
        assert "none" in found["basis"]
    expected = pytest.approx(t_interval(of_seed + of_point.mean()))
    for layout, basis in (
        (StudyLayout("grid", seeds=40, grid=6), "40 seeds drawn independently"),
        (StudyLayout("random", seeds=6, samples=40), "6 members of a sample count as one"),
    ):
        found = statistics_of(values, layout)
        assert found["mean_interval"] == expected
        assert basis in found["basis"]


# figures and their intervals


def test_the_figures_of_exported_rows_are_those_of_numpy_and_scipy():
    """Where the method is the same: within 1e-12 of them."""
    study, results = tolerances()
    rows = study.table().to_pydict()
    rms = np.array(rows["rms"], float)
    kept = rms[~np.isnan(rms)]
    found = study_statistics(results.columns, results.layout)["rms"]
    share = passed_share(results.columns, results.layout, "rms < 0.1")
    wilson = stats.binomtest(int((kept < 0.1).sum()), 200).proportion_ci(method="wilson")
    ends = (found["minimum"], found["maximum"])
    pairs = [
        ((found["count"], found["mean"], *ends), (197, kept.mean(), kept.min(), kept.max())),
        (found["deviation"], np.std(kept, ddof=1)),
        (found["mean_interval"], t_interval(kept)),
        (share["share"], np.mean(rms < 0.1)),
        (share["interval"], [wilson.low, wilson.high]),
    ]
    for quantile in found["quantiles"]:
        pairs.append((quantile["value"], np.quantile(kept, quantile["probability"])))
    for one in rank_correlations(results.columns, results.layout)[:2]:
        of_parameter = np.array(rows[one["parameter"]])[~np.isnan(rms)]
        pairs.append((one["value"], stats.spearmanr(of_parameter, kept).statistic))
    means = running_mean(results.columns.metric("rms"), results.layout).means
    pairs.append((means, np.cumsum(kept) / np.arange(1, len(kept) + 1)))
    for own, other in pairs:
        assert np.asarray(own) == pytest.approx(np.asarray(other), rel=1e-12)


@pytest.mark.external
def test_sobol_indices_are_those_of_salib():
    """Of the 255 base points of 256 that are complete."""
    salib = pytest.importorskip("SALib.analyze.sobol")
    pairs = []
    results = saltelli_study()
    indices = sobol_indices(results.columns, results.layout, "y")
    assert indices.omitted.tolist() == [4]
    matrices = np.delete(results.columns.numeric("y").reshape(4, 256), 4, axis=1)
    of_a, of_b, *mixed = matrices - matrices[:2].mean()
    for k, of_ab in enumerate(mixed):
        pairs.append((indices.first_order[k], salib.first_order(of_a, of_ab, of_b)))
        pairs.append((indices.total_order[k], salib.total_order(of_a, of_ab, of_b)))
    for own, other in pairs:
        assert np.asarray(own) == pytest.approx(np.asarray(other), rel=1e-12)


def test_too_few_values_have_no_figures_or_no_interval():
    """One unit has none of its mean; four values, or equal ones, none of their deviation."""
    for raw, failed in (([None] * 3, ()), ([1.0, 2.0, 3.0], (0, 1, 2)), ([np.inf] * 3, ())):
        found = statistics_of(raw, failed=failed)
        assert (found["count"], found["quantiles"], found["mean"]) == (0, [], None)
        assert found["failed"] + found["without_value"] + found["infinite"] == 3
    intervals = [mean_interval(np.ones(1)), mean_interval(np.ones(0))]
    intervals += [mean_interval(np.ones(4), np.zeros(4, np.int64))]
    intervals += [deviation_interval(one) for one in (np.arange(4.0), np.ones(100), np.zeros(0))]
    intervals += [quantile_interval(np.zeros(0), 0.5, 0), proportion_interval(0, 0, 0.0)]
    assert set(intervals) == {NO_INTERVAL}


@pytest.mark.parametrize("count", [1, 5, 58, 59, 200, 100_000])
@pytest.mark.parametrize("probability", [0.05, 0.5, 0.95, 0.99])
def test_a_quantile_has_the_interval_of_its_order_statistics(count, probability):
    """As scipy has it: NaN there is no end here."""
    values = np.sort(np.random.default_rng(count).exponential(size=count))
    expected = stats.quantile_test(values, p=probability).confidence_interval(0.95)
    found = np.array(quantile_interval(values, probability, count), float)
    assert np.array_equal(found, [expected.low, expected.high], equal_nan=True)


def test_the_effective_count_is_that_of_independent_values():
    """Members that repeat the value of their unit count once, independent ones all."""
    rng = np.random.default_rng(4)
    units = np.repeat(np.arange(4000), 5)
    repeated = effective_count(np.repeat(rng.normal(size=4000), 5), units)
    assert repeated == pytest.approx(4000.0, rel=2e-3)
    # the variance of the sum of 4000 units is known to a share of sqrt(2 / 4000)
    independent = effective_count(rng.normal(size=20_000), units)
    assert independent == pytest.approx(20_000.0, rel=0.1)
    assert effective_count(np.ones(50), np.repeat(np.arange(10), 5)) < 10.0
    assert effective_count(np.ones(50), np.zeros(50, np.int64)) == 0.0


@pytest.mark.parametrize("law", [stats.norm(1.0, 2.0), stats.uniform(-1.0, 3.0), stats.rayleigh()])
def test_95_percent_of_the_intervals_hold(law):
    """Of 500 samples: those of mean and deviation."""
    samples = law.rvs((500, 200), random_state=np.random.default_rng(7))
    for interval, true in ((mean_interval, law.mean()), (deviation_interval, law.std())):
        found = share_that_hold([*map(interval, samples)], true)
        assert 1.0 - most_by_chance(0.05, 500) <= found < 1.0


def of_units(rng):
    """Return 80 values with 4 seeds each: the sample moves the value as the seed does."""
    return np.repeat(rng.normal(size=80), 4) + rng.normal(size=320)


def of_hypercube(rng):
    """Return 40 points of p + q, which has a triangular distribution."""
    return stats.qmc.LatinHypercube(2, rng=rng).random(40).sum(axis=1)


UNITS = StudyLayout("random", samples=80, seeds=4)
HYPERCUBE = StudyLayout("latin-hypercube", samples=40)
LOW = math.sqrt(0.1)  # 5 % of p + q are below it


@pytest.mark.parametrize(
    ("layout", "draw", "low", "middle", "deviation"),
    [
        (UNITS, of_units, stats.norm(0.0, math.sqrt(2.0)).ppf(0.05), 0.0, math.sqrt(2.0)),
        (HYPERCUBE, of_hypercube, LOW, 1.0, math.sqrt(1.0 / 6.0)),
    ],
)
def test_95_percent_of_the_intervals_of_a_design_hold(layout, draw, low, middle, deviation):
    """Of mean, deviation, quantiles and a share, whatever members have in common."""
    rng = np.random.default_rng(9)
    high = 2.0 * middle - low
    found = []
    for _ in range(200):
        columns = columns_of({"a": draw(rng)})
        one = study_statistics(columns, layout)["a"]
        share = passed_share(columns, layout, f"a < {high}")["interval"]
        quantiles = [quantile["interval"] for quantile in one["quantiles"]]
        found.append((one["mean_interval"], one["deviation_interval"], share, *quantiles))
    truth = (middle, deviation, 0.95, low, middle, high)
    for intervals, true in zip(zip(*found, strict=True), truth, strict=True):
        assert share_that_hold(intervals, true) >= 1.0 - most_by_chance(0.05, 200)


def test_a_design_that_does_not_help_has_intervals_that_hold_and_no_units_have_too_short_ones():
    """A Latin hypercube does not help p q; seeds of one sample are not independent."""
    rng = np.random.default_rng(9)
    products, careless = [], []
    for _ in range(200):
        points = stats.qmc.LatinHypercube(2, rng=rng).random(40) - 0.5
        products.append(statistics_of(np.prod(points, axis=1), HYPERCUBE)["mean_interval"])
        careless.append(mean_interval(of_units(rng)))
    assert share_that_hold(products, 0.0) >= 1.0 - most_by_chance(0.05, 200)
    assert share_that_hold(careless, 0.0) < 0.85


def test_where_too_few_intervals_of_a_mean_hold_they_are_rough():
    """Of 40 values with a long tail less than 88 % do; of as many normal ones no word is said."""
    rng = np.random.default_rng(12)
    skewed = rng.lognormal(0.0, 1.5, (500, 40))
    assert share_that_hold([*map(mean_interval, skewed)], math.exp(1.125)) < 0.88
    assert np.mean([*map(is_rough, skewed)]) > 0.9
    normal = rng.normal(size=(500, 40))
    assert np.mean([*map(is_rough, normal)]) < 0.02
    assert is_rough(normal[0, :9])
    assert is_rough(normal.ravel()[:90], np.arange(90) // 10)
    assert not is_rough(np.ones(5))


# shares, means over members, extremes, reasons


def test_a_member_without_a_value_does_not_pass():
    """Nor does one that failed; infinity is compared as any other number."""
    raw = [0.05, 0.2, None, 0.01, np.inf, 0.03]
    columns = columns_of({"rms": raw, "verdict": ["a", "a", "a", "b", "a", "a"]}, failed=[5])
    layout = StudyLayout("random", samples=6)
    found = passed_share(columns, layout, "rms < 0.1")
    counts = [found[key] for key in ("passed", "of", "failed", "without_value")]
    assert counts == [2, 6, 1, 1]
    assert found["first_not_passed"] == [1, 2, 4, 5]
    for condition, passed in (
        ("rms < 0.1 and verdict == 'a'", 1),
        ("rms != 0.2 and verdict != b", 2),
        ("rms >= 0.2", 2),
    ):
        assert passed_share(columns, layout, condition)["passed"] == passed


@pytest.mark.parametrize(
    "condition", ["rms", "rms < small", "rms < nan", "verdict < a", "verdict < 1", "rsm < 1"]
)
def test_a_text_that_is_no_condition_is_an_error(condition):
    """It names what was found."""
    columns = columns_of({"rms": [1.0], "verdict": ["a"]})
    found = "'rsm'; did you mean 'rms'" if "rsm" in condition else f"got '{condition}'"
    with pytest.raises(UsageError, match=found):
        passed_share(columns, RANDOM, condition)


def test_the_running_mean_is_that_of_the_first_members():
    """With Student's interval; a large offset costs no digits; units enter whole."""
    values = 1e6 + np.random.default_rng(4).normal(size=50)
    found = running_mean(columns_of({"a": values}).metric("a"), RANDOM)
    assert found.counts.tolist() == list(range(1, 51))
    assert np.isnan(found.half_widths[0])
    for count in (2, 7, 50):
        assert found.means[count - 1] == pytest.approx(values[:count].mean(), rel=1e-14)
        half_width = 0.5 * np.ptp(t_interval(values[:count]))
        assert found.half_widths[count - 1] == pytest.approx(half_width, rel=1e-8)
    column = columns_of({"a": [1.0, 3.0, 5.0, 7.0]}).metric("a")
    counts, means, _ = running_mean(column, StudyLayout("random", seeds=2, samples=2))
    assert (counts.tolist(), means.tolist()) == ([2, 4], [2.0, 4.0])
    with pytest.raises(UsageError, match=r"'a'.*chosen, not drawn"):
        running_mean(column, StudyLayout("grid", grid=4))


def test_the_running_mean_ends_at_the_mean_of_all_members():
    """With its interval, also where units have other numbers of members, as some have no value."""
    rng = np.random.default_rng(5)
    values = np.repeat(rng.normal(size=40), 4) + rng.normal(size=160)
    values[rng.integers(160, size=30)] = np.nan
    columns, layout = columns_of({"a": values}), StudyLayout("random", seeds=4, samples=40)
    found = running_mean(columns.metric("a"), layout)
    (all_of_it,) = study_statistics(columns, layout).values()
    assert found.counts[-1] == all_of_it["count"]
    ends = (found.means[-1] - found.half_widths[-1], found.means[-1] + found.half_widths[-1])
    assert (found.means[-1], *ends) == pytest.approx(
        (all_of_it["mean"], *all_of_it["mean_interval"]), rel=1e-12
    )


def test_rounding_is_no_spread():
    """Of equal values, and of units that have the same sum: a metric that seeds do not change."""
    found = statistics_of(np.full(6, 0.1))
    assert (found["deviation"], found["mean_interval"][0]) == (0.0, found["mean_interval"][1])
    assert found["deviation_interval"] == NO_INTERVAL
    cases = np.random.default_rng(6).normal(size=5)
    layout = StudyLayout("cases", seeds=8, samples=5)
    values = cases.repeat(8)
    found = statistics_of(values, layout)
    assert np.ptp(found["mean_interval"]) == 0.0
    columns = columns_of({"a": values})
    ends = [
        passed_share(columns, layout, f"a < {one}")["interval"].lower
        for one in np.sort(cases) + 1e-9
    ]
    assert ends == sorted(ends)  # the more pass, the higher


def test_members_with_the_own_value_are_a_group():
    """An empty cell of a case comes last."""
    columns = columns_of({"a": [1.0, 2.0, 3.0, 4.0]}, parameters={"k": [3.0, np.nan, 1.0, np.nan]})
    groups = statistics_by(columns, StudyLayout("cases", samples=4), "k")
    assert [(one["value"], one["members"]) for one in groups] == [(1.0, 1), (3.0, 1), (None, 2)]


def test_the_extremes_are_the_largest_or_smallest_values():
    """Infinity first; the smaller number first of equal ones; no failed member."""
    columns = columns_of({"a": [3.0, 9.0, None, 9.0, np.inf, 50.0, -1.0]}, failed=[5])
    found = extremes(columns, "a", 99)
    assert list(found.items()) == [(4, np.inf), (1, 9.0), (3, 9.0), (0, 3.0), (6, -1.0)]
    assert list(extremes(columns, "a", 2, largest=False)) == [6, 0]


def test_texts_that_differ_in_numbers_only_are_one():
    """The text is that of the first; a member counts once; ten are listed, and how many more."""
    pairs = [(4, "leaks"), (1, "slow at 3 s"), (2, "slow at -4.5e-3 s"), (2, "slow at 5 s")]
    first, second = grouped(pairs)
    assert first == {"reason": "slow at 3 s", "count": 2, "first_members": [1, 2]}
    assert warning_lines([first, second], 9) == [
        "2 of 9 members warn, such as 1: slow at 3 s",
        "1 of 9 members warns, 4: leaks",
    ]
    many = warning_lines(grouped((k, "x" * (k + 1)) for k in range(12)), 12)
    assert (len(many), many[-1].split()[0]) == (11, "2")


# rank correlations


def test_the_rank_correlation_is_that_of_scipy():
    """With ties, of the members that have a value, and a parameter; texts have none."""
    rng = np.random.default_rng(5)
    first = rng.integers(0, 8, 300).astype(float)
    other = rng.normal(size=300)
    values = first + 0.1 * other + rng.normal(size=300)
    values[7] = other[8] = np.nan
    texts = np.array(["a.fmu"] * 300, object)
    found = correlations_of(values, {"p": first, "q": other, "x": texts, "same": np.ones(300)})
    pairs = [(one["parameter"], one["count"]) for one in found]
    assert pairs == [("p", 299), ("q", 298), ("same", 299)]
    for one, numbers in zip(found, (first, other), strict=False):
        expected = stats.spearmanr(numbers, values, nan_policy="omit").statistic
        assert one["value"] == pytest.approx(expected, rel=1e-12)
        assert one["interval"].lower < one["value"] < one["interval"].upper
    assert found[2]["value"] is None
    assert [one["parameter"] for one in strongest(found, "m")] == ["p", "q"]


@pytest.mark.parametrize(
    ("metric", "true"),
    [
        (lambda x: 0.6 * x[0] + 0.8 * x[1], 6.0 / np.pi * np.arcsin(0.6 / 2.0)),
        (lambda x: x[0] ** 2, 0.0),  # those of normal columns hold in 86 %, of however many
        (lambda x: x[0] * x[1], 0.0),
        (lambda x: np.floor(3.0 * x[0] ** 2 + x[1]), 0.0),
    ],
)
def test_95_percent_of_the_intervals_of_rank_correlations_hold(metric, true):
    """Of normal values, also of metrics that rise and fall."""
    rng = np.random.default_rng(8)
    samples = rng.normal(size=(400, 2, 150))
    intervals = [correlations_of(metric(x), {"p": x[0]})[0]["interval"] for x in samples]
    assert 0.914 <= share_that_hold(intervals, true) <= 0.986


@pytest.mark.parametrize(
    ("values", "layout", "value"),
    [
        (np.arange(9.0), RANDOM, None),  # of nine members, chance alone makes 0.68
        (1.0 + 2.0**-52 * np.arange(40.0), RANDOM, None),  # rounding has no rank
        (np.tile(np.arange(10.0), 4), StudyLayout("grid", grid=10, seeds=4), 1.0),  # one sign
    ],
)
def test_few_members_or_seeds_have_no_distinct_correlation(values, layout, value):
    """However strong it is."""
    key = values - values.min() if layout.seeds > 1 else np.arange(len(values))
    (found,) = correlations_of(values, {"p": key}, layout)
    assert (found["value"], found["count"], found["is_distinct"]) == (value, len(values), False)


def test_noise_of_a_seed_that_grows_with_a_key_makes_no_correlation_and_a_trend_does():
    """All members of a seed have the same noise, times the key: the true correlation is 0."""
    rng = np.random.default_rng(11)
    for grid, seeds in ((5, 5), (10, 20), (3, 50)):
        key = np.geomspace(1e-4, 1e-2, grid)
        noise = {f"m{n}": (key * rng.normal(size=(seeds, 1))).ravel() for n in range(200)}
        layout = StudyLayout("grid", grid=grid, seeds=seeds)
        parameters = {"p": np.tile(key, seeds)}
        found = rank_correlations(columns_of(noise, parameters=parameters), layout)
        assert np.mean([one["is_distinct"] for one in found]) <= most_by_chance(0.05, 200)
        trend = np.tile(np.arange(grid), seeds) + 0.1 * rng.normal(size=grid * seeds)
        assert correlations_of(trend, parameters, layout)[0]["is_distinct"]


@pytest.mark.parametrize(
    ("layout", "units"),
    [
        (StudyLayout("random", samples=500), 500),
        (StudyLayout("random", samples=100, seeds=5), 100),
        (StudyLayout("grid", grid=100, seeds=5), 500),
    ],
)
def test_chance_alone_is_distinct_in_1_of_20_correlations(layout, units):
    """At most, of 200 parameters that change nothing; samples count once, however many seeds."""
    values, *keys = np.repeat(np.random.default_rng(8).normal(size=(201, units)), 500 // units, 1)
    found = correlations_of(values, {f"p{k}": key for k, key in enumerate(keys)}, layout)
    assert np.mean([one["is_distinct"] for one in found]) <= most_by_chance(0.05, 200)
    assert correlations_of(values, {"p": values + 0.1}, layout)[0]["is_distinct"]


# Sobol indices


def matrices(function, dimension, count, seed, *, independent=False):
    """Return a function of points in the unit cube, in the rows A, B, AB_1, ..., AB_d."""
    rng = np.random.default_rng(seed)
    points = rng.random((count, 2 * dimension))
    if not independent:
        points = stats.qmc.Sobol(2 * dimension, rng=rng).random(count)
    of_a, of_b = points[:, :dimension].T, points[:, dimension:].T
    rows = np.arange(dimension)[:, np.newaxis]
    mixed = [np.where(rows == k, of_b, of_a) for k in range(dimension)]
    return np.array([function(one) for one in (of_a, of_b, *mixed)])


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


def linear(u):
    return 3.0 * u[0] + 2.0 * u[1] + 1.0


# the closed form of Ishigami and Homma (1990), for a = 7 and b = 0.1
ISHIGAMI = np.array([[0.313905, 0.442411, 0.0], [0.557589, 0.442411, 0.243684]])


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (ishigami, ISHIGAMI),
        (linear, (np.array([9.0, 4.0]) / 13.0,) * 2),
        (lambda u: (u[0] - 0.5) * (u[1] - 0.5), (np.zeros(2), np.ones(2))),
        (lambda u: u[0], (np.ones(1), np.ones(1))),  # of which scipy has no indices
    ],
)
def test_the_indices_are_those_of_the_closed_form(function, expected):
    """Within 0.02 of it, of 4096 base points; the intervals hold them, and nothing is remarked."""
    found = indices_in(matrices(function, len(expected[0]), 4096, 0))
    both = (found.first_order, found.total_order), (found.first_intervals, found.total_intervals)
    for order, intervals, true in zip(*both, expected, strict=True):
        assert order == pytest.approx(true, abs=0.02)
        lower, upper = np.array(intervals).T
        assert np.all(((lower <= true) & (true <= upper)) | (abs(order - true) < 1e-3))
    assert (found.base_points, found.remark) == (4096, "")


def test_the_indices_of_a_planned_design_are_those_of_the_closed_form():
    """The Ishigami function of the parameters of its members; its mean is 3.5."""
    keys = ("delta.terms[0].theta", "delta.terms[1].theta", "observer.filter_rate")
    vary = {key: {"uniform": [-np.pi, np.pi]} for key in keys}
    design = planned(vary=vary, samples=4096, sampling="saltelli", seed=3)
    u = np.array([design.column(key) for key in keys]) / (2.0 * np.pi) + 0.5
    columns = columns_of({"y": ishigami(u)})
    found = sobol_indices(columns, design.layout, "y")
    assert found.parameters == keys
    assert np.array([found.first_order, found.total_order]) == pytest.approx(ISHIGAMI, abs=0.02)
    drawn = drawn_members(columns, design.layout).metric("y")
    assert drawn.values.mean() == pytest.approx(3.5, abs=0.1)


def test_a_base_point_with_a_member_that_failed_or_is_missing_is_left_out():
    """With all its members, and it is named; the others have the indices of theirs."""
    values = matrices(ishigami, 3, 256, 2)
    raw = values.copy()
    raw[3, 17] = np.nan
    raw[0, 200] = np.inf
    found = indices_in(raw, failed=[256 + 30])
    assert found.omitted.tolist() == [17, 30, 200]
    others = indices_in(np.delete(values, [17, 30, 200], axis=1))
    assert found.to_dict()["parameters"] == others.to_dict()["parameters"]
    values = matrices(linear, 2, 64, 3).ravel()[:-5]
    found = sobol_indices(columns_of({"y": values}), layout_of(2, 64), "y")
    assert found.omitted.tolist() == [59, 60, 61, 62, 63]


@pytest.mark.parametrize(
    ("layout", "raw", "message"),
    [
        (StudyLayout("random", samples=32), np.arange(32.0), r"'saltelli'.*got 'random'"),
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


def test_few_base_points_have_indices_without_intervals():
    """64 have the same ones whenever asked for; sums that no function has are remarked."""
    values = matrices(linear, 2, 64, 5)
    few = indices_in(values[:, :63])
    assert not few.has_intervals
    assert few.to_dict()["parameters"]["p0"]["first_interval"] == NO_INTERVAL
    found = indices_in(values)
    assert found.has_intervals
    assert found.to_dict() == indices_in(values).to_dict()
    assert "1.20, above 1" in replace(found, first_order=np.array([0.7, 0.5])).remark
    small = replace(found, total_order=np.array([0.33, 0.3]), omitted=np.array([3]))
    assert "left out: total orders sum to 0.63, below 1" in small.to_dict()["remark"]


@pytest.mark.parametrize(("points", "independent", "least"), [(512, True, 0.91), (64, False, 0.75)])
def test_intervals_of_indices_hold_roughly(points, independent, least):
    """Of independent base points 95 % on the average; of Sobol points less, of each index."""
    hold = []
    for seed in range(60):
        values = matrices(ishigami, 3, points, seed, independent=independent)
        for resampled, true in zip(bootstrap(values, resamples=200), ISHIGAMI, strict=True):
            lower, upper = np.quantile(resampled, [0.025, 0.975], axis=0)
            hold.append((lower <= true) & (true <= upper))
    assert np.mean(hold) >= least
