"""What a log says of its run beside its rows: the documents, and how they are read.

A component may record more keys than these, which are kept as they are: see
:func:`component_table`. All other documents have the keys that are declared, and no others.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import field
from typing import Annotated, Any, Final, Literal, TypeAlias, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from cosim.arrays import Matrix
from cosim.core.gain.loop_gain import LoopGain
from cosim.core.port import named_ports
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.signals import find_signal
from cosim.core.recording import INNER_STEP, Recording
from cosim.core.simulation import NEVER_TRUE
from cosim.core.stages.substep_control import SUBSTEP_COUNTS, SubstepCounts
from cosim.documents import document, plain, told, understood
from cosim.errors import LogError, quoted
from cosim.theory.documents import Bias, ParameterVerdict, StepError, UndetectedError
from cosim.units import conversions_between, units_text
from cosim.version import __version__

MEANS: Final = "means"  # of a component: its inputs that get the mean of both ends of a step
# keys among the results of a run
CERTIFICATE: Final = "certificate"
IDENTIFICATION: Final = "identification"
INITIAL_STATES: Final = "initial_states"
REAL_TIME: Final = "real_time"
UNTIL: Final = "until"
# of components, from eigenvalues: their last digits depend on the processor
EIGENVALUE_FIGURES: Final = frozenset(
    {"eigenvalues", "fixed_modes", "lambda_obs", "noise_gain", "noise_gain_held"}
    | {"T_obs", "T_id", "start_time"}
)
_TIMES: Final = ("T_obs", "T_f", "D_max", "T_id")

_Numbers: TypeAlias = tuple[float, ...]
PortVerdict: TypeAlias = Literal["ok", "unknown", "differs", "error"]
SAME_SIZE: Final = 10.0  # factor up to which two numbers are of one size
_Kind = TypeVar("_Kind")


# --- of components ---


@document
class WindowChoice:
    """The window that was chosen for an observer, for what, and what is expected of it."""

    noise: tuple[float, ...]
    amplitude: float
    bandwidth: float
    half_width_steps: int
    order: int
    error_by_noise: float
    error_by_bias: float
    assumption: str


@document
class RecordedChoice:
    """What was chosen for a component, and what the choice rests on."""

    request: Mapping[str, Any]
    result: WindowChoice


@document
class Reconstruction:
    """How an observer makes delta, and what that costs."""

    filter: str
    lag: float
    bias: Bias
    half_width: float | None = told()
    order: int | None = told()
    filter_rate: float | None = told()


@document
class Compensation:
    """What a compensator regulates, and when it uses its internal model."""

    regulated: tuple[int, ...]
    internal_model: bool
    feedforward: bool = field(default=False, kw_only=True)
    interval: tuple[tuple[float, float], ...]
    largest_error: float


class _Table(BaseModel):
    """A table of a component, whose further keys are kept."""

    model_config = ConfigDict(
        strict=True, allow_inf_nan=False, extra="allow", frozen=True, defer_build=True
    )


class CodeRecord(_Table):
    """The class of a user that a component was made of, and its source: SHA-256 by file name."""

    class_name: str = Field(alias="class")
    sources: dict[str, str]
    distribution: str | None = None

    def difference(self, recorded: CodeRecord | None) -> str:
        """Return in words what differs from the code of a recorded run."""
        if recorded is None:
            return f"{self.class_name!r}; the log does not record the code of its run"
        if self.class_name != recorded.class_name:
            return f"the class {self.class_name!r}; the recorded run had {recorded.class_name!r}"
        for file in {**self.sources, **recorded.sources}:
            own = self.sources.get(file, "none (not imported)")
            needed = recorded.sources.get(file, "none (not imported)")
            if own != needed:
                return f"{file} with the SHA-256 {own}; the recorded run had {needed}"
        return f"{self.distribution or 'no package'}; the recorded run had {recorded.distribution}"


class LinearizationRecord(_Table):
    """The linearization of an FMU, and what was asked for."""

    request: dict[str, Any]
    result: dict[str, Any]


class _Connection(_Table):
    source: str = Field(alias="from")


@document
class ComparedAspect:
    """One aspect of a port in a swapped component and in the one it replaces.

    Parameters
    ----------
    port : str
        Empty: the component as a whole.
    aspect : str
    before, after : plain value; None: unknown, or there is none
    verdict : PortVerdict
    connected : bool
        Whether the scenario names the port.
    ratio : float or None
        Size of the numbers after to that before, in the same unit; None: no numbers, or zeros.
    source : str or None
        What the port stands for in the new component; None: the port of its name.
    """

    port: str
    aspect: str
    before: Any
    after: Any
    verdict: PortVerdict
    connected: bool = True
    ratio: float | None = None
    source: str | None = None

    @property
    def label(self) -> str:
        """The port, and what it stands for in the new component."""
        return port_label(self.port, self.source)

    @property
    def of_another_size(self) -> bool:
        """Whether the numbers differ by so much that the unit is probably another."""
        return self.ratio is not None and not 1.0 / SAME_SIZE <= self.ratio <= SAME_SIZE


def port_label(port: str, source: str | None) -> str:
    """Return a port, and behind an arrow what it stands for in a new component."""
    return port if source is None else f"{port} -> {source}"


class _SwapReport(_Table):
    ports: tuple[ComparedAspect, ...] = ()


class ComponentRecord(_Table):
    """Metadata of a component; of an identifier with its unknowns, of an FMU with its file."""

    start_time: float = 0.0
    method: str = ""
    unknowns: int | None = None
    P0: Annotated[float, Field(gt=0.0)] | None = None
    T_obs: float | None = None
    T_f: float | None = None
    D_max: float | None = None
    T_id: float | None = None
    notes: tuple[str, ...] = ()
    bits: str | None = None
    swap_report: _SwapReport = _SwapReport()
    linearization: LinearizationRecord | None = None
    choice: RecordedChoice | None = None
    code: CodeRecord | None = None
    lags: dict[str, float] = {}
    reconstruction: Reconstruction | None = None
    compensation: Compensation | None = None
    interface_type: Literal["me", "cs"] | None = None
    path: str | None = None
    sha256: str | None = None
    noise_gain: _Numbers = ()
    noise_gain_held: _Numbers = ()

    @property
    def is_identifier(self) -> bool:
        """Whether it is the record of an identifier: it has an identification start time."""
        return "start_time" in self.model_fields_set

    @property
    def times(self) -> dict[str, float]:
        """What an identification waits for, by name [s]; none where the start was given."""
        times = {name: getattr(self, name) for name in _TIMES}
        return {name: time for name, time in times.items() if time is not None}


# --- of runs ---


def _rectangle(rows: tuple[_Numbers, ...]) -> tuple[_Numbers, ...]:
    if len(set(map(len, rows))) != 1:
        raise ValueError("expected rows of one length")
    return rows


@document
class ModelRecord:
    """A model that was read from a file: its path, its hash and its matrices."""

    file: str
    sha256: str
    matrices: Mapping[str, Annotated[tuple[_Numbers, ...], AfterValidator(_rectangle)]]

    @property
    def arrays(self) -> dict[str, Matrix]:
        """The matrices as arrays."""
        return {name: np.array(rows, np.float64) for name, rows in self.matrices.items()}


@document
class _CheckedGain(LoopGain):
    """The gain of a loop as a log has it, with what each figure may be."""

    h: Annotated[float, Field(gt=0.0)]
    steps: Annotated[int, Field(ge=1, lt=2**63)]
    rho: Annotated[float, Field(ge=0.0)] | None = None
    parts: Annotated[int, Field(ge=1)] = told(1)


@document
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


# --- of their ends ---


@document
class IrregularEffect:
    """What an irregular part of the disturbance within a bound leaves open of one theta.

    Parameters
    ----------
    name : str
    first_order : float
        Half width around the estimate.
    holds : bool
        Whether the first order does: the truths behind this estimate reach as far to both sides.
    is_explained : bool
        Whether any theta explains the data with this bound.
    lower, upper : float or None
        What the data and the estimate allow; None: no theta, or there is no end.
    """

    name: str
    first_order: float
    holds: bool
    is_explained: bool
    lower: float | None = None
    upper: float | None = None


@document
class IrregularPart:
    """What ``|delta_0| <= bound`` leaves open.

    Parameters
    ----------
    bound : float
    effects : tuple of IrregularEffect
    confidence : float
        Probability of the bounds of the noise.
    unsolved : int
        Searches whose linear programs could not be solved, or not within those that there may be;
        with any the data alone show no end.
    problem : str
        Why nothing is known.
    """

    bound: float
    effects: tuple[IrregularEffect, ...] = ()
    confidence: float = 1.0
    unsolved: int = 0
    problem: str = told("")

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        if self.problem:
            return {"bound": self.bound, "problem": self.problem}
        return plain(self)


@document
class IdentifierVerdicts:
    """What a log says of an identifier at the end of its run.

    ``parameters`` are those of output error, ``amplitudes`` belong to them, those of each data set;
    ``estimate`` is what the identifier says itself, held against them; ``problem`` is why there is
    neither. Deviation of the noise, accuracy and noise model are one an output. ``extent`` is what
    they rest on, where it is not simply all samples.
    """

    parameters: tuple[ParameterVerdict, ...] = ()
    correlation: tuple[tuple[float, ...], ...] = ()
    deviation: _Numbers = ()
    accuracy: _Numbers = ()
    degrees_of_freedom: float | None = None
    is_exact: bool = False
    noise_model: tuple[_Numbers, ...] = ()
    tests: tuple[Mapping[str, Any], ...] = ()
    extent: str = told("")
    amplitudes: tuple[tuple[ParameterVerdict, ...], ...] = ()
    undetected: tuple[UndetectedError, ...] = ()
    estimate: tuple[ParameterVerdict, ...] = ()
    irregular: IrregularPart | None = told()
    problem: str = told("")

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {"problem": self.problem} if self.problem else plain(self)


@document
class StepTrial:
    """A step that was tried [s]: the errors of the signals with tolerances, or why it failed."""

    step: float
    largest: Mapping[str, float | None] = field(default_factory=dict)
    failure: str = ""


@document
class StepSearch:
    """How a step was found."""

    tolerances: Mapping[str, float] = field(default_factory=dict)
    trials: tuple[StepTrial, ...] = ()


@document
class RecordedCertificate:
    """The certificate of a run: its step, the others, and what they show by element of a signal.

    Parameters
    ----------
    step : float
        Of the run [s].
    finer_steps : tuple of float
        Of the others [s].
    ends : tuple of float
        The instants [s] at which the runs ended; they were compared up to the first.
    every : int
        Every so many communication points were compared.
    problem : str
        Why nothing was compared; empty where something was.
    solvers : tuple of str
        Components whose own solvers err too: that is in the figures.
    signals : mapping of element of a signal to StepError
    search : StepSearch or None
        None: the scenario gives the step.
    """

    step: float
    finer_steps: tuple[float, ...]
    ends: tuple[float, ...] = ()
    every: int = field(kw_only=True)
    problem: str = ""
    solvers: tuple[str, ...] = ()
    signals: Mapping[str, StepError] = field(default_factory=dict)
    search: StepSearch | None = told()


@document
class StateChange:
    """An initial state that was made consistent: its entry, as it was given, as it is."""

    entry: str
    before: float
    after: float
    component: str = told("")  # in a summary


@document
class Lateness:
    """How late a run was that should keep the pace of the wall clock.

    As text it says how late.

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

    def __str__(self) -> str:
        pace = f"{self.factor:g} x the wall clock"
        if not self.late:
            return f"{pace}; never late in {self.blocks} blocks"
        return (
            f"{pace}; late in {self.late} of {self.blocks} blocks, at most by "
            f"{self.largest:.3g} s, at t = {self.time:g} s"
        )


