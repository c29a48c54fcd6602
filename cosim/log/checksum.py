"""Metadata maps with a checksum of their own.

MCAP protects neither metadata records nor the channels of a file that is still written: one flipped
bit makes a filter rate of 0000.0 out of 1000.0, unnoticed. So every map of ours carries the SHA-256
of its name and items.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Final

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
    text = json.dumps([name, sorted(items.items())], separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
