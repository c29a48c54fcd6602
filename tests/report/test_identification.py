"""`cosim identify`: its table, its JSON, its pictures and what it refuses."""

from __future__ import annotations

import json
import re
from statistics import NormalDist

import numpy as np
import pytest

import cosim
from cosim.report.estimators import IF_WRONG
from cosim.report.plots import identification
from cosim.report.plots.runs import Curve, estimate_curves
from cosim.report.summary import summarize
from cosim.report.tables.identification import report_identification
from cosim.scenario.record import IDENTIFICATION
from cosim.scenario.running.identifying import identifier_record, identify_records

FAST = {"scenario.step": 0.02, "observer.filter_rate": 50.0}


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Return the logs of runs of one plant, the last with another theta."""
    folder = tmp_path_factory.mktemp("logs")
    terms = [
        {"alpha": "1.35 + 0.25*sin(1.7*t)", "family": "exponential", "theta": -0.1},
        {"alpha": "1.10 + 0.20*cos(2.3*t)", "family": "exponential", "theta": -0.4},
    ]
    changes = {
        "first": {},
        "second": {"sensor.seed": 2, "plant.x_a0": [0.0, 2.0]},
        "other": {"sensor.seed": 3, "delta.terms": terms},
    }
    return {
        name: cosim.run("academic-noisy", out=folder / f"{name}.mcap", set={**FAST, **change})
        for name, change in changes.items()
    }


def rows(output):
    """Return the cells of a table in a pipe by the first one."""
    lines = [line.split("\t") for line in output.splitlines()]
    return {line[0]: line[1:] for line in lines if len(line) > 1}


@pytest.mark.slow
def test_the_table_shows_what_was_recorded(logs, call):
    """Estimate, standard error, interval, verdict, correlation, noise and tests."""
    code, output, _ = call("identify", logs["first"].path)
    assert code == 0
    recorded = logs["first"].results[IDENTIFICATION]["identifier"]
    shown = rows(output)
    undetected = summarize(logs["first"]).identifications[0].undetected
    assert list(undetected) == [error["text"] for error in recorded["undetected"]]
    assert shown[IF_WRONG] == [undetected[-1]]
    for found in (*recorded["parameters"], *recorded["amplitudes"][0]):
        value, error, interval, verdict = shown[found["name"]]
        assert float(value) == pytest.approx(found["value"], rel=1e-5)
        assert float(error) == pytest.approx(found["standard_error"], rel=0.05)
        ends = tuple(map(float, interval.split(" to ")))
        assert ends == pytest.approx((found["lower"], found["upper"]), rel=1e-5)
        assert verdict == "IDENTIFIABLE"
    assert shown["IDENTIFIABLE"] == [recorded["parameters"][0]["reason"]]
    pair, correlation = shown["correlation"][0].split(": ")
    assert pair == "theta[0], theta[1]"
    assert float(correlation) == pytest.approx(recorded["correlation"][0][1], abs=1e-3)
    assert float(shown["noise of y"][0].split(",")[0]) == pytest.approx(1e-3, rel=0.1)
    assert shown["whiteness"][1:] == ["55.1", "passed"]
    assert shown[str(logs["first"].path)][0].startswith("2001 samples; x(0) ")
    for amplitude in recorded["amplitudes"][0]:  # 1 in the scenario
        assert amplitude["value"] == pytest.approx(1.0, abs=4.0 * amplitude["standard_error"])
    assert shown["terms of delta"] == ["amplitude[0] exp(theta[0] t); amplitude[1] exp(theta[1] t)"]


@pytest.mark.slow
def test_amplitude_rate_and_phase_of_a_sine_are_those_of_the_scenario(call):
    """In the table of the run and in the JSON of its log, at t = 0 though it starts at 2 s.

    An exponential that is not there has no number, beside a sine that has all three.
    """
    alpha = "1.35 + 0.25*sin(1.7*t)"
    term = {"alpha": alpha, "family": "sine", "theta": 1.1, "amplitude": 0.7, "phase": 0.4}
    known = [{"alpha": alpha, "family": "sine"}, {"alpha": "1.0", "family": "exponential"}]
    changes = {
        **FAST,
        "scenario.start_time": 2.0,
        "delta.terms": [term],
        "regressor.terms": known,
        "regressor.delays": [0.4, 0.8, 1.2, 1.6],
    }
    options = []
    for key, value in changes.items():
        toml = json.dumps(value).replace(": ", " = ")
        options += ["--set", f"{key}={toml}"]
    shown = rows(call("run", "academic-noisy", "--out", "log.mcap", *options)[1])
    for name, true in (("amplitude[0]", 0.7), ("phase[0]", 0.4)):
        value = float(shown[name][0])
        half_width = float(shown[name][1].removeprefix("± "))
        assert abs(value - true) < 2.0 * half_width < 0.02
    assert shown["phase[0]"][-1] == "IDENTIFIABLE"
    assert "phase[0] in rad at t = 0" in shown["terms of delta"][0]
    assert shown["amplitude[1]"][0] == "no value"
    (log,) = json.loads(call("identify", "log.mcap", "--json")[1])["logs"]
    found = {one["name"]: (one["value"], one["standard_error"]) for one in log["amplitudes"]}
    assert list(found) == ["amplitude[0]", "phase[0]", "amplitude[1]"]
    assert found["phase[0]"][0] == pytest.approx(float(shown["phase[0]"][0]), rel=1e-5)
    assert 0.0 < found["phase[0]"][1] < 0.01
    assert found["amplitude[1]"] == (None, None)


@pytest.mark.slow
def test_several_logs_and_one_to_validate(logs, call):
    """Each log has its own amplitudes, x(0) and tests; the JSON has the numbers of the table."""
    first, second = logs["first"].path, logs["second"].path
    code, output, _ = call("identify", first, "--validate", second, "--json")
    assert code == 0
    content = json.loads(output)
    assert content["contradictions"] == []
    (validation,) = content["validation"]
    assert validation["verdict"] == "HOLDS"
    assert validation["ratio"] == pytest.approx(1.0, abs=0.1)
    assert [test["passed"] for test in validation["tests"]] == [True] * 4
    both = json.loads(call("identify", first, second, "--json")[1])
    errors = [found["parameters"][0]["standard_error"] for found in (both, content)]
    assert errors[0] < 0.8 * errors[1]
    assert [log["log"] for log in both["logs"]] == [str(first), str(second)]
    np.testing.assert_allclose(both["logs"][1]["x0"], [0.0, 2.0], atol=5e-3)
    assert len(both["tests"]) == 6


def test_a_theta_that_does_not_hold_is_said_and_exits_with_1(logs, call):
    """With the theta of the other data, and how much larger the residual is."""
    code, output, _ = call("identify", logs["first"].path, "--validate", logs["other"].path)
    assert code == 1
    shown = rows(output)
    assert {"theta[0]", "theta[1]", "amplitude[0]", "amplitude[1]"} <= shown.keys()
    assert f"validation {logs['other'].path}" in output.splitlines()
    text = shown["FAILS"][0]
    assert text.startswith("theta[0] is ")
    there, fitted = re.search(r"theta\[1\] is (\S+) \+- \S+ there, (\S+) \+- ", text).groups()
    assert (float(there), float(fitted)) == pytest.approx((-0.4, -0.3), abs=2e-3)
    ratio = float(re.search(r", ([\d.]+) times", shown["residual"][0])[1])
    assert ratio > 1.2


def test_options_reach_the_fit(logs, call):
    """An offset is another unknown; equal bounds fix a theta, which then has no error."""
    log = logs["first"].path
    plain = json.loads(call("identify", log, "--json")[1])
    offset = json.loads(call("identify", log, "--offset", "--json")[1])
    assert offset["degrees_of_freedom"] == plain["degrees_of_freedom"] - 1
    assert len(offset["logs"][0]["offset"]) == 1
    bounds = "[[-inf,inf],[-0.3,-0.3]]"
    fixed = json.loads(call("identify", log, "--bounds", bounds, "--json")[1])
    assert fixed["parameters"][1]["value"] == -0.3
    assert fixed["parameters"][1]["standard_error"] is None
    assert fixed["parameters"][0]["standard_error"] < plain["parameters"][0]["standard_error"]


@pytest.mark.slow
def test_an_irregular_part_has_guaranteed_intervals(logs):
    """They contain the truth; the cost is said, and where the first order does not hold."""
    found = identify_records([identifier_record(logs["first"])])
    report = report_identification(found, irregular=2e-3)
    part = report.irregular
    for effect, true in zip(part.effects, (-0.1, -0.3), strict=True):
        assert effect.lower <= true <= effect.upper
        assert effect.holds
        assert effect.upper - effect.lower < 3.0 * effect.first_order
    assert report.seconds > 0.0
    assert part.confidence == 0.999


@pytest.mark.campaign
def test_a_large_irregular_part_is_beyond_the_first_order(logs, call):
    """It says so, and the linear programs give the interval."""
    _, output, errors = call("identify", logs["first"].path, "--irregular", "0.02")
    assert "linear programs, which take seconds to minutes" in errors
    lines = output.splitlines()
    found = lines[
        next(i for i, line in enumerate(lines) if line.startswith("|delta_0| <= 0.02")) + 2
    ]
    label, low, high, reach = re.fullmatch(r"(\S+)\t(\S+) to ([^;]+); (.*)", found).groups()
    assert label == "theta[1]"
    assert float(low) < -0.3 < float(high)
    assert "which does not hold for so large a bound" in reach


@pytest.mark.slow
def test_logs_of_different_theta_are_told_apart(logs, call):
    """Together they leave a residual that is not noise's; each is explained alone.

    Of each the estimate is said, with its log, in table and JSON.
    """
    paths = [logs["first"].path, logs["other"].path]
    _, output, _ = call("identify", *paths)
    shown = rows(output)
    assert shown["theta[1]"][3] == "INCONSISTENT"
    assert "noise does not explain the residual" in shown["INCONSISTENT"][0]
    text = shown["contradiction"][0]
    for path in paths:
        assert f"{path} alone" in text
    assert "theta[1]" in text
    assert "not of one theta" in text
    content = json.loads(call("identify", "--json", *paths)[1])
    assert text in content["contradictions"]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--bounds", "[[-1,0]]"), r"bounds: .*2 parameters"),
        (("--bounds", "[[-1,0],[nan,1]]"), r"bounds of theta\[1\]: .*\[nan, 1\]"),
        (("--bounds", "[[-1,0],[true,1]]"), r"bounds of theta\[1\]: .*\[True, 1\]"),
        (("--bounds", f"[[-1,0],[1,{10**400}]]"), r"bounds of theta\[1\]: .*\[1, 1000"),
        (("--bounds", "[[-1,0],[inf,inf]]"), r"bounds of theta\[1\]: .*\[inf, inf\]"),
        (("--bounds", "wide"), "bounds: .*wide"),
        (("--irregular", "-1"), "--irregular: .*-1"),
        (("--irregular", "nan"), "--irregular: .*nan"),
        (("--component", "observer"), "no identifier 'observer' with a model of y"),
        (("--irregular", "1", "--bounds", "[[-1,0],[-0.3,-0.3]]"), r"theta\[1\] was not estimated"),
        (("--plot", "a.txt"), r"a\.txt: .*'\.txt'"),
    ],
)
def test_wrong_use_is_refused(logs, call, options, text):
    """Before anything is printed."""
    code, output, errors = call("identify", logs["first"].path, *options)
    assert (code, output) == (2, "")
    assert re.search(text, errors)


@pytest.mark.parametrize("option", [(), ("--validate",)])
def test_no_data_count_twice(logs, call, option, tmp_path):
    """Neither in the fit nor in its validation: a copy of a log has the same rows."""
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(logs["first"].path.read_bytes())
    code, _, errors = call("identify", logs["first"].path, *option, copy)
    assert code == 2
    assert "copy.mcap has the rows of" in errors


@pytest.mark.slow
def test_the_picture_shows_residual_spectrum_disturbance_and_theta(logs, call, tmp_path):
    """With axes, units of time and frequency; of several logs each has its panels."""
    pytest.importorskip("matplotlib")
    call("identify", logs["first"].path, logs["second"].path, "--plot", tmp_path / "a.svg")
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", (tmp_path / "a.svg").read_text("utf-8"))
    assert texts.count("residual of y") == 2
    assert texts.count("frequency [Hz]") == 2
    assert texts.count("error of delta") == 2
    assert texts.count("error of identifier.theta[1]") == 2
    assert f"{logs['second'].path}: residual" in texts


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bounds", "verdict", "band", "title"),
    [
        (None, "IDENTIFIABLE", True, "its error, and 95 % band"),
        ({1: (-0.5, -0.5)}, "INCONSISTENT", False, "its error; no 95 % band: theta[0] is {}"),
    ],
)
def test_a_band_is_drawn_where_it_holds(logs, tmp_path, monkeypatch, bounds, verdict, band, title):
    """Where noise does not explain the residual, the titles say why there is none."""
    pytest.importorskip("matplotlib")
    draw = Curve.draw
    bands = {}

    def keep(curve, panel, style, *, label=None):
        draw(curve, panel, style, label=label)
        bands[curve.name] = curve.band is not None

    monkeypatch.setattr(Curve, "draw", keep)
    found = identify_records([identifier_record(logs["first"])], bounds=bounds)
    assert {one.verdict for one in found.assessment.parameters} == {verdict}
    identification.plot_identification(found, tmp_path / "a.svg")
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", (tmp_path / "a.svg").read_text("utf-8"))
    assert (bands["delta"], bands["error of delta"]) == (band, band)
    assert title.format(verdict) in texts
    assert texts.count(f"no 95 % band: theta[0] is {verdict}") == (not band)


def test_an_exact_residual_is_within_the_errors_that_are_named(tmp_path, call):
    """It is at most as many times larger than its errors as the text says, with both numbers."""
    log = cosim.run("academic-noisy", out=tmp_path / "a.mcap", set={**FAST, "sensor.noise": 0.0})
    recorded = log.results[IDENTIFICATION]["identifier"]
    assert recorded["is_exact"]
    (text,) = rows(call("identify", log.path)[1])["noise of y"]
    numbers = re.search(r"(\S+): .* at most ([\d.]+) times what .* allow, (\S+)", text).groups()
    deviation, factor, allowed = map(float, numbers)
    assert deviation <= factor * allowed
    assert allowed == pytest.approx(recorded["accuracy"][0], rel=0.01)


@pytest.mark.slow
def test_titles_are_those_of_what_is_drawn(logs, tmp_path, monkeypatch):
    """Without a truth there is no gray line, and the half width takes the place of the error."""
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("cosim.report.plots.runs.truth_of", lambda log: {})
    found = identify_records([identifier_record(logs["first"])])
    identification.plot_identification(found, tmp_path / "a.svg")
    text = (tmp_path / "a.svg").read_text("utf-8")
    assert "gray: truth" not in text
    assert "its error" not in text
    assert text.count("half width of its 95 % band") == 2


def test_the_band_of_theta_is_that_of_its_standard_error(logs):
    """The standard picture draws it around theta; other estimates have none."""
    curves = estimate_curves(logs["first"], "identifier.theta")
    recorded = logs["first"]["identifier.standard_error"]
    for curve, error in zip(curves, recorded.T, strict=True):
        expected = NormalDist().inv_cdf(0.975) * error
        np.testing.assert_allclose(curve.band, expected, rtol=1e-12)
    (delta,) = estimate_curves(logs["first"], "observer.delta")
    assert delta.band is None
