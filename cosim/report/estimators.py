"""What is said of the components of a run that estimate: identifiers, observers, compensators."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from typing import Any, Final, TypeVar

import numpy as np

from cosim.arrays import Matrix, Vector, as_columns
from cosim.core.recorded.partial import declared_channels, is_recorded_whole
from cosim.core.recording import Recording
from cosim.errors import LogError
from cosim.report.recorded_rows import element_names, has_signal, last_value
from cosim.scenario import record
from cosim.scenario.kinds.identified_plant import OUTPUT_ERROR
from cosim.theory.assessment.consistency import NOTHING_ELSE
from cosim.theory.disturbances.excitation import describe_excitation, information
from cosim.theory.documents import Bias, ParameterVerdict, Verdict

LAST_PART: Final = 0.25  # of an active time, over which the error that is left is averaged
_IN_TERM: Final = "in "  # begins the reason of an amplitude that names its term
IF_WRONG: Final = "if it is wrong"  # the model, behind the sentence that says "if it is right"
_ORDINALS: Final = {1: "first", 2: "second", 3: "third"}
_SHOWN: Final = ("estimate", "verdict", "reason", "value", "standard_error", "half_width")
_SHOWN_OF_PART: Final = ("bound", "problem", "effects", "confidence")
_OfTheta = TypeVar("_OfTheta", ParameterVerdict, record.IrregularEffect)


@dataclass(frozen=True)
class DeltaReconstruction:
    """How an observer makes delta, and what that costs."""

    component: str
    filter: str
    parameters: Mapping[str, float]
    lag: float  # s
    noise_gain: tuple[float, ...]  # of the elements of delta, for white noise in each of y
    bias: Bias
    choice: record.WindowChoice | None = None  # of auto

    def lines(self, label: str) -> Iterator[tuple[str, str]]:
        """Yield what delta costs: noise, bias and lag, and what its window was chosen for."""
        kind = f"{self.filter} filter"
        if self.filter != "first-order":  # the scenario has it
            kind += "".join(f", {name} {value:g}" for name, value in self.parameters.items())
        bias = self.bias
        error = "y is not differentiated, no bias"
        if bias.coefficient:
            ordinal = _ORDINALS.get(bias.derivative, f"{bias.derivative}th")
            signal = "the measurement" if bias.of == "G w" else bias.of
            error = f"bias {bias.coefficient:.3g} x {ordinal} derivative of {signal}"
        lag = f"; lag {self.lag:g} s" if self.lag else ""
        yield label, f"{kind}: noise gain {numbers_text(self.noise_gain)} 1/s; {error}{lag}"
        choice = self.choice
        if choice is not None:
            yield (
                "",
                f"chosen for noise of {numbers_text(choice.noise)} in y and delta of "
                f"{choice.amplitude:.3g} up to {choice.bandwidth:.3g} rad/s; expected error "
                f"{choice.error_by_noise:.2g} from noise, {choice.error_by_bias:.2g} from bias; "
                f"{choice.assumption}",
            )


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
    guaranteed: record.IrregularPart | None = None

    def __repr__(self) -> str:
        return f"<Identification by {self.component!r}: {list(self.parameters)}>"

    @property
    def labelled_verdicts(self) -> list[tuple[str, ParameterVerdict]]:
        """All verdicts with their labels; what output error says beside another method says so."""
        return [
            *((one.name, one) for one in self.parameters),
            *((f"{one.name}, output error", one) for one in self.reference),
            *((one.name, one) for one in self.amplitudes),
        ]

    def lines(self, label: str, start: float, end: float) -> Iterator[tuple[str, str]]:
        """Yield when it starts and why, what verdicts rest on, what its data determine, the noise.

        ``start`` and ``end`` are those of the run [s].
        """
        origin = "given"
        if self.times:
            origin = f"start {start:g} s + " if start else ""
            origin += (
                f"observer {self.times['T_obs']:.4f} s + filter {self.times['T_f']:.4f} s + "
                f"longest delay {self.times['D_max']:g} s"
            )
        late = ", after the end of the run" if self.start_time > end else ""
        yield label, f"from {self.start_time:g} s{late} ({origin})"
        yield from verdict_lines(self.labelled_verdicts, self.undetected)
        if self.eigenvalues:
            yield "information matrix", f"eigenvalues {numbers_text(self.eigenvalues)}"
        for text in filter(None, (self.verdict, *self.notes)):
            yield "", text
        if self.noise:
            yield noise_line(self.deviation, self.noise)
        if self.guaranteed is not None:
            yield from guaranteed_lines(self.guaranteed)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        content = asdict(self)
        for key in ("parameters", "reference", "amplitudes"):
            verdicts = getattr(self, key)
            content[key] = [{name: getattr(one, name) for name in _SHOWN} for one in verdicts]
        part = content["guaranteed"]
        if part is not None:
            for effect in part["effects"]:
                effect["estimate"] = effect.pop("name")
            content["guaranteed"] = {name: part[name] for name in _SHOWN_OF_PART}
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

    def lines(self, label: str) -> Iterator[tuple[str, str]]:
        """Yield when the internal model became active, and what is left of the regulated error."""
        error = f"{numbers_text(self.before)} rms"
        text = f"not active: {self.reason}"
        if self.active_since is not None:
            text = f"active from {self.active_since:g} s"
            error += f" before, {numbers_text(self.after)} rms for t >= {self.since:.4g} s"
        if self.theta:
            first = ", ".join(f"{value:.6g}" for value in self.theta)
            last = ", ".join(f"{value:.6g}" for value in self.last_theta)
            text += f" with theta = {first}, at the end {last}; loop proven stable for theta in "
            text += ", ".join(f"[{lower:g}, {upper:g}]" for lower, upper in self.interval)
        yield label, text
        yield "regulated error", f"{error}, as measured"


def bad_verdicts(recording: Recording) -> Iterator[tuple[str, str]]:
    """Yield where estimates contradict the data, or have no value, each with what fails on it.

    That is "inconsistent" or "no-estimate", or empty: no verdict was made.
    """
    verdicts = record.recorded_identification(recording)
    for name in declared_channels(recording.channels):
        about = record.component_record(recording, name)
        if about.is_identifier and name not in verdicts:
            yield "", f"{name}: no verdict was made"
        elif about.is_identifier:
            found = verdicts[name]
            rows = [
                (one.verdict, one.reason, one.name)
                for one in _parameters(name, about, found)[0]
                if one.verdict == Verdict.INCONSISTENT or one.value is None
            ]
            if found.problem:
                rows.append((Verdict.NO_ESTIMATE, found.problem, name))
            for (verdict, reason), names in by_reason(rows).items():
                what = "inconsistent" if verdict == Verdict.INCONSISTENT else "no-estimate"
                yield what, f"{', '.join(names)}: {verdict}: {reason}"


def by_reason(rows: Iterable[tuple[str, str, str]]) -> dict[tuple[str, str], list[str]]:
    """Return the names that are said the same of, by what that is: rows of label, text, name."""
    names: dict[tuple[str, str], list[str]] = {}
    for label, text, name in rows:
        names.setdefault((label, text), []).append(name)
    return names


def identification(
    recording: Recording,
    component: str,
    about: record.ComponentRecord,
    found: record.IdentifierVerdicts,
) -> Identification:
    """Summarize what is known of an identifier."""
    eigenvalues: tuple[float, ...] = ()
    sentence = ""
    if about.unknowns is not None and is_recorded_whole(recording.channels, component, "regressor"):
        eigenvalues, sentence = _information(recording, component, about)
    own, reference = _parameters(component, about, found)
    part = found.irregular
    return Identification(
        component,
        about.start_time,
        about.times,
        eigenvalues,
        sentence,
        notes=(*about.notes, *_extent(recording, component, about, found)),
        parameters=own,
        reference=reference,
        amplitudes=tuple(chain.from_iterable(found.amplitudes)),
        undetected=tuple(map(str, found.undetected)),
        deviation=found.deviation,
        noise=found.problem or noise_text(found),
        guaranteed=None if part is None else replace(part, effects=_named(component, part.effects)),
    )


def _parameters(
    component: str, about: record.ComponentRecord, found: record.IdentifierVerdicts
) -> tuple[tuple[ParameterVerdict, ...], tuple[ParameterVerdict, ...]]:
    """Return verdicts on theta by the method of an identifier, and by output error beside it."""
    fitted = _named(component, found.parameters)
    if about.method == OUTPUT_ERROR:
        return fitted, ()
    return _named(component, found.estimate), fitted


def _named(component: str, rows: tuple[_OfTheta, ...]) -> tuple[_OfTheta, ...]:
    """Return what is said of each element of theta, with the name of its port."""
    names = element_names(f"{component}.theta", len(rows))
    return tuple(replace(row, name=name) for row, name in zip(rows, names, strict=True))


def _extent(
    recording: Recording,
    component: str,
    about: record.ComponentRecord,
    found: record.IdentifierVerdicts,
) -> Iterator[str]:
    """Yield what the verdicts rest on, and why the signal theta has no last value beside them."""
    if found.extent:
        yield found.extent
    theta = f"{component}.theta"
    has_value = any(one.value is not None for one in found.parameters)
    if about.method != OUTPUT_ERROR or not (has_value and has_signal(recording, theta)):
        return
    if not np.isfinite(last_value(recording, theta)).all():
        yield (
            f"{theta} itself has no value at the end: no fit during the run led to one; the fit "
            "after the run did"
        )


def noise_text(found: record.IdentifierVerdicts) -> str:
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


def value_text(value: float | None) -> str:
    """Return an estimate with its sign and six digits."""
    return "no value" if value is None else f"{value:+.6g}"


def verdict_lines(
    verdicts: Sequence[tuple[str, ParameterVerdict]], undetected: Iterable[str]
) -> Iterator[tuple[str, str]]:
    """Yield the reasons of verdicts, each once, what they do not see, and terms of amplitudes.

    Reasons say what they are of where those of a verdict differ.

    Parameters
    ----------
    verdicts : sequence of (label, ParameterVerdict)
    undetected : iterable of str
        Errors of the model that would pass.
    """
    reasons = []
    terms: dict[str, None] = {}
    units: dict[str, None] = {}
    for label, one in verdicts:
        term = one.reason.removeprefix(_IN_TERM)
        if term == one.reason:
            reasons.append((str(one.verdict), one.reason, label))
        elif "[" in term:
            terms[term] = None
        else:
            units[f"{one.name} in {term}"] = None
    groups = by_reason(row for row in reasons if row[1])
    for (verdict, reason), labels in groups.items():
        is_only = sum(verdict == other for other, _ in groups) == 1
        yield verdict, reason if is_only else f"{', '.join(labels)}: {reason}"
    for text in undetected:
        yield IF_WRONG, text
    if terms:
        yield "terms of delta", "; ".join([*terms, *units])


def noise_line(deviation: Sequence[float], noise: str) -> tuple[str, str]:
    """Return the standard deviations of the noise of y, and what is known of it."""
    if deviation:
        noise = f"{numbers_text(deviation)}: {noise}".replace(": of y,", ",", 1)
    return "noise of y", noise


def guaranteed_lines(part: record.IrregularPart) -> Iterator[tuple[str, str]]:
    """Yield what an irregular part of the disturbance within its bound leaves open of theta.

    Of each the interval, whose ends may be missing, and how far the first order reaches.
    """
    label = f"|delta_0| <= {part.bound:g}"
    if part.problem:
        yield label, part.problem
        return
    text = "guaranteed intervals by output error"
    if part.confidence < 1.0:
        text += f", noise within its bounds with probability {part.confidence:g}"
    if part.unsolved:
        text += (
            f"; {part.unsolved} starting points of the linear programs failed or exceeded their "
            "number: there the interval is open"
        )
    yield label, f"{text}:"
    for effect in part.effects:
        lower = "-inf" if effect.lower is None else f"{effect.lower:.6g}"
        upper = "inf" if effect.upper is None else f"{effect.upper:.6g}"
        interval = f"{lower} to {upper}" if effect.is_explained else "none"
        reach = f"first order {effect.first_order:.2g} to each side"
        if not effect.holds:
            reach += ", which does not hold for so large a bound"
        yield effect.name, f"{interval}; {reach}"


def _information(
    recording: Recording, component: str, about: record.ComponentRecord
) -> tuple[tuple[float, ...], str]:
    """Check the information in the rows that least squares used."""
    time = recording.time_ns(component) / 1e9
    used = as_columns(recording[f"{component}.regressor"])[time >= about.start_time]
    if len(used) < 2:
        return (), "the run ended before the identification began"
    with np.errstate(over="ignore", invalid="ignore"):  # the check behind it names that
        matrix = information(used[:, 1:], float(time[1] - time[0]))
    if not np.isfinite(matrix).all():
        raise LogError(f"'{component}.regressor' has no finite information from its rows")
    values: Vector = np.linalg.eigvalsh(matrix).astype(np.float64)
    prior = None if about.P0 is None else 1.0 / about.P0
    return tuple(values.tolist()), describe_excitation(values, prior)


def reconstruction(
    recording: Recording, name: str, about: record.ComponentRecord
) -> DeltaReconstruction:
    """Return what the delta of an observer costs, with its inputs held or interpolated."""
    design = about.reconstruction
    assert design is not None
    channel = declared_channels(recording.channels)[name]
    held = recording.held[name][channel.interface.input_columns().get("y", slice(0, 0))]
    try:
        gains = np.array([about.noise_gain, about.noise_gain_held]).reshape(2, -1, len(held))
    except ValueError as error:
        what = record.record_label(recording, f"metadata of {name!r}")
        got = len(about.noise_gain)
        raise LogError(
            f"{what}: expected as many noise gains as fit to its y, got {got}"
        ) from error
    applied = np.where(held, gains[1], gains[0])
    parameters = {key: getattr(design, key) for key in ("filter_rate", "order", "half_width")}
    return DeltaReconstruction(
        name,
        design.filter,
        {key: value for key, value in parameters.items() if value is not None},
        design.lag,
        tuple(np.sqrt(np.sum(applied**2, axis=1)).tolist()),
        design.bias,
        None if about.choice is None else about.choice.result,
    )


def compensation(
    recording: Recording, name: str, about: record.Compensation
) -> CompensationSummary:
    """Summarize what a compensator did, from its recorded rows.

    Raises
    ------
    LogError
        If these are not those of a compensator.
    """
    label = record.record_label(recording, f"metadata of {name!r}")
    y, r, active = [as_columns(recording[f"{name}.{key}"]) for key in ("y", "r", "active")]
    regulated = list(about.regulated)
    fits = all(0 <= element < y.shape[1] for element in regulated)
    if not fits or r.shape[1] != len(regulated):
        raise LogError(f"{label}: expected regulated outputs of its y as in r, got {regulated}")
    error: Matrix = y[:, regulated] - r
    rows = np.flatnonzero(active[:, 0] > 0.0)
    first = int(rows[0]) if len(rows) else None
    inactive = CompensationSummary(
        name,
        before=_rms(error[:first]),
        since=record.recorded_start(recording),
        interval=about.interval,
    )
    if first is None:
        return replace(inactive, reason=_reason(recording, name, about, label))
    time = recording.time_ns(name) / 1e9
    begin, end = float(time[first]), float(time[-1])
    since = end - LAST_PART * (end - begin)
    theta: Matrix = np.zeros((len(time), 0))
    if about.interval:
        theta = as_columns(recording[f"{name}.model_theta"])
    return replace(
        inactive,
        active_since=begin,
        theta=tuple(theta[first].tolist()),
        last_theta=tuple(theta[-1].tolist()),
        after=_rms(error[time >= since]),
        since=since,
    )


def _reason(recording: Recording, name: str, about: record.Compensation, label: str) -> str:
    """Return why the internal model stayed out, by the last estimate."""
    from cosim.theory.compensation.activation import Activation  # rarely needed

    if not about.internal_model:
        return "internal_model = false"
    ends: Matrix = np.array(about.interval, np.float64).reshape(-1, 2)
    estimates = [as_columns(recording[f"{name}.{key}"]) for key in ("theta", "standard_error")]
    if any(rows.shape[1] != len(ends) for rows in estimates):
        raise LogError(f"{label}: expected an interval for each theta, got {len(ends)}")
    if not len(estimates[0]):
        return "it has no rows"
    theta, standard_error = [rows[-1] for rows in estimates]
    activation = Activation(ends[:, 0], ends[:, 1], about.largest_error)
    return activation.reason(theta, standard_error) or "the run ended at the first good estimate"


@np.errstate(over="ignore", invalid="ignore")  # a recording may hold any numbers
def _rms(error: Matrix) -> tuple[float, ...]:
    if not len(error):
        return (float("nan"),) * int(error.shape[1])
    return tuple(np.sqrt(np.mean(error**2, axis=0)).tolist())
