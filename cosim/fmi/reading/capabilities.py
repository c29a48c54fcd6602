"""Read what each kind of an FMU can do (FMI 1.0 co-simulation section 4.3, FMI 2.0.4 and 3.0 sections 3.3.1 and 4.3.1)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final
from xml.etree.ElementTree import Element

from cosim.fmi.description import Capabilities, InterfaceType
from cosim.fmi.reading.markup import Attributes, flag
from cosim.fmi.reading.variables import major

IDENTIFIER: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
ELEMENTS: Final[Mapping[InterfaceType, str]] = {"me": "ModelExchange", "cs": "CoSimulation"}


def read_capabilities(root: Element, attributes: Attributes) -> dict[InterfaceType, Capabilities]:
    """Give the kinds that are there, and what each can do."""
    version = major(root)
    found: dict[InterfaceType, Capabilities] = {}
    if version == 1:
        identifier = _identifier(root, attributes)
        implementation = root.find("Implementation")
        if implementation is None:
            return {"me": Capabilities(identifier)}
        return {"cs": _capabilities_1(implementation, identifier)}
    for interface_type, tag in ELEMENTS.items():
        element = root.find(tag)
        if element is not None:
            able = _capabilities_2 if version == 2 else _capabilities_3
            found[interface_type] = able(
                element, _identifier(element, attributes), interface_type, attributes
            )
    return found


def _identifier(element: Element, attributes: Attributes) -> str:
    """Give the modelIdentifier; it becomes part of a path, and "../x" must not."""
    found = element.get("modelIdentifier")
    if found is None:
        attributes.problems.append(f"{element.tag}: the attribute modelIdentifier is missing")
    elif not IDENTIFIER.fullmatch(found) or not found.isascii():
        attributes.problems.append(
            f"{element.tag}: modelIdentifier {found!r} is no identifier of C"
        )
    return found or ""


def _capabilities_1(implementation: Element, identifier: str) -> Capabilities:
    found = implementation.find("*/Capabilities")
    element = Element("none") if found is None else found
    return Capabilities(
        identifier,
        interpolates_inputs=flag(element, "canInterpolateInputs"),
        variable_step=flag(element, "canHandleVariableCommunicationStepSize"),
        once_per_process=flag(element, "canBeInstantiatedOnlyOncePerProcess"),
        needs_tool=implementation.find("CoSimulation_Tool") is not None,
    )


def _capabilities_2(
    element: Element, identifier: str, interface_type: InterfaceType, attributes: Attributes
) -> Capabilities:
    return Capabilities(
        identifier,
        directional_derivatives=flag(element, "providesDirectionalDerivative"),
        saves_state=flag(element, "canGetAndSetFMUstate"),
        serializes_state=flag(element, "canSerializeFMUstate"),
        interpolates_inputs=flag(element, "canInterpolateInputs"),
        variable_step=flag(element, "canHandleVariableCommunicationStepSize"),
        completed_step=interface_type == "me"
        and not flag(element, "completedIntegratorStepNotNeeded"),
        once_per_process=flag(element, "canBeInstantiatedOnlyOncePerProcess"),
        needs_tool=flag(element, "needsExecutionTool"),
    )


def _capabilities_3(
    element: Element, identifier: str, interface_type: InterfaceType, attributes: Attributes
) -> Capabilities:
    step = attributes.number(element, "fixedInternalStepSize", element.tag)
    if step is not None and not 0.0 < step < float("inf"):
        attributes.problems.append(
            f"{element.tag}: fixedInternalStepSize: found {step}, needed a positive number"
        )
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
        completed_step=interface_type == "me" and flag(element, "needsCompletedIntegratorStep"),
        once_per_process=flag(element, "canBeInstantiatedOnlyOncePerProcess"),
        needs_tool=flag(element, "needsExecutionTool"),
    )
