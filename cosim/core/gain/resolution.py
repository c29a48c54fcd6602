"""Whether the step resolves the model: what a run makes of it against its exact solution.

Both are found for the whole linear model at once, whose components are linearized where it begins:

* exactly: the components in continuous time are joined directly (:mod:`cosim.core.gain.system`);
* as the master steps: by the map of a step of the whole schedule
  (:mod:`cosim.core.gain.loop_map`), with what each component is given of its inputs: interpolated,
  held, extrapolated in a loop, solved for, the latest, or the mean.

They answer, one by one, a jump of each discrete signal, and what the model does from its beginning
where that is not at rest. The outputs at the communication points are compared over as many steps
as the run has, each relative to the largest value of its own response: more than ``LIMIT`` of it is
refused. So a fast mode that nothing excites, that is not shown, or averaged out, is no error. What
a jump late in the run does until its end may be less, and off by more of it.

Cut are components with a period of their own and delays, which hold, or are as they were; what
comes out of them may jump. Behind a delay, which nothing excites so, it is not decided where a jump
would not be resolved. A loop through them is not followed: there a quarter of the limit is not
decided. What is not linear, or cannot be linearized, is not decided where its inputs are
interpolated and differ from the lines, or where others integrate what it may do within a step. Of
smooth signals from outside nothing is said.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.clock import Clock
from cosim.core.gain.loop_gain import largest_part
from cosim.core.gain.loop_map import CHANGING, LoopModel, of_stage, slices, whole_map, wiring
from cosim.core.gain.system import ConnectedSystem, connect, reached_by
from cosim.core.graph import Graph
from cosim.core.linearization import Linearized
from cosim.core.port import Port
from cosim.core.stages.member import Member
from cosim.errors import listing
from cosim.instants import StepNs, step_value
from cosim.native.numerics.linear import matrix_exponential

LIMIT: Final = 0.01  # of a response
LARGEST: Final = 200  # states up to which their response takes little time
LARGEST_MAP: Final = 800  # rows of the map of a step, up to which the same holds
MARGIN: Final = 4.0  # of what may be multiplied by what is not in the model
ROUNDING: Final = 1e-9
STEPS: Final = 64  # that are followed one by one, then by twos, fours, ...


class Missed(NamedTuple):
    """How far the steps are from the exact response of an output, and to what."""

    error: float  # over the largest value of the response
    signal: str
    cause: str


NONE: Final = Missed(0.0, "", "")


@dataclass(frozen=True, slots=True)
class Resolution:
    """How a run with this step differs from the exact solution of the model.

    Parameters
    ----------
    h : float
        Communication step [s].
    components : tuple of str
        With the fastest mode; empty: there is none that is known.
    rate : float
        The modulus of its eigenvalue [1/s].
    unknown : tuple of str
        Components that leave the error unknown: not linear, not linearized, or too large together.
    missed : Missed
        The largest error of a response.
    step_ns : int or None
        A step at which it is within the limit [ns]; None: it is, or there is none.
    """

    h: float
    components: tuple[str, ...]
    rate: float
    unknown: tuple[str, ...]
    missed: Missed
    step_ns: StepNs | None

    @property
    def is_resolved(self) -> bool:
        """Whether no response is known to have a larger error than the limit."""
        return self.missed.error <= LIMIT

    @property
    def text(self) -> str:
        """What was found, in a sentence."""
        text = "no linear component in continuous time has a mode"
        if self.unknown and not self.components:
            return f"nothing is known of {listing(self.unknown)}"
        if self.components:
            text = (
                f"the fastest mode of {listing(self.components)}, {self.rate:.4g} 1/s, times the "
                f"step of {self.h:g} s is {self.rate * self.h:.3g}"
            )
        if self.missed.error:
            error, signal, cause = self.missed
            text += f"; {signal} is off by up to {error:.2g} of its whole response to {cause}"
        if not self.is_resolved:
            text += f", more than {LIMIT:g}"
        if self.unknown:
            text += f"; not known is what becomes of it in {listing(self.unknown)}"
        return text

    @property
    def cure(self) -> str:
        """What can be done."""
        return "" if self.step_ns is None else f"use step = {step_value(self.step_ns)!r}"


def may_be_unresolved(graph: Graph, among: Collection[str]) -> bool:
    """Return whether one of some components may interpolate what it integrates.

    Where these are not all, what drives it has to be linearizable, too, for the others to begin.
    """
    linearizable = {n for n, m in graph.members.items() if m.channel.interface.linearizable}
    drivers = graph.components.keys() if len(among) == len(graph.components) else linearizable
    for to, connection in graph.connections.items():
        is_driven = any(source.component in drivers for source in connection.sources)
        may_integrate = to.component in among and to.component in linearizable
        moves = not graph.held[to.component].all() or graph.members[to.component].takes_latest
        if graph.input_interpolation in ("zero-order", "latest"):  # hold what is continuous
            moves |= any(graph.variability(source) == "continuous" for source in connection.sources)
        if is_driven and may_integrate and moves:
            return True
    return False


@np.errstate(over="ignore", invalid="ignore")  # of modes that leave all bounds
def resolution(
    graph: Graph, clock: Clock, row: Vector, linearized: Mapping[str, Linearized]
) -> Resolution:
    """Return how a run with this step differs from the exact solution of the model.

    Parameters
    ----------
    graph : Graph
        Prepared.
    clock : Clock
    row : Vector, shape (width,)
        With which the graph begins.
    linearized : mapping of component name to Linearized
        Those that can be linearized.
    """
    h = clock.h
    model = _WholeModel(graph, clock, row, linearized)
    with_states = tuple(name for name, own in model.linear.items() if len(own.A))
    found = None if model.is_too_large else model.compared(1)
    if found is None:
        return Resolution(h, (), 0.0, with_states or tuple(model.linear), NONE, None)
    rate, fastest = model.fastest()

    def is_resolved(parts: int) -> bool:
        shorter = model.compared(parts)
        return shorter is not None and shorter.missed.error <= LIMIT

    step_ns = None
    if found.missed.error > LIMIT:
        step_ns = largest_part(clock.step_ns, is_resolved)
    unknown = tuple(model.unknown(found))
    return Resolution(h, fastest, rate, unknown, found.missed, step_ns)


class _Compared(NamedTuple):
    """The largest error of a response, the outputs that leave the line over a step, and delays.

    These are followed by what does not resolve a jump, which they need not let out.
    """

    missed: Missed
    off_lines: Mask
    delays: frozenset[str]


class _WholeModel:
    """All components of a graph as one linear model; what is cut is constant.

    Attributes
    ----------
    linear : dict of component name to Linearized
        Those in continuous time that take communication steps.
    """

    def __init__(
        self, graph: Graph, clock: Clock, row: Vector, linearized: Mapping[str, Linearized]
    ) -> None:
        self._graph = graph
        self._clock = clock
        self._row = row
        self._members = list(graph.members.values())
        self._names = [member.name for member in self._members]
        divided: set[str] = set()
        for stage in graph.stages:
            if stage.controls or stage.nested is not None:
                divided.update(member.name for member in stage.members)
        self.linear: dict[str, Linearized] = {}
        for name in self._names:
            own = linearized.get(name)
            if own is not None and own.is_continuous and name not in divided:
                self.linear[name] = own
        self._cut = linearized.keys() - self.linear.keys() - divided
        self._delays = {name for name, own in linearized.items() if own.delay}
        # Behind the components stands what lets the states move as they do at the beginning.
        matrices = wiring(self._members, graph.layout.width)
        self._columns = [c for m in self._members for c in range(m.outputs.start, m.outputs.stop)]
        n_y = len(self._columns)
        beginning = np.eye(n_y + 1)[n_y:]
        members: list[Linearized] = []
        held = []
        for member in self._members:
            members.append(self._linearized(member))
            held.append(np.append(graph.held[member.name], True))
        widened = [np.vstack([np.pad(W, ((0, 0), (0, 1))), beginning]) for W in matrices]
        self._model = LoopModel(
            (*members, _constant(1, 0)),
            (*widened, np.zeros((0, n_y + 1))),
            (*held, np.zeros(0, np.bool_)),
            (),
            clock.h,
            latest=(*(member.takes_latest for member in self._members), False),
            left=(*map(self._left, self._members), np.zeros(n_y + 1, np.bool_)),
        )

    def _linearized(self, member: Member) -> Linearized:
        """Return a component with one input more: that of its x' at the beginning."""
        own = self.linear.get(member.name)
        interface = member.channel.interface
        if own is None:
            return _constant(interface.n_y, interface.n_u + 1)
        rate = np.zeros(len(own.A)) if own.rate is None else own.rate
        return replace(
            own,
            B=np.column_stack([own.B, rate]),
            D=np.pad(own.D, ((0, 0), (0, 1))),
            latest=np.append(self._graph.latest[member.name], False),
        )

    def _left(self, member: Member) -> Mask:
        """Return of which outputs a component takes left limits, as a mask."""
        if member.jumps is None:
            return np.zeros(len(self._columns) + 1, np.bool_)
        taken = {*member.jumps.held.tolist(), *member.jumps.followed.tolist()}
        return np.array([column in taken for column in self._columns] + [False])

    @property
    def is_too_large(self) -> bool:
        """Whether its response takes more time than it is worth."""
        states = sum(len(own.A) for own in self.linear.values())
        return states > LARGEST or self._model.size > LARGEST_MAP

    @cached_property
    def _system(self) -> ConnectedSystem | None:
        """The exact model; None: its algebraic loops have no one solution."""
        return connect(self._model)

    def fastest(self) -> tuple[float, tuple[str, ...]]:
        """Return the modulus of the fastest eigenvalue [1/s], and the components of its stage."""
        largest: tuple[float, tuple[str, ...]] = (0.0, ())
        done = 0
        for stage in self._graph.stages:
            names = [m.name for m in stage.members if m.name in self.linear]
            size = sum(len(self.linear[name].A) for name in names)
            own = slice(done, done + size)
            done += size
            if size and self._system is not None:
                rate = float(np.abs(np.linalg.eigvals(self._system.A[own, own])).max())
                with_states = tuple(name for name in names if len(self.linear[name].A))
                largest = max(largest, (rate, with_states), key=lambda one: one[0])
        return largest

    @cached_property
    def _causes(self) -> tuple[list[str], Matrix]:
        """What excites the model, in words, and as outputs of what is cut; a delay by its name."""
        labels = self._graph.labels()
        causes: list[str] = []
        jumping: list[int] = []
        place = 0
        for member in self._members:
            if member.name in self.linear:
                continue
            column = member.outputs.start
            for signal in member.channel.interface.outputs:
                may_jump = bool(self._graph.jumps(Port(member.name, signal.name)))
                for _ in range(signal.size):
                    if may_jump or member.name in self._delays:
                        jump = f"a jump of {labels[column]}"
                        causes.append(jump if may_jump else member.name)
                        jumping.append(place)
                    place += 1
                    column += 1
        units = np.eye(place + 1)
        return [*causes, "the initial state"], units[:, [*jumping, place]]

    def compared(self, parts: int) -> _Compared | None:
        """Return how responses differ where the step is so many times shorter.

        None: what depends on each other at one instant has no one solution.
        """
        stages = []
        model = replace(self._model, h=self._model.h / parts)
        for stage in self._graph.stages:
            stages.append(of_stage(model, stage, [*self._names, ""], (*CHANGING, "right")))
        first = stages[0]  # where x' is brought on, too
        number = len(self._members)
        stages[0] = replace(first, operations=(("advance", number), *first.operations))
        step = whole_map(stages, model.steps(0))
        if step is None or self._system is None:
            return None
        causes, w = self._causes
        base = np.zeros((len(self._columns) + 1, w.shape[1]))
        base[:-1, -1] = self._row[self._columns]  # no part of the response to a jump
        errors, off_lines = _responses(
            model, step, self._system, w, base, self._clock.steps * parts
        )
        behind = np.array([cause in self._delays for cause in causes])
        is_missed = (errors > LIMIT).any(axis=0)
        delays = frozenset(causes[i] for i in np.flatnonzero(is_missed & behind))
        errors[:, behind] = 0.0
        at, column = np.unravel_index(int(errors.argmax()), errors.shape)
        missed = NONE
        if errors[at, column] > ROUNDING:
            label = self._graph.labels()[self._columns[at]]
            missed = Missed(float(errors[at, column]), label, causes[column])
        return _Compared(missed, off_lines, delays)

    def unknown(self, found: _Compared) -> list[str]:
        """Return the components that leave the error unknown."""
        unknown = sorted(found.delays)
        if found.missed.error > LIMIT / MARGIN:  # which a loop through what is cut may multiply
            for stage in self._graph.stages:
                names = [member.name for member in stage.members] if stage.is_loop else []
                unknown += [name for name in names if name in self._cut]
        for number, name in enumerate(self._names):
            own = self.linear.get(name)
            interface = self._members[number].channel.interface
            ports = [Port(name, signal.name) for signal in interface.outputs]
            is_open = any(self._graph.variability(port) == "continuous" for port in ports)
            is_known = own is not None and not own.is_local
            if name in unknown or is_known or not (interface.n_u and is_open):
                continue
            has_no_states = own is not None or name in self._delays
            may_integrate = not (has_no_states or interface.continuous)  # own ones take samples
            is_off_line = bool(self._moving(name)[:, found.off_lines].any())
            if (is_off_line and may_integrate) or (
                (is_off_line or not has_no_states) and self._drives(name)
            ):
                unknown.append(name)
        return unknown

    def _moving(self, name: str) -> Mask:
        """Return which outputs drive the inputs of a component that do not hold, as a mask."""
        moving = np.append(~self._graph.held[name], False)
        return np.asarray(self._model.wiring[self._names.index(name)][moving] != 0.0)

    def _drives(self, name: str) -> bool:
        """Return whether a component that may integrate interpolates what comes out of this one."""
        reached = [name]
        for source in reached:  # grows on the way
            outputs = self._model.outputs[self._names.index(source)]
            for to, member in zip(self._names, self._members, strict=True):
                if to in reached or not self._moving(to)[:, outputs].any():
                    continue
                own = self.linear.get(to)
                if own is not None and not own.B.any():
                    reached.append(to)
                elif own is not None or not member.channel.interface.continuous:
                    return True
        return False


