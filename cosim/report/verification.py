"""What a replay proves of its log.

Four things, and no more:

* The rows are those that the run recorded: their content hash is the recorded one. That finds every
  change but one by somebody who computes the hash anew.
* The components that were computed again follow, bit for bit, from those that were copied, by the
  scenario and the designs in the log.
* What the log says of its run beside its rows follows from its scenario, as far as a replay
  computes it: see :mod:`cosim.report.statements`.
* Of what was copied (plants, FMUs, files) a replay proves nothing more. Only the run itself, done
  again, does.

Nothing is signed: the log of another run, put in the place of this one as a whole, passes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from operator import attrgetter
from typing import Any, Final, Literal, TypeAlias

from cosim.core.clock import nanoseconds
from cosim.core.contracts import Design
from cosim.core.recorded.partial import RecordSelection, declared_channels
from cosim.core.recorders import Memory
from cosim.documents import plain
from cosim.errors import CosimError, LogError, UsageError, command, flag, listing
from cosim.log import Log, open_log
from cosim.log.comparison.diff import diff
from cosim.log.comparison.difference import ElementDifference, LogDifference, SignalDifference
from cosim.log.contents.environment import environment_changes
from cosim.report.statements import NOT_COMPARED, Contradiction, Statements
from cosim.scenario.record import (
    ReplayOrigin,
    component_record,
    recorded_substep_counts,
    replay_origin,
)
from cosim.scenario.recordings.recorded_scenario import recorded_document

_MOST_SHOWN = 8  # contradictions, or components
_OF_PARTIAL_LOGS: Final = {
    "unrecorded": "not verified, as the partial log has no signals of",
    "partial": "verified only in part, as the log is partial",
    "absent": "not verified, as the partial log has neither it nor its inputs",
}
VerificationStatus: TypeAlias = Literal[
    "equal", "differs", "copied", "partial", "unrecorded", "absent"
]


@dataclass(frozen=True, slots=True)
class ComponentVerification:
    """What a replay proves of one component.

    Parameters
    ----------
    component : str
    status : str
        ``equal``: computed again, all bits of its inputs and outputs; ``differs``: they are not
        all equal; ``copied``: its outputs were taken from the log, so that nothing is proven.
        Of a partial log: ``partial``, what it has of the component is equal, which is not all;
        ``unrecorded``, it has nothing, and the replay computed it; ``absent``, the replay has
        nothing of it either.
    first : ElementDifference or None
        The first difference in a value; None: there is none, or the rows are at other times.
    reason : str
        Why nothing computed it, or not all of it is verified.
    """

    component: str
    status: VerificationStatus
    first: ElementDifference | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class CopiedSubsteps:
    """The substeps of a loop that a replay took from the log, as it copied components of the loop.

    Parameters
    ----------
    loop : tuple of str
        All components.
    copied : tuple of str
        Those of them that were copied.
    """

    loop: tuple[str, ...]
    copied: tuple[str, ...]

    def __str__(self) -> str:
        others = "; its other outputs were compared" if len(self.copied) < len(self.loop) else ""
        return (
            f"taken from the log, not recomputed: the substeps of the loop of "
            f"{listing(self.loop)} in /cosim/step (accepted, rejected, estimated errors, inputs, "
            f"outputs of {listing(self.copied)}){others}"
        )


@dataclass(frozen=True)
class Verification:
    """A log beside its replay.

    Parameters
    ----------
    recorded_hash : str or None
        Content hash that the run recorded; None: its log is unfinished.
    found_hash : str
        Of the rows in the log.
    difference : LogDifference
        Of the log and its replay.
    contradictions : tuple of Contradiction
        What the log says of its run and the replay does not.
    copied : tuple of str
        Signals that the replay took from the log: the outputs of recorded components.
    code : tuple of str
        Those of them that code of users computes, which was not allowed to run.
    left_out : tuple of str
        Those of them whose components could have been computed, but were not chosen.
    substeps : tuple of CopiedSubsteps
    scenario : str
        Where the scenario came from.
    components : tuple of ComponentVerification
        All of the log, in its order.
    environment : mapping of name to (str, str)
        Versions, platform and processor that are others than the log's run had: the recorded one
        and the present one.
    window : (float, float) or None
        The part of the log that was compared [s]; None: all of it.
    statements : str
        What the log says of its run that was compared, in words.
    is_changed : bool
        Whether the scenario was changed for the replay.
    """

    recorded_hash: str | None
    found_hash: str
    difference: LogDifference
    contradictions: tuple[Contradiction, ...]
    copied: tuple[str, ...]
    code: tuple[str, ...]
    left_out: tuple[str, ...]
    substeps: tuple[CopiedSubsteps, ...]
    scenario: str
    components: tuple[ComponentVerification, ...]
    environment: Mapping[str, tuple[str, str]]
    window: tuple[float, float] | None = None
    statements: str = ""
    is_changed: bool = False

    @property
    def passed(self) -> bool:
        """Whether the content is what was recorded, and follows by computation where it can."""
        same_rows = self._has_recorded_hash and self.difference.same_rows
        if self.window is not None:
            return same_rows and self.difference.events.equal
        return same_rows and not self.contradictions

    @property
    def _has_recorded_hash(self) -> bool:
        """Whether the rows have the recorded hash, if there is one."""
        return self.recorded_hash in (None, self.found_hash)

    @property
    def computed(self) -> tuple[str, ...]:
        """Signals that were computed again: outputs, and inputs by their connections."""
        copied = set(self.copied)
        return tuple(row.signal for row in self.difference.rows if row.signal not in copied)

    @property
    def lines(self) -> list[str]:
        """What has been proven, in words."""
        return list(self._proven())

    def _proven(self) -> Iterator[str]:
        if self.recorded_hash is None:
            yield "no content hash: the log is unfinished (its run was killed or is still running)"
        else:
            yield "the content hash is as recorded"
        equal = f"the replay equals the log bit for bit: {len(self.computed)} signals recomputed"
        if not self.computed:
            equal = "the replay recomputed no signal of the log, so none is verified"
        not_compared = NOT_COMPARED
        if self.window is not None:
            not_compared = "rows outside that window, records of the run"
            yield f"{equal}, and all events, from {self.window[0]} s to {self.window[1]} s"
        else:
            yield equal
            yield f"the records of the run agree with the replay: {self.statements}"
            if "cosim" in self.environment:
                not_compared += ", warnings of another version of cosim"
        yield from self._not_verified()
        yield from map(str, self.substeps)
        yield (
            f"not compared: {not_compared}; logs are not signed: replacing the whole log by one "
            "of another run is not detected"
        )

    def _not_verified(self) -> Iterator[str]:
        """Yield which signals and components are not verified, or not as a whole, and why."""
        if self.code:
            yield (
                f"not verified, as not recomputed: {', '.join(self.code)}; {flag('allow_code')} "
                "recomputes it, which runs user code"
            )
        if self.left_out:
            yield f"not verified, as not chosen: {', '.join(self.left_out)}"
        others = [name for name in self.copied if name not in (*self.code, *self.left_out)]
        if others:
            yield (
                f"taken from the log, not recomputed: {', '.join(others)}; {flag('rerun')} "
                f"recomputes plants, with {flag('allow_code')} also FMUs; to recompute everything, "
                f"run {self.scenario!r} with the same changes and compare with {command('diff')}"
            )
        for status, text in _OF_PARTIAL_LOGS.items():
            named = []
            for own in self.components:
                if own.status == status:
                    reason = "" if status == "unrecorded" else f" ({own.reason})"
                    named.append(f"{own.component}{reason}")
            if named:
                yield f"{text}: {', '.join(named)}"

    @property
    def problems(self) -> list[str]:
        """What is wrong, in words."""
        return list(self._problems())

    def _problems(self) -> Iterator[str]:
        if not self._has_recorded_hash:
            yield (
                "rows or declarations of signals were changed after recording: content hash "
                f"{self.found_hash}, recorded {self.recorded_hash}"
            )
        if not self.difference.same_rows:
            yield from self._differing_rows()
        events = self.difference.events
        if self.window is not None and not events.equal:
            place = ""
            if events.first is not None:
                place = f"; first: {events.first.signal} at t = {events.first.time_ns / 1e9} s"
            yield f"the events of the replay differ from those of the log{place}"
        what = "the log contradicts its scenario"
        if self.is_changed:
            what = "the log differs from the replay with a changed scenario"
        for entry in self.contradictions[:_MOST_SHOWN]:
            yield f"{what}: {entry}"
        further = len(self.contradictions) - _MOST_SHOWN
        if further > 0:
            yield f"{what}: {further} more"

    def _differing_rows(self) -> Iterator[str]:
        """Yield where the components differ first, in the order of time."""
        differs = "the replay differs from the log; first: "
        first = self.difference.first
        if first is None:
            row = next(row for row in self.difference.rows if row.status != "equal")
            in_log, in_replay, _ = row.rows
            text = f"{in_log} rows in the log, {in_replay} in the replay"
            yield f"{differs}{row.signal}: {row.status}: {text}"
            return
        yield f"{differs}{_in_words(first)}"
        found = [own.first for own in self.components if own.first is not None]
        others = sorted((one for one in found if one != first), key=attrgetter("time_ns"))
        for element in others[:_MOST_SHOWN]:
            yield f"then: {_in_words(element)}"
        further = len(others) - _MOST_SHOWN
        if further > 0:
            yield f"then: {further} more component{'' if further == 1 else 's'}"

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        return {
            "passed": self.passed,
            "content_hash": {
                "recorded": self.recorded_hash,
                "found": self.found_hash,
                "equal": self._has_recorded_hash if self.recorded_hash is not None else None,
            },
            "window": None if self.window is None else list(self.window),
            **{key: list(getattr(self, key)) for key in ("computed", "copied", "code", "left_out")},
            "components": [plain(entry) for entry in self.components],
            "environment": {
                name: {"recorded": recorded, "present": present}
                for name, (recorded, present) in self.environment.items()
            },
            "substeps_copied": [asdict(copied) for copied in self.substeps],
            "contradictions": [asdict(entry) for entry in self.contradictions],
            **self.difference.to_dict(),
        }


def _in_words(element: ElementDifference) -> str:
    recorded, computed = element.texts
    return (
        f"{element.signal} at t = {element.time_ns / 1e9} s: log {recorded}, replay {computed}; "
        f"{element.differing_bits} of the 64 bits differ"
    )


def verify(
    source: Log, again: Log | Memory, designs: Mapping[str, Design] | None = None
) -> Verification:
    """Compare a log with its replay and with the hash that its run recorded.

    Parameters
    ----------
    source : Log
    again : Log or Memory
        What :func:`cosim.replay` made of it: all of it, or a window, which is then compared alone.
    designs : mapping of name to Design, optional
        Those that the replay took from the log, computed anew; without them none is compared.

    Raises
    ------
    LogError
        If the log is damaged, has no content hash, or says what cannot be understood.
    UsageError
        If the replay was asked to record less than the log has.
    """
    _check_selection(source, again)
    recorded_hash = _recorded_hash(source)
    found_hash = source.content_hash()
    origin = replay_origin(again)
    known = declared_channels(again.channels)
    copied: list[str] = []
    code: list[str] = []
    left_out: list[str] = []
    for name in origin.copied:
        signals = [f"{name}.{signal.name}" for signal in known[name].interface.outputs]
        if source.partial is not None:
            signals = [signal for signal in signals if signal in source.signals]
        copied += signals
        if name in origin.left_out:
            left_out += signals
        elif component_record(again, name).code is not None:
            code += signals
    substeps = []
    for counts in recorded_substep_counts(again):
        inside = tuple(name for name in counts.components if name in origin.copied)
        if inside:
            substeps.append(CopiedSubsteps(counts.components, inside))
    window = origin.window
    span_ns = None if window is None else (nanoseconds(window[0]), nanoseconds(window[1]))
    difference = diff(source, again, signals=_compared(source, again), span_ns=span_ns)
    statements = None
    if window is None:
        statements = Statements(source, again, known.keys() - set(origin.copied), designs)
    return Verification(
        recorded_hash,
        found_hash,
        difference,
        tuple(statements.contradictions() if statements else ()),
        tuple(copied),
        tuple(code),
        tuple(left_out),
        tuple(substeps),
        recorded_document(source).source,
        tuple(_components(source, again, difference, origin)),
        environment_changes(source),
        window,
        str(statements or ""),
        _edits(again) != _edits(source),
    )


def _components(
    source: Log, again: Log | Memory, difference: LogDifference, origin: ReplayOrigin
) -> Iterator[ComponentVerification]:
    """Yield what is proven of every component."""
    rows_of: dict[str, list[SignalDifference]] = {}
    if source.partial is not None:
        rows_of = {name: [] for name in source.partial.declared}
    for row in difference.rows:
        rows_of.setdefault(row.signal.partition(".")[0], []).append(row)
    for name, rows in rows_of.items():
        elements = [row.first for row in rows if row.first is not None]
        first = min(elements, key=lambda element: element.time_ns, default=None)
        status, reason = _status(source, again, name, origin)
        if any(row.status != "equal" for row in rows):
            status = "differs"
        yield ComponentVerification(name, status, first, reason)


def _status(
    source: Log, again: Log | Memory, name: str, origin: ReplayOrigin
) -> tuple[VerificationStatus, str]:
    """Return what is proven of a component that does not differ, and why it is not all."""
    if name in origin.absent:
        return "absent", origin.absent[name]
    if name in origin.left_out:
        return "copied", "not chosen"
    if name in origin.copied:
        code = component_record(again, name).code
        why = "a replay takes plants, FMUs and files from the log"
        if code is not None:
            why = f"{flag('allow_code')} runs {code.class_name}"
        return "copied", origin.uncomputed.get(name, why)
    recorded = source.partial
    if recorded is None or recorded.is_whole(name, source.channels):
        return "equal", ""
    if name not in source.channels:
        return "unrecorded", "no signal in the log"
    missing = recorded.missing(source.channels).get(name)
    if missing:
        return "partial", f"without {listing(missing)}"
    return "partial", f"one row in {source.channels[name].period} steps"


def _compared(source: Log, again: Log | Memory) -> list[str]:
    """Return the signals that a partial log and its replay both have; none: the log has all.

    Raises
    ------
    LogError
        If there are none.
    """
    if source.partial is None:
        return []
    shared = [signal for signal in source if signal in again.signals]
    if not shared:
        raise LogError(
            f"{source.label}: nothing to verify: the partial log was recorded with "
            f"{source.partial.selection}, and a replay has none of these signals"
        )
    return shared


def _recorded_hash(source: Log) -> str | None:
    """Return the content hash that a log has of its rows; None: it is unfinished.

    Of a file that was joined with those before it, their hashes were checked then, and that of the
    joined rows was recorded by no run: where the last file has none, there is none.
    """
    with suppress(CosimError):
        if open_log(source.path).status == "unfinished":
            return None
    return source.recorded_hash


def _check_selection(source: Log, again: Log | Memory) -> None:
    """Check that a replay has not been asked to record less than its log has.

    Raises
    ------
    UsageError
        If it has: what it left out would pass unseen.
    """
    if again.partial is None:
        return
    selection = again.partial.selection
    of_log = RecordSelection() if source.partial is None else source.partial.selection
    has_signals = selection.signals in (None, ("*",), of_log.signals)
    if not has_signals or of_log.every % selection.every:
        raise UsageError(
            f"a verification compares all signals of {source.label}, but the replay records only "
            f"{selection}; omit that"
        )


def _edits(run: Log | Memory) -> tuple[Any, ...]:
    """Return what makes the scenario of a run; its end is that of the log in every replay."""
    document = recorded_document(run)
    changes = dict(document.changes)
    changes.pop("scenario.stop", None)
    return document.text, dict(document.swaps), dict(document.maps), changes
