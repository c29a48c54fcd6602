"""What a log says of its run beside its rows, compared with what a replay computes anew.

A log says many things twice: in its scenario, which a replay runs, and in its metadata, messages
and results, which reports show. A replay computes the latter from the former, so they can be
compared:

* of the run: name, start, step, stop, truth, schedule, connections, and whatever else
  ``cosim.run`` has; the overrides of its inputs, and what followed them;
* of the substeps of loops: which, with what errors, and what components had at their ends; beside
  recorded components only the outputs that are computed again;
* of every component: its table and kind;
* of those that are computed again, too: the tables that they rest on, their designs, their declared
  signals, held inputs, metadata, warnings and messages;
* of the end: the content of ``result.json``, its last row and the verdicts on identifiers included.

Of a partial log a replay may have less than the run had: compared is what it has.

Eigenvalues, and times computed from them, are compared to 1 %; estimates, intervals and designs to
1e-6. Designs only where the log reaches its stop, as one may rest on how long the run is.

A replay takes the rest as it stands, and nothing here is said of it: certificates, the designs,
metadata and messages of what it copies, models from files, why the run ended, the machine; and
warnings and messages of another version of cosim, whose sentences may be others.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from decimal import Decimal
from operator import attrgetter
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.core.contracts import Design
from cosim.core.port import Port
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.signals import MOST_WARNINGS, WARNINGS, DistinctWarnings
from cosim.core.recorders import Memory
from cosim.core.recording import Substep
from cosim.core.signals import Channel, Interface, element_names
from cosim.core.stages.substep_control import SubstepCounts
from cosim.errors import quoted
from cosim.log import Log
from cosim.log.comparison.event_difference import OF_COMPONENTS
from cosim.log.contents.environment import environment_changes
from cosim.log.contents.layout import signals_json
from cosim.log.contents.result import PARTIAL_STATUS, RESULT, RESULT_FILE
from cosim.scenario.actions.settings import recorded_designs as settings_designs
from cosim.scenario.record import (
    EIGENVALUE_FIGURES,
    IdentifierVerdicts,
    component_metadata,
    component_table,
    recorded_identification,
    recorded_substep_counts,
    recorded_warnings,
    run_metadata,
)
from cosim.scenario.recordings.recorded_scenario import recorded_stop
from cosim.theory.assessment.documents import ParameterVerdict

_ALWAYS_COMPARED = (
    "connections",
    "schedule",
    "times",
    "component tables",
    "overrides",
    "substeps",
    "warnings",
)
NOT_COMPARED = (
    "designs of what was not recomputed, models from files and FMUs, error growth of loops, error "
    "estimates, stop reason, machine and time, metadata of FMUs and files"
)

# An n-fold eigenvalue moves by eps**(1/n) with the last bits of its matrix, which depend on the
# processor: by 1e-2 for n = 8.
_EIGENVALUE_RTOL = 1e-2
# of the record of the run: what a replay takes, has of its own, or is compared below
_OTHER_KEYS = {"edits", "format", "replay", "stop", "warnings"}
# what follows from components or signals that a replay may not have
_OF_ALL_KEYS = {"truth", "first_order_loops", "loop_gains", "models"}
# what other processors make of the linear algebra behind a verdict, or a design
_ESTIMATE_RTOL = 1e-6
_OF_LARGEST = 1e-9  # of the largest entry of an array, in addition
# by how much linear programs may miss the ends of intervals, and more
_GUARANTEED_RTOL = 1e-4
_END_KEYS = ("status", "reason", "steps", "end_ns", "content_hash")

_Statement: TypeAlias = tuple[str, Any, Any]  # about what, as recorded, as it should be
DesignPairs: TypeAlias = Mapping[str, tuple[Design, Design]]  # as recorded, and computed anew


@dataclass(frozen=True, slots=True)
class Contradiction:
    """A statement of a log that does not follow from its scenario and rows."""

    statement: str
    found: Any
    expected: Any

    def __str__(self) -> str:
        place, found, expected = _first_difference(self.found, self.expected)
        text = f"{self.statement}{place}: {quoted(found)} in the log"
        return f"{text}, {quoted(expected)} in the replay"


def _first_difference(found: Any, expected: Any) -> tuple[str, Any, Any]:
    """Return where two lists differ first, and what they have there; of others the whole."""
    if not (isinstance(found, list) and isinstance(expected, list) and found and expected):
        return "", found, expected
    for number, (a, b) in enumerate(zip(found, expected, strict=False)):
        if isinstance(a, dict):  # of verdicts, which may differ by rounding
            break
        if a != b:
            return f", entry {number}", a, b
    else:
        common = min(len(found), len(expected))
        return f", from entry {common} on", found[common:], expected[common:]
    return "", found, expected


def contradictions(
    source: Log, again: Log | Memory, computed: Collection[str], designs: DesignPairs
) -> tuple[Contradiction, ...]:
    """Return the statements of a log that its replay contradicts.

    Parameters
    ----------
    source : Log
    again : Log or Memory
        Its replay.
    computed : collection of str
        The components that were computed again.
    designs : mapping of name to (Design, Design)
        As recorded, and computed anew, of what is compared.

    Raises
    ------
    LogError
        If a statement cannot be understood.
    """
    differing = []
    for statement, recorded, expected in _Statements(source, again, computed).pairs():
        if recorded != expected:
            differing.append(Contradiction(statement, recorded, expected))
    for name, (recorded, anew) in designs.items():
        if recorded.keys() == anew.keys():
            differing += _other_entries(f"design of {name!r}", recorded, anew)
    return tuple(differing)


def design_pairs(source: Log, designs: Mapping[str, Design]) -> DesignPairs:
    """Return the recorded design of each component beside that computed anew.

    One of an earlier version of cosim may have other arrays; a replay goes by those.
    """
    recorded = {**source.designs, **settings_designs(source)}
    return {name: (recorded[name], anew) for name, anew in designs.items()}


def _other_entries(what: str, recorded: Design, design: Design) -> list[Contradiction]:
    """Return the first entry in which a design is another one than what was computed anew."""
    for key, array in design.items():
        found = recorded[key]
        scale = _OF_LARGEST * np.abs(array).max(initial=0.0)
        near = np.isclose(found, array, rtol=_ESTIMATE_RTOL, atol=scale, equal_nan=True)
        if not near.all():
            place = tuple(np.argwhere(~near)[0].tolist())
            entry = "".join(f"[{index}]" for index in place)
            numbers = found[place].item(), array[place].item()
            return [Contradiction(f"{what}: {key}{entry}", *numbers)]
    return []


def compared_statements(source: Log, again: Log | Memory, designs: DesignPairs | None) -> str:
    """Return what :func:`contradictions` compares of a log and its replay, in words.

    ``designs``: as there; None: they are not compared.
    """
    statements = _Statements(source, again, ())
    names = list(_ALWAYS_COMPARED)
    if designs is not None:
        pairs = designs.items()
        others = [name for name, (recorded, anew) in pairs if recorded.keys() != anew.keys()]
        kept = f" but that of {', '.join(others)}, of another version of cosim" if others else ""
        names.insert(names.index("component tables") + 1, f"designs{kept}")
    if statements.has_all:
        names.insert(0, "truth")
    if statements.has_last_row:
        names.append("last row")
    if statements.has_verdicts:
        names.append("verdicts")
    if not statements.has_own_words:
        names.remove("warnings")
    text = ", ".join(names)
    if not statements.has_all:
        text += f"; as far as they concern {', '.join(again.channels)}"
    return text


class _Statements:
    """The statements of a log, each beside what its replay says."""

    def __init__(self, source: Log, again: Log | Memory, computed: Collection[str]) -> None:
        self._source = source
        self._again = again
        self._computed = frozenset(computed)
        self._known = declared_channels(again.channels)
        self.has_all = _elements_of(self._known) == _elements_of(declared_channels(source.channels))

    @property
    def has_own_words(self) -> bool:
        """Whether this version of cosim wrote the log; another one may say the same otherwise."""
        return "cosim" not in environment_changes(self._source)

    @property
    def has_last_row(self) -> bool:
        """Whether the log has a last row of its own: a part has none, or that of the whole run."""
        if self._source.status in ("unfinished", PARTIAL_STATUS):
            return False
        return isinstance(self._source.results.get("last"), dict)

    @property
    def has_verdicts(self) -> bool:
        """Whether the replay has a verdict for each that the log has."""
        if self._source.status == "unfinished":
            return False
        recorded = recorded_identification(self._source)
        return recorded.keys() <= recorded_identification(self._again).keys()

    def pairs(self) -> Iterator[_Statement]:
        """Yield them all."""
        yield from self._of_run()
        yield from self._of_connections()
        for name in self._known:
            yield from self._of_component(name)
        if self.has_own_words:
            yield from self._of_messages()
        yield from self._of_substeps()
        yield from self._of_end()
        yield from self._of_identification()

    def _of_run(self) -> Iterator[_Statement]:
        source = self._source
        recorded = run_metadata(source)
        expected = run_metadata(self._again)
        left_out = _OTHER_KEYS if self.has_all else _OTHER_KEYS | _OF_ALL_KEYS
        for key in sorted((expected.keys() | recorded.keys()) - left_out):
            yield key, recorded.get(key), expected.get(key)
        yield "overrides", self._event_bits(source), self._event_bits(self._again)
        stop = recorded_stop(source)
        yield "stop", recorded.get("stop"), repr(stop)
        if source.status == "complete" and not source.reason:
            yield "end of the run [ns]", source.end_ns, int(Decimal(repr(stop)).scaleb(9))
        stages = list(self._again.schedule)
        if self.has_all:
            yield "stages", source.schedule, stages
        else:
            own = [stage for stage in stages if not self._computed.isdisjoint(stage.split())]
            # of those that do not depend on each other, others decide on the order
            yield "stages", sorted(set(source.schedule).intersection(own)), sorted(own)
        step = source.metadata.get("cosim.schedule", {}).get("step_ns")
        yield "step of the schedule [ns]", step, str(source.step_ns)

    def _event_bits(self, run: Log | Memory) -> list[tuple[Any, ...]]:
        """Return the jumps that the replay may have, to the last bit; NaN is equal to itself so."""
        events: list[tuple[Any, ...]] = []
        for event in run.events():
            port = Port.parse(event.signal)
            channel = self._known.get(port.component)
            is_known = channel is not None and (
                event.cause in OF_COMPONENTS or port.find(channel.by_name) is not None
            )
            if self.has_all or is_known:
                values = tuple(value.hex() for value in (*event.values, *event.parameters))
                events.append((event.time_ns, event.cause, event.signal, values))
        return events

    def _of_substeps(self) -> Iterator[_Statement]:
        recorded = _substeps_before(self._source.end_ns, self._source)
        if not self.has_all:
            loops = {counts.components[0] for counts in recorded_substep_counts(self._again)}
            recorded = [substep for substep in recorded if substep.loop in loops]
        expected = _substeps_before(self._source.end_ns, self._again)
        yield "number of substeps", len(recorded), len(expected)
        for found, computed in zip(recorded, expected, strict=False):
            about = f"substep of the loop of {found.loop!r} at t = {found.begin} s"
            yield about, found._replace(values=()), computed._replace(values=())
            for number, (a, b) in enumerate(zip(found.values, computed.values, strict=False)):
                yield f"{about}: value {number}", a.hex(), b.hex()

    def _of_connections(self) -> Iterator[_Statement]:
        recorded = self._source.metadata.get("cosim.connections", {})
        expected = self._again.metadata["cosim.connections"]
        ports = {**expected, **recorded} if self.has_all else expected
        for port in ports:
            yield f"connection to {port!r}", recorded.get(port), expected.get(port)

    def _of_component(self, name: str) -> Iterator[_Statement]:
        source = self._source
        recorded = component_metadata(source, name)
        expected = component_metadata(self._again, name)
        yield f"table of {name!r}", recorded.get("table"), expected["table"]
        kind = json.loads(expected["table"])["kind"]
        yield f"kind of {name!r}", source.kinds.get(name), kind
        declared = declared_channels(source.channels)
        if name not in self._computed or name not in declared:
            return
        what = f"tables that {name!r} rests on"
        yield what, recorded.get("fingerprint"), expected["fingerprint"]
        held = source.held[name].tolist()
        yield f"held inputs of {name!r}", held, self._again.held[name].tolist()
        signals = _declaration(declared[name].interface)
        yield f"signals of {name!r}", signals, _declaration(self._known[name].interface)
        yield from self._of_metadata(name)

    def _of_metadata(self, name: str) -> Iterator[_Statement]:
        recorded = component_table(self._source, name)
        expected = component_table(self._again, name)
        for key in {**expected, **recorded}:
            value = recorded.get(key)
            other = expected.get(key)
            if key not in EIGENVALUE_FIGURES or not _are_close(value, other):
                yield f"{key} of {name!r}", value, other

    def _of_messages(self) -> Iterator[_Statement]:
        warnings = self._own(recorded_warnings(self._source))
        expected_warnings = self._own(recorded_warnings(self._again))
        messages = self._own_messages(self._source)
        expected_messages = self._own_messages(self._again)
        if not self.has_all:  # of what is not here there is no warning
            warnings = [entry for entry in warnings if entry in expected_warnings]
            messages = [entry for entry in messages if entry in expected_messages]
        yield "warnings", warnings, expected_warnings
        yield "messages", messages, expected_messages
        if self._source.status != "complete":
            return
        noted = {warning[1:] for warning in self._source.warnings}
        warned = {one[1:] for one in DistinctWarnings(self._source.messages())}
        if len(noted) < MOST_WARNINGS:
            yield f"{WARNINGS} in {RESULT_FILE}", sorted(noted), sorted(warned)

    def _own(self, texts: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
        """Return the texts of the components that were computed again."""
        return [(name, text) for name, text in texts if name in self._computed]

    def _own_messages(self, run: Log | Memory) -> list[tuple[str, str]]:
        # "run" is how the run ended: a replay ends where the recording does, whatever the reason
        named = [(message.source, message.text) for message in run.messages()]
        return [entry for entry in self._own(named) if entry[0] != "run"]

    def _of_end(self) -> Iterator[_Statement]:
        results = self._source.results
        if self._source.status == "unfinished":
            return
        if not results:
            yield RESULT_FILE, None, "how the run ended, and its last row"
            return
        recorded = self._source.metadata[RESULT]
        for key in _END_KEYS:
            value = results.get(key)
            text = value if value is None else str(value)
            yield f"{key} in {RESULT_FILE}", text, recorded.get(key)
        if self._source.status == "complete":  # else the run may have taken some beyond the end
            counts = recorded_substep_counts(self._source)
            expected_counts = recorded_substep_counts(self._again)
            if not self.has_all:
                loops = [own.components for own in expected_counts]
                counts = tuple(own for own in counts if own.components in loops)
            yield from _of_counts(counts, expected_counts)
        if self._source.status == PARTIAL_STATUS:
            return  # a last row there may be is that of the whole run
        recorded_labels = _labels(self._source.channels)
        own = self._again.results["last"].items()
        expected = {label: value for label, value in own if label in recorded_labels}
        last = results.get("last")
        if last is None and self._source.status in ("failed", "interrupted"):
            return  # on a full disk, or recovered: not even the last rows could be kept
        if not isinstance(last, dict):
            last = {}
        labels = {**expected, **last} if self.has_all else expected
        for label in labels:
            yield f"last row in {RESULT_FILE}: {label}", last.get(label), expected.get(label)

    def _of_identification(self) -> Iterator[_Statement]:
        """Yield the verdicts that differ; a log without any says nothing false of them."""
        recorded = recorded_identification(self._source)
        if not recorded:
            return
        expected = recorded_identification(self._again)
        names = {**expected, **recorded} if self.has_all else expected
        for name in names:
            computed = _parameters(recorded.get(name))
            replayed = _parameters(expected.get(name))
            if not _agree(computed, replayed):
                yield f"verdicts on {name!r}", computed, replayed
            if name in recorded and name in expected:
                yield from _beside_verdicts(name, recorded[name], expected[name])


def _of_counts(
    counts: Sequence[SubstepCounts], expected: Sequence[SubstepCounts]
) -> Iterator[_Statement]:
    """Yield the counts of every loop one by one."""
    what = f"counts of substeps in {RESULT_FILE}"
    loops = [list(own.components) for own in counts]
    yield f"{what}: loops", loops, [list(own.components) for own in expected]
    for own, other in zip(counts, expected, strict=False):
        for field in fields(own)[1:]:
            place = f"{what}: loop of {own.components[0]!r}, {field.name}"
            yield place, getattr(own, field.name), getattr(other, field.name)


def _substeps_before(time_ns: int, run: Log | Memory) -> list[Substep]:
    """Return the substeps that begin before an instant [ns], in one order of the loops."""
    substeps = [substep for substep in run.substeps() if substep.begin_ns < time_ns]
    return sorted(substeps, key=attrgetter("begin", "loop"))


def _labels(channels: Mapping[str, Channel]) -> set[str]:
    """Return the names of all elements, ``component.signal[0]``."""
    labels = set()
    for name, channel in channels.items():
        labels |= {f"{name}.{element}" for element in element_names(channel.signals)}
    return labels


def _elements_of(channels: Mapping[str, Channel]) -> set[tuple[str, str]]:
    """Return all signals by component and name."""
    elements = set()
    for name, channel in channels.items():
        elements |= {(name, signal) for signal in channel.by_name}
    return elements


def _parameters(record: IdentifierVerdicts | None) -> list[dict[str, Any]]:
    """Return what a log says of the parameters of an identifier."""
    if record is None:
        return []
    return _plain((*record.parameters, *record.estimate))


def _beside_verdicts(
    name: str, recorded: IdentifierVerdicts, expected: IdentifierVerdicts
) -> Iterator[_Statement]:
    """Yield amplitudes, errors that pass and intervals that differ, where the log has some."""
    if recorded.amplitudes:
        computed = _amplitudes(recorded)
        replayed = _amplitudes(expected)
        if not _agree(computed, replayed):
            yield f"amplitudes of {name!r}", computed, replayed
    if recorded.undetected:
        computed = _undetected(recorded)
        replayed = _undetected(expected)
        if not _agree(computed, replayed):
            yield f"undetected errors of {name!r}", computed, replayed
    if recorded.irregular is not None:
        computed = _guaranteed(recorded)
        replayed = _guaranteed(expected)
        if not _agree(computed, replayed, rtol=_GUARANTEED_RTOL):
            yield f"guaranteed intervals of {name!r}", computed, replayed


def _guaranteed(record: IdentifierVerdicts) -> list[dict[str, Any]]:
    """Return what a log says of an irregular part of the disturbance, the problem left out."""
    irregular = record.irregular
    if irregular is None:
        return []
    part = {"bound": irregular.bound, "confidence": irregular.confidence}
    return [part, *map(asdict, irregular.effects)]


def _amplitudes(record: IdentifierVerdicts) -> list[dict[str, Any]]:
    """Return what a log says of the amplitudes and phases of an identifier."""
    return _plain(itertools.chain.from_iterable(record.amplitudes))


def _undetected(record: IdentifierVerdicts) -> list[dict[str, Any]]:
    """Return what a log says of errors that would pass, flat and with the texts left out."""
    return [{"error": own.error, "size": own.size, **own.half_widths} for own in record.undetected]


def _plain(parameters: Iterable[ParameterVerdict]) -> list[dict[str, Any]]:
    """Return verdicts as plain values, reasons left out."""
    return [asdict(replace(parameter, reason="")) for parameter in parameters]


def _agree(
    computed: Sequence[dict[str, Any]],
    replayed: Sequence[dict[str, Any]],
    *,
    rtol: float = _ESTIMATE_RTOL,
) -> bool:
    """Return whether verdicts are equal and their numbers equal but for rounding."""
    if len(computed) != len(replayed):
        return False
    for verdict, expected_verdict in zip(computed, replayed, strict=True):
        if verdict.keys() != expected_verdict.keys():
            return False
        for key, value in verdict.items():
            other = expected_verdict[key]
            if isinstance(value, float) and isinstance(other, float):
                if not math.isclose(value, other, rel_tol=rtol, abs_tol=1e-12):
                    return False
            elif value != other:
                return False
    return True


def _declaration(interface: Interface) -> tuple[Any, ...]:
    """Return what a log keeps of an interface."""
    return signals_json(interface), dict(interface.initial), tuple(interface.delayed)


def _are_close(recorded: Any, expected: Any) -> bool:
    """Return whether eigenvalues, or what is computed from them, are equal but for rounding."""
    try:
        a = _complex_numbers(recorded)
        b = _complex_numbers(expected)
    except (TypeError, ValueError):
        return False
    if len(a) != len(b):
        return False
    if not len(a):
        return True
    distances = np.abs(a[:, np.newaxis] - b)  # whatever their order, which rounding changes too
    nearest = max(distances.min(axis=0).max(), distances.min(axis=1).max())
    return bool(nearest <= _EIGENVALUE_RTOL * np.abs(b).max())


def _complex_numbers(values: Any) -> NDArray[np.complex128]:
    entries = values if isinstance(values, list) else [values]
    return np.array([complex(value) for value in entries], np.complex128)
