"""JSON of metadata, and exact arrays in it."""

from __future__ import annotations

import base64
import json
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.core.contracts import Design
from cosim.errors import quoted

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


def encode_design(design: Design) -> str:
    """Write arrays as JSON, bit for bit: shape, and base64 of the doubles in C order."""
    entries = {}
    for name, array in design.items():
        shape = list(np.shape(array))
        entries[name] = {"shape": shape, "data": _encode_doubles(array)}
    return compact(entries)


def _encode_doubles(array: NDArray[np.float64]) -> str:
    little_endian = np.ascontiguousarray(array, dtype="<f8")
    return base64.b64encode(little_endian.tobytes()).decode("ascii")


def decode_design(text: str) -> dict[str, NDArray[np.float64]]:
    """Read what :func:`encode_design` wrote; the arrays are read-only.

    Raises
    ------
    ValueError, KeyError, TypeError
        If ``text`` is something else.
    """
    design = {}
    for name, entry in json_table(text).items():
        doubles = _decode_doubles(entry["data"])
        design[name] = doubles.reshape(_shape(entry["shape"]))
        design[name].setflags(write=False)
    return design


def _shape(value: Any) -> tuple[int, ...]:
    is_shape = isinstance(value, list) and len(value) <= _MOST_AXES
    if not is_shape or not all(type(size) is int and size >= 0 for size in value):
        raise ValueError(f"expected a list of sizes as the shape, got {quoted(value)}")
    return tuple(value)


def _decode_doubles(data: str) -> NDArray[np.float64]:
    if not isinstance(data, str):
        raise TypeError(f"expected base64, got {quoted(data)}")
    decoded = base64.b64decode(data, validate=True)
    little_endian = np.frombuffer(decoded, dtype="<f8")
    return little_endian.astype(np.float64)
