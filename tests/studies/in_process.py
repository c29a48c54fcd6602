"""An executor whose members run in this process, with the code that a worker runs them with."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pytest

from cosim.errors import CosimError, RunError
from cosim.studies import members as of_process
from cosim.studies.contracts import FAILED, MemberOutcome, StudyMember
from cosim.studies.members import run_member
from cosim.studies.worker import DONE, LOST, answer
from cosim.studies.workers import LocalExecutor

EXECUTOR = {name: getattr(LocalExecutor, name) for name in ("run", "__exit__")}


def run_members_in_this_process(patch: pytest.MonkeyPatch) -> None:
    """Let executors start no process: members run one after the other, as their results are taken.

    What would go through the socket is pickled as it would be there. A crash is one of the tests'
    process, nothing ends a hang, and what members print is printed.
    """
    patch.setattr(LocalExecutor, "run", _run)
    patch.setattr(LocalExecutor, "__exit__", _leave)


def run_members_in_workers(patch: pytest.MonkeyPatch) -> None:
    """Let executors start processes again."""
    for name, method in EXECUTOR.items():
        patch.setattr(LocalExecutor, name, method)


def _run(
    executor: LocalExecutor,
    members: Iterable[StudyMember],
    function: Callable[..., Any] = run_member,
) -> Iterator[tuple[StudyMember, Any]]:
    subject = _piped(executor._subject)
    for count, member in enumerate(members):
        if executor._most is not None and count % executor._most == 0:
            of_process.close()
        reply = answer(of_process.opened, subject)
        if reply[0] == LOST or (reply[0] != DONE and reply[1] is CosimError):
            raise RunError(f"{subject.scenario!r} cannot be opened: {reply[-1]}")
        if reply[0] == DONE:
            reply = answer(*_piped((function, subject, member)))
        if reply[0] == LOST:
            yield member, MemberOutcome(member.number, FAILED, reason=reply[1])
        elif reply[0] == DONE:
            yield member, _piped(reply[1])
        else:
            raise reply[1](reply[2])


def _leave(executor: LocalExecutor, *error: object) -> None:
    of_process.close()
    EXECUTOR["__exit__"](executor, *error)


def _piped(value: Any) -> Any:
    return pickle.loads(pickle.dumps(value))
