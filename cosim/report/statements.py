"""What a log says of its run beside its rows, compared with what a replay computes anew.

A log says many things twice: in its scenario, which a replay runs, and in its metadata, messages
and results, which reports show. A replay computes the latter from the former, so what the two say
is compared as two trees, made by one function, with a few rules by place (``_agree``):

* of the run: name, start, step, stop, truth, schedule, connections, and whatever else
  ``cosim.run`` has; the overrides of its inputs, and what followed them;
* of every component: its table and kind;
* of those that are computed again, too: the tables that they rest on, their designs, their declared
  signals, held inputs, metadata, warnings and messages;
* of the substeps of loops: which, with what errors, and what components had at their ends; beside
  recorded components only the outputs that are computed again;
* of the end: the content of ``result.json``, its last row and the verdicts on identifiers included,
  with all that these rest on;
* the layout for viewers.

Of a partial log a replay may have less than the run had: compared is what it has.

Eigenvalues, and times computed from them, are compared to 1 %; estimates, intervals and designs to
1e-6. Designs only where the log reaches its stop, as one may rest on how long the run is. In the
sentences of verdicts numbers are compared to one unit of their last digit.

A replay takes the rest as it stands, and :attr:`Statements.not_compared` names it. Of another
version of cosim that is more: sentences, tests of the residual and the layout may be others.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from decimal import Decimal
from itertools import chain, islice, zip_longest
from typing import Any, Final, final

import numpy as np

from cosim.core.contracts import Design
from cosim.core.port import Port
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.signals import MOST_WARNINGS, WARNINGS, DistinctWarnings
from cosim.core.recorders import Memory
from cosim.core.signals import Channel
from cosim.core.stepping.actions import AT_CONDITION
from cosim.documents import plain
from cosim.errors import quoted
from cosim.log import Log
from cosim.log.difference import OF_COMPONENTS
from cosim.log.layout import signals_json
from cosim.log.metadata import environment_changes
from cosim.log.preamble import PARTIAL_STATUS, RESULT, RESULT_FILE
from cosim.log.viewer_layout import LAYOUT_FILE
from cosim.scenario.building.actions import recorded_designs as settings_designs
from cosim.scenario.record import (
    EIGENVALUE_FIGURES,
    component_metadata,
    component_table,
    recorded_identification,
    recorded_substep_counts,
    recorded_warnings,
    replay_origin,
    run_metadata,
)
from cosim.scenario.recordings.recorded_scenario import recorded_stop

# of the record of the run: what a replay takes, has of its own, or is compared apart
_OTHER_KEYS: Final = frozenset({"edits", "format", "replay", "stop", "warnings"})
# what follows from components or signals that a replay may not have
_OF_ALL_KEYS: Final = frozenset({"truth", "first_order_loops", "loop_gains", "models"})
# sections of which a replay may have less
_OF_ALL: Final = ("connections", "schedule", "warnings", "last row", "verdicts")
_END_KEYS: Final = ("status", "reason", "steps", "end_ns", "content_hash")
# what is compared of the verdicts of another version of cosim, but for their sentences
_LASTING: Final = frozenset({"parameters", "estimate", "amplitudes", "undetected", "irregular"})
_SENTENCES: Final = frozenset({"reason", "text", "remedy", "problem"})
_LAYOUT: Final = "layout for viewers"
_NOT_COMPARED: Final = (
    "comments of the scenario, designs of what was not recomputed, models from files and FMUs, "
    "error growth of loops, error estimates, stop reason, machine and time, metadata of FMUs and "
    "files"
)
_NUMBER: Final = re.compile(r"(\d{1,20}(?:\.\d{1,20})?(?:e[+-]\d{1,3})?)")
# what other processors make of the linear algebra behind a verdict, or a design
_ESTIMATE_RTOL: Final = 1e-6
_OF_LARGEST: Final = 1e-9  # of the largest entry of an array, in addition
# By how much linear programs may miss the ends of intervals, and more. So may tests of the residual
# along many directions, some of which are hardly independent.
_GUARANTEED_RTOL: Final = 1e-4
# An n-fold eigenvalue moves by eps**(1/n) with the last bits of its matrix, which depend on the
# processor: by 1e-2 for n = 8.
_EIGENVALUE_RTOL: Final = 1e-2


@dataclass(frozen=True, slots=True)
class Contradiction:
    """A place in what a log says that does not follow from its scenario and rows.

    Parameters
    ----------
    statement : str
        The place: ``connections.observer.u``, ``component tables.plant.kind``, ...
    found, expected
        What the log and its replay have there; None: nothing.
    """

    statement: str
    found: Any
    expected: Any

    def __str__(self) -> str:
        found = quoted(self.found)
        return f"{self.statement}: {found} in the log, {quoted(self.expected)} in the replay"


@final
class Statements:
    """What a log says of its run, beside what its replay says; as text what of it is compared.

    Parameters
    ----------
    source : Log
    again : Log or Memory
        Its replay.
    designs : mapping of name to Design, or None
        Those that the replay took from the log, computed anew; None: they are not compared.

    Raises
    ------
    LogError
        If a statement cannot be understood.
    """

    def __init__(
        self, source: Log, again: Log | Memory, designs: Mapping[str, Design] | None
    ) -> None:
        self._source = source
        self._again = again
        declared = declared_channels(source.channels)
        self._known = declared_channels(again.channels)
        copied = replay_origin(again).copied
        self._computed = [n for n in self._known if n in declared and n not in copied]
        # whether the replay has all signals of the run
        self._has_all = _signals_of(self._known) == _signals_of(declared)
        # another version may say the same otherwise
        self._has_own_words = "cosim" not in environment_changes(source)
        recorded = {**source.designs, **settings_designs(source)}
        for name in designs or {}:  # what was set at a condition was prepared for any time
            at_condition = f"{AT_CONDITION} {name.partition(' ')[2]}"
            recorded.setdefault(name, recorded.get(at_condition, {}))
        # an earlier version of cosim had other arrays; a replay goes by those
        self._older = [n for n, own in (designs or {}).items() if own.keys() != recorded[n].keys()]
        anew = None if designs is None else {n: designs[n] for n in designs if n not in self._older}
        self._found = self._tree(source, anew and {name: recorded[name] for name in anew})
        self._expected = self._tree(again, anew)
        for key in () if self._has_all else self._found.keys() & _OF_ALL:
            found = self._found[key]
            kept = [one for one in found if one in self._expected[key]]
            self._found[key] = {k: found[k] for k in kept} if isinstance(found, dict) else kept

    def __str__(self) -> str:
        sections = dict.fromkeys(self._expected)
        identified, again = map(recorded_identification, (self._source, self._again))
        if not identified.keys() <= again.keys():
            sections.pop("verdicts", None)
        text = ", ".join(sections)
        if self._older:
            kept = f"designs but that of {', '.join(self._older)}, of another version of cosim"
            text = text.replace("designs", kept)
        of = "" if self._has_all else f"; as far as they concern {', '.join(self._again.channels)}"
        return f"{text}{of}"

    @property
    def not_compared(self) -> str:
        """What a log says that nothing was compared with, in words."""
        texts = [_NOT_COMPARED]
        if not self._has_own_words:
            texts.append(
                "warnings of another version of cosim, sentences, correlation, noise and tests of "
                "its verdicts"
            )
        if _LAYOUT not in self._expected:
            texts.append(_LAYOUT)
        return ", ".join(texts)

    def contradictions(self) -> Iterator[Contradiction]:
        """Yield the places where the log says something else than its replay."""
        for statement, found, expected in self._said_twice():
            if found != expected:
                yield Contradiction(statement, found, expected)
        yield from _differences(self._found, self._expected)

    def _said_twice(self) -> Iterator[tuple[str, Any, Any]]:
        """Yield what the log says a second time itself, or by its tables and rows."""
        source = self._source
        stop = repr(recorded_stop(source))
        yield "times.stop", run_metadata(source).get("stop"), stop
        if source.status == "complete" and not source.reason:
            yield "end of the run [ns]", source.end_ns, int(Decimal(stop).scaleb(9))
        step = source.metadata.get("cosim.schedule", {}).get("step_ns")
        yield "schedule.step_ns", step, str(source.step_ns)
        if self._has_own_words and source.status == "complete":
            noted = {warning[1:] for warning in source.warnings}
            warned = {one[1:] for one in DistinctWarnings(source.messages())}
            if len(noted) < MOST_WARNINGS:
                yield f"{RESULT_FILE}.{WARNINGS}", sorted(noted), sorted(warned)
        for key in _END_KEYS:
            value = source.results.get(key)
            text = value if value is None else str(value)
            yield f"{RESULT_FILE}.{key}", text, source.metadata.get(RESULT, {}).get(key)

    def _tree(
        self, run: Log | Memory, designs: Mapping[str, Design] | None
    ) -> dict[str, dict[str, Any] | list[Any]]:
        """Return what a run, the log or its replay, says of what both may have, by section."""
        of_run = run_metadata(run)
        tree: dict[str, dict[str, Any] | list[Any]] = {}
        schedule = list(run.schedule)
        if self._has_all:
            tree["truth"] = {key: text for key, text in of_run.items() if key in _OF_ALL_KEYS}
        else:  # of stages that do not depend on each other, others decide on the order
            schedule = sorted(one for one in schedule if set(self._computed) & set(one.split()))
        omitted = _OTHER_KEYS | _OF_ALL_KEYS
        tree["connections"] = dict(run.metadata.get("cosim.connections", {}))
        tree["schedule"] = schedule
        tree["times"] = {key: text for key, text in of_run.items() if key not in omitted}
        tree["component tables"] = {name: self._component(run, name) for name in self._known}
        if designs is not None:
            tree["designs"] = {
                name: {key: array.tolist() for key, array in own.items()}
                for name, own in designs.items()
            }
        tree["overrides"] = self._events(run)
        tree["substeps"] = self._substeps(run)
        if self._has_own_words:
            texts = [("recorded", *warning) for warning in recorded_warnings(run)]
            # "run" is how the run ended: a replay ends where the log does, whatever the reason
            named = [one for one in run.messages() if one.source != "run"]
            texts += [("message", one.source, one.text) for one in named]
            tree["warnings"] = [text for text in texts if text[1] in self._computed]
        source = self._source
        if self._has_own_words and self._has_all and LAYOUT_FILE in source.attachments:
            layout = run.attachment(LAYOUT_FILE).decode(errors="backslashreplace")
            tree[_LAYOUT] = layout.split("\n")
        if source.status == "unfinished":
            return tree
        is_part = source.status == PARTIAL_STATUS  # whose last row is that of the whole run
        if source.status == "complete" or not (is_part or source.results.get("last") is None):
            last = run.results.get("last")
            items = last.items() if isinstance(last, dict) else ()
            tree["last row"] = {k: v for k, v in items if run is source or k in source}
        tree["verdicts"] = verdicts = {}
        # a log without any says nothing false of identifiers
        judged = run if recorded_identification(source) else source
        for name, verdict in recorded_identification(judged).items():
            said = {key: value for key, value in plain(verdict).items() if value}
            if not self._has_own_words:
                said = _figures({key: said[key] for key in said.keys() & _LASTING})
            if said:
                verdicts[name] = said
        return tree

    def _component(self, run: Log | Memory, name: str) -> dict[str, Any]:
        own = component_metadata(run, name)
        kinds = self._source.kinds  # the log has it with the channels, too
        kind = kinds.get(name) if run is self._source else json.loads(own["table"])["kind"]
        said = {"table": own.get("table"), "kind": kind}
        if name not in self._computed:
            return said
        interface = declared_channels(run.channels)[name].interface
        return said | {
            "fingerprint": own.get("fingerprint"),
            "held": run.held[name].tolist(),
            "signals": json.loads(signals_json(interface)),
            "initial": dict(interface.initial),
            "delayed": interface.delayed,
            "metadata": component_table(run, name),
        }

    def _events(self, run: Log | Memory) -> list[tuple[Any, ...]]:
        """Return the jumps that the replay may have, to the last bit; NaN is equal to itself so."""
        events = []
        for event in run.events():
            port = Port.parse(event.signal)
            channel = self._known.get(port.component)
            is_known = channel is not None and (
                event.cause in OF_COMPONENTS or port.find(channel.by_name) is not None
            )
            if self._has_all or is_known:
                bits = [[value.hex() for value in values] for values in event[3:]]
                events.append((*event[:3], *bits))
        return events

    def _substeps(self, run: Log | Memory) -> dict[str, Any]:
        """Return the substeps of the loops that both may have, and what is counted of them."""
        there = [own.components for own in recorded_substep_counts(self._again)]
        steps: dict[str, list[dict[str, Any]]] = {}
        for one in run.substeps():
            # a run that was stopped may have taken some beyond its end
            is_within = one.begin_ns < self._source.end_ns
            if is_within and (self._has_all or one.loop in (names[0] for names in there)):
                own = steps.setdefault(f"loop of {one.loop!r} at t = {one.begin} s", [])
                own.append({**one._asdict(), "values": [value.hex() for value in one.values]})
        counts = []
        if self._source.status == "complete" and self._source.results:
            counts = [asdict(own) for own in recorded_substep_counts(run)]
        kept = [own for own in counts if self._has_all or own["components"] in there]
        return {**steps, "counts": kept}


def _signals_of(channels: Mapping[str, Channel]) -> set[tuple[str, str]]:
    return {(name, signal) for name, channel in channels.items() for signal in channel.by_name}


def _figures(said: Any) -> Any:
    """Return what verdicts say, without sentences."""
    match said:
        case Mapping():
            return {key: _figures(own) for key, own in said.items() if key not in _SENTENCES}
        case [*_]:
            return list(map(_figures, said))
    return said


# --- rules ---


def _differences(found: Any, expected: Any, *place: str | int) -> Iterator[Contradiction]:
    """Yield the places where two trees differ, of a list the first; ``...`` is nothing."""
    match found, expected:
        case _ if _agree(place, found, expected):
            return
        case Mapping(), Mapping():
            for key in {**expected, **found}:
                yield from _differences(found.get(key, ...), expected.get(key, ...), *place, key)
        case [*_], [*_] if place[-1] not in EIGENVALUE_FIGURES:
            pairs = enumerate(zip_longest(found, expected, fillvalue=...))
            places = chain.from_iterable(_differences(a, b, *place, k) for k, (a, b) in pairs)
            yield from islice(places, 1)
        case _:
            values = [None if value is ... else value for value in (found, expected)]
            yield Contradiction(".".join(map(str, place)), *values)


def _agree(place: tuple[str | int, ...], found: Any, expected: Any) -> bool:
    """Return whether a log may have at a place what it has there."""
    if found == expected:
        return True
    rtol = 0.0
    match place:
        case ("component tables", _, "metadata", figure) if figure in EIGENVALUE_FIGURES:
            return _are_close(found, expected)
        case ("designs", _, _) if np.shape(found) == np.shape(expected):
            scale = _OF_LARGEST * np.abs(expected).max(initial=0.0)
            near = np.isclose(found, expected, rtol=_ESTIMATE_RTOL, atol=scale, equal_nan=True)
            return bool(near.all())
        case ("verdicts", _) if expected is ... and found.keys() == {"problem"}:
            return True  # no verdict, and a replay that was not to make any
        case ("verdicts", _, "amplitudes" | "undetected" | "irregular") if found is ...:
            return True  # older logs have not all of them
        case ("verdicts", _, "irregular", "unsolved"):  # how many depends on the processor
            return found is not ... and bool(found) is bool(expected)
        case ("verdicts", *_) if isinstance(found, str) and isinstance(expected, str):
            return _say_the_same(found, expected)
        case ("verdicts", _, "irregular" | "tests", *_):
            rtol = _GUARANTEED_RTOL
        case ("verdicts", *_):
            rtol = _ESTIMATE_RTOL
    are_numbers = isinstance(found, float) and isinstance(expected, float)
    return are_numbers and math.isclose(found, expected, rel_tol=rtol, abs_tol=min(rtol, 1e-12))


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


def _say_the_same(found: str, expected: str) -> bool:
    """Return whether two sentences differ only in the last digits of their numbers.

    Whole numbers on both sides count, or name an element: these must be equal.
    """
    texts, others = (_NUMBER.split(text) for text in (found, expected))
    if texts[::2] != others[::2]:
        return False
    return all(
        a == b or ("." in a + b and _are_neighbours(Decimal(a), Decimal(b)))
        for a, b in zip(texts[1::2], others[1::2], strict=True)
    )


def _are_neighbours(a: Decimal, b: Decimal) -> bool:
    """Return whether two printed numbers are at most one unit of the last digit apart."""
    digits = min(int(number.as_tuple().exponent) for number in (a, b))
    return abs(a - b) <= Decimal(1).scaleb(digits)