def _constant(n_y: int, n_u: int) -> Linearized:
    """Return outputs that stay what they are."""
    nothing = np.zeros((n_y, n_u))
    return Linearized(np.eye(n_y), nothing, np.eye(n_y), nothing, is_discrete=True, own_steps=1)


def _responses(
    model: LoopModel, step: Matrix, system: ConnectedSystem, w: Matrix, base: Matrix, steps: int
) -> tuple[Matrix, Mask]:
    """Compare the responses of a model, at rest up to its first communication point, to w there.

    Parameters
    ----------
    model : LoopModel
        Of all components.
    step : Matrix, shape (N, N)
        What the master does: to all states, then to all outputs.
    system : ConnectedSystem
        What it is exactly.
    w : Matrix, shape (n_w, k)
        At the end of its rows what moves the states from the start of the step before.
    base : Matrix, shape (n_y, k)
        What is to be added to a response.
    steps : int
        Their number.

    Returns
    -------
    Matrix, shape (n_y, k)
        The errors of the outputs in continuous time, relative to their largest values.
    Mask, shape (n_y,)
        Which outputs leave the line between two communication points.
    """
    n, n_w = system.B.shape
    order: tuple[list[int], list[int]] = ([], [])
    states = slices([len(member.A) for member in model.members])
    for member, part in zip(model.members, states, strict=True):
        order[not member.is_continuous].extend(range(part.start, part.stop))
    own, others = order
    rows = slice(states[-1].stop, states[-1].stop + len(base))
    by_x = np.hstack([system.C, system.D])
    rates = np.pad(np.hstack([system.A, system.B]), ((0, n_w), (0, 0)))
    reached = reached_by(rates)  # the rest is rounding, and no response
    M, half = (matrix_exponential(rates * h) * reached for h in (model.h, 0.5 * model.h))
    middle = by_x @ (half - 0.5 * (np.eye(n + n_w) + M))
    z = np.zeros((len(step), w.shape[1]))
    z[others] = w  # it is in the row only at the end of the step
    z[rows.stop - 1, -1] = 1.0  # but what moves the states from its start
    z = step @ z
    x = np.vstack([np.zeros((n, w.shape[1])), w])
    x[:n, -1] = M[:n, -1]
    # An output that is not up to date where something jumps is so at any step.
    error = np.abs(system.C @ (z[own] - x[:n]))
    y = np.fmax(np.abs(base), np.abs(by_x @ x + base))
    terms = y.copy()  # where y is much less than its terms, it is rounding
    bend = np.abs(middle @ x)
    done = 0
    length = 1
    exact = M
    while done < steps:
        z = step @ z
        x = exact @ x
        if not (np.isfinite(z).all() and np.isfinite(x).all()):
            break
        response = by_x @ x
        error = np.fmax(error, np.abs(z[rows] - response))
        bend = np.fmax(bend, np.abs(middle @ x))
        y = np.fmax(y, np.abs(response + base))
        terms = np.fmax(terms, np.abs(by_x) @ np.abs(x))
        done += length
        if done >= STEPS * (2 * length - 1):
            length *= 2
            step = step @ step
            exact = exact @ exact
    is_own = np.concatenate([np.full(len(m.D), m.is_continuous) for m in model.members])
    is_known = is_own[:, np.newaxis] & (y > ROUNDING * terms) & np.isfinite(y)
    relative: Matrix = np.divide(error, y, out=np.zeros(y.shape), where=is_known)
    off_lines = np.asarray((bend > LIMIT / MARGIN * y + ROUNDING * terms).any(axis=1))
    return relative, off_lines
