"""Members in child processes of this machine: one that crashes or hangs costs itself only.

Each worker is a child process, and a thread of this one that asks it for one member after the
other. What a crash destroys may be the work of an earlier member: so a member with which a worker
crashes that has done others is done once more, as the first of a new worker.
"""

from __future__ import annotations

import pickle
import platform
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from itertools import islice
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from time import monotonic
from types import TracebackType
from typing import Any, Final, Self, final

from cosim.errors import CosimError, RunError, UsageError, option, quoted
from cosim.interrupts import uninterrupted
from cosim.processes import child_environment, describe_exit, kill, with_one_thread
from cosim.studies.contracts import (
    COMPLETE,
    FAILED,
    HANGS,
    MemberOutcome,
    StudyMember,
    StudySubject,
)
from cosim.studies.members import run_member
from cosim.studies.worker import DONE, HEAD, LOST, MARK, REFUSED, SOCKET_LOST, packed
from cosim.temporary import TemporaryFolder

VARIABLE: Final = "COSIM_WORKER"  # set in a worker
LEAST: Final = 60.0  # [s] that a member may take, and
FACTOR: Final = 10.0  # times the longest of
FIRST_MEMBERS: Final = 10  # that were completed
UNTIL_TIMED: Final = 3600.0  # [s]; nothing is known before
AHEAD: Final = 2  # members of each worker that are taken
_OPENING: Final = 300.0  # [s] to open a subject; models may be compiled
_OPENINGS: Final = 3  # in a row that are lost: the next will be, too
_ENDING: Final = 2.0  # [s] to free what was loaded
_LOOK: Final = 0.25  # [s] between looks at a worker that does not answer
_CLOSING: Final = 1.0  # [s] that a process may take to end once its socket is closed
_CHUNK: Final = 65536  # bytes that are read at once