# --- read ---


def record_label(recording: Recording, record: str) -> str:
    """Return where a record is, for messages; with its version where that is not this one."""
    written_by = recording.metadata.get("cosim.env", {}).get("cosim", __version__)
    version = "" if written_by == __version__ else f" (written by cosim {written_by})"
    return f"{recording.label}{version}: {record}"


def run_metadata(recording: Recording) -> dict[str, str]:
    """Return the metadata of the run as it was recorded: texts, of which some are JSON."""
    return dict(recording.metadata.get("cosim.run", {}))


def component_metadata(recording: Recording, component: str) -> dict[str, str]:
    """Return the metadata of a component as it was recorded: texts, of which some are JSON."""
    return dict(recording.metadata.get(f"cosim.component.{component}", {}))


def component_table(recording: Recording, component: str) -> dict[str, Any]:
    """Return all that a component recorded about itself, as plain values.

    Raises
    ------
    LogError
        If that cannot be understood; as all that follow.
    """
    component_record(recording, component)
    table: dict[str, Any] = json.loads(
        component_metadata(recording, component).get("metadata", "{}")
    )
    return table


def component_record(recording: Recording, component: str) -> ComponentRecord:
    """Return what a component recorded about itself."""
    what = record_label(recording, f"metadata of {component!r}")
    text = component_metadata(recording, component).get("metadata", "{}")
    record = understood(ComponentRecord, text, what)
    if record.unknowns is not None and not {"start_time", "P0"} <= record.model_fields_set:
        raise LogError(f"{what}: expected start_time and P0 of an identifier")
    if len(record.times) not in (0, len(_TIMES)):
        raise LogError(f"{what}: expected all of {', '.join(_TIMES)}, or none of them")
    return record


