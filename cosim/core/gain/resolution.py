"""Whether the step resolves the model: what linear interpolation over a step does to its modes.

Each component is exact for inputs that are linear over a step. Where an output of a component with
fast modes drives another one that integrates it, the line between two communication points misses
what the modes do there: of exp(-a t) up to (a h)^2/8. So it is asked of every input that is
interpolated and integrated, what the line misses of its response

* to a jump of each discrete signal, which reaches the model without an error,
* to the initial state, where the model does not begin at rest,

relative to the largest value of the same response. What is smooth excites no fast mode, and what a
mode adds to no such input is no error; inputs with a zero-order hold are not looked at. More than
``LIMIT`` of a response is refused: of one mode that is where a h is 0.29.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Final, NamedTuple

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.clock import Clock
from cosim.core.gain.loop_gain import largest_part
from cosim.core.gain.loop_map import LoopModel, wiring
from cosim.core.gain.system import ConnectedSystem, connect
from cosim.core.graph import Graph
from cosim.core.linearization import Linearized, static
from cosim.core.port import Port
from cosim.core.stages.member import Member
from cosim.errors import listing
from cosim.instants import NANOSECONDS
from cosim.native.numerics.linear import matrix_exponential

LIMIT: Final = 0.01  # of a response
SLOW: Final = 0.1  # a mode times the step: the line misses an eighth of a percent
POINTS: Final = 8  # within a step
STEPS: Final = 64  # that are followed one by one; the largest value is then looked for further on


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
        Components that drive others in the same way, and have no linearization.
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
                f"the fastest mode of {listing(self.components)}, {self.rate:.3g} 1/s, times the "
                f"step of {self.h:g} s is {self.rate * self.h:.3g}"
            )
        if self.missed.error:
            error, signal, cause = self.missed
            text += (
                f"; linear interpolation over a step misses {error:.2g} of the response of "
                f"{signal} to {cause}"
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
        if to.component in linearizable.intersection(among) and not graph.held[to.component].all():
            if any(source.component in linearizable for source in connection.sources):
                return True
    return False


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
    return _Model(graph, clock, row, linearized).resolution()


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
    """

    def __init__(
        self, graph: Graph, clock: Clock, row: Vector, linearized: Mapping[str, Linearized]
    ) -> None:
        self.graph = graph
        self.clock = clock
        self.row = row
        self.linear = {name: own for name, own in linearized.items() if own.is_continuous}
        self.integrated: dict[str, Mask] = {}
        self.spans: dict[str, int] = {}
        for name, own in linearized.items():
            if own.is_discrete or own.delay or own.input_use == "start":
                continue
            elements = ~graph.held[name] & own.B.any(axis=0)
            if elements.any():
                self.integrated[name] = elements
                self.spans[name] = max(1, own.own_steps)
        self.drivers: dict[str, dict[str, None]] = {name: {} for name in graph.components}
        self.driven: dict[str, dict[str, None]] = {name: {} for name in graph.components}
        for to, connection in graph.connections.items():
            for source in connection.sources:
                self.drivers[to.component][source.component] = None
                self.driven[source.component][to.component] = None

    def passes(self, name: str) -> bool:
        """Return whether what drives a component is in its outputs at once."""
        return name in self.linear and bool(self.linear[name].D.any())

    def resolution(self) -> Resolution:
        """Return what is found of all components."""
        h = self.clock.step_ns / NANOSECONDS
        sources = self._integrated_sources()
        rates: dict[str, float] = {}
        fast: list[_Part] = []
        for stage in self.graph.stages:
            names = [member.name for member in stage.members if member.name in sources]
            part = _Part(self, [name for name in names if name in self.linear])
            rate = part.fastest(is_loop=stage.is_loop)
            if rate is None:
                continue
            rates |= dict.fromkeys(part.stage, rate)
            if rate * h * max(self.spans.values()) > SLOW:
                fast.append(part)

        def worst(parts: int) -> Missed:
            return max(
                (part.missed(h / parts) for part in fast), key=lambda one: one.error, default=NONE
            )

        missed = worst(1)
        step_ns = None
        if missed.error > LIMIT:
            step_ns = largest_part(self.clock.step_ns, lambda parts: worst(parts).error <= LIMIT)
        rate = max(rates.values(), default=0.0)
        fastest = tuple(name for name in rates if rates[name] == rate)
        unknown = tuple(name for name in sources if self._is_unknown(name))
        return Resolution(h, fastest, rate, unknown, missed, step_ns)

    def _integrated_sources(self) -> dict[str, None]:
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

    def _is_unknown(self, name: str) -> bool:
        """Return whether a component follows its inputs in continuous time, unknown how."""
        channel = self.graph.members[name].channel
        if name in self.linear or not channel.interface.n_u:
            return False
        ports = [Port(name, signal.name) for signal in channel.interface.outputs]
        return any(self.graph.variability(port) == "continuous" for port in ports)


