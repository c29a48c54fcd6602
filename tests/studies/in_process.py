"""Run the members of a study where a test runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pytest

from cosim.studies import members as running
from cosim.studies.contracts import StudyMember
from cosim.studies.workers import LocalExecutor

RUN = LocalExecutor.run


def run_members_in_this_process(patch: pytest.MonkeyPatch) -> None:
    """Let executors start no process; a crash is one of this process, nothing ends a hang."""
    patch.setattr(LocalExecutor, "run", _run)


def run_members_in_workers(patch: pytest.MonkeyPatch) -> None:
    """Let executors start processes again."""
    patch.setattr(LocalExecutor, "run", RUN)


def _run(
    executor: LocalExecutor,
    members: Iterable[StudyMember],
    function: Callable[..., Any] = running.run_member,
) -> Iterator[tuple[StudyMember, Any]]:
    running.opened(executor._subject)  # refused before the first member is taken
    for member in members:
        yield member, function(executor._subject, member)
