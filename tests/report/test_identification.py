"""`cosim identify`: its table, its JSON and what it refuses."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

import cosim
from cosim.report.estimators import IF_WRONG
from cosim.report.summary import summarize
from cosim.scenario.record import IDENTIFICATION

FAST = {"scenario.step": 0.02, "observer.filter_rate": 50.0}


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Return the paths of logs of one plant, the last with another theta."""
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
    paths = {}
    for name, change in changes.items():
        paths[name] = folder / f"{name}.mcap"
        cosim.run("academic-noisy", out=paths[name], set={**FAST, **change})
    return paths


@pytest.fixture
def identify(logs, call):
    """Identify from the first log and what follows; return the exit code, and the JSON if asked."""

    def identify(*arguments):
        code, output, errors = call("identify", logs["first"], *arguments)
        assert not errors
        return code, json.loads(output) if "--json" in arguments else output

    return identify


def rows(output):
    """Return the cells of a table in a pipe by the first one."""
    lines = [line.split("\t") for line in output.splitlines()]
    return {line[0]: line[1:] for line in lines if len(line) > 1}


# --- tables ---


def test_the_table_shows_what_was_recorded(logs, identify):
    """Estimate, standard error, interval, verdict, correlation, noise and tests."""
    shown = rows(identify()[1])
    log = cosim.open_log(logs["first"])
    recorded = log.results[IDENTIFICATION]["identifier"]
    assert shown[IF_WRONG] == [summarize(log).identifications[0].undetected[-1]]
    for found in (*recorded["parameters"], *recorded["amplitudes"][0]):
        value, error, interval, verdict = shown[found["name"]]
        assert float(value) == pytest.approx(found["value"], rel=1e-5)
        assert float(error) == pytest.approx(found["standard_error"], rel=0.05)
        ends = tuple(map(float, interval.split(" to ")))
        assert ends == pytest.approx((found["lower"], found["upper"]), rel=1e-5)
        assert verdict == "IDENTIFIABLE"
    pair, correlation = shown["correlation"][0].split(": ")
    assert pair == "theta[0], theta[1]"
    assert float(correlation) == pytest.approx(recorded["correlation"][0][1], abs=1e-3)
    assert float(shown["noise of y"][0].split(",")[0]) == pytest.approx(1e-3, rel=0.1)
    assert shown["whiteness"][2] == "passed"
    for amplitude in recorded["amplitudes"][0]:  # 1 in the scenario
        assert amplitude["value"] == pytest.approx(1.0, abs=4.0 * amplitude["standard_error"])


@pytest.mark.slow
def test_amplitude_rate_and_phase_of_a_sine_are_those_of_the_scenario(call):
    """In the table of the run and in the JSON of its log, at t = 0 though it starts at 2 s.

    An exponential that is not there has no number, beside a sine that has all three.
    """
    alpha = "1.35 + 0.25*sin(1.7*t)"
    sine = {"alpha": alpha, "family": "sine"}
    changes = {
        **FAST,
        "scenario.start_time": 2.0,
        "delta.terms": [{**sine, "theta": 1.1, "amplitude": 0.7, "phase": 0.4}],
        "regressor.terms": [sine, {"alpha": "1.0", "family": "exponential"}],
        "regressor.delays": [0.4, 0.8, 1.2, 1.6],
    }
    edits = [f"{key}={json.dumps(value)}".replace(": ", " = ") for key, value in changes.items()]
    options = [f"--set={edit}" for edit in edits]
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
    assert found["phase[0]"][0] == pytest.approx(float(shown["phase[0]"][0]), rel=1e-5)
    assert found["amplitude[1]"] == (None, None)


def test_several_logs_and_one_to_validate(logs, identify):
    """Each log has its own amplitudes, x(0) and tests; the JSON has the numbers of the table."""
    code, content = identify("--validate", logs["second"], "--json")
    assert (code, content["contradictions"]) == (0, [])
    (validation,) = content["validation"]
    assert validation["verdict"] == "HOLDS"
    assert validation["ratio"] == pytest.approx(1.0, abs=0.1)
    assert [test["passed"] for test in validation["tests"]] == [True] * 4
    _, both = identify(logs["second"], "--json")
    errors = [found["parameters"][0]["standard_error"] for found in (both, content)]
    assert errors[0] < 0.8 * errors[1]
    assert [log["log"] for log in both["logs"]] == [str(logs[name]) for name in ("first", "second")]
    np.testing.assert_allclose(both["logs"][1]["x0"], [0.0, 2.0], atol=5e-3)
    assert len(both["tests"]) == 6


def test_a_theta_that_does_not_hold_is_said_and_exits_with_1(logs, identify):
    """With the theta of the other data, and how much larger the residual is."""
    code, output = identify("--validate", logs["other"])
    shown = rows(output)
    assert code == 1
    assert {"theta[0]", "theta[1]", "amplitude[0]", "amplitude[1]"} <= shown.keys()
    assert f"validation {logs['other']}" in output.splitlines()
    text = shown["FAILS"][0]
    assert text.startswith("theta[0] is ")
    there, fitted = re.search(r"theta\[1\] is (\S+) \+- \S+ there, (\S+) \+- ", text).groups()
    assert (float(there), float(fitted)) == pytest.approx((-0.4, -0.3), abs=2e-3)
    assert float(re.search(r", ([\d.]+) times", shown["residual"][0])[1]) > 1.2


