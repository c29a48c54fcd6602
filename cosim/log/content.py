"""The content hash: one number for every bit of every signal of a run.

It covers names, declarations, times and values, in the order of the rows, and nothing else: not the blocks the run was made
in, nor the chunks, the compression or the order of the components in the file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import numpy as np

from cosim.arrays import Matrix, Nanoseconds
from cosim.log.metadata import compact


def hashable(time_ns: Nanoseconds, rows: Matrix) -> memoryview:
    """Give the bytes that a component's SHA-256 takes in: per row the time as int64, then the doubles, all little-endian.

    Parameters
    ----------
    time_ns : Nanoseconds, shape (n,)
    rows : Matrix, shape (n, width)
    """
    joined = np.empty((len(rows), rows.shape[1] + 1), dtype="<f8")
    joined.view("<i8")[:, 0] = time_ns
    joined[:, 1:] = rows
    return joined.view(np.uint8).reshape(-1).data


def combine(components: Iterable[tuple[str, str, str]]) -> str:
    """Combine (name, cosim.signals, SHA-256 in hex) of all components to the hash of the run, in hex."""
    return hashlib.sha256(compact(sorted(components)).encode()).hexdigest()
