"""Whether the samples of a residual are what noise leaves: by the tests of identification.

A residual is the output of a plant without states, input and disturbance, so that what is said of
it, and the color of its noise, are those of an identifier's verdict.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from cosim.arrays import Vector
from cosim.theory.assessment.assessing import assess
from cosim.theory.assessment.noise_color import largest_power
from cosim.theory.disturbances.families import Polynomial
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.output_error import OutputErrorProblem

_NOTHING: Final = np.zeros((0, 0))
_PLANT: Final = DisturbedPlant(
    A=_NOTHING,
    B=_NOTHING,
    Bd=np.zeros((0, 1)),
    C=np.zeros((1, 0)),
    D=np.zeros((1, 0)),
    Dd=np.ones((1, 1)),
)


def residual_noise(t: Vector, residual: Vector) -> tuple[str, float, float]:
    """Test samples of a residual, shape (N,), at ascending instants t [s].

    Returns
    -------
    problem : str
        Why it is not what noise leaves; empty: it is.
    power : float
        The largest power of the noise at a frequency, over its mean; 1: it is white.
    freedom : float
        Degrees of freedom of that power.

    Raises
    ------
    AssumptionError
        If there are hardly any.
    """
    samples = len(residual)
    data = DataSet(t, residual[:, np.newaxis], np.zeros((samples, 0)), np.zeros((samples, 1)))
    found = assess(OutputErrorProblem([data], _PLANT, [Polynomial(0)]))
    problem = "" if found.consistency.passed else found.consistency.contradiction
    power = largest_power(found.noise.a[0])
    return problem.replace(" in y[0]", ""), power, found.noise.freedom
