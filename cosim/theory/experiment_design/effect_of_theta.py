"""How far a change of theta shows in the disturbance itself, beyond what its constants make up for.

What rests on the regression needs more: :mod:`cosim.theory.experiment_design.minors`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.estimation.output_error import Generators
from cosim.native.numerics.householder import triangle
from cosim.theory.assessment.record_information import RecordInformation
from cosim.theory.disturbances.families import Family, generators
from cosim.theory.experiment_design.minors import basis_and_derivative, basis_rows
from cosim.theory.fitted_response import slopes_of

_BLOCK: Final = 4096  # instants that are computed at once


def effect_of_theta(
    families: Sequence[Family], theta: Vector, t: Vector, alpha: Matrix, delta: Vector
) -> float:
    """Return the smallest relative change of the disturbance over all directions of theta.

    Theta changes by 1 over the length of the run, and the constants with it, so that they make up
    for all that they can.

    Parameters
    ----------
    families : sequence of Family
    theta : Vector, shape (P,)
    t : Vector, shape (N,)
        Instants [s], at least two.
    alpha : Matrix, shape (N, components)
        The known factor of each component.
    delta : Vector, shape (N,)
        The disturbance.
    """
    matrices = generators(families)
    order = matrices.order
    R = np.zeros((0, 0))
    for begin in range(0, len(t), _BLOCK):
        part = slice(begin, begin + _BLOCK)
        columns = _columns(matrices, theta, t[part], alpha[part])
        rows = np.column_stack([columns, delta[part]])
        R = triangle(rows, R if len(R) else None)
    known = RecordInformation(np.zeros((len(R), 0)), R[:, :order])
    slopes = slopes_of(R[:, order:-1], known.inverse @ R[:, -1], matrices)
    free = RecordInformation(np.asarray(slopes, np.float64), R[:, :order]).free
    size = float(np.linalg.norm(R[:, -1])) * float(t[-1] - t[0])
    if size == 0.0:
        return 0.0
    return float(np.linalg.svd(free / size, compute_uv=False).min())


def _columns(matrices: Generators, theta: Vector, t: Vector, alpha: Matrix) -> Matrix:
    """Return the functions of the basis, and their derivatives by each parameter of theirs."""
    functions = []
    derivatives = []
    for component, factor in zip(matrices.each, alpha.T, strict=True):
        G = component.matrix(theta[component.theta])
        functions.append(factor[:, np.newaxis] * basis_rows(component.c, G, -t))
        for slope in component.G1:
            _, of_slope = basis_and_derivative(component.c, G, slope, -t)
            derivatives.append(factor[:, np.newaxis] * of_slope)
    return np.hstack(functions + derivatives)
