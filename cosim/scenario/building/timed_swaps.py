"""Components that are swapped in a run, by FMUs that go on from the same continuous states.

Both are for model exchange, where continuous states have names: they are handed over by these. What
else an FMU remembers, its discrete states, begins anew, with an event.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cosim.blocks.declared import Declared
from cosim.core.contracts import Component
from cosim.core.signals import Interface
from cosim.core.stepping.actions import Swap
from cosim.errors import UsageError, listing
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.document.swaps import component_table
from cosim.scenario.kinds import KINDS
from cosim.scenario.kinds.base import BuildContext

if TYPE_CHECKING:
    from cosim.fmi.driving.model_exchange import ModelExchange


@dataclass(frozen=True, slots=True)
class StateTransfer:
    """Hands continuous states over by their names.

    Parameters
    ----------
    source, target : ModelExchange
    """

    source: ModelExchange
    target: ModelExchange

    def take(self) -> dict[str, float]:
        """Return the states of the source by name."""
        values = self.source.states().tolist()
        return dict(zip(self.source.state_names, values, strict=True))

    def give(self, state: Mapping[str, float]) -> None:
        """Set the states of the target."""
        x = np.array([state[name] for name in self.target.state_names])
        self.target.continue_from(x)


class SwapBuilder:
    """Makes actions of the components that are swapped in a run.

    Parameters
    ----------
    scenario : Scenario
    context : BuildContext
        In which the components of the run were built; takes what is opened.
    components : mapping of name to Component
    """

    def __init__(
        self,
        scenario: Scenario,
        context: BuildContext,
        components: Mapping[str, Component],
    ) -> None:
        self._scenario = scenario
        self._context = context
        self._components = components

    def action(self, name: str, path: str) -> Swap:
        """Return what swaps a component.

        Raises
        ------
        UsageError
            If states cannot be handed over, or the FMU does not fit into its place.
        CosimError
            If the FMU cannot be opened.
        """
        source = self._context.model_exchange.get(name)
        if source is None or not source.state_names:
            raise UsageError(
                f"the state of {name!r} cannot be transferred: it has no named continuous states; "
                "expected a plant, or a model exchange FMU (FMI 2 or 3)"
            )
        table = component_table(name, path)
        spec = KINDS[table["kind"]].model_validate(table)
        scenario = replace(self._scenario, specs={**self._scenario.specs, name: spec})
        context = self._context.beside(scenario, name)
        component = spec.build(name, context)
        target = context.model_exchange.get(name)
        if target is None:
            raise UsageError(
                f"the state of {name!r} cannot be transferred to {path}, which has no named "
                "continuous states; expected a model exchange FMU"
            )
        _check_states(name, path, source, target)
        interface = self._components[name].interface
        _check_interface(name, path, interface, component.interface)
        self._context.fmus[f"{name} ({path})"] = context.fmus[name]
        return Swap(name, Declared(component, interface), path, StateTransfer(source, target))


def _check_states(name: str, path: str, source: ModelExchange, target: ModelExchange) -> None:
    """Check that two components have the same states.

    Raises
    ------
    UsageError
        If they have not; names those of both.
    """
    if sorted(source.state_names) != sorted(target.state_names):
        found = listing(target.state_names) or "none"
        raise UsageError(
            f"the state of {name!r} cannot be transferred to {path}: expected the states "
            f"{listing(source.state_names)}, got {found}"
        )


def _check_interface(name: str, path: str, place: Interface, other: Interface) -> None:
    """Check that a component fits into the place of another one, as it is wired and ordered.

    Raises
    ------
    UsageError
        If it does not.
    """
    for kind, needed_signals, found_signals in (
        ("inputs", place.inputs, other.inputs),
        ("outputs", place.outputs, other.outputs),
    ):
        needed = [(signal.name, signal.size, signal.type) for signal in needed_signals]
        if needed != [(signal.name, signal.size, signal.type) for signal in found_signals]:
            names = listing([signal.name for signal in needed_signals])
            raise UsageError(
                f"{path} cannot replace {name!r}: expected the {kind} {names}, with the same "
                "sizes and types, in this order"
            )
    for output in place.outputs:
        more = set(other.feeds(output.name)) - set(place.feeds(output.name))
        if more:
            raise UsageError(
                f"{path} cannot replace {name!r}: {output.name} has direct feedthrough from "
                f"{listing(sorted(more))}, which the execution order does not allow for"
            )
    if place.rollback and not other.rollback:
        raise UsageError(
            f"{path} cannot save its state, but {name!r} can; expected an FMU with the capability "
            "canGetAndSetFMUstate"
        )
