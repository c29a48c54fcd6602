"""What studies print: every figure is that of numpy, and nothing is dropped silently."""

import json

import numpy as np
import pyarrow
import pytest
from scipy import stats

from cosim.errors import UsageError
from cosim.studies.analysis.confidence import ConfidenceInterval
from cosim.studies.analysis.independence import StudyLayout
from cosim.studies.analysis.results import results_of_study
from cosim.studies.tables.groups import print_groups
from cosim.studies.tables.member import check_is_done, print_member
from cosim.studies.tables.metric import print_metrics
from cosim.studies.tables.numbers import interval_text, members_text, text_with_half_width
from cosim.studies.tables.sensitivity import print_sobol
from cosim.studies.tables.study import print_study
from tests.studies.made import MadeStudy, command_of, saltelli_study, tolerances


def printed(capsys):
    return [line.split("\t") for line in capsys.readouterr().out.splitlines()]


def test_a_study_says_what_is_done_and_what_is_not(capsys):
    """Done, missing, failed; the design; how long a member takes."""
    _, results = tolerances()
    print_study(results, command_of)
    (first,), (second,) = printed(capsys)[:2]
    assert first == (
        "tolerances: random: 210 samples; 200 of 210 members done, 10 missing (200, 201, 202, 203, "
        "204, and 5 more), 3 failed"
    )
    assert second == (
        "wall time: median 0.25 s per member that completed; at most 0.25 s per failed member"
    )


def test_a_study_prints_statistics_failures_and_the_worst_members(capsys):
    """Against numpy; members without a value are named."""
    study, results = tolerances()
    print_study(results, command_of, conditions=["rms < 0.1"])
    lines = printed(capsys)
    rms = study.table(["rms"])["rms"].to_numpy()
    kept = rms[~np.isnan(rms)]
    (row,) = [line for line in lines if line[0] == "rms" and line[1] == "197"]
    half_width = stats.t.ppf(0.975, 196) * kept.std(ddof=1) / np.sqrt(197)
    assert row[2] == f"{kept.mean():.3f} ± {half_width:.3f}"
    low, middle, high = np.quantile(kept, [0.05, 0.5, 0.95])
    figures = (kept.std(ddof=1), low, middle, high)
    assert row[3:] == [f"{value:.4g}" for value in figures]
    assert ["±, 95 % intervals: samples drawn independently"] in lines
    assert ["settling: no value in 4 members: 5, 55, 105, 155"] in lines
    passed = int((kept < 0.1).sum())
    assert [f"verdict: {passed} identifiable; {197 - passed} weak"] in lines
    (share,) = [line for line in lines if line[0] == "rms < 0.1"]
    wilson = stats.binomtest(passed, 200).proportion_ci(method="wilson")
    ends = f"{100.0 * wilson.low:.3g} % to {100.0 * wilson.high:.3g} %"
    assert share[1:4] == [f"{passed} of 200", f"{passed / 2.0:.3g} %", ends]
    assert share[4].endswith("; 3 of them failed")
    reason = "RunawayError: the values of loop 1 grow without end at t = 0.25 s"
    assert ["2", "3, 17", reason] in lines
    assert [f"member 3 alone: {command_of(3)}"] in lines
    assert ["1", "60", "ended at 3 s by the action 'stop when settled'"] in lines
    worst = np.argsort(-np.nan_to_num(rms))[:3]
    largest = ", ".join(f"{k}: {rms[k]:.6g}" for k in worst)
    assert ["rms", f"{np.nanargmin(rms)}: {kept.min():.6g}", largest] in lines
    assert ["settling", "plant.mass +0.86"] in lines
    assert ["correlations not significant at the 5 % level are omitted"] in lines


