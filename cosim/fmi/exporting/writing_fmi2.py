"""Write a description as an FMI 2.0 modelDescription.xml (FMI 2.0.4 section 2.2)."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement

from cosim.fmi.description import Description, InterfaceType
from cosim.fmi.exporting.writing import (
    ELEMENTS,
    add_experiment,
    add_units,
    attributes_of,
    begin,
    finish,
    flags,
    needs_of,
    set_dependencies,
    set_real_attributes,
    unknowns,
)
from cosim.fmi.variable import Variable


def write_fmi2(
    description: Description, *, summary: str, sources: Sequence[str], constant: bool
) -> str:
    """Write the XML of an FMU with Real variables.

    Parameters
    ----------
    description : Description
        With scalars only.
    summary : str
        What the model is, for people.
    sources : sequence of str
        C files under ``sources/`` that make up the FMU.
    constant : bool
        Every unknown is a sum of constants times what it depends on.
    """
    root = begin(
        description, summary, fmiVersion="2.0", guid=description.token, numberOfEventIndicators="0"
    )
    for interface_type in description.capabilities:
        element = SubElement(
            root, ELEMENTS[interface_type], _capabilities(description, interface_type)
        )
        files = SubElement(element, "SourceFiles")
        for name in sources:
            SubElement(files, "File", name=name)
    add_units(root, description)
    add_experiment(root, description)
    variables = SubElement(root, "ModelVariables")
    indices = {
        variable.name: str(index) for index, variable in enumerate(description.variables, start=1)
    }
    for variable in description.variables:
        _add_variable(variables, variable, indices)
    _add_structure(root, description, indices, constant=constant)
    return finish(root)


def _capabilities(description: Description, interface_type: InterfaceType) -> dict[str, str]:
    able = description.capabilities[interface_type]
    attributes = {
        "modelIdentifier": able.identifier,
        "canBeInstantiatedOnlyOncePerProcess": "false",
        "canNotUseMemoryManagementFunctions": "true",
    }
    attributes |= flags(
        canGetAndSetFMUstate=able.saves_state,
        canSerializeFMUstate=able.serializes_state,
        providesDirectionalDerivative=able.directional_derivatives,
    )
    if interface_type == "me":
        return attributes | flags(completedIntegratorStepNotNeeded=not able.completed_step)
    return attributes | flags(
        canHandleVariableCommunicationStepSize=able.variable_step,
        canInterpolateInputs=able.interpolates_inputs,
    )


def _add_variable(parent: Element, variable: Variable, indices: dict[str, str]) -> None:
    scalar = SubElement(parent, "ScalarVariable", attributes_of(variable))
    set_real_attributes(SubElement(scalar, "Real"), variable, indices)


def _add_structure(
    root: Element, description: Description, indices: dict[str, str], *, constant: bool
) -> None:
    structure = SubElement(root, "ModelStructure")
    for tag, names in unknowns(description, indices).items():
        if not names:  # FMI 2.0 has no empty sections
            continue
        section = SubElement(structure, tag)
        for name in names:
            unknown = SubElement(section, "Unknown", index=indices[name])
            needs = needs_of(description, tag, name)
            set_dependencies(unknown, needs, indices, constant=constant)