@pytest.mark.slow
def test_logs_of_different_theta_are_told_apart(logs, identify):
    """Together they leave a residual that is not noise's; each is explained alone, with its log."""
    _, output = identify(logs["other"])
    shown = rows(output)
    assert shown["theta[1]"][3] == "INCONSISTENT"
    assert "noise does not explain the residual" in shown["INCONSISTENT"][0]
    text = shown["contradiction"][0]
    for part in (f"{logs['first']} alone", f"{logs['other']} alone", "theta[1]", "not of one"):
        assert part in text
    assert text in identify(logs["other"], "--json")[1]["contradictions"]


def test_options_reach_the_fit(identify):
    """An offset is another unknown; equal bounds fix a theta, which then has no error."""
    bounds = ("--bounds", "[[-inf,inf],[-0.3,-0.3]]")
    plain, offset, fixed = (
        identify("--json", *options)[1] for options in ((), ("--offset",), bounds)
    )
    assert offset["degrees_of_freedom"] == plain["degrees_of_freedom"] - 1
    assert len(offset["logs"][0]["offset"]) == 1
    assert fixed["parameters"][1]["value"] == -0.3
    assert fixed["parameters"][1]["standard_error"] is None
    assert fixed["parameters"][0]["standard_error"] < plain["parameters"][0]["standard_error"]


@pytest.mark.slow
def test_an_irregular_part_has_guaranteed_intervals(identify):
    """They contain the truth; the cost is said, and where the first order does not hold."""
    part = identify("--irregular", "2e-3", "--json")[1]["irregular"]
    for effect, true in zip(part["effects"], (-0.1, -0.3), strict=True):
        assert effect["lower"] <= true <= effect["upper"]
        assert effect["holds"]
        assert effect["upper"] - effect["lower"] < 3.0 * effect["first_order"]
    assert part["seconds"] > 0.0
    assert part["confidence"] == 0.999


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


WRONG = [
    (("--bounds", "[[-1,0]]"), r"bounds: .*2 parameters"),
    (("--bounds", "[[-1,0],[nan,1]]"), r"bounds of theta\[1\]: .*\[nan, 1\]"),
    (("--bounds", "[[-1,0],[true,1]]"), r"bounds of theta\[1\]: .*\[True, 1\]"),
    (("--bounds", f"[[-1,0],[1,{10**400}]]"), r"bounds of theta\[1\]: .*\[1, 1000"),
    (("--bounds", "[[-1,0],[inf,inf]]"), r"bounds of theta\[1\]: .*\[inf, inf\]"),
    (("--irregular", "-1"), "--irregular: .*-1"),
    (("--irregular", "nan"), "--irregular: .*nan"),
    (("--component", "observer"), "no identifier 'observer' with a model of y"),
    (("--irregular", "1", "--bounds", "[[-1,0],[-0.3,-0.3]]"), r"theta\[1\] was not estimated"),
    # no data count twice, and a copy of a log has the same rows
    (("copy.mcap",), "copy.mcap has the rows of"),
    (("--validate", "copy.mcap"), "copy.mcap has the rows of"),
]


def test_wrong_use_is_refused(logs, call, tmp_path, subtests):
    """Before anything is printed."""
    (tmp_path / "copy.mcap").write_bytes(logs["first"].read_bytes())
    for options, text in WRONG:
        with subtests.test(options=options):
            code, output, errors = call("identify", logs["first"], *options)
            assert (code, output) == (2, "")
            assert re.search(text, errors)


# --- pictures ---


def texts(path):
    """Return the texts of an SVG."""
    return re.findall(r"<text[^>]*>([^<]*)</text>", path.read_text("utf-8"))


@pytest.mark.slow
def test_the_picture_shows_residual_disturbance_and_theta(logs, identify, tmp_path):
    """Both estimates beside their truth, with their errors and bands.

    Where the data contradict theta, the disturbance has no band, which is said.
    """
    pytest.importorskip("matplotlib")
    identify("--plot", "a.svg")
    expected = {
        "residual",
        "its spectrum; gray: white noise, 95 %",
        "estimated disturbance; gray: truth",
        "theta during the run; gray: truth",
        "error of identifier.theta[1]",
    }
    shown = texts(tmp_path / "a.svg")
    assert expected <= set(shown)
    assert shown.count("its error, and 95 % band") == 2
    identify(logs["other"], "--plot", "b.svg")
    shown = texts(tmp_path / "b.svg")
    assert shown.count("its error") == 2
    assert {f"{logs['other']}: residual", "no 95 % band: theta[0] is INCONSISTENT"} <= set(shown)