@pytest.mark.parametrize(("kinds", "more"), [(5, None), (6, 1), (8, 3)])
def test_texts_beyond_the_five_most_frequent_are_counted(kinds, more, capsys):
    """Text k is that of k + 1 members; every other one is in the count behind."""
    texts = [f"v{k}" for k in range(kinds) for _ in range(k + 1)]
    study = MadeStudy({"verdict": texts}, (), ("verdict",))
    results = results_of_study(study, StudyLayout("random", samples=len(texts)))
    print_study(results, command_of)
    (line,) = [line for (line, *_) in printed(capsys) if line.startswith("verdict: ")]
    shown, _, rest = line.removeprefix("verdict: ").partition("; and ")
    assert shown.split("; ") == [f"{k + 1} v{k}" for k in reversed(range(kinds - 5, kinds))]
    assert rest.partition(" ")[0] == ("" if more is None else str(more))


def test_json_has_all_of_it(capsys):
    """With every interval, as strict JSON."""
    _, results = tolerances()
    print_study(results, command_of, conditions=["settling < 0.85"], as_json=True)
    content = json.loads(capsys.readouterr().out)
    assert content["members"] == {"planned": 210, "done": 200, "failed": 3, "missing": 10}
    assert content["design"]["kind"] == "random"
    assert StudyLayout.from_dict(content["design"]) == results.layout
    assert content["statistics"]["settling"]["without_value"] == 4
    assert len(content["statistics"]["rms"]["quantiles"][0]["interval"]) == 2
    assert content["passed"][0]["without_value"] == 4
    assert content["failures"][0]["first_members"] == [3, 17]
    assert content["failures"][0]["command"] == command_of(3)
    assert len(content["worst"]["rms"]) == 3
    assert {one["parameter"] for one in content["correlations"]} == set(results.layout.parameters)


def test_a_condition_that_is_none_prints_nothing(capsys):
    """It is an error."""
    _, results = tolerances()
    with pytest.raises(UsageError, match=r"no metric 'rsm'; did you mean 'rms'"):
        print_study(results, command_of, conditions=["rsm < 1"])
    assert capsys.readouterr().out == ""


def test_two_members_are_said_to_be_too_few(capsys):
    """Their rank correlation is always 1, and their interval rests on a normal distribution."""
    study = MadeStudy({"p": np.array([1.0, 2.0]), "y": np.array([3.0, 4.0])}, ("p",), ("y",))
    results = results_of_study(study, StudyLayout("random", samples=2))
    print_study(results, command_of)
    lines = printed(capsys)
    assert ["rank correlations: none for fewer than 10 members"] in lines
    assert ["± may be too small (few members or skewed values): y"] in lines
    print_metrics(results, ["y"])
    lines = printed(capsys)
    assert ["rank correlations: none for fewer than 10 members"] in lines
    assert ["the interval of the mean may be too narrow (few members or skewed values)"] in lines


def test_correlations_of_chance_are_not_called_strong(capsys):
    """Of 40 members +0.2 says nothing, and the one that changes the metric is shown alone."""
    rng = np.random.default_rng(4)
    cause, other = rng.normal(size=(2, 40))
    columns = {"cause": cause, "other": other, "y": cause + 0.3 * rng.normal(size=40)}
    value = stats.spearmanr(columns["other"], columns["y"]).statistic
    assert 0.1 < abs(value) < 0.25
    study = MadeStudy(columns, ("cause", "other"), ("y",))
    print_study(results_of_study(study, StudyLayout("random", samples=40)), command_of)
    (row,) = [line for line in printed(capsys) if line[0] == "y" and "cause" in line[1]]
    assert "other" not in row[1]


def test_members_that_hung_do_not_change_how_long_one_takes(capsys):
    """Six of ten were ended after a minute."""
    failed = np.arange(10) < 6
    columns = {
        "y": pyarrow.array(np.arange(10.0), mask=failed),
        "status": list(np.where(failed, "failed", "complete")),
        "reason": ["hung: ended after 60 s"] * 6 + [""] * 4,
        "wall_time": np.where(failed, 60.0, 0.5),
    }
    results = results_of_study(MadeStudy(columns, (), ("y",)), StudyLayout("random", samples=10))
    print_study(results, command_of)
    expected = "wall time: median 0.5 s per member that completed; at most 60 s per failed member"
    assert printed(capsys)[1] == [expected]
    print_study(results, command_of, as_json=True)
    assert json.loads(capsys.readouterr().out)["median_wall_time"] == 0.5