@final
class LocalExecutor:
    """Child processes that run members of one study; a context manager that ends them.

    What members print is discarded. Each worker leads a session of its own, keeps temporary files
    in a folder of the executor, and ends with this process, however that ends.

    Parameters
    ----------
    subject : StudySubject
    workers : int
        At a time.
    timeout : float or None
        Wall time that a member may take [s]; None: 10 times the longest of the first ten that were
        completed, at least 60 s.
    members_per_worker : int or None
        After so many a worker is replaced; None: never.

    Raises
    ------
    UsageError
        If a number is not positive, or this is Windows.
    """

    def __init__(
        self,
        subject: StudySubject,
        workers: int,
        *,
        timeout: float | None = None,
        members_per_worker: int | None = None,
    ) -> None:
        if sys.platform == "win32":
            raise UsageError(
                "a study runs its members in processes that it can end together with their "
                "children; expected Linux or macOS, got Windows"
            )
        for name, value in (("workers", workers), ("timeout", timeout)):
            if value is not None and not value > 0:
                raise UsageError(f"{option(name)}: expected a positive number, got {value!r}")
        self._subject = subject
        self._count = workers
        self._most = members_per_worker or sys.maxsize
        self._timeout = timeout
        self._timed = 0
        self._longest = 0.0
        self._lost_openings = 0  # in a row
        self._children: set[_Child] = set()
        self._idle: deque[_Child] = deque()
        self._lock = Lock()
        self._is_closed = False

    def __enter__(self) -> Self:
        self._folder = TemporaryFolder("workers")
        self._threads = ThreadPoolExecutor(self._count, "cosim-worker")
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with uninterrupted():
            self._is_closed = True
            self._threads.shutdown(wait=False, cancel_futures=True)
            limit = monotonic() + (_ENDING if error_type is None else 0.0)
            children = [*self._children]
            for child in children:
                child.close()
            for child in children:
                child.end(max(0.0, limit - monotonic()))
            self._threads.shutdown()
            for child in [*self._children]:  # one that was started meanwhile
                child.end()
            self._folder.remove()

    def run(
        self,
        members: Iterable[StudyMember],
        function: Callable[[StudySubject, StudyMember], Any] = run_member,
    ) -> Iterator[tuple[StudyMember, Any]]:
        """Yield members with what a function returns of them, as they come.

        Members are taken as workers need them. Where the iterator is closed before its end, members
        that were begun are lost.

        Parameters
        ----------
        members : iterable of StudyMember
        function : callable
            Of a module, or a ``partial`` of one; called in a worker with the subject and a member.

        Yields
        ------
        member : StudyMember
        result
            What the function returned; or a MemberOutcome that failed, where the worker was lost.

        Raises
        ------
        UsageError
            If a worker refuses the subject: a scenario with an error.
        ChangedFileError
            If a member reads another file than the study began with.
        RunError
            If workers are lost one after the other while they open the subject.
        """
        waiting = iter(members)
        running: dict[Future[Any], StudyMember] = {}
        done: SimpleQueue[Future[Any]] = SimpleQueue()
        try:
            while True:
                for member in islice(waiting, AHEAD * self._count - len(running)):
                    future = self._threads.submit(self._do, function, member)
                    running[future] = member
                    future.add_done_callback(done.put)
                if not running:
                    return
                future = done.get()
                yield running.pop(future), future.result()
        finally:
            if running:
                self._drop(running)

    def _drop(self, running: Iterable[Future[Any]]) -> None:
        """Give up members that were begun."""
        begun = [future for future in running if not future.cancel()]
        for child in [*self._children]:
            if child not in self._idle:
                child.kill()
        for future in begun:
            future.exception()

    def _do(self, function: Callable[..., Any], member: StudyMember) -> Any:
        request = packed((function, member))
        child = self._take()
        try:
            reply = child.ask(request, lambda: self._limit[0])
        except _LostError as lost:
            if child.answered == 0 or lost.hangs or self._is_closed:
                return self._failed(member, child, lost)
            child = self._take(fresh=True)
            try:
                reply = child.ask(request, lambda: self._limit[0])
            except _LostError as again:
                return self._failed(member, child, again)
        return self._taken(member, child, reply)

    def _taken(self, member: StudyMember, child: _Child, reply: tuple[Any, ...]) -> Any:
        """Return what a worker answered, and let it wait for the next member."""
        if reply[0] == REFUSED or (reply[0] == DONE and child.answered < self._most):
            self._idle.append(child)
        else:
            child.end(_ENDING)
            self._children.discard(child)
        if reply[0] == LOST:
            return self._failed(member, child, _LostError(reply[1]))
        if reply[0] == REFUSED:
            raise reply[1](reply[2])
        result = reply[1]
        if isinstance(result, MemberOutcome) and result.status == COMPLETE:
            with self._lock:
                if self._timed < FIRST_MEMBERS:
                    self._timed += 1
                    self._longest = max(self._longest, child.seconds)
        return result

    def _failed(self, member: StudyMember, child: _Child, lost: _LostError) -> MemberOutcome:
        child.end()
        self._children.discard(child)
        reason = lost.reason
        if lost.hangs:
            limit, origin = self._limit
            reason = f"{HANGS}did not end within {limit:g} s{origin}"
        return MemberOutcome(
            member.number, FAILED, reason=reason, wall_time=child.seconds, worker=child.name
        )

    @property
    def _limit(self) -> tuple[float, str]:
        """Wall time after which a member hangs [s], and where it comes from."""
        if self._timeout is not None:
            return self._timeout, ""
        if not self._timed:
            text = "the limit until a member is completed"
            return UNTIL_TIMED, f", {text}; set a timeout for another one"
        text = f"the larger of {LEAST:g} s and {FACTOR:g} times the longest of the first members"
        return max(LEAST, FACTOR * self._longest), f", {text}; set a timeout for another one"

    def _take(self, *, fresh: bool = False) -> _Child:
        """Return a worker that is ready."""
        while True:
            with suppress(IndexError):
                if not fresh:
                    return self._idle.pop()
            with uninterrupted():
                child = _Child(self._folder.path, packed(list(map(str, sys.path))))
                self._children.add(child)
            try:
                reply = child.ask(packed(self._subject), lambda: _OPENING)
            except _LostError as lost:
                child.end()
                self._children.discard(child)
                self._count_opening(lost)
                continue
            if reply[0] == DONE:
                self._lost_openings = 0
                child.answered = 0
                return child
            child.end()
            self._children.discard(child)
            if reply[0] == LOST or reply[1] is CosimError:
                raise RunError(f"{quoted(self._subject.scenario)} cannot be opened: {reply[-1]}")
            raise reply[1](reply[2])

    def _count_opening(self, lost: _LostError) -> None:
        self._lost_openings += 1
        if lost.hangs or self._lost_openings >= _OPENINGS or self._is_closed:
            reason = f"{HANGS}did not end within {_OPENING:g} s" if lost.hangs else lost.reason
            raise RunError(
                f"the process that opens {quoted(self._subject.scenario)} {reason}, "
                f"{self._lost_openings} times in a row; run 'cosim check' on its FMUs"
            )


