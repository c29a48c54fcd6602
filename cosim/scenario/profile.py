"""Wall time by component: a component that measures the calls of another."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from time import perf_counter

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Component, Design, prepare


class Timed:
    """Passes every call on and adds its wall time to ``seconds[name]``."""

    def __init__(self, component: Component, name: str, seconds: dict[str, float]) -> None:
        self.interface = replace(component.interface, prepares=True, rollback=False)
        self._component = component
        self._name = name
        self._seconds = seconds
        seconds[name] = 0.0

    @contextmanager
    def _measured(self) -> Iterator[None]:
        """Add the wall time of the block, if nothing is raised in it."""
        began = perf_counter()
        yield
        self._seconds[self._name] += perf_counter() - began

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Pass on."""
        with self._measured():
            return prepare(self._component, h, held, recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Pass on."""
        with self._measured():
            return self._component.initialize(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Pass on."""
        with self._measured():
            return self._component.outputs(t, u)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Pass on."""
        with self._measured():
            return self._component.advance(t, h, u)
