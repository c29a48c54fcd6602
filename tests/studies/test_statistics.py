"""What members say: against numpy, scipy and SALib, closed forms, and how often intervals hold."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import cosim
from cosim.errors import UsageError
from cosim.studies.design import plan_design
from cosim.studies.layout import StudyLayout, drawn_members, independence_of
from cosim.studies.sensitivity import bootstrap, indices_of, sobol_indices
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


def holds(interval, true):
    lower, upper = np.array(interval, float)  # NaN: an end that is not known excludes nothing
    return not (true < lower or true > upper)


def share_that_hold(intervals, true):
    return np.mean([holds(interval, true) for interval in intervals])


def most_by_chance(share, count):
    """Return the share that 999 of 1000 binomial samples do not exceed."""
    return share + 3.3 * math.sqrt(share * (1.0 - share) / count)


def t_interval(values):
    found = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    return [found.low, found.high]


# members as columns


def test_every_member_is_counted_once():
    """Numbers, failures, no value, infinity: together all members."""
    values = [1.0, None, np.nan, np.inf, 2.5, -np.inf, 7.0]
    column = columns_of({"rms": values}, failed=[6]).metric("rms")
    assert column.values.tolist() == [1.0, 2.5]
    assert column.numbers.tolist() == [0, 4]
    assert column.failed.tolist() == [6]
    assert column.without_value.tolist() == [1, 2]
    assert column.infinite.tolist() == [3, 5]


def test_texts_are_counted():
    """A failed member has none; a metric that is not there is named."""
    columns = columns_of({"verdict": ["yes", "no", "yes", None, "no"]}, failed=[4])
    assert columns.metrics["verdict"].texts == {"yes": 2, "no": 1}
    assert columns.metrics["verdict"].without_value.tolist() == [3]
    with pytest.raises(UsageError, match=r"'verdict'.*texts"):
        columns.metric("verdict")
    with pytest.raises(UsageError, match=r"'verdit'; did you mean 'verdict'"):
        columns.metric("verdit")


# what was drawn together


@pytest.mark.parametrize(
    ("options", "text", "units"),
    [
        ({"vary": RATE}, "grid of 3", None),
        ({"vary": {}, "seeds": 5}, "5 seeds", 5),
        ({"vary": THETA, "samples": 1}, "random: 1 sample", 1),
        ({"vary": RATE, "seeds": 5}, "grid of 3 x 5 seeds", 5),
        (
            {"vary": {**THETA, **RATE}, "samples": 8, "seeds": 2, "sampling": "sobol"},
            "sobol: 8 samples x grid of 3 x 2 seeds",
            8,
        ),
        ({"vary": THETA, "samples": 4, "sampling": "saltelli"}, "saltelli: 4 base points x 3", 12),
    ],
)
def test_a_design_has_a_layout(options, text, units):
    """With as many independent units as were drawn."""
    design = planned(**options)
    layout = design.layout
    assert layout.text == text
    independence = independence_of(layout)
    assert independence.is_drawn == (units is not None)
    numbers = np.arange(len(design))
    found = independence.units_of(numbers)
    assert len(np.unique(numbers if found is None else found)) == (units or 1)


def test_members_of_one_unit_share_what_was_drawn():
    """Those of a sample its values; of a seed of a grid, of a Saltelli base point their noise."""
    for options, key, shared in (
        ({"vary": {**THETA, **RATE}, "samples": 6, "seeds": 2}, "delta.terms[0].theta", 1),
        ({"vary": RATE, "seeds": 4}, None, 1),
        ({"vary": THETA, "samples": 4, "sampling": "saltelli", "seeds": 2}, None, 2),
    ):
        design = planned(**options)
        layout = design.layout
        values = np.array(design.column(key or layout.noise_seeds[0]))
        units = independence_of(layout).units_of(np.arange(len(design)))
        for unit in np.unique(units):
            assert len(np.unique(values[units == unit])) == shared


def test_a_grid_has_no_interval_and_one_with_seeds_has_that_of_its_seeds():
    """The points of a grid were chosen: only seeds vary the mean over all points."""
    of_point = np.linspace(0.0, 5.0, 6)
    of_seed = np.random.default_rng(1).normal(size=40)
    values = (of_seed[:, np.newaxis] + of_point).ravel()
    for chosen in (StudyLayout("grid", grid=6), StudyLayout("cases", samples=6)):
        found = statistics_of(values[:6], chosen)
        intervals = [found["mean_interval"], found["quantiles"][1]["interval"]]
        assert intervals == [NO_INTERVAL, NO_INTERVAL]
        assert passed_share(columns_of({"a": values[:6]}), chosen, "a < 3")["interval"] == (
            NO_INTERVAL
        )
    assert "none" in found["basis"]
    drawn = statistics_of(values, StudyLayout("grid", seeds=40, grid=6))
    expected = t_interval(of_seed + of_point.mean())
    assert drawn["mean_interval"] == pytest.approx(expected)
    assert drawn["basis"] == "40 seeds drawn independently"
    of_sample = statistics_of(values, StudyLayout("random", seeds=6, samples=40))
    assert of_sample["mean_interval"] == pytest.approx(expected)
    assert "6 members of a sample count as one" in of_sample["basis"]


# figures


def test_the_figures_of_exported_rows_are_those_of_numpy_scipy_and_salib():
    """Where the method is the same: within 1e-12 of them."""
    study, results = tolerances()
    rows = study.table().to_pydict()
    rms = np.array(rows["rms"], float)
    kept = rms[~np.isnan(rms)]
    found = study_statistics(results.columns, results.layout)["rms"]
    share = passed_share(results.columns, results.layout, "rms < 0.1")
    wilson = stats.binomtest(int((kept < 0.1).sum()), 200).proportion_ci(method="wilson")
    pairs = [
        (found["count"], len(kept)),
        (found["mean"], np.mean(kept)),
        (found["deviation"], np.std(kept, ddof=1)),
        (found["minimum"], np.min(kept)),
        (found["maximum"], np.max(kept)),
        (found["mean_interval"], t_interval(kept)),
        (share["share"], np.mean(rms < 0.1)),
        (share["interval"], [wilson.low, wilson.high]),
    ]
    for quantile in found["quantiles"]:
        probability = quantile["probability"]
        test = stats.quantile_test(kept, p=probability).confidence_interval(0.95)
        pairs.append((quantile["value"], np.quantile(kept, probability)))
        pairs.append((quantile["interval"], [test.low, test.high]))
    for one in rank_correlations(results.columns, results.layout)[:2]:
        of_parameter = np.array(rows[one["parameter"]])[~np.isnan(rms)]
        pairs.append((one["value"], stats.spearmanr(of_parameter, kept).statistic))
    means = running_mean(results.columns.metric("rms"), independence_of(results.layout))
    pairs.append((means.means, np.cumsum(kept) / np.arange(1, len(kept) + 1)))
    for own, other in pairs:
        assert np.asarray(own) == pytest.approx(np.asarray(other), rel=1e-12)
    # a Saltelli study: 255 base points, of which SALib has the rows that are complete
    salib = pytest.importorskip("SALib.analyze.sobol")
    results = saltelli_study()
    indices = sobol_indices(results.columns, results.layout, "y")
    matrices = np.delete(results.columns.numeric("y").reshape(4, 256), 4, axis=1)
    of_a, of_b, *mixed = matrices - matrices[:2].mean()
    for k, of_ab in enumerate(mixed):
        assert indices.first_order[k] == pytest.approx(
            salib.first_order(of_a, of_ab, of_b), rel=1e-12
        )
        assert indices.total_order[k] == pytest.approx(
            salib.total_order(of_a, of_ab, of_b), rel=1e-12
        )


def test_too_few_values_have_no_figures_or_no_interval():
    """One unit has none of its mean; four values, or equal ones, none of their deviation."""
    for raw, failed in (([None] * 3, ()), ([1.0, 2.0, 3.0], (0, 1, 2)), ([np.inf] * 3, ())):
        found = statistics_of(raw, failed=failed)
        assert (found["count"], found["quantiles"], found["mean"]) == (0, [], None)
        assert found["failed"] + found["without_value"] + found["infinite"] == 3
    assert mean_interval(np.ones(1)) == mean_interval(np.ones(0)) == NO_INTERVAL
    assert mean_interval(np.ones(4), np.zeros(4, np.int64)) == NO_INTERVAL
    for values in (np.arange(4.0), np.ones(100), np.zeros(0)):
        assert deviation_interval(values) == NO_INTERVAL
    assert quantile_interval(np.zeros(0), 0.5, 0) == NO_INTERVAL
    assert proportion_interval(0, 0, 0.0) == NO_INTERVAL


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


def test_95_percent_of_the_intervals_hold():
    """Of 500 samples of normal, uniform, Rayleigh values: mean and deviation."""
    rng = np.random.default_rng(7)
    low, high = 1.0 - most_by_chance(0.05, 500), 1.0
    for law in (stats.norm(1.0, 2.0), stats.uniform(-1.0, 3.0), stats.rayleigh()):
        samples = law.rvs((500, 200), random_state=rng)
        assert low <= share_that_hold([*map(mean_interval, samples)], law.mean()) < high
        assert low <= share_that_hold([*map(deviation_interval, samples)], law.std()) < high


def test_95_percent_of_the_intervals_of_units_hold():
    """80 samples of 4 seeds: the sample moves the value as the seed does. Without units too few."""
    rng = np.random.default_rng(9)
    layout = StudyLayout("random", samples=80, seeds=4)
    units = np.repeat(np.arange(80), 4)
    found = []
    for _ in range(300):
        values = np.repeat(rng.normal(size=80), 4) + rng.normal(size=320)
        one = statistics_of(values, layout)
        below = (values > 0.0).astype(float)
        share = proportion_interval(int(below.sum()), 320, effective_count(below, units))
        median = one["quantiles"][1]["interval"]
        intervals = (one["mean_interval"], one["deviation_interval"], median, share)
        found.append((*intervals, mean_interval(values)))
    *honest, careless = zip(*found, strict=True)
    for intervals, true in zip(honest, (0.0, math.sqrt(2.0), 0.0, 0.5), strict=True):
        assert share_that_hold(intervals, true) >= 1.0 - most_by_chance(0.05, 300)
    assert share_that_hold(careless, 0.0) < 0.85


def test_the_intervals_of_a_latin_hypercube_are_conservative():
    """Of p + q, which has a triangular distribution; of p q, which it does not help, they hold."""
    rng = np.random.default_rng(9)
    layout = StudyLayout("latin-hypercube", samples=40)
    low = math.sqrt(0.1)  # 5 % are below it
    truth = (low, 1.0, 2.0 - low, 1.0, math.sqrt(1.0 / 6.0), 0.95, 0.0)
    hold = []
    for _ in range(150):
        points = stats.qmc.LatinHypercube(2, rng=rng).random(40)
        columns = columns_of({"a": points.sum(axis=1), "b": np.prod(points - 0.5, axis=1)})
        found, of_product = study_statistics(columns, layout).values()
        intervals = [quantile["interval"] for quantile in found["quantiles"]]
        intervals += [found["mean_interval"], found["deviation_interval"]]
        intervals += [passed_share(columns, layout, f"a < {2.0 - low}")["interval"]]
        intervals += [of_product["mean_interval"]]
        hold.append([holds(*pair) for pair in zip(intervals, truth, strict=True)])
    assert np.mean(hold, axis=0).min() >= 1.0 - most_by_chance(0.05, 150)


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
    ("condition", "message"),
    [
        ("rms", r"condition 'rms': .*got 'rms'"),
        ("rsm < 1", r"'rsm'; did you mean 'rms'"),
        ("rms < small", r"metric 'rms': .*< 'small'"),
        ("verdict < a", r"metric 'verdict': .*< 'a'"),
        ("verdict < 1", r"metric 'verdict': .*text"),
        ("rms < nan", r"metric 'rms': .*< 'nan'"),
    ],
)
def test_a_text_that_is_no_condition_is_an_error(condition, message):
    """It names what was found."""
    columns = columns_of({"rms": [1.0], "verdict": ["a"]})
    with pytest.raises(UsageError, match=message):
        passed_share(columns, RANDOM, condition)


def test_the_running_mean_is_that_of_the_first_members():
    """With Student's interval; a large offset costs no digits; units enter whole."""
    values = 1e6 + np.random.default_rng(4).normal(size=50)
    found = running_mean(columns_of({"a": values}).metric("a"), independence_of(RANDOM))
    assert found.counts.tolist() == list(range(1, 51))
    assert np.isnan(found.half_widths[0])
    for count in (2, 7, 50):
        assert found.means[count - 1] == pytest.approx(values[:count].mean(), rel=1e-14)
        half_width = 0.5 * np.ptp(t_interval(values[:count]))
        assert found.half_widths[count - 1] == pytest.approx(half_width, rel=1e-8)
    column = columns_of({"a": [1.0, 3.0, 5.0, 7.0]}).metric("a")
    found = running_mean(column, independence_of(StudyLayout("random", seeds=2, samples=2)))
    assert (found.counts.tolist(), found.means.tolist()) == ([2, 4], [2.0, 4.0])
    with pytest.raises(UsageError, match=r"'a'.*chosen, not drawn"):
        running_mean(column, independence_of(StudyLayout("grid", grid=4)))


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
    assert (first["reason"], first["count"], first["first_members"]) == ("slow at 3 s", 2, [1, 2])
    assert second["first_members"] == [4]
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
    names = np.array(["a.fmu"] * 300)
    parameters = {"p": first, "q": other, "swap.plant": names, "same": np.ones(300)}
    found = correlations_of(values, parameters)
    assert [one["parameter"] for one in found] == ["p", "q", "same"]
    assert [one["count"] for one in found] == [299, 298, 299]
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
        (lambda x: x[0] ** 2, 0.0),
        (lambda x: x[0] * x[1], 0.0),
        (lambda x: np.floor(3.0 * x[0] ** 2 + x[1]), 0.0),
    ],
)
def test_95_percent_of_the_intervals_of_rank_correlations_hold(metric, true):
    """Of normal values, also of metrics that rise and fall: but for the sign they are as they are.

    Of the second metric those of normal columns hold in 86 %, however many members there are.
    """
    rng = np.random.default_rng(8)
    intervals = []
    for _ in range(400):
        x = rng.normal(size=(2, 150))
        intervals.append(correlations_of(metric(x), {"p": x[0]})[0]["interval"])
    assert 0.914 <= share_that_hold(intervals, true) <= 0.986


