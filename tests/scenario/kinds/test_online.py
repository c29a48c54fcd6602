"""The identifier by output error, online: its contract, its options, and what it does not say."""

import pickle

import numpy as np
import pytest

import cosim
from cosim.core.contracts import prepare
from cosim.report.summary import summarize
from cosim.scenario.record import recorded_identification
from tests.scenario.online import COARSE, THETA, H, identifier, inputs, run
from tests.scenario.refusals import check_refused

SHORT = {**COARSE, "scenario.stop": 12.0}
EVERY_STEP = {**SHORT, "identifier.period": H}  # what saves its state is not decimated


@pytest.fixture(scope="module")
def recorded():
    """Return what the identifier took in a run of 12 s, with an estimate from 0.7 s on."""
    return inputs(cosim.run("academic", set=SHORT))


def theta(log):
    return np.reshape(log["identifier.theta"], (-1, 2))


def standard_error(log):
    return np.reshape(log["identifier.standard_error"], (-1, 2))


def prepared(recorded, settings=EVERY_STEP):
    component = identifier("academic", settings)
    prepare(component, H, np.zeros(9, np.bool_), {})
    component.initialize(0.0, recorded[0])
    return component


def drive(component, recorded, begin, end):
    t = np.arange(begin, end + 1) * H
    return component.advance(t, H, recorded[begin : end + 1])


@pytest.mark.usefixtures("without_verdicts")
def test_a_bound_of_a_file_may_be_infinite(tmp_path):
    """``inf`` is no bound, in a scenario as in ``cosim identify``; a replay has it too."""
    settings = {**SHORT, "identifier.bounds": [[-np.inf, np.inf], [-np.inf, np.inf]]}
    log = cosim.run("academic-noisy", set=settings, out=tmp_path / "log.mcap")
    assert np.isfinite(theta(log)[-1]).all()
    np.testing.assert_array_equal(theta(log), theta(cosim.run("academic-noisy", set=SHORT)))
    assert cosim.diff(log, cosim.replay(log.path)).equal


def test_a_state_keeps_its_samples_when_others_come_in_their_places(recorded):
    """Behind the state that was restored since, and behind an initialization.

    It goes on out of a pickle, and in an identifier for a longer run.
    """
    component = prepared(recorded)
    drive(component, recorded, 0, 1000)
    early = component.save()
    drive(component, recorded, 1000, 1100)
    late = component.save()
    expected = drive(component, recorded, 1100, 1200)
    component.restore(early)
    assert not np.array_equal(drive(component, 1.5 * recorded, 1000, 1200)[100:], expected)
    component.restore(late)
    assert np.array_equal(drive(component, recorded, 1100, 1200), expected)
    component.initialize(0.0, recorded[0])
    drive(component, 1.5 * recorded, 0, 1200)
    component.restore(early)
    drive(component, recorded, 1000, 1100)
    assert np.array_equal(drive(component, recorded, 1100, 1200), expected)
    longer = prepared(recorded, {**EVERY_STEP, "scenario.stop": 120.0})
    drive(longer, 1.5 * recorded, 0, 900)
    for other in (component, longer):
        other.restore(pickle.loads(pickle.dumps(late)))
        assert np.array_equal(drive(other, recorded, 1100, 1200), expected)


def test_there_is_no_value_before_there_is_an_estimate():
    """The same NaN in all outputs, and numbers in all of them afterwards."""
    log = run("academic-noisy")
    known = np.isfinite(theta(log)).all(axis=1)
    first = int(np.argmax(known))
    assert first > 0
    assert known[first:].all()
    for name in ("theta", "standard_error", "deviation", "amplitude"):
        rows = np.reshape(log[f"identifier.{name}"], (len(known), -1))
        assert np.array_equal(np.isfinite(rows).all(axis=1), known)
        before = np.ascontiguousarray(rows[:first])
        assert set(before.view(np.uint64).ravel().tolist()) == {0x7FF8000000000000}


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.usefixtures("without_verdicts")
def test_the_first_estimate_comes_before_mu_counts_and_every_one_keeps_its_error(seed):
    """From y alone, once no other minimum explains the samples as well."""
    log = cosim.run("academic-noisy", set={**COARSE, "sensor.seed": seed})
    estimates = theta(log)
    first = int(np.argmax(np.isfinite(estimates).all(axis=1)))
    assert first * 0.1 < COARSE["identifier.start"]
    # 170 estimates of 2 parameters, most of the same samples
    errors = np.abs(estimates[first:] - THETA) / standard_error(log)[first:]
    assert errors.max() < 5.0


@pytest.mark.usefixtures("without_verdicts")
def test_noise_leaves_an_error_of_the_standard_errors_size():
    """Whichever samples count, and with an offset among the unknowns or without.

    All samples tell more than those of a window, or of 5 s forgetting, or than a constant lets.
    """
    found = []
    for options in ({}, {"offset": True}, {"window": 8.0}, {"forgetting": 5.0}):
        log = run("academic-noisy", **options)
        errors = standard_error(log)[-1]
        found.append(errors)
        assert (np.abs(theta(log)[-1] - THETA) < 4.0 * errors).all()
        # 800 samples of the shortest window: the deviation is known to 2.5 %
        assert log["identifier.deviation"][-1] == pytest.approx(1e-3, rel=0.1)
        assert (log["identifier.amplitude"][-1] > 0.0).all()
    assert (np.array(found[1:]) > found[0]).all()


