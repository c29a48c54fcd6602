"""The members that no worker has."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import final

from cosim.studies.contracts import StudyMember


@final
class RemainingMembers:
    """Members that are taken one by one from where they come, and those that came back.

    One that ran when its worker was lost, after others, is retried as the first of a new worker:
    what the others left may be the cause.
    """

    def __init__(self, members: Iterable[StudyMember]) -> None:
        self._members: Iterator[StudyMember] = iter(members)
        self._is_exhausted = False
        self._returned: deque[StudyMember] = deque()
        self._retried: deque[StudyMember] = deque()

    @property
    def is_empty(self) -> bool:
        """Whether it is known that there are none."""
        return self._is_exhausted and not self._returned and not self._retried

    def take(self, most: int) -> list[StudyMember]:
        """Return the next members, for a worker that runs others too."""
        taken: list[StudyMember] = []
        while self._returned and len(taken) < most:
            taken.append(self._returned.popleft())
        taken += islice(self._members, most - len(taken))
        self._is_exhausted = len(taken) < most
        return taken

    def take_first(self) -> list[StudyMember]:
        """Return the member that a new worker begins with; empty: there is none."""
        return [self._retried.popleft()] if self._retried else self.take(1)

    def give_back(self, members: Iterable[StudyMember]) -> None:
        """Take back members that a worker had in its pipe; they are the next."""
        self._returned.extendleft(reversed(list(members)))

    def retry(self, member: StudyMember) -> None:
        """Take back a member that may have been lost by what others left."""
        self._retried.append(member)
