"""The family of any generator: `beta' = (G0 + sum theta_j G_j) beta, f = c' beta`.

Only the eigenvalues of G are seen in f, not its coordinates: parameters that do not move them, or
move them as others do, are not identifiable, and states that c does not observe are not there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, TypeAlias, final

import numpy as np

from cosim.arrays import NAN, Matrix, Vector
from cosim.errors import AssumptionError

Rows: TypeAlias = tuple[tuple[float, ...], ...]

MOST_STATES: Final = 16
# singular value, relative to the largest one, below which states or parameters count as dependent;
# multiple eigenvalues are known to the root of the rounding
DEPENDENT: Final = 1e-6
GENERIC: Final = (0.5461, -0.8317, 0.2903)  # theta at which nothing cancels by chance
TRIALS: Final = 5  # starts on an axis, where theta is sought from roots
LARGEST_RATIO: Final = 1e6  # of a searched parameter to the one that moves an eigenvalue by itself


@final
@dataclass(frozen=True)
class LinearFamily:
    """`f = c' expm((G0 + sum theta_j G_j) t) beta(0)`.

    Parameters
    ----------
    G0 : rows of shape (v, v)
        [1/s]
    slopes : tuple of rows of shape (v, v)
        G_j, one for each parameter.
    row : tuple of v numbers
        c.
    parameters : tuple of str
        Their names.
    ranges : tuple of (lower, upper), optional
        Where a start of each parameter is searched; by default where the eigenvalues of G are
        those of exponentials and sines that would be searched.

    Raises
    ------
    AssumptionError
        If shapes do not fit, c does not observe every state, or a parameter is not identifiable.
    """

    G0: Rows
    slopes: tuple[Rows, ...]
    row: tuple[float, ...]
    parameters: tuple[str, ...]
    ranges: tuple[tuple[float, float], ...] | None = None
    name: ClassVar[str] = "linear"

    def __post_init__(self) -> None:
        """Check sizes, names and ranges, then observability and identifiability."""
        self._check_sizes()
        self._check_names()
        self._check_ranges()
        self._check_observable()
        self._check_identifiable()

    @property
    def v(self) -> int:
        """The number of basis functions (5)."""
        return len(self.row)

    @property
    def c(self) -> Vector:
        """Output row, shape ``(v,)``."""
        return np.array(self.row)

    @property
    def even(self) -> tuple[bool, ...]:
        """That negatives make other signals, as far as is known."""
        return (False,) * len(self.parameters)

    @property
    def graded(self) -> tuple[bool, ...]:
        """That a start is searched in equal steps."""
        return (False,) * len(self.parameters)

    @property
    def constants(self) -> tuple[str, ...]:
        """The names of the states at t = 0."""
        return tuple(f"beta_{k}" for k in range(1, self.v + 1))

    @property
    def formula(self) -> str:
        """The response of the generator, by the names of its parameters and states in braces."""
        parameters = ", ".join(f"{{{name}}}" for name in self.parameters)
        states = ", ".join(f"{{{name}}}" for name in self.constants)
        generator = f"G({parameters})" if parameters else "G"
        return f"c' expm({generator} t) ({states})"

    def G(self, theta: Vector) -> Matrix:
        """Compute the system matrix [1/s], shape ``(v, v)``."""
        matrix = np.array(self.G0)
        for value, slope in zip(theta, self.slopes, strict=True):
            matrix = matrix + value * np.array(slope)
        return matrix

    def constants_of(self, beta: Vector) -> tuple[Vector, Matrix]:
        """Return the states."""
        return beta.copy(), np.eye(self.v)

    def search(self, span: float, shortest: float) -> tuple[tuple[float, float], ...]:
        """Return the ranges as given, or those in which the eigenvalues of G can be searched."""
        if self.ranges is not None:
            return self.ranges
        limits = _Limits(span, shortest, self.eigenvalues(np.zeros(len(self.parameters))))
        return tuple(self._range(j, limits) for j in range(len(self.parameters)))

    def eigenvalues(self, theta: Vector) -> np.ndarray[tuple[int], np.dtype[np.complex128]]:
        """Compute the eigenvalues of G [1/s], shape ``(v,)``."""
        values: np.ndarray[tuple[int], np.dtype[np.complex128]] = np.linalg.eigvals(
            self.G(theta)
        ).astype(np.complex128)
        return values

    def theta_from_roots(self, z: Sequence[complex], spacing: float) -> Vector:
        """Compute theta from `z = exp(lambda spacing)`; NaN where no theta is found for it.

        The coefficients of the characteristic polynomial are compared, from starts on a grid.
        """
        none = np.full(len(self.parameters), NAN)
        roots = np.asarray(z, np.complex128)
        if not self.parameters or not (np.isfinite(roots).all() and roots.all()):
            return none
        from scipy.optimize import least_squares  # takes long to import, and is rarely needed

        wanted = np.log(roots) / spacing
        scale = max(float(np.abs(wanted).max()), 1.0 / spacing)
        target = np.real(np.poly(wanted / scale))

        def difference(theta: Vector) -> Vector:
            return np.asarray(np.real(np.poly(self.eigenvalues(theta) / scale)) - target)

        lower, upper = np.array(self.search(20.0 * spacing, spacing)).T
        best = none
        smallest = DEPENDENT
        for fraction in np.linspace(0.0, 1.0, TRIALS + 2)[1:-1]:
            solution = least_squares(difference, lower + fraction * (upper - lower), xtol=1e-15)
            size = float(np.abs(solution.fun).max())
            if size < smallest:
                smallest = size
                best = np.asarray(solution.x)
        return best

    # --- checks ---

    def _check_sizes(self) -> None:
        v = self.v
        if not 1 <= v <= MOST_STATES:
            raise AssumptionError(
                f"family 'linear': c: expected 1 to {MOST_STATES} numbers, one for each state, got "
                f"{v}"
            )
        named = [("G0", self.G0), *((f"G[{j}]", rows) for j, rows in enumerate(self.slopes))]
        for name, rows in named:
            lengths = {len(row) for row in rows}
            if len(rows) != v or lengths != {v}:
                found = " and ".join(map(str, sorted(lengths)))
                raise AssumptionError(
                    f"family 'linear': {name}: expected {v} rows of {v} numbers, as c has {v}, got "
                    f"{len(rows)} rows of {found or 'no'} numbers"
                )
        if not np.isfinite([*np.ravel(self.G0), *np.ravel(self.slopes), *self.row]).all():
            raise AssumptionError("family 'linear': expected finite numbers, got NaN or infinity")

    def _check_names(self) -> None:
        names = self.parameters
        if len(names) != len(self.slopes):
            raise AssumptionError(
                f"family 'linear': parameters: expected {len(self.slopes)} names, one for each "
                f"matrix of G, got {len(names)}"
            )
        for name in names:
            if not name.isidentifier() or name in self.constants:
                raise AssumptionError(
                    "family 'linear': parameters: expected a word of letters, digits and '_' "
                    f"other than {', '.join(self.constants)}, got {name!r}"
                )
        if len(set(names)) < len(names):
            raise AssumptionError(
                f"family 'linear': parameters: expected different names, got {', '.join(names)}"
            )

    def _check_ranges(self) -> None:
        if self.ranges is None:
            return
        if len(self.ranges) != len(self.slopes):
            raise AssumptionError(
                f"family 'linear': search: expected {len(self.slopes)} ranges, [lower, upper] for "
                f"each matrix of G, got {len(self.ranges)}"
            )
        for name, (lower, upper) in zip(self.parameters, self.ranges, strict=True):
            if not -math.inf < lower < upper < math.inf:
                raise AssumptionError(
                    f"family 'linear': search of {name}: expected [lower, upper], finite and lower "
                    f"first, got [{lower:g}, {upper:g}]"
                )

    def _check_observable(self) -> None:
        """Check at a generic theta, by the rank of `[G - lambda I; c]` at every eigenvalue."""
        G = self.G(self._generic())
        size = max(float(np.abs(G).max()), 1.0)
        length = float(np.linalg.norm(self.c)) or 1.0
        for eigenvalue in np.linalg.eigvals(G):
            pencil = np.vstack([(G - eigenvalue * np.eye(self.v)) / size, self.c / length])
            if np.linalg.svd(pencil, compute_uv=False)[-1] <= DEPENDENT:
                raise AssumptionError(
                    f"family 'linear': c = {list(self.row)} does not observe the state of G that "
                    f"goes with the eigenvalue {_text(eigenvalue)}, so it is not in f; leave that "
                    "state out, or choose another c"
                )

    def _check_identifiable(self) -> None:
        """Check that the characteristic polynomial depends on every parameter in a way of its own.

        For an observable pair (c, G) it is all that the signals f say of G.
        """
        slopes = self._slopes_of_polynomial()
        lengths = np.linalg.norm(slopes, axis=0)
        for name, length in zip(self.parameters, lengths, strict=True):
            if length <= DEPENDENT:
                raise AssumptionError(
                    f"family 'linear': {name} does not move the eigenvalues of G, so no signal of "
                    "the family depends on it; fix it in G0"
                )
        if not self.parameters:
            return
        values = np.linalg.svd(slopes / lengths, compute_uv=False)
        if len(values) < len(lengths) or values[-1] <= DEPENDENT:
            listed = ", ".join(self.parameters)
            raise AssumptionError(
                f"family 'linear': the {len(lengths)} parameters {listed} move the {self.v} "
                "eigenvalues of G together: other values of them make the same signals; fix some "
                "in G0"
            )

    def _slopes_of_polynomial(self) -> Matrix:
        """Return derivatives of the coefficients by theta, scaled, shape ``(v, parameters)``."""
        theta = self._generic()
        sizes = [max(float(np.abs(slope).max()), 1e-300) for slope in map(np.array, self.slopes)]
        scale = max(float(np.abs(self.G(theta)).max()), 1e-300)
        columns = []
        for j, size in enumerate(sizes):
            step = np.zeros(len(sizes))
            step[j] = 1e-4 * scale / size
            above = np.poly(self.G(theta + step) / scale)
            below = np.poly(self.G(theta - step) / scale)
            columns.append(np.real(above - below)[1:] / 2e-4)
        return np.array(columns).T.reshape(self.v, len(sizes))

    def _generic(self) -> Vector:
        """Return a theta at which no two things agree by chance, shape ``(parameters,)``."""
        G0 = float(np.abs(self.G0).max()) or 1.0
        theta = []
        for j, slope in enumerate(self.slopes):
            size = float(np.abs(slope).max()) or 1.0
            theta.append(GENERIC[j % 3] * (1.0 + 0.37 * j) * G0 / size)
        return np.array(theta)

    def _range(self, j: int, limits: _Limits) -> tuple[float, float]:
        """Return how far one parameter alone moves no eigenvalue out of the limits."""
        size = float(np.abs(self.slopes[j]).max())
        ratios = np.geomspace(1.0 / LARGEST_RATIO, LARGEST_RATIO, 241)
        ends = []
        for side in (-1.0, 1.0):
            reached = 0.0
            for ratio in ratios:
                theta = np.zeros(len(self.parameters))
                theta[j] = side * ratio * limits.fastest / size
                if not limits.hold(self.eigenvalues(theta)):
                    break
                reached = float(theta[j])
            ends.append(reached)
        lower, upper = ends
        if lower == upper:
            return -limits.fastest / size, limits.fastest / size
        return lower, upper


class _Limits:
    """Within which the eigenvalues of exponentials and sines are searched; those of G0 are, too."""

    def __init__(
        self, span: float, shortest: float, known: np.ndarray[tuple[int], np.dtype[np.complex128]]
    ) -> None:
        least_known = float(known.real.min())
        largest_known = float(known.real.max())
        fastest_known = float(np.abs(known.imag).max())
        self.fastest = math.pi / shortest
        self._least = min(-3.0 / shortest, least_known)
        self._largest = max(math.log(10.0) / span, largest_known)
        self._fastest = max(self.fastest, fastest_known)

    def hold(self, values: np.ndarray[tuple[int], np.dtype[np.complex128]]) -> bool:
        """Return whether all eigenvalues are within, up to rounding."""
        slack = 1e-6 * self.fastest
        within = (
            values.real >= self._least - slack,
            values.real <= self._largest + slack,
            np.abs(values.imag) <= self._fastest + slack,
        )
        return all(bool(is_within.all()) for is_within in within)


def _text(eigenvalue: complex) -> str:
    if abs(eigenvalue.imag) <= DEPENDENT * abs(eigenvalue):
        return f"{eigenvalue.real:g}"
    return f"{eigenvalue.real:g} {eigenvalue.imag:+g}j"
