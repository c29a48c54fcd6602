"""Curves with noise, and what a search that fits them says of their parameters."""

import math

import numpy as np
from scipy.optimize import curve_fit

from cosim.studies.tuning.searching import TuningSearch, search_best
from cosim.studies.tuning.space import BoundedKey, SearchSpace
from cosim.studies.tuning.standard_errors import standard_errors
from cosim.studies.tuning.trials import Trials
from tests.studies.tuning.functions import OBJECTIVE, Recorded

T = np.linspace(0.0, 1.0, 201)
LINE = SearchSpace((BoundedKey("slope", -10.0, 10.0), BoundedKey("offset", -10.0, 10.0)))
DECAY = SearchSpace((BoundedKey("a", 0.1, 10.0, True), BoundedKey("k", 0.1, 100.0)))


def line(t, slope, offset):
    return slope * t + offset


def decay(t, a, k):
    return a * np.exp(-k * t)


def rms_of(model, measured, noise=0.0):
    """Return the rms of the residual; with noise, as a solver with step control has it."""

    def rms(point):
        exact = math.sqrt(np.mean((model(T, *point.values()) - measured) ** 2))
        jitter = math.modf(1e5 * sum(point.values()) * math.pi)[0] - 0.5
        return exact * (1.0 + noise * jitter)

    return rms


def fitted(model, space, measured, *, noise=0.0, **options):
    """Search the parameters of a curve in measured values."""
    given = {"is_rms": True, "with_errors": True, "samples": T.size, "starts": 1, **options}
    search = TuningSearch(space, OBJECTIVE, **given)
    return search_best(Recorded(rms_of(model, measured, noise)), search)


def errors_of_fit(measured):
    """Return the standard errors of a decay, after the search of a tuning."""
    return fitted(decay, DECAY, measured, starts=1).errors


def errors_at_solution(measured):
    """Return the standard errors of a decay where curve_fit ends."""
    (a, k), _ = curve_fit(decay, T, measured, p0=[2.0, 3.0])
    trials = Trials(Recorded(rms_of(decay, measured)), objective=OBJECTIVE, members=200)
    return standard_errors(DECAY, trials, {"a": float(a), "k": float(k)}, T.size)
