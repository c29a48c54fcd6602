"""`cosim design`: choices of a scenario, ranked by the error of theta that is to be expected."""

import json
import re

import numpy as np
import pytest

import cosim
from cosim.errors import UsageError
from cosim.report.tables.console import print_shown
from cosim.report.tables.preparation import show_design
from cosim.scenario.experiment_design.trial import DesignSubject
from tests.scenario.online import TWO_OUTPUTS

FAST = {"scenario.step": 0.05, "scenario.stop": 20.0, "observer.filter_rate": 20.0}
TINY = {
    "scenario.step": 0.1,
    "scenario.stop": 9.0,
    "observer.filter_rate": 10.0,
    "regressor.delays": [0.1, 0.3, 0.5],
}
THETA = (-0.1, -0.3)
TERMS = [
    {"alpha": "1.35 + 0.25*sin(1.7*t)", "family": "exponential", "theta": -0.1},
    {"alpha": "1.10 + 0.20*cos(2.3*t)", "family": "exponential", "theta": -0.3},
]


@pytest.fixture(scope="module")
def designed():
    return cosim.design("academic-noisy", set=FAST, input=True, longest=3.0)


def first(design, choice, method):
    return design.of(choice, method)[0]


def test_the_bound_is_that_of_the_academic_example():
    """(7.09e-6, 6.22e-5) at 1e-3, found independently: prototypes of the method on y."""
    trial = DesignSubject(cosim.load("academic-noisy")).trial()
    np.testing.assert_allclose(trial.bound().standard_error, [7.09e-6, 6.22e-5], rtol=2e-3)
    assert trial.bound().residual < 1e-12


def test_predictions_are_what_runs_find():
    """Least squares at two seeds: its bias is 40 times its scatter, so that two runs show it."""
    trial = DesignSubject(cosim.load("academic-noisy").set(FAST)).trial()
    predicted = trial.regression.least_squares(trial.steps)
    settings = {**FAST, "identifier.method": "least-squares", "identifier.period": 20.0}
    found = []
    for seed in (1, 2):
        run = cosim.run("academic-noisy", set={**settings, "sensor.seed": seed})
        found.append(run["identifier.theta"][-1] - THETA)
    np.testing.assert_allclose(
        np.mean(found, axis=0), predicted.bias, atol=4.0 * predicted.standard_error.max() / 2**0.5
    )
    assert np.abs(predicted.bias).max() > 10.0 * predicted.standard_error.max()


@pytest.mark.slow
def test_the_delays_of_the_paper_are_not_the_best(designed):
    """Others have less than half the error; all of them stay far from output error."""
    before = first(designed, "scenario", "rayleigh")
    after = first(designed, "delays", "rayleigh")
    assert after.ratio < 0.5 * before.ratio
    assert first(designed, "scenario", "output-error").ratio == 1.0
    together = first(designed, "together", "rayleigh")
    filtered = first(designed, "filter", "rayleigh")
    assert 1.0 < together.ratio <= min(after.ratio, filtered.ratio)
    assert any("the delays (1, 2, 3) are not the best" in note for note in designed.notes)


@pytest.mark.slow
def test_the_best_design_can_be_set_and_is_predicted_the_same(designed):
    """The settings of a design, given to the scenario, make it the scenario as it is."""
    best = first(designed, "together", "rayleigh")
    scenario = cosim.load("academic-noisy").set({**FAST, **best.settings})
    trial = DesignSubject(scenario).trial()
    again = trial.regression.rayleigh(trial.steps)
    np.testing.assert_allclose(again.error, best.error, rtol=1e-9)


@pytest.mark.slow
def test_designs_of_a_choice_are_ranked(designed):
    """The best first, for every method that has it; each error is bias and scatter together."""
    for choice in ("filter", "step", "window"):
        for method in ("output-error", "rayleigh", "least-squares"):
            ratios = [one.ratio for one in designed.of(choice, method)]
            assert ratios == sorted(ratios)
    for one in designed.designs:
        np.testing.assert_allclose(one.error, np.hypot(one.bias, one.standard_error))
        assert one.ratio == pytest.approx((one.error / designed.bound).max())
    windows = designed.of("window", "output-error")
    assert [one.settings["identifier.window"] for one in windows] == [10.0, 5.0, 2.5]


