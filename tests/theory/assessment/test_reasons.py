"""What verdicts say where there is no number, or none that may be trusted: causes and ways out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cosim.errors import AssumptionError
from cosim.theory.assessment.amplitude_verdicts import amplitude_verdicts
from cosim.theory.assessment.assessing import assess, assess_near
from cosim.theory.assessment.verdicts import judge
from cosim.theory.disturbances.families import (
    DampedSine,
    Exponential,
    Polynomial,
    Sine,
    TExponential,
)
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant, white_noise
from cosim.theory.documents import Verdict
from cosim.theory.estimators.output_error import OutputErrorProblem, SampledProblem
from cosim.theory.estimators.start_grid import ITERATIONS, STARTS, search_start

TRUE = -0.4
T = np.arange(501) * 0.02
ONE = (Exponential(),)


def plant(terms: int) -> DisturbedPlant:
    """Return `x' = -x + sum_i alpha_i f_i, y = x`."""
    return DisturbedPlant(
        A=-np.eye(1),
        B=np.zeros((1, 0)),
        Bd=np.ones((1, terms)),
        C=np.eye(1),
        D=np.zeros((1, 0)),
        Dd=np.zeros((1, terms)),
    )


def measured(*alphas: float, t=T, amplitude: float = 2.0, sigma: float = 1e-3) -> DataSet:
    """Return noisy samples of x under `amplitude exp(-0.4 t)`, with constant alphas."""
    x = 0.5 * np.exp(-t) + amplitude * np.exp(TRUE * t) / (1.0 + TRUE)
    y = x + sigma * np.random.default_rng(5).standard_normal(len(t))
    alpha = np.tile(alphas, (len(t), 1))
    return DataSet(t, y[:, np.newaxis], np.zeros((len(t), 0)), alpha)


@pytest.mark.parametrize("start", [64.2, -1e6, 1e300])
def test_a_start_whose_response_is_not_finite_is_replaced(start):
    """By a searched one: it says nothing of the data."""
    found = assess(OutputErrorProblem([measured(1.0)], plant(1), ONE), np.array([start]))
    assert found.parameters[0].verdict is Verdict.IDENTIFIABLE
    assert found.parameters[0].lower <= TRUE <= found.parameters[0].upper


def test_an_infinite_response_is_no_lack_of_samples():
    """One error for each: the number of samples, and the start."""
    with pytest.raises(AssumptionError, match=r"at theta = \[64.2\] is not finite"):
        assess_near(OutputErrorProblem([measured(1.0)], plant(1), ONE), np.array([64.2]))
    with pytest.raises(AssumptionError, match="at least 3 measured values for 3 unknowns, got 2"):
        assess_near(OutputErrorProblem([measured(1.0, t=T[:2])], plant(1), ONE), np.array([-0.3]))


@pytest.mark.parametrize("shown", ["absent", "other", "both"])
def test_a_term_whose_alpha_is_zero_has_no_theta(shown):
    """However large a residual it leaves: no residual makes it a number."""
    alphas = {"absent": (0.0,), "other": (0.0, 1.0), "both": (0.0, 0.0)}[shown]
    families = ONE * len(alphas)
    found = assess(OutputErrorProblem([measured(*alphas)], plant(len(alphas)), families))
    verdicts = [parameter.verdict for parameter in found.parameters]
    for parameter, alpha in zip(found.parameters, alphas, strict=True):
        if alpha == 0.0:
            assert parameter.verdict is Verdict.NOT_IDENTIFIABLE
            assert parameter.value is None
            assert "is 0 at every sample" in parameter.reason
    assert (verdicts[-1] is Verdict.IDENTIFIABLE) == (shown == "other")
    own = judge(found, np.full(len(alphas), -5.9), None)
    assert own[0].value is None


def test_terms_that_do_not_reach_the_output_have_no_theta():
    """Alpha is not zero, but the response is."""
    blind = DisturbedPlant(
        A=-np.eye(2),
        B=np.zeros((2, 0)),
        Bd=np.array([[1.0, 0.0], [0.0, 1.0]]),
        C=np.array([[1.0, 0.0]]),
        D=np.zeros((1, 0)),
        Dd=np.zeros((1, 2)),
    )
    first, second = assess(OutputErrorProblem([measured(1.0, 1.0)], blind, ONE * 2)).parameters
    assert first.verdict is Verdict.IDENTIFIABLE
    assert second.verdict is Verdict.NOT_IDENTIFIABLE
    assert "does not reach y" in second.reason


@pytest.mark.parametrize("alphas", [(1.0, 1.0), (1.0, -2.5)])
def test_terms_of_which_one_explains_the_data_are_named(alphas):
    """More data or less noise would not help: two equal terms share one amplitude anyhow."""
    found = assess(OutputErrorProblem([measured(*alphas)], plant(2), ONE * 2))
    assert Verdict.NOT_IDENTIFIABLE in [parameter.verdict for parameter in found.parameters]
    for parameter, other in zip(found.parameters, (1, 0), strict=True):
        if parameter.verdict.has_value:
            assert parameter.lower <= TRUE <= parameter.upper
            continue
        assert f"without terms[{other}] " in parameter.reason
        assert "less noise" not in parameter.reason


@pytest.mark.parametrize("terms", [1, 2])
def test_a_term_that_is_lost_in_noise_is_called_so(terms):
    """The other cause of the same verdict."""
    found = assess(
        OutputErrorProblem([measured(*[1.0] * terms, amplitude=0.0)], plant(terms), ONE * terms)
    )
    for parameter in found.parameters:
        assert parameter.verdict is Verdict.NOT_IDENTIFIABLE
        assert "less noise would show it" in parameter.reason


def test_a_term_that_is_absent_beside_one_that_is_there_is_called_so():
    """The alphas differ: the second explains nothing of the first."""
    data = measured(1.0, 1.0)
    alpha = np.stack([np.ones(len(T)), 1.0 + np.sin(3.0 * T)], axis=1)
    first, second = assess(
        OutputErrorProblem([DataSet(T, data.y, data.u, alpha)], plant(2), ONE * 2)
    ).parameters
    assert first.verdict is Verdict.IDENTIFIABLE
    assert second.verdict is Verdict.NOT_IDENTIFIABLE
    assert "less noise would show it" in second.reason


def test_a_wrong_family_says_what_to_do():
    """The iteration runs towards a sine of rate 0: the family has no exponential."""
    (parameter,) = assess(OutputErrorProblem([measured(1.0)], plant(1), (Sine(),))).parameters
    assert parameter.verdict in (Verdict.NO_ESTIMATE, Verdict.INCONSISTENT)
    assert parameter.lower is None
    if parameter.verdict is Verdict.NO_ESTIMATE:
        assert "family" in parameter.reason


@pytest.mark.parametrize("start", [None, np.array([np.nan])])
def test_two_optima_of_one_term_are_told(start):
    """A start and a slope under one exponent: (1 + 0.5 t) exp(-0.519 t) is nearly another one.

    Also where the run had no estimate to start from.
    """
    t = np.linspace(0.0, 6.0, 301)
    theta = -0.519
    slope = 0.5 / (1.0 + theta)
    level = (1.0 - slope) / (1.0 + theta)
    x = (level + slope * t) * np.exp(theta * t) - level * np.exp(-t)
    y = x + 0.05 * np.random.default_rng(2).standard_normal(len(t))
    data = DataSet(t, y[:, np.newaxis], np.zeros((len(t), 0)), np.ones((len(t), 1)))
    found = assess(OutputErrorProblem([data], plant(1), (TExponential(),)), start)
    (parameter,) = found.parameters
    assert parameter.verdict is Verdict.WEAK
    assert "theta = -0.06768 explains the data too" in parameter.reason


def test_bounds_that_stop_an_iteration_are_named():
    """Of a rate of 6 and an exponent of -0.5; the exponential runs towards the constant."""
    t = np.linspace(0.0, 10.0, 501)
    y = np.sin(6.0 * t) + np.exp(-0.5 * t) + 1e-3 * np.random.default_rng(1).standard_normal(501)
    data = DataSet(t, y[:, np.newaxis], np.zeros((501, 0)), np.ones((501, 3)))
    none = np.zeros((0, 0))
    still = DisturbedPlant(
        A=none,
        B=none,
        Bd=np.zeros((0, 3)),
        C=np.zeros((1, 0)),
        D=np.zeros((1, 0)),
        Dd=np.ones((1, 3)),
    )
    families = (Sine(), Exponential(), Polynomial(0))
    bounds = {0: (-1.0, 0.0), 1: (0.0, 10.0)}
    for parameter in assess(OutputErrorProblem([data], still, families, bounds=bounds)).parameters:
        assert parameter.verdict is Verdict.NO_ESTIMATE
        assert "a bound of theta[0], a family" in parameter.reason


def test_the_color_of_noise_is_not_asked_for_without_an_estimate(monkeypatch):
    """The fit has not converged: its verdict is that of any noise."""

    def no_color(*_):
        raise AssertionError("the color of the noise was asked for")

    monkeypatch.setattr("cosim.theory.assessment.noise_color.noise_color", no_color)
    assessment = assess(OutputErrorProblem([measured(1.0)], plant(1), (DampedSine(),)))
    assert assessment.consistency.is_structured
    assert {one.verdict for one in assessment.parameters} == {Verdict.NO_ESTIMATE}


def test_only_the_best_start_is_followed_where_none_gets_to_an_optimum(monkeypatch):
    """A damped sine beside a constant, of an exponential: its rate runs towards 0 from anywhere."""
    iterations = []
    own_fit = SampledProblem.fit

    def fit(*given):
        found = own_fit(*given)
        iterations.append(found.iterations)
        return found

    monkeypatch.setattr(SampledProblem, "fit", fit)
    families = (DampedSine(), Polynomial(0))
    problem = OutputErrorProblem([measured(1.0, 1.0)], plant(2), families)
    search_start(problem, white_noise(1))
    assert iterations == [ITERATIONS + 1] * STARTS  # the last step is refused


@pytest.mark.parametrize(
    ("bounds", "side", "bound"), [((-0.3, 0.0), "lower", "-0.3"), ((-9.0, -0.5), "upper", "-0.5")]
)
@pytest.mark.parametrize("sigma", [1e-3, 1.0])
def test_an_estimate_at_a_bound_names_it(bounds, side, bound, sigma):
    """Whether its residual is that of noise or not."""
    data = measured(1.0, sigma=sigma, amplitude=2.0 if sigma < 0.1 else 40.0)
    (parameter,) = assess(OutputErrorProblem([data], plant(1), ONE, bounds={0: bounds})).parameters
    assert parameter.value == float(bound)
    assert f"theta[0] stands at its {side} bound {bound}" in parameter.reason
    assert "widen" in parameter.reason
    assert "dynamics" not in parameter.reason
    assert parameter.lower is None


def test_an_inconsistent_parameter_has_no_interval():
    """There is none that holds."""
    data = measured(1.0)
    wrong = DataSet(data.t, data.y + 0.1 * np.sin(data.t)[:, np.newaxis], data.u, data.alpha)
    found = assess(OutputErrorProblem([wrong], plant(1), ONE))
    (parameter,) = found.parameters
    assert parameter.verdict is Verdict.INCONSISTENT
    assert parameter.value is not None
    assert (parameter.standard_error, parameter.lower, parameter.upper) == (None, None, None)
    ((amplitude,),) = amplitude_verdicts(found)
    assert amplitude.value is not None
    assert (amplitude.standard_error, amplitude.lower, amplitude.upper) == (None, None, None)
    (biased,) = judge(
        assess(OutputErrorProblem([data], plant(1), ONE)), np.array([-50.9]), np.array([1e-9])
    )
    assert biased.verdict is Verdict.INCONSISTENT
    assert biased.value == -50.9
    assert (biased.standard_error, biased.lower, biased.upper) == (None, None, None)
    assert "more than both intervals allow" in biased.reason


@pytest.mark.parametrize("value", [0.0, 3.0, -1.0])
def test_an_output_that_does_not_change_is_named(value):
    """No distance of the samples would help: u moves the plant, and y does not show it."""
    forced = replace(plant(1), B=np.ones((1, 1)), D=np.zeros((1, 1)))
    u = np.where(T >= 2.0, 1.0, 0.0)[:, np.newaxis]
    data = DataSet(T, np.full((len(T), 1), value), u, np.ones((len(T), 1)))
    (parameter,) = assess(OutputErrorProblem([data], forced, ONE)).parameters
    assert parameter.lower is None
    assert f"y[0] is {value:g} at every sample" in parameter.reason
    assert "far apart" not in parameter.reason


def test_an_output_that_stands_at_a_limit_is_named():
    """A sensor at the lower limit of its range from ln(...) on."""
    data = measured(1.0)
    cut = DataSet(T, np.maximum(data.y, 1.0), data.u, data.alpha)
    (parameter,) = assess(OutputErrorProblem([cut], plant(1), ONE)).parameters
    since = T[np.flatnonzero(data.y[:, 0] > 1.0)[-1] + 1]
    assert parameter.verdict is Verdict.INCONSISTENT
    assert f"y[0] stands at 1 from {since:g} s to 10 s" in parameter.reason


def test_samples_too_far_apart_are_called_so():
    """Their distance counts, which of recorded data is no step of a simulation."""
    t = T[::50]
    y = np.exp(-t) + np.sin(2.0 * t)
    u = 3.0 * np.sin(3.0 * t)[:, np.newaxis]
    forced = replace(plant(1), B=np.ones((1, 1)), D=np.zeros((1, 1)))
    data = DataSet(t, y[:, np.newaxis], u, np.ones((len(t), 1)))
    (parameter,) = assess(OutputErrorProblem([data], forced, ONE)).parameters
    assert "the samples are too far apart" in parameter.reason
    assert "stands" not in parameter.reason


def test_a_failed_test_of_several_data_sets_names_that_of_it():
    """The second is of another plant; numbers begin with 1."""
    good = measured(1.0)
    bad = DataSet(T, good.y + 0.1 * np.sin(T)[:, np.newaxis], good.u, good.alpha)
    (parameter,) = assess_near(
        OutputErrorProblem([good, bad], plant(1), ONE), np.array([TRUE])
    ).parameters
    assert parameter.verdict is Verdict.INCONSISTENT
    assert "data set 2, whiteness" in parameter.reason


def test_a_single_sample_is_no_record():
    """Refused by name, before a time scale is divided by its length."""
    with pytest.raises(AssumptionError, match="a single sample at 0 s"):
        assess(OutputErrorProblem([measured(1.0, t=T[:1])], plant(1), ONE))


def test_another_value_than_a_fixed_one_is_biased():
    """Of a fixed theta there is no interval: only the other estimate's own one reaches it."""
    assessment = assess(
        OutputErrorProblem([measured(1.0)], plant(1), ONE, bounds={0: (TRUE, TRUE)})
    )
    for value, verdict in ((TRUE + 0.5, Verdict.INCONSISTENT), (TRUE, Verdict.IDENTIFIABLE)):
        (judged,) = judge(assessment, np.array([value]), np.array([1e-3]))
        assert judged.verdict is verdict


