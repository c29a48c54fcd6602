"""What is said of the components of a run that estimate: identifiers, observers, compensators."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from typing import Any, Final, TypeVar

import numpy as np

from cosim.arrays import Matrix, Vector, as_columns
from cosim.core.recorded.partial import declared_channels, is_recorded_whole
from cosim.core.recording import Recording
from cosim.errors import LogError
from cosim.report.recorded_rows import element_names, has_signal
from cosim.scenario.kinds.run_verdicts import OUTPUT_ERROR
from cosim.scenario.record import (
    Compensation,
    ComponentRecord,
    IdentifierVerdicts,
    IrregularEffect,
    IrregularPart,
    Reconstruction,
    WindowChoice,
    component_record,
    record_label,
    recorded_identification,
    recorded_start,
)
from cosim.theory.assessment.consistency import NOTHING_ELSE
from cosim.theory.disturbances.excitation import describe_excitation, information
from cosim.theory.documents import Bias, ParameterVerdict, Verdict

LAST_PART: Final = 0.25  # of an active time, over which the error that is left is averaged
_OfTheta = TypeVar("_OfTheta", ParameterVerdict, IrregularEffect)


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
        shown = ("estimate", "verdict", "reason", "value", "standard_error", "half_width")
        for key in ("parameters", "reference", "amplitudes"):
            content[key] = [
                {name: getattr(verdict, name) for name in shown} for verdict in getattr(self, key)
            ]
        if self.guaranteed is not None:
            effects = content["guaranteed"]["effects"]
            for effect in effects:
                effect["estimate"] = effect.pop("name")
            content["guaranteed"] = {
                "bound": self.guaranteed.bound,
                "problem": self.guaranteed.problem,
                "effects": effects,
                "confidence": self.guaranteed.confidence,
            }
        return content


@dataclass(frozen=True)
class CompensationSummary:
    """The internal model of a compensator in a run.

    Parameters
    ----------
    component : str
    active_since : float or None
        When it became active [s]; None: it did not.
    reason : str
        Why not.
    theta : tuple of float
        With which theta it became active.
    last_theta : tuple of float
        And with which it ended.
    before : tuple of float
        Root mean square of each regulated error y - r, as measured, until it became active, or of
        the whole run.
    after : tuple of float
        The same of the last time since it became active; empty: it did not.
    since : float
        Where that time begins [s].
    interval : tuple of (lower, upper)
        Of every theta, for which the loop is proven to be stable.
    """

    component: str
    active_since: float | None = None
    reason: str = ""
    theta: tuple[float, ...] = ()
    last_theta: tuple[float, ...] = ()
    before: tuple[float, ...] = ()
    after: tuple[float, ...] = ()
    since: float = 0.0
    interval: tuple[tuple[float, ...], ...] = ()


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
        own, _ = _parameters(name, record, found[name])
        for parameter in own:
            if parameter.verdict == Verdict.INCONSISTENT or parameter.value is None:
                labels.setdefault((parameter.verdict, parameter.reason), []).append(parameter.name)
        for (verdict, reason), names in labels.items():
            yield ", ".join(names), verdict, reason


def summarize_identification(
    recording: Recording, component: str, record: ComponentRecord, found: IdentifierVerdicts
) -> Identification:
    """Summarize what is known of an identifier."""
    eigenvalues: tuple[float, ...] = ()
    sentence = ""
    channels = recording.channels
    if record.unknowns is not None and is_recorded_whole(channels, component, "regressor"):
        eigenvalues, sentence = _information(recording, component, record)
    own, reference = _parameters(component, record, found)
    guaranteed = found.irregular
    if guaranteed is not None:
        guaranteed = replace(guaranteed, effects=_named(component, guaranteed.effects))
    return Identification(
        component,
        record.start_time,
        record.times,
        eigenvalues,
        sentence,
        (*record.notes, *_extent(recording, component, record, found)),
        parameters=own,
        reference=reference,
        amplitudes=tuple(chain.from_iterable(found.amplitudes)),
        undetected=tuple(error.text for error in found.undetected),
        deviation=found.deviation,
        noise=found.problem or noise_text(found),
        guaranteed=guaranteed,
    )


def _parameters(
    component: str, record: ComponentRecord, found: IdentifierVerdicts
) -> tuple[tuple[ParameterVerdict, ...], tuple[ParameterVerdict, ...]]:
    """Return verdicts on theta by the method of an identifier, and by output error beside it."""
    fitted = _named(component, found.parameters)
    if record.method == OUTPUT_ERROR:
        return fitted, ()
    return _named(component, found.estimate), fitted


def _named(component: str, rows: tuple[_OfTheta, ...]) -> tuple[_OfTheta, ...]:
    """Return what is said of each element of theta, with the name of its port."""
    names = element_names(f"{component}.theta", len(rows))
    return tuple(replace(row, name=name) for row, name in zip(rows, names, strict=True))


def _extent(
    recording: Recording, component: str, record: ComponentRecord, found: IdentifierVerdicts
) -> Iterator[str]:
    """Yield what the verdicts rest on, and why the signal theta has no last value beside them."""
    if found.extent:
        yield found.extent
    theta = f"{component}.theta"
    if found.problem or record.method != OUTPUT_ERROR or not has_signal(recording, theta):
        return  # no term has a parameter
    rows = as_columns(recording[theta])
    if len(rows) and np.isfinite(rows[-1]).all():
        return
    end = recording.end_ns / 1e9
    cause = "no fit during the run led to one; the fit after the run did"
    if end < record.start_time:
        cause = f"the run ends at {end:g} s, before the identification start time"
    elif all(parameter.value is None for parameter in found.parameters):
        return  # the verdicts say why
    yield f"{theta} itself has no value at the end: {cause}"


def noise_text(found: IdentifierVerdicts) -> str:
    """Describe the noise of y as the residual of output error shows it."""
    if not found.deviation:
        return ""
    if found.is_exact:
        return (
            f"the residual is at most {NOTHING_ELSE:g} times what step, quantization and rounding "
            f"allow, {numbers_text(found.accuracy)}"
        )
    order = len(found.noise_model[0]) if found.noise_model else 0
    if order:
        rows = "; ".join(map(numbers_text, found.noise_model))
        return f"colored, whitened by an autoregressive model of order {order}: {rows}"
    return "of y, from the residual of output error"


def numbers_text(numbers: Sequence[float]) -> str:
    """Return numbers with three digits each."""
    return ", ".join(f"{number:.3g}" for number in numbers)


def _information(
    recording: Recording, component: str, record: ComponentRecord
) -> tuple[tuple[float, ...], str]:
    """Check the information in the rows that least squares used."""
    regressor = as_columns(recording[f"{component}.regressor"])
    time = recording.time_ns(component) / 1e9
    used = regressor[time >= record.start_time]
    if len(used) < 2:
        return (), "the run ended before the identification began"
    with np.errstate(over="ignore", invalid="ignore"):  # the check behind it names that
        matrix = information(used[:, 1:], float(time[1] - time[0]))
    if not np.isfinite(matrix).all():
        raise LogError(f"'{component}.regressor' has no finite information from its rows")
    values: Vector = np.linalg.eigvalsh(matrix).astype(np.float64)
    prior = None if record.P0 is None else 1.0 / record.P0
    return tuple(values.tolist()), describe_excitation(values, prior)


def summarize_reconstruction(
    recording: Recording, name: str, record: ComponentRecord, design: Reconstruction
) -> DeltaReconstruction:
    """Return what the delta of an observer costs, with its inputs held or interpolated."""
    channel = declared_channels(recording.channels)[name]
    held = recording.held[name][channel.interface.input_columns().get("y", slice(0, 0))]
    shape = (-1, len(held)) if len(held) else (0, 0)
    interpolated = np.array(record.noise_gain)
    zero_order = np.array(record.noise_gain_held)
    if interpolated.size != zero_order.size or interpolated.size % max(len(held), 1):
        what = record_label(recording, f"metadata of {name!r}")
        raise LogError(
            f"{what}: expected as many noise gains as fit to its y, got {interpolated.size}"
        )
    gains = np.where(held, zero_order.reshape(shape), interpolated.reshape(shape))
    parameters = {key: getattr(design, key) for key in ("filter_rate", "order", "half_width")}
    return DeltaReconstruction(
        name,
        design.filter,
        {key: value for key, value in parameters.items() if value is not None},
        design.lag,
        tuple(np.sqrt(np.sum(gains**2, axis=1)).tolist()),
        design.bias,
        None if record.choice is None else record.choice.result,
    )


def summarize_compensation(
    recording: Recording, name: str, record: Compensation
) -> CompensationSummary:
    """Summarize what a compensator did, from its recorded rows.

    Raises
    ------
    LogError
        If these are not those of a compensator.
    """
    label = record_label(recording, f"metadata of {name!r}")
    y = as_columns(recording[f"{name}.y"])
    r = as_columns(recording[f"{name}.r"])
    regulated = list(record.regulated)
    fits = all(0 <= element < y.shape[1] for element in regulated)
    if not fits or r.shape[1] != len(regulated):
        raise LogError(f"{label}: expected regulated outputs of its y as in r, got {regulated}")
    error: Matrix = y[:, regulated] - r
    active = np.flatnonzero(as_columns(recording[f"{name}.active"])[:, 0] > 0.0)
    if not len(active):
        return CompensationSummary(
            name,
            reason=_reason(recording, name, record, label),
            before=_rms(error),
            since=recorded_start(recording),
            interval=record.interval,
        )
    time = recording.time_ns(name) / 1e9
    begin = float(time[active[0]])
    end = float(time[-1])
    since = end - LAST_PART * (end - begin)
    theta: Matrix = np.zeros((len(time), 0))
    if record.interval:
        theta = as_columns(recording[f"{name}.model_theta"])
    return CompensationSummary(
        name,
        active_since=begin,
        theta=tuple(theta[active[0]].tolist()),
        last_theta=tuple(theta[-1].tolist()),
        before=_rms(error[: active[0]]),
        after=_rms(error[time >= since]),
        since=since,
        interval=record.interval,
    )


def _reason(recording: Recording, name: str, record: Compensation, label: str) -> str:
    """Return why the internal model stayed out, by the last estimate."""
    from cosim.theory.compensation.activation import Activation  # rarely needed

    if not record.internal_model:
        return "internal_model = false"
    ends: Matrix = np.array(record.interval, np.float64).reshape(-1, 2)
    estimates = [as_columns(recording[f"{name}.{key}"]) for key in ("theta", "standard_error")]
    if any(rows.shape[1] != len(ends) for rows in estimates):
        raise LogError(f"{label}: expected an interval for each theta, got {len(ends)}")
    if not len(estimates[0]):
        return "it has no rows"
    theta, standard_error = [rows[-1] for rows in estimates]
    activation = Activation(ends[:, 0], ends[:, 1], record.largest_error)
    return activation.reason(theta, standard_error) or "the run ended at the first good estimate"


@np.errstate(over="ignore", invalid="ignore")  # a recording may hold any numbers
def _rms(error: Matrix) -> tuple[float, ...]:
    if not len(error):
        return (float("nan"),) * int(error.shape[1])
    return tuple(np.sqrt(np.mean(error**2, axis=0)).tolist())
