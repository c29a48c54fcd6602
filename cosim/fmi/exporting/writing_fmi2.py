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
    start_of,
    unknowns,
)
from cosim.fmi.variable import Variable


def write_fmi2(
    description: Description, *, text: str, sources: Sequence[str], constant: bool
) -> str:
    """Write the XML of a unit with Real variables.

    Parameters
    ----------
    description : Description
        With scalars only.
    text : str
        What the model is, for people.
    sources : sequence of str
        C files under ``sources/`` that make up the unit.
    constant : bool
        Every unknown is a sum of constants times what it depends on.
    """
    root = begin(
        description, text, fmiVersion="2.0", guid=description.token, numberOfEventIndicators="0"
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
    numbers = {
        variable.name: str(index + 1) for index, variable in enumerate(description.variables)
    }
    for variable in description.variables:
        _variable(variables, variable, numbers)
    _structure(root, description, numbers, constant)
    return finish(root)


def _capabilities(description: Description, interface_type: InterfaceType) -> dict[str, str]:
    there = description.capabilities[interface_type]
    return {
        "modelIdentifier": there.identifier,
        "canBeInstantiatedOnlyOncePerProcess": "false",
        "canNotUseMemoryManagementFunctions": "true",
    } | flags(
        canGetAndSetFMUstate=there.saves_state,
        canSerializeFMUstate=there.serializes_state,
        providesDirectionalDerivative=there.directional_derivatives,
        completedIntegratorStepNotNeeded=interface_type == "me" and not there.completed_step,
        canHandleVariableCommunicationStepSize=interface_type == "cs" and there.variable_step,
        canInterpolateInputs=interface_type == "cs" and there.interpolates_inputs,
    )


def _variable(parent: Element, variable: Variable, numbers: dict[str, str]) -> None:
    real = SubElement(SubElement(parent, "ScalarVariable", attributes_of(variable)), "Real")
    if variable.unit is not None:
        real.set("unit", variable.unit)
    if (start := start_of(variable)) is not None:
        real.set("start", start)
    if variable.derivative_of is not None:
        real.set("derivative", numbers[variable.derivative_of])


def _structure(
    root: Element, description: Description, numbers: dict[str, str], constant: bool
) -> None:
    structure = SubElement(root, "ModelStructure")
    for tag, names in unknowns(description):
        section = SubElement(structure, tag) if names else structure
        for name in sorted(names, key=lambda name: int(numbers[name])):
            unknown, needs = (
                SubElement(section, "Unknown", index=numbers[name]),
                needs_of(description, tag, name),
            )
            if needs is not None:
                unknown.set(
                    "dependencies", " ".join(sorted((numbers[need] for need in needs), key=int))
                )
            if needs and constant:
                unknown.set("dependenciesKind", " ".join(["constant"] * len(needs)))
