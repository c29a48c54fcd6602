"""The basin of the staged estimate, and what it says of the starts that end elsewhere."""

import numpy as np
import pytest

import cosim
from cosim.theory import observer
from cosim.theory.descriptor import reduce
from cosim.theory.disturbance import Exponential, group_by_alpha
from cosim.theory.disturbed_plant import DataSet, disturbed_plant
from cosim.theory.estimators.output_error import fit_output_error
from cosim.theory.estimators.rayleigh import means, noise_covariance, rayleigh_constants
from cosim.theory.estimators.staged import Reconstruction, StagedEstimator
from cosim.theory.observer import design
from cosim.theory.regression import alpha_products, expand
from tests.scenario.online import COARSE, noisy
from tests.theory.academic import DELAYS, THETA, academic, alpha, delayed

FAMILIES = (Exponential(), Exponential())
AXIS = np.linspace(-3.0, 0.3, 9)
STARTS = np.stack(np.meshgrid(AXIS, AXIS), axis=-1).reshape(-1, 2)


class Recorded:
    """A run of the example with noise, and the estimator of what it recorded."""

    def __init__(self, folder, sigma, settings):
        log = cosim.run(noisy(folder), set={**settings, "sensor.noise": sigma, "sensor.seed": 3})
        y = np.reshape(log["sensor.y"], (-1, 1))
        t = np.arange(len(y)) * settings.get("scenario.step", 1e-3)
        self.data = DataSet(t, y, np.reshape(log["u.y"], (-1, 1)), alpha(t))
        reduced = reduce(academic())
        self.plant = disturbed_plant(reduced, 2)
        rate = settings["observer.filter_rate"]
        realized = observer.realize(reduced, design(reduced, L=[4.0, 0.0], filter_rate=rate))
        terms = expand((1, 1))
        counts = t >= settings["identifier.start"]
        average = round(0.5 / (t[1] - t[0]))
        _, factors = delayed(t[counts])
        rows = log["regressor.mu"][counts]
        span = float(t[-1])
        groups = group_by_alpha(["a", "b"], FAMILIES)
        reconstruction = Reconstruction(
            mu=means(rows, average),
            N=noise_covariance(terms, means(alpha_products(terms, factors), average)),
            rayleigh=rayleigh_constants(FAMILIES, groups, terms, DELAYS, span=span),
            delta=np.ravel(log["observer.delta"]),
            modes=realized.A,
            row=realized.C[len(reduced.A_a)],
        )
        self.estimator = StagedEstimator(
            self.data, self.plant, FAMILIES, reconstruction, average=max(1, average // 10)
        )
        self.optimum = fit_output_error([self.data], self.plant, FAMILIES, np.array(THETA))


def reached(recorded):
    """Return how many of 81 starts reach the optimum; all must say truly whether they did."""
    count = 0
    best = recorded.optimum
    small = 0.1 * best.standard_error + 1e-9
    for start in STARTS:
        estimate = recorded.estimator.estimate(start)
        is_there = bool((np.abs(estimate.fit.theta - best.theta) < small).all())
        assert estimate.is_optimum == is_there
        count += is_there
    return count


@pytest.fixture(scope="module", params=[0.0, 1e-3])
def coarse(request, tmp_path_factory):
    """40 s at a step of 10 ms."""
    settings = {**COARSE, "scenario.stop": 40.0, "identifier.start": 6.5}
    settings["observer.filter_rate"] = 300.0
    return Recorded(tmp_path_factory.mktemp("noisy"), request.param, settings)


def test_the_search_finds_the_optimum(coarse):
    """From nothing."""
    found = coarse.estimator.estimate()
    assert found.is_optimum
    error = np.abs(found.fit.theta - coarse.optimum.theta)
    assert (error < 0.1 * coarse.optimum.standard_error + 1e-9).all()


def test_nearly_all_starts_reach_the_optimum(coarse):
    """80 of 81 at least."""
    assert reached(coarse) >= 80


def test_starts_that_end_elsewhere_say_so(tmp_path):
    """In a record half as long, whose filter lags ten times as much, some of them do."""
    count = reached(Recorded(tmp_path, 1e-3, COARSE))
    assert 54 <= count < 81


def test_a_local_minimum_of_output_error_is_no_optimum(coarse):
    """It converged, with an error that its own covariance denies; the search finds better."""
    local = fit_output_error([coarse.data], coarse.plant, FAMILIES, np.array([-2.8, -0.1]))
    found = coarse.estimator.estimate()
    elsewhere = np.abs(local.theta - THETA).max() > 0.1
    assert elsewhere
    assert local.deviation > 2.0 * found.fit.deviation


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
    assert reached(recorded) >= 80
