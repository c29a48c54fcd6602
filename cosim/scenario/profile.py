"""Where the time goes: a component that counts the wall time of another."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Component, Design, prepare


class Timed:
    """Hands every call on and adds its wall time to ``seconds[name]``."""

    def __init__(self, component: Component, name: str, seconds: dict[str, float]) -> None:
        self._component, self._name, self._seconds = component, name, seconds
        self.interface = replace(component.interface, prepares=True, rollback=False)
        seconds[name] = 0.0

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Hand on."""
        began = perf_counter()
        design = prepare(self._component, h, held, recorded)
        self._seconds[self._name] += perf_counter() - began
        return design

    def initialize(self, t: float, u: Vector) -> Vector:
        """Hand on."""
        began = perf_counter()
        y = self._component.initialize(t, u)
        self._seconds[self._name] += perf_counter() - began
        return y

    def outputs(self, t: float, u: Vector) -> Vector:
        """Hand on."""
        began = perf_counter()
        y = self._component.outputs(t, u)
        self._seconds[self._name] += perf_counter() - began
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Hand on."""
        began = perf_counter()
        y = self._component.advance(t, h, u)
        self._seconds[self._name] += perf_counter() - began
        return y
