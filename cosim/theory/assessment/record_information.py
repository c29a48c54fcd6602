"""What one data set says of theta and of its linear unknowns, near the minimum of a fit.

Amplitudes, x(0) and offset are linear unknowns: of the derivatives of the output by theta they take
the part that lies in their own columns, and what is free of it is information about theta. All of
this is in the triangle that the rows of a pass over the samples are rotated into, whose columns
have the products of the rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.estimation.output_error import ResponseRecord
from cosim.theory.estimators.output_error import OutputErrorFit
from cosim.theory.fitted_response import slopes_of

DEPENDENT: Final = 1e-12  # relative to the largest: singular values of columns that depend
DETERMINED: Final = 1e-6  # what of a linear unknown may lie where the columns depend


@dataclass(frozen=True, eq=False)
class RecordInformation:
    """The regression of a data set on theta and its linear unknowns, rotated.

    Parameters
    ----------
    slopes : Matrix, shape (M, P)
        By theta.
    linear : Matrix, shape (M, L)
        By amplitudes, x(0) and offset.
    """

    slopes: Matrix
    linear: Matrix

    @cached_property
    def inverse(self) -> Matrix:
        """The pseudo-inverse of the columns of the linear unknowns, shape (L, M)."""
        lengths = np.linalg.norm(self.linear, axis=0)
        lengths[lengths == 0.0] = 1.0
        scaled = np.linalg.pinv(self.linear / lengths, rcond=DEPENDENT)
        return np.asarray(scaled / lengths[:, np.newaxis], np.float64)

    @property
    def free(self) -> Matrix:
        """What of the slopes the linear unknowns cannot take, shape (M, P)."""
        taken: Matrix = self.linear @ (self.inverse @ self.slopes)
        return self.slopes - taken

    @property
    def determined(self) -> list[bool]:
        """Which linear unknowns the data determine for a given theta."""
        resolution = np.diag(self.inverse @ self.linear)
        return [bool(abs(1.0 - part) <= DETERMINED) for part in resolution]

    def covariance(self, of_theta: Matrix, deviation: float) -> Matrix:
        """Compute the covariance of theta and the linear unknowns, shape (P + L, P + L).

        Parameters
        ----------
        of_theta : Matrix, shape (P, P)
            To which other data sets may contribute. For a given theta the linear unknowns have an
            error of their own, uncorrelated with that of theta, which moves them along.
        deviation : float
            Of the noise, whitened.
        """
        return joint_covariance(self.inverse, self.slopes, of_theta, deviation)


def joint_covariance(inverse: Matrix, slopes: Matrix, of_theta: Matrix, deviation: float) -> Matrix:
    """Compute the covariance of theta and of the linear unknowns of a data set.

    Parameters
    ----------
    inverse : Matrix, shape (L, M)
        Pseudo-inverse of the columns of the linear unknowns.
    slopes : Matrix, shape (M, P)
    of_theta, deviation
        As in :meth:`RecordInformation.covariance`.
    """
    own = deviation**2 * (inverse @ inverse.T)
    along = -inverse @ slopes
    cross = along @ of_theta
    return np.block([[of_theta, cross.T], [cross, own + cross @ along.T]])


def record_information(fit: OutputErrorFit, index: int) -> RecordInformation:
    """Return the information of data set number ``index`` at the minimum of a fit."""
    return information_of(fit.records[index], fit.theta, fit.amplitudes[index])


def information_of(record: ResponseRecord, theta: Vector, amplitudes: Vector) -> RecordInformation:
    """Return the information in a record, at theta and amplitudes."""
    R = record.make(theta)
    model = record.model
    slopes = slopes_of(R[:, model.linear : -1], amplitudes, model.constants.generators)
    return RecordInformation(np.asarray(slopes, np.float64), R[:, : model.linear])
