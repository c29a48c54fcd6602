"""What a recording keeps beside its signals, read back and checked.

A log may come from anywhere: what is read here has the types that the reports rest on.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError

from cosim.arrays import Matrix
from cosim.core.gain.loop_gain import LoopGain
from cosim.core.partial import partial_of
from cosim.core.recorded import find_signal
from cosim.core.recording import Recording
from cosim.core.signals import Channel
from cosim.core.simulation import NEVER_TRUE
from cosim.core.stages.substep_control import SUBSTEP_COUNTS, SubstepCounts
from cosim.errors import LogError
from cosim.log.contents.metadata import read_json
from cosim.scenario.document.schema import Number, NumberRow, NumberRows, Whole, truth_ports
from cosim.units import conversion

Text = Annotated[str, Field(strict=True)]
_Checked = TypeVar("_Checked")


def _as_row(value: object) -> object:
    """Return the number of the one output that older logs tell of as a row."""
    return (value,) if isinstance(value, int | float) else value


def _as_rows(value: object) -> object:
    """Return a row of numbers as the only one."""
    if isinstance(value, list | tuple) and any(isinstance(entry, int | float) for entry in value):
        return (value,)
    return value


OneAnOutput = Annotated[NumberRow, BeforeValidator(_as_row)]
RowAnOutput = Annotated[NumberRows, BeforeValidator(_as_rows)]


class _Record(BaseModel):
    """A table of a recording: more keys than these are kept as they are."""

    model_config = ConfigDict(extra="allow", frozen=True, defer_build=True)


class _SwapRow(_Record):
    """A line of a swap report."""

    port: Text
    aspect: Text
    before: Any
    after: Any
    verdict: Text
    connected: Any
    source: Text | None = None


class _SwapRecord(_Record):
    """A swap report."""

    ports: tuple[_SwapRow, ...] = ()


class LinearizationRecord(_Record):
    """The linearization of an FMU, and what was asked for."""

    request: dict[str, Any]
    result: dict[str, Any]


class WindowRecord(_Record):
    """The window that was chosen for an observer, for what, and what is expected of it."""

    noise: NumberRow
    amplitude: Number
    bandwidth: Number
    half_width_steps: Whole
    order: Whole
    error_by_noise: Number
    error_by_bias: Number
    assumption: Text


class ChoiceRecord(_Record):
    """What was chosen for a component, and what the choice rests on."""

    request: dict[str, Any]
    result: WindowRecord


class BiasRecord(_Record):
    """The leading error of a reconstruction."""

    coefficient: Number
    derivative: Whole
    of: Text


class ReconstructionRecord(_Record):
    """How an observer makes delta, and what that costs."""

    filter: Text
    lag: Number
    bias: BiasRecord
    order: Whole | None = None
    half_width: Number | None = None
    filter_rate: Number | None = None


class CompensationRecord(_Record):
    """What a compensator regulates, and when it uses its internal model."""

    regulated: tuple[Whole, ...]
    internal_model: bool
    interval: NumberRows
    largest_error: Number


class LoopGainRecord(_Record):
    """The gain of a loop, as it was before the run."""

    components: tuple[Text, ...]
    coupling: Text
    h: Annotated[Number, Field(gt=0.0)]
    steps: Annotated[Whole, Field(ge=1)]
    rho: Annotated[Number, Field(ge=0.0)] | None = None
    rate: Number | None = None
    unknown: tuple[Text, ...] = ()
    reason: Text = ""
    action: Text = ""
    parts: Annotated[Whole, Field(ge=1)] = 1

    @property
    def gain(self) -> LoopGain:
        """The gain itself."""
        return LoopGain(
            self.components,
            self.coupling,
            self.h,
            self.steps,
            self.rho,
            self.rate,
            self.unknown,
            self.reason,
            self.action,
            self.parts,
        )


class CodeRecord(_Record):
    """The class of a user that a component was made of, and its source: SHA-256 by file name."""

    class_name: Text = Field(alias="class")
    sources: dict[Text, Text]
    distribution: Text | None = None

    def difference(self, recorded: CodeRecord | None) -> str:
        """Return in words what differs from the code of a recorded run."""
        if recorded is None:
            return f"{self.class_name!r}, and the log does not say what code its run had"
        if self.class_name != recorded.class_name:
            return f"the class {self.class_name!r}, the log's run had {recorded.class_name!r}"
        for file in {**self.sources, **recorded.sources}:
            own = self.sources.get(file, "none, for it is not imported")
            needed = recorded.sources.get(file, "none, for it was not imported")
            if own != needed:
                return f"{file} with the SHA-256 {own}, that of the log's run: {needed}"
        return f"{self.distribution or 'no package'}, the log's run had {recorded.distribution}"


class ComponentRecord(_Record):
    """Metadata of a component; of an identifier with its unknowns, of an FMU with its file.

    The times are those of (36)-(38), all of them or none.
    """

    start_time: Number = 0.0
    method: Text = ""
    unknowns: Whole | None = None
    P0: Annotated[Number, Field(gt=0.0)] | None = None
    T_obs: Number | None = None
    T_f: Number | None = None
    D_max: Number | None = None
    T_id: Number | None = None
    notes: tuple[Text, ...] = ()
    bits: Text | None = None
    swap_report: _SwapRecord = _SwapRecord()
    linearization: LinearizationRecord | None = None
    choice: ChoiceRecord | None = None
    code: CodeRecord | None = None
    lags: dict[Text, Number] = {}
    reconstruction: ReconstructionRecord | None = None
    compensation: CompensationRecord | None = None
    interface_type: Literal["me", "cs"] | None = None
    path: Text | None = None
    sha256: Text | None = None
    noise_gain: NumberRow = ()
    noise_gain_held: NumberRow = ()

    @property
    def is_identifier(self) -> bool:
        """Whether it is the record of an identifier: it has an identification start time."""
        return "start_time" in self.model_fields_set

    @property
    def times(self) -> dict[str, float]:
        """The times of (36)-(38) by name; none where the start was given."""
        times = {"T_obs": self.T_obs, "T_f": self.T_f, "D_max": self.D_max, "T_id": self.T_id}
        return {name: time for name, time in times.items() if time is not None}


class ParameterRecord(_Record):
    """What a log says of one parameter or amplitude: a verdict, no number where there is none."""

    name: Text
    verdict: Text
    value: Number | None = None
    standard_error: Number | None = None
    lower: Number | None = None
    upper: Number | None = None
    reason: Text = ""


class EffectRecord(_Record):
    """What a log says of one theta under an irregular part of the disturbance."""

    name: Text
    first_order: Number
    holds: bool
    is_explained: bool
    lower: Number | None = None
    upper: Number | None = None


class IrregularRecord(_Record):
    """What a log says of an irregular part within a bound, or why nothing."""

    bound: Number
    effects: tuple[EffectRecord, ...] = ()
    confidence: Number = 1.0
    problem: Text = ""


class IdentificationRecord(_Record):
    """What a log says of an identifier at the end of its run.

    ``parameters`` are those of output error, ``amplitudes`` belong to them, those of each data set;
    ``estimate`` is what the identifier says itself, held against them; ``problem`` is why there is
    neither. Deviation of the noise, accuracy and noise model are one an output. ``extent`` is what
    they rest on, where it is not simply all samples.
    """

    parameters: tuple[ParameterRecord, ...] = ()
    amplitudes: tuple[tuple[ParameterRecord, ...], ...] = ()
    estimate: tuple[ParameterRecord, ...] = ()
    deviation: OneAnOutput = ()
    accuracy: OneAnOutput = ()
    is_exact: bool = False
    degrees_of_freedom: Number | None = None
    noise_model: RowAnOutput = ()
    irregular: IrregularRecord | None = None
    extent: Text = ""
    problem: Text = ""


class StepErrorRecord(_Record):
    """What a log says of the error of the step in one element of a signal.

    See :class:`cosim.theory.richardson.StepError`.
    """

    largest: Number | None = None
    time: Number | None = None
    last: Number | None = None
    order: Number | None = None
    reason: Text = ""
    grows: bool = False
    is_rounding: bool = False


class TrialRecord(_Record):
    """A step that was tried: the errors of the signals with tolerances, or why it failed."""

    step: Number
    largest: dict[Text, Number | None] = {}
    failure: Text = ""


class SearchRecord(_Record):
    """How a step was found."""

    tolerances: dict[Text, Number] = {}
    trials: tuple[TrialRecord, ...] = ()


class CertificateRecord(_Record):
    """The certificate of a run: its step, the others, and what they show by element of a signal."""

    step: Number
    finer_steps: NumberRow
    every: Whole
    ends: NumberRow = ()
    problem: Text = ""
    solvers: tuple[Text, ...] = ()
    signals: dict[Text, StepErrorRecord] = {}
    search: SearchRecord | None = None


class ModelRecord(_Record):
    """A model that was read from a file: its path, its hash and its matrices."""

    file: Text
    sha256: Text
    matrices: dict[Text, NumberRows]

    @property
    def arrays(self) -> dict[str, Matrix]:
        """The matrices as arrays."""
        return {name: np.array(rows, np.float64) for name, rows in self.matrices.items()}


class StateChangeRecord(_Record):
    """An initial state that was made consistent: its entry, as it was given, as it is."""

    entry: Text
    before: Number
    after: Number


@dataclass(frozen=True)
class Lateness:
    """How late a run was that should keep the pace of the wall clock.

    Parameters
    ----------
    factor : float
        Simulated time by wall time.
    blocks : int
        Where the pace was looked at.
    late : int
        Of these, those that were complete only after their time.
    largest : float
        Wall time by which the latest of them was [s].
    time : float
        Simulated time there [s].
    """

    factor: float
    blocks: int
    late: int
    largest: float
    time: float


@dataclass(frozen=True)
class ReplayOrigin:
    """What a replay is made from.

    Parameters
    ----------
    log : str
        Path of the log.
    content_hash : str
        The one that its run recorded.
    copied : tuple of str
        The components whose outputs are copied from it; all others are computed.
    window : (float, float) or None
        Where the part of it begins and ends that was recorded [s]; None: all of it was.
    left_out : tuple of str
        Those of ``copied`` that could have been computed, but were not chosen.
    absent : mapping of component name to str
        Of a partial log: components that are neither copied nor computed, and why.
    uncomputed : mapping of component name to str
        Of it: components that a whole log would have computed, and why they are not.
    """

    log: str
    content_hash: str
    copied: tuple[str, ...]
    window: tuple[float, float] | None = None
    left_out: tuple[str, ...] = ()
    absent: Mapping[str, str] = field(default_factory=dict)
    uncomputed: Mapping[str, str] = field(default_factory=dict)


class ConnectionRecord(_Record):
    """The outputs that a connection comes from."""

    sources: Text = Field(alias="from")


# Validators are built when they are first used: a command reads few of these.
_DEFERRED = ConfigDict(defer_build=True)
_TRUTH: TypeAdapter[dict[str, Any]] = TypeAdapter(
    dict[str, Text | tuple[Text, ...] | Number | NumberRow], config=_DEFERRED
)
_WARNINGS: TypeAdapter[list[tuple[str, str]]] = TypeAdapter(
    list[tuple[Text, Text]], config=_DEFERRED
)
_LOOPS: TypeAdapter[list[str]] = TypeAdapter(list[Text], config=_DEFERRED)
_GAINS: TypeAdapter[list[LoopGainRecord]] = TypeAdapter(list[LoopGainRecord], config=_DEFERRED)
_TIME: TypeAdapter[float] = TypeAdapter(Number, config=_DEFERRED)
_IDENTIFICATION: TypeAdapter[dict[str, IdentificationRecord]] = TypeAdapter(
    dict[str, IdentificationRecord], config=_DEFERRED
)
_CONNECTION: TypeAdapter[ConnectionRecord] = TypeAdapter(ConnectionRecord)  # deferred, too
_LATENESS: TypeAdapter[Lateness] = TypeAdapter(Lateness)
_SUBSTEPS: TypeAdapter[tuple[SubstepCounts, ...]] = TypeAdapter(tuple[SubstepCounts, ...])
_MODELS: TypeAdapter[dict[str, ModelRecord]] = TypeAdapter(dict[str, ModelRecord], config=_DEFERRED)
_STATE_CHANGES: TypeAdapter[dict[str, tuple[StateChangeRecord, ...]]] = TypeAdapter(
    dict[str, tuple[StateChangeRecord, ...]], config=_DEFERRED
)
_COMPONENT: TypeAdapter[ComponentRecord] = TypeAdapter(ComponentRecord)  # deferred by its config
_CERTIFICATE: TypeAdapter[CertificateRecord] = TypeAdapter(CertificateRecord)  # the same
# keys among the results of a run
CERTIFICATE: Final = "certificate"
REAL_TIME: Final = "real_time"
_OF_IDENTIFIERS = ("start_time", "P0")
_TIMES = ("T_obs", "T_f", "D_max", "T_id")

# Metadata of components that come from eigenvalues: their last digits depend on the processor.
EIGENVALUE_FIGURES = frozenset(
    {
        "eigenvalues",
        "fixed_modes",
        "lambda_obs",
        "noise_gain",
        "noise_gain_held",
        "T_obs",
        "T_id",
        "start_time",
    }
)


def run_metadata(recording: Recording) -> dict[str, str]:
    """Return the metadata of the run as it was recorded: texts, of which some are JSON."""
    return dict(recording.metadata.get("cosim.run", {}))


def component_metadata(recording: Recording, component: str) -> dict[str, str]:
    """Return the metadata of a component as it was recorded: texts, of which some are JSON."""
    return dict(recording.metadata.get(f"cosim.component.{component}", {}))


def recorded_start(recording: Recording) -> float:
    """Return the start time of a run [s].

    Raises
    ------
    LogError
        If it is no number.
    """
    return _of_run(recording, "start_time", "0.0", _TIME)


def component_table(recording: Recording, component: str) -> dict[str, Any]:
    """Return what a component recorded about itself, as plain values to be shown.

    Raises
    ------
    LogError
        If that cannot be understood.
    """
    component_record(recording, component)
    return dict(_component_json(recording, component))


def component_record(recording: Recording, component: str) -> ComponentRecord:
    """Return what a component recorded about itself.

    Raises
    ------
    LogError
        If that cannot be understood.
    """
    what = f"metadata of {component!r}"
    record = _checked(_COMPONENT, _component_json(recording, component), what)
    known = record.model_fields_set
    if "unknowns" in known and not known.issuperset(_OF_IDENTIFIERS):
        raise LogError(f"{what}: needed {' and '.join(_OF_IDENTIFIERS)} of an identifier")
    if len(record.times) not in (0, len(_TIMES)):
        raise LogError(f"{what}: needed {', '.join(_TIMES)}, or none of them")
    return record


def _component_json(recording: Recording, component: str) -> Any:
    text = component_metadata(recording, component).get("metadata", "{}")
    return _json(text, f"metadata of {component!r}")


def recorded_warnings(recording: Recording) -> list[tuple[str, str]]:
    """Return the warnings of a run, as (component, text).

    Raises
    ------
    LogError
        If they cannot be understood.
    """
    return _of_run(recording, "warnings", "[]", _WARNINGS)


def recorded_identification(recording: Recording) -> dict[str, IdentificationRecord]:
    """Return the verdicts on identifiers at the end of a run, by component.

    Raises
    ------
    LogError
        If they cannot be understood.
    """
    results = recording.results.get("identification", {})
    return _checked(_IDENTIFICATION, results, "results of the identification")


def recorded_certificate(recording: Recording) -> CertificateRecord | None:
    """Return the certificate of a run; None: it has none.

    Raises
    ------
    LogError
        If it cannot be understood.
    """
    content = recording.results.get(CERTIFICATE)
    if content is None:
        return None
    record: CertificateRecord = _checked(_CERTIFICATE, content, CERTIFICATE)
    return record


def recorded_models(recording: Recording) -> dict[str, ModelRecord]:
    """Return the models that were read from files, by name.

    Raises
    ------
    LogError
        If they cannot be understood.
    """
    models = _of_run(recording, "models", "{}", _MODELS)
    for name, record in models.items():
        for letter, rows in record.matrices.items():
            if len({len(row) for row in rows}) != 1:
                raise LogError(f"models: {name}.{letter} has rows of different lengths, or none")
    return models


def recorded_state_changes(recording: Recording) -> dict[str, tuple[StateChangeRecord, ...]]:
    """Return the initial states that were made consistent, by component.

    Raises
    ------
    LogError
        If they cannot be understood.
    """
    results = recording.results.get("initial_states", {})
    return _checked(_STATE_CHANGES, results, "results of the initial states")


def first_order_loops(recording: Recording) -> list[str]:
    """Return the loops of a run whose error is one of first order in the communication step.

    Raises
    ------
    LogError
        If they cannot be understood.
    """
    return _of_run(recording, "first_order_loops", "[]", _LOOPS)


def until_came_true(recording: Recording) -> bool | None:
    """Return whether the condition came true that ends a run; None: the run looked for none."""
    came_true = recording.results.get("until")
    return came_true if isinstance(came_true, bool) else None


def recorded_loop_gains(recording: Recording) -> tuple[LoopGain, ...]:
    """Return the gains of the loops of a run, as they were before it.

    Raises
    ------
    LogError
        If they cannot be understood.
    """
    records = _of_run(recording, "loop_gains", "[]", _GAINS)
    return tuple(record.gain for record in records)


def recorded_lateness(recording: Recording) -> Lateness | None:
    """Return how late a run was that kept the pace of the wall clock; None: it did not.

    Raises
    ------
    LogError
        If it cannot be understood.
    """
    values = recording.results.get(REAL_TIME)
    return None if values is None else _checked(_LATENESS, values, "results of real time")


def recorded_substep_counts(recording: Recording) -> tuple[SubstepCounts, ...]:
    """Return how many substeps the loops of a run took; empty: they took none.

    Raises
    ------
    LogError
        If they cannot be understood.
    """
    values = recording.results.get(SUBSTEP_COUNTS, [])
    return _checked(_SUBSTEPS, values, "results of substeps")


def connected_sources(recording: Recording) -> dict[str, tuple[str, ...]]:
    """Return the outputs that drive each input of a run, by the input.

    Raises
    ------
    LogError
        If they cannot be understood.
    """
    sources = {}
    for to, text in recording.metadata.get("cosim.connections", {}).items():
        what = f"connection to {to!r}"
        connection = _checked(_CONNECTION, _json(text, what), what)
        sources[to] = tuple(connection.sources.split(", "))
    return sources


def never_came_true(recording: Recording) -> tuple[str, ...]:
    """Return the conditions of actions that were not performed, as they never came true."""
    conditions = recording.results.get(NEVER_TRUE, ())
    if not isinstance(conditions, list):
        return ()
    return tuple(text for text in conditions if isinstance(text, str))


def replay_origin(recording: Recording) -> ReplayOrigin:
    """Return what a replay was made from.

    Raises
    ------
    LogError
        If the recording is no replay, or that cannot be understood.
    """
    text = run_metadata(recording).get("replay")
    if text is None:
        raise LogError("this is no replay; needed what cosim.replay() returned")
    return _checked(TypeAdapter(ReplayOrigin), _json(text, "replay"), "replay")


def recorded_window(recording: Recording) -> tuple[float, float] | None:
    """Return the window of a replay [s] whose rows are without those before; None: there is none.

    Raises
    ------
    LogError
        If that cannot be understood.
    """
    if "replay" not in run_metadata(recording):
        return None
    window = replay_origin(recording).window
    if window is None or window[0] == recorded_start(recording):
        return None
    return window


def truth_of(recording: Recording) -> dict[str, Any]:
    """Return what each estimate of a run should equal: a port, a list of ports, or values.

    What was not recorded, or is to be compared with what was not, is left out.

    Raises
    ------
    LogError
        If that cannot be understood, or compared with what was recorded.
    """
    table = _json(run_metadata(recording).get("truth", "{}"), "truth")
    _checked(_TRUTH, table, "truth")
    partial = partial_of(recording.channels)
    kept = {}
    for estimate, truth in table.items():
        names = [estimate, *truth_ports(truth)]
        if partial is not None and not _are_recorded(names, recording.channels, partial.declared):
            continue
        _check_truth(recording, estimate, truth)
        kept[estimate] = truth
    return kept


def _are_recorded(
    names: Iterable[str], channels: Mapping[str, Channel], declared: Mapping[str, Channel]
) -> bool:
    """Return whether all of some signals of a run are recorded.

    Raises
    ------
    LogError
        If one of them is none of the run.
    """
    found = []
    for name in names:
        port = find_signal(declared, name, source="truth")
        component = port.channel.name
        is_there = component in channels and port.signal.name in channels[component].by_name
        found.append(is_there)
    return all(found)


def _check_truth(recording: Recording, estimate: str, truth: Any) -> None:
    estimated = find_signal(recording.channels, estimate, source="truth")
    ports = truth_ports(truth)
    size = len(truth) if isinstance(truth, list) else 1
    if ports:
        size = sum(_comparable_size(recording, port, estimate) for port in ports)
    if size != estimated.size:
        raise LogError(f"truth: {estimate!r} has another size than {truth!r}")


def _comparable_size(recording: Recording, port: str, estimate: str) -> int:
    """Return the size of a true signal, whose unit must be of the same kind."""
    true = find_signal(recording.channels, port, source="truth")
    estimated = find_signal(recording.channels, estimate, source="truth")
    if conversion(true.signal.measure, estimated.signal.measure) is None:
        raise LogError(f"truth: {estimate!r} has another kind of unit than {port!r}")
    return true.size


def _of_run(
    recording: Recording, key: str, default: str, adapter: TypeAdapter[_Checked]
) -> _Checked:
    """Return an entry of the run's metadata, which is JSON; ``default`` where there is none."""
    text = run_metadata(recording).get(key, default)
    return _checked(adapter, _json(text, key), key)


def _json(text: str, what: str) -> Any:
    try:
        return read_json(text)
    except ValueError as error:
        raise LogError(f"{what}: no JSON: {error}") from error


def _checked(adapter: TypeAdapter[_Checked], value: Any, what: str) -> _Checked:
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise LogError(f"{what} cannot be understood: {place}: {first['msg']}") from error
