"""What expressions in t were in a run, for the next run that asks for them at the same instants.

Runs of one graph that differ in a few components have their communication points in common. An
expression in t alone that is the same in all of them is computed in the first one: ``expression.c``
reads its values then, where the bits of t are the same, and computes it where they are not.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from typing import Final, TypeAlias, final

import numpy as np

from cosim.native.library import pointer
from cosim.native.numerics.expression import FUNCTIONS, OPERATIONS
from cosim.native.numerics.programs import ProgramCacheStruct, ProgramStruct
from cosim.native.step import DOUBLE, NativeStep

_ProgramPlace: TypeAlias = tuple[str, int]  # a component, and the number of an expression in it

MOST_BYTES: Final = 2**24  # of the caches of a graph
# content of what reads a row, is computed as fast as it is read, or is not always the same
_NOT_CACHED: Final = b""
_CHEAP: Final = frozenset({"sqrt", "abs", "sign", "step"})
_COSTLY: Final = frozenset(map(OPERATIONS.index, {"power", *FUNCTIONS} - _CHEAP))
_BYTES: Final = 2 * DOUBLE  # of an instant and its value
_FIRST_ROOM: Final = 2**12  # values
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
        self._free_bytes = most_bytes
        self._contents: dict[_ProgramPlace, bytes] = {}
        self._caches: dict[_ProgramPlace, ProgramCacheStruct] = {}

    def connect(self, component: str, step: NativeStep) -> None:
        """Let a component's expressions read their caches from the start on: before every run.

        An expression that is not what it was in the run before has no cache from then on.
        """
        for number, program in enumerate(_programs(step)):
            place = (component, number)
            if self._is_cached(place, _content(program)):
                cache = self._cache_of(place)
                cache.next = 0
                cache.misses = 0
                program.cache = ctypes.pointer(cache)  # which keeps it alive
            else:
                program.cache = None

    def _is_cached(self, place: _ProgramPlace, content: bytes) -> bool:
        """Return whether what is in a place has always been there."""
        if self._contents.setdefault(place, content) != content:
            self._contents[place] = _NOT_CACHED
            dropped = self._caches.pop(place, ProgramCacheStruct())
            self._free_bytes += dropped.room * _BYTES
        return self._contents[place] != _NOT_CACHED

    def _cache_of(self, place: _ProgramPlace) -> ProgramCacheStruct:
        """Return the cache of a place; with more room where the last run filled it."""
        cache = self._caches.get(place)
        if cache is None:
            cache = self._cache(_FIRST_ROOM)
        elif cache.count == cache.room:
            cache = self._larger(cache)
        self._caches[place] = cache
        return cache

    def _larger(self, cache: ProgramCacheStruct) -> ProgramCacheStruct:
        """Return a cache with more room, and the values of one; the same where there is no room."""
        larger = self._cache(max(_FIRST_ROOM, _GROWTH * cache.room))
        if not larger.room:
            return cache
        for name in ("t", "values"):
            ctypes.memmove(getattr(larger, name), getattr(cache, name), cache.count * DOUBLE)
        larger.count = cache.count
        self._free_bytes += cache.room * _BYTES
        return larger

    def _cache(self, room: int) -> ProgramCacheStruct:
        """Return an empty cache; without room where that were too many bytes."""
        if room * _BYTES > self._free_bytes:
            return ProgramCacheStruct()
        self._free_bytes -= room * _BYTES
        cache = ProgramCacheStruct(room)
        cache.arrays = (np.empty(room), np.empty(room))
        cache.t, cache.values = map(pointer, cache.arrays)
        return cache


def _programs(step: NativeStep) -> Iterator[ProgramStruct]:
    """Yield the programs of a compiled step, and of those inside it."""
    for kept in step.keep:
        if isinstance(kept, NativeStep):
            yield from _programs(kept)
        elif isinstance(kept, ctypes.Array) and kept._type_ is ProgramStruct:
            yield from kept


def _content(program: ProgramStruct) -> bytes:
    """Return the code and the constants of a program that is worth a cache, else nothing."""
    text = ctypes.string_at(program.code or 0, 4 * program.length)
    code = set(np.frombuffer(text, np.int32).tolist())
    if _COSTLY.isdisjoint(code) or min(code) < 0:
        return _NOT_CACHED
    constants = max(0, max(code) + 1 - len(OPERATIONS))
    return text + ctypes.string_at(program.constants, constants * DOUBLE)
