"""A linearized FMU as the design model of an observer, and as a table of a scenario."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.linear import LinearModel
from cosim.core.signals import Signal
from cosim.errors import UsageError, nearest
from cosim.theory.plants.descriptor import ReducedSystem
from cosim.units import Unit

if TYPE_CHECKING:
    from cosim.fmi.linearizing.linearization import Linearization
    from cosim.fmi.linearizing.moving import MovingLinearization


MOST_OF_ERROR: Final = 10.0  # how many times larger than its estimate an error may be


class DesignModel(NamedTuple):
    """The model that an observer is designed on.

    Parameters
    ----------
    reduced : ReducedSystem
    constant : bool
        Whether the last input of ``reduced`` is the constant 1.
    units : mapping of signal name to tuple of Unit
        Those that are declared of the elements of the observer's signals u, y, x_a and delta.
    """

    reduced: ReducedSystem
    constant: bool = False
    units: Mapping[str, tuple[Unit, ...]] = MappingProxyType({})

    def declare(self, model: LinearModel) -> LinearModel:
        """Declare the units of the signals of an observer."""
        interface = model.interface
        inputs = self.declared(interface.inputs)
        outputs = self.declared(interface.outputs)
        return replace(model, interface=replace(interface, inputs=inputs, outputs=outputs))

    def declared(self, signals: Iterable[Signal]) -> tuple[Signal, ...]:
        """Return signals of an observer with their units."""
        return tuple(
            signal.in_units(self.units.get(signal.name) or (Unit(None),) * signal.size)
            for signal in signals
        )


def design_model(linearization: Linearization, disturbances: Sequence[str]) -> DesignModel:
    """Build the design model of a linearization: (9)-(10) without x_b.

    It is ``x' = A x + B_1 u + B_2 delta + c``, ``y = C x + C_4 u + C_5 delta + d``. c and d are
    what an operating point away from an equilibrium at zero leaves: they act through one more
    input, the constant 1.

    Raises
    ------
    UsageError
        If a disturbance is none of the inputs, or is named twice.
    """
    known, unknown = split(linearization, disturbances)
    c, d = linearization.constants
    constant = bool(c.any() or d.any())
    B_1 = linearization.B[:, known]
    C_4 = linearization.D[:, known]
    if constant:
        B_1 = np.hstack([B_1, c[:, np.newaxis]])
        C_4 = np.hstack([C_4, d[:, np.newaxis]])
    n = len(linearization.states)
    reduced = ReducedSystem(
        A_a=linearization.A,
        B_1a=B_1,
        B_2a=linearization.B[:, unknown],
        C3=linearization.C,
        C4=C_4,
        C5=_direct(linearization, unknown),
        Kx=np.zeros((0, n)),
        Ku=np.zeros((0, len(known) + constant)),
        Kd=np.zeros((0, len(unknown))),
    )
    units = {
        "u": _units(linearization, [linearization.inputs[i] for i in known]),
        "delta": _units(linearization, [linearization.inputs[i] for i in unknown]),
        "y": _units(linearization, linearization.outputs),
        "x_a": _units(linearization, linearization.states),
    }
    return DesignModel(reduced, constant, units)


def _direct(linearization: Linearization, unknown: Sequence[int]) -> Matrix:
    """Return the direct paths from delta to y; what may be the error of a difference is none."""
    D = linearization.D[:, unknown]
    return _beyond_error(D, linearization.errors["D"] or 0.0)


def _beyond_error(D: Matrix, error: float) -> Matrix:
    return np.where(np.abs(D) > MOST_OF_ERROR * error, D, 0.0)


class MovingModel:
    """An FMU as the design model of an observer, linearized wherever its estimate is.

    Parameters
    ----------
    fmu : MovingLinearization
    known, unknown : sequence of int
        Columns of u and of delta among the inputs.

    Attributes
    ----------
    x, delta : Vector
        Its own, at the operating point.
    """

    def __init__(
        self, fmu: MovingLinearization, known: Sequence[int], unknown: Sequence[int]
    ) -> None:
        self._fmu = fmu
        self._known = list(known)
        self._unknown = list(unknown)
        self.x = fmu.x
        self.delta = fmu.u[self._unknown]

    def local(self, t: float, x: Vector, u: Vector, delta: Vector) -> ReducedSystem:
        """Linearize at a point; the last input is the constant 1.

        Raises
        ------
        FmuError, RunError
            If the FMU cannot be linearized there.
        """
        inputs = np.zeros_like(self._fmu.u)
        inputs[self._known] = u
        inputs[self._unknown] = delta
        at = self._fmu.at(t, x, inputs)
        n = len(x)
        A = at.jacobian[:n, :n]
        B = at.jacobian[:n, n:]
        C = at.jacobian[n:, :n]
        D = at.jacobian[n:, n:]
        c = at.dx - A @ x - B @ inputs
        d = at.y - C @ x - D @ inputs
        error = 0.0 if at.error is None else float(at.error[n:, n:].max(initial=0.0))
        return ReducedSystem(
            A_a=A,
            B_1a=np.column_stack([B[:, self._known], c]),
            B_2a=B[:, self._unknown],
            C3=C,
            C4=np.column_stack([D[:, self._known], d]),
            C5=_beyond_error(D[:, self._unknown], error),
            Kx=np.zeros((0, n)),
            Ku=np.zeros((0, len(self._known) + 1)),
            Kd=np.zeros((0, len(self._unknown))),
        )


def _units(linearization: Linearization, names: Sequence[str]) -> tuple[Unit, ...]:
    """Return the units of the elements of a signal; none where one of them has none."""
    units = [Unit(linearization.units.get(name), linearization.bases.get(name)) for name in names]
    return () if any(unit.name is None for unit in units) else tuple(units)


def split(linearization: Linearization, disturbances: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return the columns of the known inputs and those of the disturbances.

    Disturbances may be named by port or by element.

    Raises
    ------
    UsageError
        If a disturbance is none of the inputs, or is named twice.
    """
    unknown: list[int] = []
    for name in disturbances:
        columns = _columns(linearization, name)
        if not columns:
            advice = nearest(name, linearization.inputs)
            raise UsageError(
                f"disturbance {name!r} is not an input of {linearization.name}; {advice}"
            )
        if set(columns) & set(unknown):
            raise UsageError(f"disturbance {name!r} is named twice")
        unknown += columns
    known = [i for i in range(len(linearization.inputs)) if i not in unknown]
    return known, unknown