@pytest.mark.slow
def test_the_input_does_not_change_the_bound_but_leaks_through_the_filter(designed):
    """Tenfold u: the same bound, and ten times the part of delta that is an error."""
    scenario = cosim.load("academic-noisy").set(FAST)
    trials = [DesignSubject(scenario.set({"u.amplitude": a})).trial() for a in (1.0, 10.0)]
    bounds = [trial.bound().standard_error for trial in trials]
    np.testing.assert_allclose(*bounds, rtol=1e-9)
    for factor, trial in zip((1.0, 10.0), trials, strict=True):
        grown = trials[0].with_input(factor)
        np.testing.assert_allclose(grown.delta[1:], trial.regression.delta[1:], atol=1e-10)
    (without,) = designed.of("input", "rayleigh")
    assert without.settings["input"] == "0 u"
    omitted = {(one.choice, one.method): one for one in designed.omitted}
    tenfold = omitted["input", "rayleigh"]
    assert tenfold.settings == ({"input": "10 u"},)
    assert tenfold.reason.startswith("no estimate")
    assert any("no input changes the bound" in note for note in designed.notes)


def test_theta_given_replaces_that_of_the_disturbance():
    """Also in the signals: the model still leaves nothing of y without noise."""
    subject = DesignSubject(cosim.load("academic-noisy").set(FAST), theta=[-0.2, -0.05])
    trial = subject.trial()
    assert trial.regression.theta.tolist() == [-0.2, -0.05]
    assert trial.bound().residual < 1e-10


@pytest.mark.parametrize(
    ("noise", "variances"),
    [(0.5, [0.25, 0.25]), ([0.5], [0.25, 0.25]), ([0.5, 2.0], [0.25, 4.0]), (None, [0.01, 1e-6])],
)
def test_noise_is_of_all_outputs_or_of_each(noise, variances):
    """A number, also in a list as the command has it, one per output, or that of the sensor."""
    scenario = cosim.load("academic-noisy").set({**TWO_OUTPUTS, "scenario.stop": 8.0})
    trial = DesignSubject(scenario, noise=noise).trial()
    np.testing.assert_allclose(trial.covariance, np.diag(variances), rtol=1e-15)
    assert trial.noise_source == ("sensor.noise" if noise is None else "noise")


UNKNOWN = {"delta": {"kind": "constant", "value": 1.0}}
OTHER_TERMS = {"regressor.delays": [1.0, 2.0], "regressor.terms": [{"family": "exponential"}]}


@pytest.mark.parametrize(
    ("scenario", "settings", "arguments", "words"),
    [
        ("academic", FAST, {}, "the noise of y is unknown; .*deviation.* noise"),
        ("academic", FAST, {"noise": -1.0}, "noise: expected positive finite .*got -1.0"),
        ("academic", FAST, {"noise": "x"}, "noise: expected positive finite .*got 'x'"),
        ("academic", FAST, {"noise": [1e-3, 1e-3]}, "noise: expected one number, or .*, got 2"),
        ("academic-noisy", FAST, {"theta": [0.1]}, r"theta: expected 2 finite .*, got \[0.1\]"),
        ("academic-noisy", FAST, {"longest": 0.0}, "longest: expected .*, got 0 s"),
        ("academic-noisy", {**FAST, **UNKNOWN}, {}, "theta is unknown: no single component"),
        ("academic-noisy", {**FAST, **OTHER_TERMS}, {}, "'regressor' and in 'delta', .*different"),
        ("academic-noisy", {**FAST, "sensor.period": 0.1}, {}, "values between the samples"),
        ("closed-loop", {}, {"noise": 1e-3}, "depends on its y"),
        ("pair", {}, {}, "pair: identifiers: expected one .*, got none"),
    ],
)
def test_missing_knowledge_is_refused_with_the_way_out(scenario, settings, arguments, words):
    """One error, which says what is missing and how to give it."""
    with pytest.raises(UsageError, match=words):
        cosim.design(scenario, set=settings, **arguments)


def test_a_recorded_plant_has_no_model(tmp_path):
    """Its noise cannot be left out."""
    short = {**FAST, "scenario.stop": 4.0}
    cosim.run("academic-noisy", set=short, out=tmp_path / "a.mcap")
    swapped = cosim.load("academic-noisy").set(short).swap(plant=tmp_path / "a.mcap")
    with pytest.raises(UsageError, match=r"'plant' is recorded .* it has no model"):
        cosim.design(swapped)


