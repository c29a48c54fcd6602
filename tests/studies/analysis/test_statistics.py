"""Statistics of a metric: against scipy, and what they say of each design."""

import numpy as np
import pytest
from scipy import stats

from cosim.errors import UsageError
from cosim.studies.analysis.conditions import passed_share
from cosim.studies.analysis.convergence import running_mean
from cosim.studies.analysis.correlation import rank_correlations, strongest
from cosim.studies.analysis.extremes import best_members, worst_members
from cosim.studies.analysis.independence import StudyLayout, independence_of
from cosim.studies.analysis.ranks import Ranks, rank_correlation_deviation
from cosim.studies.analysis.statistics import study_statistics
from tests.studies.analysis.made import columns_of

RANDOM = StudyLayout("random", samples=1000)


def test_the_figures_are_those_of_numpy_and_scipy():
    """Of the members that have a value; the others are counted."""
    values = np.random.default_rng(0).gamma(3.0, size=1000)
    values[[3, 5]] = np.nan
    found = study_statistics(columns_of({"rms": values}, failed=[3]), RANDOM)["rms"]
    kept = values[~np.isnan(values)]
    assert (found.count, found.failed, found.without_value, found.infinite) == (998, 1, 1, 0)
    assert found.mean == kept.mean()
    assert found.deviation == kept.std(ddof=1)
    assert (found.minimum, found.maximum) == (kept.min(), kept.max())
    expected = stats.ttest_1samp(kept, 0.0).confidence_interval(0.95)
    assert found.mean_interval.to_list() == pytest.approx([expected.low, expected.high])
    for quantile in found.quantiles:
        assert quantile.value == np.quantile(kept, quantile.probability)
        test = stats.quantile_test(kept, p=quantile.probability).confidence_interval(0.95)
        assert quantile.interval.to_list() == [test.low, test.high]
    assert found.basis == "samples drawn independently"
    assert found.to_dict()["count"] == 998


def test_a_metric_without_any_value_has_no_figures():
    """Nor has one whose members all failed, or all have infinity."""
    for raw, failed in (([None] * 3, ()), ([1.0, 2.0, 3.0], (0, 1, 2)), ([np.inf] * 3, ())):
        found = study_statistics(columns_of({"a": raw}, failed=failed), RANDOM)["a"]
        assert found.count == 0
        assert found.failed + found.without_value + found.infinite == 3
        assert found.mean is found.deviation is found.minimum is None
        assert found.quantiles == ()


def test_a_grid_has_no_interval_and_one_with_seeds_has_that_of_its_seeds():
    """The points of a grid were chosen: only seeds vary the mean over all points."""
    rng = np.random.default_rng(1)
    of_point = np.linspace(0.0, 5.0, 6)
    of_seed = rng.normal(size=40)
    values = (of_seed[:, np.newaxis] + of_point).ravel()
    chosen = study_statistics(columns_of({"a": values[:6]}), StudyLayout("grid", grid=6))["a"]
    assert chosen.mean_interval.to_list() == [None, None]
    assert chosen.quantiles[1].interval.to_list() == [None, None]
    assert chosen.basis == "none (the members were chosen, not drawn)"
    layout = StudyLayout("grid", seeds=40, grid=6)
    drawn = study_statistics(columns_of({"a": values}), layout)["a"]
    expected = stats.ttest_1samp(of_seed + of_point.mean(), 0.0).confidence_interval(0.95)
    assert drawn.mean_interval.to_list() == pytest.approx([expected.low, expected.high])
    assert drawn.basis == "40 seeds drawn independently"


def test_the_members_of_a_sample_count_together():
    """Seeds of one sample share its values."""
    rng = np.random.default_rng(2)
    of_sample = rng.normal(size=30)
    values = (of_sample[:, np.newaxis] + np.array([-1.0, 1.0])).ravel()
    layout = StudyLayout("random", seeds=2, samples=30)
    found = study_statistics(columns_of({"a": values}), layout)["a"]
    expected = stats.ttest_1samp(of_sample, 0.0).confidence_interval(0.95)
    assert found.mean_interval.to_list() == pytest.approx([expected.low, expected.high])
    assert found.basis.endswith("; the 2 members of a sample count as one")


