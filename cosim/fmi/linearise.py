"""A model exchange unit linearised at an operating point.

::

    x' = dx + A (x - x0) + B (u - u0),    y = y0 + C (x - x0) + D (u - u0)

The unit starts at t = 0 with constant inputs and, where asked for, runs to the operating point. There, in continuous-time mode,
the columns of A, B, C and D come from its directional derivatives by unit seeds (FMI 2.0.4 section 2.1.9, FMI 3.0 section 2.2.11:
known are states and continuous inputs, unknown are derivatives and outputs), or from central differences where it has none. An
output that is a state is known, not unknown: its row is completed from the structure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Final, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import FmuError, RunError, nearest
from cosim.fmi.component import load
from cosim.fmi.description import Description, Variable
from cosim.fmi.differences import differentiate
from cosim.fmi.driving.model_exchange import ModelExchange
from cosim.fmi.driving.start import Starts, StartValue, check_start
from cosim.fmi.reading.model_description import read
from cosim.fmi.references import References
from cosim.fmi.unit import ModelExchangeUnit
from cosim.units import BaseUnit

Method: TypeAlias = Literal["directional derivatives", "central differences"]
METHODS: Final[tuple[Method, ...]] = ("directional derivatives", "central differences")

SOLVER: Final = "LSODA"  # to the operating point: stiff or not
NOWHERE: Final = -1  # the value reference of what has none: the states of FMI 1
GOOD: Final = 1e-7  # relative error from which central differences are told to be poor
SINGULAR: Final = 1e-12  # reciprocal condition of A below which there is no static gain


@dataclass(frozen=True, eq=False, kw_only=True)
class Linearisation:
    """A unit near its operating point.

    Parameters
    ----------
    name : str
        Name of the model.
    states, inputs, outputs : tuple of str
        Names of the n_x, n_u and n_y elements.
    A, B, C, D : Matrix, shapes (n_x, n_x), (n_x, n_u), (n_y, n_x), (n_y, n_u)
    t : float
        Time of the operating point [s].
    x, u, y, dx : Vector, shapes (n_x,), (n_u,), (n_y,), (n_x,)
        States, inputs, outputs and derivatives there.
    made : mapping of state or input name to Method
        Where its column comes from.
    errors : mapping of matrix name to float or None
        Estimate of the largest error of an entry; None: all are the unit's own derivatives, taken at their word.
    notes : tuple of str
        What is to be known about the result.
    units : mapping of element name to str
        Where one is declared.
    bases : mapping of element name to BaseUnit
        What such a unit is in SI, where the unit defines it.
    """

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix
    t: float
    x: Vector
    u: Vector
    y: Vector
    dx: Vector
    made: Mapping[str, Method]
    errors: Mapping[str, float | None]
    notes: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    bases: Mapping[str, BaseUnit] = field(default_factory=dict)

    @property
    def poles(self) -> NDArray[np.complex128]:
        """The eigenvalues of A [1/s], sorted by real part."""
        return np.sort_complex(np.linalg.eigvals(self.A).astype(np.complex128)) if self.A.size else np.zeros(0, np.complex128)

    @property
    def static_gain(self) -> Matrix | None:
        """D - C A^-1 B, shape (n_y, n_u): what constant inputs move the outputs to; None where A is singular."""
        if not self.A.size:
            return self.D
        values = np.linalg.svd(self.A, compute_uv=False)
        if values[-1] <= max(SINGULAR * values[0], len(self.A) * (self.errors["A"] or 0.0)):
            return None
        gain: Matrix = self.D - self.C @ np.linalg.solve(self.A, self.B)
        return gain

    @property
    def constants(self) -> tuple[Vector, Vector]:
        """What ``x' = A x + B u + c``, ``y = C x + D u + d`` need beside the matrices, c and d; zero where it is rounding."""
        z = np.concatenate([self.x, self.u])
        parts = ((self.dx, "A", "B", np.hstack([self.A, self.B])), (self.y, "C", "D", np.hstack([self.C, self.D])))
        return tuple(self._constant(value, first, second, matrix, z) for value, first, second, matrix in parts)  # type: ignore[return-value]

    def _constant(self, value: Vector, first: str, second: str, matrix: Matrix, z: Vector) -> Vector:
        terms = np.abs(value) + np.abs(matrix) @ np.abs(z)
        error = max(self.errors[first] or 0.0, self.errors[second] or 0.0) * np.abs(z).sum()
        rest = value - matrix @ z
        return np.where(np.abs(rest) > 8.0 * np.finfo(np.float64).eps * terms + error, rest, 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Give plain values, from which :meth:`of` builds the same bits again."""
        return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in asdict(self).items()}

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> Self:
        """Build it from what :meth:`to_dict` gave, also by way of JSON."""
        n_x, n_u, n_y = (len(plain[name]) for name in ("states", "inputs", "outputs"))
        shapes = {"A": (n_x, n_x), "B": (n_x, n_u), "C": (n_y, n_x), "D": (n_y, n_u), **dict.fromkeys(("x", "u", "y", "dx"), -1)}
        found = {entry.name: plain[entry.name] for entry in fields(cls)}
        found["bases"] = {
            name: BaseUnit(**base | {"exponents": tuple(base["exponents"])}) for name, base in plain["bases"].items()
        }
        found |= {name: np.array(plain[name], np.float64).reshape(shape) for name, shape in shapes.items()}
        return cls(**found | {name: tuple(plain[name]) for name in ("states", "inputs", "outputs", "notes")})


def linearize(
    unit: str | Path | ModelExchangeUnit,
    *,
    at: float = 0.0,
    start: Starts | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    states: Sequence[str] | None = None,
    method: Method | None = None,
) -> Linearisation:
    """Linearise an .fmu, or a unit for model exchange; see :func:`linearise`.

    Parameters
    ----------
    unit : str, Path or ModelExchangeUnit
        The path of an .fmu; or a unit: of an opened FMU its ``unit``.
    at, start, inputs, outputs, states, method
        As in :func:`linearise`.

    Raises
    ------
    FmuError
        As :func:`linearise`, or if the file cannot be used; co-simulation alone does not show the states.
    """
    wanted: dict[str, Any] = {"at": at, "start": start, "inputs": inputs, "outputs": outputs, "states": states, "method": method}
    if not isinstance(unit, str | Path):
        return linearise(unit, **wanted)
    description = read(unit).description
    if "me" not in description.capabilities:
        raise FmuError(
            f"{unit}: is for co-simulation only, which does not show the states; linearising needs model exchange: export it for "
            "that too"
        )
    structural = {
        n: v for n, v in (start or {}).items() if n in description and description[n].causality == "structuralParameter"
    }
    with load(unit, mode="me", start=structural) as fmu:  # they decide the sizes of arrays
        return linearise(fmu.unit, **wanted)


def linearise(
    unit: ModelExchangeUnit,
    *,
    at: float = 0.0,
    start: Starts | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    states: Sequence[str] | None = None,
    method: Method | None = None,
) -> Linearisation:
    """Linearise a unit for model exchange; it is reset before and after.

    Parameters
    ----------
    unit : ModelExchangeUnit
    at : float
        The operating point is where the unit arrives at this time [s], from t = 0 with constant inputs.
    start : mapping of variable name to StartValue
        Values at t = 0 instead of the unit's own: inputs, parameters, states, with ``at`` 0 any state; see ``start.py``. Elements
        of inputs and of such states may be named too.
    inputs, outputs : sequence of str, optional
        Names of ports, variables or their elements, in this order; left out: all that are real and continuous.
    states : sequence of str, optional
        The same for states; those left out are held.
    method : Method, optional
        Left out: directional derivatives where the unit has them, else central differences.

    Raises
    ------
    FmuError
        If a name or a value is wrong, the method is not there, or something is not finite at the operating point.
    RunError
        If the unit cannot go on.
    """
    description = unit.description
    if not (math.isfinite(at) and at >= 0.0):
        raise FmuError(f"{description.name}: linearised at t = {at} s; needed a time from 0 on")
    method = _method(description, method)
    chosen = _Chosen.of(description, states=states, inputs=inputs, outputs=outputs)
    unit.reset()
    try:
        point = _Point(unit, chosen, at, start or {})
        jacobian, error = point.directional() if method == METHODS[0] else point.differences()
    finally:
        with suppress(RunError):  # a unit that is lost cannot be reset either
            unit.reset()
    return _result(point, jacobian, error, method)


@dataclass(frozen=True, slots=True)
class _Element:
    """One number of a variable, and the port that it belongs to."""

    name: str
    port: str
    variable: Variable
    index: int

    @property
    def key(self) -> tuple[str, int, int]:
        """The same for aliases (FMI 2.0.4 section 2.2.7: equal value references)."""
        return self.variable.type, self.variable.reference, self.index

    @property
    def moves(self) -> bool:
        """Whether it is real and continuous."""
        return self.variable.kind == "real" and self.variable.variability == "continuous"

    @property
    def whole(self) -> bool:
        """Whether it is all of a variable that has a name."""
        return self.variable.size == 1 and self.variable.reference != NOWHERE

    def checked(self, label: str, value: StartValue) -> float:
        """Refuse what is no finite number, or outside the range."""
        low, high = self.variable.minimum, self.variable.maximum
        if not (isinstance(value, int | float) and math.isfinite(value) and low <= value <= high):
            needed = "a finite number" if math.isinf(low) and math.isinf(high) else f"{low} to {high}"
            raise FmuError(f"{label}: start value of {self.name!r}: found {value!r}, needed {needed}")
        return value


def _elements(port: str, variable: Variable) -> Iterator[_Element]:
    alone = variable.size == 1 and variable.reference != NOWHERE
    for i in range(variable.size):
        yield _Element(variable.name if alone else f"{variable.name}[{i}]", port, variable, i)


@dataclass(frozen=True, slots=True)
class _Chosen:
    """What a unit is linearised for, among all its states and inputs."""

    all_states: tuple[_Element, ...]
    all_inputs: tuple[_Element, ...]
    states: tuple[_Element, ...]
    inputs: tuple[_Element, ...]
    outputs: tuple[_Element, ...]

    @staticmethod
    def of(
        description: Description,
        *,
        states: Sequence[str] | None,
        inputs: Sequence[str] | None,
        outputs: Sequence[str] | None,
    ) -> _Chosen:
        """Find what is named."""
        label = description.name
        unnamed = Variable("state", NOWHERE, "local", size=description.unnamed_states)
        variables = [*map(description.__getitem__, description.states), *([unnamed] if unnamed.size else [])]
        all_states = tuple(e for v in variables for e in _elements(v.name.rpartition("[")[0], v))
        all_inputs, all_outputs = (
            tuple(e for signal, group in description.ports(causality) for v in group for e in _elements(signal.name, v))
            for causality in ("input", "output")
        )
        shown = [e for e in all_outputs if e.moves and e.variable.causality == "output"]
        return _Chosen(
            all_states,
            all_inputs,
            states=_select(label, "state", all_states, states, all_states),
            inputs=_select(label, "input", all_inputs, inputs, [e for e in all_inputs if e.moves]),
            outputs=_select(label, "output", all_outputs, outputs, shown),
        )

    @property
    def columns(self) -> tuple[_Element, ...]:
        """States, then inputs."""
        return self.states + self.inputs

    @property
    def notes(self) -> tuple[str, ...]:
        """What does not move although it might."""
        still = [e.name for e in self.all_inputs if not e.moves]
        held = [e.name for e in self.all_states if e not in self.states]
        return (
            *(
                [f"{', '.join(still)} held constant: only inputs that are real and continuous can be linearised for"]
                * bool(still)
            ),
            *([f"{', '.join(held)} held at the operating point: not among the states that were named"] * bool(held)),
        )


def _select(
    label: str, what: str, there: Sequence[_Element], wanted: Sequence[str] | None, default: Sequence[_Element]
) -> tuple[_Element, ...]:
    if wanted is None:
        return tuple(default)
    found: list[_Element] = []
    for name in wanted:
        own = [e for e in there if name in (e.name, e.variable.name)] or [e for e in there if name == e.port]
        still = next((e for e in own if not e.moves), None)
        if not own:
            raise FmuError(f"{label}: no {what} {name!r}; {nearest(name, [e.name for e in there])}")
        if still is not None:
            how = f"type {still.variable.type}, variability {still.variable.variability}"
            raise FmuError(f"{label}: {what} {name!r} cannot be linearised for: found {how}, needed a real and continuous one")
        if any(e.name == other.name for e in own for other in found):
            raise FmuError(f"{label}: {what} {name!r} is named twice; needed each once")
        found += own
    return tuple(found)


def _method(description: Description, method: Method | None) -> Method:
    able = description.capabilities["me"].directional_derivatives
    if method is None:
        return METHODS[0] if able else METHODS[1]
    if method not in METHODS:
        raise FmuError(f"{description.name}: no method {method!r}; {nearest(method, METHODS)}")
    if method == METHODS[0] and not able:
        raise FmuError(f"{description.name}: has no directional derivatives; leave the method out, or use {METHODS[1]!r}")
    return method


class _Point:
    """A unit at its operating point, in continuous-time mode."""

    def __init__(self, unit: ModelExchangeUnit, chosen: _Chosen, at: float, start: Starts) -> None:
        self.unit, self.chosen, self.t = unit, chosen, at
        description = unit.description
        self._moving = _read([e for e in chosen.all_inputs if e.moves])
        self._moves = np.array([e.moves for e in chosen.all_inputs], np.bool_)
        self._outputs, self._rows = _read(chosen.outputs), _places(chosen.outputs)
        self._x_at, self._u_at = (
            np.array([there.index(e) for e in some], np.intp)
            for there, some in ((chosen.all_states, chosen.states), (chosen.all_inputs, chosen.inputs))
        )
        values = dict(start)
        late = self._pop({e.name: e for e in chosen.all_states if at == 0.0 and not (e.whole and e.variable.settable)}, values)
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

    def _pop(self, named: Mapping[str, _Element], values: dict[str, StartValue]) -> list[tuple[_Element, float]]:
        """Take the values of elements out of the start values."""
        return [(e, e.checked(self.unit.description.name, values.pop(name))) for name, e in named.items() if name in values]

    def _inputs(self, values: Starts, moved: Iterable[tuple[_Element, float]]) -> Vector:
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
                raise RunError(f"{self.unit.description.name}: on the way to t = {self.t} s: {error}") from error
        return self.unit.get_continuous_states()

    def _evaluate(self, x: Vector, u: Vector) -> tuple[Vector, Vector]:
        """Give the derivatives and outputs that were chosen, for all states and inputs."""
        unit = self.unit
        unit.set_time(self.t)
        unit.set_continuous_states(x)
        if self._moving.size:
            unit.set_float64(self._moving, u[self._moves])
        dx = unit.get_derivatives()[self._x_at]
        return dx, unit.get_float64(self._outputs)[self._rows] if self._outputs.size else np.empty(0)

    # --- both ways to the Jacobian d(dx, y)/d(x, u), shape (n_x + n_y, n_x + n_u), and its error ---

    def directional(self) -> tuple[Matrix, Matrix | None]:
        """Ask the unit, column by column."""
        elements = (*(_derivative(self.unit.description, e) for e in self.chosen.states), *self.chosen.outputs)
        jacobian = np.zeros((len(elements), len(self.chosen.columns)))
        known_rows = self._complete(jacobian, elements)
        rows = [i for i in range(len(elements)) if i not in known_rows]
        unknowns = [elements[i] for i in rows]
        at, references = _places(unknowns), _numbers(unknowns)
        for column, known in enumerate(self.chosen.columns if rows else ()):
            seed = np.zeros(known.variable.size)
            seed[known.index] = 1.0
            try:
                found = self.unit.get_directional_derivative(references, _numbers([known]), seed)
            except RunError as error:
                raise RunError(f"{error}; central differences do without it") from error
            jacobian[rows, column] = found[at]
        if not np.isfinite(jacobian).all():
            raise FmuError(f"{self.unit.description.name}: a directional derivative is not finite; try central differences")
        return jacobian, None

    def differences(self) -> tuple[Matrix, Matrix | None]:
        """Move one state or input at a time."""
        chosen = self.chosen
        jacobian = np.empty((len(chosen.states) + len(chosen.outputs), len(chosen.columns)))
        error = np.empty_like(jacobian)
        nominals = [*self.unit.get_nominals()[self._x_at].tolist(), *(e.variable.nominal for e in chosen.inputs)]
        for column, known in enumerate(chosen.columns):
            f, z = self._along(column)
            scale = max(abs(nominals[column] or 1.0), abs(z))
            found, wrong = differentiate(f, z, scale=scale, room=self._room(known, z))
            if not np.isfinite(wrong).all():
                raise FmuError(f"{self.unit.description.name}: nothing finite around {known.name!r} = {z}; choose another point")
            real = np.abs(found) > wrong  # what cannot be told from zero is given as zero, so that feedthrough is structure
            jacobian[:, column], error[:, column] = np.where(real, found, 0.0), wrong + np.where(real, 0.0, np.abs(found))
        n = len(chosen.states)
        error[[n + i for i in self._complete(jacobian[n:], chosen.outputs)]] = 0.0
        return jacobian, error

    def _room(self, known: _Element, z: float) -> float:
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

    def _complete(self, rows: Matrix, elements: Sequence[_Element]) -> list[int]:
        """Fill in the rows of those elements that are states; tell which they are."""
        column_of = {e.key: j for j, e in enumerate(self.chosen.states)}
        states = {e.key for e in self.chosen.all_states}
        found = [i for i, e in enumerate(elements) if e.key in states]
        for i in found:
            rows[i] = 0.0
            if elements[i].key in column_of:
                rows[i, column_of[elements[i].key]] = 1.0
        return found


def _derivative(description: Description, state: _Element) -> _Element:
    """Find the derivative of a state element."""
    mine = [v for v in description.variables if v.derivative_of == state.variable.name]
    mine.sort(key=lambda v: v.name not in description.dependencies)  # the one that ModelStructure names
    if not mine:
        raise FmuError(f"{description.name}: no variable is the derivative of {state.name!r}; use central differences")
    return _Element(f"der({state.name})", "", mine[0], state.index)


def _read(elements: Sequence[_Element]) -> References:
    """Give the references of the variables of some elements, each once."""
    return References.of([(v.type, v.reference, v.size) for v in _once(elements)])


def _numbers(elements: Sequence[_Element]) -> References:
    """Give the same for directional derivatives, whose numbers are Float64 whatever the variables are."""
    return References.of([("Float64", v.reference, v.size) for v in _once(elements)])


def _places(elements: Sequence[_Element]) -> NDArray[np.intp]:
    """Give where elements stand in the values of their variables, each variable once."""
    starts, size = {}, 0
    for variable in _once(elements):
        starts[variable.type, variable.reference] = size
        size += variable.size
    return np.array([starts[e.variable.type, e.variable.reference] + e.index for e in elements], np.intp)


def _once(elements: Sequence[_Element]) -> list[Variable]:
    return list({(e.variable.type, e.variable.reference): e.variable for e in elements}.values())


def _result(point: _Point, jacobian: Matrix, error: Matrix | None, method: Method) -> Linearisation:
    chosen, description = point.chosen, point.unit.description
    n = len(chosen.states)
    top, bottom = slice(n), slice(n, None)
    parts = {"A": (top, top), "B": (top, bottom), "C": (bottom, top), "D": (bottom, bottom)}
    matrices = {letter: np.ascontiguousarray(jacobian[part]) for letter, part in parts.items()}
    errors = {letter: None if error is None else float(error[part].max(initial=0.0)) for letter, part in parts.items()}
    sizes = {letter: float(np.linalg.norm(jacobian[rows])) for letter, (rows, _) in parts.items()}  # of A and B, of C and D
    poor = [
        f"{letter} by central differences: error up to {wrong:.1g}"
        for letter, wrong in errors.items()
        if wrong is not None and wrong > GOOD * sizes[letter] > 0.0
    ]
    shown = (*chosen.columns, *chosen.outputs)
    count = description.event_indicators
    events = f"event indicators ({count}): linearised within the mode it is in" if count else ""
    return Linearisation(
        name=description.name,
        states=tuple(e.name for e in chosen.states),
        inputs=tuple(e.name for e in chosen.inputs),
        outputs=tuple(e.name for e in chosen.outputs),
        **matrices,
        t=point.t,
        x=point.x,
        u=point.u,
        y=point.y,
        dx=point.dx,
        made={e.name: method for e in chosen.columns},
        errors=errors,
        units={e.name: e.variable.unit for e in shown if e.variable.unit is not None},
        bases={e.name: e.variable.base for e in shown if e.variable.base is not None},
        notes=(*([events] if events else []), *chosen.notes, *poor),
    )
