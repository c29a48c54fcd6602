"""An executor whose members run in this process, with the code that a worker runs them with."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pytest

from cosim.errors import RunError
from cosim.studies import members as of_process
from cosim.studies.contracts import FAILED, MemberOutcome, StudyMember, StudySubject
from cosim.studies.members import run_member
from cosim.studies.worker import DONE, HEAD, LOST, REFUSED, answer
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
        kind, *values = _answer(_open, subject)
        if kind == LOST:
            raise RunError(f"{subject.scenario!r} cannot be opened: {values[0]}")
        if kind == DONE:
            kind, *values = _answer(*_piped((function, subject, member)))
        if kind == REFUSED:
            raise values[0](values[1])
        lost = MemberOutcome(member.number, FAILED, reason=str(values[0]))
        yield member, lost if kind == LOST else values[0]


def _open(subject: StudySubject) -> None:
    of_process.opened(subject)


def _answer(function: Callable[..., Any], *arguments: Any) -> Any:
    return pickle.loads(answer(lambda: function(*arguments))[HEAD.size :])


def _leave(executor: LocalExecutor, *error: object) -> None:
    of_process.close()
    EXECUTOR["__exit__"](executor, *error)


def _piped(value: Any) -> Any:
    return pickle.loads(pickle.dumps(value))
