"""A recorded component in the place of a live one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cosim.arrays import Mask, Matrix, Vector, as_columns
from cosim.core.contracts import Design, Recording, Stopped
from cosim.core.signals import Interface
from cosim.errors import GraphError, LogError


class Replay:
    """Gives the recorded outputs of a component, bit for bit, whatever its inputs are.

    Parameters
    ----------
    recording : Recording
        A log file, or the memory of a run.
    component : str
        The recorded component.
    inputs : bool
        Show the recorded inputs too, so that what fed the component may stay connected; False: a source.
    """

    def __init__(self, recording: Recording, component: str, *, inputs: bool = True) -> None:
        channel = recording.channels.get(component)
        if channel is None:
            raise LogError(
                f"the log has no component {component!r}; it has: {', '.join(recording.channels)}"
            )
        if not len(recording.time_ns(component)):
            raise LogError(
                f"the log has no rows of {component!r}; needed at least the one at t = 0"
            )
        found = channel.interface
        shown = found if inputs else Interface((), found.outputs, {})
        self.interface = replace(shown, prepares=True, rollback=False)
        columns = [as_columns(recording[f"{component}.{signal.name}"]) for signal in found.outputs]
        self._rows = (
            np.hstack(columns) if columns else np.zeros((len(recording.time_ns(component)), 0))
        )
        self._time = recording.time_ns(component) / 1e9

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Pass the recorded design on, so that a replay's log is as complete as the run's."""
        return recorded

    def initialize(self, t: float, u: Vector) -> Vector:
        """Give the first recorded row."""
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the recorded row at ``t``."""
        row: Vector = self._rows[self._index(np.array([t]))[0]].copy()
        return row

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Give the recorded rows at ``t[1:]``; stops at the end of the recording."""
        inside = t[1:][t[1:] <= self._time[-1]]
        rows = self._rows[self._index(inside)]
        if len(inside) < len(t) - 1:
            raise Stopped(rows, f"the recording ends at {self._time[-1]} s")
        return rows

    def _index(self, t: Vector) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        index = np.searchsorted(self._time, t, side="right") - 1
        if (index < 0).any():
            raise GraphError(f"the recording begins at {self._time[0]} s, was asked for {t[0]} s")
        return index