def test_of_a_saltelli_design_only_the_drawn_members_count():
    """Those of A and B: the others repeat their values."""
    layout = StudyLayout("saltelli", parameters=("p", "q"), samples=4 * 8)
    values = np.concatenate([np.arange(16.0), np.full(16, 100.0)])
    found = study_statistics(columns_of({"a": values}), layout)["a"]
    assert (found.count, found.maximum) == (16, 15.0)
    assert "not guaranteed" in found.basis


def test_a_latin_hypercube_says_that_its_interval_is_conservative():
    """Its variance has the factor n / (n - 1)."""
    values = np.random.default_rng(3).normal(size=11)
    layout = StudyLayout("latin-hypercube", samples=11)
    found = study_statistics(columns_of({"a": values}), layout)["a"]
    independent = study_statistics(columns_of({"a": values}), RANDOM)["a"]
    ratio = np.diff(found.mean_interval.to_list()) / np.diff(independent.mean_interval.to_list())
    assert ratio == pytest.approx(np.sqrt(11.0 / 10.0))
    assert "conservative" in found.basis


@pytest.mark.parametrize("count", [150, pytest.param(5000, marks=pytest.mark.campaign)])
def test_all_intervals_of_a_latin_hypercube_are_conservative(count):
    """Of the mean, deviation, quantiles and share of p + q, which has a triangular distribution."""
    rng = np.random.default_rng(9)
    layout = StudyLayout("latin-hypercube", samples=40)
    low = np.sqrt(0.1)  # 5 % are below it
    hold = []
    for _ in range(count):
        values = stats.qmc.LatinHypercube(2, rng=rng).random(40).sum(axis=1)
        columns = columns_of({"a": values})
        found = study_statistics(columns, layout)["a"]
        share = passed_share(columns, layout, f"a < {float(2.0 - low)}")
        intervals = [quantile.interval for quantile in found.quantiles]
        truth = list(zip(intervals, (low, 1.0, 2.0 - low), strict=True))
        truth += [(found.mean_interval, 1.0), (found.deviation_interval, np.sqrt(1.0 / 6.0))]
        truth += [(share.interval, 0.95)]
        hold.append([interval.holds(true) for interval, true in truth])
    # binomial: that of 95 % is within 3.3 deviations in 999 of 1000
    assert np.mean(hold, axis=0).min() >= 0.95 - 3.3 * np.sqrt(0.05 * 0.95 / count)


def test_a_member_without_a_value_does_not_pass():
    """Nor does one that failed; infinity is compared as any other number."""
    raw = [0.05, 0.2, None, 0.01, np.inf, 0.03]
    columns = columns_of({"rms": raw, "verdict": ["a", "a", "a", "b", "a", "a"]}, failed=[5])
    layout = StudyLayout("random", samples=6)
    found = passed_share(columns, layout, "rms < 0.1")
    assert (found.passed, found.of, found.failed, found.without_value) == (2, 6, 1, 1)
    assert found.not_passed.tolist() == [1, 2, 4, 5]
    expected = stats.binomtest(2, 6).proportion_ci(method="wilson")
    assert found.interval.to_list() == pytest.approx([expected.low, expected.high])
    assert passed_share(columns, layout, "rms < 0.1 and verdict == 'a'").passed == 1
    assert passed_share(columns, layout, "rms != 0.2 and verdict != b").passed == 2
    assert passed_share(columns, layout, "rms >= 0.2").passed == 2


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        ("rms", r"condition 'rms': .*got 'rms'"),
        ("rsm < 1", r"the study has no metric 'rsm'; did you mean 'rms'"),
        ("rms < small", r"metric 'rms': .*< 'small'"),
        ("verdict < a", r"metric 'verdict': .*< 'a'"),
        ("verdict < 1", r"metric 'verdict': .*got texts"),
        ("rms < nan", r"metric 'rms': .*< 'nan'"),
    ],
)
def test_a_text_that_is_no_condition_is_an_error(condition, message):
    """It names what was found."""
    columns = columns_of({"rms": [1.0], "verdict": ["a"]})
    with pytest.raises(UsageError, match=message):
        passed_share(columns, RANDOM, condition)


