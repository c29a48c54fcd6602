"""Variable projection on the reconstructed disturbance: theta from delta_hat.

The same least squares as output error, with delta_hat in the place of y: no plant, but the modes of
the observer, whose transients are in delta_hat and are eliminated with the amplitudes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.theory.disturbances.families import Family
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.output_error import OutputErrorFit, fit_output_error


def reconstruction_model(A: Matrix, c: Vector, components: int) -> DisturbedPlant:
    """Return the model of delta_hat: the sum of its components and the modes of the observer.

    Parameters
    ----------
    A : Matrix, shape (n, n)
        Of the observer and its filter; shape (0, 0): their transients are over.
    c : Vector, shape (n,)
        How its states enter delta_hat.
    components : int
        Number of components of the disturbance.
    """
    n = len(A)
    return DisturbedPlant(
        A=A,
        B=np.zeros((n, 0)),
        Bd=np.zeros((n, components)),
        C=np.reshape(c, (1, n)),
        D=np.zeros((1, 0)),
        Dd=np.ones((1, components)),
    )


def project(
    t: Vector,
    delta: Vector,
    alpha: Matrix,
    families: Sequence[Family],
    theta: Vector,
    *,
    A: Matrix | None = None,
    c: Vector | None = None,
) -> OutputErrorFit:
    """Estimate theta by variable projection on delta_hat.

    Parameters
    ----------
    t : Vector, shape (N,)
        [s]
    delta : Vector, shape (N,)
        NaN: no value.
    alpha : Matrix, shape (N, components)
        At the instants that delta belongs to: at ``t`` less its lag.
    families : sequence of Family
    theta : Vector, shape (P,)
        Start.
    A, c : optional
        The observer's modes, as for :func:`reconstruction_model`.
    """
    modes = np.zeros((0, 0)) if A is None else A
    row = np.zeros(0) if c is None else c
    model = reconstruction_model(modes, row, len(families))
    column = np.reshape(delta, (-1, 1))
    no_input = np.zeros((len(t), 0))
    data_set = DataSet(t, column, no_input, alpha)
    return fit_output_error([data_set], model, families, theta)
