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
from cosim.blocks.modulated_source import ModulatedSource, Modulation
from cosim.blocks.regressor import Regressor
from cosim.blocks.source import Expression
from cosim.core.signals import Signal
from cosim.errors import ScenarioError, UsageError
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from cosim.native.estimation.alphas import AlphaSignal
from cosim.native.numerics.expression import compile_expression
from cosim.native.numerics.programs import evaluate_at
from cosim.scenario.building.build import Builder
from cosim.scenario.document.document import find
from cosim.scenario.exporting import export_component
from cosim.scenario.kinds import parameters_of
from cosim.scenario.kinds.regressor import RegressorKind
from cosim.scenario.record import recorded_identification, recorded_warnings
from cosim.testing import check_component
from cosim.theory.disturbances.regression import expand
from tests.scenario.refusals import check_refused
from tests.scenario.signals import signals

ALPHAS = ("1.35 + 0.25*sin(1.7*t)", "1.10 + 0.20*cos(2.3*t)")
THETA = (-0.1, -0.3)
H = 1.0 / 128.0  # instants and delays are exact, so that alphas are read at the very same ones
RUN = {
    "scenario.step": H,
    "scenario.stop": 10.0,
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


@pytest.mark.parametrize(
    "method",
    [
        "output-error",
        "least-squares",
        "rayleigh",
        "projection",
        "extended-kalman",
        "augmented-kalman",
    ],
)
def test_a_signal_gives_the_bits_of_the_text(tmp_path, method):
    """At instants that are communication points exactly an alpha is the same number either way."""
    changes = {**RUN, "identifier.method": method}
    by_signal = signals(scenario(tmp_path), set=changes)
    by_text = signals("academic", set=changes)
    for name in ("delta.y", "regressor.mu", "identifier.theta"):
        np.testing.assert_array_equal(by_signal[name], by_text[name])
    assert np.isfinite(by_signal["identifier.theta"][-1]).any()


def table(folder: Path) -> str:
    """Write both alphas at the communication points as a CSV file; return a source of it."""
    t = np.arange(round(10.0 / H) + 1) * H
    rows = np.column_stack([t, values(t)])
    lines = ["t,first,second", *(",".join(map(repr, row)) for row in rows.tolist())]
    (folder / "schedule.csv").write_text("\n".join(lines), encoding="utf-8")
    return '[components.schedule]\nkind = "table"\nfile = "schedule.csv"\n'


MEASURED = f"""[components.first]
kind = "sine"
amplitude = 0.25
rate = 1.7

[components.speed]
kind = "sum"
signs = [1.0, 1.0]

[components.mean]
kind = "constant"
value = 1.35

[components.second]
kind = "sensor"

[components.schedule]
kind = "expression"
y = "{ALPHAS[1]}"
"""
CONNECTIONS = {
    "speed.u1": "first.y",
    "speed.u2": "mean.y",
    "second.u": "schedule.y",
}


@pytest.mark.slow
def test_a_table_a_recorded_channel_and_a_computed_signal_identify_theta(tmp_path):
    """Any source will do, and a replay takes a file and a recording from the log."""
    changes = {**RUN, "scenario.stop": 8.0}
    path = scenario(tmp_path, table(tmp_path))
    log = cosim.run(path, set=changes, out=tmp_path / "table.mcap")
    np.testing.assert_allclose(log["identifier.theta"][-1], THETA, atol=1e-6)
    np.testing.assert_array_equal(log["regressor.alpha"], values(log.time("regressor.alpha")))

    assert cosim.diff(log, cosim.replay(log)).equal
    again = cosim.replay(log, set={"identifier.period": 0.5})
    np.testing.assert_allclose(again["identifier.theta"][-1], THETA, atol=1e-6)

    recording = (
        '[components.schedule]\nkind = "recording"\nlog = "table.mcap"\ncomponent = "schedule"\n'
    )
    recorded = signals(scenario(tmp_path, recording), set=changes)
    np.testing.assert_array_equal(recorded["identifier.theta"], log["identifier.theta"])

    path = scenario(tmp_path, MEASURED, ("speed.y", "second.y"), CONNECTIONS)
    run = cosim.run(path, set=changes)
    np.testing.assert_allclose(run["identifier.theta"][-1], THETA, atol=1e-6)
    said = [text for name, text in recorded_warnings(run) if name == "identifier"]
    assert any("'speed.y', 'second.y': only the run" in text for text in said)


def test_field_data_in_the_place_of_the_source_identify_theta(tmp_path):
    """A swap leaves the connections that follow from the terms."""
    table(tmp_path)
    columns = {"schedule.y": ["first", "second"]}
    swap = {"schedule": tmp_path / "schedule.csv"}
    changes = {**RUN, "scenario.stop": 8.0}
    run = signals(scenario(tmp_path), set=changes, swap=swap, map=columns)
    t = run.time("regressor.alpha")
    np.testing.assert_allclose(run["regressor.alpha"], values(t), rtol=1e-15)
    np.testing.assert_allclose(run["identifier.theta"][-1], THETA, atol=1e-6)


def test_delayed_signals_are_straight_lines_between_samples():
    """At t - lag - D the error is at most h^2/8 max |alpha''|; earlier there is no value."""
    h = 0.01
    lag = 0.1234
    own_lag = 0.05
    terms = expand((1,))
    regressor = Regressor(
        terms,
        alphas=[AlphaSignal("speed.y", 0, own_lag)],
        steps=(0, 30),
        delays=(0.0, 0.3),
        lag=lag,
    )
    t = np.arange(201) * h
    late = values(t - own_lag)[:, :1]
    u = np.hstack([np.ones((201, 1)), late])
    mu = np.vstack([regressor.initialize(0.0, u[0]), regressor.advance(t, h, u)])
    for column, term in enumerate(terms):
        ((other,),) = term.parts
        age = lag + (0.0, 0.3)[other]
        exact = term.sign * values(t - age)[:, 0]
        first = max(math.ceil((age - own_lag) / h), 30)
        assert np.isnan(mu[:first, column]).all()
        # |alpha''| <= 0.25 1.7^2
        np.testing.assert_allclose(mu[first:, column], exact[first:], atol=0.25 * 1.7**2 * h**2 / 8)


def test_an_alpha_that_lags_more_than_delta_is_refused():
    """Its value is not there yet."""
    with pytest.raises(UsageError, match=r"'speed\.y': .*0\.1 s, got 0\.5 s"):
        Regressor(
            expand((1,)),
            alphas=[AlphaSignal("speed.y", 0, 0.5)],
            steps=(0, 30),
            delays=(0.0, 0.3),
            lag=0.1,
        )


SAMPLED = """[components.sensor]
kind = "sensor"
period = 0.0625
delay = 0.03125
jitter = 0.001
seed = 3
time_stamps = true
"""


def test_samples_between_communication_points_have_their_alphas(tmp_path):
    """At the times of samples a signal is on its straight lines."""
    source = EXPRESSION + SAMPLED
    path = Path(scenario(tmp_path, source, connections={"sensor.u": "plant.y"}))
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace('"observer.y" = "plant.y"', '"observer.y" = "sensor.y"'))
    log = cosim.run(str(path), set={**RUN, "scenario.stop": 8.0}, out=tmp_path / "log.mcap")
    (record,) = cosim.identify(log).records
    t = record.data.t
    assert len(t) > len(log.time("plant.y")) + 100
    # |alpha''| <= 0.25 1.7^2 and 0.2 2.3^2
    largest = max(0.25 * 1.7**2, 0.2 * 2.3**2)
    np.testing.assert_allclose(record.data.alpha, values(t), atol=largest * H**2 / 8)
    np.testing.assert_allclose(log["identifier.theta"][-1], THETA, atol=1e-4)


