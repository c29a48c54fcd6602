"""The arguments of public functions: what is none of the right type is refused at the border."""

from __future__ import annotations

import errno
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.errors import UsageError, command, flag, named_keys, option, quoted
from cosim.files import check_writable, expanded, file_type, read_type

READ_BY: Final = "'cosim cat' without --follow, diff, metrics, plot and convert read it"
NO_PATH = (errno.ENAMETOOLONG, errno.EILSEQ, errno.EINVAL)


def path_argument(name: str, value: object) -> Path:
    """Return an argument that is a path.

    Raises
    ------
    UsageError
        If it is neither text nor a path, or no file can have it.
    """
    if not isinstance(value, str | os.PathLike):
        raise UsageError(f"{option(name)}: expected a path, got {quoted(value)}")
    path = os.fspath(value)
    if not isinstance(path, str):
        raise UsageError(f"{option(name)}: expected a path as a string, got {quoted(value)}")
    check_path(path)
    return expanded(path)


def log_argument(value: object) -> Path:
    """Return an argument that is the path of a log.

    Raises
    ------
    UsageError
        If it is none, but that of something else; names the command for that.
    """
    path = path_argument("log", value)
    kind = read_type(path)
    if kind == "log":
        return path
    expected = f"{quoted(str(path))}: expected a log (.mcap)"
    if is_scenario(path):
        raise UsageError(f"{expected}; {command('run')} runs a scenario")
    if kind == "FMU":
        raise UsageError(f"{expected}; 'cosim info' shows an FMU")
    if kind == "table" and path.is_file():
        raise UsageError(f"{expected} of cosim, got a table; {READ_BY}")
    return path


def check_fmu_to_write(out: Path, *, force: bool) -> None:
    """Check the path of an FMU that is to be written.

    Raises
    ------
    UsageError
        If it is no path of an FMU, is there already and not to be replaced, or cannot be written.
    """
    check_path(out)
    if file_type(out) != "FMU":
        raise UsageError(f"{out}: expected a path that ends in .fmu")
    if out.exists() and not force:
        raise UsageError(f"{out} exists; choose another path, or {flag('force')} to replace it")
    try:
        check_writable(out)
    except OSError as error:
        raise UsageError(f"{out} cannot be written: {error.strerror}") from error


def fmu_argument(value: object) -> Path:
    """Return an argument that is the path of an FMU.

    Raises
    ------
    UsageError
        If it is none, but that of something else; names the command for that.
    """
    path = path_argument("fmu", value)
    expected = f"{quoted(str(path))}: expected an FMU (.fmu)"
    if is_scenario(path):
        raise UsageError(f"{expected}; 'cosim info' shows a scenario")
    if file_type(path) == "log":
        raise UsageError(f"{expected}; 'cosim info' shows a log")
    return path


def is_scenario(path: Path) -> bool:
    """Return whether a path is that of a scenario, or may be the name of a shipped one."""
    return file_type(path) == "scenario" or not (path.suffix or path.exists())


def check_path(path: str | Path) -> None:
    """Check that a file can have a path; there need be none.

    Raises
    ------
    UsageError
        If it is too long for the file system, or has characters that no path has.
    """
    try:
        os.stat(path)
    except ValueError as error:  # NUL, or half a surrogate pair
        raise UsageError(f"{quoted(str(path))} is no valid path") from error
    except OSError as error:
        if error.errno in NO_PATH:
            raise UsageError(f"{quoted(str(path))} is no valid path ({error.strerror})") from error


def mapping_argument(name: str, value: object) -> Mapping[str, Any]:
    """Return an argument that maps texts to something; None is an empty one.

    Raises
    ------
    UsageError
        If it is no mapping, or a key is no text.
    """
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise UsageError(
            f"{option(name)}: expected a mapping, such as {{'component.name': ...}}, "
            f"got {quoted(value)}"
        )
    for key in value:
        if not isinstance(key, str):
            raise UsageError(f"{option(name)}: expected strings as keys, got {quoted(key)}")
    return value


@contextmanager
def setting_arguments(
    changes: object,
    *,
    stop: float | None = None,
    step: float | str | None = None,
    verdicts: bool | None = None,
) -> Iterator[dict[str, Any]]:
    """Yield ``set`` with the settings that are arguments, too; inside, messages name these.

    Raises
    ------
    UsageError
        If ``set`` is no mapping, or sets one of them itself.
    """
    merged = dict(mapping_argument("set", changes))
    names = {}
    for name, value in {"stop": stop, "step": step, "verdicts": verdicts}.items():
        if value is None:
            continue
        key = f"scenario.{name}"
        names[key] = flag(name, value) if isinstance(value, bool) else option(name)
        if key in merged:
            raise UsageError(
                f"{names[key]} and {option('set', key)} set the same; omit one of them"
            )
        merged[key] = value
    with named_keys(names):
        yield merged


def swap_argument(value: object) -> dict[str, Any]:
    """Return what is swapped by component, which may be written ``components.NAME``.

    Raises
    ------
    UsageError
        If it is no mapping, a key is no text, or a component is given twice.
    """
    swap: dict[str, Any] = {}
    for key, item in mapping_argument("swap", value).items():
        name = key.removeprefix("components.")
        if name in swap:
            raise UsageError(f"{option('swap', name)}: expected once, also given as {quoted(key)}")
        swap[name] = item
    return swap


def texts_argument(name: str, value: object) -> tuple[str, ...] | None:
    """Return an argument that is a sequence of texts, or None; a single text is none.

    Raises
    ------
    UsageError
        If it is something else.
    """
    if value is None:
        return None
    items = value if isinstance(value, Sequence) and not isinstance(value, str) else (None,)
    if not all(isinstance(item, str) for item in items):
        raise UsageError(f"{option(name)}: expected a list of strings, got {quoted(value)}")
    return tuple(items)


def number_argument(name: str, value: object) -> float:
    """Return an argument that is a number.

    Raises
    ------
    UsageError
        If it is none; truth values are none.
    """
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        raise UsageError(f"{option(name)}: expected a number, got {quoted(value)}")
    return float(value)


def positive_argument(name: str, value: object) -> float:
    """Return an argument that is a finite number above 0.

    Raises
    ------
    UsageError
        If it is none.
    """
    number = number_argument(name, value)
    if not 0.0 < number < math.inf:
        raise UsageError(f"{option(name)}: expected a finite number > 0, got {number}")
    return number


def truth_argument(name: str, value: object) -> bool:
    """Return an argument that is true or false.

    Raises
    ------
    UsageError
        If it is something else.
    """
    if not isinstance(value, bool | np.bool_):
        raise UsageError(f"{option(name)}: expected True or False, got {quoted(value)}")
    return bool(value)


def whole_argument(name: str, value: object) -> int | None:
    """Return an argument that is a whole number or None.

    Raises
    ------
    UsageError
        If it is something else.
    """
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise UsageError(f"{option(name)}: expected a whole number, got {quoted(value)}")
    return int(value)


def fillable_argument(name: str, value: object) -> None:
    """Check an argument that is filled with results; None is none.

    Raises
    ------
    UsageError
        If it is no dict.
    """
    if value is not None and not isinstance(value, dict):
        raise UsageError(f"{option(name)}: expected a dict to fill, got {quoted(value)}")


def callable_argument(name: str, value: object) -> None:
    """Check an argument that is called; None is none.

    Raises
    ------
    UsageError
        If it cannot be called.
    """
    if value is not None and not callable(value):
        raise UsageError(f"{option(name)}: expected a function, got {quoted(value)}")