def test_the_command_prints_json_or_the_error(call):
    """The same numbers as in Python; exit 2 for wrong use."""
    short = ["--longest", "0.5", *(f"--set={key}={value}" for key, value in TINY.items())]
    code, out, _ = call("design", "academic-noisy", *short, "--json")
    content = json.loads(out)
    assert (code, content["noise"]) == (0, "sensor.noise")
    for one in content["designs"]:  # of the parameter that is farthest from its bound
        of_bound = np.array(one["error"], float) / content["bound"]
        assert float(one["ratio"]) == pytest.approx(of_bound.max(), rel=1e-15)
    assert call("design", "academic", *short)[0] == 2
    assert "expected a number, or a list" in call("design", "academic", "--noise", "x", *short)[2]


@pytest.mark.slow
def test_every_choice_has_a_row_or_a_reason(capsys):
    """Steps that the delays do not fit, or too few of them; filters and windows too long to try."""
    settings = {**TINY, "scenario.step": 0.02}
    design = cosim.design("academic-noisy", set=settings, longest=0.5)
    ranked = {one.settings["scenario.step"] for one in design.of("step", "output-error")}
    reasons = {}
    for omitted in design.omitted:
        if omitted.choice == "step":
            reasons |= {one["scenario.step"]: omitted.reason for one in omitted.settings}
    assert sorted([*ranked, *reasons]) == [0.002, 0.004, 0.01, 0.04, 0.1, 0.2]
    assert "delays[0]: 0.1 s is not a whole number of 0.04 s steps; nearest" in reasons[0.04]
    assert reasons[0.1] == "not tried: expected 200 to 100000 steps in the run" == reasons[0.2]
    of_filters = " ".join(one.reason for one in design.omitted if one.choice == "filter")
    assert re.search("10 % of the run.*time constants|time constants.*10 % of the run", of_filters)
    assert all(np.isfinite(one.ratio) for one in design.designs if one.choice != "scenario")
    print_shown(show_design(design), as_json=False)
    out = capsys.readouterr().out
    assert "\nstep: scenario.step=0.1, scenario.step=0.2: not tried: expected 200" in out
    assert all(one.reason in out for one in design.omitted)


def test_alphas_that_are_signals_are_those_of_the_run():
    """The example with its alphas as signals: the same predictions, up to their interpolation."""
    settings = {**FAST, "scenario.step": 1.0 / 64.0, "identifier.period": 0.25}
    scenario = cosim.load("academic-noisy").set(settings)
    terms = [{"alpha": {"from": f"schedule.y[{i}]"}, "family": "exponential"} for i in (0, 1)]
    by_signal = {
        "components.schedule": {"kind": "expression", "y": [term["alpha"] for term in TERMS]},
        "delta.terms": [{**one, "theta": theta} for one, theta in zip(terms, THETA, strict=True)],
        "regressor.terms": terms,
    }
    errors = []
    for one in (scenario.set(by_signal), scenario):
        trial = DesignSubject(one).trial()
        errors.append([trial.regression.rayleigh(trial.steps).error, trial.bound().standard_error])
    np.testing.assert_allclose(errors[0], errors[1], rtol=1e-3)


def test_any_family_and_a_shared_alpha_can_be_designed_for():
    """A damped sine and a constant under one alpha: theta is (decay, rate), four delays."""
    terms = [{"family": "damped-sine"}, {"family": "constant"}]
    values = [{**terms[0], "theta": [0.05, 1.3]}, {**terms[1], "level": 0.5}]
    settings = {"regressor.terms": terms, "delta.terms": values, "observer.filter_rate": 20.0}
    scenario = cosim.load("academic-noisy").set(
        {**FAST, **settings, "regressor.delays": [0.0, 0.5, 1.0, 1.5]}
    )
    subject = DesignSubject(scenario)
    assert subject.theta == (0.05, 1.3)
    trial = subject.trial()
    assert trial.bound().residual < 1e-10
    predicted = trial.regression.rayleigh(trial.steps)
    assert (predicted.error > trial.bound().standard_error).all()
    assert (predicted.error < 0.1).all()


def test_a_disturbance_that_is_absent_determines_no_theta():
    """Both amplitudes 0: refused; one of them: that theta is left out, the other is ranked."""
    absent = [{**term, "amplitude": 0.0} for term in TERMS]
    with pytest.raises(UsageError, match="no choice makes theta identifiable from y"):
        cosim.design("academic-noisy", set={**FAST, "delta.terms": absent})
    one = cosim.load("academic-noisy").set({**FAST, "delta.terms": [absent[0], TERMS[1]]})
    errors = DesignSubject(one).trial().bound().standard_error
    assert np.isinf(errors[0])
    assert errors[1] < 1e-2
