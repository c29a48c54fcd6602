"""The summary of a run, from its recording alone.

Errors against the truth, estimates, start times of identifiers, and what their data determine.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from typing import TYPE_CHECKING, Any, final

import numpy as np

from cosim.arrays import Matrix, Vector, as_columns
from cosim.core.gain.loop_gain import LoopGain
from cosim.core.recorded.partial import declared_channels, is_recorded_whole
from cosim.core.recorded.run import RecordedRun
from cosim.core.recorded.signals import RunMessage, find_signal
from cosim.core.recording import Recording
from cosim.core.stages.substep_control import SubstepCounts
from cosim.errors import LogError
from cosim.report.recorded_rows import (
    element_names,
    has_signal,
    lag_of,
    last_row,
    parts_beside_truth,
    rows_of,
)
from cosim.scenario.document.schema import truth_ports
from cosim.scenario.identification.run_verdicts import OUTPUT_ERROR
from cosim.scenario.record import (
    ComponentRecord,
    IdentifierVerdicts,
    IrregularPart,
    Lateness,
    Reconstruction,
    StateChange,
    WindowChoice,
    component_record,
    connected_sources,
    first_order_loops,
    never_came_true,
    recorded_identification,
    recorded_lateness,
    recorded_loop_gains,
    recorded_start,
    recorded_state_changes,
    recorded_substep_counts,
    recorded_window,
    replay_origin,
    run_metadata,
    truth_of,
    until_came_true,
)
from cosim.theory.assessment.consistency import NOTHING_ELSE
from cosim.theory.assessment.documents import ParameterVerdict, Verdict
from cosim.theory.disturbances.excitation import describe_excitation, information
from cosim.theory.reconstruction.filters import Bias

if TYPE_CHECKING:
    from cosim.report.compensation import CompensationSummary


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
class DeltaReconstruction:
    """How an observer makes delta, and what that costs."""

    component: str
    filter: str
    parameters: Mapping[str, float]
    lag: float  # s
    noise_gain: tuple[float, ...]  # of the elements of delta, for white noise in each of y
    bias: Bias
    choice: WindowChoice | None = None  # of auto


@dataclass(frozen=True)
class ValueOutcome:
    """An estimated constant against its true value."""

    estimate: str
    value: float | None  # None: no value yet
    truth: float
    error: float | None


@dataclass(frozen=True, repr=False)
class Identification:
    """What the data of an identifier determine.

    Parameters
    ----------
    component : str
    start_time : float
        When the identification starts [s].
    times : mapping of name to float
        What that is made of, where it was computed: ``T_obs``, ``T_f``, ``D_max``, ``T_id`` [s].
    eigenvalues : tuple of float
        Of the information matrix of delta as it was reconstructed.
    verdict : str
        On the regression; empty where the method has none.
    notes : tuple of str
    parameters : tuple of ParameterVerdict
        The verdict on each element of theta.
    reference : tuple of ParameterVerdict
        The same by output error, where the method is another.
    amplitudes : tuple of ParameterVerdict
        Amplitudes and phases, by output error.
    undetected : tuple of str
        Which errors of the model would pass, and how far they move the estimate.
    deviation : tuple of float
        Standard deviation of the noise of each y, from the residual of output error.
    noise : str
        What is known of the noise, or why nothing is.
    guaranteed : IrregularPart or None
        Intervals for a bounded irregular part, where they are asked for.
    """

    component: str
    start_time: float
    times: Mapping[str, float]
    eigenvalues: tuple[float, ...]
    verdict: str
    notes: tuple[str, ...] = ()
    parameters: tuple[ParameterVerdict, ...] = ()
    reference: tuple[ParameterVerdict, ...] = ()
    amplitudes: tuple[ParameterVerdict, ...] = ()
    undetected: tuple[str, ...] = ()
    deviation: tuple[float, ...] = ()
    noise: str = ""
    guaranteed: IrregularPart | None = None

    def __repr__(self) -> str:
        return f"<Identification by {self.component!r}: {list(self.parameters)}>"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        content = asdict(self)
        for key in ("parameters", "reference", "amplitudes"):
            content[key] = [_verdict_row(one) for one in getattr(self, key)]
        if self.guaranteed is not None:
            effects = [{**asdict(one), "estimate": one.name} for one in self.guaranteed.effects]
            for effect in effects:
                del effect["name"]
            keys = ("bound", "problem", "effects", "confidence")
            content["guaranteed"] |= {"effects": effects}
            content["guaranteed"] = {key: content["guaranteed"][key] for key in keys}
        return content


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
    identifications: tuple[Identification, ...] = ()
    reconstructions: tuple[DeltaReconstruction, ...] = ()
    compensations: tuple[CompensationSummary, ...] = ()
    last: Mapping[str, float | list[float]] = field(default_factory=dict)
    loops: tuple[str, ...] = ()
    gains: tuple[LoopGain, ...] = ()
    substeps: tuple[SubstepCounts, ...] = ()
    interpolated: tuple[tuple[str, ...], ...] = ()
    changed_states: tuple[StateChange, ...] = ()
    copied_code: Mapping[str, str] = field(default_factory=dict)
    until: str | None = None
    until_came_true: bool | None = None
    never_came_true: tuple[str, ...] = ()
    lateness: Lateness | None = None
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
    """Summarize a run; truth and start times come from the recording's metadata."""
    run = run_metadata(recording)
    truth = truth_of(recording)
    identifiers: dict[str, ComponentRecord] = {}
    reconstructions = []
    compensations = []
    for name in declared_channels(recording.channels):
        record = component_record(recording, name)
        if record.is_identifier:
            identifiers[name] = record
        if record.reconstruction is not None:
            reconstructions.append(_reconstruction(recording, name, record, record.reconstruction))
        if record.compensation is not None and is_recorded_whole(recording.channels, name):
            from cosim.report.compensation import summarize_compensation  # rarely needed

            compensations.append(summarize_compensation(recording, name, record.compensation))
    since = max((record.start_time for record in identifiers.values()), default=0.0)
    recorded = recorded_identification(recording)
    identifications = []
    for name, record in identifiers.items():
        identification = recorded.get(name, IdentifierVerdicts())
        identifications.append(_identification(recording, name, record, identification))
    unknown = _without_value(identifications)
    signals: list[SignalError] = []
    values: list[ValueOutcome] = []
    for estimate, true in truth.items():
        true_ports = truth_ports(true)
        if true_ports:
            signals.append(_signal_error(recording, estimate, true_ports, since))
        else:
            true_values = np.atleast_1d(np.array(true, dtype=np.float64))
            values += _value_outcomes(recording, estimate, true_values, unknown)
    last = {} if truth else _last_values(recording)
    came_true = until_came_true(recording)
    substeps = recorded_substep_counts(recording)
    window = recorded_window(recording)
    return Summary(
        scenario=run.get("scenario", ""),
        start=recorded_start(recording) if window is None else window[0],
        end=recording.end_ns / 1e9,
        steps=recording.steps,
        status=recording.status,
        reason=recording.reason,
        signals=tuple(signals),
        values=tuple(values),
        identifications=tuple(identifications),
        reconstructions=tuple(reconstructions),
        compensations=tuple(compensations),
        last=last,
        loops=tuple(first_order_loops(recording)),
        gains=recorded_loop_gains(recording),
        substeps=substeps,
        interpolated=tuple(_interpolated(recording, counts.components) for counts in substeps),
        changed_states=tuple(_changed_states(recording)),
        copied_code=_copied_code(recording),
        until=run.get("until") if came_true is not None else None,
        until_came_true=came_true,
        never_came_true=never_came_true(recording),
        lateness=recorded_lateness(recording),
        warnings=tuple(recording.warnings),
    )


