"""The instants of samples: what is refused where they must be equally spaced."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.errors import AssumptionError
from cosim.theory.bounded.irregular_part import bounded_problem
from cosim.theory.disturbances.families import Exponential, group_by_alpha
from cosim.theory.disturbances.regression import expand
from cosim.theory.estimators.least_squares import plan
from cosim.theory.sampling import distinct_steps, equal_step
from tests.theory.estimators.passes import drem, extended_kalman, gradient, smoothed_disturbance
from tests.theory.lag import FAMILY, lag, record


def test_the_rounding_of_times_makes_no_other_step(subtests):
    """Far from 0 too, where the times have fewer digits."""
    for step in [1e-3, 1e-2 / 3.0, 7.0]:
        with subtests.test(step=step):
            for start in (0.0, 1e3):
                t = start + np.arange(1000) * step
                assert equal_step(t) == pytest.approx(step, abs=1e-12)


def test_the_steps_that_differ_are_found_with_their_places():
    """As often as they come: two here."""
    t = np.cumsum([0.0, 0.1, 0.2, 0.1, 0.1, 0.2])
    steps, index = distinct_steps(t)
    np.testing.assert_allclose(steps, [0.1, 0.2])
    np.testing.assert_array_equal(index, [0, 0, 1, 0, 0, 1])


EQUAL_METHODS = {
    "gradient": lambda t: gradient(t, np.ones((len(t), 3)), two_exponentials()),
    "drem": lambda t: drem(t, np.ones((len(t), 3)), two_exponentials()),
    "augmented Kalman": lambda t: smoothed_disturbance(
        t, np.ones((len(t), 1)), np.ones((len(t), 1)), lag()
    ),
    "extended Kalman": lambda t: extended_kalman(
        t, np.ones((len(t), 1)), np.ones((len(t), 1)), ["1"], lag(), FAMILY
    ),
    "irregular part": lambda t: bounded_problem(
        record(t, t, np.ones((len(t), 1))), lag(), FAMILY, bound=1.0
    ),
}


def two_exponentials():
    """Return how theta follows from eta."""
    groups = group_by_alpha(["a", "a"], [Exponential(), Exponential()])
    return plan(expand((2,)), groups, [1.0, 2.0, 3.0])


def test_a_method_for_equal_steps_refuses_others(subtests):
    """It names the place and the step there, and takes times that are merely rounded."""
    for method in EQUAL_METHODS:
        with subtests.test(method=method):
            t = 1e4 + np.arange(100) * 1e-2
            EQUAL_METHODS[method](t)
            t[50:] += 1e-3
            with pytest.raises(AssumptionError, match=r"after t = 10000.* s comes 0\.011 s later"):
                EQUAL_METHODS[method](t)
