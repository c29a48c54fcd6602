"""What the parts of a study hand to each other: members, their outcomes, and what runs them.

All of it is plain data that JSON carries exactly, so that it means the same in this process, in a
worker, and on another machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, TypeAlias

MetricValue: TypeAlias = float | str | None
MemberStatus: TypeAlias = Literal["complete", "failed"]

COMPLETE: Final = "complete"
FAILED: Final = "failed"
RECORDING: Final = "recording"  # name of the column with the log that is replayed
SWAP: Final = "swap."  # what the key of a swap that is varied begins with
MOST_MEMBERS: Final = 2 * 10**7  # whose columns fit into the memory of a small machine
HANGS: Final = "hangs: "  # begins the reason of a member that took longer than it might


@dataclass(frozen=True, slots=True)
class StudyMember:
    """One run of a study; it follows from the study's file alone.

    Parameters
    ----------
    number : int
        From 0.
    set : mapping of dotted key to value
        As of ``cosim run --set``; the values are as TOML has them.
    swap : mapping of component name to path
        As of ``cosim run --swap``.
    recording : str or None
        The log that is replayed with these edits; None: the scenario is run.
    """

    number: int
    set: Mapping[str, Any] = field(default_factory=dict)
    swap: Mapping[str, str] = field(default_factory=dict)
    recording: str | None = None


def member_of(number: int, values: Mapping[str, Any]) -> StudyMember:
    """Return the member that has some values; None stands for the scenario's own."""
    given = {name: value for name, value in values.items() if value is not None}
    recording = given.pop(RECORDING, None)
    swaps = {n.removeprefix(SWAP): str(v) for n, v in given.items() if n.startswith(SWAP)}
    changes = {name: value for name, value in given.items() if not name.startswith(SWAP)}
    return StudyMember(number, changes, swaps, recording)


@dataclass(frozen=True, slots=True)
class MemberOutcome:
    """What a member came to.

    Parameters
    ----------
    number : int
    status : {"complete", "failed"}
    reason : str
        Why it failed, or ended before its stop; empty: it did not.
    steps : int
        Communication steps that were completed.
    metrics : mapping of name to value
        None: there is none, such as where it failed.
    wall_time : float
        [s], building included.
    worker : str
        Where it ran.
    warnings : sequence of str
        What it warned of, in alphabetical order.
    """

    number: int
    status: MemberStatus
    reason: str = ""
    steps: int = 0
    metrics: Mapping[str, MetricValue] = field(default_factory=dict)
    wall_time: float = 0.0
    worker: str = ""
    warnings: Sequence[str] = ()


MemberResult: TypeAlias = tuple[StudyMember, MemberOutcome]  # what was run, and what it came to


@dataclass(frozen=True, slots=True)
class StudySubject:
    """What all members of a study have in common.

    Parameters
    ----------
    scenario : str
        Path, or name of a shipped scenario.
    set, swap, map
        The edits that all members have, as of :func:`cosim.run`.
    metrics : mapping of name to expression
    with_results : bool
        Keep, beside the metrics, what the result of a run says: estimates, errors, verdicts.
    allow_code : bool
        Of members that replay logs, as of :func:`cosim.replay`.
    digests : mapping of path to SHA-256
        Of all files that members read, as they were when the study was planned, under the absolute
        paths that are opened; behind ``code of`` those of the classes of users. A member that
        finds another content is not run. Empty: nothing is checked.
    """

    scenario: str
    set: Mapping[str, Any] = field(default_factory=dict)
    swap: Mapping[str, str] = field(default_factory=dict)
    map: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, str] = field(default_factory=dict)
    with_results: bool = False
    allow_code: bool = False
    digests: Mapping[str, str] = field(default_factory=dict)
