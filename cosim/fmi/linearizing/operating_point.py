"""An instance at its operating point, and both ways to its Jacobian there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import FmuError, RunError
from cosim.fmi.description import usable_nominal
from cosim.fmi.driving.initialization import Starts, StartValue, check_start
from cosim.fmi.driving.model_exchange import ModelExchange
from cosim.fmi.instance import ModelExchangeInstance
from cosim.fmi.linearizing.differences import differentiate
from cosim.fmi.linearizing.elements import Element, Selection, derivative_of, references_of
from cosim.fmi.linearizing.linearization import METHODS, Method
from cosim.fmi.references import ReferenceMap

SOLVER: Final = "LSODA"  # to the operating point: stiff or not


@final
class OperatingPoint:
    """An instance at its operating point, in continuous-time mode.

    Parameters
    ----------
    instance : ModelExchangeInstance
        Just reset.
    selection : Selection
    at : float
        Time of the operating point [s].
    start : mapping of variable or element name to StartValue
    rtol : float
        Relative tolerance of the states on the way there.

    Raises
    ------
    FmuError
        If a start value is wrong, or something is not finite at the operating point.
    RunError
        If the instance does not reach it.
    """

    def __init__(
        self,
        instance: ModelExchangeInstance,
        selection: Selection,
        at: float,
        start: Starts,
        *,
        rtol: float,
    ) -> None:
        self.instance = instance
        self.selection = selection
        self.t = at
        self._name = instance.description.name
        is_continuous = [element.is_continuous for element in selection.all_inputs]
        inputs = instance.description.references("input")
        self._continuous_inputs = inputs.select(np.array(is_continuous, np.bool_))
        self._outputs, self._output_rows = references_of(selection.outputs)
        self._state_columns = _positions(selection.states, selection.all_states)
        self._input_columns = _positions(selection.inputs, selection.all_inputs)
        values = dict(start)
        state_values = self._pop_elements(self._states_to_set(), values)
        array_elements = [e for e in selection.all_inputs if not e.is_variable]
        input_values = self._pop_elements(array_elements, values)
        self._u = self._constant_inputs(values, input_values)
        self._x = self._reach(values, rtol)
        for element, value in state_values:
            self._x[selection.all_states.index(element)] = value
        self._read()

    def _read(self) -> None:
        """Set the instance to the point and read what is selected there."""
        self.dx, self.y = self._evaluate(self._x, self._u)
        self.x = self._x[self._state_columns]
        self.u = self._u[self._input_columns]
        self._check_finite("states", self.x)
        self._check_finite("derivatives", self.dx)
        self._check_finite("outputs", self.y)

    def _states_to_set(self) -> list[Element]:
        """Return the states that can be set in continuous-time mode only: those without a start."""
        if self.t != 0.0:
            return []
        states = []
        for element in self.selection.all_states:
            if not (element.is_variable and element.variable.settable):
                states.append(element)
        return states

    def _pop_elements(
        self, elements: Iterable[Element], values: dict[str, StartValue]
    ) -> list[tuple[Element, float]]:
        """Take the values of elements out of the start values."""
        pairs = []
        for element in elements:
            if element.name in values:
                value = values.pop(element.name)
                pairs.append((element, element.check_start(self._name, value)))
        return pairs

    def _constant_inputs(
        self, values: Starts, element_values: Iterable[tuple[Element, float]]
    ) -> Vector:
        """Return all inputs: the values that the user sets, else the FMU's start values."""
        description = self.instance.description
        inputs = self.selection.all_inputs
        u = np.zeros(len(inputs))
        for i, element in enumerate(inputs):
            start = element.variable.start
            if start:
                u[i] = start[element.index]
        checked = check_start(description, values)
        for name, numbers in checked.numbers.items():
            own_name = description[name].alias_of or name
            columns = [i for i, e in enumerate(inputs) if e.variable.name == own_name]
            if columns:
                u[columns] = numbers
        for element, value in element_values:
            u[inputs.index(element)] = value
        return u

    def _reach(self, values: Starts, rtol: float) -> Vector:
        """Initialize the instance and run it to the operating point; return its states there."""
        driver = ModelExchange(self.instance, SOLVER, starts=values, rtol=rtol)
        h = self.t or 1.0
        none_held = np.zeros(len(self._u), np.bool_)
        driver.prepare(h, none_held, {})
        driver.initialize(0.0, self._u)
        driver.outputs(0.0, self._u)
        self.warnings = [m.text for m in driver.drain() if m.level == "warning"]
        if self.t > 0.0:
            times = np.array([0.0, self.t])
            inputs = np.array([self._u, self._u])
            try:
                driver.advance(times, h, inputs)
            except RunError as error:
                raise RunError(f"{self._name}: on the way to t = {self.t} s: {error}") from error
        return self.instance.get_continuous_states()

    def _evaluate(self, x: Vector, u: Vector) -> tuple[Vector, Vector]:
        """Return the selected derivatives and outputs for all states and inputs."""
        instance = self.instance
        instance.set_time(self.t)
        instance.set_continuous_states(x)
        inputs = self._continuous_inputs
        if inputs.size:
            instance.set_float64(inputs, inputs.take(u))
        dx = instance.get_derivatives()
        y = np.empty(0)
        if self._outputs.size:
            y = instance.get_float64(self._outputs)[self._output_rows]
        return dx[self._state_columns], y

    @property
    def all_states(self) -> Vector:
        """All states there, the selected ones among them."""
        return self._x.copy()

    def displaced(self, x: Vector) -> OperatingPoint:
        """Return the point with all states moved as far as they are from ``x`` at the most.

        How far is relative to the size of a state, its nominal value at the least; each goes the
        way that ``x`` is, within its range. The instance is there then, at this point no more.
        """
        nominals = list(map(usable_nominal, self.instance.get_nominals().tolist()))
        scale = np.maximum(np.abs(self._x), nominals)
        difference = x - self._x
        distance = np.max(np.abs(difference) / scale, initial=0.0) * scale
        step = np.copysign(distance, difference)
        for i, element in enumerate(self.selection.all_states):
            reached = self._x[i] + step[i]
            if not element.variable.minimum <= reached <= element.variable.maximum:
                step[i] = -step[i]
        displaced = copy(self)
        displaced._x = self._x + step
        displaced._read()
        return displaced

    def moved(self, t: float, x: Vector, u: Vector) -> OperatingPoint:
        """Return another point by its time and the selected states and inputs.

        The instance is there then, at this point no more.

        Raises
        ------
        FmuError
            If something is not finite there.
        RunError
            If the instance fails.
        """
        moved = copy(self)
        moved.t = t
        moved._x = self._x.copy()
        moved._x[self._state_columns] = x
        moved._u = self._u.copy()
        moved._u[self._input_columns] = u
        moved._read()
        return moved

    def _check_finite(self, what: str, values: Vector) -> None:
        if not np.isfinite(values).all():
            raise FmuError(
                f"{self._name}: the {what} at t = {self.t} s are not finite: {values.tolist()}; "
                "choose another point"
            )

    # --- both ways to the Jacobian d(dx, y)/d(x, u), shape (n_x + n_y, n_x + n_u) ---

    def jacobian(self, method: Method) -> tuple[Matrix, Matrix | None]:
        """Compute the Jacobian and its error; None: there is none. Raises as both ways to it."""
        if method == METHODS[0]:
            return self.directional(), None
        return self.differences()

    def directional(self) -> Matrix:
        """Compute the Jacobian from directional derivatives, column by column.

        Raises
        ------
        FmuError
            If a state has no derivative among the variables, or an entry is not finite.
        RunError
            If the instance refuses.
        """
        selection = self.selection
        description = self.instance.description
        elements = [derivative_of(description, state) for state in selection.states]
        elements += selection.outputs
        jacobian = np.zeros((len(elements), len(selection.columns)))
        state_rows = self._fill_state_rows(jacobian, elements)
        rows = [row for row in range(len(elements)) if row not in state_rows]
        if rows:
            references, positions = references_of([elements[row] for row in rows])
            for column, known in enumerate(selection.columns):
                derivative = self._directional_derivative(references, known)
                jacobian[rows, column] = derivative[positions]
        if not np.isfinite(jacobian).all():
            raise FmuError(
                f"{self._name}: a directional derivative is not finite; try central differences"
            )
        return jacobian

    def _directional_derivative(self, unknowns: ReferenceMap, known: Element) -> Vector:
        seed = np.zeros(known.variable.size)
        seed[known.index] = 1.0
        knowns = ReferenceMap.of([known.variable])
        try:
            return self.instance.get_directional_derivative(unknowns, knowns, seed)
        except RunError as error:
            raise RunError(f"{error}; central differences do without it") from error

    def differences(self) -> tuple[Matrix, Matrix]:
        """Compute the Jacobian and its error by differences, one state or input at a time.

        Raises
        ------
        FmuError
            If a state or input is at the edge of its range, or nothing is finite around it.
        RunError
            If the instance fails.
        """
        selection = self.selection
        n = len(selection.states)
        n_rows = n + len(selection.outputs)
        jacobian = np.empty((n_rows, len(selection.columns)))
        error = np.empty_like(jacobian)
        nominals = self._nominals()
        for column, known in enumerate(selection.columns):
            f, z = self._along(column)
            scale = max(nominals[column], abs(z))
            room = self._room(known, z)
            slope, slope_error = differentiate(f, z, scale=scale, room=room)
            if not np.isfinite(slope_error).all():
                raise FmuError(
                    f"{self._name}: nothing finite around {known.name!r} = {z}; "
                    "choose another point"
                )
            # what cannot be told from zero is returned as zero, so that feedthrough is structure
            size = np.abs(slope)
            is_nonzero = size > slope_error
            jacobian[:, column] = np.where(is_nonzero, slope, 0.0)
            error[:, column] = slope_error + np.where(is_nonzero, 0.0, size)
        for row in self._fill_state_rows(jacobian[n:], selection.outputs):
            error[n + row] = 0.0
        return jacobian, error

    def _nominals(self) -> list[float]:
        """Return the nominal values of the selected states and inputs."""
        states = self.instance.get_nominals()[self._state_columns].tolist()
        inputs = [element.variable.nominal for element in self.selection.inputs]
        return [usable_nominal(nominal) for nominal in (*states, *inputs)]

    def _room(self, known: Element, z: float) -> float:
        """Return how far an element can move within its range."""
        low = known.variable.minimum
        high = known.variable.maximum
        if not low < z < high:
            raise FmuError(
                f"{self._name}: {known.name!r} = {z} leaves central differences no room in its "
                f"range, {low} to {high}; choose another point"
            )
        return min(z - low, high - z)

    def _along(self, column: int) -> tuple[Callable[[float], Vector], float]:
        """Return derivatives and outputs as a function of one state or input, and its value."""
        x = self._x.copy()
        u = self._u.copy()
        n = len(self._state_columns)
        if column < n:
            vector = x
            position = self._state_columns[column]
        else:
            vector = u
            position = self._input_columns[column - n]

        def values(z: float) -> Vector:
            vector[position] = z
            return np.concatenate(self._evaluate(x, u))

        return values, float(vector[position])

    def _fill_state_rows(self, rows: Matrix, elements: Sequence[Element]) -> list[int]:
        """Fill in the rows of those elements that are states; return which they are.

        A state is a known of a directional derivative, not an unknown: its row follows from the
        structure.
        """
        column_of = {state.key: i for i, state in enumerate(self.selection.states)}
        states = {state.key for state in self.selection.all_states}
        state_rows = []
        for row, element in enumerate(elements):
            if element.key not in states:
                continue
            state_rows.append(row)
            rows[row] = 0.0
            if element.key in column_of:
                rows[row, column_of[element.key]] = 1.0
        return state_rows


def _positions(selected: Sequence[Element], elements: Sequence[Element]) -> NDArray[np.intp]:
    positions = [elements.index(element) for element in selected]
    return np.array(positions, np.intp)