def test_a_filter_is_chosen_by_a_signal_that_is_known_before_the_run(tmp_path):
    """The spectrum of an expression is known, that of what the run computes is not."""
    changes = {**RUN, "observer.filter": "auto", "observer.noise": 1e-3}
    del changes["observer.filter_rate"]
    changes["identifier.start"] = 5.0
    run = cosim.load(scenario(tmp_path)).set(changes)
    with ExitStack() as resources:
        chosen = Builder(run, resources).experiment().metadata["observer"]["choice"]
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


@pytest.mark.slow
def test_a_log_identifies_theta_from_the_recorded_alphas(tmp_path):
    """Alphas of a log are those that the run computed, to the last bit."""
    changes = {**RUN, "scenario.stop": 8.0, "identifier.method": "least-squares"}
    log = cosim.run(scenario(tmp_path), set=changes, out=tmp_path / "signal.mcap")
    text = cosim.run("academic", set=changes, out=tmp_path / "text.mcap")
    by_signal = cosim.identify(log)
    by_text = cosim.identify(text)
    (record,) = by_signal.records
    np.testing.assert_array_equal(record.data.alpha, values(record.data.t))
    found = zip(by_signal.assessment.parameters, by_text.assessment.parameters, strict=True)
    for one, other in found:
        assert one.value == other.value


