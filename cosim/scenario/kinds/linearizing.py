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
    reduced = _reduced(
        (linearization.A, linearization.B, linearization.C, linearization.D),
        known,
        unknown,
        constants=(c, d) if constant else None,
        error=linearization.errors["D"] or 0.0,
    )
    units = {
        "u": _units(linearization, [linearization.inputs[i] for i in known]),
        "delta": _units(linearization, [linearization.inputs[i] for i in unknown]),
        "y": _units(linearization, linearization.outputs),
        "x_a": _units(linearization, linearization.states),
    }
    return DesignModel(reduced, constant, units)


def _reduced(
    matrices: tuple[Matrix, Matrix, Matrix, Matrix],
    known: Sequence[int],
    unknown: Sequence[int],
    *,
    constants: tuple[Vector, Vector] | None,
    error: float,
) -> ReducedSystem:
    """Return the design model of A, B, C, D, with constants c, d as one more input.

    ``error`` is that of an entry of D.
    """
    A, B, C, D = matrices
    B_1 = B[:, known]
    C_4 = D[:, known]
    if constants is not None:
        c, d = constants
        B_1 = np.column_stack([B_1, c])
        C_4 = np.column_stack([C_4, d])
    return ReducedSystem(
        A_a=A,
        B_1a=B_1,
        B_2a=B[:, unknown],
        C3=C,
        C4=C_4,
        C5=_direct(D[:, unknown], error),
        Kx=np.zeros((0, len(A))),
        Ku=np.zeros((0, B_1.shape[1])),
        Kd=np.zeros((0, len(unknown))),
    )


def _direct(D: Matrix, error: float) -> Matrix:
    """Return the direct paths from delta to y; what may be the error of a difference is none."""
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
        return _reduced((A, B, C, D), self._known, self._unknown, constants=(c, d), error=error)


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
        columns = [
            i
            for i, element in enumerate(linearization.inputs)
            if name in (element, linearization.ports.get(element))
        ]
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


def model_toml(linearization: Linearization, disturbances: Sequence[str]) -> str:
    """Write a linearization as a table of [models], in the general form.

    Raises
    ------
    UsageError
        If a disturbance is none of the inputs, or no states or outputs are there.
    """
    known, unknown = split(linearization, disturbances)
    for what, columns in (("state", linearization.states), ("output", linearization.outputs)):
        if not columns:
            inputs = ", ".join(linearization.inputs) or "none"
            raise UsageError(
                f"{linearization.name}: a table of [models] requires a {what}; inputs: {inputs}"
            )
    lines = _header(linearization, known, unknown)
    lines = [" ".join(line.splitlines()) for line in lines]  # a name of an FMU may have several
    matrices = {
        "A": linearization.A,
        "Bu": linearization.B[:, known],
        "Bd": linearization.B[:, unknown],
        "C": linearization.C,
        "Du": linearization.D[:, known],
        "Dd": _direct(linearization.D[:, unknown], linearization.errors["D"] or 0.0),
    }
    for name, matrix in matrices.items():
        if matrix.any() or (matrix.size and not name.startswith("D")):
            rows = (matrix + 0.0).tolist()  # + 0.0: no -0.0 in the file
            lines.append(f"{name} = {rows!r}")
    return "\n".join(lines) + "\n"


def _header(
    linearization: Linearization, known: Sequence[int], unknown: Sequence[int]
) -> list[str]:
    """Return the name of the table, and comments: the operating point, what the signals are."""
    name = re.sub(r"[^A-Za-z0-9_-]", "_", linearization.name)
    names = [*linearization.states, *linearization.inputs]
    values = [*linearization.x.tolist(), *linearization.u.tolist()]
    point = ", ".join(f"{name} = {value!r}" for name, value in zip(names, values, strict=True))
    lines = [
        f"[models.{name}]",
        f"# {linearization.name} linearized at t = {linearization.t} s, {point}",
    ]
    c, d = linearization.constants
    if c.any() or d.any():
        lines.append(
            f"# for deviations from this point: it lacks c = {c.tolist()} of x' = ... + c "
            f"and d = {d.tolist()} of y = ... + d"
        )
    signals = {
        "x": linearization.states,
        "u": [linearization.inputs[i] for i in known],
        "delta": [linearization.inputs[i] for i in unknown],
        "y": linearization.outputs,
    }
    listed = [f"{signal}: {', '.join(names)}" for signal, names in signals.items() if names]
    return [*lines, f"# {'; '.join(listed)}"]
