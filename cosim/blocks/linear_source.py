"""A source whose signal is the response of linear systems without input."""

from __future__ import annotations

from collections.abc import Sequence

from cosim.arrays import Matrix, Vector
from cosim.core.signals import Interface, Signal
from cosim.native.blocks.functions import LinearResponse, linear_source_step
from cosim.native.numerics.expression import Program
from cosim.native.step import NativeStep


class LinearSource:
    """``y_i(t)``: an expression in t and responses of linear systems.

    Every value is computed from t alone, so it does not depend on the communication step.

    Parameters
    ----------
    programs : sequence of Program
        One an element of y.
    responses : sequence of LinearResponse
        At least one, added to the elements.
    unit : str, optional
    """

    def __init__(
        self,
        programs: Sequence[Program],
        responses: Sequence[LinearResponse],
        *,
        unit: str | None = None,
    ) -> None:
        self._step = linear_source_step(programs, responses)
        y = Signal("y", len(programs), unit)
        self.interface = Interface(outputs=(y,), rollback=True, native=True, continuous=True)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Return y(t)."""
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return y(t)."""
        y = self._step.outputs_at(t, u)
        assert y is not None
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Return y at ``t[1:]``."""
        return self._step.advance(t, h, u)

    def save(self) -> None:
        """Copy nothing: there is no state."""

    def restore(self, state: None) -> None:
        """Do nothing: there is no state."""

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return self._step
