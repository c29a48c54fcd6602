"""Compile the C kernels: a hatchling build hook, and the compiler that FMU export uses too.

``cc`` is used where there is one, else the package ``ziglang``, which the hook then requests as a
build dependency. zig always gets a target: without one it emits the instructions of the host, fused
multiply-adds among them, and the bits would differ.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NoReturn

HERE = Path(__file__).resolve().parent
SOURCES = (
    "stages/cascade.c",
    "stages/stage.c",
    "stages/loop_solver.c",
    "numerics/linear.c",
    "numerics/elementary.c",
    "numerics/expression.c",
    "numerics/reductions.c",
    "numerics/runge_kutta.c",
    "numerics/householder.c",
    "numerics/noise.c",
    "blocks/static.c",
    "blocks/functions.c",
    "blocks/window.c",
    "blocks/control.c",
    "blocks/field_data.c",
    "blocks/sensor.c",
    "blocks/late_samples.c",
    "blocks/compensator.c",
    "blocks/wrapping.c",
    "blocks/refresh.c",
    "estimation/alphas.c",
    "estimation/regression.c",
    "estimation/adaptive.c",
    "estimation/kalman.c",
    "estimation/extended_kalman.c",
    "estimation/augmented_kalman.c",
    "estimation/between.c",
    "estimation/weights.c",
    "estimation/predictor.c",
    "estimation/rayleigh.c",
    "estimation/start_grid.c",
    "estimation/output_error.c",
    "estimation/identifier.c",
    "fmi/callbacks.c",
    "fmi/running.c",
    "fmi/fmu.c",
    "fmi/process.c",
    "fmi/inner_step.c",
    "fmi/co_simulation.c",
    "fmi/exact.c",
    "fmi/model_exchange.c",
)
# files include headers by name alone: in an exported FMU all of them are in one folder
FOLDERS = (".", "stages", "numerics", "blocks", "estimation", "fmi")
INCLUDES = tuple(f"-I{HERE / folder}" for folder in FOLDERS)
FLAGS = ("-std=c11", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
# of the package's own library, which is compiled once: a fifth less time, and the same bits
OPTIONS = ("-O3", *INCLUDES)
LIBRARY = f"_cosim{'.dll' if sys.platform == 'win32' else '.so'}"
_ZIG_SYSTEMS = {"linux": "linux-gnu", "darwin": "macos", "win32": "windows-gnu"}
_ZIG_MACHINES = {"AMD64": "x86_64", "arm64": "aarch64"}


def compiler() -> list[str]:
    """Return the command of a C compiler for this machine; empty where there is none."""
    cc = shutil.which("cc")
    if cc:
        return [cc]
    if importlib.util.find_spec("ziglang") is None:
        return []
    system = _ZIG_SYSTEMS[sys.platform]
    machine = platform.machine()
    zig_machine = _ZIG_MACHINES.get(machine, machine)
    return cross_compiler(f"{zig_machine}-{system}")


def cross_compiler(target: str) -> list[str]:
    """Return the command of a C compiler for another machine; empty where there is none.

    ``target`` is zig's name of the machine, like ``x86_64-linux-gnu``.
    """
    if importlib.util.find_spec("ziglang") is None:
        return []
    return [sys.executable, "-m", "ziglang", "cc", "-target", target]


def source(name: str) -> Path:
    """Return the path of one of ``SOURCES`` by its name without the folder."""
    by_name = {Path(path).name: HERE / path for path in SOURCES}
    return by_name[name]


def headers(names: Iterable[str]) -> list[Path]:
    """Return the headers that sources of these names include, and those that they include."""
    by_name: dict[str, Path] = {}
    for folder in FOLDERS:
        by_name.update({path.name: path for path in (HERE / folder).glob("*.h")})
    included: dict[str, Path] = {}
    waiting = [source(name) for name in names]
    while waiting:
        text = waiting.pop().read_text(encoding="utf-8")
        for name in re.findall(r'^#include "(.+)"$', text, re.MULTILINE):
            if name not in included:
                included[name] = by_name[name]
                waiting.append(by_name[name])
    return [included[name] for name in sorted(included)]


def compile_library(
    sources: Iterable[Path],
    target: Path,
    options: Iterable[str] = (),
    *,
    command: Sequence[str] | None = None,
) -> None:
    """Compile C sources to a shared library.

    Parameters
    ----------
    sources : iterable of Path
    target : Path
        The library.
    options : iterable of str
        Further options of the compiler.
    command : sequence of str, optional
        The compiler; by default that of this machine.

    Raises
    ------
    RuntimeError
        If there is no compiler, or it refuses the sources; with the compiler's own message.
    """
    command = (compiler() if command is None else command) or _no_compiler()
    libraries = [] if target.suffix == ".dll" else ["-lm"]
    inputs = map(str, sources)
    run_compiler(command, [*FLAGS, *options, *inputs, "-o", str(target), *libraries])


def compile_kernels(target: Path) -> None:
    """Compile the package's own library, sources side by side.

    Raises
    ------
    RuntimeError
        As of :func:`compile_library`.
    """
    command = compiler() or _no_compiler()
    with TemporaryDirectory() as folder, ThreadPoolExecutor(os.cpu_count()) as pool:
        objects = [Path(folder, f"{Path(name).stem}.o") for name in SOURCES]
        compilers = []
        for name, path in zip(SOURCES, objects, strict=True):
            arguments = [*FLAGS, *OPTIONS, "-c", str(HERE / name), "-o", str(path)]
            compilers.append(pool.submit(run_compiler, command, arguments))
        for running in compilers:
            running.result()
        compile_library(objects, target, OPTIONS, command=command)


def _no_compiler() -> NoReturn:
    raise RuntimeError("no C compiler: install one as 'cc', or 'pip install ziglang'")


def run_compiler(command: Sequence[str], arguments: Iterable[str]) -> None:
    """Run a compiler.

    Raises
    ------
    RuntimeError
        If it fails; with its own message.
    """
    result = subprocess.run([*command, *arguments], capture_output=True, text=True, check=False)
    if result.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{result.stderr}")


# only in a build: elsewhere importing hatchling would cost time
if "hatchling" in sys.modules:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface

    class KernelBuildHook(BuildHookInterface):  # type: ignore[type-arg,misc,unused-ignore]
        """Add the compiled kernels to the wheel, or to the sources of an editable install."""

        def dependencies(self) -> list[str]:
            """Request a compiler where the machine has none."""
            return [] if shutil.which("cc") else ["ziglang"]

        def initialize(self, version: str, build_data: dict[str, Any]) -> None:
            """Compile before the wheel is put together."""
            compile_kernels(HERE / LIBRARY)
            build_data["artifacts"].append(f"cosim/native/{LIBRARY}")
            build_data["pure_python"] = False
            system = sysconfig.get_platform().replace("-", "_").replace(".", "_")
            build_data["tag"] = f"py3-none-{system}"
