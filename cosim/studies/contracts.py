"""What the parts of a study hand to each other: members, their outcomes, and what runs them.

All of it is plain data that JSON carries exactly, so that it means the same in this process, in a
worker, and on another machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from types import TracebackType
from typing import Any, Final, Literal, Protocol, Self, TypeAlias

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
    designs : str
        What was designed for it alone where it ran before, as of MemberOutcome; empty: that is
        computed.
    """

    number: int
    set: Mapping[str, Any] = field(default_factory=dict)
    swap: Mapping[str, str] = field(default_factory=dict)
    recording: str | None = None
    designs: str = ""


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
    designs : str
        JSON of what was designed for this member alone (gains, discretized matrices); empty:
        nothing was.
    worker : str
        Where it ran.
    warnings : sequence of str
        What it warned of, in alphabetical order.
    details : mapping of name to value
        What its runner says of it besides; that is not recorded.
    """

    number: int
    status: MemberStatus
    reason: str = ""
    steps: int = 0
    metrics: Mapping[str, MetricValue] = field(default_factory=dict)
    wall_time: float = 0.0
    designs: str = ""
    worker: str = ""
    warnings: Sequence[str] = ()
    details: Mapping[str, MetricValue] = field(default_factory=dict)


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
    logs : str
        Folder for the logs of members that are logged.
    designs : str
        What was designed where the study was planned (gains, discretized matrices) for all members
        alike: JSON. Linear algebra gives other bits on other machines. Empty: it is computed.
    replay_designs : sequence of (recording, JSON)
        The same for members that replay one log: what that does not have.
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
    logs: str = ""
    designs: str = ""
    replay_designs: Sequence[Sequence[str]] = ()
    digests: Mapping[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)


class MemberRunner(Protocol):
    """Runs members one after the other in this process; a context manager that frees what it holds.

    What fails in a run is an outcome. A crash or a hang of a foreign binary is not: it is the
    process that is lost, which is why members run in workers.
    """

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free what it holds."""
        ...

    def run(self, member: StudyMember) -> MemberOutcome:
        """Run a member."""
        ...
