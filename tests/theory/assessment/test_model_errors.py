"""What a wrong model would leave rests on the model, not on the last bits of instants."""

import numpy as np
import pytest
from scipy.signal import lfilter

from cosim.theory.assessment.assessing import assess
from cosim.theory.disturbances.families import Exponential
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.output_error import OutputErrorProblem


def test_a_constant_alpha_has_no_slope_at_any_instants():
    """Its rounding at unequal distances was taken for directions that colored noise has, too.

    So the color and with it the intervals were others with stamps one unit in the last place off.
    """
    one = np.ones((1, 1))
    nothing = np.zeros((1, 1))
    plant = DisturbedPlant(A=-one, B=one, Bd=one, C=one, D=nothing, Dd=nothing)
    rng = np.random.default_rng(3)
    t = 0.02 * np.arange(300) + 0.004 * rng.random(300)
    noise = 1e-3 * lfilter([1.0], [1.0, -0.5], rng.standard_normal(300))
    y = (np.exp(-0.3 * t) - np.exp(-t)) / 0.7 + noise
    found = []
    for own in (t, np.nextafter(t, np.inf)):
        data = DataSet(own, y[:, np.newaxis], np.zeros((300, 1)), np.ones((300, 1)))
        found.append(assess(OutputErrorProblem([data], plant, [Exponential()])))
    first, second = found
    errors = first.consistency.tested[0].tested_errors().errors
    assert not any("alpha" in error.name for error in errors)
    assert second.noise.a == pytest.approx(first.noise.a, rel=1e-6)
    error = first.parameters[0].standard_error
    assert second.parameters[0].standard_error == pytest.approx(error, rel=1e-6)
