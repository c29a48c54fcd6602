"""The gain of the loops of a scenario, before its run: refused, warned of, or reported.

A coupling that multiplies an error by more than 10 over the run leaves nothing of its results. It
is refused, with a step or a coupling that would do; ``coupling_check = "warn"`` runs it all the
same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from graphlib import CycleError, TopologicalSorter
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.core.clock import Clock
from cosim.core.gain.loop_gain import NOTED, REFUSED, LinearizedLoops, LoopGain
from cosim.core.gain.resolution import may_be_unresolved, resolution
from cosim.core.graph import Graph
from cosim.core.recording import Plan
from cosim.errors import CosimError, listing
from cosim.instants import step_value
from cosim.scenario.building.changed_loops import ChangedLoops, changed_loops
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.document.places import Key, Problem
from cosim.scenario.document.schema import Settings

COUPLING: Final = "coupling"  # whose warnings these are
STEP: Final = "scenario.step"
LARGEST: Final = 1e4  # that is written without an exponent of ten


@dataclass(frozen=True, slots=True)
class CouplingReport:
    """What is known of the loops of a graph.

    Parameters
    ----------
    gains : tuple of LoopGain
    refusals, warnings : tuple of str
    """

    gains: tuple[LoopGain, ...] = ()
    refusals: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def with_loop_gains(experiment: Experiment, rebuild: Callable[[], Experiment]) -> Experiment:
    """Return an experiment with the gains of its loops, and the warnings that follow from them.

    It also warns of a step that does not resolve the model. The graph is prepared and initialized
    for that; one that cannot be is left to the run. Where an FMU does not begin again as it did,
    the run takes what ``rebuild`` returns.

    Raises
    ------
    ScenarioError
        If the coupling of a loop is refused.
    """
    graph = experiment.graph
    has_loop = any(stage.is_loop for stage in graph.stages)
    own = () if experiment.built.modules else graph.components.keys() - experiment.fmus.keys()
    is_to_begin = LinearizedLoops.may_be_known(graph) or may_be_unresolved(graph, own)
    if not (has_loop or is_to_begin):
        return experiment
    messages = {
        name: [*experiment.messages.get(name, ()), *fmu.drain()]
        for name, fmu in experiment.fmus.items()
    }
    beginning = _Beginning(graph, experiment.clock, experiment.plan, is_to_begin=is_to_begin)
    loops = beginning.loops()
    step_warnings = beginning.step_warnings(loops)
    changes = beginning.changed(experiment, loops)
    if experiment.fmus and not beginning.repeats():
        experiment = rebuild()
    else:
        experiment.plan = beginning.plan
        experiment.messages = messages
        for fmu in experiment.fmus.values():
            fmu.discard()  # the run says the same again
    first = report_on(loops, experiment.scenario)
    reports: list[tuple[Key, CouplingReport]] = [(("scenario", "step"), first)]
    reports += [(changed.key, report_behind(changed)) for changed in changes]
    settings = experiment.scenario.file.scenario
    gains: list[LoopGain] = []
    problems: list[Problem] = []
    for key, report in reports:
        gains += report.gains
        noted = report.warnings
        if settings.coupling_check == "warn":
            noted += report.refusals
        else:
            way_out = '; coupling_check = "warn" runs it anyway'
            problems += [(key, text + way_out) for text in report.refusals]
        for text in noted:
            experiment.built.warn(COUPLING, text)
    if problems:
        raise experiment.scenario.document.report(problems)
    _note(experiment.graph, first.gains)
    experiment.graph.watched = _watched(first.gains, settings)
    for name, text in step_warnings:
        experiment.built.warn(name, text)
    experiment.gains = tuple(gains)
    return experiment


class _Beginning:
    """The beginning of a graph, where that is needed to know its loops.

    Attributes
    ----------
    plan : Plan or None
    """

    def __init__(
        self, graph: Graph, clock: Clock, plan: Plan | None = None, *, is_to_begin: bool
    ) -> None:
        self.plan = plan
        self._graph = graph
        self._clock = clock
        self._row: Vector | None = None
        if not is_to_begin:
            return
        with suppress(CosimError):  # the run will end with it
            if plan is None:
                self.plan = graph.prepare(clock.step_ns)
            self._row = self._initialized()

    def _initialized(self) -> Vector:
        row = np.zeros(self._graph.layout.width)
        self._graph.initialize(self._clock.start_time, row)
        return row

    def loops(self) -> LinearizedLoops:
        """Return the loops, linearized where the graph could be begun."""
        if self._row is None:
            return LinearizedLoops(self._graph, self._clock)
        return LinearizedLoops.of(self._graph, self._clock, self._row)

    def step_warnings(self, loops: LinearizedLoops) -> list[tuple[str, str]]:
        """Return that the step does not resolve the model, if it is known not to."""
        if self._row is None:
            return []
        found = resolution(self._graph, self._clock, self._row, loops.linearized)
        if found.is_resolved:
            return []
        return [(STEP, "; ".join(filter(None, (found.text, found.cure))))]

    def changed(self, experiment: Experiment, loops: LinearizedLoops) -> list[ChangedLoops]:
        """Return the loops behind actions; none where it is not known how they begin."""
        return [] if self._row is None else list(changed_loops(experiment, loops, self._row))

    def repeats(self) -> bool:
        """Return whether it can be begun again, to the same bits, or was not begun."""
        if self._row is None:
            return True
        try:
            return self._initialized().tobytes() == self._row.tobytes()
        except CosimError:
            return False


def _note(graph: Graph, gains: tuple[LoopGain, ...]) -> None:
    """Add its gain to the errors of a loop."""
    for gain in gains:
        if gain.rho is not None:
            for name in gain.components:
                amplification = f"{_number(gain.rho)} per {_step(gain)}"
                graph.members[name].note += f" with an error amplification of {amplification}"


def _watched(gains: tuple[LoopGain, ...], settings: Settings) -> frozenset[str]:
    """Return the components of loops that are not to grow: all but those that do of themselves."""
    components: set[str] = set()
    if settings.coupling_check == "warn":
        return frozenset()
    for gain in gains:
        if gain.own_exponent <= math.log(REFUSED):
            components.update(gain.components)
    return frozenset(components)


def report_on(loops: LinearizedLoops, scenario: Scenario) -> CouplingReport:
    """Return what is known of loops, and what stands against their coupling."""
    gains = dict(enumerate(loops.gains()))
    return _report(loops, {n: gain for n, gain in gains.items() if _is_closed(gain, scenario)})


def _is_closed(gain: LoopGain, scenario: Scenario) -> bool:
    """Return whether a loop is one without what is recorded, which reacts to nothing."""
    names = {name for name in gain.components if not scenario.specs[name].is_recorded}
    if len(names) == len(gain.components):
        return True
    try:
        TopologicalSorter({name: scenario.sources_of(name) & names for name in names}).prepare()
    except CycleError:
        return True
    return False


def report_behind(changed: ChangedLoops) -> CouplingReport:
    """Return the same of loops behind an action, of those that it changes.

    One that comes with a condition may never be performed, so it is warned of.
    """
    gains = {}
    for number, gain in enumerate(changed.loops.gains()):
        if not changed.components.isdisjoint(gain.components):
            gains[number] = _gain_behind(gain, changed)
    report = _report(changed.loops, gains)
    if changed.is_certain:
        return report
    return CouplingReport(report.gains, warnings=report.warnings + report.refusals)


def _gain_behind(gain: LoopGain, changed: ChangedLoops) -> LoopGain:
    """Return the gain of a loop behind an action; not known where a fault is not in it."""
    named = replace(gain, action=changed.action)
    faults = [text for name in gain.components for text in changed.not_linearized.get(name, ())]
    if not faults:
        return named
    reason = f"no linearization of {listing(faults)}"
    return replace(named, rho=None, rate=None, reason=reason)


def _report(loops: LinearizedLoops, gains: Mapping[int, LoopGain]) -> CouplingReport:
    """Return what is known of some loops by their numbers."""
    refusals = []
    warnings = []
    for number, gain in gains.items():
        if gain.verdict == "refused":
            refusals.append(_refusal(gain, loops, number))
        elif gain.verdict == "noted":
            warnings.append(_excess(gain))
        if gain.is_unstable:
            warnings.append(_unstable(gain))
    return CouplingReport(tuple(gains.values()), tuple(refusals), tuple(warnings))


def _refusal(gain: LoopGain, loops: LinearizedLoops, number: int) -> str:
    ways_out = []
    step_ns = loops.step_for(number)
    if step_ns is not None:
        ways_out.append(f"step = {step_value(step_ns)!r}")
    for coupling in loops.couplings_for(number):
        offer = f'coupling = "{coupling}"'
        if coupling == "newton" and loops.graph.iterations > 1:  # it takes as many as it needs
            offer += " with iterations = 1"
        ways_out.append(offer)
    way_out = ""
    if ways_out:
        *others, last = ways_out
        way_out = f"; use {' or '.join(filter(None, (', '.join(others), last)))}"
    return f"{_excess(gain)}, more than {REFUSED:g}{way_out}"


def _excess(gain: LoopGain) -> str:
    assert gain.rho is not None
    own = _own(gain)
    return (
        f"{_loop(gain)}: coupling '{gain.coupling}' amplifies an error by "
        f"{_number(gain.rho)} per {_step(gain)} of {gain.h:g} s (exact solution: {own}), by "
        f"{_growth(gain.exponent)} over {_span(gain)}"
    )


def _step(gain: LoopGain) -> str:
    return "step" if gain.parts == 1 else "substep"


def _loop(gain: LoopGain) -> str:
    text = f"the loop of {listing(gain.components)}"
    return f"{gain.action}, {text}" if gain.action else text


def _span(gain: LoopGain) -> str:
    return "the rest of the run" if gain.action else "the run"


def _unstable(gain: LoopGain) -> str:
    return (
        f"{_loop(gain)} is unstable with any coupling: pole at {gain.rate:+.4g} /s, errors "
        f"grow by {_growth(gain.own_exponent)} over {_span(gain)}"
    )


def _growth(exponent: float) -> str:
    """Return exp(exponent) in words, also where it is no number of the machine."""
    decades = exponent / math.log(10.0)
    if abs(decades) > math.log10(LARGEST):
        return f"1e{decades:+.0f}".replace("+", "")
    return f"{math.exp(exponent):.4g}"


def _own(gain: LoopGain) -> str:
    """Return what the loop itself multiplies an error by in a step, in words."""
    if gain.rate is None:
        return "0"
    exponent = gain.h * gain.rate
    return _growth(exponent) if exponent > 1.0 else _number(math.exp(exponent))


def _number(rho: float) -> str:
    """Return a gain with three digits of what it has more or less than 1."""
    difference = abs(rho - 1.0)
    if not 1e-12 < difference < 1.0:
        return f"{rho:.4g}"
    decimals = 2 - math.floor(math.log10(difference))
    return f"{rho:.{decimals}f}"


# --- to be shown ---


def described_gains(graph: Graph, clock: Clock) -> tuple[LoopGain, ...]:
    """Return the gains of loops of a graph that shows what there is.

    Of what cannot run nothing does: it is not linearized, either.
    """
    is_to_begin = LinearizedLoops.may_be_known(graph)
    return _Beginning(graph, clock, is_to_begin=is_to_begin).loops().gains()


def gain_text(gain: LoopGain) -> str:
    """Return the gain of a loop in words."""
    if gain.unknown:
        return f"unknown: no linearization of {listing(gain.unknown)}"
    if gain.rho is None:
        return f"unknown: {gain.reason}"
    own = _own(gain)
    step = "step"
    if gain.parts > 1:
        step = f"smallest substep allowed, {gain.h:g} s"
    text = f"{_number(gain.rho)} per {step} (exact solution: {own})"
    if gain.exponent > math.log(NOTED):
        text += f"; errors grow by an extra {_growth(gain.exponent)} over {_span(gain)}"
    return text


def gain_values(gain: LoopGain) -> dict[str, Any]:
    """Return what is known of a loop as plain values."""
    return {
        "loop": ", ".join(gain.components),
        "action": gain.action,
        "coupling": gain.coupling,
        "gain": gain.rho,
        "step": gain.h,
        "largest pole": gain.rate,
        "verdict": gain.verdict,
        "text": gain_text(gain),
    }
