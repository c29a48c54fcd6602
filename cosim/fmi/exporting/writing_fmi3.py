"""Write a description as an FMI 3.0 modelDescription.xml and its buildDescription.xml (FMI 3.0.2 sections 2.4 and 2.5.1.4)."""

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

TAGS = {
    "Outputs": "Output",
    "Derivatives": "ContinuousStateDerivative",
    "InitialUnknowns": "InitialUnknown",
}


def write_fmi3(
    description: Description, *, text: str, sources: Sequence[str], constant: bool
) -> str:
    """Write the XML of a unit with Float64 variables, scalars and arrays; parameters as in ``write_fmi2``."""
    root = begin(description, text, fmiVersion="3.0", instantiationToken=description.token)
    for interface_type in description.capabilities:
        SubElement(root, ELEMENTS[interface_type], _capabilities(description, interface_type))
    add_units(root, description)
    add_experiment(root, description)
    variables = SubElement(root, "ModelVariables")
    references = {variable.name: str(variable.reference) for variable in description.variables}
    updated = (
        "cs" in description.capabilities and description.capabilities["cs"].interpolates_inputs
    )
    for variable in description.variables:
        _variable(variables, variable, references, updated)
    add_structure(root, description, references, constant)
    return finish(root)


def write_build_description(identifier: str, sources: Sequence[str]) -> str:
    """Write how the sources are compiled: one set of C11 files, and the mathematical library."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = SubElement(root, "BuildConfiguration", modelIdentifier=identifier)
    files = SubElement(
        configuration, "SourceFileSet", language="C11", compilerOptions="-ffp-contract=off"
    )
    for name in sources:
        SubElement(files, "SourceFile", name=name)
    SubElement(configuration, "Library", name="m", external="true")
    return finish(root)


def _capabilities(description: Description, interface_type: InterfaceType) -> dict[str, str]:
    there = description.capabilities[interface_type]
    found = {
        "modelIdentifier": there.identifier,
        "canBeInstantiatedOnlyOncePerProcess": "false",
    } | flags(
        canGetAndSetFMUState=there.saves_state,
        canSerializeFMUState=there.serializes_state,
        providesDirectionalDerivatives=there.directional_derivatives,
        providesAdjointDerivatives=there.adjoint_derivatives,
        canHandleVariableCommunicationStepSize=interface_type == "cs" and there.variable_step,
        providesIntermediateUpdate=interface_type == "cs" and there.interpolates_inputs,
        hasEventMode=interface_type == "cs" and there.event_mode,
    )
    if interface_type == "me":
        found["needsCompletedIntegratorStep"] = "true" if there.completed_step else "false"
    if interface_type == "cs" and there.fixed_step is not None:
        found["fixedInternalStepSize"] = repr(there.fixed_step)
    return found


def _variable(
    parent: Element, variable: Variable, references: dict[str, str], updated: bool
) -> None:
    element = SubElement(parent, "Float64", attributes_of(variable))
    if variable.causality == "input" and variable.variability == "continuous" and updated:
        element.set("intermediateUpdate", "true")
    if variable.unit is not None:
        element.set("unit", variable.unit)
    if (start := start_of(variable)) is not None:
        element.set("start", start)
    if variable.derivative_of is not None:
        element.set("derivative", references[variable.derivative_of])
    for size in variable.dimensions:
        SubElement(element, "Dimension", start=str(size))


def add_structure(
    root: Element, description: Description, references: dict[str, str], constant: bool
) -> Element:
    """Write what depends on what; give the element."""
    structure = SubElement(root, "ModelStructure")
    for section, names in unknowns(description):
        for name in sorted(names, key=lambda name: int(references[name])):
            add_unknown(
                structure,
                TAGS[section],
                name,
                needs_of(description, section, name),
                references,
                constant,
            )
    return structure


def add_unknown(
    parent: Element,
    tag: str,
    name: str,
    needs: Sequence[str] | None,
    references: dict[str, str],
    constant: bool,
) -> Element:
    """Write what one unknown depends on; None: not said."""
    unknown = SubElement(parent, tag, valueReference=references[name])
    if needs is not None:
        unknown.set("dependencies", " ".join(sorted((references[need] for need in needs), key=int)))
    if needs and constant:
        unknown.set("dependenciesKind", " ".join(["constant"] * len(needs)))
    return unknown
