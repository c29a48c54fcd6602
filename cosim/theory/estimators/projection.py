"""Variable projection on the reconstructed disturbance: theta from delta_hat.

The same least squares as output error, with delta_hat in the place of y: no plant, but the modes of
the observer, whose transients are in delta_hat and are eliminated with the amplitudes.
"""

from __future__ import annotations

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.theory.disturbed_plant import DisturbedPlant


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
