"""A pool whose members run in this process, with the code that a worker runs them with."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack

import pytest

from cosim.errors import ChangedFileError, CosimError
from cosim.studies.contracts import MemberResult, MemberRunner, StudyMember
from cosim.studies.workers import worker
from cosim.studies.workers.messages import (
    WorkerAnswer,
    WorkerRefusal,
    decode_member,
    decode_opening,
    decode_reply,
    encode_member,
    encode_reply,
)
from cosim.studies.workers.pool import WorkerPool

POOL = {name: getattr(WorkerPool, name) for name in ("run", "__exit__")}


def run_members_in_this_process(patch: pytest.MonkeyPatch) -> None:
    """Let pools start no process: members run one after the other, as their results are taken.

    What would go through the pipes is encoded and decoded as it would be there. The runner stays
    open from one call of ``run`` to the next, as that of a worker does. A crash is one of the
    tests' process, nothing ends a hang, and what members print is printed.
    """
    patch.setattr(WorkerPool, "run", _run)
    patch.setattr(WorkerPool, "__exit__", _leave)


def run_members_in_workers(patch: pytest.MonkeyPatch) -> None:
    """Let pools start processes again."""
    for name, method in POOL.items():
        patch.setattr(WorkerPool, name, method)


OPEN_RUNNERS: dict[int, tuple[MemberRunner, ExitStack]] = {}  # by the identity of their pool


def _run(pool: WorkerPool, members: Iterable[StudyMember]) -> Iterator[MemberResult]:
    name = worker.worker_name(os.getpid())
    for given, member in enumerate(members, 1):
        runner = _runner_of(pool)
        try:
            answer = worker.run_member(runner, decode_member(encode_member(member)), name)
        except ChangedFileError as error:
            raise _refusal(pool, error) from error
        reply = decode_reply(worker.encode_answer(answer))
        assert isinstance(reply, WorkerAnswer)
        if reply.retires or given % pool._most_members == 0:
            _close_runner(pool)
        yield member, reply.outcome


def _leave(pool: WorkerPool, *error: object) -> None:
    _close_runner(pool)
    POOL["__exit__"](pool, *error)


def _runner_of(pool: WorkerPool) -> MemberRunner:
    if id(pool) not in OPEN_RUNNERS:
        paths = list(sys.path)
        stack = ExitStack()
        try:
            runner = worker.open_runner(decode_opening(pool._opening))
            OPEN_RUNNERS[id(pool)] = stack.enter_context(runner), stack
        except Exception as error:
            raise _refusal(pool, error) from error
        finally:
            sys.path[:] = paths
    return OPEN_RUNNERS[id(pool)][0]


def _close_runner(pool: WorkerPool) -> None:
    if id(pool) in OPEN_RUNNERS:
        _, stack = OPEN_RUNNERS.pop(id(pool))
        stack.close()


def _refusal(pool: WorkerPool, error: Exception) -> CosimError:
    refusal = decode_reply(encode_reply(worker.refusal_of(error)))
    assert isinstance(refusal, WorkerRefusal)
    return pool._refused(refusal)
