"""Stages in compiled code: the components of several stages advance in one call.

A native stage has the programs of ordinary stages (:mod:`cosim.core.stages.coupling`), one after
the other: ``stage.c`` works through them step by step, with the same bits. An operation whose
component has no compiled step, or whose compiled step declines, is done here by the methods of the
component; so is every error, which is named here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from ctypes import addressof, c_double
from typing import Any

import numpy as np

from cosim.arrays import Matrix, Vector, read_only
from cosim.core.contracts import Block, Stopped
from cosim.core.graph import Graph
from cosim.core.signals import Layout
from cosim.core.stages.branches import Exclusion, with_branches
from cosim.core.stages.coupling import (
    Advancing,
    Cut,
    OperationName,
    Stage,
    call,
    keep_limits,
)
from cosim.core.stages.member import Member, NonFinite, first_non_finite
from cosim.core.stages.nested_loop import NestedLoop
from cosim.core.stages.runaway import LoopWatch
from cosim.core.stages.stage_structs import NativeSteps, StageStructs
from cosim.core.stages.substeps import SubsteppedLoop
from cosim.errors import NonFiniteError
from cosim.native.library import library
from cosim.native.stages.loop_solver import SOLVED
from cosim.native.stages.stage import DONE, HERE, OVER
from cosim.native.step import NativeStep


def advancing_stages(graph: Graph) -> Sequence[Advancing]:
    """Return the stages of an initialized graph in their order, and what watches its loops."""
    watched = [
        stage.members
        for stage in graph.stages
        if stage.is_loop and not graph.watched.isdisjoint(member.name for member in stage.members)
    ]
    stages = _advancing_stages(graph)
    return [*stages, LoopWatch(watched)] if watched else stages


def _advancing_stages(graph: Graph) -> Sequence[Advancing]:
    """Return the stages as they are to advance.

    Those that follow each other advance in compiled code as one. A loop advances in compiled code
    whatever its components are. A component outside every loop that has no compiled step stays as
    it is: it advances a whole block in one call.
    """
    if not graph.native:
        return tuple(_in_substeps(stage, graph) for stage in graph.stages)
    advancing: list[Advancing] = []
    together: list[Stage] = []
    steps: dict[str, NativeStep] = {}
    for stage in graph.stages:
        steps_of_stage = _native_steps(stage.members, graph)
        if stage.controls:
            advancing += _compiled(together, steps, graph)
            together = []
            advancing.append(_in_substeps(stage, graph))
            continue
        if steps_of_stage or stage.is_loop:
            together.append(stage)
            steps.update(steps_of_stage)
            continue
        advancing += _compiled(together, steps, graph)
        together = []
        advancing.append(stage)
    return advancing + _compiled(together, steps, graph)


def _in_substeps(stage: Stage, graph: Graph) -> Advancing:
    """Return what advances a stage by itself, in substeps where it takes any."""
    if stage.nested is not None:
        inner = [_in_substeps(nested, graph) for nested in stage.nested.stages]
        return NestedLoop(stage.members, stage.order, stage.nested, inner)
    advancing: Advancing = stage
    if graph.native:
        steps = _native_steps(stage.members, graph)
        advancing = NativeStage([stage], steps, graph.layout, nullcontext())
    for control in stage.controls:
        advancing = SubsteppedLoop(stage, control, advancing)
    return advancing


def _compiled(stages: Sequence[Stage], steps: NativeSteps, graph: Graph) -> list[Advancing]:
    """Compile stages that follow each other; independent branches of them for two threads."""

    def compiled(part: Sequence[Stage], calls: Exclusion) -> NativeStage:
        return NativeStage(part, steps, graph.layout, calls)

    def may_leave(stage: Stage) -> bool:
        own = [steps.get(member.name) for member in stage.members]
        foreign_may = graph.threads is not None
        return all(step is not None and (foreign_may or not step.guard) for step in own)

    def binaries(stage: Stage) -> frozenset[str]:
        guards = [steps[m.name].guard for m in stage.members if m.name in steps]
        return frozenset[str]().union(*(guard.binaries for guard in guards if guard is not None))

    if not stages:
        return []
    if graph.threads == 1:
        return [compiled(stages, nullcontext())]
    return [with_branches(stages, may_leave, binaries, compiled)]


def _native_steps(members: Iterable[Member], graph: Graph) -> dict[str, NativeStep]:
    steps = {}
    for member in members:
        step = member.component.native()
        # what has jumps of its own needs a step that returns them, where they are followed
        is_silent = step is not None and step.left_outputs is None and member.returns_left_limits
        if step is not None and not is_silent:
            steps[member.name] = step
    return steps


class NativeStage:
    """Advances the components of some stages in compiled code.

    Parameters
    ----------
    stages : sequence of Stage
    steps : mapping of component name to NativeStep
        The compiled steps that there are.
    layout : Layout
    calls : context manager
        Is entered where methods of components are called.
    """

    def __init__(
        self,
        stages: Sequence[Stage],
        steps: NativeSteps,
        layout: Layout,
        calls: Exclusion,
    ) -> None:
        self._calls = calls
        self._members: list[Member] = []
        self._operations: list[tuple[OperationName, Member]] = []  # on one member or from it on
        self._stage_of: dict[str, Stage] = {}
        programs = [stage.program for stage in stages]
        for stage, program in zip(stages, programs, strict=True):
            self._members += stage.members
            self._operations += [(kind, members[0]) for kind, members in program]
            self._stage_of.update((member.name, stage) for member in stage.members)
        self._structs = StageStructs(stages, programs, steps, layout)
        self._state = self._structs.stage
        self._address = addressof(self._state)
        own_steps = [steps[member.name] for member in self._members if member.name in steps]
        guards = [step.guard for step in own_steps if step.guard is not None]
        self._guard = guards[0].joined(guards[1:]) if guards else None
        self._saved: dict[str, Any] = {}  # states by component, where compiled code has none
        self._stopped = Stopped(np.empty((0, 0)), "")  # the last component that did, in a loop
        self._measured = [m.component for m in self._members if m.component.is_measured]

    def advance(self, block: Block, signals: Matrix) -> None:
        """Fill rows 1 to K of its columns; see :class:`cosim.core.stages.coupling.Advancing`."""
        addresses = (block.time.ctypes.data, signals.ctypes.data)
        self.advance_at(addresses, signals, block.h, lambda: block)

    def advance_at(
        self,
        addresses: tuple[int, int],
        signals: Matrix,
        h: float,
        block_of: Callable[[], Block],
    ) -> None:
        """Do the same where the addresses of the times and the rows are known.

        The block is made only if something is left to be done here.
        """
        state = self._state
        state.t, state.rows = addresses
        state.h = h
        state.completed = 0
        state.segment = 0
        state.step = 0
        state.operation = 0
        if self._guard is not None:
            self._guard.begin()
        try:
            left = library.cosim_stage_run(self._address, len(signals) - 1, HERE)
            if left:
                self._go_on(left, block_of(), signals)
        finally:
            if self._guard is not None:
                self._guard.end(c_double.from_address(addresses[0]).value)
            state.step = 0
            state.completed = 0
            for component in self._measured:
                component.add_native_seconds()

    @property
    def steps_under_way(self) -> int:
        """Steps that the call under way has completed; another thread may ask. Outside one: 0."""
        state = self._state
        while True:
            completed, segment = state.completed, state.segment
            step = state.step
            if (completed, segment) == (state.completed, state.segment):  # of one instant
                return int(step if segment == state.n_segments - 1 else completed)

    # What is not finite is named by the check; numpy's warnings would say it without a name.
    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def _go_on(self, left: int, block: Block, signals: Matrix) -> None:
        """Do what compiled code leaves to be done, and go on in it."""
        known = read_only(signals)
        end = block.steps
        first: Cut | None = None
        while left:
            k = self._state.step
            kind, member = self._operations[left - 1]
            rows = slice(k, k + 2)
            try:
                if kind == "check":
                    raise self._non_finite(signals[k + 1], member).error(float(block.time[k + 1]))
                if kind == "solve":
                    raise self._unsolved(member, float(block.time[k + 1]))
                with self._calls:
                    if kind == "save":
                        self._saved[member.name] = member.component.save()
                    elif kind == "restore":
                        self._restore(member, float(block.time[k + 1]))
                    else:
                        signals[k + 1, member.outputs] = self._call(
                            kind, member, block.time[rows], block.h, member.inputs_over(known[rows])
                        )
                        failure = keep_limits(kind, member, block.time[rows], signals[rows])
                        if failure is not None:
                            raise failure
                left = library.cosim_stage_run(self._address, end, DONE)
            except (NonFiniteError, Stopped) as error:
                cut = self._cut(error, k, member, block=block, signals=signals)
                if first is None or cut.steps < first.steps:
                    first = cut
                end = cut.steps  # the others come as far
                left = library.cosim_stage_run(self._address, end, DONE if end > k else OVER)
        if first is not None:
            raise first

    def _call(
        self, kind: OperationName, member: Member, time: Vector, h: float, u: Matrix
    ) -> Vector:
        """Advance or refresh a component; a stop in a sweep waits until the loop is solved.

        Raises
        ------
        Stopped
            As from :func:`call`.
        """
        try:
            return call(kind, member, time, h, u)
        except Stopped as stop:
            unknowns = self._structs.unknowns.get(self._stage_of[member.name].members[0].name)
            if unknowns is None or not stop.steps:
                raise
            unknowns.stopped = 1
            self._stopped = stop
            y: Vector = stop.outputs[0]
            return y

    def _restore(self, member: Member, t: float) -> None:
        """Go back to what was saved here; or raise why compiled code could not."""
        if member.name in self._saved:
            member.component.restore(self._saved[member.name])
            return
        raise Stopped(np.empty((0, 0)), "its state could not be put back").at(member.name, t)

    def _is_iterated(self, member: Member) -> bool:
        return self._stage_of[member.name].torn is not None

    def _unsolved(self, member: Member, t: float) -> Stopped:
        """Return what ends a loop at ``t`` [s]: it is not solved, or a component has stopped."""
        stage = self._stage_of[member.name]
        status = self._structs.unknowns[stage.members[0].name].status
        if status == SOLVED:
            return self._stopped
        assert stage.torn is not None
        return stage.torn.stop(status, t)

    def _cut(
        self,
        error: NonFiniteError | Stopped,
        k: int,
        member: Member,
        *,
        block: Block,
        signals: Matrix,
    ) -> Cut:
        """Return where an error of step ``k`` ends the run; keep the row that a stop may bring."""
        if isinstance(error, NonFiniteError):
            return Cut(k, error, member.name)
        if error.steps:
            if not self._is_iterated(member):  # there the row is that of the solution
                signals[k + 1, member.outputs] = error.outputs[0]
                rows = slice(k, k + 2)
                failure = keep_limits("advance", member, block.time[rows], signals[rows])
                if failure is not None:
                    return Cut(k, failure, member.name)
            return Cut(k + 1, error, member.name)
        origin = self._origin(signals[k + 1])
        if origin is None:
            return Cut(k, error, member.name)
        return Cut(k, origin.error(float(block.time[k + 1])), member.name)

    def _non_finite(self, row: Vector, member: Member) -> NonFinite:
        """Return the value that a check found: where it arose, if that is known."""
        stage = self._stage_of[member.name]
        bad = self._origin(row) if stage.is_loop else None
        if bad is None:
            bad = first_non_finite(stage.members, row[np.newaxis])
        assert bad is not None
        return bad

    def _origin(self, row: Vector) -> NonFinite | None:
        """Return the first output of a step that was not finite, if it is not finite still."""
        column = self._state.origin
        if column < 0 or math.isfinite(row[column]):
            return None
        for member in self._members:
            own_column = int(column) - member.columns.start
            if 0 <= own_column < member.columns.stop - member.columns.start:
                return NonFinite(
                    member.label(own_column), self._state.origin_value, column, note=member.note
                )
        raise AssertionError(column)