@pytest.mark.parametrize("start", [-3.0, 0.3, 5.0])
def test_a_start_that_leads_elsewhere_says_nothing_against_the_model(start):
    """It is searched for another one."""
    found = assess(OutputErrorProblem([measured(1.0)], plant(1), ONE), np.array([start]))
    assert found.parameters[0].verdict is Verdict.IDENTIFIABLE
    assert found.parameters[0].lower <= TRUE <= found.parameters[0].upper


def test_an_output_in_another_unit_is_a_wrong_model_and_not_a_long_step():
    """A gain of 1e-9 forgotten: no shorter step would help."""
    t = np.linspace(0.0, 20.0, 2001)
    u = np.sin(t)[:, np.newaxis]
    model = plant(1)
    forced = DisturbedPlant(
        A=model.A, B=np.ones((1, 1)), Bd=model.Bd, C=model.C, D=np.zeros((1, 1)), Dd=model.Dd
    )
    x = 0.5 * (np.sin(t) - np.cos(t)) + np.exp(-t) + 2.0 * np.exp(TRUE * t) / (1.0 + TRUE)
    noise = 1e-3 * np.random.default_rng(7).standard_normal(len(t))
    data = DataSet(t, 1e-9 * (x + noise)[:, np.newaxis], u, np.ones((len(t), 1)))
    (parameter,) = assess(OutputErrorProblem([data], forced, ONE)).parameters
    assert parameter.verdict is Verdict.INCONSISTENT
    assert "samples are too far apart" not in parameter.reason
