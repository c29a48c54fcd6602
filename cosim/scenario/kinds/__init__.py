"""The component kinds of a scenario: one table class each, which builds its component."""

from __future__ import annotations

from collections.abc import Mapping

from cosim.scenario.kinds.base import BuildContext, ExportableKind, Kind, LinearKind
from cosim.scenario.kinds.method import IdentifierKind, RegressorKind, UnknownInputObserverKind
from cosim.scenario.kinds.parts import (
    ControllerKind,
    DelayKind,
    GainKind,
    LagKind,
    LimitKind,
    SumKind,
)
from cosim.scenario.kinds.plants import DescriptorKind, FmuKind, RecordingKind
from cosim.scenario.kinds.sources import (
    ChirpKind,
    ConstantKind,
    DisturbanceKind,
    ExpressionKind,
    NoiseKind,
    RampKind,
    SineKind,
    StepKind,
    TableKind,
)

KINDS: Mapping[str, type[Kind]] = {
    "constant": ConstantKind,
    "step": StepKind,
    "ramp": RampKind,
    "sine": SineKind,
    "chirp": ChirpKind,
    "expression": ExpressionKind,
    "table": TableKind,
    "noise": NoiseKind,
    "disturbance": DisturbanceKind,
    "sum": SumKind,
    "gain": GainKind,
    "limit": LimitKind,
    "lag": LagKind,
    "delay": DelayKind,
    "controller": ControllerKind,
    "descriptor": DescriptorKind,
    "fmu": FmuKind,
    "recording": RecordingKind,
    "unknown-input-observer": UnknownInputObserverKind,
    "regressor": RegressorKind,
    "identifier": IdentifierKind,
}

EXPORTABLE = tuple(name for name, kind in KINDS.items() if issubclass(kind, ExportableKind))

__all__ = [
    "EXPORTABLE",
    "KINDS",
    "BuildContext",
    "DescriptorKind",
    "ExportableKind",
    "Kind",
    "LinearKind",
]
