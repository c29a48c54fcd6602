"""What a recording keeps beside its signals, read back and checked."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError

from cosim.core.gain.loop_gain import LoopGain
from cosim.core.recorded.partial import partial_of
from cosim.core.recorded.signals import find_signal
from cosim.core.recording import INNER_STEP, Recording
from cosim.core.signals import Channel
from cosim.core.simulation import NEVER_TRUE
from cosim.core.stages.substep_control import SUBSTEP_COUNTS, SubstepCounts
from cosim.errors import LogError
from cosim.log.contents.metadata import read_json
from cosim.scenario.document.schema import Number, NumberRow, truth_ports
from cosim.scenario.recorded_tables import (
    CertificateRecord,
    ComponentRecord,
    ConnectionRecord,
    IdentificationRecord,
    Lateness,
    LoopGainRecord,
    ModelRecord,
    ReplayOrigin,
    StateChangeRecord,
    Text,
)
from cosim.units import Unit, conversions_between

_Checked = TypeVar("_Checked")

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
MEANS: Final = "means"  # of a component: its inputs that get the mean of both ends of a step
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
        raise LogError(f"{what}: expected {' and '.join(_OF_IDENTIFIERS)} of an identifier")
    if len(record.times) not in (0, len(_TIMES)):
        raise LogError(f"{what}: expected all of {', '.join(_TIMES)}, or none of them")
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

    Where a component keeps an inner step, whatever the communication step is, there is no order.

    Raises
    ------
    LogError
        If they cannot be understood.
    """
    loops = _of_run(recording, "first_order_loops", "[]", _LOOPS)
    keeping = _checked(_LOOPS, recording.results.get(INNER_STEP, []), "results on inner steps")
    return [loop for loop in loops if not set(keeping).intersection(loop.split())]


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
        raise LogError("this is not a replay; expected what cosim.replay() returned")
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
    true_units: list[Unit] = []
    for port in ports:
        true_units += find_signal(recording.channels, port, source="truth").measures
    if (len(true_units) if ports else size) != estimated.size:
        raise LogError(f"truth: {estimate!r} has another size than {truth!r}")
    if ports and None in conversions_between(true_units, estimated.measures):
        raise LogError(f"truth: {estimate!r} has another kind of unit than {truth!r}")


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
        raise LogError(f"{what}: invalid JSON: {error}") from error


def _checked(adapter: TypeAdapter[_Checked], value: Any, what: str) -> _Checked:
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise LogError(f"{what} cannot be understood: {place}: {first['msg']}") from error
