"""A co-simulation unit as a component.

One communication step from t0 to t1::

    interpolating unit:   set inputs u0; set_input_derivatives (u1 - u0)/h; do_step     its outputs belong to u_end = u1
    any other:            set inputs (u0 + u1)/2; do_step                               its outputs belong to u_end = (u0 + u1)/2
    (held and discrete:   u0, no slope                                                  u_end = u0)
    y <- outputs + D (u1 - u_end), where the unit gives D by directional derivatives at t1

The mean makes the states second order. FMI forbids setting inputs and then reading outputs without a step between (FMI 2.0.4
section 4.2.4), so that is never done: the correction asks for D alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, Stopped
from cosim.errors import FmuError, RunError
from cosim.fmi.description import Description
from cosim.fmi.references import References
from cosim.fmi.saved import SavedState, save
from cosim.fmi.start import Start, Starts
from cosim.fmi.unit import TERMINATED, CoSimulationUnit, StepEnd


@final
class CoSimulation:
    """A co-simulation unit.

    Parameters
    ----------
    unit : CoSimulationUnit
        Just instantiated.
    starts : mapping of variable name to StartValue
        Start values to set instead of the unit's own.

    Raises
    ------
    FmuError
        If a start value is wrong.
    """

    def __init__(self, unit: CoSimulationUnit, *, starts: Starts | None = None) -> None:
        self._unit, self._name = unit, unit.description.name
        self.interface = unit.interface
        self._start = Start(unit, starts or {})
        self._capabilities = unit.description.capabilities["cs"]
        self._inputs, self._outputs = unit.description.references("input"), unit.description.references("output")
        self._interpolates = self._capabilities.interpolates_inputs and self._inputs.plain
        self._direct = _Direct.of(unit) if self._capabilities.directional_derivatives else None
        self._moves = ~unit.description.discrete_inputs
        self._read, self._end = np.zeros(self._outputs.size), np.zeros(self._inputs.size)

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Learn which inputs are held; nothing is designed.

        Raises
        ------
        FmuError
            If the unit has a fixed inner step and ``h`` is not a whole number of them.
        """
        fixed = self._capabilities.fixed_step
        if fixed and not self._capabilities.variable_step and abs(round(h / fixed) * fixed - h) > 1e-9 * h:
            raise FmuError(
                f"{self._name}: the communication step {h} s is not a whole number of the unit's inner steps of {fixed} s; "
                f"nearest: {max(1, round(h / fixed)) * fixed} s"
            )
        self._moves = ~(held | self._unit.description.discrete_inputs)
        return {}

    @property
    def notes(self) -> tuple[str, ...]:
        """What is to be known about the results."""
        fed = [output.name for output in self.interface.outputs if self.interface.feeds(output.name)]
        if not fed or self._direct:
            return ()
        verb = "depend" if all(self.interface.knows(name) for name in fed) else "may depend"
        where = (
            "where inputs are held, what is read belongs to their value"
            if self._interpolates
            else "what is read belongs to the inputs"
        )
        return (
            f"{self._name}: {', '.join(fed)} {verb} directly on inputs; {where} inside the step, not at its end (first order in "
            "the step), as the unit has no directional derivatives",
        )

    def initialize(self, t: float, u: Vector) -> Vector:
        """Start at ``t``; stays in initialization mode until the first advance."""
        self._read, self._end = self._start.enter(t, u), np.array(u)
        return self._read.copy()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the outputs last read, corrected to the inputs ``u`` where D is known."""
        self._start.leave()
        return self._outputs_for(u)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step K times; see :class:`cosim.core.contracts.Component`."""
        u = np.array(u, np.float64, order="C")
        y = np.empty((len(t) - 1, self.interface.n_y))
        for k, t0 in enumerate(t[:-1].tolist()):
            try:
                self._start.leave()
                end = self._step(t0, h, u[k], u[k + 1])
                if end.completed:
                    y[k] = self._outputs_for(u[k + 1])
            except RunError as error:
                raise Stopped(y[:k].copy(), str(error)) from error
            if end.terminate:
                raise Stopped(y[: k + end.completed].copy(), TERMINATED, failed=False)
        return y

    def _step(self, t: float, h: float, u0: Vector, u1: Vector) -> StepEnd:
        unit = self._unit
        change = (u1 - u0) * self._moves
        if self._interpolates:
            unit.set_float64(self._inputs, u0)
            unit.set_input_derivatives(self._inputs, change / h)
            self._end = u0 + change
        else:
            self._end = u0 + 0.5 * change
            unit.set_float64(self._inputs, self._end)
        end = unit.do_step(t, h)
        if not (end.completed or end.terminate):
            raise RunError(f"{self._name}: returned early from the step at t = {t} s, which was not allowed")
        if end.completed:
            self._read = unit.get_float64(self._outputs)
        return end

    def _outputs_for(self, u: Vector) -> Vector:
        """Give y + D (u - u_end)."""
        return self._read.copy() if self._direct is None else self._read + self._direct.change(u - self._end)

    def save(self) -> SavedState:
        """Copy the state.

        Raises
        ------
        FmuError
            If the unit cannot.
        """
        return save(self._unit, self._capabilities, (self._start.t, self._read.copy(), self._end.copy()))

    def restore(self, state: SavedState) -> None:
        """Go back to a saved state."""
        self._unit.set_fmu_state(state.unit)
        self._start.t, self._read, self._end = state.own  # type: ignore[assignment]


@final
class _Direct:
    """The direct way from inputs to outputs: D times a change of the inputs, for real variables that feed through."""

    def __init__(self, unit: CoSimulationUnit, outputs: Sequence[int], inputs: Sequence[int]) -> None:
        self._unit, self._n_y = unit, unit.interface.n_y
        self._rows, self._columns = np.array(outputs, np.intp), np.array(inputs, np.intp)
        self._unknowns = _select(unit.description, "output", self._rows)
        self._knowns = _select(unit.description, "input", self._columns)

    @staticmethod
    def of(unit: CoSimulationUnit) -> _Direct:
        """Find what feeds through."""
        face = unit.interface
        sources = {name for output in face.outputs for name in face.feeds(output.name)}
        fed = [signal.name for signal in face.outputs if face.feeds(signal.name) and signal.kind == "real"]
        feeding = [signal.name for signal in face.inputs if signal.name in sources and signal.kind == "real"]
        rows, columns = face.output_columns(), face.input_columns()
        return _Direct(unit, _elements(rows, fed), _elements(columns, feeding))

    def change(self, du: Vector) -> Vector:
        """D du, shape (n_y,)."""
        seed, dy = du[self._columns], np.zeros(self._n_y)
        if len(self._rows) and seed.any():
            dy[self._rows] = self._unit.get_directional_derivative(self._unknowns, self._knowns, seed)
        return dy


def _elements(columns: Mapping[str, slice], names: Sequence[str]) -> list[int]:
    return [i for name in names for i in range(columns[name].start, columns[name].stop)]


def _select(description: Description, causality: str, elements: NDArray[np.intp]) -> References:
    """Give the references of the variables that hold some elements of the input or output vector."""
    variables = [v for _, group in description.ports(causality) for v in group]
    owner = np.repeat(np.arange(len(variables)), [v.size for v in variables])
    return description.reference(variables[i].name for i in dict.fromkeys(owner[elements].tolist()))
