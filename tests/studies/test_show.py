"""What studies print: every figure is that of numpy, and nothing is dropped silently."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from cosim.errors import UsageError, shell_language
from cosim.report.tables.console import print_shown
from cosim.studies.layout import StudyLayout
from cosim.studies.show import ShownParts, show_study, text_with_half_width, tuning_lines
from cosim.studies.statistics import ConfidenceInterval
from tests.studies.made import MadeStudy, command_of, saltelli, tolerances
from tests.studies.test_standard_errors import LINE, T, fitted, line

TEN = StudyLayout("random", samples=10)
STUDY, RESULTS = tolerances()
LAYOUT = RESULTS.layout
RMS, SETTLING = (STUDY.table([name])[name].to_numpy() for name in ("rms", "settling"))


@pytest.fixture
def shown(capsys):
    """Return the cells of the lines that a study prints, or its JSON."""

    def function(study, layout, *, as_json=False, **parts):
        print_shown(show_study(study, layout, command_of, ShownParts(**parts)), as_json=as_json)
        out = capsys.readouterr().out
        if as_json:
            return json.loads(out)
        return [text.split("\t") for text in out.splitlines()]

    return function


def with_half_width(values, digits):
    """Return the mean of values with Student's interval."""
    half_width = stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)
    return f"{values.mean():.{digits}f} ± {half_width:.{digits}f}"


def test_json_has_the_figures_of_numpy_and_scipy(shown):
    """Within 1e-12, where the method is the same; as strict JSON."""
    content = shown(STUDY, LAYOUT, conditions=("rms < 0.1",), as_json=True)
    rms, (share,) = content["statistics"]["rms"], content["passed"]
    kept = RMS[~np.isnan(RMS)]
    figures = [rms[name] for name in ("count", "mean", "deviation", "minimum", "maximum")]
    figures += [*rms["mean_interval"], *(one["value"] for one in rms["quantiles"])]
    figures += [share["share"], *share["interval"]]
    passed = int((kept < 0.1).sum())
    expected = [197, kept.mean(), kept.std(ddof=1), kept.min(), kept.max()]
    expected += stats.ttest_1samp(kept, 0.0).confidence_interval(0.95)
    expected += [*np.quantile(kept, [0.05, 0.5, 0.95]), passed / 200]
    expected += stats.binomtest(passed, 200).proportion_ci(method="wilson")
    assert figures == pytest.approx(expected, rel=1e-12)
    assert content["members"] == {"planned": 210, "done": 200, "failed": 3, "missing": 10}
    assert content["statistics"]["settling"]["without_value"] == 4
    failure = content["failures"][0]
    assert (failure["first_members"], failure["command"]) == ([3, 17], command_of(3))
    assert content["ended_early"][0]["first_members"] == [60]
    assert content["worst"]["rms"] == np.argsort(-np.nan_to_num(RMS))[:3].tolist()
    assert {one["parameter"] for one in content["correlations"]} == set(LAYOUT.parameters)


def test_a_study_prints_statistics_failures_and_the_worst_members(shown):
    """As JSON has them; members that are missing, failed or have no value are named."""
    lines = shown(STUDY, LAYOUT, conditions=("rms < 0.1",))
    content = shown(STUDY, LAYOUT, conditions=("rms < 0.1",), as_json=True)
    missing = "200 of 210 members done, 10 missing (200, 201, 202, 203, 204, and 5 more)"
    assert lines[0] == [f"tolerances: random: 210 samples; {missing}, 3 failed"]
    one, (share,) = content["statistics"]["rms"], content["passed"]
    figures = [one["deviation"], *(quantile["value"] for quantile in one["quantiles"])]
    low, high = share["interval"]
    shares = [f"{100.0 * share['share']:.3g} %", f"{100.0 * low:.3g} % to {100.0 * high:.3g} %"]
    passed = share["passed"]
    worst = ", ".join(f"{k}: {RMS[k]:.6g}" for k in content["worst"]["rms"])
    for needed in (
        ["rms", "197", with_half_width(RMS[~np.isnan(RMS)], 3), *(f"{x:.4g}" for x in figures)],
        ["settling: no value in 4 members: 5, 55, 105, 155"],
        [f"verdict: {passed} identifiable; {197 - passed} weak"],
        ["rms < 0.1", f"{passed} of 200", *shares],
        ["2", "3, 17", "RunawayError: the values of loop 1 grow without end at t = 0.25 s"],
        [f"member 3 alone: {command_of(3)}"],
        ["1", "60", "ended at 3 s by the action 'stop when settled'"],
        ["rms", f"{np.nanargmin(RMS)}: {one['minimum']:.6g}", worst],
        ["settling", "plant.mass +0.86"],
    ):
        assert needed in [cells[: len(needed)] for cells in lines]
    assert any(cells[-1].endswith("; 3 of them failed") for cells in lines)