def test_a_study_in_which_every_member_failed_says_so(capsys):
    """Without figures."""
    columns = {"rms": np.full(4, np.nan), "status": ["failed"] * 4, "reason": ["crashed"] * 4}
    study = MadeStudy(columns, (), ("rms",))
    print_study(results_of_study(study, StudyLayout("grid", grid=4)), command_of)
    lines = printed(capsys)
    assert lines[0][0].startswith("tolerances: grid of 4; 4 of 4 members done, 4 failed")
    assert ["4", "0, 1, 2, 3", "crashed"] in lines
    assert ["wall time: median 0.25 s per failed member"] in lines


def test_a_study_that_has_not_begun_has_no_figures(capsys):
    """No member is done."""
    _, whole = tolerances()
    study = MadeStudy({"rms": np.zeros(0)}, (), ("rms",), planned=3)
    print_study(results_of_study(study, whole.layout), command_of, conditions=["rms < 1"])
    assert printed(capsys)[0][0].endswith("0 of 3 members done, 3 missing (0, 1, 2), none failed")


def test_a_metric_is_printed_with_all_intervals(capsys):
    """And who has the largest values."""
    study, results = tolerances()
    print_metrics(results, ["settling"])
    lines = printed(capsys)
    values = study.table(["settling"])["settling"].to_numpy()
    kept = values[~np.isnan(values)]
    expected = stats.quantile_test(kept, p=0.05).confidence_interval(0.95)
    assert ["failed", "3"] in lines
    assert ["no value", "4"] in lines
    assert [
        "5 %",
        f"{np.quantile(kept, 0.05):.6g}",
        f"{expected.low:.4g} to {expected.high:.4g}",
    ] in lines
    assert lines[0] == ["settling [s]"]
    print_metrics(results, ["settling"], as_json=True)
    content = json.loads(capsys.readouterr().out)["settling"]
    assert content["largest"][0] == np.nanargmax(values)
    assert content["smallest"][0] == np.nanargmin(values)
    with pytest.raises(UsageError, match=r"no metric 'settlin'; did you mean 'settling'"):
        print_metrics(results, ["rms", "settlin"])
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("kind", ["saltelli", "random"])
def test_the_extremes_of_a_metric_are_those_of_the_members_beside_them(kind, capsys):
    """Of all members: also of those that no statistics are of, and of infinite ones."""
    values = np.arange(64.0)
    values[[40, 50]] = -7.0, np.inf
    study = MadeStudy({"y": values}, (), ("y",))
    layout = StudyLayout(kind, samples=64, parameters=("p", "q"))
    print_metrics(results_of_study(study, layout), ["y"])
    lines = printed(capsys)
    assert ["smallest", "-7", "members 40, 0, 1, 2, 3"] in lines
    assert ["largest", "inf", "members 50, 63, 62, 61, 60"] in lines


def test_one_member_is_printed_with_its_command(capsys):
    """Parameters, metrics, how it ended."""
    study, results = tolerances()
    print_member(study.row(3), results, command_of(3))
    lines = printed(capsys)
    reason = "RunawayError: the values of loop 1 grow without end at t = 0.25 s"
    assert lines[0] == [f"member 3: failed: {reason}"]
    assert ["settling [s]", "no value"] in lines
    assert ["steps", "1000"] in lines
    assert lines[-1] == [f"alone: {command_of(3)}"]
    print_member(study.row(8), results, command_of(8), as_json=True)
    content = json.loads(capsys.readouterr().out)
    assert content["plant.mass"] == study.row(8)["plant.mass"]
    assert content["command"] == command_of(8)


def test_a_member_that_is_not_done_is_an_error():
    """Nor is there one beyond the last."""
    _, results = tolerances()
    check_is_done(199, results)
    with pytest.raises(UsageError, match=r"member 205 has not run yet"):
        check_is_done(205, results)
    for number in (-1, 210):
        with pytest.raises(UsageError, match=rf"from 0 to 209, got {number}"):
            check_is_done(number, results)