def _interpolated(recording: Recording, loop: Collection[str]) -> tuple[str, ...]:
    """Return the outputs from outside a loop that are interpolated over a communication step."""
    found: dict[str, None] = {}
    declared = declared_channels(recording.channels)
    for to, sources in connected_sources(recording).items():
        name, _, _ = to.partition(".")
        if name not in loop:
            continue
        port = find_signal(declared, to, source="connections")
        if recording.held[name][port.columns].all():
            continue
        for source in sources:
            component, _, _ = source.partition(".")
            if component not in loop and not _is_constant(recording, source):
                found[source] = None
    return tuple(found)


def _is_constant(recording: Recording, source: str) -> bool:
    """Whether an output inherits how it changes from inputs, and there are none."""
    declared = declared_channels(recording.channels)
    port = find_signal(declared, source, source="connections")
    return port.signal.variability == "inherited" and not port.channel.interface.inputs


def _copied_code(recording: Recording) -> dict[str, str]:
    """Return the components of users' classes that a replay did not compute."""
    if "replay" not in run_metadata(recording):
        return {}
    classes = {}
    for name in replay_origin(recording).copied:
        code = component_record(recording, name).code
        if code is not None:
            classes[name] = code.class_name
    return classes


def _changed_states(recording: Recording) -> Iterator[StateChange]:
    for name, changes in recorded_state_changes(recording).items():
        yield from (replace(change, component=name) for change in changes)


