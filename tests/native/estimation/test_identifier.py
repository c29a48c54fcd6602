"""The compiled identifier: what it knows of the samples that it was given."""

from __future__ import annotations

import numpy as np

from cosim.blocks.estimator import Estimator
from cosim.blocks.identification_problem import IdentificationProblem, IdentificationSchedule
from cosim.blocks.output_error_identifier import OutputErrorIdentifier
from cosim.blocks.regressor import Regressor
from cosim.native.numerics.expression import compile_expression
from cosim.theory.disturbances.families import Exponential, group_by_alpha
from cosim.theory.disturbances.regression import expand
from cosim.theory.disturbed_plant import DisturbedPlant
from cosim.theory.estimators.rayleigh import rayleigh_box, rayleigh_constants

H = 0.01
T = np.arange(401) * H
ALPHA = "1.35 + 0.25*sin(1.7*t)"


def identifier():
    """Return that of an exponential which is all of y, with an estimate every second."""
    families = [Exponential()]
    terms = expand((1,))
    delays = (0.1, 0.2)
    alpha = compile_expression(ALPHA)
    groups = group_by_alpha([ALPHA], families)
    problem = IdentificationProblem(
        plant=DisturbedPlant(
            A=np.zeros((0, 0)),
            B=np.zeros((0, 0)),
            Bd=np.zeros((0, 1)),
            C=np.zeros((1, 0)),
            D=np.zeros((1, 0)),
            Dd=np.ones((1, 1)),
        ),
        modes=-np.eye(1),
        row=np.ones(1),
        rayleigh=rayleigh_constants(families, groups, terms, delays, span=T[-1]),
        products=Regressor(terms, alphas=[alpha], steps=[10, 20], delays=delays).constants,
        alphas=[alpha],
        box=rayleigh_box(families, delays, span=T[-1]),
    )
    schedule = IdentificationSchedule(
        period=100,
        steps=len(T),
        average=5,
        window=0,
        forgetting=1.0,
        start=0.5,
        settled=0.0,
        lag=0.0,
    )
    infinite = np.full(1, np.inf)
    method = OutputErrorIdentifier(problem, schedule, offset=False, lower=-infinite, upper=infinite)
    return Estimator(method)


def test_initialized_again_it_knows_nothing_of_the_samples_before():
    """There is no value at first; then the theta, without error, of the samples of this run."""
    estimator = identifier()
    interface = estimator.interface
    estimator.prepare(H, np.zeros(interface.n_u, np.bool_), {})
    columns = interface.input_columns()
    for theta in (-0.3, -0.8):
        u = np.full((len(T), interface.n_u), np.nan)
        y = 2.0 * (1.35 + 0.25 * np.sin(1.7 * T)) * np.exp(theta * T)
        u[:, columns["y"]] = y[:, np.newaxis]
        assert np.isnan(estimator.initialize(0.0, u[0])).all()
        outputs = estimator.advance(T, H, u)
        found = outputs[:, interface.output_columns()["theta"]]
        assert np.isnan(found[:99]).all()
        # the rounding of y, over what 400 samples say of theta
        np.testing.assert_allclose(found[-1], [theta], rtol=1e-12)
