"""Metadata maps with a checksum of their own, and exact arrays in them.

MCAP protects neither metadata records nor a running file's channels: one flipped bit makes a filter rate of 0000.0 out of 1000.0,
unnoticed. So every map of ours carries the SHA-256 of its name and items.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.core.contracts import Design

PREFIX = "cosim."
CHECKSUM = "cosim.sha256"


def compact(value: Any) -> str:
    """Write JSON without spaces, in ASCII: equal values give equal text."""
    return json.dumps(value, separators=(",", ":"))


def seal(name: str, items: Mapping[str, str]) -> dict[str, str]:
    """Add the checksum to the map recorded under ``name``."""
    return {**items, CHECKSUM: _checksum(name, items)}


def unseal(name: str, items: Mapping[str, str]) -> dict[str, str]:
    """Check the map recorded under ``name`` and give it without its checksum; maps of others pass as they are.

    Raises
    ------
    ValueError
        If the checksum is missing from a map of ours, or does not fit.
    """
    if CHECKSUM not in items and not name.startswith(PREFIX):
        return dict(items)
    content = {key: value for key, value in items.items() if key != CHECKSUM}
    if items.get(CHECKSUM) != _checksum(name, content):
        raise ValueError(f"metadata {name!r} is damaged: its checksum does not fit its content")
    return content


def _checksum(name: str, items: Mapping[str, str]) -> str:
    return hashlib.sha256(compact([name, sorted(items.items())]).encode()).hexdigest()


def encode_design(design: Design) -> str:
    """Write arrays as JSON, bit for bit: shape, and base64 of the little-endian doubles in C order."""
    return compact(
        {
            name: {"shape": list(np.shape(array)), "data": _base64(array)}
            for name, array in design.items()
        }
    )


def _base64(array: NDArray[np.float64]) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype="<f8").tobytes()).decode("ascii")


def decode_design(text: str) -> dict[str, NDArray[np.float64]]:
    """Read what :func:`encode_design` wrote; the arrays cannot be written to.

    Raises
    ------
    ValueError, KeyError, TypeError
        If ``text`` is something else.
    """
    return {name: _array(entry["shape"], entry["data"]) for name, entry in json.loads(text).items()}


def _array(shape: list[int], data: str) -> NDArray[np.float64]:
    array = (
        np.frombuffer(base64.b64decode(data, validate=True), dtype="<f8")
        .astype(np.float64)
        .reshape(shape)
    )
    array.setflags(write=False)
    return array