@pytest.mark.usefixtures("without_verdicts")
def test_amplitudes_are_those_at_the_beginning_of_the_window():
    """exp(theta t) there, as all are 1 at t = 0."""
    log = run(window=8.0)
    np.testing.assert_allclose(
        log["identifier.amplitude"][-1], np.exp(THETA * (20.0 - 8.0)), rtol=1e-8
    )


@pytest.mark.usefixtures("without_verdicts")
def test_bounds_fix_theta_and_keep_it():
    """Equal bounds give the number itself, without error; the search keeps to bounds too."""
    log = run("academic-noisy", bounds=[[-0.2, 0.0], [-0.3, -0.3]])
    assert theta(log)[-1, 1] == -0.3
    assert standard_error(log)[-1, 1] == 0.0
    assert abs(theta(log)[-1, 0] + 0.1) < 4.0 * standard_error(log)[-1, 0]
    away = run(bounds=[[-0.2, 0.0], [-9.0, -8.0]])
    assert np.isnan(theta(away)[:, 1]).all()


@pytest.mark.parametrize("seed", [2, 5])
@pytest.mark.usefixtures("without_verdicts")
def test_an_absent_component_has_no_value(seed):
    """Of two exponentials of which one has the amplitude 0 the other is estimated.

    Its error is no amplitude of the absent one, at any time.
    """
    terms = [
        {"alpha": "1.35 + 0.25*sin(1.7*t)", "family": "exponential", "theta": -0.1},
        {"alpha": "1.10", "family": "exponential", "theta": -0.3, "amplitude": 0.0},
    ]
    log = cosim.run("academic-noisy", set={**COARSE, "delta.terms": terms, "sensor.seed": seed})
    assert np.isnan(theta(log)[:, 1]).all()
    assert np.isnan(standard_error(log)[:, 1]).all()
    error = theta(log)[-1, 0] + 0.1
    assert abs(error) < 4.0 * standard_error(log)[-1, 0]


@pytest.mark.slow
@pytest.mark.usefixtures("without_verdicts")
def test_a_zero_order_hold_costs_the_square_of_the_step_or_the_step():
    """Held inputs are taken as held; what the plant held of the disturbance is half a step late."""
    errors = []
    for step in (0.02, 0.01):
        settings = {**COARSE, "scenario.step": step, "scenario.input_interpolation": "zero-order"}
        log = cosim.run("academic", set=settings)
        errors.append(np.abs(theta(log)[-1] - THETA))
    assert (errors[1] < 1e-3).all()
    ratio = errors[0] / errors[1]
    assert (ratio > 1.7).all()
    assert (ratio < 4.3).all()


NO_SENSE = [
    ({"window": 0.0}, r"identifier.window'\]: expected a number > 0, got 0.0"),
    ({"irregular": -0.01}, r"identifier.irregular'\]: expected a number > 0, got -0.01"),
    ({"window": 8.0, "forgetting": 3.0}, "window and forgetting, got both"),
    ({"window": 0.0151}, "window of 'identifier'"),
    ({"bounds": [[np.nan, np.inf], [-np.inf, np.inf]]}, r"\[nan, inf\]"),
    ({"bounds": [[0.0, -1.0], [0.0, 1.0]]}, r"identifier: bounds of theta\[0\]: .*got \[0, -1\]"),
    ({"P0": 1.0}, "P0: .*'output-error'"),
]


def test_options_that_make_no_sense_are_refused():
    """Each with what was found."""
    check_refused(NO_SENSE, lambda options: run(**options))


def test_the_verdict_of_a_window_is_made_of_its_samples():
    """Its interval is that of the last 4 s, and larger; without samples enough there is none."""
    whole = recorded_identification(run())["identifier"].parameters
    log = run(window=4.0)
    found = recorded_identification(log)["identifier"]
    assert "of the last 4 s" in found.extent
    for part, full in zip(found.parameters, whole, strict=True):
        assert part.standard_error is None or part.standard_error > full.standard_error
    assert "of the last 4 s" in " ".join(summarize(log).identifications[0].notes)
    short = run(window=3 * H)
    assert np.isnan(theta(short)[-1]).all()
    found = recorded_identification(short)["identifier"]
    assert found.problem
    assert found.parameters == ()


def test_verdicts_beside_forgetting_say_that_they_do_not_forget():
    """And the estimate that forgot too much has its reason."""
    log = run(forgetting=1e-3)
    assert np.isnan(theta(log)[-1]).all()
    notes = " ".join(summarize(log).identifications[0].notes)
    assert "weigh all samples equally" in notes
    assert "identifier.theta itself has no value at the end" in notes
    found = recorded_identification(log)["identifier"]
    assert {parameter.verdict for parameter in found.parameters} == {"IDENTIFIABLE"}


@pytest.mark.usefixtures("without_verdicts")
def test_the_smoothed_disturbance_does_not_lag_as_that_of_the_observer_does():
    """The start of a Kalman filter is of smoothed delta, beside alphas of its own instants.

    The smoothed delta errs by 1e-3 of theta (see the theory's tests); with alphas half a second
    late the search began elsewhere and ended 4 off.
    """
    changes = {
        "identifier.method": "augmented-kalman",
        "identifier.start": 12.0,
        "observer.filter": "consistent",
        "observer.filter_rate": 2.0,
        "scenario.step": 0.02,
        "scenario.stop": 24.0,
    }
    log = cosim.run("academic", set=changes)
    np.testing.assert_allclose(log["identifier.theta"][-1], THETA, rtol=0, atol=5e-3)
