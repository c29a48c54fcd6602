"""A linearized FMU as what an observer believes, and as a table of a scenario."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from cosim.arrays import Matrix
from cosim.core.linear import LinearModel
from cosim.errors import UsageError, nearest
from cosim.theory.descriptor import ReducedSystem
from cosim.units import BaseUnit

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


Unit: TypeAlias = tuple[str | None, BaseUnit | None]  # its name, and what it is in SI


class DesignModel(NamedTuple):
    """What an observer believes.

    ``constant``: the last input of ``reduced`` is the constant 1. ``units``: those that are declared of the observer's signals
    u, y, x_a and delta.
    """

    reduced: ReducedSystem
    constant: bool = False
    units: Mapping[str, Unit] = MappingProxyType({})

    def declare(self, model: LinearModel) -> LinearModel:
        """Declare the units of the signals of an observer."""
        face = model.interface
        inputs, outputs = (
            tuple(
                replace(s, unit=unit, base=base)
                for s in signals
                for unit, base in [self.units.get(s.name, (None, None))]
            )
            for signals in (face.inputs, face.outputs)
        )
        return replace(model, interface=replace(face, inputs=inputs, outputs=outputs))


def design_model(found: Linearization, disturbances: Sequence[str]) -> DesignModel:
    """Write a linearization as ``x' = A x + B_1 u + B_2 delta + c``, ``y = C x + C_4 u + C_5 delta + d``: (9)-(10) without x_b.

    c and d are what an operating point away from an equilibrium at zero leaves: they act through one more input, the constant 1.

    Raises
    ------
    UsageError
        If a disturbance is none of the inputs, or is named twice.
    """
    known, unknown = split(found, disturbances)
    c, d = (column[:, np.newaxis] for column in found.constants)
    constant = bool(c.any() or d.any())
    B_1, C_4 = found.B[:, known], found.D[:, known]
    n, m = len(found.states), len(known) + constant
    reduced = ReducedSystem(
        A_a=found.A,
        B_1a=np.hstack([B_1, c]) if constant else B_1,
        B_2a=found.B[:, unknown],
        C3=found.C,
        C4=np.hstack([C_4, d]) if constant else C_4,
        C5=found.D[:, unknown],
        Kx=np.zeros((0, n)),
        Ku=np.zeros((0, m)),
        Kd=np.zeros((0, len(unknown))),
    )
    ports = {
        "u": [found.inputs[i] for i in known],
        "delta": [found.inputs[i] for i in unknown],
        "y": found.outputs,
        "x_a": found.states,
    }
    return DesignModel(
        reduced, constant, {port: _unit(found, names) for port, names in ports.items()}
    )


def _unit(found: Linearization, names: Sequence[str]) -> Unit:
    """Give the unit that all elements of a signal have; else none is declared."""
    units = {(found.units.get(name), found.bases.get(name)) for name in names}
    return units.pop() if len(units) == 1 else (None, None)


def split(found: Linearization, disturbances: Sequence[str]) -> tuple[list[int], list[int]]:
    """Give the columns of the known inputs and those of the disturbances, which may be named by port or by element.

    Raises
    ------
    UsageError
        If a disturbance is none of the inputs, or is named twice.
    """
    unknown: list[int] = []
    for name in disturbances:
        mine = [
            i
            for i, element in enumerate(found.inputs)
            if name in (element, element.rpartition("[")[0])
        ]
        if not mine:
            raise UsageError(
                f"disturbance {name!r} is no input of {found.name}; {nearest(name, found.inputs)}"
            )
        if set(mine) & set(unknown):
            raise UsageError(f"disturbance {name!r} is named twice; needed each once")
        unknown += mine
    return [i for i in range(len(found.inputs)) if i not in unknown], unknown


def model_table(found: Linearization, disturbances: Sequence[str]) -> str:
    """Write a linearization as a table of [models]; what feeds through to y goes by way of algebraic states.

    Raises
    ------
    UsageError
        If a disturbance is none of the inputs, or no states, outputs, known inputs or disturbances are there.
    """
    known, unknown = split(found, disturbances)
    for what, there in (
        ("state", found.states),
        ("output", found.outputs),
        ("known input", known),
        ("disturbance", unknown),
    ):
        if not there:
            raise UsageError(
                f"{found.name}: a table of [models] needs a {what}; inputs: {', '.join(found.inputs) or 'none'}"
            )
    through = np.flatnonzero(found.D.any(axis=1))  # y = C x + x_b there, 0 = -x_b + D (u, delta)
    n, n_b = len(found.states), len(through)
    A = np.block([[found.A, np.zeros((n, n_b))], [np.zeros((n_b, n)), -np.eye(n_b)]])
    B = np.vstack([found.B, found.D[through]])
    C = np.hstack([found.C, np.eye(len(found.outputs))[:, through]])
    lines = [
        f"[models.{re.sub(r'[^A-Za-z0-9_-]', '_', found.name)}]",
        f"# {found.name} linearized at t = {found.t} s, {_at(found)}",
        f"# x: {', '.join(found.states)}; u: {_names(found, known)}; "
        f"delta: {_names(found, unknown)}; y: {', '.join(found.outputs)}",
        f"n_a = {n}",
        *(
            f"{name} = {_rows(matrix)}"
            for name, matrix in (("A", A), ("Bu", B[:, known]), ("Bd", B[:, unknown]), ("C", C))
        ),
    ]
    c, d = (vector.tolist() for vector in found.constants)
    if any((*c, *d)):
        lines.insert(
            2,
            f"# for deviations from this point: it lacks c = {c} of x' = ... + c and d = {d} of y = ... + d",
        )
    return "\n".join(lines) + "\n"


def _at(found: Linearization) -> str:
    pairs = (*zip(found.states, found.x, strict=True), *zip(found.inputs, found.u, strict=True))
    return ", ".join(f"{name} = {value!r}" for name, value in ((n, float(v)) for n, v in pairs))


def _names(found: Linearization, columns: Sequence[int]) -> str:
    return ", ".join(found.inputs[i] for i in columns)


def _rows(matrix: Matrix) -> str:
    return (
        "["
        + ", ".join("[" + ", ".join(map(repr, row)) + "]" for row in (matrix + 0.0).tolist())
        + "]"
    )
