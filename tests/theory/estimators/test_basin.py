"""The basin of output error: what 49 starts reach, in turn by each stage and in the identifier."""

from __future__ import annotations

import numpy as np
import pytest

import cosim
from cosim.theory.assessment.assessing import assess_near
from cosim.theory.disturbances.families import Exponential, group_by_alpha
from cosim.theory.disturbances.regression import alpha_products, expand
from cosim.theory.disturbed_plant import DataSet, disturbed_plant, white_noise
from cosim.theory.documents import Verdict
from cosim.theory.estimators.output_error import OutputErrorProblem, fit_output_error
from cosim.theory.estimators.rayleigh import rayleigh_constants
from cosim.theory.estimators.start_grid import search_start
from cosim.theory.observers import observer
from cosim.theory.observers.observer import design
from cosim.theory.plants.descriptor import reduce
from tests.scenario.online import COARSE, noisy
from tests.theory.academic import DELAYS, THETA, academic, alpha, delayed
from tests.theory.estimators.passes import means, noise_covariance, project, rayleigh

FAMILIES = (Exponential(), Exponential())
AXIS = np.linspace(-3.0, 0.3, 7)
STARTS = np.stack(np.meshgrid(AXIS, AXIS), axis=-1).reshape(-1, 2)


class Recorded:
    """A run of the example with noise, and the stages of what it recorded."""

    def __init__(self, folder, sigma, settings):
        self.scenario = noisy(folder)
        self.settings = {**settings, "sensor.noise": sigma, "sensor.seed": 3}
        self.log = cosim.run(self.scenario, set=self.settings)
        y = np.reshape(self.log["sensor.y"], (-1, 1))
        self.h = settings.get("scenario.step", 1e-3)
        self.t = np.arange(len(y)) * self.h
        self.samples = (self.t, y, np.reshape(self.log["u.y"], (-1, 1)), alpha(self.t))
        self.data = DataSet(*self.samples)
        reduced = reduce(academic())
        self.plant = disturbed_plant(reduced, [0, 0])
        rate = settings["observer.filter_rate"]
        realized = observer.realize(reduced, design(reduced, L=[4.0, 0.0], filter_rate=rate))
        self.modes = realized.A
        self.row = realized.C[len(reduced.A_a)]
        terms = expand((1, 1))
        counts = self.t >= settings["identifier.start"]
        average = round(0.5 / self.h)
        _, factors = delayed(self.t[counts])
        self.mu = means(self.log["regressor.mu"][counts], average)
        self.N = noise_covariance(terms, means(alpha_products(terms, factors), average))
        groups = group_by_alpha(["a", "b"], FAMILIES)
        self.rayleigh = rayleigh_constants(FAMILIES, groups, terms, DELAYS)
        self.optimum = self.fit(np.array(THETA))

    def fit(self, theta):
        return fit_output_error([self.data], self.plant, FAMILIES, theta)

    def in_turn(self, theta):
        """Fit from a start: the quotient, delta, then y."""
        found = rayleigh(self.rayleigh, self.mu, self.N, theta=theta).theta
        delta = np.ravel(self.log["observer.delta"])
        on_delta = project(
            self.t, delta, self.data.alpha, FAMILIES, found, A=self.modes, c=self.row
        )
        return self.fit(on_delta.theta if on_delta.converged else found)

    def is_optimum(self, theta):
        small = 0.1 * self.optimum.standard_error + 1e-9
        return bool((np.abs(theta - self.optimum.theta) < small).all())

    def is_said_to_be_wrong(self, theta):
        """Whether no parameter has a verdict that stands for its interval."""
        verdicts = assess_near(
            OutputErrorProblem([self.data], self.plant, FAMILIES), theta
        ).parameters
        doubts = (Verdict.INCONSISTENT, Verdict.NOT_IDENTIFIABLE, Verdict.NO_ESTIMATE)
        return all(one.verdict in doubts for one in verdicts)


def reached(recorded):
    """Return how many of 49 starts reach the optimum in turn; the others must say so."""
    count = 0
    judged = []
    for start in STARTS:
        theta = recorded.in_turn(start).theta
        if recorded.is_optimum(theta):
            count += 1
        elif not any(np.allclose(theta, other, rtol=1e-6) for other in judged):
            assert recorded.is_said_to_be_wrong(theta)
            judged.append(theta)
    return count


@pytest.fixture(scope="module", params=[0.0, 1e-3])
def coarse(request, tmp_path_factory):
    """40 s at a step of 10 ms."""
    settings = {**COARSE, "scenario.stop": 40.0, "identifier.start": 6.5}
    settings["observer.filter_rate"] = 300.0
    return Recorded(tmp_path_factory.mktemp("noisy"), request.param, settings)


@pytest.fixture(scope="module")
def lagging(tmp_path_factory):
    """Half as long, with a filter that lags three times as much."""
    return Recorded(tmp_path_factory.mktemp("noisy"), 1e-3, COARSE)


@pytest.mark.fast("0.001")
def test_nearly_all_starts_reach_the_optimum(coarse):
    """48 of 49 at least."""
    assert reached(coarse) >= 48


def test_starts_that_end_elsewhere_say_so(lagging):
    """In a short record whose filter lags some of them do."""
    assert reached(lagging) < 49


def test_the_search_finds_the_optimum(coarse):
    """From y alone."""
    start = search_start(OutputErrorProblem([coarse.data], coarse.plant, FAMILIES), white_noise(1))
    assert coarse.is_optimum(coarse.fit(start).theta)


def test_a_local_minimum_of_output_error_is_no_optimum(coarse):
    """It converged, with an error that its own covariance denies; but the verdict does not hold."""
    local = coarse.fit(np.array([-2.8, -0.1]))
    assert local.converged
    assert np.abs(local.theta - THETA).max() > 0.1
    assert coarse.is_said_to_be_wrong(local.theta)


def check_estimates(recorded):
    """Check that at every whole second the identifier gives the optimum of its samples, or none."""
    estimates = recorded.log["identifier.theta"]  # one row a period
    valued = 0
    for second in range(2, int(recorded.t[-1]) + 1):
        theta = estimates[round(second / recorded.settings["identifier.period"])]
        if np.isnan(theta).any():
            continue
        valued += 1
        so_far = DataSet(*(values[: round(second / recorded.h)] for values in recorded.samples))
        best = fit_output_error([so_far], recorded.plant, FAMILIES, np.array(THETA))
        assert (np.abs(theta - best.theta) < 0.1 * best.standard_error + 1e-9).all()
    assert valued >= recorded.t[-1] - 6.0


def test_the_identifier_gives_the_optimum_of_its_samples_or_none(coarse):
    """From a start of its own: never a local minimum."""
    check_estimates(coarse)


def test_the_identifier_does_so_where_its_regression_misleads(lagging):
    """The quotient of a delta that lags has its minimum elsewhere."""
    check_estimates(lagging)


@pytest.mark.campaign
@pytest.mark.parametrize("sigma", [0.0, 1e-3])
def test_the_whole_basin(sigma, tmp_path):
    """At a step of 1 ms."""
    settings = {
        "identifier.method": "output-error",
        "identifier.period": 0.1,
        "identifier.start": 6.461,
        "observer.filter_rate": 1e3,
    }
    recorded = Recorded(tmp_path, sigma, settings)
    assert reached(recorded) >= 48
