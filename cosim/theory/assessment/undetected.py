"""How far errors of the model that the tests of the residual do not see move the estimates.

An error of the model in a direction d adds ``s d`` to the outputs. What of it is in the tangent of
the model moves the unknowns by ``s J^+ d``; the rest, ``s (I - J J^+) d``, stays in the residual,
where the tests see it beside noise. The largest s that they let pass is therefore known, and with
it how far every estimate moves without a word, which no interval contains: it rests on noise alone.

The errors are those that the tests look for, and what a model lacks most often: a constant or a
drift on an output, and a further term of the disturbance, an exponential of any rate. An error of
the plant or the disturbance counts up to a tenth of what the disturbance does to the outputs, a
change of an alpha up to a tenth of what varies of it: beyond, its effect is not linear. What passes
even where it is as large as all of that is no error that tests can see: theta makes up for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cosim.arrays import Vector
from cosim.theory.assessment.amplitude_verdicts import constants_of
from cosim.theory.assessment.consistency import LEAST_REMAINDER, ErrorTraces, TestedFit
from cosim.theory.assessment.linearized_fit import pseudo_inverse
from cosim.theory.assessment.model_errors import ModelError, missing_parts
from cosim.theory.assessment.verdicts import Assessment
from cosim.theory.documents import ParameterVerdict, UndetectedError, Verdict

LEAST_MOVE: Final = 0.5  # half widths, from which on it is told
LARGEST_ERROR: Final = 0.1  # over the effect of the disturbance, of an alpha over its variation
ROUNDING_LENGTH: Final = 1e-9  # over the effect of the disturbance
SAME_MOVE: Final = 1.01  # of two errors that move a parameter as far the first one is told
RATES: Final = 7  # of exponentials, a factor of 2 apart, from the slowest one over the record


def _sentence(error: str, size: float, half_widths: Mapping[str, float], remedy: str) -> str:
    first, *others = half_widths.items()
    moves = [f"{first[0]} moves by {_times_text(first[1])} half widths"]
    moves += [f"{name} by {_times_text(times)}" for name, times in others]
    removed = f"; {remedy} removes it" if remedy else ""
    return f"{error} of {size:.2g} would pass: {', '.join(moves)}{removed}"


def _times_text(times: float) -> str:
    return f"{times:.2g}" if times < 99.5 else f"{times:.0f}"


def undetected_errors(
    assessment: Assessment,
    amplitudes: Sequence[Sequence[ParameterVerdict]],
    *,
    with_offset: str,
) -> tuple[UndetectedError, ...]:
    """Return which errors of a model that passes its tests move an estimate out of its interval.

    These are a constant and a drift on each output, and the error that moves an estimate most.

    Parameters
    ----------
    assessment : Assessment
    amplitudes : sequence of sequence of ParameterVerdict
        Of each data set.
    with_offset : str
        What makes a constant on every output an unknown.
    """
    labels = [parameter.name for parameter in assessment.parameters]
    verdicts = list(assessment.parameters)
    for number, of_data in enumerate(amplitudes, start=1):
        place = f", data set {number}" if len(amplitudes) > 1 else ""
        labels += [f"{amplitude.name}{place}" for amplitude in of_data]
        verdicts += of_data
    widths = np.array([_half_width(verdict) for verdict in verdicts])
    consistency = assessment.consistency
    if not np.isfinite(widths).any() or not consistency.passed or not consistency.tests:
        return ()
    found = _moves(assessment)
    times = np.nan_to_num(np.array([one.distances for one in found]) / widths)
    told = [i for i, one in enumerate(found) if one.error.is_on_output]
    for j in range(len(widths)):
        largest = float(times[:, j].max())
        first = int(np.argmax(times[:, j] * SAME_MOVE >= largest))
        if first not in told:
            told.append(first)
    errors = []
    for i in told:
        half_widths = {}
        for label, value in zip(labels, times[i], strict=True):
            if value > LEAST_MOVE:
                half_widths[label] = float(value)
        error = found[i].error
        remedy = with_offset if error.is_constant else ""
        if half_widths:
            moved = (error.name, found[i].size, half_widths, remedy)
            errors.append(UndetectedError(*moved, text=_sentence(*moved)))
    return tuple(errors)


def _half_width(verdict: ParameterVerdict) -> float:
    """Return that of the interval that the data say to hold; NaN: there is none, or no width."""
    if verdict.verdict is not Verdict.IDENTIFIABLE or verdict.lower is None:
        return np.nan
    assert verdict.upper is not None
    return 0.5 * (verdict.upper - verdict.lower) or np.nan


@dataclass(frozen=True, eq=False)
class _Move:
    """An error that would just pass, its size, and how far it moves each estimate."""

    error: ModelError
    size: float
    distances: Vector


def _moves(assessment: Assessment) -> list[_Move]:
    """Return every error that would pass, and by how much it moves each estimate.

    One that may be in each of several data sets has its largest size, and moves them by its sum.
    """
    fitted = assessment.fitted
    fit = assessment.fit
    tested = assessment.consistency.tested
    order = fitted.problem.generators.order
    span = max(float(data.t[-1] - data.t[0]) for data in fitted.problem.data)
    rates = np.append(0.0, 2.0 ** np.arange(RATES) / span)
    slopes = [one.thinned(one.fit.slopes) for one in tested]
    linear = [one.thinned(one.fit.linear) for one in tested]
    inverses = [pseudo_inverse(columns) for columns in linear]
    free = []
    for own, columns, inverse in zip(slopes, linear, inverses, strict=True):
        estimated = own[:, fit.estimated]
        free.append(estimated - columns @ (inverse @ estimated))
    ends = np.cumsum([len(rows) for rows in free])
    of_theta = np.split(pseudo_inverse(np.vstack(free)), ends[:-1], axis=1)
    by_unknowns = []
    for index in range(len(tested)):
        constants = constants_of(assessment, index)
        by_unknowns.append(np.vstack([own.slopes for own in constants]))
    moves: dict[str, _Move] = {}
    for index, one in enumerate(tested):
        missing = missing_parts(fitted.problem.plant, one.data, rates)
        traces = one.traces(missing) + one.tested_errors()
        theta = np.zeros((len(fit.theta), len(traces.errors)))
        theta[fit.estimated] = of_theta[index] @ one.basis @ traces.within
        moved = [theta]
        for other in range(len(tested)):
            unknowns = -(inverses[other] @ slopes[other]) @ theta
            if other == index:
                unknowns += inverses[index] @ one.basis @ traces.within
            moved.append(by_unknowns[other] @ np.vstack([theta, unknowns[:order]]))
        disturbed = linear[index][:, :order] @ fit.amplitudes[index]
        passing = _passing(one, traces, fit.deviation, float(np.linalg.norm(disturbed)))
        distances = np.abs(np.vstack(moved) * passing)
        for k, error in enumerate(traces.errors):
            move = moves.get(error.name, _Move(error, 0.0, np.zeros(len(distances))))
            size = max(float(passing[k]), move.size)
            moves[error.name] = _Move(error, size, distances[:, k] + move.distances)
    return list(moves.values())


def _passing(tested: TestedFit, traces: ErrorTraces, deviation: float, disturbed: float) -> Vector:
    """Return the size of each error that would just pass, shape (K,); 0: there is none to tell."""
    passing = tested.passing(traces, deviation)
    lengths = traces.lengths
    passing[traces.beside <= LEAST_REMAINDER * lengths] = 0.0
    for k in np.flatnonzero(passing).tolist():
        error = traces.errors[k]
        if error.is_on_output:
            continue
        whole = min(disturbed / lengths[k], error.limit)
        is_rounding = lengths[k] <= ROUNDING_LENGTH * disturbed
        is_made_up_for = passing[k] > whole
        passing[k] = min(passing[k], LARGEST_ERROR * whole)
        if is_rounding or is_made_up_for:
            passing[k] = 0.0
    return passing