def test_what_a_few_members_do_not_show_is_said(shown):
    """No correlation, and rough intervals; texts beyond the five most frequent are counted."""
    texts = ["v0", *(f"v{k}" for k in range(7))]
    warnings = ["", "pump: too slow at 3 s", "pump: too slow at 4 s\nvalve: leaks", *[""] * 5]
    columns = {"p": np.arange(8.0), "y": np.arange(8.0), "verdict": texts, "warnings": warnings}
    study = MadeStudy(columns, ("p",), ("y", "verdict"))
    for parts in ({}, {"metrics": ("y",)}):
        lines = [cells[0] for cells in shown(study, TEN, **parts)]
        assert "rank correlations: none for fewer than 10 members" in lines
        assert any(text.endswith("(few members or skewed values): y") for text in lines)
    lines = shown(study, TEN)
    assert ["verdict: 2 v0; 1 v1; 1 v2; 1 v3; 1 v4; and 2 other texts"] in lines
    assert ["2 of 8 members warn, such as 1: pump: too slow at 3 s"] in lines
    first, second = shown(study, TEN, as_json=True)["warnings"]
    assert (first["count"], second["first_members"]) == (2, [2])


def test_members_that_hung_do_not_change_how_long_one_takes(shown):
    """Six of ten were ended after a minute; where none is done, nothing is said of time."""
    failed = np.arange(10) < 6
    status = list(np.where(failed, "failed", "complete"))
    columns = {"y": np.arange(10.0), "status": status, "wall_time": np.where(failed, 60.0, 0.5)}
    study = MadeStudy({**columns, "reason": ["hung" if one else "" for one in failed]}, (), ("y",))
    lines = shown(study, TEN)
    assert lines[1] == ["wall time: median 0.5 s per member; at most 60 s per failed member"]
    assert ["6", "0, 1, 2, 3, 4, and 1 more", "hung"] in lines
    assert shown(study, TEN, as_json=True)["median_wall_time"] == 0.5
    none = MadeStudy({"y": np.zeros(0)}, (), ("y",), planned=3)
    (done,), *others = shown(none, TEN, conditions=("y < 1",))
    assert done.endswith("0 of 3 members done, 3 missing (0, 1, 2), none failed")
    assert not any("wall time" in cells[0] for cells in others)


def test_a_metric_is_printed_with_all_intervals(shown):
    """And who has the largest values."""
    lines = shown(STUDY, LAYOUT, metrics=("settling",))
    kept = SETTLING[~np.isnan(SETTLING)]
    ends = stats.quantile_test(kept, p=0.05).confidence_interval(0.95)
    figures = [f"{np.quantile(kept, 0.05):.6g}", f"{ends.low:.4g} to {ends.high:.4g}"]
    for needed in (["settling [s]"], ["failed", "3"], ["no value", "4"], ["5 %", *figures]):
        assert needed in lines
    content = shown(STUDY, LAYOUT, metrics=("settling",), as_json=True)["settling"]
    ends = [content["smallest"][0], content["largest"][0]]
    assert ends == [np.nanargmin(SETTLING), np.nanargmax(SETTLING)]


def test_one_member_is_printed_with_its_command(shown):
    """Parameters, metrics, how it ended."""
    failed, complete = STUDY.table(members=[3, 8]).to_pylist()
    lines = shown(STUDY, LAYOUT, member=3)
    assert lines[0] == [f"member 3: failed: {failed['reason']}"]
    rows = [["plant.mass [kg]", str(failed["plant.mass"])], ["settling [s]", "no value"]]
    assert all(row in lines for row in [*rows, ["steps", "1000"]])
    assert lines[-1] == [f"alone: {command_of(3)}"]
    content = shown(STUDY, LAYOUT, member=8, as_json=True)
    assert content == {**complete, "command": command_of(8)}


