"""The loops of a scenario behind actions: parameters set, swaps, inputs with another gain.

A component of cosim's own with other parameters is linearized where the run begins, as the one in
whose place it comes: its state there is not known before the run. What an FMU is with parameters
that are set in it, or in the place of another component, is not known either.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cosim.arrays import Vector
from cosim.core.clock import nanoseconds
from cosim.core.contracts import linearized
from cosim.core.gain.loop_gain import LinearizedLoops
from cosim.core.linearization import Linearized
from cosim.core.port import Port
from cosim.core.stepping.actions import AT_CONDITION
from cosim.errors import CosimError
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.document.places import Key
from cosim.scenario.document.schema import ActionTable

NOT_LINEARIZED: Final = ("delay", "drop")  # actions on an input that leave the loop closed


@dataclass(frozen=True, slots=True)
class ChangedLoops:
    """The loops of a graph behind an action.

    Parameters
    ----------
    key : Key
        Of the action in the file.
    action : str
        When they are so, in words.
    is_certain : bool
        Whether the action is performed, and when, is known.
    components : frozenset of str
        That it changes.
    loops : LinearizedLoops
        Over the rest of the run; over all of it where the instant is not known.
    not_linearized : mapping of component name to tuple of str
        Faults of its inputs, in words, that the loops do without.
    """

    key: Key
    action: str
    is_certain: bool
    components: frozenset[str]
    loops: LinearizedLoops
    not_linearized: Mapping[str, tuple[str, ...]]


def changed_loops(
    experiment: Experiment, loops: LinearizedLoops, row: Vector
) -> Iterator[ChangedLoops]:
    """Yield the loops behind every action that changes components of loops, or their inputs.

    Parameters
    ----------
    experiment : Experiment
    loops : LinearizedLoops
        As the run begins.
    row : Vector
        The first one.
    """
    actions = experiment.scenario.actions
    changes = _Changes(experiment, row)
    beginning = _Components(loops.linearized, {}, {})
    now = beginning
    for at, numbers in _by_instant(actions).items():
        changed: dict[str, int] = {}  # by component, the first action
        for number in numbers:
            now, names = changes.of(actions[number], now, nanoseconds(at))
            changed = {**dict.fromkeys(names, number), **changed}
        if changed:
            clock = replace(loops.clock, start_time=at)
            behind = replace(loops, clock=clock, linearized=now.scaled())
            key = ("actions", min(changed.values()))
            names = frozenset(changed)
            text = f"after the action at {at} s"
            yield ChangedLoops(key, text, True, names, behind, now.not_linearized)
    for number, action in actions.items():
        if action.when is None:
            continue
        after, names = changes.of(action, beginning, AT_CONDITION)
        if names:
            behind = replace(loops, linearized=after.scaled())
            text = f"after the action when {action.when!r}, linearized at the start"
            key = ("actions", number)
            yield ChangedLoops(key, text, False, names, behind, after.not_linearized)


def _by_instant(actions: Mapping[int, ActionTable]) -> dict[float, list[int]]:
    """Return the numbers of actions by their instants [s], in the order of time."""
    numbers: dict[float, list[int]] = {}
    for number, action in actions.items():
        if action.at is not None:
            numbers.setdefault(action.at, []).append(number)
    return dict(sorted(numbers.items()))


@dataclass(frozen=True, slots=True)
class _Components:
    """The components of loops at some time.

    Parameters
    ----------
    linearized : mapping of component name to Linearized
    factors : mapping of component name to Vector, shape (n_u,)
        That faults multiply inputs by; 1 where not named.
    faults : mapping of (component name, element of its inputs) to str
        Those that have no linearization, in words.
    """

    linearized: Mapping[str, Linearized]
    factors: Mapping[str, Vector]
    faults: Mapping[tuple[str, int], str]

    @property
    def not_linearized(self) -> dict[str, tuple[str, ...]]:
        """The faults without a linearization, by component."""
        by_component: dict[str, dict[str, None]] = {}
        for (name, _), text in self.faults.items():
            by_component.setdefault(name, {})[text] = None
        return {name: tuple(texts) for name, texts in by_component.items()}

    def scaled(self) -> dict[str, Linearized]:
        """Return them with their inputs multiplied."""
        scaled = dict(self.linearized)
        for name, factors in self.factors.items():
            own = scaled.get(name)
            if own is not None:
                scaled[name] = replace(own, B=own.B * factors, D=own.D * factors)
        return scaled


class _Changes:
    """What actions make of the components of loops.

    Parameters
    ----------
    experiment : Experiment
    row : Vector
        The first one.
    """

    def __init__(self, experiment: Experiment, row: Vector) -> None:
        self._experiment = experiment
        self._row = row
        self._loops: dict[str, frozenset[str]] = {}
        for stage in experiment.graph.stages:
            if stage.is_loop:
                names = frozenset(member.name for member in stage.members)
                self._loops |= dict.fromkeys(names, names)

    def of(
        self, action: ActionTable, before: _Components, time_ns: int
    ) -> tuple[_Components, frozenset[str]]:
        """Return the components behind an action, and the names of those that it changes."""
        names = {key.partition(".")[0] for key in action.set or {}}
        names.update(action.swap or {})
        names &= self._loops.keys()
        linearizations = dict(before.linearized)
        for name in names:
            linearizations.pop(name, None)
            found = self._linearized(name, time_ns)
            if found is not None:
                linearizations[name] = found
        all_factors = dict(before.factors)
        all_faults = dict(before.faults)
        for signal in action.signals:
            port = Port.parse(signal)
            if not self._is_inside(port):
                continue
            elements = self._elements(port)
            own = all_factors.get(port.component)
            factors = self._factors(port.component, elements, action, own)
            if own is None or (factors != own).any():
                all_factors[port.component] = factors
            if (factors != (1.0 if own is None else own)).any():
                names.add(port.component)
            if _set_fault(all_faults, port, elements, action):
                names.add(port.component)
        return _Components(linearizations, all_factors, all_faults), frozenset(names)

    def _is_inside(self, port: Port) -> bool:
        """Return whether an input is driven from the loop that it is in."""
        loop = self._loops.get(port.component, frozenset())
        for to, connection in self._experiment.graph.connections.items():
            if to.whole == port.whole and any(s.component in loop for s in connection.sources):
                return True
        return False

    def _elements(self, port: Port) -> range:
        """Return which of the inputs of its component a port is."""
        end = self._experiment.graph.ports.input(port)
        first = end.columns.start - end.channel.inputs.start
        return range(first, first + end.size)

    def _factors(
        self, name: str, elements: range, action: ActionTable, before: Vector | None
    ) -> Vector:
        """Return the factors of the inputs of a component, of which an action is about some.

        What is added to an input does not change what a loop makes of an error; what takes its
        place opens the loop, and is left out.
        """
        n_u = self._experiment.graph.layout[name].interface.n_u
        factors = np.ones(n_u) if before is None else before.copy()
        factors[elements.start : elements.stop] = 1.0 if action.gain is None else action.gain
        return factors

    def _linearized(self, name: str, time_ns: int) -> Linearized | None:
        """Linearize what comes in the place of a component; None: that is not known."""
        experiment = self._experiment
        action = experiment.settings.get((time_ns, name))
        if action is None or action.transfers:
            return None
        component = action.variants[name]
        t = experiment.clock.start_time
        u = self._row[experiment.graph.members[name].inputs]
        step_ns = experiment.clock.step_ns
        try:
            experiment.graph.prepare_variant(name, component, step_ns, {})
            component.initialize(t, u)
            return linearized(component, t, u)
        except CosimError:  # the run will end with it
            return None


def _set_fault(
    faults: dict[tuple[str, int], str], port: Port, elements: range, action: ActionTable
) -> bool:
    """Set what an action makes of faults without a linearization; return whether that changed."""
    before = dict(faults)
    effect = action.effects[0]
    opens_loop = action.drop is True or action.drop == 1.0  # no sample arrives any more
    for element in elements:
        key = (port.component, element)
        if effect in NOT_LINEARIZED and not opens_loop:
            faults[key] = f"the {effect} of '{port}'"
        else:
            faults.pop(key, None)
    return faults != before
