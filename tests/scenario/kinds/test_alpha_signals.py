"""Alphas of terms that are signals of the scenario."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.arrays import Matrix
from cosim.blocks.regressor import Regressor
from cosim.errors import ScenarioError, UsageError
from cosim.native.estimation.alphas import AlphaSignal
from cosim.native.numerics.expression import compile_expression
from cosim.native.numerics.programs import evaluate_at
from cosim.scenario.building.build import Builder
from cosim.scenario.document.document import find
from cosim.scenario.exporting import export_component
from cosim.scenario.record import recorded_identification, recorded_warnings
from cosim.theory.disturbances.regression import expand
from tests.scenario.refusals import check_refused
from tests.scenario.signals import signals

ALPHAS = ("1.35 + 0.25*sin(1.7*t)", "1.10 + 0.20*cos(2.3*t)")
CURVATURE = 0.25 * 1.7**2  # the largest |alpha''| of the first one; 0.2 2.3^2 of the second
THETA = (-0.1, -0.3)
H = 1.0 / 128.0  # instants and delays are exact, so that alphas are read at the very same ones
RUN = {
    "scenario.step": H,
    "scenario.stop": 8.0,
    "observer.filter_rate": 100.0,
    "regressor.delays": [0.5, 1.0, 1.5],
    "identifier.start": 2.0,
    "identifier.period": 0.25,
}
EXPRESSION = f'[components.schedule]\nkind = "expression"\ny = ["{ALPHAS[0]}", "{ALPHAS[1]}"]\n'
BOTH = ("schedule.y[0]", "schedule.y[1]")


def scenario(
    folder: Path,
    source: str = EXPRESSION,
    names: tuple[str, str] = BOTH,
    connections: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Write the example with alphas that are signals of a component; return its path."""
    text = find("academic").text
    for alpha, name in zip(ALPHAS, names, strict=True):
        text = text.replace(f'"{alpha}"', f'{{ from = "{name}" }}')
    text = text.replace("[connections]", f"{source}\n[connections]", 1)
    lines = [f'"{to}" = "{origin}"' for to, origin in connections.items()]
    text = text.replace("[truth]", "\n".join([*lines, "", "[truth]"]), 1)
    path = folder / "alphas.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def values(t: Any) -> Matrix:
    """Return both alphas at instants."""
    return evaluate_at([compile_expression(alpha) for alpha in ALPHAS], np.asarray(t))


def table(folder: Path) -> str:
    """Write both alphas at the communication points as a CSV file; return a source of it."""
    t = np.arange(round(8.0 / H) + 1) * H
    rows = np.column_stack([t, values(t)])
    lines = ["t,first,second", *(",".join(map(repr, row)) for row in rows.tolist())]
    (folder / "schedule.csv").write_text("\n".join(lines), encoding="utf-8")
    return '[components.schedule]\nkind = "table"\nfile = "schedule.csv"\n'


@pytest.mark.parametrize("method", ["output-error", "least-squares", "augmented-kalman"])
def test_a_signal_gives_the_bits_of_the_text(tmp_path, method):
    """At instants that are communication points exactly an alpha is the same number either way."""
    changes = {**RUN, "identifier.method": method}
    by_signal = signals(scenario(tmp_path), set=changes)
    by_text = signals("academic", set=changes)
    for name in ("delta.y", "regressor.mu", "identifier.theta"):
        np.testing.assert_array_equal(by_signal[name], by_text[name])
    assert np.isfinite(by_signal["identifier.theta"][-1]).any()


@pytest.mark.slow
def test_any_source_will_do(tmp_path):
    """A replay takes a file and a recording from the log; a swap keeps what follows from terms."""
    log = cosim.run(scenario(tmp_path, table(tmp_path)), set=RUN, out=tmp_path / "table.mcap")
    np.testing.assert_allclose(log["identifier.theta"][-1], THETA, atol=1e-6)
    np.testing.assert_array_equal(log["regressor.alpha"], values(log.time("regressor.alpha")))
    assert cosim.diff(log, cosim.replay(log)).equal
    keys = 'kind = "recording", log = "table.mcap", component = "schedule"'
    recorded = signals(scenario(tmp_path, f"[components]\nschedule = {{ {keys} }}\n"), set=RUN)
    np.testing.assert_array_equal(recorded["identifier.theta"], log["identifier.theta"])
    columns = {"schedule.y": ["first", "second"]}
    swap = {"schedule": tmp_path / "schedule.csv"}
    swapped = signals(scenario(tmp_path), set=RUN, swap=swap, map=columns)
    np.testing.assert_allclose(swapped["identifier.theta"][-1], THETA, atol=1e-6)


def test_what_only_the_run_computes_is_checked_at_its_end(tmp_path):
    """That is said before; alphas that prove proportional are named."""
    source = '[components.twice]\nkind = "gain"\nK = 2.0\n'
    path = scenario(tmp_path, source, ("u.y", "twice.y"), {"twice.u": "u.y"})
    changes = {**RUN, "scenario.stop": 4.0, "identifier.method": "least-squares"}
    run = cosim.run(path, set=changes)
    said = [text for name, text in recorded_warnings(run) if name == "identifier"]
    assert any("'twice.y': only the run computes it" in text for text in said)
    problem = recorded_identification(run)["identifier"].problem
    assert "'u.y' and alpha 'twice.y' are proportional" in problem