def test_few_members_or_seeds_have_no_distinct_correlation():
    """Of nine members, chance alone makes 0.68; of four seeds, one sign; rounding has no rank."""
    (found,) = correlations_of(np.arange(9.0), {"p": np.arange(9)})
    assert (found["value"], found["count"], found["is_distinct"]) == (None, 9, False)
    assert strongest([found], "m") == []
    noise = 1.0 + 2.0**-52 * np.arange(40.0)
    assert correlations_of(noise, {"p": np.arange(40)})[0]["value"] is None
    key = np.tile(np.arange(10.0), 4)
    (found,) = correlations_of(key, {"p": key}, StudyLayout("grid", grid=10, seeds=4))
    assert (found["value"], found["is_distinct"]) == (1.0, False)


def test_noise_of_a_seed_that_grows_with_a_key_makes_no_correlation_and_a_trend_does():
    """All members of a seed have the same noise, times the key: the true correlation is 0."""
    rng = np.random.default_rng(11)
    for grid, seeds in ((5, 5), (10, 20), (3, 50)):
        key = np.geomspace(1e-4, 1e-2, grid)
        noise = [(key * rng.normal(size=(seeds, 1))).ravel() for _ in range(200)]
        layout = StudyLayout("grid", grid=grid, seeds=seeds)
        parameters = {"p": np.tile(key, seeds)}
        columns = columns_of({f"m{n}": one for n, one in enumerate(noise)}, parameters=parameters)
        found = rank_correlations(columns, layout)
        assert np.mean([one["is_distinct"] for one in found]) <= most_by_chance(0.05, 200)
        trend = np.tile(np.arange(grid), seeds) + 0.1 * rng.normal(size=grid * seeds)
        assert correlations_of(trend, parameters, layout)[0]["is_distinct"]


