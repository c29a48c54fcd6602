"""Trials of FMUs in this process, with the code that a child runs them with."""

from __future__ import annotations

import io

import pytest

from cosim.errors import CosimError
from cosim.fmi import child_process
from cosim.fmi.checking.trial import TASKS, TrialLog
from cosim.fmi.child_process import CHILD_VARIABLE, TIMEOUT, TrialProblem, TrialTask

IN_A_CHILD = child_process.attempt


def attempt(task: TrialTask, *arguments: str, timeout: float = TIMEOUT) -> tuple[TrialProblem, ...]:
    """Try here what a loaded FMU is tried for: a crash is one of the tests', nothing ends a hang.

    What ``cosim check`` asks for is done in a child.
    """
    path, interface_type, given, step = arguments if task == "rollback" else ("", "", "no", "")
    if given:  # a check gives what it has read
        return IN_A_CHILD(task, *arguments, timeout=timeout)
    text = io.StringIO()
    log = TrialLog(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CHILD_VARIABLE, "1")
        try:
            TASKS["rollback"](log, path, interface_type, step=step)
        except CosimError as error:
            log.problem(str(error))
    log.done(task)
    return child_process._problems(text.getvalue(), 0, timeout)
