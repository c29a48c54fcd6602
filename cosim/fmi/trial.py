"""Try a foreign binary in a child process: what crashes, hangs or lies does it there.

``python -m cosim.fmi.trial TASK RESULT ARGUMENT...`` does a task and writes its story to the file RESULT, one JSON object a line:
where it is, what it found, that it is done. A story without an end tells where the process was lost.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

from cosim.errors import CosimError

if TYPE_CHECKING:
    from cosim.arrays import Matrix, Vector
    from cosim.fmi.component import Fmu
    from cosim.fmi.description import Description, Mode
    from cosim.fmi.reading import Archive

Task: TypeAlias = Literal["symbols", "run", "rollback"]

TIMEOUT: Final = 20.0  # [s] of wall time
STEP: Final = 1e-3  # [s], where the FMU prefers none
STEPS: Final = 3
INSIDE: Final = "COSIM_TRIAL"  # set in the child: a trial inside a trial is none
MISSING: Final = "missing function"
ROOT: Final = Path(__file__).parents[2]


def can_roll_back(archive: Archive, mode: Mode, *, timeout: float = TIMEOUT) -> tuple[str, ...]:
    """Say why get and set FMU state of an FMU cannot be relied on; empty: they can.

    The answer is kept for the life of the process: the trial starts one, which takes about half a second.

    Parameters
    ----------
    archive : Archive
    mode : Mode
        A kind that says that it can (``saves_state``).
    timeout : float
        Of the trial [s].
    """
    return () if INSIDE in os.environ else _can_roll_back(archive.path.resolve(), archive.sha256, mode, timeout)


@lru_cache(maxsize=256)
def _can_roll_back(path: Path, sha256: str, mode: Mode, timeout: float) -> tuple[str, ...]:
    return attempt("rollback", str(path), mode, timeout=timeout)


def attempt(task: Task, *arguments: str, timeout: float = TIMEOUT) -> tuple[str, ...]:
    """Do a task in a child process; give what is wrong, empty where nothing is.

    Parameters
    ----------
    task : Task
        ``symbols LIBRARY NAME...``: load the library and look the functions up. ``run PATH MODE``: instantiate, initialise,
        read, step, terminate, free. ``rollback PATH MODE``: save and restore in the midst of a run.
    arguments : str
    timeout : float
        After it the child and what it started are killed [s].
    """
    with TemporaryDirectory(prefix="cosim-trial-", ignore_cleanup_errors=True) as folder:
        result = Path(folder) / "result"
        result.touch()
        command = [sys.executable, "-m", "cosim.fmi.trial", task, str(result), *arguments]
        child = subprocess.Popen(
            command,
            cwd=folder,
            env=_environment(folder),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            ended: int | None = child.wait(timeout)
        except subprocess.TimeoutExpired:
            ended = None
        finally:
            _kill(child)
        return _verdict(result.read_text(encoding="utf-8", errors="replace"), ended, timeout)


def _environment(folder: str) -> dict[str, str]:
    """Let the child find this package, and keep its temporary files where they are removed."""
    paths = [str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    own = {"PYTHONPATH": os.pathsep.join(path for path in paths if path), INSIDE: "1"}
    return os.environ | own | dict.fromkeys(("TMPDIR", "TEMP", "TMP"), folder)


def _kill(child: subprocess.Popen[bytes]) -> None:
    """End the child and what it started."""
    with suppress(ProcessLookupError, PermissionError):
        if sys.platform == "win32":
            child.kill()
        else:
            os.killpg(child.pid, signal.SIGKILL)
    child.wait()


def _verdict(story: str, ended: int | None, timeout: float) -> tuple[str, ...]:
    lines: list[dict[str, str]] = []
    for line in story.splitlines():
        with suppress(ValueError):  # the last one may be cut
            lines.append(json.loads(line))
    problems = [line["problem"] for line in lines if "problem" in line]
    where = next((line["at"] for line in reversed(lines) if "at" in line), "the start of the process")
    if ended is None:
        problems.append(f"hangs: did not end within {timeout:g} s, at: {where}")
    elif ended < 0:
        problems.append(f"crashes: {signal.Signals(-ended).name} at: {where}")
    elif not any("done" in line for line in lines):
        problems.append(f"ends the process with exit code {ended} at: {where}")
    return tuple(problems)


# --- in the child ---


class _Story:
    """Writes what happens, so that it is known after a crash."""

    def __init__(self, path: str) -> None:
        self._file = open(path, "a", encoding="utf-8", buffering=1)  # noqa: SIM115 - for the life of the process

    def tell(self, key: str, text: str) -> None:
        """Write a line."""
        self._file.write(json.dumps({key: text}) + "\n")
        self._file.flush()

    def at(self, text: str) -> None:
        """Say what comes now."""
        self.tell("at", text)

    def problem(self, text: str) -> None:
        """Say what is wrong."""
        self.tell("problem", text)


def symbols(story: _Story, library: str, *names: str) -> None:
    """Load a library and look functions up."""
    import ctypes

    story.at("loading the library")
    try:
        found = ctypes.CDLL(library)
    except OSError as error:
        story.problem(f"cannot be loaded: {str(error).replace(library, Path(library).name)}")
        return
    for name in names:
        if not hasattr(found, name):
            story.problem(f"{MISSING} {name}")


def run(story: _Story, path: str, mode: Mode) -> None:
    """Go through a short run."""
    import numpy as np

    with _opened(story, path, mode) as fmu:
        component, h = fmu.component, _step(fmu.description, mode)
        names = [element for signal in component.interface.outputs for element in signal.elements]
        t, u = _times(h, STEPS), _inputs(fmu, STEPS)
        story.at("initialisation")
        y = component.initialize(0.0, u[0])
        _check_starts(story, fmu.description, y)
        story.at(f"steps of {h:g} s")
        rows = component.advance(t, h, u)
        for name, values in zip(names, rows.T, strict=True):
            if not np.isfinite(values).all():
                story.problem(f"output {name!r} is {values[~np.isfinite(values)][0]} after a step")
        story.at("terminate and free")
    story.at("the end of the process")


def rollback(story: _Story, path: str, mode: Mode) -> None:
    """Save, step, restore and step again, also after other inputs: the same bits each time."""
    with _opened(story, path, mode) as fmu:
        component, h = fmu.component, _step(fmu.description, mode)
        t, u = _times(h, 2 * STEPS), _inputs(fmu, 2 * STEPS)
        story.at("initialisation")
        component.initialize(0.0, u[0])
        story.at("steps before the state is saved")
        component.advance(t[: STEPS + 1], h, u[: STEPS + 1])
        ahead = (t[STEPS:], h, u[STEPS:])
        story.at("saving the state")
        saved = component.save()
        story.at("steps after the state was saved")
        first = component.advance(*ahead).tobytes()

        def other_inputs() -> None:
            component.restore(saved)
            with suppress(CosimError):  # they may be more than it bears
                component.advance(t[STEPS:], h, 2.0 * u[STEPS:] + 1.0)

        detours = {"steps": lambda: None, "steps with other inputs": other_inputs, "saving anew": component.save}
        for what, detour in detours.items():
            story.at(what)
            detour()
            story.at(f"going back after {what}")
            component.restore(saved)
            if component.advance(*ahead).tobytes() != first:
                story.problem(f"goes back wrongly: after {what} the same steps give other outputs")
                break
        story.at("terminate and free")
    story.at("the end of the process")


@contextmanager
def _opened(story: _Story, path: str, mode: Mode) -> Iterator[Fmu]:
    import numpy as np

    from cosim.fmi.component import load

    story.at("loading and instantiating")
    with load(path, mode=mode) as fmu:
        story.at("preparing")
        fmu.component.prepare(_step(fmu.description, mode), np.zeros(fmu.component.interface.n_u, np.bool_), {})
        yield fmu


def _step(description: Description, mode: Mode) -> float:
    return description.capabilities[mode].fixed_step or description.default_step or STEP


def _times(h: float, steps: int) -> Vector:
    import numpy as np

    return np.array([k * h for k in range(steps + 1)], np.float64)


def _inputs(fmu: Fmu, steps: int) -> Matrix:
    """Hold every input at its start value."""
    import numpy as np

    starts = [value for signal in fmu.component.interface.inputs for value in (signal.start or (0.0,) * signal.size)]
    return np.tile(np.array(starts, np.float64), (steps + 1, 1))


def _check_starts(story: _Story, description: Description, y: Vector) -> None:
    """Compare outputs whose start values are exact with what the unit gives."""
    column = 0
    for _, group in description.ports("output"):
        for variable in group:
            values = tuple(y[column : column + variable.size].tolist())
            column += variable.size
            if variable.initial == "exact" and variable.start not in (None, values):
                said, given = (", ".join(f"{v:g}" for v in row) for row in (variable.start or (), values))
                story.problem(f"{variable.name!r} starts at {given}; the file says exactly {said}")


TASKS: Final[dict[str, Callable[..., None]]] = {"symbols": symbols, "run": run, "rollback": rollback}


def main(arguments: Sequence[str]) -> None:
    """Do a task."""
    task, result, *rest = arguments
    story = _Story(result)
    with suppress(ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        TASKS[task](story, *rest)
    except CosimError as error:
        story.problem(str(error))
    except Exception as error:  # the process is there to find out what a foreign binary makes of it
        story.problem(f"{type(error).__name__}: {error}")
    story.tell("done", task)


if __name__ == "__main__":
    main(sys.argv[1:])
