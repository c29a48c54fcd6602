"""The times of the messages of a topic: their order, repeated instants, and the largest gap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.instants import NANOSECONDS

Instants = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Spacing:
    """Messages in time.

    Parameters
    ----------
    count : int
    first_ns, last_ns : int
        Earliest and latest time.
    late : int
        Messages that stand after one of a later time.
    repeated : int
        Messages of an instant that a later one in the file has, too.
    median_ns, largest_ns : int
        Distances of instants that follow each other; 0: there is one instant.
    largest_at_ns : int
        Where the largest distance begins, the first of several.
    """

    count: int
    first_ns: int
    last_ns: int
    late: int
    repeated: int
    median_ns: int
    largest_ns: int
    largest_at_ns: int

    @property
    def rate(self) -> float | None:
        """Messages per second at the median distance [Hz]; None: there is one instant."""
        return NANOSECONDS / self.median_ns if self.median_ns else None

    def disorder_text(self) -> str:
        """Return what is wrong with the order of the messages; empty: nothing is."""
        texts = []
        if self.late:
            texts.append(f"{self.late} of {self.count} messages out of order, sorted by time")
        if self.repeated:
            texts.append(
                f"{self.repeated} of {self.count} messages dropped: a later one in the file has "
                "the same time"
            )
        return "; ".join(texts)


def spacing_of(stamps: Instants) -> Spacing:
    """Return how messages lie in time.

    Parameters
    ----------
    stamps : Instants, shape (N,)
        Their times in the order of the file [ns], at least one.
    """
    late = int(np.count_nonzero(stamps < np.maximum.accumulate(stamps)))
    instants = np.unique(stamps)
    repeated = len(stamps) - len(instants)
    # unsigned: between the ends of int64 lie more than it has
    gaps = np.diff(instants.view(np.uint64))
    place = int(gaps.argmax()) if len(gaps) else 0
    return Spacing(
        len(stamps),
        int(instants[0]),
        int(instants[-1]),
        late,
        repeated,
        int(np.median(gaps)) if len(gaps) else 0,
        int(gaps[place]) if len(gaps) else 0,
        int(instants[place]),
    )
