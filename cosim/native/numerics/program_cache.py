"""What expressions in t were in a run, for the next run that asks for them at the same instants.

Runs of one graph that differ in a few components have their communication points in common. An
expression in t alone that is the same in all of them is computed in the first one: ``expression.c``
reads its values then, where the bits of t are the same, and computes it where they are not.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from typing import Final, final

import numpy as np

from cosim.native.library import pointer
from cosim.native.numerics.expression import OPERATIONS
from cosim.native.numerics.programs import ProgramCacheStruct, ProgramStruct
from cosim.native.step import DOUBLE, NativeStep

MOST_BYTES: Final = 2**25  # of the caches of a graph
_NOT_CACHED: Final = b""  # the content of what is no expression in t alone, or not always the same
_BYTES: Final = 2 * DOUBLE  # of an instant and its value
_FIRST_ROOM: Final = 2**14  # values
_GROWTH: Final = 4


@final
class ProgramCaches:
    """The values of the expressions in t of a graph's compiled steps.

    Parameters
    ----------
    most_bytes : int
        Of the values and their instants; those beyond are computed in every run.
    """

    def __init__(self, most_bytes: int = MOST_BYTES) -> None:
        self._rest = most_bytes
        self._contents: dict[tuple[str, int], bytes] = {}
        self._caches: dict[tuple[str, int], ProgramCacheStruct] = {}

    def connect(self, component: str, step: NativeStep) -> None:
        """Let a component's expressions read their caches from the start on: before every run.

        An expression that is not what it was in the run before has no cache from then on.
        """
        for number, program in enumerate(_programs(step)):
            place = (component, number)
            content = _content(program)
            if self._contents.setdefault(place, content) != content:
                self._contents[place] = _NOT_CACHED
            if self._contents[place] == _NOT_CACHED:
                self._caches.pop(place, None)
                program.cache = None
                continue
            cache = self._caches.get(place) or self._cache(_FIRST_ROOM)
            if cache.count == cache.room:
                cache = self._larger(cache)
            cache.next = 0
            self._caches[place] = cache
            program.cache = ctypes.pointer(cache)  # which keeps it alive

    def _larger(self, cache: ProgramCacheStruct) -> ProgramCacheStruct:
        """Return a cache with more room, and the values of one; the same where there is no room."""
        larger = self._cache(_GROWTH * cache.room)
        if not larger.room:
            return cache
        for name in ("t", "values"):
            ctypes.memmove(getattr(larger, name), getattr(cache, name), cache.count * DOUBLE)
        larger.count = cache.count
        self._rest += cache.room * _BYTES
        return larger

    def _cache(self, room: int) -> ProgramCacheStruct:
        """Return an empty cache; without room where that were too many bytes."""
        if room * _BYTES > self._rest:
            return ProgramCacheStruct()
        self._rest -= room * _BYTES
        cache = ProgramCacheStruct(room)
        cache.arrays = (np.empty(room), np.empty(room))
        cache.t, cache.values = map(pointer, cache.arrays)
        return cache


def _programs(step: NativeStep) -> Iterator[ProgramStruct]:
    """Yield the expressions in t alone of a compiled step, and of those inside it."""
    for kept in step.keep:
        if isinstance(kept, NativeStep):
            yield from _programs(kept)
        elif isinstance(kept, ctypes.Array) and kept._type_ is ProgramStruct:
            yield from kept


def _content(program: ProgramStruct) -> bytes:
    """Return the code and the constants of a program; empty: there are none, or it reads a row."""
    code = np.frombuffer(ctypes.string_at(program.code or 0, 4 * program.length), np.int32)
    if not code.size or code.min() < 0:
        return b""
    constants = max(0, int(code.max()) + 1 - len(OPERATIONS))
    return code.tobytes() + ctypes.string_at(program.constants, constants * DOUBLE)
