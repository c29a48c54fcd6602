"""The step of ``late_samples.c``: inputs that are held back until their samples have come."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import Structure, c_int32, c_void_p
from dataclasses import dataclass

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.blocks.wrapping import InnerStruct, inner_struct
from cosim.native.library import address, int32, pointer
from cosim.native.step import NativeStep


@dataclass(frozen=True, eq=False, kw_only=True)
class LateColumns:
    """Where samples stand in the inputs that are shown, and in those of the component.

    Parameters
    ----------
    shown_samples, shown_times : int
        First columns of the samples and of their instants, as shown.
    samples, times : int
        The same of the component.
    values : int
        The number of outputs that are sampled.
    most : int
        Places for samples in a row of the component.
    source : sequence of int
        Of each input of the component: the column that is shown; -1: it has samples.
    """

    shown_samples: int
    shown_times: int
    samples: int
    times: int
    values: int
    most: int
    source: Sequence[int]


class HeldRows:
    """What changes in a component whose inputs are held back.

    Parameters
    ----------
    steps : int
        Rows that are held back, at most.
    n_u, n_y : int
        Inputs and outputs of the component.

    Attributes
    ----------
    values : Vector
        All of it.
    y : Vector, shape (n_y,)
        The last outputs.
    """

    def __init__(self, steps: int, n_u: int, n_y: int) -> None:
        self.values = np.zeros(3 + n_y + (steps + 1) * (1 + n_u))
        self.y = self.values[3 : 3 + n_y]
        self._rows = self.values[3 + n_y :].reshape(steps + 1, 1 + n_u)

    @property
    def passed(self) -> float:
        """Time of the last row that was passed on [s]."""
        return float(self.values[2])

    @passed.setter
    def passed(self, t: float) -> None:
        self.values[2] = t

    def rows(self) -> tuple[Vector, Matrix]:
        """Return copies of times [s] and inputs of the rows that are held, the oldest first."""
        count = int(self.values[0])
        oldest = int(self.values[1])
        places = (oldest + np.arange(count)) % len(self._rows)
        held = self._rows[places]
        return held[:, 0].copy(), held[:, 1:].copy()

    def hold(self, t: Vector, u: Matrix) -> None:
        """Hold these rows back, and no others."""
        self.values[0] = len(t)
        self.values[1] = 0.0
        self._rows[: len(t), 0] = t
        self._rows[: len(t), 1:] = u


class _LateSamplesStruct(Structure):
    """cosim_late_samples."""

    _fields_ = (
        ("inner", InnerStruct),
        *((name, c_int32) for name in ("steps", "n_u", "n_y")),
        *((name, c_int32) for name in ("shown_samples", "shown_times", "samples", "times")),
        *((name, c_int32) for name in ("values", "most")),
        *((name, c_void_p) for name in ("source", "memory")),
    )


def late_samples_step(
    step: NativeStep, columns: LateColumns, held: HeldRows, *, steps: int
) -> NativeStep:
    """Build a step that holds the inputs of another one back by ``steps`` steps.

    It declines where a sample has no place.
    """
    source = int32(columns.source)
    state = _LateSamplesStruct(
        inner_struct(step),
        steps,
        len(source),
        step.n_y,
        columns.shown_samples,
        columns.shown_times,
        columns.samples,
        columns.times,
        columns.values,
        columns.most,
        pointer(source),
        pointer(held.values),
    )
    return NativeStep(
        address("cosim_late_samples_step"),
        state,
        n_y=step.n_y,
        memory=held.values,
        keep=(step, source),
        outputs=address("cosim_late_samples_outputs"),
        guard=step.guard,
    )
