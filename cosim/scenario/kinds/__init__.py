"""The component kinds of a scenario: one table class each, with what it takes to build the component."""

from __future__ import annotations

from collections.abc import Mapping

from cosim.scenario.kinds.base import LINEAR, Exportable, Kind, Site
from cosim.scenario.kinds.method import Identifier, RegressorKind, UnknownInputObserver
from cosim.scenario.kinds.parts import Controller, Delay, Gain, Lag, Limit, Sum
from cosim.scenario.kinds.plants import Descriptor, Fmu, Recording
from cosim.scenario.kinds.sources import Chirp, Constant, Disturbance, Expression, Noise, Ramp, Sine, Step, TableSource

KINDS: Mapping[str, type[Kind]] = {
    "constant": Constant,
    "step": Step,
    "ramp": Ramp,
    "sine": Sine,
    "chirp": Chirp,
    "expression": Expression,
    "table": TableSource,
    "noise": Noise,
    "disturbance": Disturbance,
    "sum": Sum,
    "gain": Gain,
    "limit": Limit,
    "lag": Lag,
    "delay": Delay,
    "controller": Controller,
    "descriptor": Descriptor,
    "fmu": Fmu,
    "recording": Recording,
    "unknown-input-observer": UnknownInputObserver,
    "regressor": RegressorKind,
    "identifier": Identifier,
}

__all__ = ["KINDS", "LINEAR", "Exportable", "Kind", "Site"]
