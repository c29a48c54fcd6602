"""Threads beside the one that writes or reads a log, for what leaves the interpreter to others.

Compression, CRCs and hashes of large pieces do: two threads take little more than half the time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from itertools import chain, islice
from types import TracebackType
from typing import Final, Self, TypeVar, final

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_THREADS: Final = 2


@final
class Workers:
    """Two threads, which are started when there is work for them."""

    @cached_property
    def _executor(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(_THREADS, thread_name_prefix="cosim log")

    def start(self, work: Callable[[], _Result]) -> Future[_Result]:
        """Let a thread do some work."""
        return self._executor.submit(work)

    def map(self, work: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
        """Return the results of some work on each item, in their order."""
        every = list(items)
        if len(every) < _THREADS:
            return [work(item) for item in every]
        return list(self._executor.map(work, every))

    def ahead(self, works: Iterator[Callable[[], _Result]]) -> Iterator[_Result]:
        """Yield the results of some works in their order; the next one is begun before."""
        few = list(islice(works, _THREADS))
        if len(few) < _THREADS:
            for work in few:
                yield work()
            return
        begun: deque[Future[_Result]] = deque()
        for work in chain(few, works):
            begun.append(self.start(work))
            if len(begun) == _THREADS:
                yield begun.popleft().result()
        while begun:
            yield begun.popleft().result()

    def close(self) -> None:
        """End the threads, when they have done what they began."""
        if "_executor" in self.__dict__:
            self._executor.shutdown(cancel_futures=True)
            del self._executor

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
