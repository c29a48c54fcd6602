"""A source whose signal is the response of linear systems without input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.signals import Interface, Signal
from cosim.native.expression import Program
from cosim.native.step import evaluate_at, response


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearResponse:
    """A term factor(t) c' expm(G t) beta of one element of a signal.

    Parameters
    ----------
    factor : Program
    G : Matrix, shape (v, v)
        [1/s]
    c, beta : Vector, shape (v,)
    element : int
    """

    factor: Program
    G: Matrix
    c: Vector
    beta: Vector
    element: int


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
        self._programs = tuple(programs)
        self._responses = tuple(responses)
        self._factors = tuple(term.factor for term in responses)
        self.interface = Interface(outputs=(Signal("y", len(programs), unit),), rollback=True)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Return y(t)."""
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return y(t)."""
        y: Vector = self._at(np.array([t]))[0]
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Return y at ``t[1:]``."""
        return self._at(t[1:])

    def save(self) -> None:
        """Copy nothing: there is no state."""

    def restore(self, state: None) -> None:
        """Do nothing: there is no state."""

    def _at(self, t: Vector) -> Matrix:
        y = evaluate_at(self._programs, t)
        factors = evaluate_at(self._factors, t)
        for k, term in enumerate(self._responses):
            y[:, term.element] += factors[:, k] * response(term.G, term.c, term.beta, t)
        return y