def test_sobol_indices_are_printed(capsys):
    """The largest first, with what was left out; a metric without any says why."""
    results = saltelli_study()
    print_sobol(results)
    captured = capsys.readouterr()
    lines = [line.split("\t") for line in captured.out.splitlines()]
    assert lines[0] == ["Sobol indices of y"]
    assert [line[0] for line in lines[2:5]] == ["p", "q", "sum"]
    assert abs(float(lines[2][1]) - 9.0 / 13.0) < 0.02
    assert abs(float(lines[3][3]) - 4.0 / 13.0) < 0.02
    assert ["of 255 base points; 95 % intervals: rough (bootstrap)"] in lines
    assert lines[-1][0].startswith("omitted: 1 base point with a member that failed")
    assert lines[-1][0].endswith(": 4; the indices are biased if this depends on the parameters")
    assert "Sobol indices of 'z': expected a metric that depends on the parameters" in captured.err
    print_sobol(results, as_json=True)
    assert list(json.loads(capsys.readouterr().out)) == ["y"]
    with pytest.raises(UsageError, match=r"'z': .*same value"):
        print_sobol(results, ["z"])
    with pytest.raises(UsageError, match=r"'saltelli'"):
        print_sobol(tolerances()[1])


@pytest.mark.parametrize(("points", "has_intervals"), [(256, True), (32, False)])
def test_one_parameter_alone_explains_all_of_a_metric(points, has_intervals, capsys):
    """Both of its indices are 1, whatever the function; few base points have no intervals."""
    p = stats.qmc.Sobol(2, rng=np.random.default_rng(0)).random(points)
    values = np.concatenate([p[:, 0], p[:, 1], p[:, 1]])  # A, B, and A with the parameter of B
    study = MadeStudy({"p": values, "y": np.exp(values)}, ("p",), ("y",))
    layout = StudyLayout("saltelli", samples=3 * points, parameters=("p",))
    print_sobol(results_of_study(study, layout))
    lines = printed(capsys)
    (row,) = [line for line in lines if line[0] == "p"]
    # means over Sobol points are those of the integrals, but for some 1 / points
    assert [float(row[1]), float(row[3])] == pytest.approx([1.0, 1.0], abs=2.0 / points)
    assert sum(" to " in cell for cell in row) == (2 if has_intervals else 0)
    basis = "rough (bootstrap)" if has_intervals else "none (too few)"
    assert [f"of {points} base points; 95 % intervals: {basis}"] in lines


@pytest.mark.parametrize(
    ("value", "half_width", "text"),
    [
        (0.12345678, 0.0012, "0.1235 ± 0.0012"),
        (1234.5678, 0.01, "1234.568 ± 0.010"),
        (5.0, 300.0, "5 ± 300"),
        (123456.7, 4321.0, "123457 ± 4321"),
        (5.0, 3e6, "(0.0 ± 3.0)e+06"),
        (2.35156e10, 1.6e9, "(2.35 ± 0.16)e+10"),
        (-1.5e-12, 3e-12, "(-1.5 ± 3.0)e-12"),
        (0.0, 0.25, "0.00 ± 0.25"),
        (1.5e-12, 3e-13, "(1.50 ± 0.30)e-12"),
        (3.25, 0.0, "3.25"),
    ],
)
def test_a_number_has_as_many_digits_as_are_known(value, half_width, text):
    """As far as the second digit of its half-width."""
    interval = ConfidenceInterval(value - half_width, value + half_width)
    assert text_with_half_width(value, interval) == text


def test_an_interval_names_the_end_that_it_does_not_have():
    """Of few members a quantile has one end, or none."""
    assert interval_text(ConfidenceInterval(None, None)) == ""
    assert interval_text(ConfidenceInterval(0.5, 1.0)) == "0.5 to 1"
    assert interval_text(ConfidenceInterval(None, 1.0)).startswith(
        "to 1; too few members for the l"
    )
    assert interval_text(ConfidenceInterval(0.5, None)).startswith(
        "from 0.5; too few members for t"
    )
    assert members_text(np.arange(5)) == "0, 1, 2, 3, 4"
    assert members_text(np.arange(6)) == "0, 1, 2, 3, 4, and 1 more"


