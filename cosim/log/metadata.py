"""Metadata of a log: JSON, exact arrays, when and where the run began, its content hash.

The content hash is one number for every bit of every signal of a run. It covers names,
declarations, times and values, in the order of the rows, and nothing else: not the blocks the run
was made in, nor the chunks, the compression or the order of the components in the file. Signals
with the same hash have the same bits at the same times, in one log or in two.

MCAP protects neither metadata records nor the channels of a file that is still written: one flipped
bit makes a filter rate of 0000.0 out of 1000.0, unnoticed. So every map of ours carries the SHA-256
of its name and items.
"""

from __future__ import annotations

import base64
import hashlib
import json
import platform
import re
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.contracts import Design
from cosim.core.recorded.signals import RecordedPort
from cosim.core.recording import Recording
from cosim.errors import quoted
from cosim.instants import last_nanosecond
from cosim.version import __version__

_MOST_AXES = 8
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


def compact(value: Any) -> str:
    """Write JSON without spaces, in ASCII: equal values have equal text."""
    return json.dumps(value, separators=(",", ":"))


def read_json(text: str | bytes) -> Any:
    """Read JSON.

    Raises
    ------
    ValueError
        If it is none, or nested too deeply to be read.
    """
    try:
        value = json.loads(text)
        if _SURROGATE.search(text if isinstance(text, str) else text.decode()):
            json.dumps(value, ensure_ascii=False).encode()
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    except UnicodeEncodeError as error:
        raise ValueError("it contains an unpaired surrogate") from error
    return value


def json_table(text: str | bytes) -> dict[str, Any]:
    """Read a JSON object.

    Raises
    ------
    ValueError
        If ``text`` is none.
    """
    value = read_json(text)
    if not isinstance(value, dict):
        raise ValueError(f"expected a table, got {quoted(value)}")
    return value


def json_texts(text: str) -> list[str]:
    """Read a JSON array of strings.

    Raises
    ------
    ValueError
        If ``text`` is none.
    """
    value = read_json(text)
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise ValueError(f"expected a list of strings, got {quoted(value)}")
    return value


PREFIX: Final = "cosim."
CHECKSUM: Final = "cosim.sha256"


def add_checksum(name: str, items: Mapping[str, str]) -> dict[str, str]:
    """Add the checksum to the map recorded under ``name``."""
    return {**items, CHECKSUM: _checksum(name, items)}


def verify_checksum(name: str, items: Mapping[str, str]) -> dict[str, str]:
    """Check the map recorded under ``name`` and return it without its checksum.

    Maps that other tools added pass as they are.

    Raises
    ------
    ValueError
        If the checksum is missing from a map of ours, or does not fit.
    """
    if CHECKSUM not in items and not name.startswith(PREFIX):
        return dict(items)
    content = dict(items)
    checksum = content.pop(CHECKSUM, None)
    if checksum != _checksum(name, content):
        raise ValueError(f"metadata {name!r} is damaged: its checksum does not match its content")
    return content


def _checksum(name: str, items: Mapping[str, str]) -> str:
    # Sorted: another tool may write the items of a map in another order.
    text = compact([name, sorted(items.items())])
    return hashlib.sha256(text.encode()).hexdigest()


def encode_design(design: Design) -> str:
    """Write arrays as JSON, bit for bit: shape, and base64 of the doubles in C order."""
    entries = {}
    for name, array in design.items():
        data = np.ascontiguousarray(array, dtype="<f8").tobytes()
        text = base64.b64encode(data).decode("ascii")
        entries[name] = {"shape": list(np.shape(array)), "data": text}
    return compact(entries)


def decode_design(text: str) -> dict[str, NDArray[np.float64]]:
    """Read what :func:`encode_design` wrote; the arrays are read-only.

    Raises
    ------
    ValueError, KeyError, TypeError
        If ``text`` is something else.
    """
    design = {}
    for name, entry in json_table(text).items():
        shape, data = entry["shape"], entry["data"]
        is_shape = isinstance(shape, list) and len(shape) <= _MOST_AXES
        if not is_shape or not all(type(size) is int and size >= 0 for size in shape):
            raise ValueError(f"expected a list of sizes as the shape, got {quoted(shape)}")
        if not isinstance(data, str):
            raise TypeError(f"expected base64, got {quoted(data)}")
        doubles = np.frombuffer(base64.b64decode(data, validate=True), dtype="<f8")
        design[name] = doubles.astype(np.float64).reshape(shape)
        design[name].setflags(write=False)
    return design