def test_the_running_mean_is_that_of_the_first_members():
    """With Student's interval; a large offset costs no digits."""
    values = 1e6 + np.random.default_rng(4).normal(size=50)
    column = columns_of({"a": values}).metric("a")
    found = running_mean(column, independence_of(RANDOM))
    assert found.counts.tolist() == list(range(1, 51))
    assert np.isnan(found.half_widths[0])
    for count in (2, 7, 50):
        expected = stats.ttest_1samp(values[:count], 0.0).confidence_interval(0.95)
        half_width = 0.5 * (expected.high - expected.low)
        assert found.means[count - 1] == pytest.approx(values[:count].mean(), rel=1e-14)
        assert found.half_widths[count - 1] == pytest.approx(half_width, rel=1e-8)


def test_the_mean_of_a_grid_does_not_converge():
    """Its members were chosen."""
    column = columns_of({"a": np.arange(4.0)}).metric("a")
    with pytest.raises(UsageError, match=r"the mean of 'a' does not converge: the members of this"):
        running_mean(column, independence_of(StudyLayout("grid", grid=4)))


def test_units_enter_the_running_mean_whole():
    """A sample whose seeds are all counted."""
    column = columns_of({"a": np.array([1.0, 3.0, 5.0, 7.0])}).metric("a")
    found = running_mean(column, independence_of(StudyLayout("random", seeds=2, samples=2)))
    assert found.counts.tolist() == [2, 4]
    assert found.means.tolist() == [2.0, 4.0]


def test_the_worst_members_have_the_largest_values():
    """Infinity first; the smaller number first of equal ones; no failed member."""
    columns = columns_of({"a": [3.0, 9.0, None, 9.0, np.inf, 50.0, -1.0]}, failed=[5])
    assert worst_members(columns, "a", 3).tolist() == [4, 1, 3]
    assert best_members(columns, "a", 2).tolist() == [6, 0]
    assert worst_members(columns, "a", 99).tolist() == [4, 1, 3, 0, 6]


def test_the_rank_correlation_is_that_of_scipy():
    """With ties, and of the members that have a value."""
    rng = np.random.default_rng(5)
    first = rng.integers(0, 8, 300).astype(float)
    other = rng.normal(size=300)
    values = first + 0.1 * other + rng.normal(size=300)
    values[7] = np.nan
    names = np.array(["a.fmu"] * 300)
    parameters = {"p": first, "q": other, "swap.plant": names, "same": np.ones(300)}
    columns = columns_of({"m": values}, parameters=parameters)
    found = rank_correlations(columns, RANDOM)
    assert [one.parameter for one in found] == ["p", "q", "same"]
    kept = ~np.isnan(values)
    expected = stats.spearmanr(first[kept], values[kept]).statistic
    assert found[0].value == pytest.approx(expected, rel=1e-12)
    assert found[0].count == 299
    assert found[0].interval.lower < found[0].value < found[0].interval.upper
    assert found[2].value is None
    assert [one.parameter for one in strongest(found, "m")] == ["p", "q"]


@pytest.mark.parametrize("count", [600, pytest.param(10_000, marks=pytest.mark.campaign)])
def test_95_percent_of_the_intervals_of_rank_correlations_hold(count):
    """Of normal values, whose rank correlation is 6 / pi asin(r / 2)."""
    rng = np.random.default_rng(6)
    true = 6.0 / np.pi * np.arcsin(0.6 / 2.0)
    hold = 0
    for _ in range(count):
        first = rng.normal(size=150)
        values = 0.6 * first + 0.8 * rng.normal(size=150)
        columns = columns_of({"m": values}, parameters={"p": first})
        interval = rank_correlations(columns, RANDOM)[0].interval
        hold += interval.lower <= true <= interval.upper
    assert 0.92 <= hold / count <= 0.98 if count < 1000 else 0.93 <= hold / count <= 0.97


