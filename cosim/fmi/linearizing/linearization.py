"""What is known of an instance near its operating point: matrices, and what follows from them."""

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
EPSILON: Final = np.finfo(np.float64).eps
NAMES: Final = ("states", "inputs", "outputs", "notes")


def pole_text(pole: complex, digits: int = 6) -> str:
    """Return a pole; a real one without its imaginary part."""
    return f"{pole.real:.{digits}g}" if pole.imag == 0.0 else f"{pole:.{digits}g}"


def poles(A: Matrix) -> NDArray[np.complex128]:
    """Return the eigenvalues of A [1/s], shape (n_x,), sorted by real part."""
    return np.sort_complex(np.linalg.eigvals(A).astype(np.complex128))


def is_singular(matrix: NDArray[np.inexact[Any]], *, error: float) -> bool:
    """Return whether a square matrix, whose entries are known up to ``error``, may be singular."""
    sizes = np.linalg.svd(matrix, compute_uv=False)
    return bool(sizes.size) and bool(sizes[-1] <= max(SINGULAR * sizes[0], len(matrix) * error))


def static_gain(A: Matrix, B: Matrix, C: Matrix, D: Matrix, *, error: float) -> Matrix | None:
    """Return D - C A^-1 B, shape (n_y, n_u).

    None where A, whose entries are known up to ``error``, may be singular.
    """
    if is_singular(A, error=error):
        return None
    gain: Matrix = D - C @ np.linalg.solve(A, B)
    return gain


@dataclass(frozen=True, eq=False, kw_only=True)
class Linearization:
    """An instance near its operating point.

    Parameters
    ----------
    name : str
        Name of the model.
    states, inputs, outputs : tuple of str
        Names of the n_x, n_u and n_y elements.
    ports : mapping of input name to str
        Name of the port that the element belongs to.
    A, B, C, D : Matrix, shapes (n_x, n_x), (n_x, n_u), (n_y, n_x), (n_y, n_u)
    t : float
        Time of the operating point [s].
    x, u, y, dx : Vector, shapes (n_x,), (n_u,), (n_y,), (n_x,)
        States, inputs, outputs and derivatives there.
    made : mapping of state or input name to Method
        Where its column comes from.
    errors : mapping of matrix name to float or None
        Estimate of the largest error of an entry, that of the states at t included; None: all are
        the FMU's own derivatives, taken to be exact.
    notes : tuple of str
        What is to be known about the result.
    units : mapping of element name to str
        Where one is declared.
    bases : mapping of element name to BaseUnit
        What such a unit is in SI, where the FMU defines it.
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
    ports: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    bases: Mapping[str, BaseUnit] = field(default_factory=dict)

    @property
    def poles(self) -> NDArray[np.complex128]:
        """The eigenvalues of A [1/s], sorted by real part."""
        return poles(self.A)

    @property
    def static_gain(self) -> Matrix | None:
        """D - C A^-1 B, shape (n_y, n_u): the change of the outputs with constant inputs.

        None where A is singular.
        """
        error = self.errors["A"] or 0.0
        return static_gain(self.A, self.B, self.C, self.D, error=error)

    @property
    def constants(self) -> tuple[Vector, Vector]:
        """The c and d of ``x' = A x + B u + c``, ``y = C x + D u + d``; rounding is zero."""
        AB = np.hstack([self.A, self.B])
        CD = np.hstack([self.C, self.D])
        c = self._constant(self.dx, AB, self._largest_error("AB"))
        d = self._constant(self.y, CD, self._largest_error("CD"))
        return c, d

    def _largest_error(self, letters: str) -> float:
        return max(self.errors[letter] or 0.0 for letter in letters)

    def _constant(self, value: Vector, matrix: Matrix, entry_error: float) -> Vector:
        z = np.concatenate([self.x, self.u])
        sizes = np.abs(z)
        terms = np.abs(value) + np.abs(matrix) @ sizes
        rounding = 8.0 * EPSILON * terms
        error = entry_error * sizes.sum()
        constant = value - matrix @ z
        is_known = np.abs(constant) > rounding + error
        return np.where(is_known, constant, 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, from which :meth:`of` builds the same bits again."""
        plain = asdict(self)
        for name, value in plain.items():
            if isinstance(value, np.ndarray):
                plain[name] = value.tolist()
        return plain

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> Self:
        """Build it from the result of :meth:`to_dict`, also by way of JSON."""
        n_x = len(plain["states"])
        n_u = len(plain["inputs"])
        n_y = len(plain["outputs"])
        shapes: dict[str, tuple[int, ...]] = {
            "A": (n_x, n_x),
            "B": (n_x, n_u),
            "C": (n_y, n_x),
            "D": (n_y, n_u),
            "x": (n_x,),
            "u": (n_u,),
            "y": (n_y,),
            "dx": (n_x,),
        }
        # Earlier logs do not name the ports: there an input is named by its elements.
        known = {"ports": {}, **plain}
        values = {entry.name: known[entry.name] for entry in fields(cls)}
        for name in NAMES:
            values[name] = tuple(plain[name])
        for name, shape in shapes.items():
            array = np.array(plain[name], np.float64)
            values[name] = array.reshape(shape)  # which an empty list has lost
        values["bases"] = bases = {}
        for name, base in plain["bases"].items():
            exponents = tuple(base["exponents"])
            bases[name] = BaseUnit(**{**base, "exponents": exponents})
        return cls(**values)
