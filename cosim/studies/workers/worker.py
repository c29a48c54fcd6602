"""What a worker does: it opens its runner, and runs members until no more come.

``python -m cosim.studies.workers.worker MEMBERS REPLIES`` reads members from a pipe and hands over
the outcome of each before it begins the next; the arguments are descriptors. What FMUs print goes
to the standard streams, and so not between the replies.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from importlib import import_module
from time import perf_counter
from typing import Final, NoReturn

from cosim.errors import ChangedFileError, CosimError
from cosim.processes import describe_exit, end_with_parent, leave_no_core
from cosim.studies.contracts import FAILED, MemberOutcome, MemberRunner, StudyMember
from cosim.studies.workers.messages import (
    WorkerAnswer,
    WorkerOpening,
    WorkerReady,
    WorkerRefusal,
    decode_member,
    decode_opening,
    encode_reply,
)

PIPE_CLOSED: Final = 113  # exit code: a member closed the pipe of the replies


class WorkerPipe:
    """A pipe that a member may close, or replace by a file of its own: descriptors are numbers."""

    def __init__(self, descriptor: int) -> None:
        os.set_inheritable(descriptor, False)  # what a member starts must not keep it open
        self._descriptor = descriptor
        self._identity = self._identify()

    @property
    def is_open(self) -> bool:
        """Whether the descriptor still is that of the pipe."""
        return self._identify() == self._identity

    def write(self, line: bytes) -> None:
        """Hand over a line, or end the process where that cannot be."""
        rest = memoryview(line)
        if not self.is_open:
            os._exit(PIPE_CLOSED)
        while rest:
            rest = rest[os.write(self._descriptor, rest) :]

    def _identify(self) -> tuple[int, int] | None:
        try:
            status = os.fstat(self._descriptor)
        except OSError:
            return None
        return status.st_dev, status.st_ino


def open_runner(opening: WorkerOpening) -> MemberRunner:
    """Return the runner of the opener's module."""
    sys.path[:] = opening.import_paths
    module, _, function = opening.opener.partition(":")
    runner: MemberRunner = getattr(import_module(module), function)(opening.subject)
    return runner


def describe_error(error: BaseException) -> str:
    """Return what ended a member, or the opening of a runner."""
    if isinstance(error, CosimError):
        return str(error)
    if isinstance(error, SystemExit):
        code = error.code
        return describe_exit(code if isinstance(code, int) else int(code is not None))
    return f"{type(error).__name__}: {error}".removesuffix(": ")


def run_member(runner: MemberRunner, member: StudyMember, worker: str) -> WorkerAnswer:
    """Return the outcome of a member, whatever its run raises.

    A runner makes an outcome of what it expects. After anything else nobody knows what state it is
    in, and the worker retires.

    Raises
    ------
    ChangedFileError
        If it reads another file than the study began with: there is no outcome then.
    """
    began = perf_counter()
    try:
        outcome = runner.run(member)
    except ChangedFileError:
        raise
    except BaseException as error:
        return failed_answer(member.number, error, perf_counter() - began, worker)
    seconds = perf_counter() - began
    return WorkerAnswer(outcome if outcome.worker else replace(outcome, worker=worker), seconds)


def failed_answer(number: int, error: BaseException, seconds: float, worker: str) -> WorkerAnswer:
    """Return the last answer of a worker: a member that raised an error."""
    reason = describe_error(error)
    outcome = MemberOutcome(number, FAILED, reason=reason, wall_time=seconds, worker=worker)
    return WorkerAnswer(outcome, seconds, retires=True)


def refusal_of(error: BaseException) -> WorkerRefusal:
    """Return what a worker says that cannot go on for an error."""
    if isinstance(error, ChangedFileError):  # the parent adds the way out, in its language
        return WorkerRefusal(error.problem, error.exit_code, has_changed=True)
    code = error.exit_code if isinstance(error, CosimError) else 1
    return WorkerRefusal(describe_error(error), code)


def encode_answer(answer: WorkerAnswer) -> bytes:
    """Return the line of an answer; an outcome that JSON cannot carry is a failed one."""
    try:
        return encode_reply(answer)
    except (TypeError, ValueError, RecursionError) as error:
        outcome = answer.outcome
        failed = failed_answer(outcome.number, error, answer.seconds, outcome.worker)
        return encode_reply(failed)


def serve(
    runner: MemberRunner,
    lines: Iterable[bytes],
    *,
    members: WorkerPipe,
    replies: WorkerPipe,
    most: int,
) -> None:
    """Run members until no more come, or this process should not run another.

    Parameters
    ----------
    runner : MemberRunner
    lines : iterable of bytes
        Of members.
    members : WorkerPipe
        From which the lines come.
    replies : WorkerPipe
    most : int
        Members that this process may run.
    """
    worker = worker_name(os.getpid())
    for number, line in enumerate(lines, 1):
        if not line.endswith(b"\n"):
            return  # the parent was lost while it wrote
        answer = run_member(runner, decode_member(line), worker)
        if number == most or not members.is_open:
            answer = answer._replace(retires=True)
        replies.write(encode_answer(answer))
        if answer.retires:
            return


def worker_name(pid: int) -> str:
    """Return how a worker of this machine is named in outcomes."""
    return f"{os.uname().nodename}:{pid}"


def main(arguments: Sequence[str]) -> NoReturn:
    """Open the runner, run members, and end without the exit handlers of the binaries."""
    end_with_parent()
    leave_no_core()
    members, replies = (WorkerPipe(int(text)) for text in arguments)
    lines = open(int(arguments[0]), "rb")  # noqa: SIM115 - until the process ends
    with suppress(BrokenPipeError), ExitStack() as stack:  # the parent ends before
        try:
            opening = decode_opening(next(lines))
            runner = stack.enter_context(open_runner(opening))
        except BaseException as error:
            replies.write(encode_reply(refusal_of(error)))
            os._exit(1)
        replies.write(encode_reply(WorkerReady()))
        most = opening.most_members
        try:
            serve(runner, lines, members=members, replies=replies, most=most)
        except ChangedFileError as error:
            replies.write(encode_reply(refusal_of(error)))
            os._exit(1)
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1:])
