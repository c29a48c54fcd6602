"""Run foreign binaries in a child process, so that a crash or a hang there leaves this one alive.

The child runs the module ``TRIAL``, which is named here and not imported: it opens FMUs, and so
stands above this module.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias

from cosim.fmi.trial_cache import KeptTrial
from cosim.processes import child_environment, describe_exit, run_child
from cosim.temporary import TemporaryFolder

if TYPE_CHECKING:
    from cosim.fmi.description import InterfaceType
    from cosim.fmi.reading.model_description import Archive

TrialTask: TypeAlias = Literal["symbols", "run", "rollback"]
ProblemKind: TypeAlias = Literal["missing function", "refused", "inexact", "wrong", "step", "other"]

TRIAL: Final = "cosim.fmi.checking.trial"
TIMEOUT: Final = 20.0  # [s] of wall time
CHILD_VARIABLE: Final = "COSIM_TRIAL"  # of the environment; set in a child, which starts no other
# What the FMU itself shows, on any machine.
OF_STATE: Final[frozenset[ProblemKind]] = frozenset(("refused", "inexact", "wrong"))


class TrialProblem(NamedTuple):
    """What a trial shows to be wrong.

    The kind says where a required function is missing, and whether saving or restoring the state is
    refused, not exact, or wrong; or with which step it was tried; all else is another.
    """

    text: str
    kind: ProblemKind = "other"


def find_rollback_problems(
    archive: Archive, interface_type: InterfaceType, step: float | None = None
) -> tuple[str, ...]:
    """Return why get and set FMU state of an FMU cannot be relied on; empty where they can.

    The trial starts a child, which takes about a second, so its result is kept: for the life of the
    process, and in the user's cache folder. Inside a child there are no problems, as a trial would
    start the next one without end.

    Parameters
    ----------
    archive : Archive
    interface_type : {"me", "cs"}
        One whose capabilities say that it can (``saves_state``).
    step : float or None
        The communication step of the run [s]; None: what the FMU prefers, or takes.
    """
    if CHILD_VARIABLE in os.environ:
        return ()
    return _try_rollback(archive.path.resolve(), archive.sha256, interface_type, step)


@lru_cache(maxsize=256)
def _try_rollback(
    path: Path, sha256: str, interface_type: InterfaceType, step: float | None
) -> tuple[str, ...]:
    """Try it once for each content of the file: ``sha256`` is part of the cache's key."""
    kept = KeptTrial("rollback", sha256, interface_type)
    known_texts = kept.problems()
    if known_texts is not None:
        return known_texts
    found = try_fmu("rollback", path, interface_type, step=step)
    problems = [problem for problem in found if problem.kind != "step"]
    texts = tuple(problem.text for problem in problems)
    # A hang or a missing library may belong to this moment and this machine.
    if all(problem.kind in OF_STATE for problem in problems):
        kept.keep(texts)
    return texts


def try_fmu(
    task: TrialTask,
    path: Path,
    interface_type: InterfaceType,
    *,
    given: Path | None = None,
    step: float | None = None,
    timeout: float = TIMEOUT,
) -> tuple[TrialProblem, ...]:
    """Do a task with an FMU in a child process; return the problems, without its path.

    ``given`` is a file that this process wrote: pickled, the Archive and the start values. ``step``
    [s] is tried first.
    """
    absolute_path = str(path.resolve())
    arguments = [str(given or ""), repr(step) if step else ""]
    problems = attempt(task, absolute_path, interface_type, *arguments, timeout=timeout)
    shortened = []
    for problem in problems:
        shortened.append(problem._replace(text=problem.text.replace(f"{absolute_path}: ", "")))
    return tuple(shortened)


def attempt(task: TrialTask, *arguments: str, timeout: float = TIMEOUT) -> tuple[TrialProblem, ...]:
    """Do a task in a child process and return the problems; empty where there are none.

    Parameters
    ----------
    task : TrialTask
        ``symbols LIBRARY NAME...``: load the library and look the functions up. ``run PATH
        INTERFACE_TYPE GIVEN STEP``: instantiate, initialize, read, step, terminate, free.
        ``rollback PATH INTERFACE_TYPE GIVEN STEP``: save and restore in the midst of a run.
    arguments : str
    timeout : float
        After it the child and what it started are killed [s].
    """
    with TemporaryFolder("trial") as folder:
        log = folder / "result"
        log.touch()
        exit_code = run_child(
            [TRIAL, task, str(log), *arguments],
            child_environment(folder, CHILD_VARIABLE),
            folder=folder,
            timeout=timeout,
        )
        text = log.read_text(encoding="utf-8", errors="replace")
        return _problems(text, exit_code, timeout)


def _problems(log: str, exit_code: int | None, timeout: float) -> tuple[TrialProblem, ...]:
    """Return the problems that the child logged, and how it ended if not at the end."""
    records: list[dict[str, Any]] = []
    for line in log.splitlines():
        with suppress(ValueError):  # the last one may be cut
            records.append(json.loads(line))
    problems = [
        TrialProblem(record["problem"], record["kind"]) for record in records if "problem" in record
    ]
    stages = [record["stage"] for record in records if "stage" in record]
    last_stage = stages[-1] if stages else "the start of the process"
    if exit_code is None:
        text = f"hangs: did not end within {timeout:g} s, at: {last_stage}"
        problems.append(TrialProblem(text))
    elif exit_code < 0 or not any("done" in record for record in records):
        problems.append(TrialProblem(f"{describe_exit(exit_code)} at: {last_stage}"))
    return tuple(problems)
