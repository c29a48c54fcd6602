"""Whether the step resolves the model: what linear interpolation over a step does to its modes.

Each component is exact for inputs that are linear over a step, or held. Where an output of a
component with fast modes drives another one that integrates it, the line between two communication
points misses what the modes do there: of exp(-a t) up to (a h)^2/8, and (a h)^2/12 of its integral.
What becomes of that is computed wherever inputs are interpolated and integrated, from the exact
response of the components as one linear system

* to a jump of each discrete signal, which itself reaches the model without an error,
* to the initial state, where the model does not begin at rest.

What the lines miss of these inputs drives the errors of the states, from component to component,
and around loops. They are compared with the largest value of the same response, output by output:
more than ``LIMIT`` of it is refused. So a fast mode that nothing excites, that no such input shows,
or that what follows averages out, is no error.

Not in it: what is lost where a loop extrapolates inputs, which hold, and of smooth signals from
outside.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.clock import Clock
from cosim.core.gain.loop_gain import largest_part
from cosim.core.gain.loop_map import LoopModel, slices, wiring
from cosim.core.gain.system import ConnectedSystem, connect
from cosim.core.graph import Graph
from cosim.core.linearization import Linearized, static
from cosim.core.port import Port
from cosim.core.stages.member import Member
from cosim.errors import listing
from cosim.instants import NANOSECONDS
from cosim.native.numerics.linear import first_order_hold, matrix_exponential

LIMIT: Final = 0.01  # of a response
LARGEST: Final = 200  # states up to which their response takes little time
SLOW: Final = 0.1  # a mode times the step: the line misses an eighth of a percent
POINTS: Final = 8  # within a step
ROUNDING: Final = 1e-9
STEPS: Final = 64  # that are followed one by one, then by twos, fours, ...


class Missed(NamedTuple):
    """What linear interpolation misses of the response of an input, and to what."""

    error: float  # over the largest value of the response
    signal: str
    cause: str


NONE: Final = Missed(0.0, "", "")


@dataclass(frozen=True, slots=True)
class Resolution:
    """What linear interpolation over a step does to a model.

    Parameters
    ----------
    h : float
        Communication step [s].
    components : tuple of str
        With the fastest mode of all whose outputs others integrate; empty: there is none.
    rate : float
        The largest modulus of an eigenvalue of theirs [1/s].
    unknown : tuple of str
        Components that drive others in the same way, and have no linearization or too many states.
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
    step_ns: int | None

    @property
    def is_resolved(self) -> bool:
        """Whether the error of every response is within the limit."""
        return self.missed.error <= LIMIT

    @property
    def text(self) -> str:
        """What was found, in a sentence."""
        if not self.components:
            text = "no mode of a linear component is interpolated and integrated"
        else:
            text = (
                f"the fastest mode of {listing(self.components)}, {self.rate:.4g} 1/s, times the "
                f"step of {self.h:g} s is {self.rate * self.h:.3g}"
            )
        if self.missed.error:
            error, signal, cause = self.missed
            text += (
                f"; by the linear interpolation of inputs {signal} is off by up to {error:.2g} of "
                f"its response to {cause}"
            )
        if not self.is_resolved:
            text += f", more than {LIMIT:g}"
        if self.unknown:
            text += f"; nothing is known of {listing(self.unknown)}"
        return text

    @property
    def cure(self) -> str:
        """What can be done."""
        return "" if self.step_ns is None else f"use step = {self.step_ns / NANOSECONDS:g}"


def may_be_unresolved(graph: Graph, among: Collection[str]) -> bool:
    """Return whether one of some components may integrate the modes of another one."""
    linearizable = {n for n, m in graph.members.items() if m.channel.interface.linearizable}
    for to, connection in graph.connections.items():
        is_driven = any(source.component in linearizable for source in connection.sources)
        may_integrate = to.component in among and to.component in linearizable
        if is_driven and may_integrate and not graph.held[to.component].all():
            return True
    return False


