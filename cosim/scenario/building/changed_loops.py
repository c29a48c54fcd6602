"""The loops of a scenario behind actions that change their components: parameters set, swaps.

A component of cosim's own with other parameters is linearized where the run begins, as the one in
whose place it comes: its state there is not known before the run. What an FMU is with parameters
that are set in it, or in the place of another component, is not known either.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from cosim.arrays import Vector
from cosim.core.clock import nanoseconds
from cosim.core.contracts import linearized
from cosim.core.gain.loop_gain import LinearizedLoops
from cosim.core.linearization import Linearized
from cosim.core.stepping.actions import AT_CONDITION
from cosim.errors import CosimError
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.document.problems import Key
from cosim.scenario.document.schema import ActionTable


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
    """

    key: Key
    action: str
    is_certain: bool
    components: frozenset[str]
    loops: LinearizedLoops


def changed_loops(
    experiment: Experiment, loops: LinearizedLoops, row: Vector
) -> Iterator[ChangedLoops]:
    """Yield the loops behind every action that changes components of loops.

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
    now = loops
    for at, numbers in _by_instant(actions).items():
        names = changes.in_loops(actions[number] for number in numbers)
        if names:
            now = changes.made(now, names, nanoseconds(at))
            behind = replace(now, clock=replace(now.clock, start_time=at))
            key = ("actions", numbers[0])
            yield ChangedLoops(key, f"behind the action at {at} s", True, names, behind)
    for number, action in actions.items():
        names = changes.in_loops([action])
        if action.when is not None and names:
            behind = changes.made(loops, names, AT_CONDITION)
            text = f"behind the action when {action.when!r}, taken as at the start"
            yield ChangedLoops(("actions", number), text, False, names, behind)


def _by_instant(actions: Mapping[int, ActionTable]) -> dict[float, list[int]]:
    """Return the numbers of actions by their instants [s], in the order of time."""
    numbers: dict[float, list[int]] = {}
    for number, action in actions.items():
        if action.at is not None:
            numbers.setdefault(action.at, []).append(number)
    return dict(sorted(numbers.items()))


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
        self._in_loops: set[str] = set()
        for stage in experiment.graph.stages:
            if stage.is_loop:
                self._in_loops.update(member.name for member in stage.members)

    def in_loops(self, actions: Iterable[ActionTable]) -> frozenset[str]:
        """Return the components of loops that actions change."""
        names: set[str] = set()
        for action in actions:
            names.update(key.partition(".")[0] for key in action.set or {})
            names.update(action.swap or {})
        return frozenset(names & self._in_loops)

    def made(self, loops: LinearizedLoops, names: Collection[str], time_ns: int) -> LinearizedLoops:
        """Return loops with other components in the places of some."""
        linearizations = dict(loops.linearized)
        for name in names:
            linearizations.pop(name, None)
            found = self._linearized(name, time_ns)
            if found is not None:
                linearizations[name] = found
        return replace(loops, linearized=linearizations)

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
