"""States of a whole graph: they are saved, pickled, and restored."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from cosim.arrays import Vector
from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.recording import Plan
from cosim.core.stages.overrides import SavedOverrides
from cosim.errors import UsageError, listing


@dataclass(frozen=True, eq=False)
class SimulationState:
    """The state of a simulation at a communication point; it can be pickled.

    Parameters
    ----------
    graph : str
        Hash of the graph that it is a state of.
    index : int
        Number of the communication point.
    row : Vector, shape (width,)
        All signals there, behind the jumps.
    overrides : mapping of component name to SavedOverrides
        Of their inputs, where there are any.
    components : mapping of component name to its state
        What delays and filters hold, the states of random generators, and so on.
    kept_by_loops : tuple of Vector
        What loops keep from step to step beside their components.
    conditions : mapping of condition to int
        For how many rows each has held, where the run looks for any.
    performed : tuple of int
        Numbers of the actions at conditions that were performed.
    origin : object
        The simulation in whose memory component states may lie; not pickled.
    """

    graph: str
    index: int
    row: Vector
    overrides: Mapping[str, SavedOverrides]
    components: Mapping[str, Any]
    kept_by_loops: tuple[Vector, ...]
    conditions: Mapping[str, int]
    performed: tuple[int, ...]
    origin: object = field(default=None, repr=False)

    def __reduce__(self) -> tuple[Any, ...]:
        self.check_portable()
        values = (self.graph, self.index, self.row, self.overrides, self.components)
        return SimulationState, (*values, self.kept_by_loops, self.conditions, self.performed)

    def check_portable(self) -> None:
        """Check that every component's state can leave the simulation that it was taken of.

        Raises
        ------
        UsageError
            If one lies in the memory of its component, as that of an FMU does.
        """
        for name, state in self.components.items():
            try:
                pickle.dumps(state)
            except Exception as error:  # a state is the component's own, and may raise anything
                raise UsageError(
                    f"state: that of {name!r} cannot leave its simulation, as it cannot be "
                    f"pickled: {error}"
                ) from error


class States:
    """Saves and restores the components of a graph, and the overrides of their inputs.

    Parameters
    ----------
    graph : Graph
    clock : Clock
    plan : Plan
    identity : str or None
        What the values of the graph are known by; None: by its designs.
    """

    def __init__(self, graph: Graph, clock: Clock, plan: Plan, identity: str | None) -> None:
        self._graph = graph
        self._clock = clock
        self._plan = plan
        self._identity = identity

    @cached_property
    def graph_hash(self) -> str:
        """What states of this graph are known by."""
        return graph_hash(self._graph, self._clock, self._plan, self._identity)

    def check_rollback(self) -> None:
        """Check that every component can go back.

        Raises
        ------
        UsageError
            If one cannot.
        """
        names = []
        for name, member in self._graph.members.items():
            if not member.channel.interface.rollback:
                names.append(name)
        if names:
            raise UsageError(
                f"state: {listing(names)} cannot go back (rollback is not declared); call reset() "
                "and repeat the steps"
            )

    def save(
        self,
        index: int,
        row: Vector,
        conditions: Mapping[str, int],
        *,
        performed: tuple[int, ...],
        origin: object,
    ) -> SimulationState:
        """Save the state at a communication point; ``origin`` is the simulation.

        Raises
        ------
        RunError
            If a component raises what is no error of cosim.
        """
        overrides = {}
        components = {}
        for name, member in self._graph.members.items():
            if member.overrides:
                overrides[name] = member.overrides.save()
            components[name] = member.component.save()
        row = row.copy()
        row.flags.writeable = False
        kept_by_loops = tuple(kept.memory.copy() for kept in self._graph.kept_by_loops)
        values = (index, row, overrides, components, kept_by_loops, conditions, performed)
        return SimulationState(self.graph_hash, *values, origin)

    def check(self, state: SimulationState, simulation: object) -> None:
        """Check that a state can be restored in a simulation.

        Raises
        ------
        UsageError
            If it is that of another graph, behind the stop, or cannot leave its simulation.
        """
        if state.graph != self.graph_hash:
            raise UsageError(
                f"state: expected a state of this graph ({self.graph_hash[:12]}: same scenario, "
                f"same values), got one of another graph ({state.graph[:12]})"
            )
        if state.index > self._clock.steps:
            time = self._clock.grid.stamp(state.index) / 1e9
            raise UsageError(
                f"state: expected a time before the stop at {self._clock.stop} s, got {time} s; "
                "set a later stop"
            )
        if state.origin is not simulation:
            state.check_portable()

    def restore(self, state: SimulationState) -> None:
        """Put a state that was checked back into the components.

        Raises
        ------
        RunError
            If a component raises what is no error of cosim.
        """
        for kept, memory in zip(self._graph.kept_by_loops, state.kept_by_loops, strict=True):
            kept.memory[:] = memory
        for name, member in self._graph.members.items():
            member.component.restore(state.components[name])
            member.overrides.clear()
            if name in state.overrides:
                member.overrides.restore(state.overrides[name])


def graph_hash(graph: Graph, clock: Clock, plan: Plan, identity: str | None) -> str:
    """Return the hash of a graph on a clock.

    It covers the structure, and ``identity``, which stands for the values; None: the designs do.
    """
    digest = hashlib.sha256()
    structure = (graph.layout, graph.input_interpolation, plan.schedule)
    times = (clock.start_ns, clock.step_ns)
    digest.update(repr((structure, times, identity)).encode())
    for to, connection in graph.connections.items():
        digest.update(repr((to, connection.sources, connection.offset, connection.unit)).encode())
        digest.update(connection.matrix.tobytes())
    if identity is None:
        for name, design in plan.designs.items():
            for key, array in design.items():
                digest.update(repr((name, key, array.shape)).encode())
                digest.update(array.tobytes())
    return digest.hexdigest()
