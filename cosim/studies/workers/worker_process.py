"""A worker as its pool sees it: a child process, the pipes to it, and the members it has."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from time import monotonic
from typing import Final, NamedTuple, TypeAlias, final

from cosim.processes import child_environment, describe_exit, kill, with_one_thread
from cosim.studies.contracts import MemberOutcome, StudyMember
from cosim.studies.workers.messages import (
    WorkerAnswer,
    WorkerReady,
    WorkerRefusal,
    WorkerReply,
    decode_reply,
    encode_member,
)
from cosim.studies.workers.worker import PIPE_CLOSED, worker_name

WORKER: Final = "cosim.studies.workers.worker"
WORKER_VARIABLE: Final = "COSIM_WORKER"
_CHUNK: Final = 65536  # bytes that are read at once: what a pipe holds
_ENDING: Final = 1.0  # [s] that a process may take to end once its pipe is closed


class MemberAnswer(NamedTuple):
    """What a worker answered for one of its members, and how long that took [s]."""

    member: StudyMember
    outcome: MemberOutcome
    seconds: float


ReceivedReply: TypeAlias = WorkerReady | WorkerRefusal | MemberAnswer


@final
class WorkerProcess:
    """A child process that leads a session of its own; it is started here.

    Attributes
    ----------
    name : str
        As outcomes have it.
    queue : deque of StudyMember
        The members that it was given and has not answered; it runs the first.
    since : float
        When it began what it does now, of :func:`time.monotonic` [s].
    is_ready : bool
        Whether it has opened its runner.
    is_last : bool
        Whether it ends by itself, after what it does now.
    given, answered : int
        How many members.
    members, replies : int
        Descriptors of the pipes to it and from it.
    """

    def __init__(self, opening: bytes, folder: Path) -> None:
        self.queue: deque[StudyMember] = deque()
        self.since = monotonic()
        self.is_ready = False
        self.is_last = False
        self.given = 0
        self.answered = 0
        self._unsent = bytearray()
        self._received = b""
        self._is_garbled = False
        self._is_killed = False
        self._child, self.members, self.replies = _start(folder)
        self.name = worker_name(self._child.pid)
        self._write(opening)

    @property
    def is_full(self) -> bool:
        """Whether the pipe to it is: there is more to be written."""
        return bool(self._unsent)

    def give(self, members: Sequence[StudyMember]) -> None:
        """Hand members to it, in one write."""
        if not self.queue:
            self.since = monotonic()
        self.queue += members
        self.given += len(members)
        self._write(b"".join(map(encode_member, members)))

    def take_back(self) -> list[StudyMember]:
        """Return the members that it has not answered, and forget them."""
        members = list(self.queue)
        self.queue.clear()
        return members

    def write_rest(self) -> None:
        """Write what the pipe to it takes now."""
        try:
            while self._unsent:
                del self._unsent[: os.write(self.members, self._unsent)]
        except BlockingIOError:
            pass
        except BrokenPipeError:  # it has ended; the other pipe will say so
            self._unsent.clear()

    def receive(self) -> tuple[list[ReceivedReply], bool]:
        """Return the replies that have come, and whether more can come."""
        try:
            chunk = os.read(self.replies, _CHUNK)
        except BlockingIOError:
            return [], True
        *lines, self._received = (self._received + chunk).split(b"\n")
        replies: list[ReceivedReply] = []
        for line in lines:
            try:
                replies.append(self._taken(decode_reply(line)))
            except ValueError:
                self._is_garbled = True
                return replies, False
        return replies, bool(chunk)

    def let_end(self) -> None:
        """Close its pipe, so that it ends by itself: no more members come."""
        self.is_last = True
        self.since = monotonic()
        os.close(self.members)
        self.members = -1

    def has_ended(self) -> bool:
        """Return whether the process had ended when this was asked before.

        Its last reply may come after it was first asked. What it started is ended, too, as that may
        keep the pipe open.
        """
        had_ended = self._is_killed
        if self._child.poll() is not None:
            self._kill()
        return had_ended

    def end(self) -> None:
        """End it now, with all that it started."""
        self._kill()
        os.close(self.replies)
        if self.members >= 0:
            os.close(self.members)

    def wait_for_end(self) -> str:
        """Wait until a worker whose pipe is closed has ended; return what happened to it."""
        if self._is_garbled:
            return "writes into the pipe of its worker process"
        exit_code = None
        with suppress(subprocess.TimeoutExpired):
            exit_code = self._child.wait(_ENDING)
        if exit_code is None or exit_code == PIPE_CLOSED:
            return "closes the pipe of its worker process"
        return describe_exit(exit_code)

    def _taken(self, reply: WorkerReply) -> ReceivedReply:
        """Follow what it does now; return its reply, with the member that it is about.

        Raises
        ------
        ValueError
            If it answers for a member that it does not run.
        """
        self.since = monotonic()
        self.is_ready = self.is_ready or isinstance(reply, WorkerReady)
        if not isinstance(reply, WorkerAnswer):
            return reply
        if not self.queue or self.queue[0].number != reply.outcome.number:
            raise ValueError("an answer to nothing")
        self.answered += 1
        self.is_last = reply.retires
        return MemberAnswer(self.queue.popleft(), reply.outcome, reply.seconds)

    def _write(self, data: bytes) -> None:
        self._unsent += data
        self.write_rest()

    def _kill(self) -> None:
        if not self._is_killed:
            self._is_killed = True
            kill(self._child)


def _start(folder: Path) -> tuple[subprocess.Popen[bytes], int, int]:
    """Start a worker; return it, and the ends of the pipes to it and from it.

    What it and its FMUs print is discarded.
    """
    with ExitStack() as opened, ExitStack() as on_error:
        members, to_members = os.pipe()
        opened.callback(os.close, members)
        on_error.callback(os.close, to_members)
        from_replies, replies = os.pipe()
        opened.callback(os.close, replies)
        on_error.callback(os.close, from_replies)
        child = subprocess.Popen(
            # -P: the parent says from which folders modules are imported, not this one
            [sys.executable, "-P", "-m", WORKER, str(members), str(replies)],
            env=with_one_thread(child_environment(folder, WORKER_VARIABLE)),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(members, replies),
            start_new_session=True,
        )
        on_error.pop_all()
    os.set_blocking(to_members, False)
    os.set_blocking(from_replies, False)
    return child, to_members, from_replies
