"""The gain of the loops of a scenario, before its run: refused, warned of, or reported.

A coupling that multiplies an error by more than 10 over the run leaves nothing of its results. It
is refused, with a step or a coupling that would do; ``coupling_check = "warn"`` runs it all the
same. The loops are looked at as the run begins, and behind every action that changes them:
parameters that are set, swaps, inputs with another gain.

A component of cosim's own with other parameters is linearized where the run begins, as the one in
whose place it comes: its state there is not known before the run. What an FMU is with parameters
that are set in it, or in the place of another component, is not known either.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.core.clock import Clock, nanoseconds
from cosim.core.connections import components_driving
from cosim.core.contracts import linearized
from cosim.core.gain.loop_gain import NOTED, REFUSED, LinearizedLoops, LoopGain
from cosim.core.gain.resolution import may_be_unresolved, resolution
from cosim.core.graph import Graph
from cosim.core.linearization import Linearized
from cosim.core.port import Port
from cosim.core.recording import Plan
from cosim.core.stepping.actions import AT_CONDITION
from cosim.core.structure.cycles import find_cycle
from cosim.errors import CosimError, listing
from cosim.instants import step_value
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.document.places import Key, Problem
from cosim.scenario.document.schema import ActionTable
from cosim.scenario.kinds.base import Scenario

COUPLING: Final = "coupling"  # whose warnings these are
STEP: Final = "scenario.step"
LARGEST: Final = 1e4  # that is written without an exponent of ten
NOT_LINEARIZED: Final = ("delay", "drop")  # actions on an input that leave the loop closed


@dataclass(frozen=True, slots=True)
class CouplingReport:
    """What is known of the loops of a graph.

    Parameters
    ----------
    key : Key
        Of the step, or of the action behind which they are so.
    gains : tuple of LoopGain
    refusals, warnings : tuple of str
    """

    key: Key
    gains: tuple[LoopGain, ...]
    refusals: tuple[str, ...]
    warnings: tuple[str, ...]


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
    clock = experiment.clock
    fmus = experiment.built.fmus
    own = () if experiment.built.modules else graph.components.keys() - fmus.keys()
    is_to_begin = LinearizedLoops.may_be_known(graph) or may_be_unresolved(graph, own)
    if not (is_to_begin or any(stage.is_loop for stage in graph.stages)):
        return experiment
    messages = {name: fmu.drain() for name, fmu in fmus.items()}
    plan = row = None
    if is_to_begin:
        plan, row = _begun(graph, clock, None)
    loops = LinearizedLoops(graph, clock)
    repeats = True
    unresolved = ""
    if row is not None:
        loops = LinearizedLoops.of(graph, clock, row)
        found = resolution(graph, clock, row, loops.linearized)
        if not found.is_resolved:
            unresolved = "; ".join(filter(None, (found.text, found.cure)))
    reports = coupling_reports(experiment, loops, row)
    if fmus and row is not None:
        _, again = _begun(graph, clock, plan)
        repeats = again is not None and again.tobytes() == row.tobytes()
    if repeats:
        experiment.plan = plan
        experiment.messages = messages
        for fmu in fmus.values():
            fmu.discard()  # the run says the same again
    else:
        experiment = rebuild()
    _conclude(experiment, reports)
    if unresolved:
        experiment.built.warn(STEP, unresolved)
    return experiment


def _conclude(experiment: Experiment, reports: Sequence[CouplingReport]) -> None:
    """Refuse or warn of couplings; note the gains for the log, and for errors of the run.

    Raises
    ------
    ScenarioError
        If the coupling of a loop is refused.
    """
    is_refused = experiment.scenario.file.scenario.coupling_check == "refuse"
    problems: list[Problem] = []
    for report in reports:
        experiment.gains += report.gains
        warnings = report.warnings
        if is_refused:
            way_out = '; coupling_check = "warn" runs it anyway'
            problems += [(report.key, text + way_out) for text in report.refusals]
        else:
            warnings += report.refusals
        for text in warnings:
            experiment.built.warn(COUPLING, text)
    if problems:
        raise experiment.scenario.document.report(problems)
    graph = experiment.graph
    watched: set[str] = set()  # components of loops that are not to grow: all but unstable ones
    for gain in reports[0].gains:
        if gain.rho is not None:
            note = f" with an error amplification of {_number(gain.rho)} per {_step(gain)}"
            for name in gain.components:
                graph.members[name].note += note
        if is_refused and not gain.is_unstable:
            watched.update(gain.components)
    graph.watched = frozenset(watched)


def _begun(graph: Graph, clock: Clock, plan: Plan | None) -> tuple[Plan | None, Vector | None]:
    """Prepare and initialize a graph; return its plan and first row.

    None: it cannot be, so that the run will end with it.
    """
    row = np.zeros(graph.layout.width)
    try:
        if plan is None:
            plan = graph.prepare(clock.step_ns)
        graph.initialize(clock.start_time, row)
    except CosimError:
        return plan, None
    return plan, row


def described_gains(graph: Graph, clock: Clock) -> tuple[LoopGain, ...]:
    """Return the gains of loops of a graph that shows what there is.

    Of what cannot run nothing does: it is not linearized, either.
    """
    row = None
    if LinearizedLoops.may_be_known(graph):
        _, row = _begun(graph, clock, None)
    if row is None:
        return LinearizedLoops(graph, clock).gains()
    return LinearizedLoops.of(graph, clock, row).gains()


def coupling_reports(
    experiment: Experiment, loops: LinearizedLoops, row: Vector | None
) -> list[CouplingReport]:
    """Return what is known of the loops, and what stands against their coupling.

    As they begin, then behind every action that changes components of loops, or their inputs. One
    that comes with a condition may never be performed, so it is only warned of.

    Parameters
    ----------
    experiment : Experiment
    loops : LinearizedLoops
        As the run begins.
    row : Vector or None
        The first one; None: it is not known, nor is anything behind actions.
    """
    scenario = experiment.scenario
    gains = dict(enumerate(loops.gains()))
    closed = {number: gain for number, gain in gains.items() if _is_closed(gain, scenario)}
    reports = [_report(("scenario", "step"), loops, closed)]
    if row is None:
        return reports
    beginning = _Changed(experiment, row, loops.linearized)
    now = beginning.copied()
    timed: dict[float, list[int]] = {}
    for number, action in scenario.actions.items():
        if action.at is not None:
            timed.setdefault(action.at, []).append(number)
    for at, numbers in sorted(timed.items()):
        changed: dict[str, int] = {}  # by component, the first action
        for number in numbers:
            names = now.apply(scenario.actions[number], nanoseconds(at))
            changed = {**dict.fromkeys(names, number), **changed}
        if changed:
            key = ("actions", min(changed.values()))
            rest = replace(loops, clock=replace(loops.clock, start_time=at))
            reports.append(now.report(key, f"after the action at {at} s", rest, changed))
    for number, action in scenario.actions.items():
        if action.when is not None:
            after = beginning.copied()
            names = after.apply(action, AT_CONDITION)
            if names:
                text = f"after the action when {action.when!r}, linearized at the start"
                found = after.report(("actions", number), text, loops, names)
                warnings = found.warnings + found.refusals
                reports.append(replace(found, refusals=(), warnings=warnings))
    return reports


def _is_closed(gain: LoopGain, scenario: Scenario) -> bool:
    """Return whether a loop is one without what is recorded, which reacts to nothing."""
    names = {name for name in gain.components if not scenario.specs[name].is_recorded}
    if len(names) == len(gain.components):
        return True
    return bool(find_cycle({name: scenario.drivers[name] & names for name in names}))


@dataclass
class _Changed:
    """The components of loops at some time, behind actions.

    Parameters
    ----------
    experiment : Experiment
    row : Vector
        The first one.
    linearized : mapping of component name to Linearized
    factors : dict of component name to Vector, shape (n_u,)
        That faults multiply inputs by; 1 where not named.
    faults : dict of (component name, element of its inputs) to str
        Those that have no linearization, in words; empty: there is none.
    """

    experiment: Experiment
    row: Vector
    linearized: Mapping[str, Linearized]
    factors: dict[str, Vector] = field(default_factory=dict)
    faults: dict[tuple[str, int], str] = field(default_factory=dict)

    def copied(self) -> _Changed:
        """Return one that goes on from here on its own."""
        return replace(self, factors=dict(self.factors), faults=dict(self.faults))

    def apply(self, action: ActionTable, time_ns: int) -> set[str]:
        """Go on behind an action; return the components of loops that it changes."""
        graph = self.experiment.graph
        loop_of: dict[str, set[str]] = {}
        for stage in graph.stages:
            if stage.is_loop:
                members = {member.name for member in stage.members}
                loop_of |= dict.fromkeys(members, members)
        names = {key.partition(".")[0] for key in action.set or {}}
        names.update(action.swap or {})
        names &= loop_of.keys()
        known = {name: own for name, own in self.linearized.items() if name not in names}
        for name in names:
            found = self._linearized(name, time_ns)
            if found is not None:
                known[name] = found
        self.linearized = known
        for port in map(Port.parse, action.signals):
            sources = components_driving(graph.connections, port.whole)
            is_inside = not sources.isdisjoint(loop_of.get(port.component, ()))
            if is_inside and self._fault(port, action):
                names.add(port.component)
        return names

    def _fault(self, port: Port, action: ActionTable) -> bool:
        """Go on behind what is done to an input; return whether that changes its loop.

        What is added to an input does not change what a loop makes of an error; what takes its
        place opens the loop, and is left out.
        """
        name = port.component
        end = self.experiment.graph.ports.input(port)
        first = end.columns.start - end.channel.inputs.start
        elements = range(first, first + end.size)
        before = self.factors.get(name, np.ones(end.channel.interface.n_u))
        factors = before.copy()
        factors[elements.start : elements.stop] = 1.0 if action.gain is None else action.gain
        self.factors[name] = factors
        effect = action.effects[0]
        opens_loop = action.drop is True or action.drop == 1.0  # no sample arrives any more
        is_fault = effect in NOT_LINEARIZED and not opens_loop
        fault = f"the {effect} of '{port}'" if is_fault else ""
        is_another = any(self.faults.get((name, element), "") != fault for element in elements)
        self.faults |= {(name, element): fault for element in elements}
        return is_another or bool((factors != before).any())

    def _linearized(self, name: str, time_ns: int) -> Linearized | None:
        """Linearize what comes in the place of a component; None: that is not known."""
        experiment = self.experiment
        action = experiment.settings.get((time_ns, name))
        if action is None or action.transfers:
            return None
        component = action.variants[name]
        t = experiment.clock.start_time
        u = self.row[experiment.graph.members[name].inputs]
        try:
            experiment.graph.prepare_variant(name, component, experiment.clock.step_ns, {})
            component.initialize(t, u)
            return linearized(component, t, u)
        except CosimError:  # the run will end with it
            return None

    def report(
        self, key: Key, action: str, loops: LinearizedLoops, names: Collection[str]
    ) -> CouplingReport:
        """Return what is known of the loops that an action changes, by components ``names``.

        The gain is not known where a fault is not in it.
        """
        scaled = dict(self.linearized)
        for name, factors in self.factors.items():
            if name in scaled:
                own = scaled[name]
                scaled[name] = replace(own, B=own.B * factors, D=own.D * factors)
        behind = replace(loops, linearized=scaled)
        gains = {}
        for number, gain in enumerate(behind.gains()):
            if not any(name in names for name in gain.components):
                continue
            gains[number] = replace(gain, action=action)
            faults: dict[str, None] = {}
            for name in gain.components:
                own_faults = [text for (of, _), text in self.faults.items() if of == name and text]
                faults |= dict.fromkeys(own_faults)
            if faults:
                reason = f"no linearization of {listing(list(faults))}"
                gains[number] = replace(gains[number], rho=None, rate=None, reason=reason)
        return _report(key, behind, gains)


# --- in words ---


def _report(key: Key, loops: LinearizedLoops, gains: Mapping[int, LoopGain]) -> CouplingReport:
    """Return what is known of some loops by their numbers."""
    refusals = []
    warnings = []
    for number, gain in gains.items():
        if gain.verdict == "refused":
            refusals.append(f"{_excess(gain)}, more than {REFUSED:g}{_way_out(loops, number)}")
        elif gain.verdict == "noted":
            warnings.append(_excess(gain))
        if gain.is_unstable:
            warnings.append(
                f"{_loop(gain)} is unstable with any coupling: pole at {gain.rate:+.4g} /s, errors "
                f"grow by {_growth(gain.own_exponent)} over {_span(gain)}"
            )
    return CouplingReport(key, tuple(gains.values()), tuple(refusals), tuple(warnings))


def _way_out(loops: LinearizedLoops, number: int) -> str:
    """Return the step and the couplings with which a loop would be fine; empty: none is known."""
    ways_out = []
    step_ns = loops.step_for(number)
    if step_ns is not None:
        ways_out.append(f"step = {step_value(step_ns)!r}")
    for coupling in loops.couplings_for(number):
        offer = f'coupling = "{coupling}"'
        if coupling == "newton" and loops.graph.iterations > 1:  # it takes as many as it needs
            offer += " with iterations = 1"
        ways_out.append(offer)
    first = ", ".join(ways_out[:-1])
    return f"; use {' or '.join(filter(None, (first, ways_out[-1])))}" if ways_out else ""


def _excess(gain: LoopGain) -> str:
    assert gain.rho is not None
    return (
        f"{_loop(gain)}: coupling '{gain.coupling}' amplifies an error by "
        f"{_number(gain.rho)} per {_step(gain)} of {gain.h:g} s (exact solution: {_own(gain)}), by "
        f"{_growth(gain.exponent)} over {_span(gain)}"
    )


def _step(gain: LoopGain) -> str:
    return "step" if gain.parts == 1 else "substep"


def _loop(gain: LoopGain) -> str:
    text = f"the loop of {listing(gain.components)}"
    return f"{gain.action}, {text}" if gain.action else text


def _span(gain: LoopGain) -> str:
    return "the rest of the run" if gain.action else "the run"


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


def gain_text(gain: LoopGain) -> str:
    """Return the gain of a loop in words."""
    if gain.unknown:
        return f"unknown: no linearization of {listing(gain.unknown)}"
    if gain.rho is None:
        return f"unknown: {gain.reason}"
    step = "step" if gain.parts == 1 else f"smallest substep allowed, {gain.h:g} s"
    text = f"{_number(gain.rho)} per {step} (exact solution: {_own(gain)})"
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
