"""A first-order lag under a disturbance: simulated, fitted and judged."""

import numpy as np
from scipy.signal import lfilter

from cosim.theory.assessment.advice import advised
from cosim.theory.assessment.assessing import assess
from cosim.theory.disturbances.families import Sine
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.output_error import OutputErrorProblem

H = 0.02
DECAY = np.exp(-H)


def lag(components):
    """Return x' = -x + d, y = x, whose disturbance has so many components."""
    return DisturbedPlant(
        A=np.array([[-1.0]]),
        B=np.zeros((1, 0)),
        Bd=np.ones((1, components)),
        C=np.ones((1, 1)),
        D=np.zeros((1, 0)),
        Dd=np.zeros((1, components)),
    )


def ones(count):
    return lambda t: np.ones((len(t), count))


def simulate(d):
    """Return x of the lag for straight lines between samples, x(0) = 0.3."""
    end = 1.0 - (1.0 - DECAY) / H
    begin = 1.0 - DECAY - end
    forced = begin * d[:-1] + end * d[1:]
    return lfilter([1.0], [1.0, -DECAY], np.concatenate([[0.3], forced]))


def experiment(families, theta, disturbance, *, length, sigma, seed=0, alpha=None, **options):
    """Simulate, fit and judge; return what is said of every parameter."""
    constant = options.pop("constant", 0.0)
    alpha = alpha or ones(len(families))
    t = np.arange(round(length / H) + 1) * H
    noise = sigma * np.random.default_rng(seed).standard_normal(len(t))
    y = simulate(disturbance(t)) + constant + noise
    data = [DataSet(t, y[:, np.newaxis], np.zeros((len(t), 0)), alpha(t))]
    plant = lag(len(families))
    assessment = assess(OutputErrorProblem(data, plant, families, **options), np.array(theta))
    return advised(assessment, [alpha]).parameters


def sine(**options):
    return experiment(
        [Sine()],
        [1.3],
        lambda t: 2.0 * np.sin(1.3 * t + 0.5),
        **{"sigma": 0.8, **options},
    )
