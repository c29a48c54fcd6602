"""Trials of FMUs in this process, with the code that a child runs them with."""

from __future__ import annotations

import io

import pytest

from cosim.errors import CosimError
from cosim.fmi import child_process
from cosim.fmi.checking.trial import TrialLog, roll_back
from cosim.fmi.child_process import CHILD_VARIABLE, TIMEOUT, TrialProblem, TrialTask

ATTEMPT = child_process.attempt


def try_fmus_in_this_process(patch: pytest.MonkeyPatch) -> None:
    """Let FMUs that are loaded be tried here: a crash is one of the tests', nothing ends a hang.

    ``cosim check`` still starts its children.
    """
    patch.setattr(child_process, "attempt", _attempt)


def try_fmus_in_children(patch: pytest.MonkeyPatch) -> None:
    """Let children be started again."""
    patch.setattr(child_process, "attempt", ATTEMPT)


def _attempt(
    task: TrialTask, *arguments: str, timeout: float = TIMEOUT
) -> tuple[TrialProblem, ...]:
    if task != "rollback" or len(arguments) > 2:  # a check gives what it has read
        return ATTEMPT(task, *arguments, timeout=timeout)
    path, interface_type = arguments
    text = io.StringIO()
    log = TrialLog(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CHILD_VARIABLE, "1")
        try:
            roll_back(log, path, interface_type)
        except CosimError as error:
            log.problem(str(error))
    log.done(task)
    return child_process._problems(text.getvalue(), 0, timeout)
