"""Identification from logs, after their runs: the data and the model of their identifiers.

What an identifier took in is in its log, and its model is built again from the recorded scenario.
Several logs of one plant under one theta make one fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cosim.arrays import Matrix, Nanoseconds, Vector, as_columns
from cosim.core.clock import seconds
from cosim.core.connections import conversions_of
from cosim.core.port import Port
from cosim.core.recorded.partial import partial_of
from cosim.core.recorded.run import RecordedRun
from cosim.core.structure.ports import Ports
from cosim.errors import UsageError, nearest, quoted
from cosim.log import open_log
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.kinds.identified_plant import (
    OUTPUT_ERROR,
    IdentifiedPlant,
    SampleRows,
    ThetaBounds,
    bounds_of,
)
from cosim.scenario.record import component_record
from cosim.scenario.recordings.replay_request import ReplayRequest
from cosim.scenario.recordings.replaying import RebuiltRun
from cosim.scenario.recordings.verdicts import IDENTIFY_WITH_OFFSET, interval_of
from cosim.theory.assessment.advice import advised
from cosim.theory.assessment.agreement import contradictions, each_alone
from cosim.theory.assessment.amplitude_verdicts import amplitude_verdicts
from cosim.theory.assessment.assessing import assess
from cosim.theory.assessment.smoothing import SmoothedSignals, smoothed_signals
from cosim.theory.assessment.undetected import undetected_errors
from cosim.theory.assessment.validation import Validation, validate
from cosim.theory.assessment.verdicts import Assessment
from cosim.theory.bounded.feasible_program import Watch
from cosim.theory.bounded.irregular_part import GuaranteedInterval, Programs
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.documents import ParameterVerdict, UndetectedError


@dataclass(frozen=True, eq=False)
class IdentifierRecord:
    """The data and the model of an identifier, from the log of its run.

    Parameters
    ----------
    log : RecordedRun
        A log, or a run in memory.
    identifier : str
    identified : IdentifiedPlant
    data : DataSet
    """

    log: RecordedRun
    identifier: str
    identified: IdentifiedPlant
    data: DataSet

    @property
    def estimate(self) -> Vector | None:
        """The last theta of output error in the run, NaN without value; None by other methods."""
        if component_record(self.log, self.identifier).method != OUTPUT_ERROR:
            return None
        if not self.identified.parameters:
            return np.zeros(0)
        rows = as_columns(self.log[f"{self.identifier}.theta"])
        theta: Vector = rows[-1]
        return theta


@dataclass(frozen=True, eq=False, kw_only=True)
class LogIdentification:
    """A fit by output error to one or more logs.

    Parameters
    ----------
    records : tuple of IdentifierRecord
    assessment : Assessment
    contradictions : tuple of str
        Where the logs are not explained together: which of them fail alone, and whose theta differ.
    """

    records: tuple[IdentifierRecord, ...]
    assessment: Assessment
    contradictions: tuple[str, ...] = ()

    @property
    def identified(self) -> IdentifiedPlant:
        """The model."""
        return self.records[0].identified

    @cached_property
    def amplitudes(self) -> tuple[tuple[ParameterVerdict, ...], ...]:
        """What may be said about amplitudes and phases, those of each log."""
        return amplitude_verdicts(self.assessment)

    @cached_property
    def undetected(self) -> tuple[UndetectedError, ...]:
        """Which errors of the model the tests let pass, though they move an estimate far."""
        return undetected_errors(self.assessment, self.amplitudes, with_offset=IDENTIFY_WITH_OFFSET)

    def validate(self, other: IdentifierRecord) -> Validation:
        """Test the fit on the data of another run, which was not used in it.

        Raises
        ------
        UsageError
            If the log is of another model, or was used in the fit.
        AssumptionError
            If it has fewer samples than unknowns.
        """
        _check_beside(other, self.records)
        return validate(self.assessment, other.data)

    def smoothed(self, index: int = 0) -> SmoothedSignals:
        """Return states and disturbance of log number ``index`` by the fit, with their bands.

        Raises
        ------
        UsageError
            If there is no such log.
        AssumptionError
            If the plant is unstable.
        """
        if not 0 <= index < len(self.records):
            raise UsageError(
                f"index: expected 0 to {len(self.records) - 1}, the number of a log, got {index}"
            )
        return smoothed_signals(self.assessment.fitted, index)

    def guaranteed_interval(self, bound: float, watch: Watch | None = None) -> GuaranteedInterval:
        """Return which theta a log allows if an irregular part of delta is within a bound.

        Parameters
        ----------
        bound : float
            Of the irregular part, ``|delta_0| <= bound``.
        watch : callable, optional
            Called after every linear program with the number solved so far.

        Raises
        ------
        UsageError
            If there are several logs.
        AssumptionError
            If not every theta was estimated, samples are missing or at unequal distances, or the
            plant is unstable.
        """
        if len(self.records) > 1:
            raise UsageError(
                "expected one log to bound theta for an irregular part of the disturbance, got "
                f"{len(self.records)}"
            )
        return interval_of(self.assessment, bound, Programs.ALWAYS, watch)


def identifier_record(
    source: str | Path | RecordedRun, identifier: str | None = None
) -> IdentifierRecord:
    """Return the data and the model of an identifier, from the log of its run.

    Parameters
    ----------
    source : path, log, or run in memory
    identifier : str, optional
        Its name, where there are several.

    Raises
    ------
    LogError
        If the log cannot be read, has no scenario, or does not fit it.
    UsageError
        If it is no log, or has no identifier of that name whose model output error can fit, or
        several.
    """
    log = open_log(source) if isinstance(source, str | Path) else source
    if not isinstance(log, RecordedRun):
        raise UsageError(f"logs: expected a path, or what a run returned, got {quoted(source)}")
    with ExitStack() as resources:
        experiment = RebuiltRun(log, ReplayRequest(), resources).experiment
        name = _chosen(log, experiment.identified, identifier)
        identified = experiment.identified[name]
        samples = _samples(log, experiment, name)
    if identified.problem:
        raise UsageError(f"{log.label}: {identified.problem}")
    t, rows = identified.recorded(log)
    data = identified.data_set(experiment.graph, t, rows, samples)
    return IdentifierRecord(log, name, identified, data)


def _samples(log: RecordedRun, experiment: Experiment, identifier: str) -> SampleRows | None:
    """Return the samples that drove an identifier at times of their own; None: it had none.

    They are taken from what drove it: of the identifier the log may keep some rows only.
    """
    to = Port(identifier, "samples")
    connections = experiment.scenario.connections
    if to not in connections:
        return None
    connection = connections[to]
    conversions = conversions_of(Ports(experiment.graph.layout), to, connection)
    (times,) = connections[Port(identifier, "sample_times")].sources
    t_ns = log.time_ns(times.component)
    for source in connection.sources:
        t_ns = np.union1d(t_ns, log.time_ns(source.component))
    rows = np.hstack([_at_times(log, source, t_ns) for source in connection.sources])
    rows = connection.matrix * rows + connection.offset
    for column, convert in enumerate(conversions):
        rows[:, column] = convert(rows[:, column])
    return SampleRows(seconds(t_ns), _at_times(log, times, t_ns), rows)


def _at_times(log: RecordedRun, port: Port, t_ns: Nanoseconds) -> Matrix:
    """Return the rows of a signal at times; NaN where the log has none."""
    recorded = as_columns(log[port])
    rows = np.full((len(t_ns), recorded.shape[1]), np.nan)
    rows[np.searchsorted(t_ns, log.time_ns(port.component))] = recorded
    return rows


def identify(
    logs: str | Path | RecordedRun | Sequence[str | Path | RecordedRun],
    *,
    identifier: str | None = None,
    offset: bool = False,
    bounds: ThetaBounds | None = None,
) -> LogIdentification:
    """Estimate theta from logs by output error, whatever method their runs used.

    Parameters
    ----------
    logs : path, what a run returned, or a sequence of these
        Of one plant under one theta; each has its own amplitudes, phases and x(0).
    identifier : str, optional
        The identifier to take the model from, if a log has several.
    offset : bool
        An unknown constant is on every output, also where the scenario does not say so.
    bounds : sequence of (lower, upper), or mapping of index to (lower, upper), optional
        Of each theta, or of some; equal ones fix it. By default those of the first log's scenario.

    Raises
    ------
    LogError
        If a log is damaged, or has no scenario.
    UsageError
        If there are none, one is neither a path nor a run, a log has no such identifier, the models
        of the logs differ, two logs have the same rows, or the bounds are invalid.
    AssumptionError
        If there are fewer samples than unknowns.
    """
    listed = list(logs) if isinstance(logs, Sequence) and not isinstance(logs, str) else [logs]
    if not listed:
        raise UsageError("logs: expected at least one, got none")
    records = [identifier_record(log, identifier) for log in listed]
    for number, record in enumerate(records):
        _check_beside(record, records[:number])
    identified = records[0].identified
    problem = identified.problem_of([record.data for record in records])
    problem = replace(
        problem,
        offset=offset or identified.offset,
        bounds=identified.bounds if bounds is None else bounds_of(bounds, identified.parameters),
    )
    assessment = assess(problem, records[0].estimate)
    assessment = advised(assessment, [record.identified.alpha for record in records])
    names = [record.log.label for record in records]
    return LogIdentification(
        records=tuple(records),
        assessment=assessment,
        contradictions=tuple(contradictions(each_alone(assessment), names)),
    )


def _check_beside(record: IdentifierRecord, used: Sequence[IdentifierRecord]) -> None:
    """Check that a log is of one model with those that are used in a fit, and none of them.

    Raises
    ------
    UsageError
        If the plants or the classes of their disturbances differ, by the first difference; or if a
        log of the same rows is used already, so that data would count twice.
    """
    own = record.data
    for other in used:
        data = other.data
        is_same_y = np.array_equal(data.y, own.y, equal_nan=True)
        if is_same_y and np.array_equal(data.t, own.t) and np.array_equal(data.u, own.u):
            raise UsageError(
                f"{record.log.label} has the rows of {other.log.label}, which is used in the fit; "
                "expected data of another run"
            )
        plants = (other.identified.plant, record.identified.plant)
        differences = [
            f"the design models differ in {field.name}"
            for field in fields(DisturbedPlant)
            if not np.array_equal(*(getattr(plant, field.name) for plant in plants))
        ]
        if list(other.identified.families) != list(record.identified.families):
            differences.append("the terms of their regressors differ in family")
        if differences:
            raise UsageError(
                f"{other.log.label} and {record.log.label}: {differences[0]}; expected one model"
            )


def _chosen(log: RecordedRun, identified: Mapping[str, Any], identifier: str | None) -> str:
    """Return the name of an identifier with a model of y, or of the only one."""
    if identifier in identified:
        return str(identifier)
    if identifier is not None:
        problem = (
            f"no identifier {identifier!r} with a model of y; {nearest(identifier, identified)}"
        )
    elif len(identified) == 1:
        return next(iter(identified))
    elif identified:
        problem = (
            "expected the name of one identifier, as there are several; available: "
            f"{', '.join(identified)}"
        )
    elif (partial := partial_of(log.channels)) is not None:
        problem = (
            "expected an identifier with a model of y whose signals are recorded at every step, "
            f"got none; {partial.reason(log.channels)}"
        )
    else:
        problem = (
            "expected an identifier with a model of y, got none; its regressor must be driven by a "
            "single observer of kind 'unknown-input-observer', whose disturbances its terms "
            "describe"
        )
    raise UsageError(f"{log.label}: {problem}")
