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

import json
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from decimal import Decimal
from functools import partial
from itertools import chain
from operator import attrgetter
from typing import Any, Final, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from cosim.core.contracts import Design
from cosim.core.port import Port
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.signals import MOST_WARNINGS, WARNINGS, DistinctWarnings
from cosim.core.recorders import Memory
from cosim.core.recording import Substep
from cosim.core.signals import Channel, Interface, element_names
from cosim.documents import plain
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


@final
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
        yield from self._each(
            "connection to {!r}", lambda run: run.metadata.get("cosim.connections", {})
        )
        for name in self._known:
            yield from self._of_component(name)
        if self.has_own_words:
            yield from self._of_messages()
        yield from self._of_substeps()
        if self._source.status != "unfinished":
            yield from self._of_end()
        yield from self._of_identification()

    def _both(self, what: str, said: Callable[[Log | Memory], Any]) -> _Statement:
        return what, said(self._source), said(self._again)

    def _each(
        self, what: str, said: Callable[[Log | Memory], Mapping[str, Any]]
    ) -> Iterator[_Statement]:
        """Yield what both say by key; of a partial replay what it says."""
        _, recorded, expected = self._both(what, said)
        for key in {**expected, **recorded} if self.has_all else expected:
            yield what.format(key), recorded.get(key), expected.get(key)

    def _of_run(self) -> Iterator[_Statement]:
        source = self._source
        left_out = _OTHER_KEYS if self.has_all else _OTHER_KEYS | _OF_ALL_KEYS
        of_runs = run_metadata(source), run_metadata(self._again)
        for key in sorted({**of_runs[0], **of_runs[1]}.keys() - left_out):
            yield key, of_runs[0].get(key), of_runs[1].get(key)
        yield self._both("overrides", self._event_bits)
        stop = repr(recorded_stop(source))
        yield "stop", of_runs[0].get("stop"), stop
        if source.status == "complete" and not source.reason:
            yield "end of the run [ns]", source.end_ns, int(Decimal(stop).scaleb(9))
        yield self._both("stages", self._stages)
        step = source.metadata.get("cosim.schedule", {}).get("step_ns")
        yield "step of the schedule [ns]", step, str(source.step_ns)

    def _stages(self, run: Log | Memory) -> list[str]:
        stages = list(run.schedule)
        if self.has_all:
            return stages
        own = [one for one in self._again.schedule if not self._computed.isdisjoint(one.split())]
        # of those that do not depend on each other, others decide on the order
        return sorted(set(stages).intersection(own))

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

    def _of_component(self, name: str) -> Iterator[_Statement]:
        own = partial(component_metadata, component=name)
        table = component_metadata(self._again, name)["table"]
        yield f"table of {name!r}", own(self._source).get("table"), table
        yield f"kind of {name!r}", self._source.kinds.get(name), json.loads(table)["kind"]
        declared = declared_channels(self._source.channels)
        if name not in self._computed or name not in declared:
            return
        what = f"tables that {name!r} rests on"
        yield self._both(what, lambda run: own(run).get("fingerprint"))
        yield self._both(f"held inputs of {name!r}", lambda run: run.held[name].tolist())
        signals = _declaration(declared[name].interface)
        yield f"signals of {name!r}", signals, _declaration(self._known[name].interface)
        _, recorded, expected = self._both("", lambda run: component_table(run, name))
        for key in {**expected, **recorded}:
            value, other = recorded.get(key), expected.get(key)
            if key not in EIGENVALUE_FIGURES or not _are_close(value, other):
                yield f"{key} of {name!r}", value, other

    def _of_messages(self) -> Iterator[_Statement]:
        for what, texts in (("warnings", recorded_warnings), ("messages", _named_messages)):
            found, expected = (
                [one for one in texts(run) if one[0] in self._computed]
                for run in (self._source, self._again)
            )
            if not self.has_all:  # of what is not here there is no warning
                found = [entry for entry in found if entry in expected]
            yield what, found, expected
        if self._source.status == "complete":
            noted = {warning[1:] for warning in self._source.warnings}
            warned = {one[1:] for one in DistinctWarnings(self._source.messages())}
            if len(noted) < MOST_WARNINGS:
                yield f"{WARNINGS} in {RESULT_FILE}", sorted(noted), sorted(warned)

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

    def _of_end(self) -> Iterator[_Statement]:
        results = self._source.results
        if not results:
            yield RESULT_FILE, None, "how the run ended, and its last row"
            return
        recorded = self._source.metadata[RESULT]
        for key in _END_KEYS:
            value = results.get(key)
            text = value if value is None else str(value)
            yield f"{key} in {RESULT_FILE}", text, recorded.get(key)
        if self._source.status == "complete":  # else the run may have taken some beyond the end
            yield from self._of_counts()
        last = results.get("last")
        if self._source.status == PARTIAL_STATUS:
            return  # a last row there may be is that of the whole run
        if last is None and self._source.status in ("failed", "interrupted"):
            return  # on a full disk, or recovered: not even the last rows could be kept
        recorded_labels = _labels(self._source.channels)
        of_replay = self._again.results["last"].items()
        expected = {label: value for label, value in of_replay if label in recorded_labels}
        found = last if isinstance(last, dict) else {}
        for label in {**expected, **found} if self.has_all else expected:
            yield f"last row in {RESULT_FILE}: {label}", found.get(label), expected.get(label)

    def _of_counts(self) -> Iterator[_Statement]:
        """Yield the counts of every loop one by one."""
        what = f"counts of substeps in {RESULT_FILE}"
        _, found, expected = self._both(what, recorded_substep_counts)
        if not self.has_all:
            there = [own.components for own in expected]
            found = [own for own in found if own.components in there]
        loops = [list(own.components) for own in found]
        yield f"{what}: loops", loops, [list(own.components) for own in expected]
        for own, other in zip(found, expected, strict=False):
            for field in fields(own)[1:]:
                place = f"{what}: loop of {own.components[0]!r}, {field.name}"
                yield place, getattr(own, field.name), getattr(other, field.name)

    def _of_identification(self) -> Iterator[_Statement]:
        """Yield the verdicts that differ; a log without any says nothing false of them."""
        if not recorded_identification(self._source):
            return
        for name, recorded, expected in self._each("{}", recorded_identification):
            for what, (part, rtol) in _OF_VERDICTS.items():
                found, computed = part(recorded or _NOTHING), part(expected or _NOTHING)
                is_said = found or what == _VERDICTS  # older logs have not all the others
                if is_said and not _agree(found, computed, rtol):
                    yield f"{what} {name!r}", found, computed


