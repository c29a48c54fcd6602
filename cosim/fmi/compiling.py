"""Compile C sources to a shared library, only those that were not compiled before.

Objects and libraries are kept in the user's cache folder. The key of an object is the SHA-256 of
its source, of the headers that it includes, of the options, the compiler and the machine; that of a
library, of the keys of its objects and the options. A file begins with the SHA-256 of the rest: a
damaged one counts as none, and is written anew. Sources and options whose effect a key would not
show are compiled directly.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Final

from cosim.files import read_bounded
from cosim.fmi.cache import COMPILED, cache_folder, cached_files, keep
from cosim.native import build

LARGEST: Final = 2**26  # bytes of one file
LARGEST_FOLDER: Final = 2**27  # bytes of all; the ones used last stay
_DIGEST: Final = 32  # bytes
_INCLUDE: Final = re.compile(rb'^[ \t]*#[ \t]*include[ \t]*(["<])([^">\n]+)[">]', re.MULTILINE)
# what a source may depend on besides its text and the headers it names
_UNKNOWN: Final = re.compile(
    rb"^[ \t]*#[ \t]*(include[ \t]*[^\"< \t]|include_next|import|embed)|__has_include|__has_embed"
    rb"|__DATE__|__TIME__|__TIMESTAMP__|__FILE__|__BASE_FILE__|\.incbin",
    re.MULTILINE,
)
_OPTION: Final = re.compile(r"-std=.+|-[DUIO].+|-[fm].+|-O|-shared|-s|-Wl,.+")
_OF_LINKER: Final = re.compile(r"-shared|-s|-Wl,.+")
_ENVIRONMENT: Final = ("CPATH", "C_INCLUDE_PATH", "COMPILER_PATH", "GCC_EXEC_PREFIX", "SDKROOT")


@dataclass(frozen=True, slots=True)
class _Step:
    """A call of the compiler that makes one file.

    Parameters
    ----------
    key : str
    command : tuple of str
        The compiler.
    arguments : tuple of str
        Without the file to write.
    """

    key: str
    command: tuple[str, ...]
    arguments: tuple[str, ...]


def compile_library(
    sources: Iterable[Path],
    target: Path,
    options: Iterable[str] = (),
    *,
    command: Sequence[str] | None = None,
) -> None:
    """Compile C sources to a shared library, with the objects that are kept.

    The library is the same, bit for bit, as that of :func:`cosim.native.build.compile_library`.

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
    files = list(sources)
    further = list(options)
    command = build.compiler() if command is None else command
    folder = cache_folder()
    if folder is not None and command:
        # whatever fails here, fails below with the compiler's message, or is compiled there
        with suppress(RuntimeError, OSError):
            content = _library(folder / COMPILED, files, target, further, tuple(command))
            if content is not None:
                target.unlink(missing_ok=True)  # it may be loaded
                target.write_bytes(content)
                return
    build.compile_library(files, target, further, command=command)


def _library(
    folder: Path, files: Sequence[Path], target: Path, options: list[str], command: tuple[str, ...]
) -> bytes | None:
    """Return the library; None: its sources or options are of a sort that has no key."""
    flags = [*build.FLAGS, *options]
    steps = _steps(files, flags, command)
    if steps is None:
        return None
    of_linker = [flag for flag in flags if _OF_LINKER.fullmatch(flag)]
    # on Windows and macOS a library holds its own name
    name = target.suffix if target.suffix == ".so" else target.name
    key = _digest(name, of_linker, [step.key for step in steps])
    content = _read(folder / f"{key}.bin")
    if content is not None:
        return content
    # beside the target: who made its folder removes it, also after a crash
    with tempfile.TemporaryDirectory(dir=target.parent, prefix="objects-") as temporary:
        objects = [Path(temporary) / f"{i}.o" for i in range(len(steps))]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(lambda step, path: _make(folder, step, path), steps, objects))
        libraries = [] if target.suffix == ".dll" else ["-lm"]
        inputs = map(str, objects)
        made = Path(temporary) / target.name
        link = _Step(key, command, (*of_linker, *inputs, *libraries))
        content = _make(folder, link, made)
    _remove_oldest()
    return content


