"""Read what an FMU can do with each interface type.

FMI 1.0 for co-simulation section 4.3, FMI 2.0.4 and FMI 3.0 sections 3.3.1 and 4.3.1.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final
from xml.etree.ElementTree import Element

from cosim.fmi.description import Capabilities, InterfaceType
from cosim.fmi.reading.markup import Attributes, flag
from cosim.fmi.reading.variables import major

IDENTIFIER: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*", re.ASCII)
LONGEST: Final = 200  # bytes of a modelIdentifier; a name of a file may have 255
ELEMENTS: Final[Mapping[InterfaceType, str]] = {"me": "ModelExchange", "cs": "CoSimulation"}


def read_capabilities(root: Element, attributes: Attributes) -> dict[InterfaceType, Capabilities]:
    """Return the interface types that are there, and what the FMU can do with each."""
    version = major(root)
    if version == 1:
        identifier = _identifier(root, attributes)
        implementation = root.find("Implementation")
        if implementation is None:
            return {"me": Capabilities(identifier)}
        return {"cs": _capabilities_1(implementation, identifier)}
    capabilities: dict[InterfaceType, Capabilities] = {}
    for interface_type, tag in ELEMENTS.items():
        element = root.find(tag)
        if element is not None:
            identifier = _identifier(element, attributes)
            if version == 2:
                declared = _capabilities_2(element, identifier, interface_type)
            else:
                declared = _capabilities_3(element, identifier, interface_type, attributes)
            capabilities[interface_type] = declared
    return capabilities


def _identifier(element: Element, attributes: Attributes) -> str:
    """Return the modelIdentifier; it becomes part of a path, and "../x" must not."""
    identifier = element.get("modelIdentifier")
    if identifier is None:
        attributes.problems.append(f"{element.tag}: the attribute modelIdentifier is missing")
        return ""
    where = f"{element.tag}: modelIdentifier {identifier[:LONGEST]!r}"
    if not _is_file_name(identifier):
        attributes.problems.append(
            f"{where} is no name of a file (no path, at most {LONGEST} bytes)"
        )
        return ""
    if not IDENTIFIER.fullmatch(identifier):
        attributes.warnings.append(f"{where} is no identifier of C")
    return identifier


def _is_file_name(identifier: str) -> bool:
    """Return whether a library can have that name, in the folder where it is looked for."""
    return (
        identifier.isprintable()
        and identifier.strip(". ") != ""
        and not any(letter in identifier for letter in "/\\:")
        and len(identifier.encode()) <= LONGEST
    )


def _capabilities_1(implementation: Element, identifier: str) -> Capabilities:
    element = implementation.find("*/Capabilities")
    if element is None:
        element = Element("none")
    once_per_process = flag(element, "canBeInstantiatedOnlyOncePerProcess")
    needs_tool = implementation.find("CoSimulation_Tool") is not None
    return Capabilities(
        identifier,
        interpolates_inputs=flag(element, "canInterpolateInputs"),
        variable_step=flag(element, "canHandleVariableCommunicationStepSize"),
        once_per_process=once_per_process,
        needs_tool=needs_tool,
    )


def _capabilities_2(
    element: Element, identifier: str, interface_type: InterfaceType
) -> Capabilities:
    not_needed = flag(element, "completedIntegratorStepNotNeeded")
    return Capabilities(
        identifier,
        directional_derivatives=flag(element, "providesDirectionalDerivative"),
        saves_state=flag(element, "canGetAndSetFMUstate"),
        serializes_state=flag(element, "canSerializeFMUstate"),
        interpolates_inputs=flag(element, "canInterpolateInputs"),
        variable_step=flag(element, "canHandleVariableCommunicationStepSize"),
        completed_step=interface_type == "me" and not not_needed,
        once_per_process=flag(element, "canBeInstantiatedOnlyOncePerProcess"),
        needs_tool=flag(element, "needsExecutionTool"),
    )


def _capabilities_3(
    element: Element, identifier: str, interface_type: InterfaceType, attributes: Attributes
) -> Capabilities:
    step = attributes.number(element, "fixedInternalStepSize", element.tag)
    if step is not None and not 0.0 < step < float("inf"):
        attributes.report(f"{element.tag}: fixedInternalStepSize", step, "a positive number")
    needs_completed_step = flag(element, "needsCompletedIntegratorStep")
    return Capabilities(
        identifier,
        directional_derivatives=flag(element, "providesDirectionalDerivatives"),
        adjoint_derivatives=flag(element, "providesAdjointDerivatives"),
        saves_state=flag(element, "canGetAndSetFMUState"),
        serializes_state=flag(element, "canSerializeFMUState"),
        interpolates_inputs=flag(element, "providesIntermediateUpdate"),
        variable_step=flag(element, "canHandleVariableCommunicationStepSize"),
        fixed_step=step,
        event_mode=flag(element, "hasEventMode"),
        early_return=flag(element, "mightReturnEarlyFromDoStep"),
        completed_step=interface_type == "me" and needs_completed_step,
        once_per_process=flag(element, "canBeInstantiatedOnlyOncePerProcess"),
        needs_tool=flag(element, "needsExecutionTool"),
    )
