"""Identifiers that take y themselves, whatever the observer makes of delta."""

import numpy as np

import cosim


def test_the_smoothed_disturbance_does_not_lag_as_that_of_the_observer_does():
    """The start is of smoothed delta, beside alphas of its own instants, not of the observer's.

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
    np.testing.assert_allclose(log["identifier.theta"][-1], [-0.1, -0.3], rtol=0, atol=5e-3)
