"""Responses to signals that enter at the states: of the outputs of a fit, and of the states.

From sample to sample a signal is a straight line or held, and samples may be at any distances.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.native.estimation.output_error import (
    Generators,
    KnownInput,
    OutputErrorModel,
    residual_of,
)
from cosim.theory.disturbed_plant import (
    DataSet,
    DisturbedPlant,
    discretize,
    sample_intervals,
    white_noise,
)
from cosim.theory.predictor import Predictor
from cosim.theory.sampling import distinct_steps

_NO_COMPONENTS: Final = Generators((), (), np.zeros(0), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, eq=False)
class ForcedOutputs:
    """The outputs of a plant from rest, at the samples of a data set, without feedthrough.

    Where those of the data set are predicted so are these: they are what a signal that the model
    lacks leaves in the residual.
    """

    model: OutputErrorModel
    known: KnownInput
    interval: NDArray[np.integer] | None

    def respond(self, lines: Matrix, held: Matrix, direct: Matrix | None = None) -> Matrix:
        """Compute the outputs, shape (N, n_y), for signals at the states, each (N, n).

        ``direct``, shape (N, n_y), is on the outputs themselves.
        """
        zeros = np.zeros((len(lines), self.model.outputs))
        y = zeros if direct is None else -direct
        forcing = np.hstack([lines, held])
        return -residual_of(self.model, self.known, u=forcing, y=y, interval=self.interval)


def forced_outputs(plant: DisturbedPlant, data: DataSet) -> ForcedOutputs:
    """Discretize a plant for signals at its states."""
    covariance = np.eye(len(plant.C))
    step, interval, predictor = sample_intervals(plant, data, covariance)
    model, known = _discretized(plant.A, plant.C, step, predictor)
    return ForcedOutputs(model, known, interval)


def simulate(A: Matrix, B: Matrix, t: Vector, u: Matrix, x0: Vector, held: Mask) -> Matrix:
    """Simulate ``x' = A x + B u``.

    Parameters
    ----------
    A : Matrix, shape (n, n)
    B : Matrix, shape (n, m)
    t : Vector, shape (N,)
        Ascending instants [s].
    u : Matrix, shape (N, m)
    x0 : Vector, shape (n,)
    held : Mask, shape (m,)
        Which u keep their value from one instant to the next.

    Returns
    -------
    Matrix
        x, shape (N, n).
    """
    n = len(A)
    if n == 0 or len(t) < 2:
        return np.tile(x0, (len(t), 1))
    step, interval = distinct_steps(t)
    model, known = _discretized(A, np.eye(n), step)
    # x - x0 starts from rest under the constant A x0 beside u
    lines = u[:, ~held] @ B[:, ~held].T
    levels = u[:, held] @ B[:, held].T + A @ x0
    forcing = np.hstack([lines, levels])
    rest = np.zeros((len(t), n))
    return x0 - residual_of(model, known, u=forcing, y=rest, interval=interval)


def _discretized(
    A: Matrix, C: Matrix, step: Vector, predictor: Predictor | None = None
) -> tuple[OutputErrorModel, KnownInput]:
    """Discretize for n signals that are straight lines and n that are held, at the states."""
    n_y, n = C.shape
    plant = DisturbedPlant(
        A=A,
        B=np.hstack([np.eye(n), np.eye(n)]),
        Bd=np.zeros((n, 0)),
        C=C,
        D=np.zeros((n_y, 2 * n)),
        Dd=np.zeros((n_y, 0)),
    )
    held = np.arange(2 * n) >= n
    constants, known = discretize(
        plant, _NO_COMPONENTS, step=step, predictor=predictor, noise=white_noise(n_y), held=held
    )
    return OutputErrorModel(constants), known
