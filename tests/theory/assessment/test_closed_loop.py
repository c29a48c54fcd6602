"""A loop that is closed over the noisy output: the noise in u is no error of the model."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.theory.assessment.assessing import assess_near
from cosim.theory.disturbances.families import Exponential
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.documents import Verdict
from cosim.theory.estimators.output_error import OutputErrorProblem

N = 2000
H = 0.0125  # s
SIGMA = 0.02
RATE = -0.15
A = np.array([[-0.4, 1.0], [0.0, -1.0]])
B = np.array([[0.0], [1.0]])
Bd = np.array([[0.5], [1.0]])


def plant(scale=1.0, pole=-1.0):
    matrix = A.copy()
    matrix[1, 1] = pole
    C = np.array([[1.0, 0.0]])
    return DisturbedPlant(
        A=matrix, B=scale * B, Bd=Bd, C=C, D=np.zeros((1, 1)), Dd=np.zeros((1, 1))
    )


def recorded(seed, delay, in_feedback=True):
    """Simulate the plant under u(k) = -4 y(k - delay) + sin(1.3 t), held, exactly."""
    held = expm(H * np.block([[A, B], [np.zeros((1, 3))]]))
    ramp = np.zeros((4, 4))
    ramp[:2, :2] = A * H
    ramp[:2, 2:3] = Bd * H
    ramp[2, 3] = 1.0
    lines = expm(ramp)
    end = lines[:2, 3]
    begin = lines[:2, 2] - end
    t = H * np.arange(N)
    f = 1.8 * np.exp(RATE * t)
    noise = SIGMA * np.random.default_rng(seed).standard_normal(N)
    disturbed = (np.outer(f[:-1], begin) + np.outer(f[1:], end)).tolist()
    (a11, a12, b1), (a21, a22, b2) = held[:2].tolist()
    reference = np.sin(1.3 * t)
    x1, x2 = 0.2, -0.1
    y = []
    u = []
    for k, (w1, w2) in enumerate(disturbed):
        y.append(x1 + noise[k])
        u.append(reference[k] - 4.0 * (y[k - delay] if k >= delay else 0.0))
        x1, x2 = a11 * x1 + a12 * x2 + b1 * u[k] + w1, a21 * x1 + a22 * x2 + b2 * u[k] + w2
    y.append(x1 + noise[-1])
    u.append(0.0)
    data = DataSet(t, np.array([y]).T, np.array([u]).T, np.ones((N, 1)), np.array([True]))
    return replace(data, in_feedback=np.array([in_feedback]))


def verdict(data, model):
    problem = OutputErrorProblem([data], model, [Exponential()])
    return assess_near(problem, np.array([RATE])).parameters[0]


@pytest.mark.parametrize("delay", [0, 1, 5])
def test_noise_that_is_fed_back_is_no_model_error(delay):
    """The data are those of the model, and theta is right within its interval."""
    missed = 0
    for seed in range(8):
        parameter = verdict(recorded(seed, delay), plant())
        assert parameter.verdict is Verdict.IDENTIFIABLE
        missed += not parameter.lower <= RATE <= parameter.upper
    assert missed <= 2


def test_noise_in_an_input_that_is_said_to_be_independent_contradicts_the_model():
    """The same data alarm where nothing says that u was computed from y."""
    parameter = verdict(recorded(0, 0, in_feedback=False), plant())
    assert parameter.verdict is Verdict.INCONSISTENT


@pytest.mark.parametrize("model", [plant(scale=1.1), plant(pole=-1.1)])
def test_a_wrong_model_is_seen_in_a_closed_loop(model):
    """Also without the traces along u and what it makes of the states."""
    for seed in range(4):
        assert verdict(recorded(seed, 1), model).verdict is Verdict.INCONSISTENT