def _last_values(recording: Recording) -> dict[str, float | list[float]]:
    last: dict[str, float | list[float]] = {}
    for name, channel in recording.channels.items():
        row = last_row(recording, name)
        if row is None:
            continue
        y = row[channel.interface.n_u :]
        columns = channel.interface.output_columns()
        for signal in channel.interface.outputs:
            values = y[columns[signal.name]].tolist()
            last[f"{name}.{signal.name}"] = values[0] if signal.size == 1 else values
    return last


@final
class _ErrorNorms:
    """The largest error and the sum of squares of errors that come part by part."""

    def __init__(self) -> None:
        self._count = 0
        self._squares = 0.0
        self._largest = 0.0

    def add(self, errors: Matrix) -> None:
        """Add some rows of errors."""
        self._count += errors.size
        self._squares += float(np.sum(errors**2))
        self._largest = float(np.maximum(self._largest, errors.max(initial=0.0)))

    def values(self, otherwise: float) -> tuple[float, float]:
        """Return the largest one, ``otherwise`` if there was none, and the root mean square."""
        if not self._count:
            return otherwise, float("nan")
        return self._largest, float(np.sqrt(self._squares / self._count))


@np.errstate(over="ignore", invalid="ignore")  # of a recording that may hold any numbers
def _signal_error(
    recording: Recording, estimate: str, true_ports: Sequence[str], since: float
) -> SignalError:
    lag = lag_of(recording, estimate)
    in_all = _ErrorNorms()
    later = _ErrorNorms()
    last = last_time = float("nan")
    for shared_ns, estimated, true in parts_beside_truth(recording, estimate, true_ports):
        if not len(shared_ns):
            continue
        error: Matrix = np.abs(estimated - true)
        time = shared_ns / 1e9
        last = float(error[-1].max())
        last_time = float(time[-1])
        if lag:
            has_value = ~np.isnan(error).any(axis=1)  # what lags has none at the start
            error = error[has_value]
            time = time[has_value]
        in_all.add(error[time >= 0.0])
        later.add(error[time >= since])
    norms = later
    if not last_time >= since:  # the run ended before the identification began
        norms = in_all
        since = 0.0
    largest, rms = norms.values(float("nan") if lag else 0.0)
    return SignalError(estimate, ", ".join(true_ports), since, largest, rms, last, lag)


