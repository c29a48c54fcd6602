"""Threads beside the one that writes or reads a log, for what leaves the interpreter to others.

Compression, CRCs and hashes of large pieces do: two threads take little more than half the time.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from itertools import chain, islice
from threading import Lock
from typing import Final, Generic, TypeVar, final

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_THREADS: Final = 2
# Beside the caller, who takes the results and makes some calls, too: more threads than processors
# would only wait.
THREADS_AHEAD: Final = max(1, min(_THREADS, (os.cpu_count() or 1) - 1))
AHEAD: Final = 4  # calls that are begun while the result of the first one is still used


@final
class _Task(Generic[_Result]):
    """A call that is made by whoever comes first."""

    def __init__(self, work: Callable[[], _Result]) -> None:
        self._work = work
        self._claim = Lock()
        self.outcome: Future[_Result] = Future()

    def do(self) -> None:
        """Make the call, unless another thread has begun to."""
        if not self._claim.acquire(blocking=False):
            return
        try:
            self.outcome.set_result(self._work())
        except BaseException as error:  # is raised where the result is asked for
            self.outcome.set_exception(error)


def _first_result(begun: deque[_Task[_Result]]) -> _Result:
    """Remove the first of some tasks and return its result; do others rather than wait for it."""
    for task in begun:
        if begun[0].outcome.done():
            break
        task.do()
    return begun.popleft().outcome.result()


@final
class Workers:
    """Threads, which are started when there is work for them.

    Parameters
    ----------
    threads : int
        How many at most.
    """

    def __init__(self, threads: int = _THREADS) -> None:
        self._threads = threads

    @cached_property
    def _executor(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self._threads, thread_name_prefix="cosim log")

    def start(self, work: Callable[[], _Result]) -> Future[_Result]:
        """Start some work in a thread."""
        return self._executor.submit(work)

    def map(self, work: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
        """Return the results of some work on each item, in their order."""
        every = list(items)
        if len(every) < _THREADS:
            return [work(item) for item in every]
        return list(self._executor.map(work, every))

    def ahead(self, works: Iterator[Callable[[], _Result]]) -> Iterator[_Result]:
        """Yield the results of some calls in their order; the next ones are begun before.

        Where the caller would wait for a result it makes one of the calls itself. A call is taken
        from ``works`` when the result of the call ``AHEAD`` before it is no longer used.
        """
        few = list(islice(works, 2))
        if len(few) < 2:
            for work in few:
                yield work()
            return
        begun: deque[_Task[_Result]] = deque()
        for work in chain(few, works):
            task = _Task(work)
            begun.append(task)
            self.start(task.do)
            if len(begun) == AHEAD:
                yield _first_result(begun)
        while begun:
            yield _first_result(begun)

    def close(self) -> None:
        """End the threads, when they have done what they began."""
        if "_executor" in self.__dict__:
            self._executor.shutdown(cancel_futures=True)
            del self._executor
