"""How much the coupling of a loop multiplies an error over a run.

A loop is linearized where it starts. Its gain rho is the spectral radius of its one-step map
(:mod:`cosim.core.gain.loop_map`). The coupled system itself grows by exp(h r) in a step, r the
largest real part of its poles (:mod:`cosim.core.gain.system`), and an undamped one by 1. What is
beyond that is the coupling's: over N steps it multiplies an error by::

    (rho / max(1, exp(h r)))^N

More than ``REFUSED`` is no result any more; more than ``NOTED`` is worth a warning.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Literal, TypeAlias

import numpy as np

from cosim.arrays import Vector
from cosim.core.clock import Clock
from cosim.core.gain.loop_map import LoopModel, loop_model, one_step_maps, product
from cosim.core.gain.radius import spectral_radius
from cosim.core.gain.system import connect, sampled_map
from cosim.core.graph import COUPLINGS, Graph
from cosim.core.linearization import Linearized
from cosim.core.stages.coupling import Stage
from cosim.core.structure.order import Coupling
from cosim.documents import document, told
from cosim.errors import GraphError
from cosim.instants import StepNs, step_part

REFUSED: Final = 10.0
NOTED: Final = 1.01
FAR: Final = 10  # a fine step that is so much smaller than one that is not refused is not offered
MOST_PARTS: Final = 10_000  # of a step that is a fraction
NESTED: Final = "some of its components take substeps, and some do not"
TOO_FAST: Final = "it grows beyond all numbers within a step"
NO_SOLUTION: Final = "its algebraic loop has no one solution at the start"

GainVerdict: TypeAlias = Literal["fine", "noted", "refused", "unknown"]


@document
class LoopGain:
    """The gain of a loop.

    Parameters
    ----------
    components : tuple of str
    coupling : str
        How they are coupled.
    h : float
        Communication step [s].
    steps : int
        Of the run.
    rho : float or None
        In a step; None: not known.
    rate : float or None
        At which the coupled system itself grows [1/s]: the largest real part of its poles; None:
        not known, or it has none.
    unknown : tuple of str
        The components that cannot be linearized.
    reason : str
        Why else the gain is not known.
    action : str
        Behind which action it is so; empty: as the run begins.
    parts : int
        Shortest substeps in a communication step; 1: it takes none. Where it does, ``h`` and
        ``steps`` are those of its shortest substeps, and so is ``rho``.
    """

    components: tuple[str, ...]
    coupling: str
    h: float
    steps: int
    rho: float | None = None
    rate: float | None = None
    unknown: tuple[str, ...] = ()
    reason: str = ""
    action: str = ""
    parts: int = told(1)

    @property
    def exponent(self) -> float:
        """The natural logarithm of what the coupling multiplies an error by over the run."""
        if self.rho is None:
            return math.nan
        if self.rho == 0.0:
            return -math.inf
        return self.steps * math.log(self.rho) - self.own_exponent

    @property
    def own_exponent(self) -> float:
        """The same of what the coupled system itself multiplies it by, undamped at the least."""
        return 0.0 if self.rate is None else self.steps * max(0.0, self.h * self.rate)

    @property
    def verdict(self) -> GainVerdict:
        """What follows for the run."""
        exponent = self.exponent
        if math.isnan(exponent):
            return "unknown"
        if exponent > math.log(REFUSED):
            return "refused"
        return "noted" if exponent > math.log(NOTED) else "fine"

    @property
    def is_unstable(self) -> bool:
        """Whether the coupled system itself multiplies an error by more than 10 over the run."""
        return self.own_exponent > math.log(REFUSED)


@dataclass(frozen=True, slots=True)
class LinearizedLoops:
    """The components of a graph, and its loops, linearized where it starts.

    Parameters
    ----------
    graph : Graph
        Prepared and initialized.
    clock : Clock
    linearized : mapping of component name to Linearized
        Those that can be linearized.
    """

    graph: Graph
    clock: Clock
    linearized: Mapping[str, Linearized] = field(default_factory=dict)

    @staticmethod
    def may_be_known(graph: Graph) -> bool:
        """Return whether there is a loop all of whose components may be linearized."""
        for stage in graph.stages:
            declared = [member.channel.interface.linearizable for member in stage.members]
            if stage.is_loop and all(declared):
                return True
        return False

    @staticmethod
    def of(graph: Graph, clock: Clock, row: Vector) -> LinearizedLoops:
        """Linearize the components, of loops or not, at the first row, with which it begins."""
        linearized = {}
        for stage in graph.stages:
            for member in stage.members:
                matrices = member.component.linearized(clock.start_time, row[member.inputs])
                if matrices is not None:
                    linearized[member.name] = matrices
        return LinearizedLoops(graph, clock, linearized)

    def gains(self) -> tuple[LoopGain, ...]:
        """Return the gain of every loop."""
        return tuple(self._gain(loop) for loop in self.graph.stages if loop.is_loop)

    def step_for(self, number: int) -> StepNs | None:
        """Return a communication step [ns] at which a loop would run; None: none found.

        It divides the present one, so that it divides all that the present one does. Of such the
        largest is looked for by bisection at which the loop would be fine; the gain is computed at
        the one that is returned. Where that is less than a tenth of the largest that would not be
        refused, as of undamped loops, whose error grows slowly at any step, it is the latter.
        None is needed where the shortest substep would be refused, too.
        """
        if self._loops()[number].controls:
            return None
        model = self._model(self._loops()[number])
        fine = self._largest_step(model, ("fine",))
        allowed = self._largest_step(model, ("fine", "noted"))
        if fine is None or allowed is None:
            return allowed
        return fine if FAR * fine >= allowed else allowed

    def _largest_step(self, model: LoopModel, verdicts: Sequence[GainVerdict]) -> StepNs | None:
        return largest_part(
            self.clock.step_ns, lambda parts: self._verdict(model, parts) in verdicts
        )

    def couplings_for(self, number: int) -> list[Coupling]:
        """Return the other couplings with which a loop would be fine at the same step."""
        fine: list[Coupling] = []
        for coupling in COUPLINGS:
            if coupling == self.graph.coupling:
                continue
            try:
                graph = self.graph.with_coupling(coupling)
            except GraphError:  # of components that cannot go back, for example
                continue
            gain = LinearizedLoops(graph, self.clock, self.linearized).gains()[number]
            if gain.verdict == "fine":
                fine.append(coupling)
        return fine

    def _loops(self) -> list[Stage]:
        return [stage for stage in self.graph.stages if stage.is_loop]

    def _model(self, loop: Stage) -> LoopModel:
        width = self.graph.layout.width
        h = self.clock.h
        masks = (self.graph.held, self.graph.latest)
        model = loop_model(loop, self.linearized, *masks, h=h, width=width)
        parts = self._substeps(loop)
        return model.refined(parts) if parts > 1 else model

    def _substeps(self, loop: Stage) -> int:
        """Return into how many parts a loop may divide its steps."""
        if not loop.controls:
            return 1
        return 1 << loop.controls[0].tolerance.finest_level(self.clock.step_ns)

    def _gain(self, loop: Stage) -> LoopGain:
        names = tuple(member.name for member in loop.members)
        undeclared = [m.name for m in loop.members if not m.channel.interface.linearizable]
        missing = [name for name in names if name not in self.linearized]
        unknown = tuple(undeclared or missing)
        coupling = self.graph.coupling
        h = self.clock.h
        if unknown:
            return LoopGain(names, coupling, h, self.clock.steps, unknown=unknown)
        if loop.nested is not None and (loop.controls or loop.torn is not None):
            return LoopGain(names, coupling, h, self.clock.steps, reason=NESTED)
        parts = self._substeps(loop)
        gain = _gain_of(self._model(loop), names, coupling, self.clock.steps * parts)
        return replace(gain, parts=parts)

    def _verdict(self, model: LoopModel, parts: int) -> GainVerdict:
        return _gain_of(model.refined(parts), (), "", self.clock.steps * parts).verdict


def _gain_of(model: LoopModel, names: tuple[str, ...], coupling: str, steps: int) -> LoopGain:
    if model.is_too_large:
        reason = "its one-step map is too large to look at before a run"
        return LoopGain(names, coupling, model.h, steps, reason=reason)
    period = model.period
    with np.errstate(over="ignore", invalid="ignore"):  # a map that is not finite has no radius
        maps = one_step_maps(model)
        system = connect(model)
        exact = None if system is None else sampled_map(model, system)
        if maps is None or system is None or exact is None:
            return LoopGain(names, coupling, model.h, steps, reason=NO_SOLUTION)
        rho = spectral_radius(product(maps)) ** (1.0 / period)
        radius = spectral_radius(exact)
    if all(member.is_continuous for member in model.members):
        rate = max((pole.real for pole in system.poles), default=-math.inf)
    else:
        rate = math.log(radius) / (period * model.h) if radius > 0.0 else -math.inf
    if not (math.isfinite(rho) and rate < math.inf):
        return LoopGain(names, coupling, model.h, steps, reason=TOO_FAST)
    return LoopGain(names, coupling, model.h, steps, rho, None if rate == -math.inf else rate)


def largest_part(step_ns: StepNs, fits: Callable[[int], bool]) -> StepNs | None:
    """Return the largest part of a step [ns] that fits, by bisection; None: none found.

    ``fits`` is asked for the number of parts that the step is divided into.
    """
    counts: Sequence[int] = range(2, MOST_PARTS)
    if isinstance(step_ns, int):  # so are its parts
        counts = [count for count in _divisors(step_ns) if count > 1]
    number = bisect_left(counts, True, key=fits)
    if number == len(counts):
        return None
    return step_part(step_ns, counts[number])


def _divisors(number: int) -> list[int]:
    """Return the divisors of a whole number in order."""
    small = [divisor for divisor in range(1, math.isqrt(number) + 1) if number % divisor == 0]
    large = [number // divisor for divisor in small if divisor * divisor != number]
    return small + large[::-1]