def _reconstruction(
    recording: Recording, name: str, record: ComponentRecord, design: Reconstruction
) -> DeltaReconstruction:
    """Return what the delta of an observer costs, with its inputs held or interpolated."""
    channel = declared_channels(recording.channels)[name]
    columns = channel.interface.input_columns().get("y", slice(0, 0))
    held = recording.held[name][columns]
    shape = (-1, len(held)) if len(held) else (0, 0)
    interpolated = np.array(record.noise_gain)
    zero_order = np.array(record.noise_gain_held)
    if interpolated.size != zero_order.size or interpolated.size % max(len(held), 1):
        raise LogError(f"metadata of {name!r}: the noise gains do not fit to its y")
    gains = np.where(held, zero_order.reshape(shape), interpolated.reshape(shape))
    of_delta = np.sqrt(np.sum(gains**2, axis=1))
    parameters = {"filter_rate": design.filter_rate, "order": design.order}
    parameters["half_width"] = design.half_width
    return DeltaReconstruction(
        name,
        design.filter,
        {key: value for key, value in parameters.items() if value is not None},
        design.lag,
        tuple(map(float, of_delta)),
        design.bias,
        None if record.choice is None else record.choice.result,
    )


def _without_value(identifications: Sequence[Identification]) -> set[str]:
    """Return the estimates of which nothing in the data depends: what is recorded is no number."""
    unknown = set()
    for identification in identifications:
        for parameter in identification.parameters:
            if parameter.value is None:
                unknown.add(parameter.estimate)
    return unknown


def _value_outcomes(
    recording: Recording, estimate: str, truth: Vector, unknown: Collection[str]
) -> list[ValueOutcome]:
    rows = rows_of(recording, estimate)
    last = rows[-1] if len(rows) else np.full(len(truth), np.nan)
    names = element_names(estimate, len(truth))
    outcomes = []
    for name, value, true in zip(names, last, truth, strict=True):
        if np.isnan(value) or name in unknown:
            outcomes.append(ValueOutcome(name, None, float(true), None))
        else:
            error = float(abs(value - true))
            outcomes.append(ValueOutcome(name, float(value), float(true), error))
    return outcomes


def bad_verdicts(recording: Recording) -> Iterator[tuple[str, str, str]]:
    """Yield estimates, verdict and reason where estimates contradict the data, or have no value.

    The verdict is ``INCONSISTENT``, another one of what has no value, or empty: none was made.
    """
    found = recorded_identification(recording)
    for name in declared_channels(recording.channels):
        record = component_record(recording, name)
        if not record.is_identifier:
            continue
        if name not in found:
            yield name, "", "no verdict was made"
            continue
        if found[name].problem:
            yield name, Verdict.NO_ESTIMATE, found[name].problem
        labels: dict[tuple[str, str], list[str]] = {}
        for parameter in _parameters(name, _own_estimate(record, found[name])):
            if parameter.verdict == Verdict.INCONSISTENT or parameter.value is None:
                key = (parameter.verdict, parameter.reason)
                labels.setdefault(key, []).append(parameter.estimate)
        for (verdict, reason), names in labels.items():
            yield ", ".join(names), verdict, reason


def _identification(
    recording: Recording,
    component: str,
    record: ComponentRecord,
    identification: IdentifierVerdicts,
) -> Identification:
    """Summarize what is known of an identifier."""
    eigenvalues: tuple[float, ...] = ()
    sentence = ""
    if record.unknowns is not None and is_recorded_whole(
        recording.channels, component, "regressor"
    ):
        eigenvalues, sentence = _information(recording, component, record)
    others = () if record.method == OUTPUT_ERROR else identification.parameters
    return Identification(
        component,
        record.start_time,
        record.times,
        eigenvalues,
        sentence,
        (*record.notes, *_extent(recording, component, record, identification)),
        parameters=_parameters(component, _own_estimate(record, identification)),
        reference=_parameters(component, others),
        amplitudes=tuple(chain.from_iterable(identification.amplitudes)),
        undetected=tuple(error.text for error in identification.undetected),
        deviation=identification.deviation,
        noise=identification.problem or noise_text(identification),
        guaranteed=_guaranteed(component, identification.irregular),
    )


def _guaranteed(component: str, part: IrregularPart | None) -> IrregularPart | None:
    if part is None:
        return None
    names = element_names(f"{component}.theta", len(part.effects))
    pairs = zip(names, part.effects, strict=True)
    return replace(part, effects=tuple(replace(effect, name=name) for name, effect in pairs))


