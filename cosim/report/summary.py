"""The summary of a run, from its recording alone.

Errors against the truth, estimates, start times of identifiers, and what their data determine.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from typing import Any, Final, TypeAlias

import numpy as np

from cosim.arrays import Matrix
from cosim.core.gain.loop_gain import LoopGain
from cosim.core.port import named_ports
from cosim.core.recorded.partial import declared_channels, is_recorded_whole
from cosim.core.recorded.run import RecordedRun
from cosim.core.recorded.signals import RunMessage, find_signal
from cosim.core.recording import Recording
from cosim.core.stages.substep_control import SubstepCounts
from cosim.report import estimators
from cosim.report.recorded_rows import (
    element_names,
    lag_of,
    last_row,
    last_value,
    parts_beside_truth,
)
from cosim.scenario import record

ERROR: Final = " error"  # of a result, after the name of what it is of
HALF_WIDTH: Final = " half-width"
LARGEST_ERROR: Final = " largest error"
ResultValue: TypeAlias = float | str | None


@dataclass(frozen=True)
class SignalError:
    """An estimated signal against the signal it should equal.

    Parameters
    ----------
    estimate : str
        Its port.
    truth : str
        A port, or several that are stacked.
    since : float
        From when on they are compared [s].
    largest, rms : float
        Of the absolute error from there on.
    last : float
        Absolute error at the end.
    lag : float
        Of the estimate, which is compared with the truth that much earlier [s].
    """

    estimate: str
    truth: str
    since: float
    largest: float
    rms: float
    last: float
    lag: float = 0.0


@dataclass(frozen=True)
class ValueOutcome:
    """An estimated constant against its true value."""

    estimate: str
    value: float | None  # None: no value yet
    truth: float
    error: float | None


@dataclass(frozen=True, repr=False)
class Summary:
    """Everything that the table after a run shows; ``log.summary()`` returns it.

    Parameters
    ----------
    scenario : str
    start, end : float
        First and last communication point [s].
    steps : int
    status : str
    reason : str
        Why the run stopped; empty where it reached its end.
    signals : tuple of SignalError
    values : tuple of ValueOutcome
    identifications : tuple of Identification
    reconstructions : tuple of DeltaReconstruction
    compensations : tuple of CompensationSummary
    last : mapping of output name to its last value
        Only where there is no truth.
    loops : tuple of str
        Stages that advance step by step, with an error of first order in the step.
    gains : tuple of LoopGain
        Of all loops, as they were before the run.
    substeps : tuple of SubstepCounts
        Of the loops that took any.
    interpolated : tuple of tuple of str
        For each of these loops the outputs from outside that are interpolated over a communication
        step, in its substeps too.
    changed_states : tuple of StateChange
        Initial states that are others than the scenario gives.
    copied_code : mapping of component name to str
        Of a replay: components of users' classes that it took from the log, and these classes.
    until : str or None
        The condition that ends the run before its stop; None: the run looked for none.
    until_came_true : bool or None
        Whether it did.
    never_came_true : tuple of str
        Conditions of actions that were not performed.
    lateness : Lateness or None
        Of a run that kept the pace of the wall clock.
    warnings : tuple of RunMessage
        What the run warned of: ``time_ns``, ``level``, ``source``, ``text`` of each.
    """

    scenario: str
    start: float
    end: float
    steps: int
    status: str = "complete"
    reason: str = ""
    signals: tuple[SignalError, ...] = ()
    values: tuple[ValueOutcome, ...] = ()
    identifications: tuple[estimators.Identification, ...] = ()
    reconstructions: tuple[estimators.DeltaReconstruction, ...] = ()
    compensations: tuple[estimators.CompensationSummary, ...] = ()
    last: Mapping[str, float | list[float]] = field(default_factory=dict)
    loops: tuple[str, ...] = ()
    gains: tuple[LoopGain, ...] = ()
    substeps: tuple[SubstepCounts, ...] = ()
    interpolated: tuple[tuple[str, ...], ...] = ()
    changed_states: tuple[record.StateChange, ...] = ()
    copied_code: Mapping[str, str] = field(default_factory=dict)
    until: str | None = None
    until_came_true: bool | None = None
    never_came_true: tuple[str, ...] = ()
    lateness: record.Lateness | None = None
    warnings: tuple[RunMessage, ...] = ()

    def __repr__(self) -> str:
        parts = [f"{self.status}, {span(self.start, self.end)} in {self.steps} steps"]
        parts += [f"{error.estimate} off by up to {error.largest:.3g}" for error in self.signals]
        parts += [repr(one)[1:-1] for own in self.identifications for one in own.parameters]
        if self.warnings:
            parts.append(f"{len(self.warnings)} warning{'' if len(self.warnings) == 1 else 's'}")
        return f"<Summary of {self.scenario!r}: {'; '.join(parts)}>"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        content = asdict(self)
        content["warnings"] = [{"of": one.source, "text": one.text} for one in self.warnings]
        content["identifications"] = [one.to_dict() for one in self.identifications]
        for change in content["changed_states"]:
            change |= {name: change.pop(name) for name in ("entry", "before", "after")}
        return content


def summarize(recording: RecordedRun) -> Summary:
    """Summarize a run; truth and start times come from the recording's metadata.

    Raises
    ------
    LogError
        If what was recorded of the run cannot be understood.
    """
    run = record.run_metadata(recording)
    truth = record.truth_of(recording)
    verdicts = record.recorded_identification(recording)
    identifications = []
    reconstructions = []
    compensations = []
    copied = record.replay_origin(recording).copied if "replay" in run else ()
    copied_code = {}
    for name in declared_channels(recording.channels):
        own = record.component_record(recording, name)
        if own.is_identifier:
            found = verdicts.get(name, record.IdentifierVerdicts())
            identifications.append(estimators.identification(recording, name, own, found))
        if own.reconstruction is not None:
            reconstructions.append(estimators.reconstruction(recording, name, own))
        if own.compensation is not None and is_recorded_whole(recording.channels, name):
            compensations.append(estimators.compensation(recording, name, own.compensation))
        if own.code is not None and name in copied:
            copied_code[name] = own.code.class_name
    end = recording.end_ns / 1e9
    since = max([0.0, *(one.start_time for one in identifications)])
    if end < since:
        since = 0.0
    judged = chain.from_iterable(one.parameters for one in identifications)
    unknown = {one.name for one in judged if one.value is None}  # nothing in the data depends on it
    signals = []
    values: list[ValueOutcome] = []
    for estimate, true in truth.items():
        ports = named_ports(true)
        if ports:
            signals.append(_signal_error(recording, estimate, ports, since))
        else:
            values += _value_outcomes(recording, estimate, np.atleast_1d(true).tolist(), unknown)
    changed_states: list[record.StateChange] = []
    for name, changes in record.recorded_state_changes(recording).items():
        changed_states += (replace(change, component=name) for change in changes)
    came_true = record.until_came_true(recording)
    substeps = record.recorded_substep_counts(recording)
    start, _ = record.recorded_window(recording) or (record.recorded_start(recording), end)
    return Summary(
        scenario=run.get("scenario", ""),
        start=start,
        end=end,
        steps=recording.steps,
        status=recording.status,
        reason=recording.reason,
        signals=tuple(signals),
        values=tuple(values),
        identifications=tuple(identifications),
        reconstructions=tuple(reconstructions),
        compensations=tuple(compensations),
        last={} if truth else dict(_last_values(recording)),
        loops=tuple(record.first_order_loops(recording)),
        gains=record.recorded_loop_gains(recording),
        substeps=substeps,
        interpolated=tuple(_interpolated(recording, counts.components) for counts in substeps),
        changed_states=tuple(changed_states),
        copied_code=copied_code,
        until=None if came_true is None else run.get("until"),
        until_came_true=came_true,
        never_came_true=record.never_came_true(recording),
        lateness=record.recorded_lateness(recording),
        warnings=tuple(recording.warnings),
    )


def _interpolated(recording: Recording, loop: Collection[str]) -> tuple[str, ...]:
    """Return the outputs from outside a loop that are interpolated over a communication step.

    Those are not that never change: what inherits how it changes from inputs, and has none.
    """
    found: dict[str, None] = {}
    declared = declared_channels(recording.channels)
    for to, sources in record.connected_sources(recording).items():
        port = find_signal(declared, to, source="connections")
        name = port.channel.name
        if name not in loop or recording.held[name][port.columns].all():
            continue
        for source in sources:
            of = find_signal(declared, source, source="connections")
            changes = of.signal.variability != "inherited" or of.channel.interface.inputs
            if of.channel.name not in loop and changes:
                found[source] = None
    return tuple(found)


def _last_values(recording: Recording) -> Iterator[tuple[str, float | list[float]]]:
    for name, channel in recording.channels.items():
        row = last_row(recording, name)
        if row is None:
            continue
        y = row[channel.interface.n_u :].tolist()
        for signal, columns in channel.interface.output_columns().items():
            values = y[columns]
            yield f"{name}.{signal}", values[0] if len(values) == 1 else values


@np.errstate(over="ignore", invalid="ignore")  # of a recording that may hold any numbers
def _signal_error(
    recording: Recording, estimate: str, true_ports: Sequence[str], since: float
) -> SignalError:
    lag = lag_of(recording, estimate)
    count = 0
    squares = 0.0
    largest = last = math.nan
    for shared_ns, estimated, true in parts_beside_truth(recording, estimate, true_ports):
        error: Matrix = np.abs(estimated - true)
        if len(error):
            last = float(error[-1].max())
        error = error[shared_ns / 1e9 >= since]
        if lag:  # there is no value at the start
            error = error[~np.isnan(error).any(axis=1)]
        if error.size:
            largest = float(np.maximum(largest if count else 0.0, error.max()))
            squares += float(np.sum(error**2))
            count += error.size
    rms = math.sqrt(squares / count) if count else math.nan
    return SignalError(estimate, ", ".join(true_ports), since, largest, rms, last, lag)


def _value_outcomes(
    recording: Recording, estimate: str, truth: Sequence[float], unknown: Collection[str]
) -> Iterator[ValueOutcome]:
    """Yield the last values of an estimate; ``unknown`` have numbers that say nothing."""
    last = last_value(recording, estimate).tolist()
    names = element_names(estimate, len(truth))
    for name, value, true in zip(names, last, truth, strict=True):
        if math.isnan(value) or name in unknown:
            yield ValueOutcome(name, None, true, None)
        else:
            yield ValueOutcome(name, value, true, abs(value - true))


def span(start: float, end: float) -> str:
    """Return the time of a run as text: its length, or both ends where it does not start at 0."""
    return f"{start:.12g} s to {end:.12g} s" if start else f"{end:.12g} s"


def results_of(summary: Summary) -> dict[str, ResultValue]:
    """Return what the result of a run says, by name.

    * of every estimate with a truth, and every parameter of an identifier: its value at the end;
      with ``error`` after its name the distance from the truth, with ``half-width`` half of the
      95 % interval;
    * of every identifier: ``verdict``, those of its parameters, the same ones once; ``noise``, the
      deviation of the noise of y by the residual (of several outputs ``noise[0]``, ...);
    * of every estimated signal: ``rms error`` and ``largest error``, from the start of the
      identification on;
    * without a truth: the last values of the outputs.
    """
    results: dict[str, ResultValue] = {}
    for outcome in summary.values:
        results[outcome.estimate] = outcome.value
        results[f"{outcome.estimate}{ERROR}"] = outcome.error
    for identification in summary.identifications:
        name = identification.component
        verdicts = dict.fromkeys(one.verdict for one in identification.parameters)
        for parameter in identification.parameters:
            results.setdefault(parameter.estimate, parameter.value)
            results[f"{parameter.estimate}{HALF_WIDTH}"] = parameter.half_width
        if verdicts:
            results[f"{name} verdict"] = ", ".join(verdicts)
        results |= _elements(f"{name} noise", identification.deviation)
    for signal in summary.signals:
        results[f"{signal.estimate} rms error"] = signal.rms
        results[f"{signal.estimate}{LARGEST_ERROR}"] = signal.largest
    for name, last in summary.last.items():
        results |= _elements(name, last if isinstance(last, list) else [last])
    return results


def _elements(name: str, values: Sequence[float]) -> dict[str, ResultValue]:
    """Return values by name; of several each has its number."""
    if len(values) == 1:
        return {name: values[0]}
    return {f"{name}[{number}]": value for number, value in enumerate(values)}