def test_delayed_signals_are_straight_lines_between_samples():
    """At t - lag - D the error is at most h^2/8 max |alpha''|; earlier there is no value."""
    h = 0.01
    lag = 0.1234
    own_lag = 0.05
    terms = expand((1,))
    alpha = AlphaSignal("speed.y", 0, own_lag)
    regressor = Regressor(terms, alphas=[alpha], steps=(0, 30), delays=(0.0, 0.3), lag=lag)
    t = np.arange(201) * h
    u = np.hstack([np.ones((201, 1)), values(t - own_lag)[:, :1]])
    mu = np.vstack([regressor.initialize(0.0, u[0]), regressor.advance(t, h, u)])
    for column, term in enumerate(terms):
        ((other,),) = term.parts
        age = lag + (0.0, 0.3)[other]
        exact = term.sign * values(t - age)[:, 0]
        first = max(math.ceil((age - own_lag) / h), 30)
        assert np.isnan(mu[:first, column]).all()
        np.testing.assert_allclose(mu[first:, column], exact[first:], atol=CURVATURE * h**2 / 8)
    with pytest.raises(UsageError, match=r"'speed\.y': .*0\.01 s, got 0\.05 s"):
        Regressor(terms, alphas=[alpha], steps=(0, 30), delays=(0.0, 0.3), lag=0.01)


SAMPLED = """[components.sensor]
kind = "sensor"
period = 0.0625
delay = 0.03125
jitter = 0.001
seed = 3
time_stamps = true
"""


def test_samples_between_communication_points_have_their_alphas(tmp_path):
    """At the times of samples a signal is on its straight lines; a log has it as the run had."""
    source = EXPRESSION + SAMPLED
    path = Path(scenario(tmp_path, source, connections={"sensor.u": "plant.y"}))
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace('"observer.y" = "plant.y"', '"observer.y" = "sensor.y"'))
    log = cosim.run(str(path), set=RUN, out=tmp_path / "log.mcap")
    (record,) = cosim.identify(log).records
    t = record.data.t
    assert len(t) > len(log.time("plant.y")) + 100
    largest = max(CURVATURE, 0.2 * 2.3**2)
    np.testing.assert_allclose(record.data.alpha, values(t), atol=largest * H**2 / 8)
    np.testing.assert_allclose(log["identifier.theta"][-1], THETA, atol=1e-4)


def test_a_filter_is_chosen_by_a_signal_that_is_known_before_the_run(tmp_path):
    """The spectrum of an expression is known, that of what the run computes is not."""
    changes = {**RUN, "observer.filter": "auto", "observer.noise": 1e-3, "identifier.start": 5.0}
    del changes["observer.filter_rate"]
    run = cosim.load(scenario(tmp_path)).set(changes)
    with ExitStack() as resources:
        chosen = Builder(run, resources).experiment().built.metadata["observer"]["choice"]
    request = chosen["request"]["delta"]
    assert request["alpha"] == list(BOTH)
    # another table of the source is another request, so that a replay with it chooses anew
    assert request["sources"]["schedule"]["y"] == list(ALPHAS)
    path = scenario(tmp_path, EXPRESSION, ("plant.y", "schedule.y[1]"))
    with pytest.raises(ScenarioError, match="'auto' requires amplitude and bandwidth"):
        cosim.run(path, set=changes)


def test_an_alpha_that_lags_is_for_least_squares_alone(tmp_path):
    """y does not lag, so that it does not fit an alpha that does."""
    path = scenario(tmp_path, EXPRESSION, ("observer.delta", "schedule.y[1]"))
    changes = {**RUN, "observer.filter": "consistent"}
    with pytest.raises(ScenarioError, match=r"'observer\.delta' with a lag of 0\.01\d+ s"):
        cosim.run(path, set=changes)
    changes |= {"identifier.method": "least-squares", "scenario.stop": 2.5}
    assert np.isfinite(signals(path, set=changes)["regressor.mu"][-1]).all()


def test_an_identifier_starts_where_its_signals_have_values(tmp_path):
    """They are read as late as the longest delay, and the lag of delta, before."""
    changes = {**RUN, "observer.filter": "consistent", "identifier.start": 1.5}
    with pytest.raises(ScenarioError, match=r"start: .*at least 1\.5\d+ s, .*'schedule\.y\[0"):
        cosim.run(scenario(tmp_path), set=changes)


FEEDBACK = """
scenario = { name = "feedback", stop = 4.0, step = 0.02 }
[models.spring]
A = [[0.0, 1.0], [-4.0, -0.4]]
B = [[0.0, 0.0], [0.0, 1.0]]
C = [[1.0, 0.0]]
disturbances = [1]
[components]
u = { kind = "constant", value = 0.0 }
plant = { kind = "descriptor", model = "spring", x0 = [1.0, 0.0] }
[components.delta]
kind = "disturbance"
terms = [{ alpha = { from = "plant.y" }, family = "constant", level = 1.5 }]
[connections]
"plant.u" = "u.y"
"plant.delta" = "delta.y"
"""


