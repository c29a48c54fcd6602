"""What a cluster needs of a study: its members by number, and where their outcomes are recorded."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from cosim.studies.contracts import MemberOutcome, MemberResult, StudyMember


class OutcomeSink(Protocol):
    """Where outcomes are recorded, such as the dataset of a study."""

    @property
    def sha256(self) -> str:
        """Tells it from others, for workers that write parts."""
        ...

    @property
    def failed(self) -> int:
        """How many members have failed."""
        ...

    def __len__(self) -> int: ...

    def missing(self, total: int | None = None) -> list[range]:
        """Return the members without an outcome, below a number."""
        ...

    def empty_parts(self) -> list[range]:
        """Return the parts without any outcome."""
        ...

    def add(self, member: StudyMember, outcome: MemberOutcome) -> None:
        """Record an outcome."""
        ...

    def write_part(self, first: int, results: Iterable[MemberResult]) -> None:
        """Write a whole part."""
        ...

    def note_part(self, first: int) -> None:
        """Take notice of a part that a worker wrote."""
        ...


class PlannedMembers(Protocol):
    """The members of a study by number, such as its design."""

    def __len__(self) -> int: ...

    def members(self, begin: int = 0, end: int | None = None) -> list[StudyMember]:
        """Return the members from one number to another (not included)."""
        ...