def _named_messages(run: Log | Memory) -> list[tuple[str, str]]:
    # "run" is how the run ended: a replay ends where the recording does, whatever the reason
    named = [(message.source, message.text) for message in run.messages()]
    return [entry for entry in named if entry[0] != "run"]


def _substeps_before(time_ns: int, run: Log | Memory) -> list[Substep]:
    """Return the substeps that begin before an instant [ns], in one order of the loops."""
    substeps = [substep for substep in run.substeps() if substep.begin_ns < time_ns]
    return sorted(substeps, key=attrgetter("begin", "loop"))


def _labels(channels: Mapping[str, Channel]) -> set[str]:
    """Return the names of all elements, ``component.signal[0]``."""
    return {
        f"{name}.{element}"
        for name, channel in channels.items()
        for element in element_names(channel.signals)
    }


def _elements_of(channels: Mapping[str, Channel]) -> set[tuple[str, str]]:
    """Return all signals by component and name."""
    return {(name, signal) for name, channel in channels.items() for signal in channel.by_name}


def _declaration(interface: Interface) -> tuple[Any, ...]:
    """Return what a log keeps of an interface."""
    return signals_json(interface), dict(interface.initial), tuple(interface.delayed)


# --- verdicts ---


def _plain(verdicts: Iterable[ParameterVerdict]) -> list[dict[str, Any]]:
    """Return verdicts as plain values, reasons left out."""
    return [plain(replace(one, reason="")) for one in verdicts]


def _undetected(said: IdentifierVerdicts) -> list[dict[str, Any]]:
    """Return errors that would pass, flat and with the texts left out."""
    return [{"error": own.error, "size": own.size, **own.half_widths} for own in said.undetected]


def _guaranteed(said: IdentifierVerdicts) -> list[dict[str, Any]]:
    """Return what is said of an irregular part of the disturbance, the problem left out."""
    part = said.irregular
    if part is None:
        return []
    return [{"bound": part.bound, "confidence": part.confidence}, *map(plain, part.effects)]


_NOTHING: Final = IdentifierVerdicts()
_VERDICTS: Final = "verdicts on"
_OF_VERDICTS: Final[Mapping[str, tuple[Callable[[IdentifierVerdicts], Any], float]]] = {
    _VERDICTS: (lambda said: _plain((*said.parameters, *said.estimate)), _ESTIMATE_RTOL),
    "amplitudes of": (lambda said: _plain(chain(*said.amplitudes)), _ESTIMATE_RTOL),
    "undetected errors of": (_undetected, _ESTIMATE_RTOL),
    "guaranteed intervals of": (_guaranteed, _GUARANTEED_RTOL),
}


def _agree(found: Any, expected: Any, rtol: float) -> bool:
    """Return whether verdicts are equal, and their numbers equal but for rounding."""
    match found, expected:
        case dict(), dict():
            return found.keys() == expected.keys() and all(
                _agree(value, expected[key], rtol) for key, value in found.items()
            )
        case list(), list():
            is_as_long = len(found) == len(expected)
            pairs = zip(found, expected, strict=False)
            return is_as_long and all(_agree(a, b, rtol) for a, b in pairs)
        case float(), float():
            return math.isclose(found, expected, rel_tol=rtol, abs_tol=1e-12)
    return bool(found == expected)


def _are_close(recorded: Any, expected: Any) -> bool:
    """Return whether eigenvalues, or what is computed from them, are equal but for rounding."""
    try:
        a, b = map(_complex_numbers, (recorded, expected))
    except (TypeError, ValueError):
        return False
    if len(a) != len(b) or not len(a):
        return len(a) == len(b)
    distances = np.abs(a[:, np.newaxis] - b)  # whatever their order, which rounding changes too
    nearest = max(distances.min(axis=0).max(), distances.min(axis=1).max())
    return bool(nearest <= _EIGENVALUE_RTOL * np.abs(b).max())


def _complex_numbers(values: Any) -> NDArray[np.complex128]:
    entries = values if isinstance(values, list) else [values]
    return np.array([complex(value) for value in entries], np.complex128)
