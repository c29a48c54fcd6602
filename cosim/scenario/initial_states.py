"""Initial states of a plant as they are given, and what consistency with its inputs makes of them.

Of `E x' = A x + B v`, v = (u, delta), only E x(0) is free: the algebraic equations have the rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cosim.arrays import Vector
from cosim.core.graph import Graph
from cosim.scenario.recorded_metadata import StateChangeRecord
from cosim.theory.descriptor import UserCoordinates

INITIAL_STATES: Final = "initial_states"  # the key of the results
ROUNDINGS: Final = 64.0  # of a term, that no one needs to hear of
MOST_ENTRIES: Final = 12  # that a message lists


@dataclass(frozen=True, eq=False)
class GivenStates:
    """Initial states that a table gives, ``x = X (R x0) + Xv v``.

    Parameters
    ----------
    signal : str
        The output that has them.
    values : Vector, shape (n,)
        x0.
    coordinates : UserCoordinates
    """

    signal: str
    values: Vector
    coordinates: UserCoordinates

    def changes(self, v: Vector, x: Vector) -> list[StateChangeRecord]:
        """Return the entries of x(0) that differ from x0 by more than rounding."""
        coordinates = self.coordinates
        of_v = np.abs(np.hstack([coordinates.Xu, coordinates.Xd]))
        of_states = np.abs(coordinates.X) @ (np.abs(coordinates.R) @ np.abs(self.values))
        terms = np.abs(self.values) + of_states + of_v @ np.abs(v)
        rounding = ROUNDINGS * np.finfo(np.float64).eps * terms
        changed = np.flatnonzero(np.abs(x - self.values) > rounding)
        return [
            StateChangeRecord(
                entry=f"{self.signal}[{i}]", before=float(self.values[i]), after=float(x[i])
            )
            for i in changed.tolist()
        ]


def changed_states(
    graph: Graph, given: Mapping[str, GivenStates], row: Vector
) -> dict[str, list[StateChangeRecord]]:
    """Return what the first row of a run changes of the initial states, by component."""
    changes = {}
    for name, states in given.items():
        channel = graph.layout[name]
        columns = channel.interface.output_columns()[states.signal]
        begin = channel.outputs.start
        x = row[begin + columns.start : begin + columns.stop]
        changed = states.changes(row[channel.inputs], x)
        if changed:
            changes[name] = changed
    return changes


def change_text(changes: Sequence[StateChangeRecord]) -> str:
    """Return in words what became of initial states."""
    shown = [f"{one.entry} = {one.before:.6g} is {one.after:.6g}" for one in changes[:MOST_ENTRIES]]
    more = len(changes) - len(shown)
    if more:
        shown.append(f"and {more} more")
    return (
        "x0 does not fulfill the algebraic equations with u and delta at the start: E x0 is kept, "
        f"and {', '.join(shown)}"
    )