def test_a_disturbance_out_of_its_plant_is_half_a_step_late(tmp_path):
    """With 1.5 y(t - h/2) = 1.5 (y - h/2 y') the spring moves as here, but for the order h^2."""
    path = tmp_path / "feedback.toml"
    path.write_text(FEEDBACK)
    run = cosim.run(path)
    t = run.time("plant.y")

    def course(delay):
        A = np.array([[0.0, 1.0], [1.5 - 4.0, -1.5 * delay - 0.4]])
        values, vectors = np.linalg.eig(A)
        weights = np.linalg.solve(vectors, [1.0, 0.0])
        return ((vectors[0] * weights) * np.exp(np.outer(t, values))).sum(axis=1).real

    late = np.abs(run["plant.y"] - course(0.01)).max()
    assert late < 0.05 * np.abs(run["plant.y"] - course(0.0)).max()
    said = dict(recorded_warnings(run))["delta"]
    assert "delta.y depends on what it drives, so that 'plant.delta' takes it with" in said
    assert "on the mean 0.01 s late" in said


def test_terms_that_name_one_signal_share_their_alpha(tmp_path):
    """Two exponentials under one alpha make three products, under two alphas six."""
    one = EXPRESSION.replace(f', "{ALPHAS[1]}"', "")
    run = signals(scenario(tmp_path, one, ("schedule.y", "schedule.y[0]")), set=RUN)
    assert run["regressor.alpha"].ndim == 1
    assert run["regressor.mu"].shape[1] == 3


GEAR = """[components]
gear = { kind = "step", time = 1.0 }
speed = { kind = "sum", signs = [1.0, 1.0] }
"""
OF_GEAR = {"speed.u1": "gear.y", "speed.u2": "u.y"}
SECOND = "schedule.y[1]"
DISCRETE = EXPRESSION + "discrete = true\n"
PROPORTIONAL = EXPRESSION.replace(ALPHAS[1], "2.7 + 0.5*sin(1.7*t)")
WRONG_SIGNALS = [
    (EXPRESSION, ("schedul.y", SECOND), {}, "component 'schedul'; did you mean"),
    (EXPRESSION, ("schedule.y", SECOND), {}, "size 2 "),
    (EXPRESSION, ("schedule.y[2]", SECOND), {}, "schedule.y.* 2"),
    (EXPRESSION, ("schedule.y[0:2]", SECOND), {}, "expected one element of the output"),
    (DISCRETE, BOTH, {}, r"(?s)components.delta: .*jumps.*components.regressor: .* is discrete"),
    (PROPORTIONAL, BOTH, {}, "components.regressor: .*proportional"),
    (EXPRESSION.replace(ALPHAS[1], "1/(t - 5)"), BOTH, {}, r"'schedule.y\[1\]': .*t = 5 s"),
    (EXPRESSION.replace("1.7*t", "170*t"), BOTH, {}, r"components.*0\.\d+ of .*'schedule.y\[0\]'"),
    # a sum with a step in it jumps; the terms alone connect the input
    (GEAR + EXPRESSION, ("speed.y", SECOND), OF_GEAR, r"'speed\.y' jumps with gear\.y"),
    (EXPRESSION, BOTH, {"regressor.alpha": "schedule.y"}, r"'regressor\.alpha' .*of 'regressor'"),
]


def test_a_wrong_signal_is_refused_before_the_run(tmp_path):
    """The error names the table whose term it is."""

    def refuse(*case):
        cosim.run(scenario(tmp_path, *case), set=RUN)

    check_refused(WRONG_SIGNALS, refuse, ScenarioError)


@pytest.mark.slow
def test_exported_regressor_and_identifier_give_the_same(tmp_path):
    """In their places the FMUs get the same signals by their input alpha."""
    text = Path(scenario(tmp_path)).read_text(encoding="utf-8")
    text = text.replace("delays = [1.0, 2.0, 3.0]", "delays = [0.5, 1.0, 1.5]")
    text = text.replace("period = 0.1 ", "start = 2.0\nperiod = 0.25 ")
    path = tmp_path / "exported.toml"
    path.write_text(text, encoding="utf-8")
    changes = {"scenario.step": H, "scenario.stop": 4.0, "observer.filter_rate": 100.0}
    swap = {}
    for name in ("regressor", "identifier"):
        swap[name] = tmp_path / f"{name}.fmu"
        export_component(cosim.load(path).set(changes), name, swap[name], fmi="3")
    run = signals(str(path), set=changes)
    swapped = signals(str(path), set=changes, swap=swap)
    np.testing.assert_array_equal(swapped["regressor.mu"], run["regressor.mu"])
    np.testing.assert_array_equal(swapped["identifier.theta"][::32], run["identifier.theta"])
    assert np.isfinite(run["identifier.theta"][-1]).all()