class _Part:
    """The linear components of a stage, and those behind them that pass on their outputs.

    Parameters
    ----------
    model : _Model
    stage : list of str
        The components of the stage.
    """

    def __init__(self, model: _Model, stage: list[str]) -> None:
        self.stage = stage
        self._model = model

    def fastest(self, *, is_loop: bool) -> float | None:
        """Return the fastest mode of the stage [1/s]; None: it has none."""
        linear = self._model.linear
        modes: list[float] = []
        for name in self.stage:
            modes += np.abs(np.linalg.eigvals(linear[name].A)).tolist()
        if is_loop and modes and self._system is not None:
            modes += np.abs(self._system.poles).tolist()
        return max(modes, default=None)

    @cached_property
    def _names(self) -> list[str]:
        names = list(self.stage)
        for name in names:  # grows on the way
            followers = self._model.driven[name]
            names += [n for n in followers if n not in names and self._model.passes(n)]
        return names

    @cached_property
    def _consumers(self) -> list[str]:
        followers = dict.fromkeys(chain.from_iterable(self._model.driven[n] for n in self._names))
        return [name for name in followers if name in self._model.integrated]

    @cached_property
    def _members(self) -> list[Member]:
        """The components, then what drives them or integrates their outputs."""
        drivers = chain.from_iterable(self._model.drivers[name] for name in self._names)
        names = dict.fromkeys((*self._names, *drivers, *self._consumers))
        return [self._model.graph.members[name] for name in names]

    @cached_property
    def _wiring(self) -> dict[str, Matrix]:
        """The inputs of each component by all outputs."""
        matrices = wiring(self._members, self._model.graph.layout.width)
        return dict(zip((member.name for member in self._members), matrices, strict=True))

    @cached_property
    def _system(self) -> ConnectedSystem | None:
        """The components as one, driven by the outputs of the others."""
        linear = []
        for number, member in enumerate(self._members):
            interface = member.channel.interface
            nothing = static(np.zeros((interface.n_y, interface.n_u)))
            is_inside = number < len(self._names)
            linear.append(
                self._model.linear[member.name] if is_inside else replace(nothing, is_discrete=True)
            )
        loop = LoopModel(tuple(linear), tuple(self._wiring.values()), (), (), 0.0)
        return connect(loop)

    def missed(self, h: float) -> Missed:
        """Return the largest error of a response where the step is h."""
        system = self._system
        if system is None:
            return NONE
        clock = self._model.clock
        duration = clock.stop - clock.start_time
        causes, columns, by_w = self._excitations(system)
        found = NONE
        for name in self._consumers:
            member = self._model.graph.members[name]
            elements = np.flatnonzero(self._model.integrated[name])
            inputs = self._wiring[name][elements]
            base = inputs @ system.D @ by_w
            base[:, -1] = self._model.row[member.inputs][elements]
            span = h * self._model.spans[name]
            steps = max(1, round(duration / span))
            errors = _relative_errors(system.A, columns, inputs @ system.C, base, span, steps)
            row, column = np.unravel_index(int(errors.argmax()), errors.shape)
            if errors[row, column] > found.error:
                signal = member.label(int(elements[row]))
                found = Missed(float(errors[row, column]), signal, causes[column])
        return found

    def _excitations(self, system: ConnectedSystem) -> tuple[list[str], Matrix, Matrix]:
        """Return what begins fast modes, in words, as x' at once, and as outputs of the others.

        The last one is the initial state.
        """
        graph = self._model.graph
        causes: list[str] = []
        jumping: list[int] = []
        labels = graph.labels()
        number = 0
        for member in self._members[len(self._names) :]:
            columns = range(member.outputs.start, member.outputs.stop)
            jumps: list[bool] = []
            for signal in member.channel.interface.outputs:
                jumps += [bool(graph.jumps(Port(member.name, signal.name)))] * signal.size
            for column, may_jump in zip(columns, jumps, strict=True):
                if may_jump and system.B[:, number].any():
                    causes.append(f"a jump of {labels[column]}")
                    jumping.append(number)
                number += 1
        rates = []
        for name in self._names:
            own = self._model.linear[name]
            rates.append(np.zeros(len(own.A)) if own.rate is None else own.rate)
        initial = np.concatenate(rates)[:, np.newaxis]
        by_w = np.eye(number)[:, jumping]
        columns_of_x = np.hstack([system.B @ by_w, initial])
        by_w = np.hstack([by_w, np.zeros((number, 1))])
        return [*causes, "the initial state"], columns_of_x, by_w


@np.errstate(over="ignore", invalid="ignore")  # of modes that leave all bounds
def _relative_errors(A: Matrix, G: Matrix, M: Matrix, base: Matrix, h: float, steps: int) -> Matrix:
    """Return what linear interpolation over steps misses of responses, over their largest values.

    Parameters
    ----------
    A : Matrix, shape (n, n)
    G : Matrix, shape (n, k)
        x' at the start: ``x' = A x + g``, and ``x = 0`` there.
    M : Matrix, shape (m, n)
        The signals, ``M x`` and ``base``, shape (m, k).
    h : float
        Length of the steps [s].
    steps : int
        Their number.
    """
    n, k = G.shape
    joined = np.zeros((n + k, n + k))
    joined[:n] = np.hstack([A, G])
    E = matrix_exponential(joined * (h / POINTS))
    x = np.vstack([np.zeros((n, k)), np.eye(k)])
    shown = np.hstack([M, np.zeros((len(M), k))])
    fractions = np.linspace(0.0, 1.0, POINTS + 1)[:, np.newaxis, np.newaxis]
    missed = np.zeros(base.shape)
    largest = np.abs(base)
    for _ in range(min(STEPS, steps)):
        states = [x]
        for _ in range(POINTS):
            states.append(E @ states[-1])
        x = states[-1]
        values = shown @ np.array(states)
        line = values[0] + fractions * (values[-1] - values[0])
        missed = np.fmax(missed, np.abs(values - line).max(axis=0))
        largest = np.fmax(largest, np.abs(values + base).max(axis=0))
    done = STEPS
    length = 1
    E = np.linalg.matrix_power(E, POINTS)
    while done < steps and np.isfinite(x).all():
        for _ in range(STEPS):
            x = E @ x
            largest = np.fmax(largest, np.abs(shown @ x + base))
        done += STEPS * length
        length *= 2
        E = E @ E
    is_known = (largest > 0.0) & np.isfinite(largest)
    errors: Matrix = np.divide(missed, largest, out=np.zeros(base.shape), where=is_known)
    return errors