@pytest.mark.parametrize(
    "layout",
    [
        StudyLayout("random", samples=500),
        StudyLayout("random", samples=100, seeds=5),
        StudyLayout("grid", grid=100, seeds=5),
    ],
)
def test_chance_alone_is_distinct_in_1_of_20_correlations(layout):
    """At most, of 200 parameters that change nothing; samples count once, however many seeds."""
    rng = np.random.default_rng(8)
    units = layout.samples if layout.kind != "grid" else 500
    values = np.repeat(rng.normal(size=units), 500 // units)
    parameters = {f"p{k}": np.repeat(rng.normal(size=units), 500 // units) for k in range(200)}
    found = correlations_of(values, parameters, layout)
    assert np.mean([one["is_distinct"] for one in found]) <= most_by_chance(0.05, 200)
    assert correlations_of(values, {"p": values + 0.1}, layout)[0]["is_distinct"]


# Sobol indices


def saltelli(function, dimension, count, seed, *, independent=False):
    """Return a function of points in the unit cube, in the rows A, B, AB_1, ..., AB_d."""
    rng = np.random.default_rng(seed)
    points = rng.random((count, 2 * dimension))
    if not independent:
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
ISHIGAMI = (np.array([0.313905, 0.442411, 0.0]), np.array([0.557589, 0.442411, 0.243684]))
CLOSED = [
    (ishigami, ISHIGAMI),
    (linear, (np.array([9.0, 4.0]) / 13.0,) * 2),
    (lambda u: (u[0] - 0.5) * (u[1] - 0.5), (np.zeros(2), np.ones(2))),
    (lambda u: u[0], (np.ones(1), np.ones(1))),  # of which scipy has no indices
]


@pytest.mark.parametrize(("function", "expected"), CLOSED)
def test_the_indices_are_those_of_the_closed_form(function, expected):
    """Within 0.02 of it, of 4096 base points; the intervals hold them, and nothing is remarked."""
    found = indices_in(saltelli(function, len(expected[0]), 4096, 0))
    both = (found.first_order, found.total_order), (found.first_intervals, found.total_intervals)
    for order, intervals, true in zip(*both, expected, strict=True):
        assert abs(order - true).max() < 0.02
        for (lower, upper), value, own in zip(intervals, true, order, strict=True):
            assert lower <= value <= upper or own == pytest.approx(value, abs=1e-3)
    assert (found.base_points, found.remark) == (4096, "")


def test_the_indices_of_a_planned_design_are_those_of_the_closed_form():
    """The Ishigami function of the parameters of its members; its mean is 3.5."""
    keys = ("delta.terms[0].theta", "delta.terms[1].theta", "observer.filter_rate")
    vary = {key: {"uniform": [-np.pi, np.pi]} for key in keys}
    design = planned(vary=vary, samples=4096, sampling="saltelli", seed=3)
    u = np.array([design.column(key) for key in keys]) / (2.0 * np.pi) + 0.5
    columns = columns_of({"y": ishigami(u)})
    layout = design.layout
    found = sobol_indices(columns, layout, "y")
    assert found.parameters == keys
    assert abs(found.first_order - ISHIGAMI[0]).max() < 0.02
    assert abs(found.total_order - ISHIGAMI[1]).max() < 0.02
    assert drawn_members(columns, layout).metric("y").values.mean() == pytest.approx(3.5, abs=0.1)


def test_a_base_point_with_a_member_that_failed_or_is_missing_is_left_out():
    """With all its members, and it is named; the others have the indices of theirs."""
    values = saltelli(ishigami, 3, 256, 2)
    raw = values.copy()
    raw[3, 17] = np.nan
    raw[0, 200] = np.inf
    found = indices_in(raw, failed=[256 + 30])
    assert found.omitted.tolist() == [17, 30, 200]
    first, total = indices_of(np.delete(values, [17, 30, 200], axis=1), np.ones((1, 253)))
    assert np.array_equal(found.first_order, first[0])
    assert np.array_equal(found.total_order, total[0])
    values = saltelli(linear, 2, 64, 3).ravel()[:-5]
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
    values = saltelli(linear, 2, 64, 5)
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
        values = saltelli(ishigami, 3, points, seed, independent=independent)
        for resampled, true in zip(bootstrap(values, resamples=200), ISHIGAMI, strict=True):
            lower, upper = np.quantile(resampled, [0.025, 0.975], axis=0)
            hold.append((lower <= true) & (true <= upper))
    assert np.mean(hold) >= least
