"""Faults by kinds and parameters; those that change from one communication point to the next.

Gain and value of an element are fixed from one point to the next, so that a graph with faults that
vary advances step by step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

from cosim.arrays import Vector
from cosim.core.graph import Graph
from cosim.core.signals import LARGEST_WHOLE, FaultKind, Signal
from cosim.core.stages.faults import (
    DelayFault,
    DriftFault,
    DropFault,
    Fault,
    FaultInstant,
    FreezeFault,
    GainFault,
    NoiseFault,
    OffsetFault,
)
from cosim.core.stages.member import Member
from cosim.core.structure.ports import ConnectionEnd
from cosim.errors import GraphError, nearest

PARAMETERS: Final[dict[str, tuple[str, ...]]] = {
    "freeze": (),
    "offset": ("offset",),
    "gain": ("gain",),
    "drift": ("rate",),
    "noise": ("deviation", "seed"),
    "drop": ("probability", "seed"),
    "delay": ("steps",),
}


def faults_of(end: ConnectionEnd, kind: FaultKind, parameters: Sequence[float]) -> list[Fault]:
    """Return the faults of the elements of an input.

    Parameters
    ----------
    end : ConnectionEnd
        The input, or elements of it.
    kind : FaultKind
    parameters : sequence of float
        Of the fault of every element, one behind the other.

    Raises
    ------
    GraphError
        If there is no such kind, it has other parameters, or the signal cannot have it.
    """
    names = PARAMETERS.get(kind)
    if names is None:
        raise GraphError(f"there is no fault {kind!r}; {nearest(kind, PARAMETERS)}")
    each = len(names)
    if len(parameters) != each * end.size:
        needed = ", ".join(names) or "none"
        raise GraphError(
            f"{kind}: expected for each of {end.size} elements: {needed}; got {len(parameters)} "
            "parameters"
        )
    faults = []
    for number in range(end.size):
        values = dict(zip(names, parameters[each * number :], strict=False))
        _check_parameters(kind, values)
        _check_type(kind, values, end.signal)
        faults.append(_fault_of(kind, values, end.elements.start + number, end.signal))
    return faults


def _fault_of(
    kind: FaultKind, parameters: Mapping[str, float], element: int, signal: Signal
) -> Fault:
    match kind:
        case "freeze":
            return FreezeFault()
        case "offset":
            return OffsetFault(parameters["offset"])
        case "gain":
            return GainFault(parameters["gain"])
        case "drift":
            return DriftFault(parameters["rate"])
        case "noise":
            return NoiseFault(parameters["deviation"], int(parameters["seed"]), element)
        case "drop":
            seed = int(parameters["seed"])
            return DropFault(parameters["probability"], seed, element, signal.optional)
        case "delay":
            return DelayFault(int(parameters["steps"]))


def _check_parameters(kind: str, parameters: Mapping[str, float]) -> None:
    for name, value in parameters.items():
        if not math.isfinite(value):
            raise GraphError(f"{kind}: {name}: expected a finite number, got {value}")
    deviation = parameters.get("deviation", 0.0)
    if deviation < 0.0:
        raise GraphError(f"noise: expected a standard deviation >= 0, got {deviation}")
    probability = parameters.get("probability", 1.0)
    if not 0.0 < probability <= 1.0:
        raise GraphError(f"drop: expected a probability > 0 and <= 1, got {probability}")
    for name, least in (("seed", 0), ("steps", 1)):
        value = parameters.get(name, 1.0)
        if value != math.floor(value) or not least <= value <= LARGEST_WHOLE:
            raise GraphError(f"{kind}: {name}: expected an integer >= {least}, got {value}")


def _check_type(kind: str, parameters: Mapping[str, float], signal: Signal) -> None:
    """Check that values of a signal stay what its type has."""
    keeps = kind in ("freeze", "drop", "delay")
    factor = parameters.get("offset", parameters.get("gain", 0.5))
    is_whole = signal.type == "integer" and factor == math.floor(factor)
    if signal.type == "real" or keeps or is_whole:
        return
    article = "Boolean" if signal.type == "boolean" else "an integer"
    ways = "an integer offset or gain, " if signal.type == "integer" else ""
    raise GraphError(
        f"{kind}: '{signal.name}' is {article}; use {ways}override, freeze, drop or delay"
    )


class VaryingFaults:
    """The members of a graph with such faults.

    Parameters
    ----------
    graph : Graph
    h : float
        Communication step [s].
    """

    def __init__(self, graph: Graph, h: float) -> None:
        self._graph = graph
        self._h = h
        self._members: list[Member] = []

    @property
    def are_there(self) -> bool:
        """Whether there are any."""
        return bool(self._members)

    def find(self) -> None:
        """Find the members, where faults have begun or ended."""
        members = self._graph.members.values()
        self._members = [member for member in members if member.overrides.varies]

    def determine(self, index: int, row: Vector) -> None:
        """Determine all faults at a communication point.

        Parameters
        ----------
        index : int
            Its number.
        row : Vector, shape (width,)
            The signals at the one before.
        """
        for member in self._members:
            driven = member.driven(row)
            for column, active in member.overrides.faults.items():
                if active.fault.varies:
                    steps = index - active.begin
                    source = float(driven[column])
                    instant = FaultInstant(steps, self._h, source, float(row[column]))
                    member.overrides.vary(column, instant)
