"""Trials of FMUs in this process, with the code that a child runs them with."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from cosim.errors import CosimError
from cosim.fmi import child_process
from cosim.fmi.checking.trial import TrialLog, roll_back
from cosim.fmi.child_process import CHILD_VARIABLE, TIMEOUT, TrialProblem, TrialTask
from cosim.fmi.description import InterfaceType

TRY_FMU = child_process.try_fmu


def try_fmus_in_this_process(patch: pytest.MonkeyPatch) -> None:
    """Let FMUs that are loaded be tried here: a crash is one of the tests', nothing ends a hang.

    ``cosim check`` still starts its children.
    """
    patch.setattr(child_process, "try_fmu", _try_fmu)


def try_fmus_in_children(patch: pytest.MonkeyPatch) -> None:
    """Let children be started again."""
    patch.setattr(child_process, "try_fmu", TRY_FMU)


def _try_fmu(
    task: TrialTask, path: Path, interface_type: InterfaceType, *, timeout: float = TIMEOUT
) -> tuple[TrialProblem, ...]:
    assert task == "rollback"
    text = io.StringIO()
    log = TrialLog(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CHILD_VARIABLE, "1")
        try:
            roll_back(log, str(path), interface_type)
        except CosimError as error:
            log.problem(str(error))
    log.done(task)
    problems = child_process._problems(text.getvalue(), 0, timeout)
    return tuple(p._replace(text=p.text.replace(f"{path}: ", "")) for p in problems)
