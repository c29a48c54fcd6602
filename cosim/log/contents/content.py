"""The content hash: one number for every bit of every signal of a run.

It covers names, declarations, times and values, in the order of the rows, and nothing else: not the
blocks the run was made in, nor the chunks, the compression or the order of the components in the
file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import numpy as np

from cosim.arrays import Matrix, Nanoseconds
from cosim.log.contents.metadata import compact


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
