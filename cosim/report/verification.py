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

from collections.abc import Collection
from dataclasses import asdict, dataclass
from typing import Any

from cosim.core.recorders import Memory
from cosim.errors import command, flag, listing
from cosim.log import Log
from cosim.log.diff import LogDifference, SignalDifference, diff
from cosim.report.statements import COMPARED, NOT_COMPARED, Contradiction, contradictions
from cosim.scenario.recorded_metadata import (
    component_record,
    recorded_substep_counts,
    replay_origin,
)
from cosim.scenario.recordings.replaying import recorded_document

_MOST_SHOWN = 8  # contradictions


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
            f"not computed, but copied from the log: the substeps of the loop of "
            f"{listing(self.loop)} in /cosim/step: which were taken or refused, their estimated "
            f"errors, the inputs at their ends and there the outputs of {listing(self.copied)}"
        )
        if len(self.copied) < len(self.loop):
            text += "; the other outputs there were compared"
        return text


@dataclass(frozen=True)
class Verification:
    """A log beside its replay.

    Parameters
    ----------
    recorded_hash : str
        Content hash that the run recorded.
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
    substeps : tuple of CopiedSubsteps
    scenario : str
        Where the scenario came from.
    """

    recorded_hash: str
    found_hash: str
    difference: LogDifference
    contradictions: tuple[Contradiction, ...]
    copied: tuple[str, ...]
    code: tuple[str, ...]
    substeps: tuple[CopiedSubsteps, ...]
    scenario: str

    @property
    def passed(self) -> bool:
        """Whether the content is what was recorded, and follows by computation where it can."""
        same_rows = self.found_hash == self.recorded_hash and self.difference.same_rows
        return same_rows and not self.contradictions

    @property
    def computed(self) -> tuple[str, ...]:
        """Signals that were computed again: outputs, and inputs by their connections."""
        names = [row.signal for row in self.difference.rows]
        copied = set(self.copied)
        return tuple(name for name in names if name not in copied)

    @property
    def lines(self) -> list[str]:
        """What has been proven, in words."""
        lines = [
            "the content hash is the one that its run recorded",
            f"the replay equals the log bit for bit: {len(self.computed)} signals computed again",
            f"what the log says of its run is what the replay computes: {COMPARED}",
        ]
        if self.code:
            names = ", ".join(self.code)
            lines.append(
                f"not verified, as nothing computed it: {names}; {flag('allow_code')} does, which "
                "runs the code of its user"
            )
        others = [name for name in self.copied if name not in self.code]
        if others:
            names = ", ".join(others)
            lines.append(
                f"not computed, but copied from the log: {names}; to compute these too, run "
                f"{self.scenario!r} again with the changes it had, and compare with "
                f"{command('diff')}"
            )
        lines += map(str, self.substeps)
        lines.append(
            f"not compared: {NOT_COMPARED}; nor is the log signed: a log of another run, put in "
            "its place as a whole, passes"
        )
        return lines

    @property
    def problems(self) -> list[str]:
        """What is wrong, in words."""
        problems = []
        if self.found_hash != self.recorded_hash:
            problems.append(
                "the rows are not those that its run recorded: their content hash is "
                f"{self.found_hash}, recorded {self.recorded_hash}"
            )
        if not self.difference.same_rows:
            problems.append(f"the replay differs from the log; first: {self._first}")
        for contradiction in self.contradictions[:_MOST_SHOWN]:
            problems.append(f"the log contradicts its scenario: {contradiction}")
        further = len(self.contradictions) - _MOST_SHOWN
        if further > 0:
            problems.append(f"the log contradicts its scenario: {further} times more")
        return problems

    @property
    def _first(self) -> str:
        first = self.difference.first
        if first is None:
            row = next(row for row in self.difference.rows if row.status != "equal")
            return _in_words(row)
        time = first.time_ns / 1e9
        return f"{first.signal} at t = {time} s: log {first.a!r}, replay {first.b!r}"

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        return {
            "passed": self.passed,
            "content_hash": {
                "recorded": self.recorded_hash,
                "found": self.found_hash,
                "equal": self.found_hash == self.recorded_hash,
            },
            "computed": list(self.computed),
            "copied": list(self.copied),
            "code": list(self.code),
            "substeps_copied": [asdict(copied) for copied in self.substeps],
            "contradictions": [asdict(entry) for entry in self.contradictions],
            **self.difference.to_dict(),
        }


def _in_words(row: SignalDifference) -> str:
    rows_a, rows_b, _ = row.rows
    return f"{row.signal}: {row.status}: {rows_a} rows in the log, {rows_b} in the replay"


def _copied_substeps(again: Log | Memory, copied: Collection[str]) -> tuple[CopiedSubsteps, ...]:
    """Return the substeps of loops with components that a replay copied."""
    found = []
    for counts in recorded_substep_counts(again):
        inside = tuple(name for name in counts.components if name in copied)
        if inside:
            found.append(CopiedSubsteps(counts.components, inside))
    return tuple(found)


def verify(source: Log, again: Log | Memory) -> Verification:
    """Compare a log with its replay and with the hash that its run recorded.

    Parameters
    ----------
    source : Log
    again : Log or Memory
        What :func:`cosim.replay` made of it.

    Raises
    ------
    LogError
        If the log is damaged, has no content hash, or says what cannot be understood.
    """
    recorded_hash = source.recorded_hash
    found_hash = source.content_hash()
    origin = replay_origin(again)
    copied = []
    code = []
    for name in origin.copied:
        signals = [f"{name}.{signal.name}" for signal in again.channels[name].interface.outputs]
        copied += signals
        if component_record(again, name).code is not None:
            code += signals
    computed = again.channels.keys() - set(origin.copied)
    return Verification(
        recorded_hash,
        found_hash,
        diff(source, again),
        contradictions(source, again, computed),
        tuple(copied),
        tuple(code),
        _copied_substeps(again, origin.copied),
        recorded_document(source).source,
    )