def recorded_start(recording: Recording) -> float:
    """Return the start time of a run [s]."""
    return _of_run(recording, "start_time", float) or 0.0


def recorded_warnings(recording: Recording) -> list[tuple[str, str]]:
    """Return the warnings of a run, as (component, text)."""
    return _of_run(recording, "warnings", list[tuple[str, str]]) or []


def recorded_models(recording: Recording) -> dict[str, ModelRecord]:
    """Return the models that were read from files, by name."""
    return _of_run(recording, "models", dict[str, ModelRecord]) or {}


def recorded_loop_gains(recording: Recording) -> tuple[LoopGain, ...]:
    """Return the gains of the loops of a run, as they were before it."""
    gains = _of_run(recording, "loop_gains", tuple[_CheckedGain, ...]) or ()
    return tuple(LoopGain(**vars(gain)) for gain in gains)


def first_order_loops(recording: Recording) -> list[str]:
    """Return the loops of a run whose error is one of first order in the communication step.

    Where a component keeps an inner step, whatever the communication step is, there is no order.
    """
    loops = _of_run(recording, "first_order_loops", list[str]) or []
    keeping = _result(recording, INNER_STEP, list[str]) or []
    return [loop for loop in loops if not set(keeping).intersection(loop.split())]


def recorded_identification(recording: Recording) -> dict[str, IdentifierVerdicts]:
    """Return the verdicts on identifiers at the end of a run, by component."""
    return _result(recording, IDENTIFICATION, dict[str, IdentifierVerdicts]) or {}