def test_groups_of_few_members_are_said_to_have_rough_means(capsys):
    """Five seeds at each of two rates."""
    numbers = np.arange(10)
    columns = {"rate": np.array([10.0, 100.0])[numbers % 2], "y": np.sqrt(numbers)}
    study = MadeStudy(columns, ("rate",), ("y",))
    print_groups(results_of_study(study, StudyLayout("grid", seeds=5, grid=2)), "rate")
    assert printed(capsys)[-1] == [
        "± may be too small for groups of few members or with skewed values"
    ]


def seeded_grid():
    """Return 3 rates with 20 seeds each; of the largest rate every second member fails."""
    numbers = np.arange(60)
    rates = np.array([10.0, 100.0, 1000.0])[numbers % 3]
    values = rates + np.random.default_rng(2).normal(size=60)
    status = np.where((rates > 500.0) & (numbers % 2 == 0), "failed", "complete")
    columns = {"rate": rates, "plant": ["b.fmu", "a.fmu", "a.fmu"] * 20, "y": values}
    study = MadeStudy({**columns, "status": list(status)}, ("rate", "plant"), ("y",))
    return results_of_study(study, StudyLayout("grid", seeds=20, grid=3))


def test_each_value_of_a_key_has_statistics(capsys):
    """Of its members: the interval of 20 seeds at one rate is Student's."""
    results = seeded_grid()
    print_groups(results, "rate")
    lines = printed(capsys)
    assert lines[0] == ["y"]
    assert [line[0] for line in lines[2:5]] == ["10.0", "100.0", "1000.0"]
    assert [line[1:3] for line in lines[2:5]] == [["20", ""], ["20", ""], ["10", "10"]]
    values = results.columns.metric("y").values
    first = values[values < 50.0]
    half_width = stats.t.ppf(0.975, 19) * first.std(ddof=1) / np.sqrt(20)
    assert lines[2][3] == f"{first.mean():.2f} ± {half_width:.2f}"
    assert lines[5] == ["±, 95 % intervals: 20 seeds drawn independently"]
    assert len(lines) == 6
    print_groups(results, "plant", ["y"], as_json=True)
    content = json.loads(capsys.readouterr().out)
    assert [group["value"] for group in content["groups"]] == ["b.fmu", "a.fmu"]
    assert content["groups"][1]["failed"] == 10
    assert content["groups"][0]["statistics"]["y"]["mean"] == pytest.approx(first.mean())


@pytest.mark.parametrize(
    ("key", "metrics", "message"),
    [
        ("rat", (), r"the study does not vary 'rat'; did you mean 'rate'"),
        ("rate", ("z",), r"the study has no metric 'z'; .*: y"),
    ],
)
def test_groups_of_what_is_not_there_are_an_error(key, metrics, message):
    """Found before anything is printed."""
    with pytest.raises(UsageError, match=message):
        print_groups(seeded_grid(), key, metrics)


def test_a_key_of_very_many_values_has_no_groups():
    """One that is drawn from a continuous distribution."""
    with pytest.raises(UsageError, match=r"'plant.mass': .*at most 200 values.*got 300"):
        print_groups(tolerances(300)[1], "plant.mass")


def test_members_that_warn_are_counted_by_warning(capsys):
    """Warnings that differ in numbers only are one; the example is that of the first member."""
    texts = ["", "pump: too slow at 3 s", "pump: too slow at 4 s\nvalve: leaks", ""]
    study = MadeStudy({"warnings": texts, "rms": [1.0, 2.0, 3.0, 4.0]}, (), ("rms",))
    results = results_of_study(study, StudyLayout("random", samples=4))
    print_study(results, command_of)
    lines = printed(capsys)
    assert ["2 of 4 members warn, such as 1: pump: too slow at 3 s"] in lines
    assert ["1 of 4 members warns, 2: valve: leaks"] in lines
    print_study(results, command_of, as_json=True)
    (first, second) = json.loads(capsys.readouterr().out)["warnings"]
    assert (first["count"], second["first_members"]) == (2, [2])