@pytest.mark.parametrize(
    "metric",
    [
        lambda u: (u[0] - 0.5) ** 2,
        lambda u: (u[0] - 0.5) * (u[1] - 0.5),
        lambda u: np.floor(3.0 * (u[0] - 0.5) ** 2 + u[1]),
    ],
)
def test_intervals_of_rank_correlations_hold_of_metrics_that_rise_and_fall(metric):
    """Their correlation is 0: but for the sign of u[0] - 0.5 they are as they are.

    Of the first metric those of normal values hold in 86 %, whatever the number of members is.
    """
    rng = np.random.default_rng(8)
    hold = 0
    for _ in range(600):
        u = rng.random((2, 150))
        columns = columns_of({"m": metric(u)}, parameters={"p": u[0]})
        interval = rank_correlations(columns, RANDOM)[0].interval
        hold += interval.lower <= 0.0 <= interval.upper
    assert 0.92 <= hold / 600 <= 0.98


def test_the_deviation_of_a_rank_correlation_is_that_of_many_studies():
    """With ties, too; of 400 studies it is known to a part of 1/sqrt(800), 3.5 %."""
    rng = np.random.default_rng(9)
    for levels in (5.0, 1e9):
        values = []
        deviations = []
        for _ in range(400):
            u = np.floor(levels * rng.random((2, 300)))
            pair = (Ranks.of(u[0]), Ranks.of(u[0] + u[1]))
            values.append(stats.spearmanr(u[0], u[0] + u[1]).statistic)
            deviations.append(rank_correlation_deviation(*pair, values[-1]))
        assert np.mean(deviations) == pytest.approx(np.std(values), rel=0.12)


@pytest.mark.parametrize("scale", [1e-200, 1e200, 1e307])
def test_statistics_of_huge_and_tiny_values_are_scaled(scale):
    """Their squares are no numbers; all figures are those of the values times a power of two."""
    factor = 2.0 ** np.floor(np.log2(scale))
    values = np.random.default_rng(7).gamma(3.0, size=60)
    small = study_statistics(columns_of({"a": values}), RANDOM)["a"].to_dict()
    large = study_statistics(columns_of({"a": values * factor}), RANDOM)["a"].to_dict()
    for key in ("mean", "deviation", "minimum", "maximum"):
        assert large[key] == pytest.approx(small[key] * factor, rel=1e-12)
    for key in ("mean_interval", "deviation_interval"):
        assert np.allclose(large[key], np.array(small[key]) * factor, rtol=1e-12, atol=0.0)
    for one, other in zip(large["quantiles"], small["quantiles"], strict=True):
        assert one["value"] == pytest.approx(other["value"] * factor, rel=1e-12)
    column = columns_of({"a": values * factor}).metric("a")
    found = running_mean(column, independence_of(RANDOM))
    assert found.means[-1] == pytest.approx(large["mean"], rel=1e-12)
    low, high = large["mean_interval"]
    assert found.half_widths[-1] == pytest.approx(0.5 * (high - low), rel=1e-9)


def test_members_without_a_parameter_have_no_part_in_its_correlation():
    """They are counted as without."""
    first = np.arange(12.0)
    first[2] = np.nan
    values = np.random.default_rng(0).permutation(12).astype(float)
    columns = columns_of({"m": values}, parameters={"p": first})
    (found,) = rank_correlations(columns, RANDOM)
    assert found.count == 11
    known = ~np.isnan(first)
    assert found.value == pytest.approx(stats.spearmanr(first[known], values[known]).statistic)


@pytest.mark.parametrize(("grid", "seeds"), [(5, 5), (10, 5), (5, 10), (10, 20), (3, 50)])
def test_noise_that_grows_with_a_key_makes_no_correlation(grid, seeds):
    """All members of a seed have the same noise, times the key: the true correlation is 0."""
    rng = np.random.default_rng(11)
    layout = StudyLayout("grid", grid=grid, seeds=seeds)
    key = np.geomspace(1e-4, 1e-2, grid)
    metrics = {f"m{n}": (key * rng.normal(size=(seeds, 1))).ravel() for n in range(200)}
    found = rank_correlations(columns_of(metrics, parameters={"p": np.tile(key, seeds)}), layout)
    share = np.mean([one.is_distinct for one in found])
    # binomial: 200 trials of 5 % are within 3.3 deviations in 999 of 1000
    assert share <= 0.05 + 3.3 * np.sqrt(0.05 * 0.95 / 200)


