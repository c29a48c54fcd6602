"""What is known of a unit near its operating point: matrices, and what follows from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Final, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.units import BaseUnit

Method: TypeAlias = Literal["directional derivatives", "central differences"]
METHODS: Final[tuple[Method, ...]] = ("directional derivatives", "central differences")

SINGULAR: Final = 1e-12  # reciprocal condition of A below which there is no static gain


def poles(A: Matrix) -> NDArray[np.complex128]:
    """Give the eigenvalues of A [1/s], shape (n_x,), sorted by real part."""
    return np.sort_complex(np.linalg.eigvals(A).astype(np.complex128))


def static_gain(A: Matrix, B: Matrix, C: Matrix, D: Matrix, *, error: float) -> Matrix | None:
    """Give D - C A^-1 B, shape (n_y, n_u); None where A, whose entries are known up to ``error``, may be singular."""
    values = np.linalg.svd(A, compute_uv=False)
    if values.size and values[-1] <= max(SINGULAR * values[0], len(A) * error):
        return None
    gain: Matrix = D - C @ np.linalg.solve(A, B)
    return gain


@dataclass(frozen=True, eq=False, kw_only=True)
class Linearization:
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
        return poles(self.A)

    @property
    def static_gain(self) -> Matrix | None:
        """D - C A^-1 B, shape (n_y, n_u): what constant inputs move the outputs to; None where A is singular."""
        return static_gain(self.A, self.B, self.C, self.D, error=self.errors["A"] or 0.0)

    @property
    def constants(self) -> tuple[Vector, Vector]:
        """What ``x' = A x + B u + c``, ``y = C x + D u + d`` need beside the matrices, c and d; zero where it is rounding."""
        z = np.concatenate([self.x, self.u])
        parts = (
            (self.dx, "A", "B", np.hstack([self.A, self.B])),
            (self.y, "C", "D", np.hstack([self.C, self.D])),
        )
        return tuple(
            self._constant(value, first, second, matrix, z)
            for value, first, second, matrix in parts
        )  # type: ignore[return-value]

    def _constant(
        self, value: Vector, first: str, second: str, matrix: Matrix, z: Vector
    ) -> Vector:
        terms = np.abs(value) + np.abs(matrix) @ np.abs(z)
        error = max(self.errors[first] or 0.0, self.errors[second] or 0.0) * np.abs(z).sum()
        rest = value - matrix @ z
        return np.where(np.abs(rest) > 8.0 * np.finfo(np.float64).eps * terms + error, rest, 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Give plain values, from which :meth:`of` builds the same bits again."""
        return {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in asdict(self).items()
        }

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> Self:
        """Build it from what :meth:`to_dict` gave, also by way of JSON."""
        n_x, n_u, n_y = (len(plain[name]) for name in ("states", "inputs", "outputs"))
        shapes = {
            "A": (n_x, n_x),
            "B": (n_x, n_u),
            "C": (n_y, n_x),
            "D": (n_y, n_u),
            **dict.fromkeys(("x", "u", "y", "dx"), -1),
        }
        found = {entry.name: plain[entry.name] for entry in fields(cls)}
        found["bases"] = {
            name: BaseUnit(**base | {"exponents": tuple(base["exponents"])})
            for name, base in plain["bases"].items()
        }
        found |= {
            name: np.array(plain[name], np.float64).reshape(shape) for name, shape in shapes.items()
        }
        return cls(
            **found
            | {name: tuple(plain[name]) for name in ("states", "inputs", "outputs", "notes")}
        )
