"""Compile the C kernels: a hatchling build hook, and the compiler that FMU export uses too.

``cc`` is used where there is one, else the package ``ziglang``, which the hook then asks for as a build dependency. zig always
gets a target: without one it emits the instructions of the host, fused multiply-adds among them, and the bits would differ.
"""

from __future__ import annotations

import importlib.util
import platform
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
SOURCES = ("loops.c", "linear.c", "expression.c", "estimate.c", "fmi.c")
FLAGS = ("-std=c11", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
LIBRARY = f"_cosim{'.dll' if sys.platform == 'win32' else '.so'}"


def compiler() -> list[str]:
    """Give the command of a C compiler; empty where there is none."""
    found = shutil.which("cc")
    if found:
        return [found]
    if importlib.util.find_spec("ziglang") is not None:
        system = {"linux": "linux-gnu", "darwin": "macos", "win32": "windows-gnu"}[sys.platform]
        machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(
            platform.machine(), platform.machine()
        )
        return cross_compiler(f"{machine}-{system}")
    return []


def cross_compiler(target: str) -> list[str]:
    """Give the command of a C compiler for another machine, by zig's name of it; empty where there is none."""
    if importlib.util.find_spec("ziglang") is None:
        return []
    return [sys.executable, "-m", "ziglang", "cc", "-target", target]


def compile_library(
    sources: Iterable[Path],
    target: Path,
    options: Iterable[str] = (),
    *,
    command: Sequence[str] | None = None,
) -> None:
    """Compile C sources to a shared library; ``options`` go to the compiler as they are.

    Without ``command`` the compiler is the one for this machine.

    Raises
    ------
    RuntimeError
        If there is no compiler, or it refuses the sources; with the compiler's own words.
    """
    command = compiler() if command is None else command
    if not command:
        raise RuntimeError("no C compiler: install one as 'cc', or 'pip install ziglang'")
    libraries = [] if target.suffix == ".dll" else ["-lm"]
    result = subprocess.run(
        [*command, *FLAGS, *options, *map(str, sources), "-o", str(target), *libraries],
        capture_output=True,
        text=True,
        check=False,
    )
    if result.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{result.stderr}")


if (
    "hatchling" in sys.modules
):  # a build; elsewhere only the compiler above is wanted, and importing hatchling costs time
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface

    class KernelBuildHook(BuildHookInterface):  # type: ignore[type-arg,misc,unused-ignore]
        """Put the compiled kernels into the wheel, or beside their sources for an editable install."""

        def dependencies(self) -> list[str]:
            """Ask for a compiler where the machine has none."""
            return [] if shutil.which("cc") else ["ziglang"]

        def initialize(self, version: str, build_data: dict[str, Any]) -> None:
            """Compile before the wheel is put together."""
            compile_library((HERE / name for name in SOURCES), HERE / LIBRARY)
            build_data["artifacts"].append(f"cosim/native/{LIBRARY}")
            build_data["pure_python"] = False
            build_data["tag"] = (
                f"py3-none-{sysconfig.get_platform().replace('-', '_').replace('.', '_')}"
            )