@pytest.mark.parametrize("seeds", [2, 3, 4])
def test_of_very_few_seeds_nothing_is_distinct(seeds):
    """Chance alone gives all of them one sign."""
    layout = StudyLayout("grid", grid=10, seeds=seeds)
    key = np.tile(np.arange(10.0), seeds)
    (found,) = rank_correlations(columns_of({"m": key}, parameters={"p": key}), layout)
    assert found.value == 1.0
    assert not found.is_distinct


@pytest.mark.parametrize("common", [0.0, 0.9])
def test_a_trend_over_a_grid_is_distinct(common):
    """Of 20 seeds, whether their noise is common to all points or not."""
    rng = np.random.default_rng(12)
    layout = StudyLayout("grid", grid=5, seeds=20)
    metrics = {}
    for number in range(100):
        shared = common * rng.normal(size=(20, 1))
        own = np.sqrt(1.0 - common**2) * rng.normal(size=(20, 5))
        metrics[f"m{number}"] = (np.linspace(0.0, 1.0, 5) + shared + own).ravel()
    parameters = {"p": np.tile(np.arange(5.0), 20)}
    found = rank_correlations(columns_of(metrics, parameters=parameters), layout)
    assert np.mean([one.is_distinct for one in found]) >= 0.8


def test_a_metric_that_is_smallest_in_the_middle_makes_no_correlation():
    """Of samples with seeds: the deviation is larger than that of independent columns."""
    rng = np.random.default_rng(13)
    layout = StudyLayout("random", samples=100, seeds=3)
    metrics, shares = {}, []
    for _ in range(200):
        key = np.repeat(rng.uniform(-1.0, 1.0, size=100), 3)
        metrics = {"m": key**2 + 1e-3 * rng.normal(size=300)}
        (found,) = rank_correlations(columns_of(metrics, parameters={"p": key}), layout)
        shares.append(found.is_distinct)
    # asymptotic in the number of samples: the reference is 0.06 of 1000 studies of 50 samples
    assert np.mean(shares) <= 0.06 + 3.3 * np.sqrt(0.06 * 0.94 / 200)


@pytest.mark.parametrize("count", [1, 2, 9])
def test_few_members_have_no_rank_correlation(count):
    """Two are always in order: of nine, chance alone makes 0.68 in 1 of 20 studies."""
    columns = columns_of({"m": np.arange(float(count))}, parameters={"p": np.arange(count)})
    (found,) = rank_correlations(columns, RANDOM)
    assert (found.value, found.count, found.is_distinct) == (None, count, False)
    assert strongest([found], "m") == []


def test_differences_of_rounding_have_no_rank_correlation():
    """A metric that no parameter changes, summed in another order."""
    noise = 1.0 + 2.0**-52 * np.arange(40.0)
    columns = columns_of({"m": noise}, parameters={"p": np.arange(40)})
    (found,) = rank_correlations(columns, RANDOM)
    assert found.value is None


@pytest.mark.parametrize(
    ("layout", "rows"),
    [
        (StudyLayout("random", samples=500), 500),
        (StudyLayout("latin-hypercube", samples=500), 500),
        (StudyLayout("random", samples=500 // 5, seeds=5), 500),
        (StudyLayout("grid", grid=100, seeds=5), 500),
    ],
)
def test_chance_alone_is_distinct_in_1_of_20_correlations(layout, rows):
    """At most, of 200 parameters that change nothing; samples count once, however many seeds."""
    rng = np.random.default_rng(8)
    units = layout.samples if layout.kind != "grid" else layout.grid * layout.seeds
    repeats = rows // units
    values = np.repeat(rng.normal(size=units), repeats)
    parameters = {f"p{k}": np.repeat(rng.normal(size=units), repeats) for k in range(200)}
    found = rank_correlations(columns_of({"m": values}, parameters=parameters), layout)
    share = np.mean([one.is_distinct for one in found])
    # binomial: 200 trials of 5 % are within 3.3 deviations in 999 of 1000
    assert share <= 0.05 + 3.3 * np.sqrt(0.05 * 0.95 / 200)
    strong = columns_of({"m": values}, parameters={"p": values + 0.1})
    assert rank_correlations(strong, layout)[0].is_distinct
