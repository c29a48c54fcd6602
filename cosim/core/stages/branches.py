"""Branches of a graph that do not depend on each other, in two threads.

Compiled code runs without the lock of the interpreter, so that two branches advance at the same
time on two processors. They share no column that one of them writes, so the bits are those of one
thread; what components do in Python they do one at a time. Whether two threads are faster depends
on the machine and on what else runs there: both ways are timed, and the faster one is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from threading import Lock
from time import perf_counter
from typing import Any, Final, TypeAlias

import numpy as np

from cosim.arrays import Matrix
from cosim.core.contracts import Block
from cosim.core.stages.coupling import Advancing, Cut, Stage
from cosim.core.stages.member import driving_groups

LONG_ENOUGH: Final = 3e-4  # s of wall time of a call from which on handing over is little of it
TRIALS: Final = 6  # calls of each way that are timed
GAIN: Final = 0.9  # of the time of one thread: what two must stay below

Exclusion: TypeAlias = AbstractContextManager[Any]  # of what may run in one thread only
Compile: TypeAlias = Callable[[Sequence[Stage], Exclusion], Advancing]


def with_branches(
    stages: Sequence[Stage],
    may_leave: Callable[[Stage], bool],
    binaries: Callable[[Stage], frozenset[str]],
    compiled: Compile,
) -> Advancing:
    """Compile stages that follow each other: as one, or with two branches side by side.

    What nothing drives goes before the branches, and what drives nothing behind them, where that
    separates the rest.

    Parameters
    ----------
    stages : sequence of Stage
    may_leave : callable
        Whether a stage may run in another thread.
    binaries : callable
        What the foreign code of a stage is known by: stages with the same stay in one thread.
    compiled : callable
        Compiles stages as one, and what is entered where it calls Python.
    """
    drivers = driving_groups([stage.members for stage in stages])
    for number, driving in enumerate(drivers):
        driving.discard(number)
    everything = set(range(len(stages)))
    driven: set[int] = set().union(*drivers)
    sources = {i for i in everything if not drivers[i]}
    sinks = everything - driven - sources
    nothing: set[int] = set()
    leaves = [may_leave(stage) for stage in stages]
    together = _with_same([binaries(stage) for stage in stages])
    for before, behind in (
        (nothing, nothing),
        (sources, nothing),
        (nothing, sinks),
        (sources, sinks),
    ):
        middle = sorted(everything - before - behind)
        first, second = _divided(middle, [*map(set.union, drivers, together)], leaves)
        if second:
            parts = [sorted(before), first, second, sorted(behind)]
            return Branches(stages, [[stages[i] for i in part] for part in parts], compiled)
    return compiled(stages, nullcontext())


class _Part:
    """Some of the stages, compiled as one, and how far they came in a block."""

    def __init__(self, stages: Sequence[Stage], compiled: Compile, calls: Exclusion) -> None:
        self.names: set[str] = set()
        for stage in stages:
            self.names |= {member.name for member in stage.members}
        self.reached = 0
        self._compiled = compiled(stages, calls)

    def advance(self, block: Block, signals: Matrix, end: int) -> Cut | None:
        """Advance to row ``end``; return where they came to an end before it."""
        self.reached = end
        if not (self.names and end):
            return None
        try:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # of this thread
                self._compiled.advance(block.part(0, end), signals[: end + 1])
        except Cut as cut:
            self.reached = cut.steps
            return cut
        return None


class Branches:
    """Advances two branches, side by side where that is faster.

    Parameters
    ----------
    stages : sequence of Stage
        All of them, in their order.
    parts : sequence of four sequences of Stage
        What goes before the branches, the branches, and what goes behind them. The branches share
        no column that one of them writes.
    compiled : callable
        As in :func:`with_branches`.
    """

    def __init__(
        self, stages: Sequence[Stage], parts: Sequence[Sequence[Stage]], compiled: Compile
    ) -> None:
        self._stages = stages
        lock = Lock()
        self._parts = [_Part(part, compiled, lock) for part in parts]
        self._times: dict[bool, list[float]] = {False: [], True: []}  # of a step, by threads
        self._threads: ThreadPoolExecutor | None = None

    def advance(self, block: Block, signals: Matrix) -> None:
        """Fill rows 1 to K of their columns; see :class:`cosim.core.stages.coupling.Advancing`."""
        before, first, second, behind = self._parts
        cuts = [before.advance(block, signals, block.steps)]
        cuts += self._advance_branches(block, signals, before.reached)
        cuts.append(behind.advance(block, signals, min(first.reached, second.reached)))
        first_cuts = [cut for cut in cuts if cut is not None]
        if first_cuts:
            raise self._first_of(min(first_cuts, key=lambda cut: cut.steps), block, signals)

    def _advance_branches(self, block: Block, signals: Matrix, end: int) -> list[Cut | None]:
        in_two = self._chooses_two()
        way = self._side_by_side if in_two else self._in_turn
        began = perf_counter()
        cuts = way(block, signals, end)
        elapsed = perf_counter() - began
        if end and elapsed > LONG_ENOUGH:
            self._times[in_two].append(elapsed / end)
        return cuts

    def _chooses_two(self) -> bool:
        """Return whether to take two threads: after some calls of each way, where it is faster."""
        one = self._times[False]
        two = self._times[True]
        if len(one) < TRIALS:
            return False
        if len(two) < TRIALS:
            return True
        return min(two[:TRIALS]) < GAIN * min(one[:TRIALS])

    def _in_turn(self, block: Block, signals: Matrix, end: int) -> list[Cut | None]:
        _, first, second, _ = self._parts
        cut = first.advance(block, signals, end)
        return [cut, second.advance(block, signals, first.reached)]

    def _side_by_side(self, block: Block, signals: Matrix, end: int) -> list[Cut | None]:
        _, first, second, _ = self._parts
        if self._threads is None:
            self._threads = ThreadPoolExecutor(1, "cosim")
        other = self._threads.submit(second.advance, block, signals, end)
        try:
            cut = first.advance(block, signals, end)
        finally:
            other_cut = other.result()  # also where Ctrl-C came: nothing advances behind an error
        return [cut, other_cut]

    def _first_of(self, cut: Cut, block: Block, signals: Matrix) -> Cut:
        """Return the end that comes first in the order of the stages, of those at one step.

        Stages of other parts were not asked for the step that was not completed; those that come
        before the stage that ended are asked now.
        """
        k = cut.steps
        asked: set[str] = set()
        for part in self._parts:
            if part.reached == k and cut.component not in part.names:
                asked |= part.names
        for stage in self._stages:
            first = stage.members[0].name
            if k == block.steps or any(cut.component == member.name for member in stage.members):
                break
            if first not in asked:
                continue
            try:
                stage.advance(block.part(k, k + 1), signals[k : k + 2])
            except Cut as earlier:
                if not earlier.steps:
                    return Cut(k, earlier.error, first)
        return cut


def _with_same(binaries: Sequence[frozenset[str]]) -> list[set[int]]:
    """Return for each stage the number of one before it with the same foreign code."""
    latest: dict[str, int] = {}
    earlier: list[set[int]] = []
    for number, own in enumerate(binaries):
        earlier.append({latest[binary] for binary in own if binary in latest})
        latest.update(dict.fromkeys(own, number))
    return earlier


def _divided(
    middle: Sequence[int], neighbors: Sequence[set[int]], may_leave: Sequence[bool]
) -> tuple[list[int], list[int]]:
    """Return stages of two branches of about one size; the second one may run in another thread.

    It is empty where the stages hang together, or none may leave.
    """
    groups = _connected(middle, neighbors)
    groups.sort(key=len, reverse=True)
    first: list[int] = []
    second: list[int] = []
    for group in groups:
        leaves = all(may_leave[stage] for stage in group)
        branch = second if leaves and len(second) <= len(first) else first
        branch.extend(group)
    return sorted(first), sorted(second) if first else []


def _connected(nodes: Sequence[int], edges: Sequence[set[int]]) -> list[list[int]]:
    """Return the nodes that hang together, whatever the direction of the edges."""
    neighbors: dict[int, set[int]] = {node: set() for node in nodes}
    for node in nodes:
        for other in edges[node] & neighbors.keys():
            neighbors[node].add(other)
            neighbors[other].add(node)
    groups: list[list[int]] = []
    seen: set[int] = set()
    for node in nodes:
        group: list[int] = []
        waiting = [node]
        while waiting:
            current = waiting.pop()
            if current in seen:
                continue
            seen.add(current)
            group.append(current)
            waiting += neighbors[current]
        if group:
            groups.append(group)
    return groups