def _columns(linearization: Linearization, name: str) -> list[int]:
    """Return the columns of an element or of all elements of a port."""
    columns = []
    for i, element in enumerate(linearization.inputs):
        if name in (element, linearization.ports.get(element)):
            columns.append(i)
    return columns


def model_toml(linearization: Linearization, disturbances: Sequence[str]) -> str:
    """Write a linearization as a table of [models], in the general form.

    Raises
    ------
    UsageError
        If a disturbance is none of the inputs, or no states or outputs are there.
    """
    known, unknown = split(linearization, disturbances)
    _check_not_empty(linearization, "state", linearization.states)
    _check_not_empty(linearization, "output", linearization.outputs)
    B = linearization.B
    matrices = {
        "A": linearization.A,
        "Bu": B[:, known],
        "Bd": B[:, unknown],
        "C": linearization.C,
        "Du": linearization.D[:, known],
        "Dd": _direct(linearization, unknown),
    }
    lines = _header(linearization, known, unknown)
    for name, matrix in matrices.items():
        if matrix.any() or (matrix.size and not name.startswith("D")):
            lines.append(f"{name} = {_rows(matrix)}")
    return "\n".join(lines) + "\n"


def _check_not_empty(linearization: Linearization, what: str, columns: Sequence[object]) -> None:
    if not columns:
        inputs = ", ".join(linearization.inputs) or "none"
        raise UsageError(
            f"{linearization.name}: a table of [models] requires a {what}; inputs: {inputs}"
        )


def _header(
    linearization: Linearization, known: Sequence[int], unknown: Sequence[int]
) -> list[str]:
    name = linearization.name
    u = ", ".join(linearization.inputs[i] for i in known)
    delta = ", ".join(linearization.inputs[i] for i in unknown)
    x = ", ".join(linearization.states)
    y = ", ".join(linearization.outputs)
    lines = [
        f"[models.{re.sub(r'[^A-Za-z0-9_-]', '_', name)}]",
        f"# {name} linearized at t = {linearization.t} s, {_operating_point(linearization)}",
    ]
    c, d = linearization.constants
    if c.any() or d.any():
        lines.append(
            f"# for deviations from this point: it lacks c = {c.tolist()} of x' = ... + c "
            f"and d = {d.tolist()} of y = ... + d"
        )
    names = {"x": x, "u": u, "delta": delta, "y": y}
    listed = "; ".join(f"{signal}: {listing}" for signal, listing in names.items() if listing)
    lines.append(f"# {listed}")
    return [" ".join(line.splitlines()) for line in lines]  # a name of an FMU may have several


def _operating_point(linearization: Linearization) -> str:
    names = [*linearization.states, *linearization.inputs]
    values = [*linearization.x.tolist(), *linearization.u.tolist()]
    pairs = zip(names, values, strict=True)
    return ", ".join(f"{name} = {value!r}" for name, value in pairs)


def _rows(matrix: Matrix) -> str:
    """Write a matrix in TOML."""
    rows = []
    for row in (matrix + 0.0).tolist():  # + 0.0: no -0.0 in the file
        numbers = ", ".join(map(repr, row))
        rows.append(f"[{numbers}]")
    return f"[{', '.join(rows)}]"
