"""A linearized FMU as the design model of an observer, and as a table of a scenario."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cosim.arrays import Matrix
from cosim.core.linear import LinearModel
from cosim.core.signals import Signal
from cosim.errors import UsageError, nearest
from cosim.theory.descriptor import ReducedSystem
from cosim.units import Unit

if TYPE_CHECKING:
    from cosim.fmi.linearizing.linearization import Linearization, Method


def linearize_file(
    path: Path,
    *,
    at: float,
    start: Mapping[str, Any],
    inputs: Sequence[str] | None,
    outputs: Sequence[str] | None,
    differences: bool,
) -> Linearization:
    """Linearize an FMU, as :func:`cosim.linearize`."""
    from cosim.fmi.linearizing.linearize import linearize

    method: Method | None = "central differences" if differences else None
    return linearize(path, at=at, start=start, inputs=inputs, outputs=outputs, method=method)


class DesignModel(NamedTuple):
    """The model that an observer is designed on.

    Parameters
    ----------
    reduced : ReducedSystem
    constant : bool
        Whether the last input of ``reduced`` is the constant 1.
    units : mapping of signal name to Unit
        Those that are declared of the observer's signals u, y, x_a and delta.
    """

    reduced: ReducedSystem
    constant: bool = False
    units: Mapping[str, Unit] = MappingProxyType({})

    def declare(self, model: LinearModel) -> LinearModel:
        """Declare the units of the signals of an observer."""
        interface = model.interface
        declared = replace(
            interface,
            inputs=tuple(self._with_unit(signal) for signal in interface.inputs),
            outputs=tuple(self._with_unit(signal) for signal in interface.outputs),
        )
        return replace(model, interface=declared)

    def _with_unit(self, signal: Signal) -> Signal:
        unit = self.units.get(signal.name, Unit(None))
        return replace(signal, unit=unit.name, base=unit.base)


def design_model(linearization: Linearization, disturbances: Sequence[str]) -> DesignModel:
    """Return the design model of an observer of a linearized FMU.

    It is (9)-(10) without x_b: ``x' = A x + B_1 u + B_2 delta + c``,
    ``y = C x + C_4 u + C_5 delta + d``, where c and d are not zero at an operating point away from
    an equilibrium at zero. They act through one more input, the constant 1.

    Raises
    ------
    UsageError
        If a disturbance is none of the inputs, or is named twice.
    """
    known, unknown = split(linearization, disturbances)
    n = len(linearization.states)
    B_1 = linearization.B[:, known]
    C_4 = linearization.D[:, known]
    c, d = (column[:, np.newaxis] for column in linearization.constants)
    constant = bool(c.any() or d.any())
    if constant:
        B_1 = np.hstack([B_1, c])
        C_4 = np.hstack([C_4, d])
    reduced = ReducedSystem(
        A_a=linearization.A,
        B_1a=B_1,
        B_2a=linearization.B[:, unknown],
        C3=linearization.C,
        C4=C_4,
        C5=linearization.D[:, unknown],
        Kx=np.zeros((0, n)),
        Ku=np.zeros((0, len(known) + constant)),
        Kd=np.zeros((0, len(unknown))),
    )
    inputs = linearization.inputs
    units = {
        "u": _common_unit(linearization, [inputs[i] for i in known]),
        "delta": _common_unit(linearization, [inputs[i] for i in unknown]),
        "y": _common_unit(linearization, linearization.outputs),
        "x_a": _common_unit(linearization, linearization.states),
    }
    return DesignModel(reduced, constant, units)


def _common_unit(linearization: Linearization, names: Sequence[str]) -> Unit:
    """Return the unit that all elements of a signal have; else none is declared."""
    units = {Unit(linearization.units.get(name), linearization.bases.get(name)) for name in names}
    return units.pop() if len(units) == 1 else Unit(None)


def split(linearization: Linearization, disturbances: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return the columns of the known inputs and those of the disturbances.

    A disturbance may be named by port or by element.

    Raises
    ------
    UsageError
        If a disturbance is none of the inputs, or is named twice.
    """
    inputs = linearization.inputs
    unknown: list[int] = []
    for name in disturbances:
        columns = []
        for i, element in enumerate(inputs):
            if name in (element, element.rpartition("[")[0]):
                columns.append(i)
        if not columns:
            raise UsageError(
                f"disturbance {name!r} is no input of {linearization.name}; {nearest(name, inputs)}"
            )
        if set(columns) & set(unknown):
            raise UsageError(f"disturbance {name!r} is named twice; needed each once")
        unknown += columns
    known = [i for i in range(len(inputs)) if i not in unknown]
    return known, unknown


