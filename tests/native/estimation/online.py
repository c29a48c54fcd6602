"""An identifier by output error as it runs in compiled code, made without a scenario."""

import numpy as np

from cosim.blocks.estimator import Estimator
from cosim.blocks.identification_problem import IdentificationProblem, IdentificationSchedule
from cosim.blocks.output_error_identifier import OutputErrorIdentifier
from cosim.blocks.regressor import Regressor
from cosim.native.numerics.expression import compile_expression
from cosim.theory.disturbances.families import Exponential, group_by_alpha
from cosim.theory.disturbances.regression import expand
from cosim.theory.estimators.rayleigh import rayleigh_constants

H = 0.01  # s
ALPHAS = ("1.35 + 0.25*sin(1.7*t)", "1.1 + 0.2*cos(2.3*t)")


def online(plant, *, count=2, modes=1, steps=1000):
    """Return the identifier of one or two exponentials on a plant, with an estimate every second.

    It has room for so many steps of ``H``.
    """
    families = [Exponential()] * count
    alphas = ALPHAS[:count]
    groups = group_by_alpha(alphas, families)
    terms = expand((1,) * count)
    delays = (0.1, 0.2, 0.3)[: count + 1]
    ages = [10, 20, 30][: count + 1]
    programs = [compile_expression(alpha) for alpha in alphas]
    problem = IdentificationProblem(
        plant=plant,
        modes=-np.eye(modes),
        row=np.ones(modes),
        rayleigh=rayleigh_constants(families, groups, terms, delays),
        products=Regressor(terms, alphas=programs, steps=ages, delays=delays).constants,
        alphas=programs,
        families=families,
    )
    schedule = IdentificationSchedule(
        period=100,
        steps=steps,
        average=5,
        window=0,
        forgetting=1.0,
        start=0.5,
        settled=0.0,
        lag=0.0,
    )
    infinite = np.full(count, np.inf)
    method = OutputErrorIdentifier(problem, schedule, offset=False, lower=-infinite, upper=infinite)
    return Estimator(method)
