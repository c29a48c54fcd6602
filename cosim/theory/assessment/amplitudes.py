"""Amplitudes and phases of the components of a disturbance, with their errors.

A fit has the state beta of each component at the first sample of a data set. What a user means are
constants: `amplitude exp(theta t)`, `amplitude sin(theta t + phase)`, at t = 0 as in a scenario.
They follow from `beta(0) = expm(-G(theta) t_1) beta(t_1)`, so their errors come from those of theta
and beta together, to first order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.arrays import NAN, Matrix, Vector
from cosim.theory.assessment.record_information import DEPENDENT, record_information
from cosim.theory.disturbances.families import Family
from cosim.theory.estimators.output_error import OutputErrorFit, presence_threshold


@dataclass(frozen=True, eq=False, kw_only=True)
class ComponentConstants:
    """Amplitude and phase of one component in one data set.

    Parameters
    ----------
    family : Family
    values : Vector, shape (v,)
        In the order of its ``constants``; NaN: the data do not determine it.
    standard_error : Vector, shape (v,)
    bias : Vector, shape (v,)
        What step and quantization may have moved them by.
    slopes : Matrix, shape (v, P + order)
        By theta and beta; 0 where there is no number.
    is_present : bool
        Whether the component is larger here than what noise alone makes it for a given theta.
    """

    family: Family
    values: Vector
    standard_error: Vector
    bias: Vector
    slopes: Matrix
    is_present: bool


def component_constants(
    fit: OutputErrorFit, index: int, families: Sequence[Family], *, t_1: float, moved: Vector
) -> tuple[ComponentConstants, ...]:
    """Compute amplitudes and phases of all components in data set number ``index``.

    Parameters
    ----------
    fit : OutputErrorFit
    index : int
    families : sequence of Family
    t_1 : float
        Time of its first sample [s].
    moved : Vector, shape (P + order,)
        What step and quantization may have moved theta and beta by.
    """
    information = record_information(fit, index)
    covariance = information.covariance(fit.covariance, fit.deviation)
    by_noise = fit.deviation**2 * (information.inverse @ information.inverse.T)
    determined = information.determined
    P = len(fit.theta)
    constants = []
    parameter = 0
    column = 0
    for family in families:
        of_theta = np.arange(parameter, parameter + len(family.parameters))
        of_beta = np.arange(column, column + family.v)
        beta = fit.amplitudes[index][of_beta]
        values, slopes = _constants(family, fit.theta[of_theta], beta, t_1)
        own = np.concatenate([of_theta, P + of_beta])
        variance = np.einsum("ca,ab,cb->c", slopes, covariance[np.ix_(own, own)], slopes)
        known = np.isfinite(values) & np.isfinite(variance)
        known &= all(determined[j] for j in of_beta)
        by_own = np.where(known[:, np.newaxis], slopes, 0.0)
        by_all = np.zeros((family.v, len(moved)))
        by_all[:, own] = by_own
        constants.append(
            ComponentConstants(
                family=family,
                values=np.where(known, values, NAN),
                standard_error=np.where(known, np.sqrt(np.maximum(variance, 0.0)), NAN),
                bias=np.abs(by_own) @ moved[own],
                slopes=by_all,
                is_present=_is_present(beta, by_noise[np.ix_(of_beta, of_beta)]),
            )
        )
        parameter += len(of_theta)
        column += family.v
    return tuple(constants)


def _is_present(beta: Vector, covariance: Matrix) -> bool:
    """Return whether noise of this covariance alone is not what makes beta."""
    (threshold,) = presence_threshold([len(beta)], 1)
    if not covariance.any():
        return bool(beta.any())
    statistic = float(beta @ np.linalg.lstsq(covariance, beta, rcond=DEPENDENT)[0])
    return bool(statistic > threshold)


def _constants(family: Family, theta: Vector, beta: Vector, t_1: float) -> tuple[Vector, Matrix]:
    """Return the constants at t = 0, and their derivatives by theta and beta(t_1)."""
    P = len(theta)
    if t_1 == 0.0:
        values, slopes = family.constants_of(beta)
        return values, np.hstack([np.zeros((family.v, P)), slopes])
    from scipy.linalg import expm, expm_frechet  # take long to import

    G = family.G(theta)
    columns = []
    with np.errstate(over="ignore", invalid="ignore"):  # far from the record it may be any size
        back = expm(-G * t_1)
        for j in range(P):
            unit = np.zeros(P)
            unit[j] = 1.0
            slope = family.G(theta + unit) - G
            change = expm_frechet(-G * t_1, -slope * t_1, compute_expm=False)
            columns.append(change @ beta)
        values, by_beta = family.constants_of(back @ beta)
        slopes = by_beta @ np.column_stack([*columns, back])
    return values, np.asarray(slopes, np.float64)
