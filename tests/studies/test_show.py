"""What studies print: every figure is that of numpy, and nothing is dropped silently."""

import json
from dataclasses import replace

import numpy as np
import pyarrow
import pytest
from scipy import stats

import cosim
from cosim.cli.app import main
from cosim.errors import UsageError, shell_language
from cosim.studies.layout import StudyLayout
from cosim.studies.show import ShownParts, show_study, text_with_half_width, tuning_lines
from cosim.studies.statistics import ConfidenceInterval
from tests.studies.made import MadeStudy, command_of, saltelli, tolerances
from tests.studies.test_standard_errors import LINE, T, fitted, line

TEN = StudyLayout("random", samples=10)


@pytest.fixture
def shown(capsys):
    """Return the cells of the lines that a study prints, or its JSON."""

    def function(study, layout, **parts):
        show_study(study, layout, command_of, ShownParts(**parts))
        out = capsys.readouterr().out
        if parts.get("as_json"):
            return json.loads(out)
        return [text.split("\t") for text in out.splitlines()]

    return function


def row_of(lines, head):
    (row,) = [cells for cells in lines if cells[0] == head]
    return row


def with_half_width(values, digits):
    """Return the mean of values with Student's interval."""
    half_width = stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)
    return f"{values.mean():.{digits}f} ± {half_width:.{digits}f}"


def test_a_study_prints_statistics_failures_and_the_worst_members(shown):
    """Against numpy; members that are missing, failed or have no value are named."""
    study, results = tolerances()
    lines = shown(study, results.layout, conditions=("rms < 0.1",))
    (first,), (times,) = lines[:2]
    assert "200 of 210 members done, 10 missing (200, 201, 202, 203, 204, and 5 more)" in first
    assert first.endswith(" 3 failed")
    assert "median 0.25 s" in times
    rms = study.table(["rms"])["rms"].to_numpy()
    kept = rms[~np.isnan(rms)]
    figures = (kept.std(ddof=1), *np.quantile(kept, [0.05, 0.5, 0.95]))
    texts = [f"{value:.4g}" for value in figures]
    assert lines[4] == ["rms", "197", with_half_width(kept, 3), *texts]
    assert ["settling: no value in 4 members: 5, 55, 105, 155"] in lines
    passed = int((kept < 0.1).sum())
    assert [f"verdict: {passed} identifiable; {197 - passed} weak"] in lines
    share = row_of(lines, "rms < 0.1")
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


def test_json_has_all_of_it(shown):
    """With every interval, as strict JSON."""
    study, results = tolerances()
    content = shown(study, results.layout, conditions=("settling < 0.85",), as_json=True)
    assert content["members"] == {"planned": 210, "done": 200, "failed": 3, "missing": 10}
    assert content["design"]["kind"] == "random"
    assert content["statistics"]["settling"]["without_value"] == 4
    assert len(content["statistics"]["rms"]["quantiles"][0]["interval"]) == 2
    assert content["passed"][0]["without_value"] == 4
    assert content["failures"][0]["first_members"] == [3, 17]
    assert content["failures"][0]["command"] == command_of(3)
    assert content["ended_early"][0]["first_members"] == [60]
    assert len(content["worst"]["rms"]) == 3
    assert {one["parameter"] for one in content["correlations"]} == set(results.layout.parameters)


def test_what_a_few_members_do_not_show_is_said(shown):
    """No correlation, and rough intervals; texts beyond the five most frequent are counted."""
    texts = ["v0", *(f"v{k}" for k in range(7))]
    columns = {"p": np.arange(8.0), "y": np.arange(8.0), "verdict": texts}
    study = MadeStudy(columns, ("p",), ("y", "verdict"))
    for parts in ({}, {"metrics": ("y",)}):
        lines = [cells[0] for cells in shown(study, TEN, **parts)]
        assert "rank correlations: none for fewer than 10 members" in lines
        assert any(text.endswith("(few members or skewed values): y") for text in lines)
    (texts,) = [cells[0] for cells in shown(study, TEN) if cells[0].startswith("verdict: ")]
    assert texts == "verdict: 2 v0; 1 v1; 1 v2; 1 v3; 1 v4; and 2 other texts"


