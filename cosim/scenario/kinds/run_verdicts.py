"""Verdicts on identifiers at the end of a run, from the signals that were recorded of it.

The same for every method: output error is fitted to what the observer took in as y and u, and what
the identifier says is held against it. Where the identifier takes samples of y at times of their
own, it is fitted to these; where it has a moving window, to the last one. They are results, not
signals: they rest on linear algebra whose last bits depend on the processor.

The same tests tell whether the samples of a residual are what noise leaves: it is the output of a
plant without states, input and disturbance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Block
from cosim.core.graph import Graph
from cosim.errors import AssumptionError, RunError
from cosim.scenario.kinds.feedback import inputs_in_feedback
from cosim.scenario.kinds.identified_plant import IdentifiedPlant, SampleRows
from cosim.scenario.record import IdentifierVerdicts, IrregularEffect, IrregularPart
from cosim.theory.assessment.advice import advised
from cosim.theory.assessment.amplitude_verdicts import amplitude_verdicts
from cosim.theory.assessment.assessing import assess
from cosim.theory.assessment.noise_color import largest_power
from cosim.theory.assessment.undetected import undetected_errors
from cosim.theory.assessment.verdicts import Assessment, judge
from cosim.theory.bounded.feasible_program import Watch
from cosim.theory.bounded.irregular_part import GuaranteedInterval, Programs, guaranteed_interval
from cosim.theory.disturbances.families import Polynomial
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant, NoiseModel
from cosim.theory.estimators.output_error import OutputErrorProblem

OUTPUT_ERROR: Final = "output-error"
IDENTIFY_WITH_OFFSET: Final = "`cosim identify --offset`"
FREQUENCIES: Final = 1025  # of a spectrum, from 0 to half the sampling frequency


class Assessor:
    """Keeps what verdicts need of the rows of a run.

    Parameters
    ----------
    graph : Graph
    identified : mapping of identifier to IdentifiedPlant
    """

    def __init__(self, graph: Graph, identified: Mapping[str, IdentifiedPlant]) -> None:
        self._identifiers = {
            name: _IdentifierData(graph, name, one) for name, one in identified.items()
        }

    def take(self, block: Block, signals: Matrix) -> None:
        """Keep the rows of a block."""
        for data in self._identifiers.values():
            data.take(block, signals)

    def results(self) -> dict[str, Any]:
        """Return the verdicts by identifier, as plain values."""
        return {name: data.verdicts().to_dict() for name, data in self._identifiers.items()}


class _IdentifierData:
    """The data of one identifier: y and u of its observer, the alphas, its last estimate."""

    def __init__(self, graph: Graph, name: str, identified: IdentifiedPlant) -> None:
        own = graph.layout[name].signal_columns
        observer = graph.layout[identified.observer]
        of_observer = observer.signal_columns
        none = slice(0, 0)
        self._identified = identified
        self._theta = own.get("theta", none)  # there is none without parameters
        self._error = own.get("standard_error")
        self._kept = {
            "y": of_observer["y"],
            "u": of_observer.get("u", none),
            "alpha": graph.layout[identified.regressor].signal_columns.get("alpha", none),
        }
        if "samples" in own:
            self._kept |= {key: own[key] for key in ("sample_times", "samples")}
        u = observer.interface.input_columns().get("u", none)
        self._held = graph.held[identified.observer][u]
        self._in_feedback = inputs_in_feedback(graph, identified.observer)
        self._times: list[Vector] = []
        self._rows: dict[str, list[Matrix]] = {key: [] for key in self._kept}
        self._last = np.zeros(0)

    def take(self, block: Block, signals: Matrix) -> None:
        """Keep the rows of a block."""
        first = 1 if self._times else 0
        self._times.append(block.time[first:].copy())
        for key, columns in self._kept.items():
            self._rows[key].append(signals[first:, columns].copy())
        self._last = signals[-1].copy()

    def verdicts(self) -> IdentifierVerdicts:
        """Return the verdicts on the last estimate, or why there are none."""
        if not self._times:
            return IdentifierVerdicts(problem="the run ended before there were data")
        if self._identified.problem:
            return IdentifierVerdicts(problem=self._identified.problem)
        try:
            return self._assessed()
        except (AssumptionError, np.linalg.LinAlgError) as error:
            return IdentifierVerdicts(problem=str(error))

    def _assessed(self) -> IdentifierVerdicts:
        identified = self._identified
        t = np.concatenate(self._times)
        rows = {key: np.concatenate(parts) for key, parts in self._rows.items()}
        samples = None
        if "samples" in rows:
            samples = SampleRows(t, rows["sample_times"], rows["samples"])
        data = identified.data_set(
            t, rows["y"], rows["u"], self._held, self._in_feedback, rows["alpha"], samples
        )
        theta = self._last[self._theta]
        fitted = assess(identified.problem_of([data.last(identified.window)]), theta)
        assessment = advised(fitted, [identified.alpha])
        amplitudes = amplitude_verdicts(assessment)
        with_offset = "`offset = true`" if identified.has_offset_key else IDENTIFY_WITH_OFFSET
        error = None if self._error is None else self._last[self._error]
        bound = identified.irregular
        return replace(
            verdicts_of(assessment),
            extent=identified.extent,
            amplitudes=amplitudes,
            undetected=undetected_errors(assessment, amplitudes, with_offset=with_offset),
            estimate=judge(assessment, theta, error),
            irregular=None if bound is None else _irregular(assessment, bound),
        )


def verdicts_of(assessment: Assessment) -> IdentifierVerdicts:
    """Return what a fit by output error says of theta, and of the noise."""
    return IdentifierVerdicts(**assessment.to_dict() | {"parameters": assessment.parameters})


def _irregular(assessment: Assessment, bound: float) -> IrregularPart:
    """Return what an irregular part within its bound leaves open, or why that is not known."""
    try:
        interval = interval_of(assessment, bound, Programs.BEYOND_FIRST_ORDER)
    except (AssumptionError, RunError) as error:
        return IrregularPart(bound, problem=str(error))
    return irregular_part(bound, interval)


def irregular_part(bound: float, interval: GuaranteedInterval) -> IrregularPart:
    """Return what an interval that is guaranteed for a bound says of every theta."""
    effects = []
    for j, half_width in enumerate(interval.half_width.tolist()):
        lower = float(interval.lower[j])
        upper = float(interval.upper[j])
        effects.append(
            IrregularEffect(
                name=f"theta[{j}]",
                first_order=half_width,
                holds=bool(interval.first_order_holds[j]),
                is_explained=not (np.isnan(lower) or np.isnan(upper)),
                lower=lower if np.isfinite(lower) else None,
                upper=upper if np.isfinite(upper) else None,
            )
        )
    return IrregularPart(
        bound=bound,
        effects=tuple(effects),
        confidence=interval.confidence,
        unsolved=0 if interval.feasible is None else interval.feasible.unsolved,
    )


def interval_of(
    assessment: Assessment, bound: float, programs: Programs, watch: Watch | None = None
) -> GuaranteedInterval:
    """Return which theta data allow if an irregular part of delta is within a bound.

    Where the noise of y is not stated it is as large as the residual, which holds the irregular
    part too; errors of step and quantization are allowed for.

    Parameters
    ----------
    assessment : Assessment
        Of one data set.
    bound : float
        Of the irregular part, ``|delta_0| <= bound``.
    programs : Programs
        When linear programs are solved.
    watch : callable, optional
        Is told after every linear program how many have been solved.

    Raises
    ------
    AssumptionError
        If not every theta was estimated, samples are missing or at unequal distances, or the plant
        is unstable.
    """
    problem = assessment.problem
    estimated = assessment.fit.estimated
    if not estimated.all():
        missing = ", ".join(f"theta[{j}]" for j in np.flatnonzero(~estimated))
        raise AssumptionError(
            f"{missing} was not estimated; bounding theta for an irregular part of the "
            "disturbance takes an estimate of every theta"
        )
    accuracy = assessment.consistency.accuracy[0]
    sampling_error = float(np.abs(accuracy.step).max()) + 0.5 * float(accuracy.spacing.max())
    outputs = accuracy.step.shape[1]
    sigma = _largest_deviations(assessment)
    if problem.stated is not None:
        sigma = np.sqrt(np.diag(problem.stated))
    return guaranteed_interval(
        problem.data[0],
        problem.plant,
        problem.families,
        assessment.fit,
        bound=bound,
        sigma=sigma,
        sampling_error=sampling_error,
        noise=NoiseModel(covariance=assessment.noise.covariance, a=np.zeros((outputs, 0))),
        programs=programs,
        watch=watch,
    )


def _largest_deviations(assessment: Assessment) -> Vector:
    """Return deviations of white noise whose means are as large as those of each residual.

    Of colored noise that is the one at the frequency where its spectrum is largest.
    """
    noise = assessment.noise
    if assessment.consistency.is_exact:
        return np.zeros(len(noise.a))
    frequencies = np.linspace(0.0, np.pi, FREQUENCIES)
    lags = np.arange(1, noise.order + 1)
    waves = np.exp(-1j * np.outer(frequencies, lags))
    gains = 1.0 / np.abs(1.0 - waves @ noise.a.T)
    return np.asarray(assessment.deviations * gains.max(axis=0), np.float64)


def residual_noise(t: Vector, residual: Vector) -> tuple[str, float, float]:
    """Test samples of a residual, shape (N,), at ascending instants t [s].

    Returns
    -------
    problem : str
        Why it is not what noise leaves; empty: it is.
    power : float
        The largest power of the noise at a frequency, over its mean; 1: it is white.
    freedom : float
        Degrees of freedom of that power.

    Raises
    ------
    AssumptionError
        If there are hardly any.
    """
    samples = len(residual)
    data = DataSet(t, residual[:, np.newaxis], np.zeros((samples, 0)), np.zeros((samples, 1)))
    nothing = np.zeros((0, 0))
    plant = DisturbedPlant(
        A=nothing,
        B=nothing,
        Bd=np.zeros((0, 1)),
        C=np.zeros((1, 0)),
        D=np.zeros((1, 0)),
        Dd=np.ones((1, 1)),
    )
    found = assess(OutputErrorProblem([data], plant, [Polynomial(0)]), None)
    problem = "" if found.consistency.passed else found.consistency.contradiction
    power = largest_power(found.noise.a[0])
    return problem.replace(" in y[0]", ""), power, found.noise.freedom
