"""Simulation without knowledge of the method: contracts, graph, coupling and master."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cosim.lazy import lazy_names

if TYPE_CHECKING:
    from cosim.core.clock import Clock
    from cosim.core.connections import Connection
    from cosim.core.contracts import (
        Component,
        Model,
        Preparable,
        Recorder,
        Recording,
        Rollback,
        Stopped,
        prepare,
    )
    from cosim.core.graph import Graph
    from cosim.core.linear import Linear, LinearModel
    from cosim.core.master import run, simulate
    from cosim.core.port import Port
    from cosim.core.recorders import Memory, Nothing, RunMessage, Watched
    from cosim.core.signals import Interface, Signal

_HOMES = {
    "Clock": "cosim.core.clock",
    "Component": "cosim.core.contracts",
    "Connection": "cosim.core.connections",
    "Graph": "cosim.core.graph",
    "Interface": "cosim.core.signals",
    "Linear": "cosim.core.linear",
    "LinearModel": "cosim.core.linear",
    "Memory": "cosim.core.recorders",
    "Model": "cosim.core.contracts",
    "Nothing": "cosim.core.recorders",
    "Port": "cosim.core.port",
    "Preparable": "cosim.core.contracts",
    "prepare": "cosim.core.contracts",
    "Recorder": "cosim.core.contracts",
    "Recording": "cosim.core.contracts",
    "Rollback": "cosim.core.contracts",
    "run": "cosim.core.master",
    "RunMessage": "cosim.core.recorders",
    "Signal": "cosim.core.signals",
    "simulate": "cosim.core.master",
    "Stopped": "cosim.core.contracts",
    "Watched": "cosim.core.recorders",
}

__all__ = [
    "Clock",
    "Component",
    "Connection",
    "Graph",
    "Interface",
    "Linear",
    "LinearModel",
    "Memory",
    "Model",
    "Nothing",
    "Port",
    "Preparable",
    "Recorder",
    "Recording",
    "Rollback",
    "RunMessage",
    "Signal",
    "Stopped",
    "Watched",
    "prepare",
    "run",
    "simulate",
]

__getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return list(__all__)