def test_members_that_hung_do_not_change_how_long_one_takes(shown):
    """Six of ten were ended after a minute; where all failed, or none is done, there are others."""
    failed = np.arange(10) < 6
    columns = {
        "y": pyarrow.array(np.arange(10.0), mask=failed),
        "status": list(np.where(failed, "failed", "complete")),
        "wall_time": np.where(failed, 60.0, 0.5),
    }
    study = MadeStudy(columns, (), ("y",))
    (text,) = shown(study, TEN)[1]
    assert "median 0.5 s per member; at most 60 s per failed member" in text
    assert shown(study, TEN, as_json=True)["median_wall_time"] == 0.5
    columns = {"rms": np.full(4, np.nan), "status": ["failed"] * 4, "reason": ["crashed"] * 4}
    lines = shown(MadeStudy(columns, (), ("rms",)), StudyLayout("grid", grid=4))
    assert ["4", "0, 1, 2, 3", "crashed"] in lines
    none = MadeStudy({"rms": np.zeros(0)}, (), ("rms",), planned=3)
    (text,) = shown(none, TEN, conditions=("rms < 1",))[0]
    assert text.endswith("0 of 3 members done, 3 missing (0, 1, 2), none failed")


def test_members_that_warn_are_counted_by_warning(shown):
    """Warnings that differ in numbers only are one; the example is that of the first member."""
    texts = ["", "pump: too slow at 3 s", "pump: too slow at 4 s\nvalve: leaks", ""]
    study = MadeStudy({"warnings": texts, "rms": [1.0, 2.0, 3.0, 4.0]}, (), ("rms",))
    assert ["2 of 4 members warn, such as 1: pump: too slow at 3 s"] in shown(study, TEN)
    first, second = shown(study, TEN, as_json=True)["warnings"]
    assert (first["count"], second["first_members"]) == (2, [2])


def test_a_metric_is_printed_with_all_intervals(shown):
    """And who has the largest values."""
    study, results = tolerances()
    lines = shown(study, results.layout, metrics=("settling",))
    values = study.table(["settling"])["settling"].to_numpy()
    kept = values[~np.isnan(values)]
    ends = stats.quantile_test(kept, p=0.05).confidence_interval(0.95)
    figures = [f"{np.quantile(kept, 0.05):.6g}", f"{ends.low:.4g} to {ends.high:.4g}"]
    rows = [["settling [s]"], ["failed", "3"], ["no value", "4"], ["5 %", *figures]]
    rows += [["settling: no value in 4 members: 5, 55, 105, 155"]]
    assert all(row in lines for row in rows)
    content = shown(study, results.layout, metrics=("settling",), as_json=True)["settling"]
    assert content["largest"][0] == np.nanargmax(values)
    assert content["smallest"][0] == np.nanargmin(values)


def test_the_extremes_of_a_metric_are_those_of_the_members_beside_them(shown):
    """Of all members: also of those that no statistics are of, and of infinite ones."""
    values = np.arange(64.0)
    values[[40, 50]] = -7.0, np.inf
    study = MadeStudy({"y": values}, (), ("y",))
    lines = shown(study, StudyLayout("saltelli", samples=64, parameters=("p", "q")), metrics=("y",))
    assert ["smallest", "-7", "members 40, 0, 1, 2, 3"] in lines
    assert ["largest", "inf", "members 50, 63, 62, 61, 60"] in lines


def test_one_member_is_printed_with_its_command(shown):
    """Parameters, metrics, how it ended."""
    study, results = tolerances()
    failed, complete = study.table(members=[3, 8]).to_pylist()
    lines = shown(study, results.layout, member=3)
    assert lines[0] == [f"member 3: failed: {failed['reason']}"]
    rows = [["plant.mass [kg]", str(failed["plant.mass"])], ["settling [s]", "no value"]]
    assert all(row in lines for row in [*rows, ["steps", "1000"]])
    assert lines[-1] == [f"alone: {command_of(3)}"]
    content = shown(study, results.layout, member=8, as_json=True)
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
    lines = shown(study, layout, by="rate")
    assert lines[0] == ["y"]
    rows = [["10.0", "20", ""], ["100.0", "20", ""], ["1000.0", "10", "10"]]
    assert [cells[:3] for cells in lines[2:5]] == rows
    assert lines[2][3] == with_half_width(values[::3], 2)
    assert lines[5:] == [["±, 95 % intervals: 20 seeds drawn independently"]]
    content = shown(study, layout, by="plant", metrics=("y",), as_json=True)
    assert [group["value"] for group in content["groups"]] == ["b.fmu", "a.fmu"]
    assert content["groups"][1]["failed"] == 10
    assert content["groups"][0]["statistics"]["y"]["mean"] == pytest.approx(values[::3].mean())