def recorded_certificate(recording: Recording) -> RecordedCertificate | None:
    """Return the certificate of a run; None: it has none."""
    return _result(recording, CERTIFICATE, RecordedCertificate)


def recorded_state_changes(recording: Recording) -> dict[str, tuple[StateChange, ...]]:
    """Return the initial states that were made consistent, by component."""
    return _result(recording, INITIAL_STATES, dict[str, tuple[StateChange, ...]]) or {}


def recorded_lateness(recording: Recording) -> Lateness | None:
    """Return how late a run was that kept the pace of the wall clock; None: it did not."""
    return _result(recording, REAL_TIME, Lateness)


def recorded_substep_counts(recording: Recording) -> tuple[SubstepCounts, ...]:
    """Return how many substeps the loops of a run took; empty: they took none."""
    counts = _result(recording, SUBSTEP_COUNTS, tuple[SubstepCounts, ...]) or ()
    if not all(own.components for own in counts):
        what = record_label(recording, SUBSTEP_COUNTS)
        raise LogError(f"{what} cannot be understood: expected the components of loops, got none")
    return counts


def until_came_true(recording: Recording) -> bool | None:
    """Return whether the condition came true that ends a run; None: the run looked for none."""
    return _result(recording, UNTIL, bool)


def never_came_true(recording: Recording) -> tuple[str, ...]:
    """Return the conditions of actions that were not performed, as they never came true."""
    return _result(recording, NEVER_TRUE, tuple[str, ...]) or ()


