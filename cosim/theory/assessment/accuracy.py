"""What a residual may be without noise: errors of the step, of quantization, of rounding.

**Step.** Between samples the disturbance is a straight line, and so is an input that is not held;
one that is held has no error. A chord of f is above f by
``h^2 f''/12`` in the mean, so the output of a plant whose signals are smooth differs from the
simulated one by the response to ``-h^2 f''/12``, which second differences of the samples give:
one simulation tells the error, to leading order.

**Quantization.** Outputs that stand on a lattice have errors up to half its spacing, of deviation
``spacing / sqrt(12)``, which need not be white. What quantization does to this very signal is found
by quantizing the fit, with noise of the deviation that is left.

**Rounding** of a simulated output.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.output_error import ROUNDING
from cosim.theory.forced_response import forced_outputs

# of the step, relative to a signal: above it the leading order says nothing
LARGEST_STEP_ERROR: Final = 0.01
STEPS_CHECKED: Final = 4_000
LATTICE: Final = 1e-6  # of its spacing: how exactly values stand on it
_DITHER_SEED: Final = 20260512


@dataclass(frozen=True, eq=False)
class Accuracy:
    """Errors of the outputs that are no noise.

    Parameters
    ----------
    step : Matrix, shape (N, n_y)
        Of the step, at every sample.
    spacing : Vector, shape (n_y,)
        Of the lattice of each output; 0: there is none.
    rounding : Vector, shape (n_y,)
        Of each simulated output.
    """

    step: Matrix
    spacing: Vector
    rounding: Vector

    @property
    def deviations(self) -> Vector:
        """Root mean square of all of them together, of each output, shape (n_y,)."""
        of_step = np.mean(self.step**2, axis=0)
        total: Vector = np.sqrt(of_step + self.spacing**2 / 12.0 + self.rounding**2)
        return total


def accuracy_of(plant: DisturbedPlant, data: DataSet, disturbance: Matrix) -> Accuracy:
    """Compute the errors of a fit that are no noise; the arguments are those of ``step_error``."""
    step = step_error(plant, data, disturbance)
    spacing = np.array([lattice_spacing(column) for column in data.y.T])
    return Accuracy(step, spacing, ROUNDING * np.nanmax(np.abs(data.y), axis=0))


def step_error(plant: DisturbedPlant, data: DataSet, disturbance: Matrix) -> Matrix:
    """Compute the error of straight lines between samples, shape (N, n_y).

    Parameters
    ----------
    plant : DisturbedPlant
    data : DataSet
    disturbance : Matrix, shape (N, components)
        ``alpha_i f_i`` as it was fitted.
    """
    everywhere = np.arange(len(data.t))
    of_u, at_samples = _line_error(data.t, data.u, np.flatnonzero(data.is_taken))
    of_u[:, data.is_held] = 0.0
    at_samples[:, data.is_held] = 0.0
    of_disturbance, _ = _line_error(data.t, disturbance, everywhere)
    at_states = of_u @ plant.B.T + of_disturbance @ plant.Bd.T
    response = forced_outputs(plant, data).respond(np.zeros_like(at_states), at_states)
    return response + at_samples @ plant.D.T


def check_step(
    alpha: Callable[[Vector], Matrix], names: Sequence[str], *, start: float, stop: float, h: float
) -> None:
    """Check that straight lines between communication points are the alphas.

    Parameters
    ----------
    alpha : callable
        The known factors at instants ``(N,)`` [s], shape ``(N, n)``.
    names : sequence of str
        A name for each, for the message.
    start, stop : float
        Of the run [s].
    h : float
        Communication step [s].

    Raises
    ------
    AssumptionError
        If a line is more than 1 % off halfway between two points; with the step that would do.
        If an alpha is not finite there.
    """
    steps = min(round((stop - start) / h), STEPS_CHECKED)
    points: Vector = start + h * np.arange(steps + 1, dtype=np.float64)
    between: Vector = points[:-1] + 0.5 * h
    ends = alpha(points)
    middles = alpha(between)
    _check_finite(ends, points, names)
    _check_finite(middles, between, names)
    distances = np.abs(middles - 0.5 * (ends[:-1] + ends[1:]))
    errors = distances.max(axis=0, initial=0.0)
    sizes = np.sqrt(np.mean(ends**2, axis=0))
    relative = errors / np.where(sizes > 0.0, sizes, 1.0)
    worst = int(relative.argmax())
    if relative[worst] > LARGEST_STEP_ERROR:
        enough = h * enough_shorter(float(relative[worst]))
        place = int(distances[:, worst].argmax())
        raise AssumptionError(
            f"the communication step {h:g} s is too long: linear interpolation misses "
            f"{relative[worst]:.2g} of alpha {names[worst]!r}, most at t = {between[place]:g} s; "
            f"expected at most {enough:.1g} s, or an alpha without such a place"
        )


def _check_finite(values: Matrix, t: Vector, names: Sequence[str]) -> None:
    wrong = np.argwhere(~np.isfinite(values))
    if wrong.size:
        row, column = wrong[0]
        raise AssumptionError(
            f"alpha {names[column]!r}: expected a finite number at every instant of the run, got "
            f"{values[row, column]:g} at t = {t[row]:g} s"
        )


def enough_shorter(relative: float) -> float:
    """Return by how much steps must be shorter for a tenth of the largest relative error.

    It falls with their square.
    """
    return float(np.sqrt(0.1 * LARGEST_STEP_ERROR / relative))


def lattice_spacing(y: Vector) -> float:
    """Return the spacing of the lattice that all values stand on; 0 where there is none.

    Values of full resolution are all different, or as good as that.
    """
    values = np.unique(y[np.isfinite(y)])
    if len(values) < 3 or len(values) > 0.5 * len(y):
        return 0.0
    gaps = np.diff(values)
    smallest = float(gaps.min())
    multiples = gaps / smallest
    if multiples.max() > 1e9:
        return 0.0
    off_lattice = np.abs(multiples - np.round(multiples))
    return smallest if float(off_lattice.max()) < LATTICE * float(multiples.max()) + 1e-3 else 0.0


def quantization_error(y: Matrix, residual: Matrix, spacing: Vector) -> Matrix:
    """Compute what quantization does to a fitted output, shape (N, n_y).

    Noise of half a level and more makes its error white noise too, so that nothing is left.

    Parameters
    ----------
    y : Matrix, shape (N, n_y)
        The quantized outputs; NaN: not measured.
    residual : Matrix, shape (N, n_y)
        Less the fit.
    spacing : Vector, shape (n_y,)
        0: not quantized.
    """
    errors = np.zeros_like(y)
    if not spacing.any():
        return errors
    noise = np.random.default_rng(_DITHER_SEED).standard_normal(y.shape)
    for o, gap in enumerate(spacing):
        measured = np.isfinite(y[:, o])
        variance = float(np.mean(residual[measured, o] ** 2)) - gap**2 / 12.0
        deviation = np.sqrt(max(variance, 0.0))
        if gap == 0.0 or deviation >= 0.5 * gap:
            continue
        fitted = y[:, o] - residual[:, o]
        exact = fitted - y[measured, o][0] + deviation * noise[:, o]
        errors[:, o] = np.nan_to_num(gap * np.round(exact / gap) - exact)
    return errors


def _line_error(t: Vector, values: Matrix, knots: NDArray[np.intp]) -> tuple[Matrix, Matrix]:
    """Compute by how much straight lines between some samples of smooth signals are wrong.

    Parameters
    ----------
    t : Vector, shape (N,)
    values : Matrix, shape (N, m)
        Between the knots on straight lines.
    knots : shape (K,)
        The samples that are exact.

    Returns
    -------
    tuple of two Matrix, each (N, m)
        What a signal has over the lines in the mean of the interval behind each sample, and at it.
    """
    if len(knots) < 3:
        return np.zeros_like(values), np.zeros_like(values)
    lengths = np.diff(t[knots])[:, np.newaxis]
    slopes = np.diff(values[knots], axis=0) / lengths
    distances = lengths[1:] + lengths[:-1]
    inner = 2.0 * np.diff(slopes, axis=0) / distances
    at_knots = np.vstack([inner[:1], inner, inner[-1:]])
    of_lines = 0.5 * (at_knots[1:] + at_knots[:-1])
    next_knot = np.searchsorted(knots, np.arange(len(t)), side="right")
    line = np.clip(next_knot - 1, 0, len(lengths) - 1)
    curvature = of_lines[line]
    H = lengths[line]
    steps = np.append(np.diff(t), 0.0)
    begin = (t - t[knots[line]])[:, np.newaxis]
    end = begin + steps[:, np.newaxis]
    # of (H - s) s f'' / 2, which a parabola has below its chord
    first = 0.5 * H * (end + begin)
    second = (end**2 + end * begin + begin**2) / 3.0
    in_the_mean = -0.5 * curvature * (first - second)
    at_samples = -0.5 * curvature * (H - begin) * begin
    return in_the_mean, at_samples
