"""Outputs that stand still: a sensor at a limit of its range, stuck, or too coarse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cosim.arrays import Vector
from cosim.theory.disturbed_plant import DataSet

LEAST_PART: Final = 0.1  # of the samples of a record
FEWEST: Final = 10


@dataclass(frozen=True)
class StandingOutput:
    """An output that has one value over a good part of a record.

    Parameters
    ----------
    output : int
    value : float
    start, stop : float
        Times of the first and the last sample with it [s].
    whole : bool
        It has it at every sample.
    """

    output: int
    value: float
    start: float
    stop: float
    whole: bool

    def __str__(self) -> str:
        """Return what it does."""
        if self.whole:
            return f"y[{self.output}] is {self.value:g} at every sample: nothing shows in it"
        return (
            f"y[{self.output}] stands at {self.value:g} from {self.start:g} s to {self.stop:g} s, "
            "as of a sensor at a limit of its range, stuck or too coarse"
        )


def standing_outputs(data: Sequence[DataSet]) -> list[StandingOutput]:
    """Return the outputs that stand still, each with the longest time of every data set."""
    outputs = []
    for one in data:
        for output, column in enumerate(one.y.T):
            measured = np.isfinite(column)
            standing = _longest(output, one.t[measured], column[measured])
            if standing is not None:
                outputs.append(standing)
    return outputs


def _longest(output: int, t: Vector, y: Vector) -> StandingOutput | None:
    changes = np.flatnonzero(np.diff(y) != 0.0) + 1
    bounds = np.concatenate([[0], changes, [len(y)]])
    lengths = np.diff(bounds)
    place = int(lengths.argmax())
    first = int(bounds[place])
    last = int(bounds[place + 1]) - 1
    whole = len(lengths) == 1
    if not whole and lengths[place] < max(LEAST_PART * len(y), FEWEST):
        return None
    return StandingOutput(output, float(y[first]), float(t[first]), float(t[last]), whole)
