"""What the verification of a log says: of every component, of its statements, and as a whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal, TypeAlias

from cosim.errors import command, flag, listing
from cosim.log.comparison.difference import ElementDifference, LogDifference, SignalDifference
from cosim.report.statements import NOT_COMPARED, Contradiction

_MOST_SHOWN = 8  # contradictions, or components
_HASH_FITS = "the content hash is as recorded"
_NO_HASH = "no content hash: the log is unfinished (its run was killed or is still running)"
_NOT_WHOLE: Final[Mapping[str, str]] = {
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

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        first = None if self.first is None else self.first.to_dict()
        return {**asdict(self), "first": first}


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
        text = (
            f"taken from the log, not recomputed: the substeps of the loop of "
            f"{listing(self.loop)} in /cosim/step (accepted, rejected, estimated errors, inputs, "
            f"outputs of {listing(self.copied)})"
        )
        if len(self.copied) < len(self.loop):
            text += "; its other outputs were compared"
        return text


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
        names = [row.signal for row in self.difference.rows]
        copied = set(self.copied)
        return tuple(name for name in names if name not in copied)

    @property
    def lines(self) -> list[str]:
        """What has been proven, in words."""
        equal = f"the replay equals the log bit for bit: {len(self.computed)} signals recomputed"
        if not self.computed:
            equal = "the replay recomputed no signal of the log, so none is verified"
        lines = [_HASH_FITS if self.recorded_hash is not None else _NO_HASH]
        if self.window is None:
            lines.append(equal)
            lines.append(f"the records of the run agree with the replay: {self.statements}")
        else:
            begin, end = self.window
            lines.append(f"{equal}, and all events, from {begin} s to {end} s")
        if self.code:
            names = ", ".join(self.code)
            lines.append(
                f"not verified, as not recomputed: {names}; {flag('allow_code')} recomputes it, "
                "which runs user code"
            )
        if self.left_out:
            names = ", ".join(self.left_out)
            lines.append(f"not verified, as not chosen: {names}")
        known = {*self.code, *self.left_out}
        others = [name for name in self.copied if name not in known]
        if others:
            names = ", ".join(others)
            lines.append(
                f"taken from the log, not recomputed: {names}; {flag('rerun')} recomputes plants, "
                f"with {flag('allow_code')} also FMUs; to recompute everything, run "
                f"{self.scenario!r} with the same changes and compare with {command('diff')}"
            )
        lines += self._of_partial_log
        lines += map(str, self.substeps)
        not_compared = NOT_COMPARED
        if self.window is not None:
            not_compared = "rows outside that window, records of the run"
        elif "cosim" in self.environment:
            not_compared += ", warnings of another version of cosim"
        lines.append(
            f"not compared: {not_compared}; logs are not signed: replacing the whole log by one "
            "of another run is not detected"
        )
        return lines

    @property
    def _of_partial_log(self) -> list[str]:
        """Which components of a partial log are not verified, or not as a whole."""
        lines = []
        unrecorded = [own.component for own in self.components if own.status == "unrecorded"]
        if unrecorded:
            names = ", ".join(unrecorded)
            lines.append(f"not verified, as the partial log has no signals of: {names}")
        for status, text in _NOT_WHOLE.items():
            named = [
                f"{own.component} ({own.reason})" for own in self.components if own.status == status
            ]
            if named:
                lines.append(f"{text}: {', '.join(named)}")
        return lines

    @property
    def problems(self) -> list[str]:
        """What is wrong, in words."""
        problems = []
        if not self._has_recorded_hash:
            problems.append(
                "rows or declarations of signals were changed after recording: content hash "
                f"{self.found_hash}, recorded {self.recorded_hash}"
            )
        if not self.difference.same_rows:
            problems.append(f"the replay differs from the log; first: {self._first}")
            problems += self._later
        if self.window is not None and not self.difference.events.equal:
            problems.append(self._event_problem)
        what = "the log contradicts its scenario"
        if self.is_changed:
            what = "the log differs from the replay with a changed scenario"
        problems += [f"{what}: {entry}" for entry in self.contradictions[:_MOST_SHOWN]]
        further = len(self.contradictions) - _MOST_SHOWN
        if further > 0:
            problems.append(f"{what}: {further} more")
        return problems

    @property
    def _event_problem(self) -> str:
        first = self.difference.events.first
        place = ""
        if first is not None:
            place = f"; first: {first.signal} at t = {first.time_ns / 1e9} s"
        return f"the events of the replay differ from those of the log{place}"

    @property
    def _first(self) -> str:
        first = self.difference.first
        if first is None:
            row = next(row for row in self.difference.rows if row.status != "equal")
            return _in_words(row)
        return _difference_text(first)

    @property
    def _later(self) -> list[str]:
        """Where the other components differ first, in words and in the order of time."""
        first = self.difference.first
        others = []
        for entry in self.components:
            if entry.first is not None and entry.first != first:
                others.append(entry.first)
        others.sort(key=lambda element: element.time_ns)
        lines = [f"then: {_difference_text(element)}" for element in others[:_MOST_SHOWN]]
        further = len(others) - _MOST_SHOWN
        if further > 0:
            lines.append(f"then: {further} more component{'' if further == 1 else 's'}")
        return lines

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
            "computed": list(self.computed),
            "copied": list(self.copied),
            "code": list(self.code),
            "left_out": list(self.left_out),
            "components": [entry.to_dict() for entry in self.components],
            "environment": {
                name: {"recorded": recorded, "present": present}
                for name, (recorded, present) in self.environment.items()
            },
            "substeps_copied": [asdict(copied) for copied in self.substeps],
            "contradictions": [asdict(entry) for entry in self.contradictions],
            **self.difference.to_dict(),
        }


def _difference_text(element: ElementDifference) -> str:
    time = element.time_ns / 1e9
    recorded, computed = element.texts
    return (
        f"{element.signal} at t = {time} s: log {recorded}, replay {computed}; "
        f"{element.differing_bits} of the 64 bits differ"
    )


def _in_words(row: SignalDifference) -> str:
    rows_a, rows_b, _ = row.rows
    return f"{row.signal}: {row.status}: {rows_a} rows in the log, {rows_b} in the replay"