def _steps(
    files: Sequence[Path], flags: Sequence[str], command: tuple[str, ...]
) -> list[_Step] | None:
    """Return how each source is compiled; None: there is one, or an option, that has no key."""
    if not all(_OPTION.fullmatch(flag) for flag in flags):
        return None
    of_compiler = [flag for flag in flags if not _OF_LINKER.fullmatch(flag)]
    folders = [Path(flag[2:]) for flag in of_compiler if flag.startswith("-I")]
    # headers count by content, wherever they are
    counted = [flag for flag in of_compiler if not flag.startswith("-I")]
    context = _digest(_identity(command), counted, [os.environ.get(name) for name in _ENVIRONMENT])
    steps = []
    for file in files:
        contents = _contents(file, folders) if file.suffix == ".c" else None
        if contents is None:
            return None
        key = _digest(context, file.name, contents)
        steps.append(_Step(key, command, (*of_compiler, "-c", str(file))))
    return steps


def _contents(source: Path, folders: Sequence[Path]) -> list[tuple[str, str]] | None:
    """Return the names and digests of a source and of what it includes; None: not all is known.

    Headers of the system belong to the compiler.
    """
    found: list[tuple[str, str]] = []
    known: set[Path] = set()
    waiting = [(source.name, source)]
    while waiting:
        name, path = waiting.pop()
        text = path.read_bytes()
        found.append((name, hashlib.sha256(text).hexdigest()))
        if path in known:
            continue
        known.add(path)
        if _UNKNOWN.search(text):
            return None
        for quote, included in _INCLUDE.findall(text):
            nearest = [path.parent] if quote == b'"' else []
            spelled = os.fsdecode(included)
            header = next(
                (place / spelled for place in (*nearest, *folders) if (place / spelled).is_file()),
                None,
            )
            if header is not None:
                waiting.append((spelled, header))
    return found


@cache
def _identity(command: tuple[str, ...]) -> list[object]:
    """Return what tells a compiler, and what it compiles for, from another."""
    path = os.path.realpath(command[0])
    status = os.stat(path)
    version = subprocess.run([*command, "--version"], capture_output=True, check=False).stdout
    identity = [command, path, status.st_size, status.st_mtime_ns, os.fsdecode(version)]
    if "ziglang" in command:
        identity.append(metadata.version("ziglang"))
    return [*identity, sys.platform, platform.machine(), platform.libc_ver()]


def _make(folder: Path, step: _Step, path: Path) -> bytes:
    """Write a file that is kept, or make and keep it; return its content."""
    file = folder / f"{step.key}.bin"
    content = _read(file)
    if content is not None:
        path.write_bytes(content)
        return content
    build.run_compiler(step.command, (*step.arguments, "-o", str(path)))
    content = path.read_bytes()
    if len(content) + _DIGEST <= LARGEST:
        keep(file, hashlib.sha256(content).digest() + content)
    return content


def _read(file: Path) -> bytes | None:
    """Return what a file keeps; None: it is not there, or damaged."""
    try:
        whole = read_bounded(file, LARGEST)
    except OSError:
        return None
    digest = whole[:_DIGEST]
    content = whole[_DIGEST:]
    if hashlib.sha256(content).digest() != digest:
        return None
    with suppress(OSError):
        os.utime(file)  # it was used
    return content


def _remove_oldest() -> None:
    """Remove the files that were not used for longest, where all are too large."""
    files = list(cached_files(COMPILED))
    total = sum(status.st_size for _, status in files)
    for file, status in sorted(files, key=lambda item: item[1].st_mtime_ns):
        if total <= LARGEST_FOLDER:
            return
        with suppress(OSError):
            file.unlink()
        total -= status.st_size


def _digest(*values: object) -> str:
    return hashlib.sha256(repr(values).encode()).hexdigest()
