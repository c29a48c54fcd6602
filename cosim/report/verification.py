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

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from operator import attrgetter
from typing import Any, Final, Literal, TypeAlias, final

from cosim.core.clock import nanoseconds
from cosim.core.contracts import Design
from cosim.core.recorded.partial import RecordSelection, declared_channels, is_recorded_whole
from cosim.core.recorders import Memory
from cosim.documents import plain
from cosim.errors import CosimError, LogError, UsageError, command, flag, listing
from cosim.log import Log, open_log
from cosim.log.diff import diff
from cosim.log.difference import ElementDifference, LogDifference, SignalDifference
from cosim.log.metadata import environment_changes
from cosim.report.statements import Contradiction, Statements
from cosim.scenario.record import component_record, recorded_substep_counts, replay_origin
from cosim.scenario.recordings.recorded_scenario import recorded_document

_MOST_SHOWN: Final = 8  # contradictions, or components
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


@final
class Verification:
    """A log beside its replay, and the hash that its run recorded.

    Parameters
    ----------
    source : Log
    again : Log or Memory
        Its replay.
    difference : LogDifference
        Of the log and its replay.
    statements : Statements or None
        What the log says of its run beside its rows; None: only a window was replayed.

    Attributes
    ----------
    window : (float, float) or None
        The part of the log that was compared [s]; None: all of it.
    recorded_hash : str or None
        Content hash that the run recorded; None: its log is unfinished.
    found_hash : str
        Of the rows in the log.
    contradictions : tuple of Contradiction
        What the log says of its run and the replay does not.
    statements, not_compared : str
        What of that was compared, in words, and what was not.
    copied : tuple of str
        Signals that the replay took from the log: the outputs of recorded components.
    code : tuple of str
        Those of them that code of users computes, which was not allowed to run.
    left_out : tuple of str
        Those of them whose components could have been computed, but were not chosen.
    substeps : list of dict
        The loops whose substeps the replay took from the log, as it copied components of them:
        all components of the ``loop``, and those that were ``copied``.
    components : list of ComponentVerification
        All of the log, in its order.
    environment : mapping of name to (str, str)
        Versions, platform and processor that are others than the log's run had: the recorded one
        and the present one.

    Raises
    ------
    LogError
        If the log has no content hash, or says what cannot be understood.
    """

    def __init__(
        self,
        source: Log,
        again: Log | Memory,
        difference: LogDifference,
        statements: Statements | None,
    ) -> None:
        self.source = source
        self._again = again
        self._origin = replay_origin(again)
        self.window = self._origin.window
        self.recorded_hash = _recorded_hash(source)
        self.found_hash = source.content_hash()
        self.difference = difference
        self.contradictions: tuple[Contradiction, ...] = ()
        self.statements = ""
        self.not_compared = "rows outside that window, records of the run"
        if statements is not None:
            self.contradictions = tuple(statements.contradictions())
            self.statements = str(statements)
            self.not_compared = statements.not_compared
        self._find_copied()
        self.components = list(self._components())
        self.environment = environment_changes(source)

    def _find_copied(self) -> None:
        """Set what the replay took from the log."""
        origin = self._origin
        known = declared_channels(self._again.channels)
        self.copied: tuple[str, ...] = ()
        self.code: tuple[str, ...] = ()
        self.left_out: tuple[str, ...] = ()
        for name in origin.copied:
            outputs = (f"{name}.{signal.name}" for signal in known[name].interface.outputs)
            signals = tuple(signal for signal in outputs if signal in self.source)
            self.copied += signals
            if name in origin.left_out:
                self.left_out += signals
            elif component_record(self._again, name).code is not None:
                self.code += signals
        self.substeps = []
        for counts in recorded_substep_counts(self._again):
            inside = [name for name in counts.components if name in origin.copied]
            if inside:
                self.substeps.append({"loop": list(counts.components), "copied": inside})

    def _components(self) -> Iterator[ComponentVerification]:
        """Yield what is proven of every component."""
        rows_of: dict[str, list[SignalDifference]]
        rows_of = {name: [] for name in declared_channels(self.source.channels)}
        for row in self.difference.rows:
            rows_of.setdefault(row.signal.partition(".")[0], []).append(row)
        for name, rows in rows_of.items():
            elements = [row.first for row in rows if row.first is not None]
            first = min(elements, key=attrgetter("time_ns"), default=None)
            status, reason = self._proven(name)
            if any(row.status != "equal" for row in rows):
                status = "differs"
            yield ComponentVerification(name, status, first, reason)

    def _proven(self, name: str) -> tuple[VerificationStatus, str]:
        """Return what is proven of a component that does not differ, and why it is not all."""
        source, origin = self.source, self._origin
        if name in origin.absent:
            return "absent", origin.absent[name]
        if name in origin.left_out:
            return "copied", "not chosen"
        if name in origin.copied:
            code = component_record(self._again, name).code
            why = "a replay takes plants, FMUs and files from the log"
            if code is not None:
                why = f"{flag('allow_code')} runs {code.class_name}"
            return "copied", origin.uncomputed.get(name, why)
        if source.partial is None or is_recorded_whole(source.channels, name):
            return "equal", ""
        if name not in source.channels:
            return "unrecorded", "no signal in the log"
        missing = source.partial.missing(source.channels).get(name)
        period = source.channels[name].period
        return "partial", f"without {listing(missing)}" if missing else f"one row in {period} steps"

    @property
    def passed(self) -> bool:
        """Whether the content is what was recorded, and follows by computation where it can."""
        is_right = self.difference.events.equal if self.window else not self.contradictions
        return self._has_recorded_hash and self.difference.same_rows and is_right

    @property
    def _has_recorded_hash(self) -> bool:
        """Whether the rows have the recorded hash, if there is one."""
        return self.recorded_hash in (None, self.found_hash)

    @property
    def computed(self) -> tuple[str, ...]:
        """Signals that were computed again: outputs, and inputs by their connections."""
        return tuple(row.signal for row in self.difference.rows if row.signal not in self.copied)

    @property
    def lines(self) -> list[str]:
        """What has been proven, in words."""
        lines = ["the content hash is as recorded"]
        if self.recorded_hash is None:
            lines = [
                "no content hash: the log is unfinished (its run was killed or is still running)"
            ]
        equal = "the replay recomputed no signal of the log, so none is verified"
        if self.computed:
            count = f"{len(self.computed)} signals recomputed"
            equal = f"the replay equals the log bit for bit: {count}"
        if self.window is None:
            lines += [
                equal,
                f"the records of the run agree with the replay: {self.statements}",
            ]
        else:
            lines.append(f"{equal}, and all events, from {self.window[0]} s to {self.window[1]} s")
        return [
            *lines,
            *self._not_verified(),
            f"not compared: {self.not_compared}; logs are not signed: replacing the whole log by "
            "one of another run is not detected",
        ]

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
            name = recorded_document(self.source).source
            yield (
                f"taken from the log, not recomputed: {', '.join(others)}; {flag('rerun')} "
                f"recomputes plants, with {flag('allow_code')} also FMUs; to recompute everything, "
                f"run {name!r} with the same changes and compare with {command('diff')}"
            )
        for status, text in _OF_PARTIAL_LOGS.items():
            named = [
                f"{own.component} ({own.reason})" if status != "unrecorded" else own.component
                for own in self.components
                if own.status == status
            ]
            if named:
                yield f"{text}: {', '.join(named)}"
        for one in self.substeps:
            loop, copied = one["loop"], one["copied"]
            others_too = "; its other outputs were compared" if len(copied) < len(loop) else ""
            yield (
                f"taken from the log, not recomputed: the substeps of the loop of {listing(loop)} "
                "in /cosim/step (accepted, rejected, estimated errors, inputs, outputs of "
                f"{listing(copied)}){others_too}"
            )

    @property
    def problems(self) -> list[str]:
        """What is wrong, in words."""
        problems = []
        if not self._has_recorded_hash:
            problems.append(
                "rows or declarations of signals were changed after recording: content hash "
                f"{self.found_hash}, recorded {self.recorded_hash}"
            )
        first = self.difference.first
        differs = "the replay differs from the log; first"
        if first is not None:
            found = [own.first for own in self.components if own.first not in (None, first)]
            then = sorted(filter(None, found), key=attrgetter("time_ns"))
            problems.append(f"{differs}: {_in_words(first)}")
            problems += _shown("then", list(map(_in_words, then)))
        elif not self.difference.same_rows:
            row = next(row for row in self.difference.rows if row.status != "equal")
            rows = f"{row.rows[0]} rows in the log, {row.rows[1]} in the replay"
            problems.append(f"{differs}: {row.signal}: {row.status}: {rows}")
        events = self.difference.events
        if self.window is not None and not events.equal:
            place = ""
            if events.first is not None:
                place = f"; first: {events.first.signal} at t = {events.first.time_ns / 1e9} s"
            problems.append(f"the events of the replay differ from those of the log{place}")
        what = "the log contradicts its scenario"
        if _edits(self._again) != _edits(self.source):
            what = "the log differs from the replay with a changed scenario"
        return problems + _shown(what, self.contradictions)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        return {
            "passed": self.passed,
            "content_hash": {
                "recorded": self.recorded_hash,
                "found": self.found_hash,
                "equal": None if self.recorded_hash is None else self._has_recorded_hash,
            },
            "window": None if self.window is None else list(self.window),
            **{key: list(getattr(self, key)) for key in ("computed", "copied", "code", "left_out")},
            "components": list(map(plain, self.components)),
            "environment": {
                name: {"recorded": recorded, "present": present}
                for name, (recorded, present) in self.environment.items()
            },
            "substeps_copied": self.substeps,
            "contradictions": list(map(asdict, self.contradictions)),
            **self.difference.to_dict(),
        }


def _in_words(element: ElementDifference) -> str:
    recorded, computed = element.texts
    return (
        f"{element.signal} at t = {element.time_ns / 1e9} s: log {recorded}, replay {computed}; "
        f"{element.differing_bits} of the 64 bits differ"
    )


def _shown(what: str, entries: Sequence[object]) -> list[str]:
    """Return the first entries as texts, and how many more there are."""
    further = len(entries) - _MOST_SHOWN
    more = [f"{further} more"] if further > 0 else []
    return [f"{what}: {entry}" for entry in (*entries[:_MOST_SHOWN], *more)]


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
    window = replay_origin(again).window
    statements = None if window else Statements(source, again, designs)
    shared = [] if source.partial is None else [name for name in source if name in again.signals]
    if source.partial is not None and not shared:
        raise LogError(
            f"{source.label}: nothing to verify: the partial log was recorded with "
            f"{source.partial.selection}, and a replay has none of these signals"
        )
    span_ns = None if window is None else (nanoseconds(window[0]), nanoseconds(window[1]))
    difference = diff(source, again, signals=shared, span_ns=span_ns)
    return Verification(source, again, difference, statements)


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
