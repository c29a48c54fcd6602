"""What is known of the binaries of an FMU without running them: for which machine they are, which functions they need."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from cosim.fmi.description import Description, InterfaceType

SHORT: Final[Mapping[str, tuple[str, str]]] = {
    "linux32": ("x86", "linux"), "linux64": ("x86_64", "linux"), "win32": ("x86", "windows"), "win64": ("x86_64", "windows"),
    "darwin32": ("x86", "darwin"), "darwin64": ("x86_64", "darwin"),
}  # fmt: skip


def machine_of(folder: str) -> tuple[str, str] | None:
    """Give (architecture, system) of a folder under ``binaries/``; None: not one of the standard's."""
    if folder in SHORT:
        return SHORT[folder]
    architecture, _, system = folder.partition("-")
    return (
        (architecture, next(s for s in ("linux", "windows", "darwin") if system.startswith(s)))
        if system.startswith(("linux", "windows", "darwin"))
        else None
    )


_VALUES_1 = [
    f"{verb}{kind}" for verb in ("Set", "Get") for kind in ("Real", "Integer", "Boolean", "String")
]
_STATES_2 = ["GetFMUstate", "SetFMUstate", "FreeFMUstate"]
_SERIAL_2 = ["SerializedFMUstateSize", "SerializeFMUstate", "DeSerializeFMUstate"]
_WIDTHS = tuple(f"{sign}Int{width}" for width in (8, 16, 32, 64) for sign in ("", "U"))
_KINDS_3 = ("Float32", "Float64", *_WIDTHS, "Boolean", "String", "Binary", "Clock")
_STATES_3 = ["GetFMUState", "SetFMUState", "FreeFMUState"]
_SERIAL_3 = ["SerializedFMUStateSize", "SerializeFMUState", "DeserializeFMUState"]
_STATUS = ["GetStatus", *(f"Get{kind}Status" for kind in ("Real", "Integer", "Boolean", "String"))]
NEEDED: Final[Mapping[tuple[int, InterfaceType], Sequence[str]]] = {
    (1, "me"): [
        *("GetModelTypesPlatform", "GetVersion", "InstantiateModel", "FreeModelInstance", "SetDebugLogging", "SetTime"),
        *("SetContinuousStates", "CompletedIntegratorStep", "Initialize", "GetDerivatives", "GetEventIndicators", "EventUpdate"),
        *("GetContinuousStates", "GetNominalContinuousStates", "GetStateValueReferences", "Terminate", *_VALUES_1),
    ],
    (1, "cs"): [
        *("GetTypesPlatform", "GetVersion", "InstantiateSlave", "InitializeSlave", "TerminateSlave", "ResetSlave"),
        *("FreeSlaveInstance", "SetDebugLogging", "DoStep", *_VALUES_1),
    ],
    (2, "me"): [
        *("EnterEventMode", "NewDiscreteStates", "EnterContinuousTimeMode", "CompletedIntegratorStep", "SetTime"),
        *("SetContinuousStates", "GetDerivatives", "GetEventIndicators", "GetContinuousStates", "GetNominalsOfContinuousStates"),
    ],
    (2, "cs"): ["DoStep", "GetStatus", "GetBooleanStatus", "GetRealStatus"],
    (3, "me"): [
        *("InstantiateModelExchange", "EnterEventMode", "UpdateDiscreteStates", "EnterContinuousTimeMode", "SetTime"),
        *("CompletedIntegratorStep", "SetContinuousStates", "GetContinuousStateDerivatives", "GetEventIndicators"),
        *("GetContinuousStates", "GetNominalsOfContinuousStates", "GetNumberOfEventIndicators", "GetNumberOfContinuousStates"),
    ],
    (3, "cs"): ["InstantiateCoSimulation", "DoStep"],
}  # fmt: skip
COMMON: Final[Mapping[int, Sequence[str]]] = {
    1: [],
    2: [
        *("GetTypesPlatform", "GetVersion", "SetDebugLogging", "Instantiate", "FreeInstance", "SetupExperiment", "Reset"),
        *("EnterInitializationMode", "ExitInitializationMode", "Terminate", *_VALUES_1),
    ],
    3: [
        *("GetVersion", "SetDebugLogging", "FreeInstance", "EnterInitializationMode", "ExitInitializationMode", "Terminate"),
        *("Reset", *(f"{verb}{kind}" for verb in ("Get", "Set") for kind in _KINDS_3)),
    ],
}  # fmt: skip


def functions(description: Description, interface_type: InterfaceType) -> list[str]:
    """Give the names of the functions that a binary must have for one kind and for what it says it can."""
    version, able = int(description.version[0]), description.capabilities[interface_type]
    names = [*COMMON[version], *NEEDED[version, interface_type]]
    if able.saves_state:
        names += _STATES_2 if version == 2 else _STATES_3
    if able.serializes_state:
        names += _SERIAL_2 if version == 2 else _SERIAL_3
    if able.directional_derivatives:
        names.append("GetDirectionalDerivative")
    if able.adjoint_derivatives:
        names.append("GetAdjointDerivative")
    if able.interpolates_inputs and version < 3:
        names.append("SetRealInputDerivatives")
    if able.event_mode:
        names += ["EnterEventMode", "UpdateDiscreteStates", "EnterStepMode"]
    prefix = {1: f"{able.identifier}_fmi", 2: "fmi2", 3: "fmi3"}[version]
    return [prefix + name for name in dict.fromkeys(names)]