@pytest.mark.usefixtures("without_verdicts")
def test_estimators_are_compared_on_the_recorded_signals(tmp_path):
    """Every replay takes the alphas that its method needs."""
    changes = {**RUN, "scenario.stop": 6.0}
    methods = ["output-error", "projection"]
    compared = cosim.compare_estimators(scenario(tmp_path), estimators=methods, set=changes)
    for result in compared.results:
        assert not result.failure
        np.testing.assert_allclose(result.theta, THETA, atol=0.02)


def test_the_catalog_names_the_key_as_files_have_it():
    """The key of the table is from, a word of Python."""
    names = [parameter.name for parameter in parameters_of(RegressorKind)]
    assert "terms.alpha.from" in names


def test_alphas_that_prove_proportional_after_the_run_are_named(tmp_path):
    """The products of alphas that only the run computes are checked at its end."""
    gain = '[components.twice]\nkind = "gain"\nK = 2.0\n'
    path = scenario(tmp_path, gain, ("u.y", "twice.y"), {"twice.u": "u.y"})
    changes = {**RUN, "scenario.stop": 4.0, "identifier.method": "least-squares"}
    run = cosim.run(path, set=changes)
    problem = recorded_identification(run)["identifier"].problem
    assert "'u.y' and alpha 'twice.y' are proportional" in problem


def test_an_alpha_out_of_the_plant_that_it_disturbs_is_warned_of(tmp_path):
    """Both are in a loop, where the plant takes delta with a zero-order hold."""
    path = scenario(tmp_path, EXPRESSION, ("plant.x_a[1]", "schedule.y[1]"))
    run = cosim.run(path, set={**RUN, "scenario.stop": 2.5})
    said = dict(recorded_warnings(run))["delta"]
    assert "delta.y depends on what it drives, so that 'plant.delta' takes it with" in said
    assert f"on the mean {0.5 * RUN['scenario.step']:g} s late" in said
    t = run.time("delta.y")
    exact = run["plant.x_a"][:, 1] * np.exp(THETA[0] * t) + values(t)[:, 1] * np.exp(THETA[1] * t)
    np.testing.assert_allclose(run["delta.y"], exact, rtol=1e-14)


