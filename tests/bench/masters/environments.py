"""Environments of the other masters, in the user's cache folder, and their processes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from tests.bench.masters.drivers.protocol import MARK

ROOT = Path(__file__).parents[3]
DRIVERS = Path(__file__).parent / "drivers"
INSTALLED = "installed.txt"
LIMIT = 600.0  # s of wall time that a process may take


class Unavailable(Exception):
    """A master cannot be installed, or cannot run a case; the reason in one line."""


@dataclass(frozen=True)
class Command:
    """A process that prints a result: a program, or a driver with its task on standard input."""

    arguments: tuple[str, ...]
    task: dict[str, Any] | None = None


@dataclass(frozen=True)
class Result:
    """What a process measured.

    Attributes
    ----------
    seconds : float
        Processor time [s].
    samples : tuple of (step, outputs)
    """

    seconds: float
    samples: tuple[tuple[int, tuple[float, ...]], ...]


def cache_folder() -> Path:
    """Return where the environments are kept."""
    cache = os.environ.get("XDG_CACHE_HOME")
    base = Path(cache) if cache else Path.home() / ".cache"
    return base / "cosim-bench"


@cache
def environment(requirements: tuple[str, ...]) -> Path:
    """Return the Python of an environment with some packages; it is made where there is none.

    Raises
    ------
    Unavailable
        If they cannot be installed.
    """
    folder = cache_folder() / "-".join(requirements)
    python = folder / "bin" / "python"
    installed = folder / INSTALLED
    if installed.exists():
        return python
    print(f"installing {', '.join(requirements)} in {folder}", file=sys.stderr, flush=True)
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    pip = [str(python), "-m", "pip", "install", "--quiet", *requirements]
    result = subprocess.run(pip, capture_output=True, text=True, check=False)
    if result.returncode:
        raise Unavailable(f"does not install: {_last_line(result.stderr)}")
    frozen = subprocess.run(
        [str(python), "-m", "pip", "freeze"], capture_output=True, text=True, check=True
    )
    installed.write_text(frozen.stdout)
    return python


def driver(name: str, requirements: tuple[str, ...], task: dict[str, Any]) -> Command:
    """Return the command of a driver; without requirements it runs in this environment."""
    python = str(environment(requirements)) if requirements else sys.executable
    return Command((python, str(DRIVERS / name)), task)


def run(command: Command) -> Result:
    """Run a process and read what it measured.

    Raises
    ------
    Unavailable
        If it fails, with its last line.
    """
    with tempfile.TemporaryDirectory(prefix="cosim-bench-") as folder:
        variables = {**os.environ, "TMPDIR": folder, "PYTHONPATH": str(ROOT)}
        text = None
        if command.task is not None:
            text = json.dumps({**command.task, "folder": folder})
        try:
            process = subprocess.run(
                command.arguments,
                input=text,
                capture_output=True,
                text=True,
                check=False,
                cwd=folder,
                env=variables,
                timeout=LIMIT,
            )
        except subprocess.TimeoutExpired as error:
            raise Unavailable(f"took more than {LIMIT:.0f} s") from error
    if process.returncode < 0:
        raise Unavailable(f"ended by {signal.Signals(-process.returncode).name}")
    if process.returncode:
        reason = _last_line(process.stderr) or f"ended with status {process.returncode}"
        raise Unavailable(reason)
    measured = [line for line in process.stdout.splitlines() if line.startswith(MARK)]
    result = json.loads(measured[-1].removeprefix(MARK))
    samples = tuple((step, tuple(outputs)) for step, outputs in result["samples"])
    return Result(result["seconds"], samples)


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else ""
