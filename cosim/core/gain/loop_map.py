"""The one-step map of a loop: what a step does to small deviations of everything it hands on.

Handed on are the states of all components, and the outputs of the row that the next step reads. The
map is found by the very operations of the loop (:class:`cosim.core.stages.coupling.Loop`), applied
to linearized components and to all unit vectors at once. Where a loop iterates, its torn inputs are
what their sources give for them: what a *sweep* of the operations gives is linear in what it takes
for them, so that they are found by one solution of equations.

The stages of a graph are such parts of a step too, one behind the other: the map of the whole is
found in the same way (:func:`whole_map`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import pairwise
from typing import Final

import numpy as np

from cosim.arrays import Mask, Matrix
from cosim.core.gain.member_step import MemberStep, Phase, member_step, phase_of
from cosim.core.linearization import Linearized
from cosim.core.stages.coupling import OperationName, Stage
from cosim.core.stages.member import Member

LARGEST: Final = 400  # rows of a map, up to which its eigenvalues take little time
SINGULAR: Final = 1e-12  # relative; equations closer to that have no solution to rely on
CHANGING: Final = ("gather together", "advance", "advance together", "refresh")
LONGEST: Final = 4096  # communication steps after which the steps of components repeat


@dataclass(frozen=True, slots=True)
class LoopModel:
    """A loop of linearized components.

    Parameters
    ----------
    members : tuple of Linearized
    wiring : tuple of Matrix, shapes (n_u, n_y of all)
        The inputs of each component, by the outputs of all, one behind the other.
    held : tuple of Mask, shapes (n_u,)
        Which inputs have a zero-order hold.
    operations : tuple of (OperationName, int)
        Of a step, with numbers of components; those that change outputs, or inputs for them.
    h : float
        Communication step [s].
    torn : tuple of (int, int)
        The inputs that are solved for, or kept for a sweep: component and element.
    iterations : int
        Sweeps of a step, where their number is fixed; 0: the torn inputs are solved for.
    records_torn : bool
        Whether the row has what is taken for the torn inputs, and not what their sources give.
    latest : tuple of bool
        Which components take the inputs at the end of a step over the whole step.
    left : tuple of Mask, shapes (n_y of all,)
        Whose left limits each component takes at the end of a step; empty: none.
    """

    members: tuple[Linearized, ...]
    wiring: tuple[Matrix, ...]
    held: tuple[Mask, ...]
    operations: tuple[tuple[OperationName, int], ...]
    h: float
    torn: tuple[tuple[int, int], ...] = ()
    iterations: int = 0
    records_torn: bool = True
    latest: tuple[bool, ...] = ()
    left: tuple[Mask, ...] = ()

    @property
    def outputs(self) -> list[slice]:
        """Where the outputs of each component stand among those of all."""
        return slices([len(member.D) for member in self.members])

    @property
    def period(self) -> int:
        """Communication steps after which the steps of all components repeat."""
        return math.lcm(*(member.period for member in self.members))

    @property
    def size(self) -> int:
        """Number of rows of the map."""
        steps = self.steps(0)
        n_y: int = self.outputs[-1].stop
        return sum(step.n_s for step in steps) + n_y + self.n_kept

    @property
    def n_kept(self) -> int:
        """Number of torn inputs that differ from their sources, so that a step hands them on."""
        return len(self.torn) if self.iterations and self.records_torn else 0

    @property
    def is_too_large(self) -> bool:
        """Whether its map, or its period, is too large to look at before a run."""
        delayed = sum(member.delay * member.D.shape[1] for member in self.members)
        return delayed > LARGEST or self.period > LONGEST or self.size > LARGEST

    def phases(self, number: int) -> tuple[Phase, ...]:
        """Return where each component is in a step of its own, at a communication step."""
        return tuple(phase_of(member, number) for member in self.members)

    def steps(self, number: int) -> list[MemberStep]:
        """Return the steps of the components at a communication step."""
        steps = []
        parts = zip(self.members, self.held, self.phases(number), strict=True)
        for member, held, phase in parts:
            steps.append(member_step(member, self.h, held, phase))
        return steps

    def refined(self, parts: int) -> LoopModel:
        """Return the loop with communication steps that are some times shorter."""
        members = tuple(member.refined(parts) for member in self.members)
        return replace(self, members=members, h=self.h / parts)


def loop_model(
    loop: Stage,
    linearized: Mapping[str, Linearized],
    held: Mapping[str, Mask],
    latest: Mapping[str, Mask],
    *,
    h: float,
    width: int,
) -> LoopModel:
    """Return the model of a loop whose components are all linearized; ``width`` is of a row."""
    names = [member.name for member in loop.members]
    model = LoopModel(
        tuple(replace(linearized[name], latest=latest[name]) for name in names),
        wiring(loop.members, width),
        tuple(held[name] for name in names),
        (),
        h,
        latest=tuple(member.takes_latest for member in loop.members),
    )
    return of_stage(model, loop, names, CHANGING)


def of_stage(
    model: LoopModel, stage: Stage, names: Sequence[str], kinds: Collection[OperationName]
) -> LoopModel:
    """Return a model of these components, by name, with the operations of a stage of them."""
    operations: list[tuple[OperationName, int]] = []
    for kind, members in stage.program:
        if kind in kinds:
            operations += [(kind, names.index(member.name)) for member in members]
    return replace(
        model,
        operations=tuple(operations),
        torn=_torn(stage, names),
        iterations=_iterations(stage),
        records_torn=stage.kept is None,
    )


def _iterations(loop: Stage) -> int:
    if loop.kept is not None:
        return 1
    return 0 if loop.torn is None else loop.torn.solver.iterations


def _torn(loop: Stage, names: Sequence[str]) -> tuple[tuple[int, int], ...]:
    """Return the inputs of a loop that are solved for or kept, as component and element."""
    inputs = loop.torn or loop.kept
    columns = () if inputs is None else inputs.columns
    torn = []
    for member in loop.members:
        number = names.index(member.name)
        first = member.inputs.start
        own = [column for column in columns if first <= column < member.inputs.stop]
        torn += [(number, column - first) for column in own]
    return tuple(torn)


def wiring(members: Sequence[Member], width: int) -> tuple[Matrix, ...]:
    """Return the inputs of each component by the outputs of all: what their wires do to units."""
    columns = np.concatenate([np.arange(m.outputs.start, m.outputs.stop) for m in members])
    rows = np.zeros((len(columns) + 1, width))
    rows[np.arange(len(columns)), columns] = 1.0
    for member in members:
        for wire in member.wires:
            wire.copy(rows, slice(None))
    # The last row is what the wires give for no outputs: their offsets.
    return tuple((rows[:-1, member.inputs] - rows[-1, member.inputs]).T for member in members)


def one_step_maps(model: LoopModel) -> list[Matrix] | None:
    """Return the maps of the steps of one period; None: a step has no one solution."""
    by_phases: dict[tuple[Phase, ...], Matrix] = {}
    maps = []
    for number in range(model.period):
        phases = model.phases(number)
        if phases not in by_phases:
            step_map = _one_step_map(model, model.steps(number))
            if step_map is None:
                return None
            by_phases[phases] = step_map
        maps.append(by_phases[phases])
    return maps


def _one_step_map(model: LoopModel, steps: Sequence[MemberStep]) -> Matrix | None:
    return whole_map([model], steps)


def whole_map(models: Sequence[LoopModel], steps: Sequence[MemberStep]) -> Matrix | None:
    """Return the map of a step of several stages, each a model of the components of all.

    None: a step has no one solution.
    """
    states = slices([step.n_s for step in steps])
    n_states = states[-1].stop
    n_row = models[0].outputs[-1].stop
    kept = slices([n_states + n_row, *(model.n_kept for model in models)])[1:]
    units = np.eye(kept[-1].stop)
    row = units[n_states : n_states + n_row]
    state = [units[part] for part in states]
    end = left = row  # what extrapolated inputs read
    handed_on = []
    for model, part in zip(models, kept, strict=True):
        sweep = _Sweep(model, steps, state, row, units[part], (end, left))
        torn = sweep.repeated() if model.iterations else sweep.solution()
        if torn is None:
            return None
        state, end, left = sweep(torn)
        handed_on.append(torn[: model.n_kept])
    return np.vstack([*state, end, *handed_on])


class _Sweep:
    """The operations of a step, for many starts at once.

    Parameters
    ----------
    model : LoopModel
    steps : sequence of MemberStep
        Of the components, at this communication step.
    state : sequence of Matrix, shapes (n_s, k)
        Of the components at the start.
    row : Matrix, shape (n_y of all, k)
        The outputs at the start.
    kept : Matrix, shape (n_kept, k)
        The torn inputs at the start.
    ends : tuple of Matrix, shapes (n_y of all, k)
        The outputs at the end as far as they are known: right and left limits.
    """

    def __init__(
        self,
        model: LoopModel,
        steps: Sequence[MemberStep],
        state: Sequence[Matrix],
        row: Matrix,
        kept: Matrix,
        ends: tuple[Matrix, Matrix],
    ) -> None:
        self._kept = kept
        self._ends = ends
        self._model = model
        self._steps = steps
        self._state = state
        self._row = row

    def __call__(self, torn: Matrix) -> tuple[list[Matrix], Matrix, Matrix]:
        """Return states, outputs at the end and their left limits, for torn inputs there.

        These have the shape (n_torn, k).
        """
        model = self._model
        outputs = model.outputs
        state = list(self._state)
        end, left = (rows.copy() for rows in self._ends)
        together: dict[int, Matrix] = {}  # inputs that are gathered before anybody advances
        for kind, number in model.operations:
            limits = end
            if model.left and kind != "right":
                limits = np.where(model.left[number][:, np.newaxis], left, end)
            if kind == "gather together":
                together[number] = self._inputs(number, limits, torn)
                continue
            is_gathered = kind == "advance together"
            u1 = together[number] if is_gathered else self._inputs(number, limits, torn)
            if kind not in ("refresh", "right"):
                u0 = u1 if model.latest[number] else self._inputs(number, self._row, self._kept)
                state[number], y = self._steps[number].advance(state[number], u0, u1)
            else:
                before = end[outputs[number]]
                y = self._steps[number].refresh(state[number], u1, before)
            end[outputs[number]] = y
            if kind != "right" and model.members[number].is_continuous:
                left[outputs[number]] = y  # what is discrete has there what it held
        return state, end, left

    def _inputs(self, number: int, end: Matrix, torn: Matrix) -> Matrix:
        u: Matrix = self._model.wiring[number] @ end
        for place, values in enumerate(torn):
            component, element = self._model.torn[place]
            if component == number:
                u[element] = values
        return u

    def repeated(self) -> Matrix:
        """Return what the last of a fixed number of sweeps takes for the torn inputs."""
        torn = self._driven(self._ends[0])
        for _ in range(self._model.iterations - 1):
            torn = self._given(torn)
        return torn

    def solution(self) -> Matrix | None:
        """Return the torn inputs that are what their sources give; None: there is no one."""
        count = len(self._model.torn)
        width = self._row.shape[1]
        given = self._given(np.zeros((count, width)))
        if not count:
            return given
        nothing = [np.zeros((len(state), count)) for state in self._state]
        no_row = np.zeros((len(self._row), count))
        no_kept = np.zeros((len(self._kept), count))
        ends = (no_row, no_row)
        J = _Sweep(self._model, self._steps, nothing, no_row, no_kept, ends)._given(np.eye(count))
        return solved(np.eye(count) - J, given)

    def _given(self, torn: Matrix) -> Matrix:
        """Return what the sources of torn inputs give for them."""
        _, end, _ = self(torn)
        return self._driven(end)

    def _driven(self, end: Matrix) -> Matrix:
        """Return the torn inputs that outputs drive."""
        rows = np.zeros((len(self._model.torn), end.shape[1]))
        for place, (component, element) in enumerate(self._model.torn):
            rows[place] = self._model.wiring[component][element] @ end
        return rows


def solved(M: Matrix, right: Matrix) -> Matrix | None:
    """Return the solution of equations; None: they have none to rely on."""
    values = np.linalg.svd(M, compute_uv=False)
    if not values[-1] > SINGULAR * values[0]:
        return None
    return np.asarray(np.linalg.solve(M, right), np.float64)


def product(maps: Sequence[Matrix]) -> Matrix:
    """Return the map of several steps, the first one first."""
    return reduce(lambda before, after: after @ before, maps)


def slices(sizes: Sequence[int]) -> list[slice]:
    """Return parts of these sizes, one behind the other."""
    ends = np.cumsum([0, *sizes]).tolist()
    return [slice(start, stop) for start, stop in pairwise(ends)]
