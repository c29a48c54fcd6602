"""The step of ``sensor.c``: what a measuring chain makes of its input."""

from __future__ import annotations

from ctypes import Structure, c_double, c_int32, c_int64, c_void_p
from dataclasses import dataclass, fields

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.library import address, pointer
from cosim.native.step import NativeStep


@dataclass(frozen=True, eq=False)
class Levels:
    """Levels ``origin + i resolution``, i from first to last; each of shape (size,)."""

    origin: Vector
    resolution: Vector
    first: Vector
    last: Vector


@dataclass(frozen=True, eq=False)
class DrawnSamples:
    """Random numbers of samples that were drawn ahead, each of shape (N, size).

    ``position`` is the sampling instant minus t, in communication steps; ``lost`` is 1 where the
    sample is lost, else 0.
    """

    position: Matrix
    noise: Matrix
    lost: Matrix


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorConstants:
    """The numbers of cosim_sensor.

    Parameters
    ----------
    depth : int
        Inputs before the time reached that are kept.
    period : int
        Communication steps between two samples.
    drops, samples, stamps : bool
        There is the output ``valid``; the samples are outputs; their times are the sampling
        instants.
    bias, lower, upper : Vector, shape (size,)
    levels : Levels or None
    """

    depth: int
    period: int
    drops: bool
    samples: bool
    stamps: bool
    bias: Vector
    lower: Vector
    upper: Vector
    levels: Levels | None

    @property
    def size(self) -> int:
        """The number of elements."""
        return len(self.bias)

    @property
    def n_y(self) -> int:
        """The number of outputs."""
        of_samples = self.size + 1 if self.samples else 0
        return self.size * (1 + self.drops) + of_samples

    @property
    def memory(self) -> int:
        """The number of doubles that change."""
        return 3 + (2 + self.depth) * self.size


class _SensorStruct(Structure):
    """cosim_sensor."""

    _fields_ = (
        *((name, c_int32) for name in ("size", "depth", "period", "drops", "samples", "stamps")),
        ("quantizes", c_int32),
        *((name, c_double) for name in ("h", "begin")),
        *((name, c_void_p) for name in ("held", "bias", "lower", "upper")),
        *((name, c_void_p) for name in ("origin", "resolution", "first", "last")),
        ("drawn", c_int64),
        *((name, c_void_p) for name in ("position", "noise", "lost", "memory")),
    )


class SensorStep:
    """The step of a sensor; it declines where the numbers that were drawn do not suffice.

    Parameters
    ----------
    constants : SensorConstants
    drawn : DrawnSamples
        Read where they are; what is drawn later stands there too.

    Attributes
    ----------
    step : NativeStep
    held : array of uint8, shape (size,)
        Which elements have a zero-order hold, to be written to.
    """

    def __init__(self, constants: SensorConstants, drawn: DrawnSamples) -> None:
        size = constants.size
        self._size = size
        self._period = constants.period
        self.held = np.zeros(size, np.uint8)
        levels = constants.levels or Levels(*np.zeros((4, size)))
        of_levels = [getattr(levels, field.name) for field in fields(Levels)]
        given = (constants.bias, constants.lower, constants.upper, *of_levels)
        arrays = [np.array(array, np.float64) for array in given]
        numbers = (drawn.position, drawn.noise, drawn.lost)
        memory = np.zeros(constants.memory)
        flags = (constants.drops, constants.samples, constants.stamps)
        self._state = _SensorStruct(
            size,
            constants.depth,
            constants.period,
            *map(int, flags),
            int(constants.levels is not None),
            0.0,
            0.0,
            pointer(self.held),
            *map(pointer, arrays),
            len(drawn.position),
            *map(pointer, (*numbers, memory)),
        )
        self.step = NativeStep(
            address("cosim_sensor_step"),
            self._state,
            n_y=constants.n_y,
            memory=memory,
            keep=(self.held, *arrays, *numbers),
            outputs=address("cosim_sensor_outputs"),
        )

    def set_step(self, h: float) -> None:
        """Take the communication step [s]."""
        self._state.h = h

    def start(self, t: float, u: Vector) -> None:
        """Begin at ``t`` [s] with ``u`` as the input before: a sample is due, the first of all."""
        self._state.begin = t
        memory = self.step.memory
        memory[:] = 0.0
        memory[0] = self._period
        memory[3 + self._size : 3 + 2 * self._size] = 1.0
        past = memory[3 + 2 * self._size :]
        past[:] = np.tile(u, len(past) // self._size)

    @property
    def next(self) -> int:
        """The number of the next sample of those that were drawn."""
        return int(self.step.memory[1])

    @next.setter
    def next(self, number: int) -> None:
        self.step.memory[1] = number
