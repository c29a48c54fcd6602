"""The tables that a recording keeps beside its signals: what each has to have.

A log may come from anywhere: what is read has the types that the reports rest on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from cosim.arrays import Matrix
from cosim.core.gain.loop_gain import LoopGain
from cosim.scenario.document.schema import Number, NumberRow, NumberRows, Whole

Text = Annotated[str, Field(strict=True)]


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
            return f"{self.class_name!r}; the log does not record the code of its run"
        if self.class_name != recorded.class_name:
            return f"the class {self.class_name!r}; the recorded run had {recorded.class_name!r}"
        for file in {**self.sources, **recorded.sources}:
            own = self.sources.get(file, "none (not imported)")
            needed = recorded.sources.get(file, "none (not imported)")
            if own != needed:
                return f"{file} with the SHA-256 {own}; the recorded run had {needed}"
        return f"{self.distribution or 'no package'}; the recorded run had {recorded.distribution}"


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


class UndetectedRecord(_Record):
    """What a log says of an error of the model that would pass the tests of the residual."""

    error: Text
    size: Number
    half_widths: dict[str, Number]
    text: Text


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
    undetected: tuple[UndetectedRecord, ...] = ()
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
    bound: Number | None = None


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
