"""A unit at its operating point, and both ways to its Jacobian there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final, final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import FmuError, RunError
from cosim.fmi.driving.initialization import Starts, StartValue, check_start
from cosim.fmi.driving.model_exchange import ModelExchange
from cosim.fmi.instance import ModelExchangeInstance
from cosim.fmi.linearizing.differences import differentiate
from cosim.fmi.linearizing.elements import Chosen, Element, derivative_of, references_of
from cosim.fmi.references import ReferenceMap

SOLVER: Final = "LSODA"  # to the operating point: stiff or not


@final
class OperatingPoint:
    """A unit at its operating point, in continuous-time mode."""

    def __init__(
        self, unit: ModelExchangeInstance, chosen: Chosen, at: float, start: Starts
    ) -> None:
        self.unit, self.chosen, self.t = unit, chosen, at
        description = unit.description
        moves = np.array([e.moves for e in chosen.all_inputs], np.bool_)
        self._moving = description.references("input").select(moves)
        self._outputs, self._rows = references_of(chosen.outputs)
        self._x_at, self._u_at = (
            np.array([there.index(e) for e in some], np.intp)
            for there, some in (
                (chosen.all_states, chosen.states),
                (chosen.all_inputs, chosen.inputs),
            )
        )
        values = dict(start)
        late = self._pop(
            {
                e.name: e
                for e in chosen.all_states
                if at == 0.0 and not (e.whole and e.variable.settable)
            },
            values,
        )
        moved = self._pop({e.name: e for e in chosen.all_inputs if not e.whole}, values)
        self._u = self._inputs(values, moved)
        self._x = self._arrive(values)
        for element, value in late:
            self._x[chosen.all_states.index(element)] = value
        self.dx, self.y = self._evaluate(self._x, self._u)
        self.x, self.u = self._x[self._x_at], self._u[self._u_at]
        for what, found in (("states", self.x), ("derivatives", self.dx), ("outputs", self.y)):
            if not np.isfinite(found).all():
                raise FmuError(
                    f"{description.name}: the {what} at t = {at} s are not finite: {found.tolist()}; choose another point"
                )

    def _pop(
        self, named: Mapping[str, Element], values: dict[str, StartValue]
    ) -> list[tuple[Element, float]]:
        """Take the values of elements out of the start values."""
        return [
            (e, e.checked(self.unit.description.name, values.pop(name)))
            for name, e in named.items()
            if name in values
        ]

    def _inputs(self, values: Starts, moved: Iterable[tuple[Element, float]]) -> Vector:
        """Give all inputs: those that are given, else the unit's own."""
        description, there = self.unit.description, self.chosen.all_inputs
        u = np.array([(e.variable.start or (0.0,) * e.variable.size)[e.index] for e in there])
        for name, given in check_start(description, values).numbers.items():
            own = description[name].alias_of or name
            columns = [i for i, e in enumerate(there) if e.variable.name == own]
            if columns:
                u[columns] = given
        for element, value in moved:
            u[there.index(element)] = value
        return u

    def _arrive(self, values: Starts) -> Vector:
        """Start the unit and run it to the operating point; give its states."""
        driver, h = ModelExchange(self.unit, SOLVER, starts=values), self.t or 1.0
        driver.prepare(h, np.zeros(len(self._u), np.bool_), {})
        driver.initialize(0.0, self._u)
        driver.outputs(0.0, self._u)
        if self.t > 0.0:
            try:
                driver.advance(np.array([0.0, self.t]), h, np.array([self._u, self._u]))
            except RunError as error:
                raise RunError(
                    f"{self.unit.description.name}: on the way to t = {self.t} s: {error}"
                ) from error
        return self.unit.get_continuous_states()

    def _evaluate(self, x: Vector, u: Vector) -> tuple[Vector, Vector]:
        """Give the derivatives and outputs that were chosen, for all states and inputs."""
        unit = self.unit
        unit.set_time(self.t)
        unit.set_continuous_states(x)
        if self._moving.size:
            unit.set_float64(self._moving, self._moving.take(u))
        dx = unit.get_derivatives()[self._x_at]
        return dx, unit.get_float64(self._outputs)[self._rows] if self._outputs.size else np.empty(
            0
        )

    # --- both ways to the Jacobian d(dx, y)/d(x, u), shape (n_x + n_y, n_x + n_u), and its error ---

    def directional(self) -> tuple[Matrix, Matrix | None]:
        """Ask the unit, column by column."""
        elements = (
            *(derivative_of(self.unit.description, e) for e in self.chosen.states),
            *self.chosen.outputs,
        )
        jacobian = np.zeros((len(elements), len(self.chosen.columns)))
        known_rows = self._complete(jacobian, elements)
        rows = [i for i in range(len(elements)) if i not in known_rows]
        unknowns = [elements[i] for i in rows]
        references, at = references_of(unknowns)
        for column, known in enumerate(self.chosen.columns if rows else ()):
            seed = np.zeros(known.variable.size)
            seed[known.index] = 1.0
            try:
                found = self.unit.get_directional_derivative(
                    references, ReferenceMap.of([known.variable]), seed
                )
            except RunError as error:
                raise RunError(f"{error}; central differences do without it") from error
            jacobian[rows, column] = found[at]
        if not np.isfinite(jacobian).all():
            raise FmuError(
                f"{self.unit.description.name}: a directional derivative is not finite; try central differences"
            )
        return jacobian, None

    def differences(self) -> tuple[Matrix, Matrix | None]:
        """Move one state or input at a time."""
        chosen = self.chosen
        jacobian = np.empty((len(chosen.states) + len(chosen.outputs), len(chosen.columns)))
        error = np.empty_like(jacobian)
        nominals = [
            *self.unit.get_nominals()[self._x_at].tolist(),
            *(e.variable.nominal for e in chosen.inputs),
        ]
        for column, known in enumerate(chosen.columns):
            f, z = self._along(column)
            scale = max(abs(nominals[column] or 1.0), abs(z))
            found, wrong = differentiate(f, z, scale=scale, room=self._room(known, z))
            if not np.isfinite(wrong).all():
                raise FmuError(
                    f"{self.unit.description.name}: nothing finite around {known.name!r} = {z}; choose another point"
                )
            real = (
                np.abs(found) > wrong
            )  # what cannot be told from zero is given as zero, so that feedthrough is structure
            jacobian[:, column], error[:, column] = (
                np.where(real, found, 0.0),
                wrong + np.where(real, 0.0, np.abs(found)),
            )
        n = len(chosen.states)
        error[[n + i for i in self._complete(jacobian[n:], chosen.outputs)]] = 0.0
        return jacobian, error

    def _room(self, known: Element, z: float) -> float:
        """Give how far an element may move within its range."""
        low, high = known.variable.minimum, known.variable.maximum
        if not low < z < high:
            raise FmuError(
                f"{self.unit.description.name}: {known.name!r} = {z} leaves central differences no room in its range, "
                f"{low} to {high}; choose another point"
            )
        return min(z - low, high - z)

    def _along(self, column: int) -> tuple[Callable[[float], Vector], float]:
        """Give derivatives and outputs as a function of one chosen state or input, and its value here."""
        x, u, n = self._x.copy(), self._u.copy(), len(self._x_at)
        vector, at = (x, self._x_at[column]) if column < n else (u, self._u_at[column - n])

        def values(z: float) -> Vector:
            vector[at] = z
            return np.concatenate(self._evaluate(x, u))

        return values, float(vector[at])

    def _complete(self, rows: Matrix, elements: Sequence[Element]) -> list[int]:
        """Fill in the rows of those elements that are states; tell which they are."""
        column_of = {e.key: j for j, e in enumerate(self.chosen.states)}
        states = {e.key for e in self.chosen.all_states}
        found = [i for i, e in enumerate(elements) if e.key in states]
        for i in found:
            rows[i] = 0.0
            if elements[i].key in column_of:
                rows[i, column_of[elements[i].key]] = 1.0
        return found