FEEDBACK = """
[scenario]
name = "feedback"
stop = 4.0
step = 0.02
[models.spring]
n_a = 2
A = [[0.0, 1.0], [-4.0, -0.4]]
Bu = [[0.0], [0.0]]
Bd = [[0.0], [1.0]]
C = [[1.0, 0.0]]
[components.u]
kind = "constant"
value = 0.0
[components.plant]
kind = "descriptor"
model = "spring"
x_a0 = [1.0, 0.0]
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

    said = np.abs(run["plant.y"] - course(0.01)).max()
    assert said < 0.05 * np.abs(run["plant.y"] - course(0.0)).max()


def test_its_blocks_keep_the_contract_of_a_component():
    """One call of K steps is K calls of one step; outputs change nothing; restore undoes."""
    alphas = [AlphaSignal("speed.y", 0, 0.0105), compile_expression(ALPHAS[0])]

    def regressor():
        return Regressor(
            expand((1, 1)), alphas=alphas, steps=(0, 3, 7), delays=(0.0, 0.03, 0.07), lag=0.0125
        )

    def source():
        inner = Expression(["sin(t)", "exp(-t)", "cos(t)"])
        signal = Signal("alpha", 2, role="input")
        return ModulatedSource(inner, [Modulation(0, 1), Modulation(0, 0)], (signal,))

    for make in (regressor, source):
        check_component(make, h=0.01)


def test_terms_that_name_one_signal_share_their_alpha(tmp_path):
    """Two exponentials under one alpha make three products, under two alphas six."""
    one = EXPRESSION.replace(f', "{ALPHAS[1]}"', "")
    run = signals(scenario(tmp_path, one, ("schedule.y", "schedule.y[0]")), set=RUN)
    assert run["regressor.alpha"].ndim == 1
    assert run["regressor.mu"].shape[1] == 3


WRONG_SIGNALS = [
    (EXPRESSION, ("schedul.y", "schedule.y[1]"), "component 'schedul'; did you mean"),
    (EXPRESSION, ("schedule.y", "schedule.y[1]"), "size 2 "),
    (EXPRESSION, ("schedule.y[2]", "schedule.y[1]"), "schedule.y.* 2"),
    (EXPRESSION, ("schedule.z", "schedule.y[1]"), "'z'"),
    (EXPRESSION, ("schedule.y[0:2]", "schedule.y[1]"), "expected one element of the output"),
    (EXPRESSION, ("schedule", "schedule.y[1]"), "'schedule'"),
    (
        EXPRESSION + "discrete = true\n",
        BOTH,
        r"(?s)components.delta: alpha 'schedule.y\[0\]' is discrete and jumps.*for jumps "
        r"use .*'expression'.*components.regressor: alpha 'schedule.y\[0\]' is",
    ),
    (
        EXPRESSION.replace(ALPHAS[1], "2.7 + 0.5*sin(1.7*t)"),
        BOTH,
        "components.regressor: .*proportional",
    ),
    (
        EXPRESSION.replace(ALPHAS[1], "1/(t - 5)"),
        BOTH,
        r"alpha 'schedule.y\[1\]': .*inf at t = 5 s",
    ),
    (
        EXPRESSION.replace("1.7*t", "170*t"),
        BOTH,
        r"components.*0\.\d+ of alpha 'schedule.y\[0\]'",
    ),
]


def test_a_wrong_signal_is_refused_before_the_run(tmp_path):
    """The error names the table whose term it is."""

    def refuse(case):
        source, names = case
        cosim.run(scenario(tmp_path, source, names), set=RUN)

    cases = [(case, message) for *case, message in WRONG_SIGNALS]
    check_refused(cases, refuse, ScenarioError)


def test_a_jump_that_feeds_through_is_refused(tmp_path):
    """A sum with a step in it is interpolated, and jumps all the same."""
    source = (
        '[components.gear]\nkind = "step"\ntime = 1.0\n\n[components.speed]\nkind = "sum"\n'
        "signs = [1.0, 1.0]\n\n" + EXPRESSION
    )
    connections = {"speed.u1": "gear.y", "speed.u2": "u.y"}
    path = scenario(tmp_path, source, ("speed.y", "schedule.y[1]"), connections)
    with pytest.raises(ScenarioError, match=r"alpha 'speed\.y' jumps with gear\.y"):
        cosim.run(path, set=RUN)


def test_the_input_alpha_is_connected_by_the_terms_alone(tmp_path):
    """A connection of the file would be a second source."""
    path = scenario(tmp_path, connections={"regressor.alpha": "schedule.y"})
    with pytest.raises(ScenarioError, match=r"'regressor\.alpha' .*table of 'regressor'"):
        cosim.run(path, set=RUN)


@pytest.mark.slow
def test_an_exported_regressor_takes_the_signals_by_its_input_alpha(tmp_path):
    """The FMU gives what the component gives, bit for bit."""
    path = scenario(tmp_path)
    changes = {**RUN, "scenario.stop": 4.0}
    fmu = tmp_path / "regressor.fmu"
    export_component(cosim.load(path).set(changes), "regressor", fmu, fmi="3")
    run = signals(path, set=changes)
    u = np.column_stack([run["observer.delta"], run["schedule.y"]])
    t = run.time("regressor.mu")
    with load(fmu, FmuOptions(interface_type="cs")) as opened:
        first = opened.component.initialize(0.0, u[0])
        rows = opened.component.advance(t, H, u)
    np.testing.assert_array_equal(np.vstack([first, rows]), run["regressor.mu"])


@pytest.mark.campaign
@pytest.mark.parametrize("fmi", ["2", "3"])
def test_exported_regressor_and_identifier_give_the_same(tmp_path, fmi):
    """In their places the FMUs get the same signals."""
    text = Path(scenario(tmp_path)).read_text(encoding="utf-8")
    text = text.replace("delays = [1.0, 2.0, 3.0]", "delays = [0.5, 1.0, 1.5]")
    text = text.replace("period = 0.1 ", "start = 2.0\nperiod = 0.25 ")
    path = tmp_path / "exported.toml"
    path.write_text(text, encoding="utf-8")
    changes = {"scenario.step": H, "scenario.stop": 4.0, "observer.filter_rate": 100.0}
    swap = {}
    for name in ("regressor", "identifier"):
        swap[name] = tmp_path / f"{name}.fmu"
        export_component(cosim.load(path).set(changes), name, swap[name], fmi=fmi)
    run = signals(str(path), set=changes)
    swapped = signals(str(path), set=changes, swap=swap)
    np.testing.assert_array_equal(swapped["regressor.mu"], run["regressor.mu"])
    np.testing.assert_array_equal(swapped["identifier.theta"][::32], run["identifier.theta"])
    assert np.isfinite(run["identifier.theta"][-1]).all()