def connected_sources(recording: Recording) -> dict[str, tuple[str, ...]]:
    """Return the outputs that drive each input of a run, by the input."""
    sources = {}
    for to, text in recording.metadata.get("cosim.connections", {}).items():
        what = record_label(recording, f"connection to {to!r}")
        sources[to] = tuple(understood(_Connection, text, what).source.split(", "))
    return sources


def replay_origin(recording: Recording) -> ReplayOrigin:
    """Return what a replay was made from."""
    origin = _of_run(recording, "replay", ReplayOrigin)
    if origin is None:
        raise LogError("this is not a replay; expected what cosim.replay() returned")
    return origin


def recorded_window(recording: Recording) -> tuple[float, float] | None:
    """Return the window of a replay [s] without the rows before it; None: there is none."""
    origin = _of_run(recording, "replay", ReplayOrigin)
    if origin is None or origin.window is None:
        return None
    return None if origin.window[0] == recorded_start(recording) else origin.window


def truth_of(recording: Recording) -> dict[str, Any]:
    """Return what each estimate of a run should equal: a port, a list of ports, or values.

    What was not recorded, or is to be compared with what was not, is left out.
    """
    kind = dict[str, str | list[str] | float | list[float]]
    channels = recording.channels
    kept = {}
    for estimate, truth in (_of_run(recording, "truth", kind) or {}).items():
        label = record_label(recording, f"truth: {estimate!r}")
        names = (estimate, *named_ports(truth))
        known = [find_signal(declared_channels(channels), name, source=label) for name in names]
        units, *of_ports = [port.measures for port in known]
        true_units = [unit for measures in of_ports for unit in measures]
        if len(units) != (len(true_units) if of_ports else np.size(truth)):
            raise LogError(f"{label}: expected {len(units)} values, got {quoted(truth)}")
        if of_ports and None in conversions_between(true_units, units):
            raise LogError(
                f"{label}: expected the unit {units_text(units)!r}, got {units_text(true_units)!r}"
            )
        if all(
            port.channel.name in channels
            and port.signal.name in channels[port.channel.name].by_name
            for port in known
        ):
            kept[estimate] = truth
    return kept


def _of_run(recording: Recording, key: str, kind: type[_Kind]) -> _Kind | None:
    """Return an entry of the run's metadata, which is JSON; None: there is none."""
    text = run_metadata(recording).get(key)
    return None if text is None else understood(kind, text, record_label(recording, key))


def _result(recording: Recording, key: str, kind: type[_Kind]) -> _Kind | None:
    """Return an entry of the results of a run; None: there is none."""
    if key not in recording.results:
        return None
    value = recording.results[key]
    what = record_label(recording, key)
    try:
        text = json.dumps(value)
    except RecursionError as error:
        raise LogError(f"{what} cannot be understood: expected less nesting") from error
    return understood(kind, text, what)
