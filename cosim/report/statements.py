"""What a log says of its run beside its rows, compared with what a replay computes anew.

A log says many things twice: in its scenario, which a replay runs, and in its metadata, messages
and results, which reports show. A replay computes the latter from the former, so what the two say
is compared as two trees, sections of statements, with a few rules (``_agree``) for what may differ
by rounding:

* of the run: name, start, step, stop, truth, schedule, connections, and whatever else
  ``cosim.run`` has; the overrides of its inputs, and what followed them;
* of every component: its table and kind;
* of those that are computed again, too: the tables that they rest on, their designs, their declared
  signals, held inputs, metadata, warnings and messages;
* of the substeps of loops: which, with what errors, and what components had at their ends; beside
  recorded components only the outputs that are computed again;
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
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass
from decimal import Decimal
from typing import Any, Final, TypeAlias, final

import numpy as np

from cosim.core.contracts import Design
from cosim.core.port import Port
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.signals import MOST_WARNINGS, WARNINGS, DistinctWarnings
from cosim.core.recorders import Memory
from cosim.core.signals import Channel, element_names
from cosim.documents import plain
from cosim.errors import quoted
from cosim.log import Log
from cosim.log.comparison.event_difference import OF_COMPONENTS
from cosim.log.contents.environment import environment_changes
from cosim.log.contents.layout import signals_json
from cosim.log.contents.result import PARTIAL_STATUS, RESULT, RESULT_FILE
from cosim.scenario.building.settings import recorded_designs as settings_designs
from cosim.scenario.record import (
    EIGENVALUE_FIGURES,
    component_metadata,
    component_table,
    recorded_identification,
    recorded_substep_counts,
    recorded_warnings,
    run_metadata,
)
from cosim.scenario.recordings.recorded_scenario import recorded_stop

NOT_COMPARED = (
    "designs of what was not recomputed, models from files and FMUs, error growth of loops, error "
    "estimates, stop reason, machine and time, metadata of FMUs and files"
)

# of the record of the run: what a replay takes, has of its own, or is compared below
_OTHER_KEYS = {"edits", "format", "replay", "stop", "warnings"}
# what follows from components or signals that a replay may not have
_OF_ALL_KEYS = {"truth", "first_order_loops", "loop_gains", "models"}
_END_KEYS = ("status", "reason", "steps", "end_ns", "content_hash")
# what other processors make of the linear algebra behind a verdict, or a design
_ESTIMATE_RTOL = 1e-6
_OF_LARGEST = 1e-9  # of the largest entry of an array, in addition
# by how much linear programs may miss the ends of intervals, and more
_GUARANTEED_RTOL = 1e-4
# An n-fold eigenvalue moves by eps**(1/n) with the last bits of its matrix, which depend on the
# processor: by 1e-2 for n = 8.
_EIGENVALUE_RTOL = 1e-2

Tree: TypeAlias = Mapping[str, Mapping[str, Any]]  # what is said, by section and statement


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
    are_lists = isinstance(found, list) and isinstance(expected, list) and found and expected
    if not are_lists or isinstance(found[0], dict):  # of verdicts, which may differ by rounding
        return "", found, expected
    for number, (a, b) in enumerate(zip(found, expected, strict=False)):
        if a != b:
            return f", entry {number}", a, b
    common = min(len(found), len(expected))
    return f", from entry {common} on", found[common:], expected[common:]


@final
class Statements:
    """What a log says of its run, beside what its replay says.

    Parameters
    ----------
    source : Log
    again : Log or Memory
        Its replay.
    computed : collection of str
        The components that were computed again.
    designs : mapping of name to Design, or None
        Those that the replay took from the log, computed anew; None: they are not compared.

    Raises
    ------
    LogError
        If a statement cannot be understood.
    """

    def __init__(
        self,
        source: Log,
        again: Log | Memory,
        computed: Collection[str],
        designs: Mapping[str, Design] | None,
    ) -> None:
        self._source = source
        self._again = again
        self._known = declared_channels(again.channels)
        declared = declared_channels(source.channels)
        self._computed = [name for name in self._known if name in computed and name in declared]
        self._designs: Mapping[str, tuple[Design, Design]] | None = None
        if designs is not None:
            recorded = {**source.designs, **settings_designs(source)}
            self._designs = {name: (recorded[name], anew) for name, anew in designs.items()}
        # whether the replay has all signals of the run
        self._has_all = _signals_of(self._known) == _signals_of(declared)
        # another version may say the same otherwise
        self._has_own_words = "cosim" not in environment_changes(source)
        self._recorded = self._tree(source)
        self._expected = self._tree(again)

    def __str__(self) -> str:
        """Return what is compared."""
        sections = [name for name in self._recorded if name != "last row" or self._recorded[name]]
        identified = recorded_identification(self._source).keys()
        again = recorded_identification(self._again).keys()
        if self._source.status == "unfinished" or not identified <= again:
            sections.remove("verdicts")
        of = "" if self._has_all else f"; as far as they concern {', '.join(self._again.channels)}"
        return f"{', '.join(sections)}{of}"

    def contradictions(self) -> Iterator[Contradiction]:
        """Yield the statements of the log that its replay contradicts."""
        for section, anew in self._expected.items():
            said = self._recorded[section]
            is_whole = self._has_all or section not in _OF_SIGNALS
            for statement in {**anew, **said} if is_whole else anew:
                none: Any = [] if section == "verdicts" else None
                found: Any = said.get(statement, none)
                expected: Any = anew.get(statement, none)
                if section == "warnings" and not self._has_all:  # of what is not here there is none
                    found = [one for one in found if one in expected]
                if found != expected and not _agree(section, statement, found, expected):
                    yield Contradiction(statement, found, expected)
        for statement, found, expected in self._said_twice():
            if found != expected:
                yield Contradiction(statement, found, expected)
        yield from self._other_designs()

    def _said_twice(self) -> Iterator[tuple[str, Any, Any]]:
        """Yield what the log says a second time itself, or by its table and rows."""
        source = self._source
        stop = repr(recorded_stop(source))
        yield "stop", run_metadata(source).get("stop"), stop
        if source.status == "complete" and not source.reason:
            yield "end of the run [ns]", source.end_ns, int(Decimal(stop).scaleb(9))
        step = source.metadata.get("cosim.schedule", {}).get("step_ns")
        yield "step of the schedule [ns]", step, str(source.step_ns)
        if self._has_own_words and source.status == "complete":
            noted = {warning[1:] for warning in source.warnings}
            warned = {one[1:] for one in DistinctWarnings(source.messages())}
            if len(noted) < MOST_WARNINGS:
                yield f"{WARNINGS} in {RESULT_FILE}", sorted(noted), sorted(warned)
        if source.status == "unfinished":
            return
        if not source.results:
            yield RESULT_FILE, None, "how the run ended, and its last row"
            return
        for key in _END_KEYS:
            value = source.results.get(key)
            text = value if value is None else str(value)
            yield f"{key} in {RESULT_FILE}", text, source.metadata[RESULT].get(key)

    def _other_designs(self) -> Iterator[Contradiction]:
        """Yield the first entry of each design that is another one than what was computed anew.

        One of an earlier version of cosim may have other arrays; a replay goes by those.
        """
        for name, (recorded, design) in (self._designs or {}).items():
            for key, anew in design.items() if recorded.keys() == design.keys() else ():
                found = recorded[key]
                scale = _OF_LARGEST * np.abs(anew).max(initial=0.0)
                near = np.isclose(found, anew, rtol=_ESTIMATE_RTOL, atol=scale, equal_nan=True)
                if not near.all():
                    place = tuple(np.argwhere(~near)[0].tolist())
                    entry = "".join(f"[{index}]" for index in place)
                    about = f"design of {name!r}: {key}{entry}"
                    yield Contradiction(about, found[place].item(), anew[place].item())
                    break

    def _tree(self, run: Log | Memory) -> Tree:
        """Return what a run, the log or its replay, says of what both may have."""
        of_run = run_metadata(run)
        connections = run.metadata.get("cosim.connections", {})
        tree: dict[str, dict[str, Any]] = {}
        if self._has_all:
            tree["truth"] = {key: of_run[key] for key in of_run if key in _OF_ALL_KEYS}
        tree["connections"] = {f"connection to {to!r}": text for to, text in connections.items()}
        tree["schedule"] = {"stages": self._stages(run)}
        known = _OTHER_KEYS | _OF_ALL_KEYS
        tree["times"] = {key: of_run[key] for key in sorted(of_run) if key not in known}
        tables = dict(self._of_components(run))
        metadata: dict[str, Any] = {}
        for name in self._computed:
            table = component_table(run, name)
            metadata |= {f"{key} of {name!r}": value for key, value in table.items()}
        # whatever a component calls its metadata: they hide no table
        tree["component tables"] = {**tables, **metadata, **tables}
        if self._designs is not None:
            pairs = self._designs.items()
            others = [name for name, (old, anew) in pairs if old.keys() != anew.keys()]
            kept = f" but that of {', '.join(others)}, of another version of cosim"
            tree[f"designs{kept if others else ''}"] = {}
        tree["overrides"] = {"overrides": self._event_bits(run)}
        tree["substeps"] = dict(self._of_substeps(run))
        if self._has_own_words:
            # "run" is how the run ended: a replay ends where the log does, whatever the reason
            named = [message for message in run.messages() if message.source != "run"]
            messages = [(message.source, message.text) for message in named]
            tree["warnings"] = {"warnings": recorded_warnings(run), "messages": messages}
            for what, entries in tree["warnings"].items():
                own = [entry for entry in entries if entry[0] in self._computed]
                tree["warnings"][what] = own
        if self._source.status not in ("unfinished", PARTIAL_STATUS):
            # a part has none, or that of the whole run
            tree["last row"] = self._last_row(run)
        tree["verdicts"] = dict(self._verdicts(run))
        return tree

    def _event_bits(self, run: Log | Memory) -> list[tuple[Any, ...]]:
        """Return the jumps that the replay may have, to the last bit; NaN is equal to itself so."""
        events: list[tuple[Any, ...]] = []
        for event in run.events():
            port = Port.parse(event.signal)
            channel = self._known.get(port.component)
            is_known = channel is not None and (
                event.cause in OF_COMPONENTS or port.find(channel.by_name) is not None
            )
            if self._has_all or is_known:
                values = tuple(value.hex() for value in (*event.values, *event.parameters))
                events.append((event.time_ns, event.cause, event.signal, values))
        return events

    def _stages(self, run: Log | Memory) -> list[str]:
        stages = list(run.schedule)
        if self._has_all:
            return stages
        own = [one for one in self._again.schedule if set(self._computed).intersection(one.split())]
        # of those that do not depend on each other, others decide on the order
        return sorted(set(stages).intersection(own))

    def _of_components(self, run: Log | Memory) -> Iterator[tuple[str, Any]]:
        for name in self._known:
            own = component_metadata(run, name)
            yield f"table of {name!r}", own.get("table")
            # the log has it with the channels, too; a replay in memory has none
            of_log = run is self._source
            kind = self._source.kinds.get(name) if of_log else json.loads(own["table"])["kind"]
            yield f"kind of {name!r}", kind
        declared = declared_channels(run.channels)
        for name in self._computed:
            own = component_metadata(run, name)
            yield f"tables that {name!r} rests on", own.get("fingerprint")
            yield f"held inputs of {name!r}", run.held[name].tolist()
            interface = declared[name].interface
            signals = signals_json(interface), dict(interface.initial), tuple(interface.delayed)
            yield f"signals of {name!r}", signals

    def _of_substeps(self, run: Log | Memory) -> Iterator[tuple[str, Any]]:
        counts = recorded_substep_counts(run)
        # a run that was stopped may have taken some beyond its end
        substeps = [one for one in run.substeps() if one.begin_ns < self._source.end_ns]
        if not self._has_all:
            there = [own.components for own in recorded_substep_counts(self._again)]
            counts = tuple(own for own in counts if own.components in there)
            loops = {components[0] for components in there}
            substeps = [one for one in substeps if one.loop in loops]
        yield "number of substeps", len(substeps)
        for substep in substeps:
            about = f"substep of the loop of {substep.loop!r} at t = {substep.begin} s"
            if not substep.accepted:
                about += f", refused at {substep.end} s"
            yield about, substep._replace(values=())
            for number, value in enumerate(substep.values):
                yield f"{about}: value {number}", value.hex()
        if self._source.status != "complete" or not self._source.results:
            return
        what = f"counts of substeps in {RESULT_FILE}"
        yield f"{what}: loops", [list(own.components) for own in counts]
        for own in counts:
            _, *figures = asdict(own).items()
            for key, value in figures:
                yield f"{what}: loop of {own.components[0]!r}, {key}", value

    def _last_row(self, run: Log | Memory) -> dict[str, Any]:
        last = self._source.results.get("last")
        has_failed = self._source.status in ("failed", "interrupted")
        if not self._source.results or (last is None and has_failed):  # on a full disk
            return {}
        labels = set(last) if isinstance(last, dict) else set()
        for name, channel in self._source.channels.items():
            labels |= {f"{name}.{element}" for element in element_names(channel.signals)}
        own = run.results.get("last")
        items = own.items() if isinstance(own, dict) else ()
        what = f"last row in {RESULT_FILE}"
        return {f"{what}: {label}": value for label, value in items if label in labels}

    def _verdicts(self, run: Log | Memory) -> Iterator[tuple[str, Any]]:
        """Yield what is said of identifiers; a log without any says nothing false of them."""
        if not recorded_identification(self._source):
            return
        for name, said in recorded_identification(run).items():
            own = _compared(plain(said))
            yield f"verdicts on {name!r}", [*own["parameters"], *own["estimate"]]
            yield f"amplitudes of {name!r}", own["amplitudes"]
            yield f"undetected errors of {name!r}", own["undetected"]
            yield f"guaranteed intervals of {name!r}", own.get("irregular", [])


def _signals_of(channels: Mapping[str, Channel]) -> set[tuple[str, str]]:
    return {(name, signal) for name, channel in channels.items() for signal in channel.by_name}


# --- rules ---

_OF_SIGNALS: Final = {"connections", "last row", "verdicts"}  # a partial log may have more
_NOT_COMPARED: Final = {"reason", "text", "remedy", "problem", "unsolved"}  # of verdicts


def _agree(section: str, statement: str, found: Any, expected: Any) -> bool:
    """Return whether a section may have something else than what a statement should say."""
    if section == "component tables":
        figure, _, _ = statement.partition(" of '")
        return figure in EIGENVALUE_FIGURES and _are_close(found, expected)
    if section != "verdicts":
        return False
    if not (found or statement.startswith("verdicts on ")):
        return True  # older logs have not all of them
    is_interval = statement.startswith("guaranteed intervals of ")
    return _are_near(found, expected, _GUARANTEED_RTOL if is_interval else _ESTIMATE_RTOL)


def _compared(value: Any) -> Any:
    """Return what is compared of verdicts: no sentences, and not why there are none."""
    match value:
        case dict():
            return {k: _compared(item) for k, item in value.items() if k not in _NOT_COMPARED}
        case list():
            return list(map(_compared, value))
    return value


def _are_near(found: Any, expected: Any, rtol: float) -> bool:
    """Return whether verdicts are equal, and their numbers equal but for rounding."""
    match found, expected:
        case dict(), dict():
            keys = {*found, *expected}
            return all(_are_near(found.get(key), expected.get(key), rtol) for key in keys)
        case list(), list():
            pairs = zip(found, expected, strict=False)
            return len(found) == len(expected) and all(_are_near(a, b, rtol) for a, b in pairs)
        case float(), float():
            return math.isclose(found, expected, rel_tol=rtol, abs_tol=1e-12)
    return bool(found == expected)


def _are_close(found: Any, expected: Any) -> bool:
    """Return whether eigenvalues, or what is computed from them, are equal but for rounding."""
    try:
        a, b = (np.atleast_1d(np.array(values, np.complex128)) for values in (found, expected))
    except (TypeError, ValueError, OverflowError):
        return False
    if a.shape != b.shape or a.ndim > 1:
        return False
    distances = np.abs(a[:, np.newaxis] - b)  # whatever their order, which rounding changes too
    nearest = max(distances.min(axis=0).max(), distances.min(axis=1).max())
    return bool(nearest <= _EIGENVALUE_RTOL * np.abs(b).max())
