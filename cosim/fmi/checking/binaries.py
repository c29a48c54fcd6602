"""What is known of the binaries of an FMU without running them: for which machine they are, which functions they need."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Final

from cosim.fmi.description import Description, InterfaceType

ELF: Final = {3: "x86", 62: "x86_64", 40: "aarch32", 183: "aarch64", 243: "riscv64"}
PE: Final = {0x14C: "x86", 0x8664: "x86_64", 0xAA64: "aarch64"}
MACH: Final = {7: "x86", 0x1000007: "x86_64", 0x100000C: "aarch64"}
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


def built_for(head: bytes) -> tuple[str, str] | None:
    """Give (architecture, system) of a shared library from its first kilobyte; ``any`` where it holds several; None: none."""
    if head[:4] == b"\x7fELF" and len(head) >= 20:
        order = "<" if head[5] == 1 else ">"
        kind, machine = struct.unpack_from(f"{order}HH", head, 16)
        return (ELF.get(machine, f"machine {machine}"), "linux") if kind == 3 else None
    if head[:2] == b"MZ" and len(head) >= 64:
        (start,) = struct.unpack_from("<I", head, 60)
        if head[start : start + 4] != b"PE\0\0" or len(head) < start + 6:
            return None
        (machine,) = struct.unpack_from("<H", head, start + 4)
        return PE.get(machine, f"machine {machine}"), "windows"
    if head[:4] in (b"\xcf\xfa\xed\xfe", b"\xce\xfa\xed\xfe") and len(head) >= 8:
        (machine,) = struct.unpack_from("<I", head, 4)
        return MACH.get(machine, f"machine {machine}"), "darwin"
    return ("any", "darwin") if head[:4] == b"\xca\xfe\xba\xbe" else None


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
