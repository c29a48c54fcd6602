"""The regressor: from the reconstructed disturbance to the known signals mu (21)-(25)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.signals import Interface, Signal
from cosim.native.expression import Program
from cosim.native.step import RegressorConstants
from cosim.native.step import RegressorStep as Kernel
from cosim.theory.regression import Term


class Regressor:
    """Delays delta and multiplies: input delta, output mu, without a value until the longest delay has passed.

    Parameters
    ----------
    terms : sequence of Term
        The expansion of the determinant.
    alphas : sequence of Program
        The known functions, one a block.
    steps, delays : sequence of int, of float
        The delays in communication steps and in seconds.
    """

    def __init__(
        self,
        terms: Sequence[Term],
        *,
        alphas: Sequence[Program],
        steps: Sequence[int],
        delays: Sequence[float],
    ) -> None:
        rows = len(delays)
        factor = np.array(
            [[b * rows + i for b, part in enumerate(term.parts) for i in part] for term in terms]
        )
        self.constants = RegressorConstants(
            alphas=alphas,
            steps=steps,
            delays=delays,
            row=np.array([term.row for term in terms]),
            factor=factor,
            sign=np.array([term.sign for term in terms], np.float64),
        )
        self._kernel = Kernel(self.constants)
        self.interface = Interface(
            (Signal("delta", role="input"),),
            (Signal("mu", len(terms), optional=True),),
            {"mu": ("delta",)} if 0 in steps else {},
            rollback=True,
        )

    def initialize(self, t: float, u: Vector) -> Vector:
        """Forget the past."""
        self._kernel.reset()
        return self._kernel.outputs(t, float(u[0]))

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give mu at the instant reached."""
        return self._kernel.outputs(t, float(u[0]))

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Take K samples."""
        return self._kernel.step.advance(t, h, u)

    def save(self) -> Vector:
        """Copy the line of samples."""
        return self._kernel.step.save()

    def restore(self, state: Vector) -> None:
        """Go back to a saved line."""
        self._kernel.step.restore(state)
