"""Which machine a folder of binaries is for, and which functions a binary must have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from cosim.fmi.description import Capabilities, Description, InterfaceType

SYSTEMS: Final = ("linux", "windows", "darwin")
SHORT_NAMES: Final[Mapping[str, tuple[str, str]]] = {
    "linux32": ("x86", "linux"),
    "linux64": ("x86_64", "linux"),
    "win32": ("x86", "windows"),
    "win64": ("x86_64", "windows"),
    "darwin32": ("x86", "darwin"),
    "darwin64": ("x86_64", "darwin"),
}


def machine_of(folder: str) -> tuple[str, str] | None:
    """Return (architecture, system) of a folder under ``binaries/``; None: not in the standard."""
    if folder in SHORT_NAMES:
        return SHORT_NAMES[folder]
    architecture, _, system_name = folder.partition("-")
    for system in SYSTEMS:
        if system_name.startswith(system):
            return architecture, system
    return None


_INTEGERS = ("Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64")
_TYPES = ("Real", "Integer", "Boolean", "String")
_TYPES_3 = ("Float32", "Float64", *_INTEGERS, "Boolean", "String", "Binary", "Clock")
_ACCESS = (*(f"Set{name}" for name in _TYPES), *(f"Get{name}" for name in _TYPES))
_ACCESS_3 = (*(f"Get{name}" for name in _TYPES_3), *(f"Set{name}" for name in _TYPES_3))
_STATE_2 = ("GetFMUstate", "SetFMUstate", "FreeFMUstate")
_STATE_3 = ("GetFMUState", "SetFMUState", "FreeFMUState")
_SERIALIZATION_2 = ("SerializedFMUstateSize", "SerializeFMUstate", "DeSerializeFMUstate")
_SERIALIZATION_3 = ("SerializedFMUStateSize", "SerializeFMUState", "DeserializeFMUState")
_CLOCKS_3 = ("GetIntervalDecimal", "GetShiftDecimal")
_EVENT_MODE_3 = ("EnterEventMode", "UpdateDiscreteStates", "EnterStepMode")

REQUIRED: Final[Mapping[tuple[int, InterfaceType], Sequence[str]]] = {
    (1, "me"): (
        "GetModelTypesPlatform", "GetVersion", "InstantiateModel", "FreeModelInstance",
        "SetDebugLogging", "SetTime", "SetContinuousStates", "CompletedIntegratorStep",
        "Initialize", "GetDerivatives", "GetEventIndicators", "EventUpdate",
        "GetContinuousStates", "GetNominalContinuousStates", "GetStateValueReferences",
        "Terminate", *_ACCESS,
    ),
    (1, "cs"): (
        "GetTypesPlatform", "GetVersion", "InstantiateSlave", "InitializeSlave",
        "TerminateSlave", "ResetSlave", "FreeSlaveInstance", "SetDebugLogging", "DoStep",
        *_ACCESS,
    ),
    (2, "me"): (
        "EnterEventMode", "NewDiscreteStates", "EnterContinuousTimeMode",
        "CompletedIntegratorStep", "SetTime", "SetContinuousStates", "GetDerivatives",
        "GetEventIndicators", "GetContinuousStates", "GetNominalsOfContinuousStates",
    ),
    (2, "cs"): ("DoStep", "GetStatus", "GetBooleanStatus", "GetRealStatus"),
    (3, "me"): (
        "InstantiateModelExchange", "EnterEventMode", "UpdateDiscreteStates",
        "EnterContinuousTimeMode", "SetTime", "CompletedIntegratorStep",
        "SetContinuousStates", "GetContinuousStateDerivatives", "GetEventIndicators",
        "GetContinuousStates", "GetNominalsOfContinuousStates",
        "GetNumberOfEventIndicators", "GetNumberOfContinuousStates",
    ),
    (3, "cs"): ("InstantiateCoSimulation", "DoStep"),
}  # fmt: skip
"""By major version and interface type."""

COMMON: Final[Mapping[int, Sequence[str]]] = {
    1: (),
    2: (
        "GetTypesPlatform", "GetVersion", "SetDebugLogging", "Instantiate", "FreeInstance",
        "SetupExperiment", "Reset", "EnterInitializationMode", "ExitInitializationMode",
        "Terminate", *_ACCESS,
    ),
    3: (
        "GetVersion", "SetDebugLogging", "FreeInstance", "EnterInitializationMode",
        "ExitInitializationMode", "Terminate", "Reset", *_ACCESS_3,
    ),
}  # fmt: skip
"""By major version, of both interface types."""


def required_functions(description: Description, interface_type: InterfaceType) -> list[str]:
    """Return the names of the functions that a binary must have for its version and interface type.

    Those that its capabilities promise are among them.
    """
    version = int(description.version[0])
    capabilities = description.capabilities[interface_type]
    names = [
        *COMMON[version],
        *REQUIRED[version, interface_type],
        *_promised_functions(capabilities, version),
        *(_CLOCKS_3 if description.clocks else ()),
    ]
    prefix = {1: f"{capabilities.identifier}_fmi", 2: "fmi2", 3: "fmi3"}[version]
    return [prefix + name for name in dict.fromkeys(names)]


def _promised_functions(capabilities: Capabilities, version: int) -> list[str]:
    names: list[str] = []
    if capabilities.saves_state:
        names += _STATE_2 if version == 2 else _STATE_3
    if capabilities.serializes_state:
        names += _SERIALIZATION_2 if version == 2 else _SERIALIZATION_3
    if capabilities.directional_derivatives:
        names.append("GetDirectionalDerivative")
    if capabilities.adjoint_derivatives:
        names.append("GetAdjointDerivative")
    if capabilities.interpolates_inputs and version < 3:
        names.append("SetRealInputDerivatives")
    if capabilities.event_mode:
        names += _EVENT_MODE_3
    return names
