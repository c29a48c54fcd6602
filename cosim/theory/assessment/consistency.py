"""Whether a residual is what noise leaves: whiteness, and no trace of what the model lacks.

The variance of the residual tests nothing where the deviation of the noise comes from the residual.
What a wrong model leaves is *structure*, so the residual is tested

* along the **directions** of a wrong model (``model_errors``), made orthogonal to
  what was fitted: for white noise the square along each is a chi-square of one degree of freedom,
  the sum along K of them, orthogonal among themselves, of K (the score test; C. Rao, 1948);
* for **whiteness**: the autocorrelations of each output's first lags (G. Ljung and G. Box, 1978).

Where the deviation of the noise is stated, the variance is tested too: it may differ from what is
stated by what errors that are no noise add, and by half as much again.

Errors that are no noise (``accuracy``) are allowed for, each in every direction and
at every lag by its own amount. Noise that is colored but has no structure is whitened by an
autoregressive model (``noise_color``). How well that is known counts along the directions:
instead of a chi-square their tests have the distribution of a ratio of two (R. Fisher and G.
Snedecor).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.theory.assessment.accuracy import LARGEST_STEP_ERROR, Accuracy
from cosim.theory.assessment.fitted_model import FittedModel
from cosim.theory.assessment.linearized_fit import ErrorBias, error_bias, whitened_rows
from cosim.theory.assessment.model_errors import Directions, ModelError, model_errors
from cosim.theory.estimators.output_error import OutputErrorFit
from cosim.theory.quantiles import chi_square_above, ratio_above

FALSE_ALARM: Final = 3e-4  # probability, for white noise, of each of the three tests
WHITENESS: Final = "whiteness"
LARGEST_TRACE: Final = "largest trace of a model error"
ALL_TRACES: Final = "traces of model errors"
LAGS: Final = 24
# Errors of step and quantization are computed, not bounded: they are allowed half as much again.
MARGIN: Final = 1.5
# of a residual over errors that are no noise: up to here it is nothing else
NOTHING_ELSE: Final = 1.1
# samples of which directions are computed; of longer records every few, which costs power alone
MOST_SAMPLES: Final = 50_000
# of a direction: what of it may be left beside the fit, so that rounding does not count
LEAST_REMAINDER: Final = 1e-6


@dataclass(frozen=True)
class ResidualTest:
    """A test of the residual.

    Parameters
    ----------
    name : str
    statistic, threshold : float
        For noise alone the statistic is a chi-square, of a size the ratio of two deviations; the
        threshold is what it rarely exceeds.
    degrees : int
    largest : str
        Where the statistic is largest.
    """

    name: str
    statistic: float
    threshold: float
    degrees: int
    largest: str

    @property
    def passed(self) -> bool:
        """Whether the statistic is what noise makes it."""
        return self.statistic <= self.threshold

    @property
    def failure(self) -> str:
        """What the test says where it did not pass."""
        where = f" ({self.largest})" if self.largest else ""
        return f"{self.name}: {self.statistic:.3g}, noise makes at most {self.threshold:.3g}{where}"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {**asdict(self), "passed": self.passed}


@dataclass(frozen=True, eq=False, kw_only=True)
class Consistency:
    """What the residual says of the model.

    Parameters
    ----------
    tests_by_data : tuple of tuples of ResidualTest
        Of each data set. Where the residual is no larger than rounding there are only those of its
        size, if the noise is stated.
    accuracy : tuple of Accuracy
        Of each data set.
    is_exact : bool
        The residual of every output is no larger than step, quantization and rounding allow, and a
        tenth more.
    step_error : Vector, shape (n_y,)
        What straight lines between samples cost each output, over its deviation; of the data set
        where that is most.
    bias : Vector, shape (P,)
        What step and quantization may have moved theta by.
    amplitude_bias : Matrix, shape (data sets, order)
        What they may have moved the amplitudes of each data set by.
    presence_bias : Vector, shape (components,)
        What they may have moved the root of ``OutputErrorFit.presence`` by.
    tested : tuple of TestedFit
        Each data set with what it was tested for.
    remark : str
        What else than a wrong model may be the cause where a test fails.
    """

    tests_by_data: tuple[tuple[ResidualTest, ...], ...]
    accuracy: tuple[Accuracy, ...]
    is_exact: bool
    step_error: Vector
    bias: Vector
    amplitude_bias: Matrix
    presence_bias: Vector
    tested: tuple[TestedFit, ...]
    remark: str = ""

    @property
    def tests(self) -> tuple[ResidualTest, ...]:
        """The tests of all data sets."""
        return sum(self.tests_by_data, ())

    @property
    def step_too_long(self) -> bool:
        """Whether the error of the step is so large that it is not known."""
        return bool((self.step_error > LARGEST_STEP_ERROR).any())

    @property
    def passed(self) -> bool:
        """Whether the residual is what noise leaves."""
        return not self.step_too_long and all(test.passed for test in self.tests)

    @property
    def failed(self) -> tuple[str, ...]:
        """The names of the tests that did not pass."""
        return tuple(test.name for test in self.tests if not test.passed)

    @property
    def contradiction(self) -> str:
        """What noise does not explain, as a sentence."""
        found = []
        for number, tests in enumerate(self.tests_by_data, start=1):
            owner = f"data set {number}, " if len(self.tests_by_data) > 1 else ""
            found += [f"{owner}{test.failure}" for test in tests if not test.passed]
        remark = f"; {self.remark}" if self.remark else ""
        return f"noise does not explain the residual: {'; '.join(found)}{remark}"

    @property
    def is_structured(self) -> bool:
        """Whether the residual has structure, as a wrong model or colored noise leaves."""
        return not {WHITENESS, LARGEST_TRACE, ALL_TRACES}.isdisjoint(self.failed)


def examine(fitted: FittedModel) -> Consistency:
    """Test the residual of a fit."""
    fit = fitted.fit
    stated = fitted.problem.stated
    order = fitted.problem.generators.order
    tested = [TestedFit(fitted, index) for index in range(len(fitted.problem.data))]
    rounding = max(one.rounding for one in tested)
    tests = []
    for one in tested:
        of_data: list[ResidualTest] = []
        if fit.deviation > NOTHING_ELSE * rounding:
            of_data += one.tests(fit.deviation)
        if stated is not None:
            of_data += one.size_tests(stated)
        tests.append(tuple(of_data))
    bias = error_bias(fitted.linearized, fit.estimated)
    of_linear = np.abs(bias.linear).sum(axis=2)
    return Consistency(
        tests_by_data=tuple(tests),
        accuracy=fitted.accuracies,
        is_exact=_is_exact(fit, tested),
        step_error=np.max([one.step_error for one in tested], axis=0),
        bias=np.abs(bias.theta).sum(axis=1),
        amplitude_bias=of_linear[:, :order],
        presence_bias=_presence_bias(fitted, bias),
        tested=tuple(tested),
    )


@dataclass(frozen=True, eq=False)
class ErrorTraces:
    """What errors of a model that are of size one leave in a fit, and beside it.

    Parameters
    ----------
    errors : tuple of ModelError
    within : Matrix, shape (unknowns, K)
        What the fit takes of each, in ``TestedFit.basis``.
    beside : Vector, shape (K,)
        How large the rest is.
    seen : Matrix, shape (directions, K)
        What of it is along each direction that is tested.
    """

    errors: tuple[ModelError, ...]
    within: Matrix
    beside: Vector
    seen: Matrix

    @property
    def lengths(self) -> Vector:
        """How large each is in all, shape (K,)."""
        lengths: Vector = np.hypot(np.linalg.norm(self.within, axis=0), self.beside)
        return lengths

    def __add__(self, other: ErrorTraces) -> ErrorTraces:
        """Return both."""
        return ErrorTraces(
            self.errors + other.errors,
            np.hstack([self.within, other.within]),
            np.concatenate([self.beside, other.beside]),
            np.hstack([self.seen, other.seen]),
        )


class TestedFit:
    """The fit of one data set near its minimum, and the directions of a wrong model beside it.

    Directions are computed of every so many samples.

    Parameters
    ----------
    fitted : FittedModel
    index : int
        Of the data set.
    """

    def __init__(self, fitted: FittedModel, index: int) -> None:
        data = fitted.problem.data[index]
        plant = fitted.problem.plant
        noise = fitted.noise
        response = fitted.responses[index]
        accuracy = fitted.accuracies[index]
        self.accuracy = accuracy
        self.fit = fitted.linearized[index]
        slopes = self.fit.slopes[:, fitted.fit.estimated]
        self._unknowns = np.hstack([slopes, self.fit.linear])
        self._noise = noise
        weights = np.abs(noise.whitening)
        self.allowed = weights @ accuracy.deviations
        self.rounding = float((weights @ accuracy.rounding).max())
        step_error = np.sqrt(np.mean(accuracy.step**2, axis=0))
        of_model = np.nanstd(data.y - response.residual, axis=0)
        scale = np.maximum(np.nanstd(data.y, axis=0), np.maximum(of_model, accuracy.rounding))
        scale[scale == 0.0] = np.inf  # of an output that is 0 at every sample
        self.step_error = step_error / scale
        self._plain = response.residual
        longest = len(data.t) if noise.order else MOST_SAMPLES
        every = max(1, len(data.t) // longest)
        self._rows = data.kept(every)
        self.data = data.thinned(every)
        self.basis = _orthonormal(self.thinned(self._unknowns))
        directions = model_errors(plant, self.data, response.at(self._rows))
        columns = whitened_rows(directions.columns, self.data.numbers, noise)
        lengths = np.linalg.norm(columns, axis=0)
        scaled = columns / np.where(lengths > 0.0, lengths, 1.0)
        within = self.basis.T @ scaled
        free = scaled - self.basis @ within
        remainders = np.linalg.norm(free, axis=0)
        kept = remainders > LEAST_REMAINDER
        self._errors = tuple(np.array(directions.errors, object)[kept])
        self._directions = free[:, kept] / remainders[kept]
        self._within = within[:, kept] * lengths[kept]
        self._beside = remainders[kept] * lengths[kept]

    def tested_errors(self) -> ErrorTraces:
        """Return the traces of the directions themselves."""
        seen = self._directions.T @ self._directions
        return ErrorTraces(self._errors, self._within, self._beside, seen * self._beside)

    def traces(self, directions: Directions) -> ErrorTraces:
        """Return the traces of others, of the samples of which directions are computed."""
        columns = whitened_rows(directions.columns, self.data.numbers, self._noise)
        within = self.basis.T @ columns
        beside = np.linalg.norm(columns - self.basis @ within, axis=0)
        return ErrorTraces(directions.errors, within, beside, self._directions.T @ columns)

    def thinned(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rows of the samples of which directions are computed."""
        kept = self.fit.by_sample(rows)[self._rows]
        return kept.reshape(-1, *rows.shape[1:])

    def passing(self, traces: ErrorTraces, deviation: float) -> Vector:
        """Return how many times each error the tests along directions just let pass, shape (K,).

        Beside noise of a deviation, of which the statistics have what they usually have.
        """
        allowed = MARGIN * np.abs(self._directions.T @ self.thinned(self.fit.errors)).sum(axis=1)
        limit = np.sqrt(self._threshold(1, among=max(len(allowed), 1))) * deviation + allowed
        squares, vectors = np.linalg.eigh(self._directions.T @ self._directions)
        kept = squares > LEAST_REMAINDER**2 * squares.max(initial=0.0)
        degrees = max(int(kept.sum()), 1)
        all_seen = (vectors[:, kept] / np.sqrt(squares[kept])).T @ traces.seen
        beyond_noise = deviation * np.sqrt(max(self._threshold(degrees) - degrees, 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            single = np.nanmin(limit[:, np.newaxis] / np.abs(traces.seen), axis=0, initial=np.inf)
            together = beyond_noise / np.linalg.norm(all_seen, axis=0)
        passing: Vector = np.minimum(single, together)
        return passing

    @property
    def squares(self) -> Vector:
        """The sums of squares of the whitened residual, shape (n_y,)."""
        return np.asarray(np.sum(self.fit.by_sample(self.fit.residual) ** 2, axis=0), np.float64)

    def tests(self, deviation: float) -> list[ResidualTest]:
        """Test the residual for noise of a deviation."""
        return [
            self._single_directions(deviation),
            self._all_directions(deviation),
            self._whiteness(deviation),
        ]

    def size_tests(self, stated: Matrix) -> list[ResidualTest]:
        """Hold the size of the residual of each output against the covariance that is stated."""
        deviations = np.sqrt(np.diag(stated))
        return [self._size(o, float(deviation)) for o, deviation in enumerate(deviations)]

    def _size(self, output: int, stated: float) -> ResidualTest:
        residual = self._plain[self.fit.counted[:, output], output]
        unknowns = self._unknowns.shape[1] / self.fit.counted.shape[1]
        degrees = max(int(len(residual) - unknowns), 1)
        deviation = float(np.sqrt(residual @ residual / degrees))
        expected = float(np.hypot(stated, self.accuracy.deviations[output]))
        name = f"deviation of y[{output}] over the stated one"
        statistic = deviation / expected
        if deviation < stated:
            name = f"stated deviation over that of y[{output}]"
            statistic = stated / max(deviation, np.finfo(np.float64).tiny)
        threshold = MARGIN * float(np.sqrt(_threshold(degrees) / degrees))
        sizes = f"found {deviation:.3g}, stated {stated:.3g}"
        return ResidualTest(name, statistic, threshold, degrees, sizes)

    def _excess(self, directions: Matrix, deviation: float) -> Vector:
        """Return how much of the residual along directions is more than errors allow."""
        projections = np.abs(directions.T @ self.thinned(self.fit.residual))
        allowed = MARGIN * np.abs(directions.T @ self.thinned(self.fit.errors)).sum(axis=1)
        excess: Vector = np.maximum(projections - allowed, 0.0) / deviation
        return excess

    def _single_directions(self, deviation: float) -> ResidualTest:
        excess = self._excess(self._directions, deviation)
        place = int(excess.argmax()) if len(excess) else 0
        statistic = float(excess[place] ** 2) if len(excess) else 0.0
        largest = self._errors[place].name if self._errors else ""
        threshold = self._threshold(1, among=max(len(excess), 1))
        return ResidualTest(LARGEST_TRACE, statistic, threshold, 1, largest)

    def _all_directions(self, deviation: float) -> ResidualTest:
        basis = _orthonormal(self._directions)
        excess = self._excess(basis, deviation)
        degrees = max(len(excess), 1)
        statistic = float(excess @ excess)
        return ResidualTest(ALL_TRACES, statistic, self._threshold(degrees), degrees, "")

    def _threshold(self, degrees: int, among: int = 1) -> float:
        return ratio_above(FALSE_ALARM / among, degrees, self._noise.freedom)

    def _whiteness(self, deviation: float) -> ResidualTest:
        residual = self.fit.by_sample(self.fit.residual)
        errors = self.fit.by_sample(self.fit.errors)
        squares = []
        places = []
        for o, values in enumerate(self.fit.counted.T):
            excess = _correlation(
                residual[values, o], errors[values, o], deviation, self._noise.order
            )
            squares += list(excess**2)
            of_output = f" of y[{o}]" if len(self.fit.counted.T) > 1 else ""
            places += [f"lag {lag}{of_output}" for lag in range(1, len(excess) + 1)]
        # each coefficient of a model of the noise takes a degree of freedom
        degrees = len(squares) - int(np.count_nonzero(self._noise.a))
        largest = places[int(np.argmax(squares))]
        statistic = float(np.sum(squares))
        return ResidualTest(WHITENESS, statistic, _threshold(degrees), degrees, largest)


def _correlation(residual: Vector, errors: Matrix, deviation: float, order: int) -> Vector:
    """Return the correlations of the first lags beyond what errors allow, of deviation 1 each.

    There are more of them than the ``order`` of a model of the noise.
    """
    N = len(residual)
    lags = max(min(LAGS + order, N // 4), order + 1)
    excess = np.zeros(lags)
    for k in range(1, lags + 1):
        product = abs(float(residual[k:] @ residual[: N - k]))
        products = np.abs(np.sum(errors[k:] * errors[: N - k], axis=0))
        excess[k - 1] = max(product - MARGIN * float(products.sum()), 0.0)
    correlation: Vector = excess / (np.sqrt(N) * deviation**2)
    return correlation


def _orthonormal(columns: Matrix) -> Matrix:
    """Return an orthonormal basis of columns; dependent ones are left out."""
    lengths = np.linalg.norm(columns, axis=0)
    scaled: Matrix = columns[:, lengths > 0.0] / lengths[lengths > 0.0]
    if not scaled.shape[1]:
        return scaled
    squares, vectors = np.linalg.eigh(scaled.T @ scaled)
    kept = squares > LEAST_REMAINDER**2 * squares[-1]
    return np.asarray(scaled @ (vectors[:, kept] / np.sqrt(squares[kept])), np.float64)


def _is_exact(fit: OutputErrorFit, tested: Sequence[TestedFit]) -> bool:
    """Return whether no residual is larger than errors that are no noise allow."""
    squares = np.sum([one.squares for one in tested], axis=0)
    freedom = max(fit.freedom, 1.0) / len(squares)
    deviations = np.sqrt(squares / freedom)
    allowed = np.max([one.allowed for one in tested], axis=0)
    return bool((deviations <= NOTHING_ELSE * allowed).all())


def _threshold(degrees: int) -> float:
    return chi_square_above(FALSE_ALARM, degrees)


def _presence_bias(fitted: FittedModel, errors: ErrorBias) -> Vector:
    """Return how long the errors of the amplitudes are in the measure of their covariance.

    Their own theta is given, as in ``OutputErrorFit.presence``.
    """
    fit = fitted.fit
    matrices = fitted.problem.generators
    owner = np.repeat(np.arange(len(matrices.size)), matrices.count)
    bias = np.zeros(len(matrices.size))
    first = 0
    for i, size in enumerate(matrices.size):
        place = slice(first, first + size)
        squares = np.zeros(errors.theta.shape[1])
        for one, own in zip(fitted.linearized, errors.linear, strict=True):
            others = one.slopes[:, fit.estimated & (owner != i)]
            basis = _orthonormal(np.hstack([others, np.delete(one.linear, place, axis=1)]))
            effect = one.linear[:, place] @ own[place]
            effect -= basis @ (basis.T @ effect)
            squares += np.sum(effect**2, axis=0)
        bias[i] = np.sqrt(squares).sum() / fit.deviation if fit.deviation > 0.0 else 0.0
        first += size
    return bias