def _extent(
    recording: Recording,
    component: str,
    record: ComponentRecord,
    identification: IdentifierVerdicts,
) -> Iterator[str]:
    """Yield what the verdicts rest on, and why the signal theta has no last value beside them."""
    if identification.extent:
        yield identification.extent
    theta = f"{component}.theta"
    if not has_signal(recording, theta):
        return  # no term has a parameter
    rows = as_columns(recording[theta])
    has_value = bool(len(rows)) and bool(np.isfinite(rows[-1]).all())
    if record.method != OUTPUT_ERROR or has_value or identification.problem:
        return
    end = recording.end_ns / 1e9
    if end < record.start_time:
        cause = f"the run ends at {end:g} s, before the identification start time"
    elif all(parameter.value is None for parameter in identification.parameters):
        return  # the verdicts say why
    else:
        cause = "no fit during the run led to one; the fit after the run did"
    yield f"{theta} itself has no value at the end: {cause}"


def _own_estimate(
    record: ComponentRecord, identification: IdentifierVerdicts
) -> Sequence[ParameterVerdict]:
    """Return what is known of the estimate of an identifier by the method that it has."""
    is_output_error = record.method == OUTPUT_ERROR
    return identification.parameters if is_output_error else identification.estimate


def _parameters(
    component: str, verdicts: Sequence[ParameterVerdict]
) -> tuple[ParameterVerdict, ...]:
    """Return verdicts with the names of their ports."""
    names = element_names(f"{component}.theta", len(verdicts))
    pairs = zip(names, verdicts, strict=True)
    return tuple(replace(verdict, name=name) for name, verdict in pairs)


def _verdict_row(verdict: ParameterVerdict) -> dict[str, Any]:
    keys = ("estimate", "verdict", "reason", "value", "standard_error", "half_width")
    return {key: getattr(verdict, key) for key in keys}


def noise_text(identification: IdentifierVerdicts) -> str:
    """Describe the noise of y as the residual of output error shows it."""
    if not identification.deviation:
        return ""
    if identification.is_exact:
        return (
            f"the residual is at most {NOTHING_ELSE:g} times what step, quantization and rounding "
            f"allow, {numbers_text(identification.accuracy)}"
        )
    order = len(identification.noise_model[0]) if identification.noise_model else 0
    if order:
        coefficients = "; ".join(
            ", ".join(f"{a:.3g}" for a in row) for row in identification.noise_model
        )
        return f"colored, whitened by an autoregressive model of order {order}: {coefficients}"
    return "of y, from the residual of output error"


def numbers_text(numbers: Sequence[float]) -> str:
    """Return numbers with three digits each."""
    return ", ".join(f"{number:.3g}" for number in numbers)


def _information(
    recording: Recording, component: str, record: ComponentRecord
) -> tuple[tuple[float, ...], str]:
    """Check the information in the rows that least squares used."""
    start_time = record.start_time
    regressor = as_columns(recording[f"{component}.regressor"])
    time = recording.time_ns(component) / 1e9
    used = regressor[time >= start_time]
    eigenvalues: tuple[float, ...] = ()
    sentence = "the run ended before the identification began"
    if len(used) >= 2:
        with np.errstate(over="ignore", invalid="ignore"):  # the check behind it names that
            matrix = information(used[:, 1:], float(time[1] - time[0]))
        if not np.isfinite(matrix).all():
            raise LogError(f"'{component}.regressor' has no finite information from its rows")
        values: Vector = np.linalg.eigvalsh(matrix).astype(np.float64)
        prior = None if record.P0 is None else 1.0 / record.P0
        eigenvalues = tuple(map(float, values))
        sentence = describe_excitation(values, prior)
    return eigenvalues, sentence


def span(start: float, end: float) -> str:
    """Return the time of a run as text: its length, or both ends where it does not start at 0."""
    return f"{start:.12g} s to {end:.12g} s" if start else f"{end:.12g} s"
