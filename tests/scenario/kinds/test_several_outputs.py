"""Identifiers of plants with several outputs: each counts by its noise, stated or estimated."""

import numpy as np
import pytest

import cosim
from cosim.errors import CosimError
from cosim.scenario.exporting import export_component
from cosim.scenario.record import recorded_identification
from tests.scenario.online import TWO_OUTPUTS
from tests.scenario.refusals import check_refused

SIGMA = np.array([0.1, 1e-3])


@pytest.fixture(scope="module")
def two():
    """Return the scenario."""
    return cosim.load("academic-noisy").set(TWO_OUTPUTS)


@pytest.fixture(scope="module")
def log(two, tmp_path_factory):
    """Run it with nothing stated."""
    return cosim.run(two, out=tmp_path_factory.mktemp("two") / "two.mcap")


def verdicts(log):
    """Return what output error says at the end of a run."""
    return recorded_identification(log)["identifier"]


def test_online_and_offline_say_the_same_at_the_end(log):
    """Theta to a small part of its error, errors and deviations to those of their estimates.

    The noise is that of at least half of the samples, 1000: deviations are known to 2.2 %. Before,
    the error of every estimate is of the size of its standard error.
    """
    found = verdicts(log)
    offline = np.array([one.value for one in found.parameters])
    errors = np.array([one.standard_error for one in found.parameters])
    assert [one.verdict for one in found.parameters] == 2 * ["IDENTIFIABLE"]
    theta = log["identifier.theta"]
    assert (np.abs(theta[-1] - offline) < 0.05 * errors).all()
    np.testing.assert_allclose(log["identifier.standard_error"][-1], errors, rtol=0.05)
    np.testing.assert_allclose(log["identifier.deviation"][-1], found.deviation, rtol=0.05)
    np.testing.assert_allclose(found.deviation, SIGMA, rtol=0.1)
    late = log.time("identifier.theta") > 10.0
    relative = (theta - [-0.1, -0.3])[late] / log["identifier.standard_error"][late]
    assert 0.1 < np.abs(relative).max() < 4.5
    assert cosim.diff(log, cosim.replay(log.path)).equal


def test_stated_noise_weighs_the_outputs(two, log):
    """By its covariance: theta is that of the estimated one, but for a part."""
    stated = cosim.run(two, set={"identifier.covariance": [[1e-2, 0.0], [0.0, 1e-6]]})
    error = log["identifier.standard_error"][-1]
    apart = np.abs(stated["identifier.theta"][-1] - log["identifier.theta"][-1])
    assert (apart < 0.2 * error).all()
    np.testing.assert_allclose(stated["identifier.standard_error"][-1], error, rtol=0.1)
    np.testing.assert_allclose(stated["identifier.deviation"][-1], SIGMA, rtol=0.05)
    assert [one.verdict for one in verdicts(stated).parameters] == 2 * ["IDENTIFIABLE"]


@pytest.mark.slow
def test_noise_that_is_stated_wrong_is_said(two):
    """Ten times smaller than it is, of the exact output."""
    log = cosim.run(two, set={"identifier.deviation": [0.1, 1e-4]})
    for one in verdicts(log).parameters:
        assert one.verdict == "INCONSISTENT"
        assert "deviation of y[1] over the stated one" in one.reason


UNSTABLE = [[3, 1, 1], [0, -2, 1], [1, 0, 1]]
NO_NOISE = [
    ({}, "deviation"),
    ({"deviation": [0.1]}, r"deviation: expected one number, or one per output \(2\), got 1"),
    ({"deviation": 0.0}, "deviation: expected positive finite numbers, got 0.0"),
    ({"covariance": [[1.0, 0.0]]}, r"expected 2 rows of 2 numbers, got \[\[1.0, 0.0\]\]"),
    ({"covariance": [[1.0, 2.0], [2.0, 1.0]]}, "expected a symmetric positive definite"),
    ({"covariance": [[1.0, 0.1], [0.2, 1.0]]}, "expected a symmetric positive definite"),
    ({"deviation": 1.0, "covariance": [[1.0, 0.0], [0.0, 1.0]]}, "deviation and cov.* got both"),
    ({"method": "least-squares", "deviation": 1.0}, "deviation: .*'least-squares'"),
]


def test_a_wrong_noise_is_refused(two):
    """Before the run; what predicts one output of an unstable plant depends on the noise of all."""

    def refuse(options):
        own = {f"identifier.{key}": value for key, value in options.items()}
        cosim.run(two, set=own if options else {"models.academic.A": UNSTABLE})

    check_refused(NO_NOISE, refuse, CosimError)


def test_kalman_filters_take_one_deviation_an_output(two):
    """Two equal ones say what one number says, to the rounding of the scales; others do not."""
    ends = []
    for deviation in (0.1, [0.1, 0.1], [0.2, 0.1]):
        settings = {"identifier.method": "extended-kalman", "identifier.deviation": deviation}
        ends.append(cosim.run(two, set=settings)["identifier.theta"][-1])
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-6)
    assert np.abs(ends[2] - ends[0]).max() > 1e-5


@pytest.mark.slow
def test_an_exported_identifier_has_the_same_bits(two, log, tmp_path):
    """The weights are estimated by the same kernel in both homes."""
    fmu = tmp_path / "identifier.fmu"
    export_component(two, "identifier", fmu)
    settings = {"identifier.interface_type": "cs", "scenario.stop": 8.0}
    run = cosim.run(two, swap={"identifier": fmu}, set=settings)
    for signal in ("identifier.theta", "identifier.standard_error", "identifier.deviation"):
        found = run[signal][::10]  # the FMU has no period
        assert np.array_equal(found, log[signal][:81], equal_nan=True), signal
