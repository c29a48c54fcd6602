"""Contracts, signals, clock, graph, coupling, solvers and master.

Simulation without knowledge of the method.
"""

from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.contracts import Component, Model, Recorder, Recording, Stopped
from cosim.core.graph import Graph
from cosim.core.linear import Linear, LinearModel
from cosim.core.master import run
from cosim.core.recorders import Memory, Nothing, Watched
from cosim.core.signals import Interface, Signal

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
    "Recorder",
    "Recording",
    "Signal",
    "Stopped",
    "Watched",
    "run",
]
