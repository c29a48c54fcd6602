"""What only some kinds can do: a kind derives from those it has, and is asked where it has them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.core.graph import Graph
from cosim.core.signals import Interface
from cosim.errors import listing
from cosim.instants import StepNs
from cosim.scenario.kinds.base import BuildContext
from cosim.scenario.record import StateChange
from cosim.theory.plants.descriptor import UserCoordinates

if TYPE_CHECKING:
    from cosim.blocks.renaming import Renaming
    from cosim.fmi.description import Description, InterfaceType

ROUNDINGS: Final = 64.0  # of a term of an initial state, that no one needs to hear of
MOST_ENTRIES: Final = 12  # that a message lists


class Advising(ABC):
    """Its result may be right but costly or poor."""

    @abstractmethod
    def advice(self, name: str, context: BuildContext, held: Mapping[str, bool]) -> list[str]:
        """Return warnings about that.

        Parameters
        ----------
        name : str
            Of the component.
        context : BuildContext
            That it was built in.
        held : mapping of input name to bool
            Whether the input keeps its value over a communication step.
        """


class DecidedByStep(ABC):
    """Keys of its table follow from the communication step, where they are not given."""

    @abstractmethod
    def decided(
        self, table: Mapping[str, Any], metadata: Mapping[str, Any], step_ns: StepNs
    ) -> Mapping[str, Any]:
        """Return the table with what the communication step has decided.

        With a smaller step it is the same then: an instant of a communication point, for example.

        Parameters
        ----------
        table : Mapping
            Of the component, as the scenario has it.
        metadata : Mapping
            That it has recorded while it was built.
        step_ns : int
            Communication step [ns] that it was built with.
        """


class HasSamples(ABC):
    """Its outputs may have values that are no new samples; the samples are outputs beside them."""

    @abstractmethod
    def samples_of(self, output: str) -> str | None:
        """Return the output with another output's samples at times of their own; None: none."""

    @property
    @abstractmethod
    def samples_at_points(self) -> bool:
        """Whether samples are of communication points, at most one of each."""

    @abstractmethod
    def most_in_a_step(self, name: str, context: BuildContext) -> int:
        """Return for how many samples in a communication step there is a place; 0: none."""

    def late_steps(self, context: BuildContext) -> int:
        """Return how many communication steps after its instant a sample may come."""
        return 0


class RenamesMore(ABC):
    """Further outputs take part where a map renames one."""

    @abstractmethod
    def renamings(self, interface: Interface, given: Sequence[Renaming]) -> Sequence[Renaming]:
        """Return the renamings of a swap, and those that follow from them.

        Parameters
        ----------
        interface : Interface
            Of the component.
        given : sequence of Renaming
        """


@dataclass(frozen=True, eq=False)
class GivenStates:
    """Initial states x0 that a table gives; the run has ``X R x0 + Xu u + Xd delta``.

    Of `E x' = A x + Bu u + Bd delta` only E x(0) is free: the algebraic equations have the rest.
    The same holds of an estimate. ``coordinates`` are X, Xu, Xd and R; x is the signal ``x`` of the
    component.
    """

    values: Vector
    coordinates: UserCoordinates

    def changes(self, signals: Mapping[str, Vector]) -> list[StateChange]:
        """Return the entries of x(0) that differ from x0 by more than rounding.

        An entry that has no value yet is left out. None, where a signal lacks that this follows
        from, as in a partial log.
        """
        maps = self.coordinates
        n_u = maps.Xu.shape[1]
        sizes = {"x": len(maps.X), "u": n_u, "delta": maps.Xd.shape[1]}
        if any(size and signal not in signals for signal, size in sizes.items()):
            return []
        u = signals["u"][:n_u] if n_u else np.zeros(0)
        delta = signals.get("delta", u[:0])
        delta = np.where(np.isnan(delta), 0.0, delta)  # a window has no value at first
        x = signals["x"]
        of_states = np.abs(maps.X) @ (np.abs(maps.R) @ np.abs(self.values))
        of_inputs = np.abs(maps.Xu) @ np.abs(u) + np.abs(maps.Xd) @ np.abs(delta)
        terms = np.abs(self.values) + of_states + of_inputs
        rounding = ROUNDINGS * np.finfo(np.float64).eps * terms
        changed = np.flatnonzero(np.abs(x - self.values) > rounding)
        return [
            StateChange(entry=f"x[{i}]", before=float(self.values[i]), after=float(x[i]))
            for i in changed.tolist()
        ]


def changed_states(
    graph: Graph, given: Mapping[str, GivenStates], row: Vector
) -> dict[str, list[StateChange]]:
    """Return what the first row of a run changes of the initial states, by component."""
    changes = {}
    for name, states in given.items():
        columns = graph.layout[name].signal_columns
        changed = states.changes({signal: row[own] for signal, own in columns.items()})
        if changed:
            changes[name] = changed
    return changes


def change_text(changes: Sequence[StateChange]) -> str:
    """Return in words what became of initial states."""
    shown = [f"{one.entry} = {one.before:.6g} is {one.after:.6g}" for one in changes]
    return (
        "x0 does not fulfill the algebraic equations with u and delta at the start: E x0 is kept, "
        f"and {listing(shown, MOST_ENTRIES)}"
    )


class HasGivenStates(ABC):
    """It has initial states of which a run may keep a part only."""

    @abstractmethod
    def given_states(self, name: str, context: BuildContext) -> GivenStates | None:
        """Return these; None: there are none."""


class HasDescription(ABC):
    """It drives an instance of FMI."""

    @abstractmethod
    def description(self, name: str, context: BuildContext) -> tuple[InterfaceType, Description]:
        """Return interface type and description of the instance."""
