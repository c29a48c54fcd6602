"""Which members a task has: enough to be worth a message, few enough to share the rest.

A part of the dataset without any outcome is one task, so that a worker can write it, as long as
there are many parts and each is quick. Else a task is some members, and their outcomes come back.
The last tasks are the shortest: at the end all threads wait for the last one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final, final

LEAST: Final = 0.25  # [s] of members in a task
TASK_RATE: Final = 100.0  # [1/s] that a scheduler has time for
MOST: Final = 10.0
MOST_OF_PART: Final = 60.0  # [s] that is lost when the worker of a whole part is
MOST_MEMBERS: Final = 1000  # of a task that is no part: what its message holds
PARTS_PER_THREAD: Final = 2  # that remain, else the last ones are shared out in pieces
PIECES_PER_THREAD: Final = 4  # of what remains
FORGETTING: Final = 0.7


@dataclass(frozen=True, slots=True)
class MemberTask:
    """Members that one task runs.

    Parameters
    ----------
    members : range
    is_part : bool
        They are a part of the dataset without any outcome.
    """

    members: range
    is_part: bool


@final
class RemainingTasks:
    """The members that no task has.

    Parameters
    ----------
    missing : iterable of range
        The members without an outcome, in order.
    parts : iterable of range
        The parts without any.
    """

    def __init__(self, missing: Iterable[range], parts: Iterable[range]) -> None:
        self._pieces = deque(_pieces(missing, {part.start: part for part in parts}))
        self._returned: deque[MemberTask] = deque()
        self._seconds: float | None = None  # of a member
        self.count = sum(len(piece.members) for piece in self._pieces)

    def __bool__(self) -> bool:
        return bool(self._pieces or self._returned)

    def note(self, count: int, seconds: float) -> None:
        """Take into account how long the members of a task took [s]."""
        recent = seconds / count
        before = recent if self._seconds is None else self._seconds
        self._seconds = FORGETTING * before + (1 - FORGETTING) * recent

    def give_back(self, task: MemberTask) -> None:
        """Take back members whose task came to nothing."""
        self.count += len(task.members)
        self._returned.append(task)

    def take(self, threads: int) -> MemberTask:
        """Return the next task.

        Parameters
        ----------
        threads : int
            That share what remains.
        """
        task = self._returned.popleft() if self._returned else self._next(threads)
        self.count -= len(task.members)
        return task

    def _next(self, threads: int) -> MemberTask:
        piece = self._pieces.popleft()
        members = piece.members
        if piece.is_part and self._is_worth_a_task(piece, threads):
            return piece
        size = self._size(threads)
        if size < len(members):
            self._pieces.appendleft(MemberTask(members[size:], is_part=False))
            return MemberTask(members[:size], is_part=False)
        return piece

    def _is_worth_a_task(self, piece: MemberTask, threads: int) -> bool:
        if self._seconds is None or self._seconds * len(piece.members) > MOST_OF_PART:
            return False
        return len(self._pieces) >= PARTS_PER_THREAD * threads

    def _size(self, threads: int) -> int:
        if self._seconds is None:
            return 1
        share = self.count / (PIECES_PER_THREAD * threads)
        seconds = max(self._seconds, 1e-6)
        least = max(LEAST, threads / TASK_RATE)
        wanted = max(least / seconds, min(MOST / seconds, share))
        return max(1, min(MOST_MEMBERS, round(wanted)))


def _pieces(missing: Iterable[range], parts: dict[int, range]) -> Iterator[MemberTask]:
    """Cut what is missing where parts without any outcome begin and end."""
    for members in missing:
        begin = first = members.start
        while first < members.stop:
            part = parts.get(first)
            if part is None:
                first += 1
                continue
            if begin < first:
                yield MemberTask(range(begin, first), is_part=False)
            yield MemberTask(part, is_part=True)
            begin = first = part.stop
        if begin < members.stop:
            yield MemberTask(range(begin, members.stop), is_part=False)
