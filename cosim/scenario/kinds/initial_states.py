"""Initial states as they are given, and what consistency makes of them.

Of `E x' = A x + Bu u + Bd delta` only E x(0) is free: the algebraic equations have the rest. The
same holds of an estimate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cosim.arrays import Vector
from cosim.core.graph import Graph
from cosim.scenario.record import StateChange
from cosim.theory.plants.descriptor import UserCoordinates

ROUNDINGS: Final = 64.0  # of a term, that no one needs to hear of
MOST_ENTRIES: Final = 12  # that a message lists


@dataclass(frozen=True, eq=False)
class GivenStates:
    """Initial states x0 that a table gives; the run has ``X R x0 + Xu u + Xd delta``.

    ``coordinates`` are X, Xu, Xd and R; x is the signal ``x`` of the component.
    """

    values: Vector
    coordinates: UserCoordinates

    def changes(self, *, u: Vector, delta: Vector, x: Vector) -> list[StateChange]:
        """Return the entries of x(0) that differ from x0 by more than rounding.

        An entry that has no value yet is left out.
        """
        coordinates = self.coordinates
        of_states = np.abs(coordinates.X) @ (np.abs(coordinates.R) @ np.abs(self.values))
        of_u = np.abs(coordinates.Xu) @ np.abs(u)
        known_delta = np.where(np.isnan(delta), 0.0, delta)  # a window has no value at first
        of_delta = np.abs(coordinates.Xd) @ np.abs(known_delta)
        terms = np.abs(self.values) + of_states + of_u + of_delta
        rounding = ROUNDINGS * np.finfo(np.float64).eps * terms
        changed = np.flatnonzero(np.abs(x - self.values) > rounding)
        return [
            StateChange(entry=f"x[{i}]", before=float(self.values[i]), after=float(x[i]))
            for i in changed.tolist()
        ]


def changed_states(
    graph: Graph, given: Mapping[str, GivenStates], row: Vector
) -> dict[str, list[StateChange]]:
    """Return what the first row of a run changes of the initial states, by component.

    A component of a partial log may lack a signal that this follows from; it is left out.
    """
    changes = {}
    for name, states in given.items():
        columns = graph.layout[name].signal_columns
        signals = {signal: row[own] for signal, own in columns.items()}
        coordinates = states.coordinates
        n_u = coordinates.Xu.shape[1]
        n_delta = coordinates.Xd.shape[1]
        sizes = {"x": len(states.values), "u": n_u, "delta": n_delta}
        if any(size and signal not in signals for signal, size in sizes.items()):
            continue
        u = signals.get("u", row[:0])[:n_u]
        changed = states.changes(u=u, delta=signals.get("delta", row[:0]), x=signals["x"])
        if changed:
            changes[name] = changed
    return changes


def change_text(changes: Sequence[StateChange]) -> str:
    """Return in words what became of initial states."""
    shown = []
    for change in changes[:MOST_ENTRIES]:
        shown.append(f"{change.entry} = {change.before:.6g} is {change.after:.6g}")
    more = len(changes) - len(shown)
    if more:
        shown.append(f"and {more} more")
    return (
        "x0 does not fulfill the algebraic equations with u and delta at the start: E x0 is kept, "
        f"and {', '.join(shown)}"
    )