class _LostError(Exception):
    """A worker gave no answer."""

    def __init__(self, reason: str, *, hangs: bool = False) -> None:
        super().__init__(reason)
        self.reason = reason
        self.hangs = hangs


@final
class _Child:
    """A child process that answers one request after the other."""

    def __init__(self, folder: Path, first: bytes) -> None:
        own, other = socket.socketpair()
        with other:
            number = other.fileno()
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "cosim.studies.worker", str(number)],
                env=with_one_thread(child_environment(folder, VARIABLE)),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=(number,),
                start_new_session=True,
            )
        self._socket = own
        self._first = first
        self.name = f"{platform.node()}:{self._process.pid}"
        self.answered = 0
        self.seconds = 0.0  # that the last request took

    def ask(self, request: bytes, limit: Callable[[], float]) -> tuple[Any, ...]:
        """Return the answer to a request.

        Raises
        ------
        _LostError
            If the process ends, hangs, or answers with anything else.
        """
        began = monotonic()
        with suppress(OSError):  # it has ended: what is read says how
            self._socket.settimeout(limit())
            self._socket.sendall(self._first + request)
        self._first = b""
        self._socket.settimeout(_LOOK)
        received = bytearray()
        while True:
            try:
                part = self._socket.recv(_CHUNK)
            except TimeoutError:
                self.seconds = monotonic() - began
                if self._process.poll() is not None:  # what it started keeps the socket open
                    raise self._ended() from None
                if self.seconds > limit():
                    raise _LostError("hangs", hangs=True) from None
                continue
            except OSError:
                part = b""
            self.seconds = monotonic() - began
            if not part:
                raise self._ended()
            received += part
            if len(received) >= HEAD.size:
                mark, count = HEAD.unpack_from(received)
                if mark != MARK:
                    raise _GARBLED
                if len(received) >= HEAD.size + count:
                    break
        try:
            reply: tuple[Any, ...] = pickle.loads(received[HEAD.size :])
        except Exception:  # whatever was written there
            raise _GARBLED from None
        self.answered += 1
        return reply

    def _ended(self) -> _LostError:
        code = None
        with suppress(subprocess.TimeoutExpired):
            code = self._process.wait(_CLOSING)
        if code is None or code == SOCKET_LOST:
            return _LostError("closes the pipe of its worker process")
        return _LostError(describe_exit(code))

    def close(self) -> None:
        """Let it end: it frees what it has loaded, and ends."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def kill(self) -> None:
        """End it, and what it started."""
        kill(self._process)

    def end(self, seconds: float = 0.0) -> None:
        """Let it end in that time, then end it."""
        self.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        kill(self._process)
        self._socket.close()


_GARBLED: Final = _LostError("writes into the pipe of its worker process")