@np.errstate(over="ignore", invalid="ignore")  # of modes that leave all bounds
def resolution(
    graph: Graph, clock: Clock, row: Vector, linearized: Mapping[str, Linearized]
) -> Resolution:
    """Return what linear interpolation over a step does to the model.

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
    model = _Model(graph, clock, row, linearized)
    h = clock.step_ns / NANOSECONDS
    sources = model.integrated_sources()
    rates: dict[str, float] = {}
    unknown = [name for name in sources if model.is_unknown(name)]
    fast: list[_FastStage] = []
    for stage in graph.stages:
        names = [member.name for member in stage.members if member.name in sources]
        part = _FastStage(model, [name for name in names if name in model.linear])
        if part.size > LARGEST:
            unknown += part.stage
            continue
        rate = part.fastest(is_loop=stage.is_loop)
        if rate is None:
            continue
        rates |= dict.fromkeys(part.stage, rate)
        if rate * h * max(model.spans.values()) > SLOW:
            fast.append(part)

    def worst(parts: int) -> Missed:
        found = (part.missed(h / parts) for part in fast)
        return max(found, key=lambda one: one.error, default=NONE)

    missed = worst(1)
    step_ns = None
    if missed.error > LIMIT:
        step_ns = largest_part(clock.step_ns, lambda parts: worst(parts).error <= LIMIT)
    rate = max(rates.values(), default=0.0)
    fastest = tuple(name for name in rates if rates[name] == rate)
    return Resolution(h, fastest, rate, tuple(unknown), missed, step_ns)


class _Model:
    """The components of a graph that are linearized, and the inputs that they integrate.

    Attributes
    ----------
    linear : dict of component name to Linearized
        Those in continuous time.
    integrated : dict of component name to Mask, shape (n_u,)
        Which inputs are interpolated over a step, and integrated.
    spans : dict of component name to int
        Communication steps of such an interpolation.
    drivers, driven : dict of component name to dict
        Whose outputs a component gets, and who gets its own.
    """

    def __init__(
        self, graph: Graph, clock: Clock, row: Vector, linearized: Mapping[str, Linearized]
    ) -> None:
        self.graph = graph
        self.clock = clock
        self.row = row
        self.labels = graph.labels()
        self.linear = {name: own for name, own in linearized.items() if own.is_continuous}
        self.integrated: dict[str, Mask] = {}
        self.spans: dict[str, int] = {}
        for name, own in linearized.items():
            if own.is_discrete or own.delay or own.input_use == "start":
                continue
            elements = ~graph.held[name] & own.B.any(axis=0) & ~self._refined(name)
            if elements.any():
                self.integrated[name] = elements
                self.spans[name] = max(1, own.own_steps)
        self.drivers: dict[str, dict[str, None]] = {name: {} for name in graph.components}
        self.driven: dict[str, dict[str, None]] = {name: {} for name in graph.components}
        for to, connection in graph.connections.items():
            for source in connection.sources:
                self.drivers[to.component][source.component] = None
                self.driven[source.component][to.component] = None

    def _refined(self, name: str) -> Mask:
        """Return which inputs of a component come out of a loop that divides its steps."""
        for stage in self.graph.stages:
            names = [member.name for member in stage.members]
            if stage.controls and name in names:
                matrices = wiring(stage.members, self.graph.layout.width)
                return np.asarray(matrices[names.index(name)].any(axis=1))
        return np.zeros(self.graph.layout[name].interface.n_u, np.bool_)

    def passes(self, name: str) -> bool:
        """Return whether what drives a component is in its outputs at once."""
        return name in self.linear and bool(self.linear[name].D.any())

    def integrated_sources(self) -> dict[str, None]:
        """Return the components whose outputs others integrate, also through what passes them."""
        sources: dict[str, None] = {}
        for name in self.integrated:
            sources |= self.drivers[name]
        waiting = list(sources)
        for name in waiting:  # grows on the way
            if self.passes(name):
                waiting += [driver for driver in self.drivers[name] if driver not in sources]
                sources |= self.drivers[name]
        return sources

    def is_unknown(self, name: str) -> bool:
        """Return whether a component follows its inputs in continuous time, unknown how."""
        interface = self.graph.members[name].channel.interface
        if name in self.linear or not interface.n_u:
            return False
        ports = [Port(name, signal.name) for signal in interface.outputs]
        return any(self.graph.variability(port) == "continuous" for port in ports)


class _FastStage:
    """The linear components of a stage, and those behind them that pass on their outputs.

    With them those that integrate these outputs, and behind all of them what else drives them.
    """

    def __init__(self, model: _Model, stage: list[str]) -> None:
        self.stage = stage
        self._model = model
        passing = list(stage)
        for name in passing:  # grows on the way
            passing += [n for n in model.driven[name] if n not in passing and model.passes(n)]
        driven = chain.from_iterable(model.driven[name] for name in passing)
        consumers = [name for name in driven if name in model.integrated]
        names = dict.fromkeys((*passing, *consumers))
        self._names = [name for name in names if name in model.linear]
        drivers = chain.from_iterable(model.drivers[name] for name in self._names)
        others = dict.fromkeys((*drivers, *consumers))
        self._inside = [model.graph.members[name] for name in self._names]
        self._others = [model.graph.members[n] for n in others if n not in self._names]
        self.size = sum(len(model.linear[name].A) for name in self._names)

    def fastest(self, *, is_loop: bool) -> float | None:
        """Return the fastest mode of the stage [1/s]; None: it has none."""
        modes: list[float] = []
        for name in self.stage:
            modes += np.abs(np.linalg.eigvals(self._model.linear[name].A)).tolist()
        if is_loop and modes and self._system is not None:
            modes += np.abs(self._system.poles).tolist()
        return max(modes, default=None)

    @cached_property
    def _loop(self) -> LoopModel:
        """All of them in their places; the others have outputs alone."""
        linear = [self._model.linear[name] for name in self._names]
        for member in self._others:
            interface = member.channel.interface
            nothing = static(np.zeros((interface.n_y, interface.n_u)))
            linear.append(replace(nothing, is_discrete=True))
        matrices = wiring([*self._inside, *self._others], self._model.graph.layout.width)
        return LoopModel(tuple(linear), matrices, (), (), 0.0)

    @cached_property
    def _system(self) -> ConnectedSystem | None:
        """The components as one, driven by the outputs of the others."""
        return connect(self._loop)

    def missed(self, h: float) -> Missed:
        """Return the largest error of a response where the step is h."""
        system = self._system
        if system is None:
            return NONE
        causes, G, by_w = self._excitations(system)
        if not G.any():
            return NONE
        response = _Response(system.A, G, h)
        places = list(chain.from_iterable(_columns(member) for member in self._inside))
        rows = np.eye(len(system.C))[: len(places)]  # those inside stand before the others
        wrong = np.hstack([np.zeros((len(places), len(response.x))), rows @ system.C])
        P = self._with_errors(system, response)
        checks = [(response, P, wrong[np.newaxis], rows, places)]
        for number, member in enumerate(self._others, start=len(self._inside)):
            if member.name not in self._model.integrated:
                continue  # it is not known what the others make of the errors of their inputs
            elements = np.flatnonzero(self._model.integrated[member.name])
            response = _Response(system.A, G, h * self._model.spans[member.name])
            rows = self._loop.wiring[number][elements]
            places = (member.inputs.start + elements).tolist()
            checks.append((response, response.P, response.missed(rows @ system.C), rows, places))
        clock = self._model.clock
        largest = (0.0, 0, 0)  # error, place of the signal in the row, cause
        for response, P, wrong, rows, places in checks:
            initial = self._model.row[places]
            base = np.hstack([rows @ system.D @ by_w, initial[:, np.newaxis]])
            steps = max(1, round((clock.stop - clock.start_time) / response.h))
            errors = response.errors(P, wrong, rows @ system.C, base, steps)
            at, column = np.unravel_index(int(errors.argmax()), errors.shape)
            largest = max(largest, (float(errors[at, column]), places[at], int(column)))
        error, place, cause = largest
        return Missed(error, self._model.labels[place], causes[cause]) if error else NONE

    def _with_errors(self, system: ConnectedSystem, response: _Response) -> Matrix:
        """Return what a step does to x and g, and to the errors of the states behind them.

        Each component takes for its inputs lines between what it gets at the points, the errors
        of the others there included.
        """
        linear = [self._model.linear[name] for name in self._names]
        states = slices([len(own.A) for own in linear])
        U = np.vstack(self._loop.wiring[: len(linear)]) @ system.C
        inputs = slices([own.B.shape[1] for own in linear])
        missed = response.missed(U)
        size = len(response.x)
        n = len(system.A)
        before = np.zeros((n, size + n))
        after = np.eye(n)
        for name, own, x, u in zip(self._names, linear, states, inputs, strict=True):
            held = np.zeros(own.B.shape[1], np.bool_)
            whole = first_order_hold(own.A, own.B, response.h, held)
            after[x] -= whole.B1 @ U[u]
            before[x, size:] += whole.B0 @ U[u]
            before[x, size:][:, x] += whole.Ad
            part = first_order_hold(own.A, own.B, response.h / POINTS, held)
            interpolated = self._model.integrated.get(name, held)
            of_inputs = missed[:, u] * interpolated[:, np.newaxis]
            for first, second in pairwise(of_inputs):
                before[x, :size] = part.Ad @ before[x, :size] + part.B0 @ first + part.B1 @ second
        P = np.zeros((size + n, size + n))
        P[:size, :size] = response.P
        try:
            P[size:] = np.linalg.solve(after, before)
        except np.linalg.LinAlgError:  # with this step the run has no one solution
            P[size:] = np.nan
        return P

    def _excitations(self, system: ConnectedSystem) -> tuple[list[str], Matrix, Matrix]:
        """Return what begins fast modes, in words, as x' at once, and as outputs of the others.

        The last one is the initial state, for which these do not change.
        """
        causes: list[str] = []
        jumping: list[int] = []
        columns = list(chain.from_iterable(_columns(member) for member in self._others))
        jumps = list(chain.from_iterable(self._jumps(member) for member in self._others))
        for number, column in enumerate(columns):
            if jumps[number] and system.B[:, number].any():
                causes.append(f"a jump of {self._model.labels[column]}")
                jumping.append(number)
        rates = []
        for name in self._names:
            own = self._model.linear[name]
            rates.append(np.zeros(len(own.A)) if own.rate is None else own.rate)
        initial = np.concatenate(rates)[:, np.newaxis]
        by_w = np.eye(len(columns))[:, jumping]
        return [*causes, "the initial state"], np.hstack([system.B @ by_w, initial]), by_w

    def _jumps(self, member: Member) -> Iterator[bool]:
        """Yield of every output of a component whether it may jump."""
        for signal in member.channel.interface.outputs:
            may_jump = bool(self._model.graph.jumps(Port(member.name, signal.name)))
            yield from [may_jump] * signal.size


def _columns(member: Member) -> range:
    """Return the columns of the outputs of a component."""
    return range(member.outputs.start, member.outputs.stop)


class _Response:
    """The responses of a system ``x' = A x + g`` with ``x = 0`` at the start, step by step.

    Parameters
    ----------
    A, G : Matrix, shapes (n, n), (n, k)
        For every response a g.
    h : float
        Length of the steps [s].

    Attributes
    ----------
    x : Matrix, shape (n + k, k)
        States and unit vectors, for the g, at the start.
    P : Matrix, shape (n + k, n + k)
        What a step does to it.
    """

    def __init__(self, A: Matrix, G: Matrix, h: float) -> None:
        n, k = G.shape
        system = np.zeros((n + k, n + k))
        system[:n] = np.hstack([A, G])
        E = matrix_exponential(system * (h / POINTS))
        states = [np.eye(n + k)]
        for _ in range(POINTS):
            states.append(E @ states[-1])
        self.h = h
        self.x = np.vstack([np.zeros((n, k)), np.eye(k)])
        self.P = states[-1]
        self._n = n
        self._states = np.array(states)

    def missed(self, inputs: Matrix) -> NDArray[np.float64]:
        """Return lines over a step less ``inputs x``, at its points, by states at its start."""
        u: NDArray[np.float64] = inputs @ self._states[:, : self._n]
        fractions = np.linspace(0.0, 1.0, POINTS + 1)[:, np.newaxis, np.newaxis]
        return np.asarray(u[0] + fractions * (u[-1] - u[0]) - u)

    def errors(
        self, P: Matrix, wrong: NDArray[np.float64], outputs: Matrix, base: Matrix, steps: int
    ) -> Matrix:
        """Return the errors of signals, shape (m, k), relative to their largest values.

        Parameters
        ----------
        P : Matrix, shape (N, N)
            What a step does to the states, and what follows from them.
        wrong : array, shape (points, m, N)
            The errors by these.
        outputs, base : Matrix, shapes (m, n), (m, k)
            The signals are ``outputs x + base``.
        steps : int
            Their number.
        """
        x = np.vstack([self.x, np.zeros((len(P) - len(self.x), self.x.shape[1]))])
        y = np.abs(base)
        terms = y.copy()  # where y is much less than its terms, it is rounding
        error = np.abs(wrong @ x).max(axis=0)
        done = 0
        length = 1
        while done < steps and np.isfinite(x).all():
            for _ in range(min(STEPS, -(-(steps - done) // length))):
                x = P @ x
                error = np.fmax(error, np.abs(wrong @ x).max(axis=0))
                y = np.fmax(y, np.abs(outputs @ x[: self._n] + base))
                terms = np.fmax(terms, np.abs(outputs) @ np.abs(x[: self._n]))
            done += STEPS * length
            length *= 2
            P = P @ P
        is_known = (y > ROUNDING * terms) & np.isfinite(y) & np.isfinite(error)
        relative: Matrix = np.divide(error, y, out=np.zeros(y.shape), where=is_known)
        return relative
