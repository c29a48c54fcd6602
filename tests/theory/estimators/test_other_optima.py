"""Starts beside a known optimum: one term moves, all others explain what they can."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.theory.disturbances.families import Sine
from cosim.theory.disturbed_plant import DataSet, white_noise
from cosim.theory.estimators.other_optima import starts_beside
from cosim.theory.estimators.output_error import OutputErrorProblem
from tests.theory.closed_forms import static_plant

T = 0.02 * np.arange(1001)
ALPHA = np.stack([1.35 + 0.25 * np.sin(1.7 * T), 1.1 + 0.2 * np.cos(2.3 * T)], axis=1)


@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e9])
def test_each_term_is_moved_beside_the_other_in_any_unit_of_the_disturbance(unit):
    """Of rates 1.3 and 2.9, the second known as 6: one stays as it is known, one goes to 2.9."""
    y = ALPHA[:, 0] * np.sin(1.3 * T) + ALPHA[:, 1] * np.cos(2.9 * T)
    data = DataSet(T, y[:, np.newaxis], np.zeros((len(T), 0)), unit * ALPHA)
    known = np.array([1.3, 6.0])
    bounds = {0: (0.2, 10.0), 1: (0.2, 10.0)}
    problem = OutputErrorProblem([data], static_plant(2), (Sine(), Sine()), bounds=bounds)
    starts = starts_beside(problem.sampled(white_noise(1)), known)
    of_terms = starts[-4:]  # two of each term, behind those of a grid
    spacing = 9.8 / 32  # of 32 points along a rate
    assert [start[1] for start in of_terms[:2]] == [6.0, 6.0]
    assert [start[0] for start in of_terms[2:]] == [1.3, 1.3]
    assert of_terms[0][0] == pytest.approx(2.9, abs=0.5 * spacing)
    assert of_terms[2][1] == pytest.approx(2.9, abs=0.5 * spacing)