def test_sobol_indices_are_printed(capsys):
    """The largest first, with what was left out; a metric without any says why."""
    show_study(*saltelli(), command_of, ShownParts(sobol=True))
    captured = capsys.readouterr()
    lines = [text.split("\t") for text in captured.out.splitlines()]
    assert lines[0] == ["Sobol indices of y"]
    assert [cells[0] for cells in lines[2:5]] == ["p", "q", "sum"]
    assert abs(float(lines[2][1]) - 9.0 / 13.0) < 0.02
    assert abs(float(lines[3][3]) - 4.0 / 13.0) < 0.02
    assert sum(" to " in cell for cell in lines[2]) == 2
    assert ["of 255 base points; 95 % intervals: rough (bootstrap)"] in lines
    assert "omitted: 1 base point" in lines[-1][0]
    assert ": 4; " in lines[-1][0]
    assert "'z'" in captured.err


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"metrics": ("rms", "settlin")}, r"'settlin'; did you mean 'settling'"),
        ({"conditions": ("rsm < 1",)}, r"'rsm'; did you mean 'rms'"),
        ({"by": "plant.mas"}, r"'plant.mas'; did you mean 'plant.mass'"),
        ({"by": "plant.mass"}, r"'plant.mass': .*at most 200 values.*got 201"),
        ({"by": "plant.mass", "metrics": ("z",)}, r"'z'"),
        ({"sobol": True}, r"'saltelli'.*'random'"),
        ({"worst": -1}, r"--worst: .*0 or more, got -1"),
        ({"member": 1, "sobol": True}, r"--member and --sobol"),
        ({"member": 1, "metrics": ("a",)}, r"--member and --metric"),
        ({"conditions": ("a < 1",), "sobol": True}, r"--pass and --sobol"),
        ({"by": "a", "sobol": True}, r"--by and --sobol"),
    ],
)
def test_what_is_not_there_or_does_not_go_together_is_an_error(parts, message, capsys):
    """Found before anything is printed."""
    study, results = tolerances(201)
    with shell_language(), pytest.raises(UsageError, match=message):
        show_study(study, results.layout, command_of, ShownParts(**parts))
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("value", "half_width", "text"),
    [
        (0.12345678, 0.0012, "0.1235 ± 0.0012"),
        (1234.5678, 0.01, "1234.568 ± 0.010"),
        (5.0, 300.0, "5 ± 300"),
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


def test_a_study_that_ran_is_shown_as_python_has_it(tmp_path, capsys):
    """From its file to its tables; of the layout that the dataset has; no member that is not."""
    study = cosim.study(
        "academic",
        vary={"observer.filter_rate": {"uniform": [100.0, 500.0]}},
        samples=12,
        metrics={"error": "rms(observer.delta - delta.y)"},
        set={"scenario.stop": 0.02},
        out=str(tmp_path / "data"),
        workers=1,
    )

    def run(*options):
        with pytest.raises(SystemExit) as ended:
            main(["study", "show", str(tmp_path / "data"), *options])
        return ended.value.code, *capsys.readouterr()

    content = json.loads(run("--json")[1])
    frame = study.to_pandas()
    assert content["statistics"]["error"]["mean"] == pytest.approx(frame["error"].mean())
    expected = stats.spearmanr(frame["observer.filter_rate"], frame["error"]).statistic
    assert content["correlations"][0]["value"] == pytest.approx(expected)
    assert json.loads(run("--member", "4", "--json")[1])["error"] == frame["error"][4]
    for number in ("12", "-1"):
        code, out, err = run("--member", number)
        assert (code, out) == (2, "")
        assert f"member {number}; available: 12 of 12 members, numbered from 0" in err