def test_each_value_of_a_key_has_statistics(shown):
    """Of its members: the interval of 20 seeds at one rate is Student's."""
    numbers = np.arange(60)
    rates = np.array([10.0, 100.0, 1000.0])[numbers % 3]
    values = rates + np.random.default_rng(2).normal(size=60)
    status = np.where((rates > 500.0) & (numbers % 2 == 0), "failed", "complete")
    columns = {"rate": rates, "plant": ["b.fmu", "a.fmu", "a.fmu"] * 20, "y": values}
    study = MadeStudy({**columns, "status": list(status)}, ("rate", "plant"), ("y",))
    layout = StudyLayout("grid", seeds=20, grid=3)
    title, _, *rows, basis = shown(study, layout, by="rate")
    assert (title, basis) == (["y"], ["±, 95 % intervals: 20 seeds drawn independently"])
    counts = [["10.0", "20", ""], ["100.0", "20", ""], ["1000.0", "10", "10"]]
    assert [cells[:3] for cells in rows] == counts
    assert rows[0][3] == with_half_width(values[::3], 2)
    groups = shown(study, layout, by="plant", metrics=("y",), as_json=True)["groups"]
    assert [(one["value"], one["failed"]) for one in groups] == [("b.fmu", 0), ("a.fmu", 10)]
    assert groups[0]["statistics"]["y"]["mean"] == pytest.approx(values[::3].mean())


def test_sobol_indices_are_printed(capsys):
    """The largest first, with what was left out; a metric without any says why."""
    study, results = saltelli()
    parts = ShownParts(sobol=True)
    print_shown(show_study(study, results.layout, command_of, parts), as_json=False)
    captured = capsys.readouterr()
    title, _, p, q, total, basis, omitted = [text.split("\t") for text in captured.out.splitlines()]
    assert title == ["Sobol indices of y"]
    assert [p[0], q[0], total[0]] == ["p", "q", "sum"]
    assert [float(p[1]), float(q[3])] == pytest.approx([9.0 / 13.0, 4.0 / 13.0], abs=0.02)
    assert sum(" to " in cell for cell in p) == 2
    assert basis == ["of 255 base points; 95 % intervals: rough (bootstrap)"]
    assert omitted[0].startswith("omitted: 1 base point with a member that failed")
    assert ": 4; " in omitted[0]
    assert "'z'" in captured.err


REFUSED = [
    ({"metrics": ("rms", "settlin")}, r"'settlin'; did you mean 'settling'"),
    ({"metrics": ("verdict",)}, r"'verdict': expected numbers, got texts"),
    ({"conditions": ("rsm < 1",)}, r"'rsm'; did you mean 'rms'"),
    ({"by": "plant.mas"}, r"'plant.mas'; did you mean 'plant.mass'"),
    ({"by": "plant.mass"}, r"'plant.mass': .*at most 200 values.*got 201"),
    ({"sobol": True}, r"'saltelli'.*'random'"),
    ({"worst": -1}, r"--worst: .*0 or more, got -1"),
    ({"member": 0, "sobol": True}, r"--member and --sobol"),
    ({"member": 1, "metrics": ("a",)}, r"--member and --metric"),
    ({"by": "a", "sobol": True}, r"--by and --sobol"),
]


def test_what_is_not_there_or_does_not_go_together_is_an_error(capsys):
    """Found before anything is printed."""
    study, results = tolerances(201)
    for parts, message in REFUSED:
        with shell_language(), pytest.raises(UsageError, match=message):
            next(show_study(study, results.layout, command_of, ShownParts(**parts)))
    assert capsys.readouterr().out == ""


def test_a_number_has_as_many_digits_as_are_known():
    """As far as the second digit of its half-width."""
    for value, half_width, text in (
        (0.12345678, 0.0012, "0.1235 ± 0.0012"),
        (1234.5678, 0.01, "1234.568 ± 0.010"),
        (5.0, 300.0, "5 ± 300"),
        (5.0, 3e6, "(0.0 ± 3.0)e+06"),
        (2.35156e10, 1.6e9, "(2.35 ± 0.16)e+10"),
        (-1.5e-12, 3e-12, "(-1.5 ± 3.0)e-12"),
        (0.0, 0.25, "0.00 ± 0.25"),
        (3.25, 0.0, "3.25"),
    ):
        interval = ConfidenceInterval(value - half_width, value + half_width)
        assert text_with_half_width(value, interval) == text


@pytest.mark.parametrize(("deviation", "digits"), [(1e-6, 9), (1.0, 6)])
def test_a_tuned_value_has_the_digits_that_its_error_leaves(deviation, digits):
    """Two of the error, in value and interval; six digits where the error has more."""
    noise = np.random.default_rng(3).standard_normal(T.size)
    result = fitted(line, LINE, line(T, 3.0, -2.0) + deviation * noise, starts=1)
    value, error, interval = tuning_lines(replace(result, command="cosim run x"))[1].split(", ")
    low, high = result.errors.intervals["slope"]
    assert value == f"  slope = {result.estimate['slope']:.{digits}g}"
    assert error == f"standard error {result.errors.errors['slope']:.2g}"
    assert interval == f"95 % interval {low:.{digits}g} to {high:.{digits}g}"