def model_table(linearization: Linearization, disturbances: Sequence[str]) -> str:
    """Write a linearization as a table of [models].

    Direct feedthrough to y goes by way of algebraic states.

    Raises
    ------
    UsageError
        If a disturbance is none of the inputs, or there are no states, outputs, known inputs or
        disturbances.
    """
    known, unknown = split(linearization, disturbances)
    _check_model_table(linearization, known, unknown)
    # Where D has a row that is not zero: y = C x + x_b and 0 = -x_b + D (u, delta).
    through = np.flatnonzero(linearization.D.any(axis=1))
    n = len(linearization.states)
    n_b = len(through)
    A = np.block([[linearization.A, np.zeros((n, n_b))], [np.zeros((n_b, n)), -np.eye(n_b)]])
    B = np.vstack([linearization.B, linearization.D[through]])
    C = np.hstack([linearization.C, np.eye(len(linearization.outputs))[:, through]])
    name = linearization.name
    identifier = re.sub(r"[^A-Za-z0-9_-]", "_", name)
    states = ", ".join(linearization.states)
    outputs = ", ".join(linearization.outputs)
    lines = [
        f"[models.{identifier}]",
        f"# {name} linearized at t = {linearization.t} s, {_operating_point(linearization)}",
    ]
    c, d = (vector.tolist() for vector in linearization.constants)
    if any((*c, *d)):
        lines.append(
            f"# for deviations from this point: it lacks c = {c} of x' = ... + c "
            f"and d = {d} of y = ... + d"
        )
    lines += [
        f"# x: {states}; u: {_input_names(linearization, known)}; "
        f"delta: {_input_names(linearization, unknown)}; y: {outputs}",
        f"n_a = {n}",
        f"A = {_rows(A)}",
        f"Bu = {_rows(B[:, known])}",
        f"Bd = {_rows(B[:, unknown])}",
        f"C = {_rows(C)}",
    ]
    return "\n".join(lines) + "\n"


def _check_model_table(
    linearization: Linearization, known: Sequence[int], unknown: Sequence[int]
) -> None:
    parts: dict[str, Sequence[Any]] = {
        "state": linearization.states,
        "output": linearization.outputs,
        "known input": known,
        "disturbance": unknown,
    }
    inputs = ", ".join(linearization.inputs) or "none"
    for part, members in parts.items():
        if not members:
            raise UsageError(
                f"{linearization.name}: a table of [models] needs a {part}; inputs: {inputs}"
            )


def _operating_point(linearization: Linearization) -> str:
    states = zip(linearization.states, linearization.x, strict=True)
    inputs = zip(linearization.inputs, linearization.u, strict=True)
    return ", ".join(f"{name} = {float(value)!r}" for name, value in (*states, *inputs))


def _input_names(linearization: Linearization, columns: Sequence[int]) -> str:
    return ", ".join(linearization.inputs[i] for i in columns)


def _rows(matrix: Matrix) -> str:
    rows = (matrix + 0.0).tolist()  # + 0.0: no -0.0 in the file
    texts = [f"[{', '.join(map(repr, row))}]" for row in rows]
    return f"[{', '.join(texts)}]"
