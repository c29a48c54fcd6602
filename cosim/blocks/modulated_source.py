"""A source with outputs that are multiplied by signals: a disturbance whose alphas are signals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Component, Native, Stopped
from cosim.core.signals import Interface, Signal
from cosim.native.blocks.functions import modulated_step
from cosim.native.step import NativeStep


class Modulation(NamedTuple):
    """A product with an element of the input ``alpha``, in an element of the output."""

    output: int
    alpha: int


class ModulatedSource:
    """``y = s + products``: the first elements of a source, and each of the others by a signal.

    Parameters
    ----------
    source : Component
        Without inputs and without a state; its output has an element for each of y, then one for
        each product.
    products : sequence of Modulation
    inputs : tuple of Signal
        The input ``alpha``.
    unit : str or None
        Of y.
    """

    def __init__(
        self,
        source: Component,
        products: Sequence[Modulation],
        inputs: tuple[Signal, ...],
        unit: str | None = None,
    ) -> None:
        (outputs,) = source.interface.outputs
        self._source = source
        self._products = tuple(products)
        self._n_y = outputs.size - len(products)
        y = Signal("y", self._n_y, unit)
        fed = tuple(signal.name for signal in inputs)
        is_native = source.interface.native
        self.interface = Interface(
            inputs, (y,), {"y": fed}, rollback=True, native=is_native, continuous=True
        )

    def initialize(self, t: float, u: Vector) -> Vector:
        """Return y(t)."""
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return y(t)."""
        values = self._source.outputs(t, np.zeros(0))
        y: Vector = self._multiplied(values[np.newaxis], u[np.newaxis])[0]
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Return y at ``t[1:]``.

        Raises
        ------
        Stopped
            Where the source stops.
        """
        alpha = u[1:]
        try:
            values = self._source.advance(t, h, np.zeros((len(t), 0)))
        except Stopped as stop:
            completed = self._multiplied(stop.outputs, alpha[: stop.steps])
            raise Stopped(completed, str(stop), failed=stop.failed) from stop
        return self._multiplied(values, alpha)

    def save(self) -> None:
        """Copy nothing: there is no state."""

    def restore(self, state: None) -> None:
        """Do nothing: there is no state."""

    def native(self) -> NativeStep | None:
        """Return the compiled step, if the source has one."""
        source = cast(Native, self._source).native()
        if source is None:
            return None
        elements = [product.output for product in self._products]
        alphas = [product.alpha for product in self._products]
        return modulated_step(source, elements, alphas)

    def _multiplied(self, values: Matrix, alpha: Matrix) -> Matrix:
        y = values[:, : self._n_y].copy()
        for place, product in enumerate(self._products, self._n_y):
            y[:, product.output] += values[:, place] * alpha[:, product.alpha]
        return y
