"""Simulation without knowledge of the method: contracts, graph, coupling and master.

In the order in which to read it::

    contracts, signals, port   what a component, a signal is
    recording                  what a run records: what a recorder takes, a recording gives back
    clock, connections, graph  a network of components on a grid of communication points
      structure/               what checks and orders it, once
      gain/                    how much the coupling of a loop multiplies an error
      initialization/          its initial values
    master                     run and simulate: the pseudocode of a run
      conditions               where a run ends, or an action is performed
      stages/                  the engine under it: components in their places, cascades and loops,
                               in Python and in compiled code
    recorders                  what takes the rows: memory, several recorders, a slice of a run
    recorded.run               what gives them back, by name and time, with what they rest on
      selection, joined_rows   signals by pattern; those of several rates in one table or frame
    simulation                 the same engine, step by step
      stepping/                actions and faults, jumps of inputs, states, rows
    ensemble                   many members of one graph
    linear, linearization      linear models with their exact solver; components near a point
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cosim.lazy import lazy_names

if TYPE_CHECKING:
    from cosim.core.clock import Clock
    from cosim.core.connections import Connection
    from cosim.core.contracts import (
        Block,
        Component,
        Design,
        Eventful,
        Jumping,
        Linearizable,
        Model,
        Native,
        Preparable,
        Rollback,
        Stopped,
        check_design,
        prepare,
    )
    from cosim.core.ensemble import EnsembleRows, run_members
    from cosim.core.graph import Graph
    from cosim.core.linear import Linear, LinearModel
    from cosim.core.linearization import Linearized
    from cosim.core.master import run, simulate
    from cosim.core.port import Port
    from cosim.core.recorded.signals import RunMessage
    from cosim.core.recorders import EndOfRun, Memory, Nothing, Watched, end_of_run
    from cosim.core.recording import MessageLevel, Plan, Recorder, Recording, SignalEvent
    from cosim.core.signals import Channel, Interface, Layout, Signal
    from cosim.core.simulation import Simulation
    from cosim.core.stepping.states import SimulationState
    from cosim.core.stepping.step_rows import StepRows

_HOMES = {
    "Block": "cosim.core.contracts",
    "Channel": "cosim.core.signals",
    "check_design": "cosim.core.contracts",
    "Clock": "cosim.core.clock",
    "Component": "cosim.core.contracts",
    "Connection": "cosim.core.connections",
    "Design": "cosim.core.contracts",
    "end_of_run": "cosim.core.recorders",
    "EndOfRun": "cosim.core.recorders",
    "EnsembleRows": "cosim.core.ensemble",
    "Eventful": "cosim.core.contracts",
    "Graph": "cosim.core.graph",
    "Interface": "cosim.core.signals",
    "Layout": "cosim.core.signals",
    "Linear": "cosim.core.linear",
    "Jumping": "cosim.core.contracts",
    "Linearizable": "cosim.core.contracts",
    "Linearized": "cosim.core.linearization",
    "LinearModel": "cosim.core.linear",
    "Memory": "cosim.core.recorders",
    "MessageLevel": "cosim.core.recording",
    "Model": "cosim.core.contracts",
    "Native": "cosim.core.contracts",
    "Nothing": "cosim.core.recorders",
    "Plan": "cosim.core.recording",
    "Port": "cosim.core.port",
    "Preparable": "cosim.core.contracts",
    "prepare": "cosim.core.contracts",
    "Recorder": "cosim.core.recording",
    "Recording": "cosim.core.recording",
    "Rollback": "cosim.core.contracts",
    "run": "cosim.core.master",
    "run_members": "cosim.core.ensemble",
    "RunMessage": "cosim.core.recorded.signals",
    "Signal": "cosim.core.signals",
    "SignalEvent": "cosim.core.recording",
    "simulate": "cosim.core.master",
    "Simulation": "cosim.core.simulation",
    "SimulationState": "cosim.core.stepping.states",
    "StepRows": "cosim.core.stepping.step_rows",
    "Stopped": "cosim.core.contracts",
    "Watched": "cosim.core.recorders",
}

__all__ = [
    "Block",
    "Channel",
    "Clock",
    "Component",
    "Connection",
    "Design",
    "EndOfRun",
    "EnsembleRows",
    "Eventful",
    "Graph",
    "Interface",
    "Jumping",
    "Layout",
    "Linear",
    "LinearModel",
    "Linearizable",
    "Linearized",
    "Memory",
    "MessageLevel",
    "Model",
    "Native",
    "Nothing",
    "Plan",
    "Port",
    "Preparable",
    "Recorder",
    "Recording",
    "Rollback",
    "RunMessage",
    "Signal",
    "SignalEvent",
    "Simulation",
    "SimulationState",
    "StepRows",
    "Stopped",
    "Watched",
    "check_design",
    "end_of_run",
    "prepare",
    "run",
    "run_members",
    "simulate",
]

__getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return list(__all__)
