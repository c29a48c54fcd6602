"""The memory of a compiled step that keeps all samples: a small state, and samples behind it.

Samples are only ever appended, so a saved state has no need of a copy of them for as long as they
stay where they are. Before others are written over them, it gets one; so does a state that leaves,
pickled or for another memory.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from ctypes import Structure, byref, c_int64, c_void_p
from typing import Any, Final
from weakref import WeakSet

import numpy as np

from cosim.arrays import Vector
from cosim.native.library import declare, library, pointer

MOST_PARTS: Final = 16


class SavedSamples:
    """A saved state, with its samples or where these are.

    Parameters
    ----------
    state : Vector
        All but the samples; its first number is how many these are.
    samples : Vector, optional
        The parts of the samples, one behind the other.
    memory : SampleMemory, optional
        Where they are as long as there is no copy of them.
    """

    def __init__(
        self, state: Vector, samples: Vector | None = None, memory: SampleMemory | None = None
    ) -> None:
        self.state = state
        self.samples = samples
        self.memory = memory

    @property
    def count(self) -> int:
        """How many samples there are."""
        return int(self.state[0])

    def copied(self) -> Vector:
        """Return the samples, from now on a copy of its own."""
        memory = self.memory
        if memory is not None:
            memory.keep(self)
        assert self.samples is not None
        return self.samples

    def __reduce__(self) -> tuple[Any, ...]:
        return SavedSamples, (self.state, self.copied())


class SampleMemory:
    """The memory of a step.

    Parameters
    ----------
    memory : Vector
    small : int
        How many numbers come before the samples.
    parts : callable
        From a state to the slices of the memory that its samples fill.
    """

    def __init__(
        self, memory: Vector, small: int, parts: Callable[[Vector], Sequence[slice]]
    ) -> None:
        self._memory = memory
        self._small = small
        self._parts = parts
        self._saved: WeakSet[SavedSamples] = WeakSet()  # whose samples are here
        self._lock = threading.Lock()  # a state may be used in another thread

    def save(self) -> SavedSamples:
        """Return the state."""
        saved = SavedSamples(self._memory[: self._small].copy(), memory=self)
        with self._lock:
            self._saved.add(saved)
        return saved

    def restore(self, saved: SavedSamples) -> None:
        """Return to a saved state, of this memory or another."""
        if saved.memory is self:
            self.keep_beyond(saved.count)
            self._memory[: self._small] = saved.state
            return
        samples = saved.copied()
        self.keep_beyond(0)
        self._memory[: self._small] = saved.state
        begin = 0
        for part in self._parts(saved.state):
            end = begin + part.stop - part.start
            self._memory[part] = samples[begin:end]
            begin = end

    def keep_beyond(self, count: int) -> None:
        """Copy the samples of all states with more of them: others may come in their places."""
        for saved in list(self._saved):
            if saved.count > count:
                self.keep(saved)

    def keep(self, saved: SavedSamples) -> None:
        """Copy the samples of a state, unless that was done."""
        with self._lock:
            if saved.memory is None:
                return
            parts = [self._memory[part] for part in self._parts(saved.state)]
            saved.samples = np.concatenate(parts)
            saved.memory = None
            self._saved.discard(saved)


def used_parts(function: str, struct: Structure) -> Callable[[Vector], list[slice]]:
    """Return what finds the parts of a memory that the samples of a state fill.

    Parameters
    ----------
    function : str
        Name of the compiled one: from the struct and a state to pairs of begin and length.
    struct : Structure
    """
    find = getattr(library, function)

    def parts(state: Vector) -> list[slice]:
        pairs = np.zeros((MOST_PARTS, 2), np.int64)
        count = int(find(byref(struct), pointer(state), pointer(pairs)))
        return [slice(begin, begin + length) for begin, length in pairs[:count].tolist()]

    return parts


declare(
    {
        name: (c_int64, (c_void_p, c_void_p, c_void_p))
        for name in ("cosim_identifier_samples", "cosim_augmented_kalman_samples")
    }
)
