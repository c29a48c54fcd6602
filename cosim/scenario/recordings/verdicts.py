"""What is judged of the estimates of a run, at its end; and of the noise of a residual.

Verdicts are the same for every method: output error is fitted to what the observer took in as y and
u, and what the identifier says is held against it. Where the identifier takes samples of y at times
of their own, it is fitted to these; where it has a moving window, to the last one. They are
results, not signals: they rest on linear algebra whose last bits depend on the processor.

The same tests tell whether the samples of a residual are what noise leaves: it is the output of a
plant without states, input and disturbance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Block
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.errors import AssumptionError, RunError
from cosim.scenario.kinds.identified_plant import IdentifiedPlant, SampleRows
from cosim.scenario.record import IdentifierVerdicts, IrregularEffect, IrregularPart
from cosim.theory.assessment.advice import advised
from cosim.theory.assessment.amplitude_verdicts import amplitude_verdicts
from cosim.theory.assessment.assessing import assess
from cosim.theory.assessment.undetected import undetected_errors
from cosim.theory.assessment.verdicts import Assessment, judge
from cosim.theory.disturbances.families import Polynomial
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.output_error import OutputErrorProblem

if TYPE_CHECKING:
    from cosim.theory.bounded.feasible_program import Watch
    from cosim.theory.bounded.irregular_part import GuaranteedInterval, Programs

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
        self._graph = graph
        self._identified = identified
        self._times: list[Vector] = []
        self._rows: dict[Port, list[Matrix]] = {}
        for name, one in identified.items():
            own = [Port(name, key) for key in ("sample_times", "samples")]
            self._rows |= {port: [] for port in (*one.ports.values(), *own)}
        self._last = np.zeros(0)

    def _columns(self, port: Port) -> slice:
        """Return where a signal is in the row; nowhere: it is not there."""
        return self._graph.layout[port.component].signal_columns.get(port.signal, slice(0, 0))

    def take(self, block: Block, signals: Matrix) -> None:
        """Keep the rows of a block."""
        first = 1 if self._times else 0
        self._times.append(block.time[first:].copy())
        for port, rows in self._rows.items():
            rows.append(signals[first:, self._columns(port)].copy())
        self._last = signals[-1].copy()

    def results(self) -> dict[str, Any]:
        """Return the verdicts by identifier, as plain values."""
        return {name: self._verdicts(name).to_dict() for name in self._identified}

    def _verdicts(self, name: str) -> IdentifierVerdicts:
        """Return the verdicts on the last estimate, or why there are none."""
        if not self._times:
            return IdentifierVerdicts(problem="the run ended before there were data")
        if self._identified[name].problem:
            return IdentifierVerdicts(problem=self._identified[name].problem)
        try:
            return self._assessed(name, self._identified[name])
        except (AssumptionError, np.linalg.LinAlgError) as error:
            return IdentifierVerdicts(problem=str(error))

    def _kept(self, port: Port) -> Matrix:
        return np.concatenate(self._rows[port])

    def _assessed(self, name: str, identified: IdentifiedPlant) -> IdentifierVerdicts:
        t = np.concatenate(self._times)
        samples = None
        values = self._kept(Port(name, "samples"))
        if values.shape[1]:
            samples = SampleRows(t, self._kept(Port(name, "sample_times")), values)
        rows = {key: self._kept(port) for key, port in identified.ports.items()}
        data = identified.data_set(self._graph, t, rows, samples)
        theta = self._last[self._columns(Port(name, "theta"))]  # none without parameters
        error = self._last[self._columns(Port(name, "standard_error"))]
        fitted = assess(identified.problem_of([data.last(identified.window)]), theta)
        assessment = advised(fitted, [identified.alpha])
        amplitudes = amplitude_verdicts(assessment)
        with_offset = "`offset = true`" if identified.has_offset_key else IDENTIFY_WITH_OFFSET
        return replace(
            verdicts_of(assessment),
            extent=identified.extent,
            amplitudes=amplitudes,
            undetected=undetected_errors(assessment, amplitudes, with_offset=with_offset),
            estimate=judge(assessment, theta, error if len(error) else None),
            irregular=_irregular(assessment, identified.irregular),
        )


def verdicts_of(assessment: Assessment) -> IdentifierVerdicts:
    """Return what a fit by output error says of theta, and of the noise."""
    return IdentifierVerdicts(**assessment.to_dict() | {"parameters": assessment.parameters})


def _irregular(assessment: Assessment, bound: float | None) -> IrregularPart | None:
    """Return what an irregular part within its bound leaves open, or why that is not known."""
    if bound is None:
        return None
    from cosim.theory.bounded.irregular_part import Programs  # rarely needed

    try:
        interval = interval_of(assessment, bound, Programs.BEYOND_FIRST_ORDER)
    except (AssumptionError, RunError) as error:
        return IrregularPart(bound, problem=str(error))
    return irregular_part(bound, interval)


def irregular_part(bound: float, interval: GuaranteedInterval) -> IrregularPart:
    """Return what an interval that is guaranteed for a bound says of every theta."""
    columns = (interval.lower, interval.upper, interval.half_width, interval.first_order_holds)
    effects = []
    for j, (lower, upper, half_width, holds) in enumerate(zip(*columns, strict=True)):
        effect = IrregularEffect(
            name=f"theta[{j}]",
            first_order=float(half_width),
            holds=bool(holds),
            is_explained=not np.isnan([lower, upper]).any(),
            lower=float(lower) if np.isfinite(lower) else None,
            upper=float(upper) if np.isfinite(upper) else None,
        )
        effects.append(effect)
    unsolved = 0 if interval.feasible is None else interval.feasible.unsolved
    return IrregularPart(bound, tuple(effects), interval.confidence, unsolved)


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
    from cosim.theory.bounded.irregular_part import guaranteed_interval  # rarely needed

    problem = assessment.problem
    missing = np.flatnonzero(~assessment.fit.estimated)
    if len(missing):
        raise AssumptionError(
            f"{', '.join(f'theta[{j}]' for j in missing)} was not estimated; bounding theta for an "
            "irregular part of the disturbance takes an estimate of every theta"
        )
    accuracy = assessment.consistency.accuracy[0]
    if problem.stated is None:
        sigma = _largest_deviations(assessment)
    else:
        sigma = np.sqrt(np.diag(problem.stated))
    return guaranteed_interval(
        problem.data[0],
        problem.plant,
        problem.families,
        assessment.fit,
        bound=bound,
        sigma=sigma,
        sampling_error=float(np.abs(accuracy.step).max()) + 0.5 * float(accuracy.spacing.max()),
        noise=assessment.noise.without_color(),
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
    from cosim.theory.assessment.noise_color import largest_power  # rarely needed

    data = DataSet(t, residual[:, np.newaxis], np.zeros((samples, 0)), np.zeros((samples, 1)))
    A = np.zeros((0, 0))
    C = np.zeros((1, 0))
    plant = DisturbedPlant(A=A, B=A, Bd=C.T, C=C, D=C, Dd=np.ones((1, 1)))
    found = assess(OutputErrorProblem([data], plant, [Polynomial(0)]), None)
    problem = "" if found.consistency.passed else found.consistency.contradiction
    power = largest_power(found.noise.a[0])
    return problem.replace(" in y[0]", ""), power, found.noise.freedom