def recorded_start_ns(metadata: Mapping[str, Mapping[str, str]]) -> int | None:
    """Return the instant from which steps are counted [ns]; None: it is not recorded.

    That is the start time of the run, or where the span begins that a replay recorded alone.

    Parameters
    ----------
    metadata : mapping of record name to its items
    """
    run = metadata.get("cosim.run", {})
    try:
        # a replay of all has null for its window
        window = json_table(run.get("replay", "{}")).get("window") or [run.get("start_time", "")]
        return last_nanosecond(float(window[0]))
    except (ValueError, OverflowError, TypeError, LookupError):
        return None


WRITTEN = "cosim.written"  # the record that has the time at which a recording began
_PACKAGES = ("numpy", "scipy", "mcap")


@cache
def library_name() -> str:
    """Return the name of the program, for the header of a log."""
    return f"cosim/{__version__} mcap-python/{_version('mcap')}"


def environment() -> dict[str, str]:
    """Return the versions of Python and the packages that compute, the platform, the processor."""
    versions = {"cosim": __version__}
    for name in _PACKAGES:
        versions[name] = _version(name)
    return {
        **versions,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": _processor(),
    }


@cache  # reading it takes a millisecond
def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


@cache
def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    for line in lines:
        key, _, value = line.partition(":")
        if key.startswith("model name"):
            return value.strip()
    return platform.machine()


def environment_changes(recording: Recording) -> dict[str, tuple[str, str]]:
    """Return what is different on this machine from the one that wrote a log.

    Returns
    -------
    dict of str to (str, str)
        By name the recorded value and the present one; what was not recorded is not compared.
    """
    recorded = recording.metadata.get("cosim.env", {})
    changes = {}
    for name, present in environment().items():
        if name in recorded and recorded[name] != present:
            changes[name] = (str(recorded[name]), present)
    return changes


def hash_input(time_ns: Nanoseconds, rows: Matrix) -> memoryview:
    """Return the bytes that a component's SHA-256 covers.

    Per row the time as int64, then the doubles, all little-endian.

    Parameters
    ----------
    time_ns : Nanoseconds, shape (n,)
    rows : Matrix, shape (n, width)
    """
    count, width = rows.shape
    table = np.empty((count, 1 + width), dtype="<f8")
    table.view("<i8")[:, 0] = time_ns
    table[:, 1:] = rows
    return table.view(np.uint8).reshape(-1).data


def combine_hashes(components: Iterable[tuple[str, str, str]]) -> str:
    """Combine the components to the hash of the run, in hex.

    Parameters
    ----------
    components : iterable of (str, str, str)
        Name, ``cosim.signals`` and SHA-256 in hex of each component, in any order.
    """
    # Sorted: the hash does not depend on the order of the components in the file.
    text = compact(sorted(components))
    return hashlib.sha256(text.encode()).hexdigest()


def hash_signals(run: Recording, selection: Mapping[str, RecordedPort]) -> dict[str, str]:
    """Return the SHA-256 in hex of each chosen signal, by its name.

    Per row it covers the time in ns as int64, then the elements as doubles, all little-endian.

    Raises
    ------
    LogError
        If a file is damaged.
    """
    by_component: dict[str, list[str]] = {}
    for name, port in selection.items():
        by_component.setdefault(port.channel.name, []).append(name)
    digests = {name: hashlib.sha256() for name in selection}
    for component, names in by_component.items():
        for time_ns, rows in run.blocks(component):
            for name in names:
                digests[name].update(hash_input(time_ns, rows[:, selection[name].columns]))
    return {name: digest.hexdigest() for name, digest in digests.items()}
