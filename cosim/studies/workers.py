"""Members in child processes of this machine: one that crashes or hangs costs itself only.

What a crash destroys may be the work of an earlier member: so a member with which a worker crashes
that has done others is done once more, as the first of a new worker.

Pools of libraries lose more: with distributed innocent members go with one that crashes, with loky
all that are at work, and pebble hangs on what foreign code writes into its pipes.
"""

from __future__ import annotations

import pickle
import platform
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from multiprocessing.connection import wait
from pathlib import Path
from time import monotonic
from typing import Any, Final, Self, TypeAlias, final

from cosim.errors import RunError, UsageError, option, quoted
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
from cosim.studies.worker import DONE, HEAD, MARK, REFUSED, SOCKET_LOST
from cosim.temporary import TemporaryFolder

LEAST: Final = 60.0  # [s] that a member may take, and
FACTOR: Final = 10.0  # times the longest of
FIRST_MEMBERS: Final = 10  # that were completed
UNTIL_TIMED: Final = 3600.0  # [s]; nothing is known before
_OPENING: Final = 300.0  # [s] to open a subject; models may be compiled
_OPENINGS: Final = 3  # in a row that are lost: the next will be, too
_ENDING: Final = 2.0  # [s] to free what was loaded
_LOOK: Final = 0.25  # [s] between looks at workers that do not answer
_CLOSING: Final = 1.0  # [s] that a process may take to end once its socket is closed
_CHUNK: Final = 65536  # bytes that are read at once
_CRASHED: Final = "crashed"  # with a reason: the process is lost, perhaps by an earlier member
_HUNG: Final = "hung"  # with a reason
_AGAIN: Final = object()  # instead of a result: another worker has to do the member
_Reply: TypeAlias = tuple[Any, ...]  # what came of a request: one of those words, and what it has


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
        given = {"workers": workers, "timeout": timeout, "members_per_worker": members_per_worker}
        for name, value in given.items():
            if value is not None and not value > 0:
                raise UsageError(f"{option(name)}: expected a positive number, got {value!r}")
        self._subject = subject
        self._count = workers
        self._most = members_per_worker
        self._timeout = timeout
        self._times: list[float] = []  # of the first members that were completed [s]
        self._lost_openings = 0  # in a row
        self._children: set[_Child] = set()
        self._idle: list[_Child] = []
        self._is_stopped = False

    def __enter__(self) -> Self:
        self._folder = TemporaryFolder("workers")
        return self

    def __exit__(self, error_type: object, *rest: object) -> None:
        with uninterrupted():
            limit = monotonic() + (_ENDING if error_type is None else 0.0)
            for child in self._children:
                child.close()
            for child in [*self._children]:
                self._end(child, limit - monotonic())
            self._folder.remove()

    def run(
        self,
        members: Iterable[StudyMember],
        function: Callable[[StudySubject, StudyMember], Any] = run_member,
    ) -> Iterator[tuple[StudyMember, Any]]:
        """Yield members with what a function returns of them, as they come.

        Members are taken as workers need them. Where the iterator is closed before its end, members
        that were begun are lost. Threads may have iterators of their own, each with its workers.

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
        again: deque[StudyMember] = deque()  # with which a worker was lost that had done others
        busy: dict[_Child, StudyMember] = {}
        done: deque[tuple[StudyMember, Any]] = deque()
        try:
            while not self._is_stopped:
                while len(busy) < self._count and len(busy) + len(done) < 2 * self._count:
                    is_fresh = bool(again)
                    member = again.popleft() if is_fresh else next(waiting, None)
                    if member is None:
                        break
                    child = self._child(is_fresh)
                    busy[child] = member
                    child.send(pickle.dumps((function, member)))
                if done:  # while workers are at work, however long the caller takes
                    yield done.popleft()
                elif not busy:
                    break
                wait([child.socket for child in busy], 0.0 if done or not busy else _LOOK)
                for child in [*busy]:
                    reply = child.reply(self._limit)
                    if reply is not None:
                        member = busy.pop(child)
                        result = self._result(child, member, *reply)
                        if result is _AGAIN:
                            again.append(member)
                        else:
                            done.append((member, result))
        finally:
            for child in busy:
                self._end(child)

    def stop(self) -> None:
        """Let what runs members end, soon and without the rest of them; any thread may ask."""
        self._is_stopped = True

    @property
    def _limit(self) -> float:
        """Wall time after which a member hangs [s]."""
        if self._timeout is not None:
            return self._timeout
        return max(LEAST, FACTOR * max(self._times)) if self._times else UNTIL_TIMED

    def _result(self, child: _Child, member: StudyMember, kind: str, *values: Any) -> Any:
        """Return what came of a member, and let its worker wait for the next one, or end it."""
        if child.is_open:
            self._lost_openings = 0
        if child.is_open and kind in (DONE, REFUSED) and child.answered != self._most:
            self._idle.append(child)
        else:
            self._end(child, 0.0 if kind in (_CRASHED, _HUNG) else _ENDING)
        if kind == REFUSED:
            error_type, text = values
            raise error_type(text)
        (result,) = values
        if kind == _CRASHED and child.answered:
            return _AGAIN
        if not child.is_open:
            self._lost_openings += 1
            if kind == _CRASHED and self._lost_openings < _OPENINGS:
                return _AGAIN
            times = f", {_OPENINGS} times in a row" if kind == _CRASHED else ""
            raise RunError(f"{quoted(self._subject.scenario)} cannot be opened: {result}{times}")
        if kind != DONE:
            if kind == _HUNG and self._timeout is None:
                result += (
                    f", the larger of {LEAST:g} s and {FACTOR:g} times the longest of the first "
                    f"members ({UNTIL_TIMED:g} s for these); set a timeout for another limit"
                )
            seconds = monotonic() - child.began
            return MemberOutcome(
                member.number, FAILED, result, wall_time=seconds, worker=child.name
            )
        if isinstance(result, MemberOutcome) and result.status == COMPLETE:
            self._times = [*self._times, result.wall_time][:FIRST_MEMBERS]
        return result

    def _child(self, is_fresh: bool) -> _Child:
        """Return a worker that waits, or a new one."""
        if not is_fresh:
            with suppress(IndexError):
                return self._idle.pop()
        with uninterrupted():
            child = _Child(self._folder.path, self._subject)
            self._children.add(child)
        return child

    def _end(self, child: _Child, seconds: float = 0.0) -> None:
        """Let a worker end in that time, then end it, and what it started."""
        self._children.discard(child)
        child.close()
        with suppress(subprocess.TimeoutExpired):
            child.process.wait(max(0.0, seconds))
        kill(child.process)
        child.socket.close()


@final
class _Child:
    """A child process that opens a subject, then answers one request after the other."""

    def __init__(self, folder: Path, subject: StudySubject) -> None:
        self.socket, other = socket.socketpair()
        with other:
            number = other.fileno()
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-m", "cosim.studies.worker", str(number)],
                env=with_one_thread(child_environment(folder, "COSIM_WORKER")),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=(number,),
                start_new_session=True,
            )
        self.name = f"{platform.node()}:{self.process.pid}"
        self.is_open = False
        self.answered = 0  # requests
        self._received = bytearray()
        self.send(pickle.dumps(list(map(str, sys.path))) + pickle.dumps(subject))

    def send(self, request: bytes) -> None:
        """Send a request; until the subject is open it waits in the socket."""
        self.began = monotonic()
        with suppress(OSError):  # it has ended, or hangs: what comes of it says so
            self.socket.settimeout(_OPENING)
            self.socket.sendall(request)
        self.socket.setblocking(False)

    def reply(self, limit: float) -> _Reply | None:
        """Return what came of a request that may take so long [s]; None: nothing yet."""
        limit = limit if self.is_open else _OPENING
        has_ended = self.process.poll() is not None  # what it started keeps the socket open
        part = b""
        try:
            part = self.socket.recv(_CHUNK)
        except BlockingIOError:
            if not has_ended:
                is_late = monotonic() - self.began > limit
                return (_HUNG, f"{HANGS}did not end within {limit:g} s") if is_late else None
        except OSError:
            pass
        self._received += part
        return self._unpacked() if part else self._ended()

    def _unpacked(self) -> _Reply | None:
        """Return the reply that is there as a whole; None: nothing but the opening is."""
        received = self._received
        garbled = _CRASHED, "writes into the pipe of its worker process"
        if not received.startswith(MARK[: len(received)]):
            return garbled
        end = HEAD.size
        if len(received) >= end:
            end += HEAD.unpack_from(received)[1]
        if len(received) < end:
            return None
        try:
            reply: _Reply = pickle.loads(received[HEAD.size : end])
        except Exception:  # whatever was written there
            return garbled
        del received[:end]
        if self.is_open:
            self.answered += 1
        elif reply[0] == DONE:
            self.is_open = True
            self.began = monotonic()
            return self._unpacked()
        return reply

    def _ended(self) -> _Reply:
        code = None
        with suppress(subprocess.TimeoutExpired):
            code = self.process.wait(_CLOSING)
        if code is None or code == SOCKET_LOST:
            return _CRASHED, "closes the pipe of its worker process"
        return _CRASHED, describe_exit(code)

    def close(self) -> None:
        """Let it end: it frees what it has loaded, and ends."""
        with suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)
