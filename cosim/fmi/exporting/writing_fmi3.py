"""Write a description as an FMI 3.0 modelDescription.xml, and its buildDescription.xml.

(FMI 3.0.2 sections 2.4 and 2.5.1.4.)
"""

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

TAGS = {
    "Outputs": "Output",
    "Derivatives": "ContinuousStateDerivative",
    "InitialUnknowns": "InitialUnknown",
}


def write_fmi3(
    description: Description, *, summary: str, sources: Sequence[str], constant: bool
) -> str:
    """Write the XML of an FMU with Float64 variables, scalars and arrays.

    Parameters as in :func:`cosim.fmi.exporting.writing_fmi2.write_fmi2`.
    """
    root = begin(description, summary, fmiVersion="3.0", instantiationToken=description.token)
    for interface_type in description.capabilities:
        SubElement(root, ELEMENTS[interface_type], _capabilities(description, interface_type))
    add_units(root, description)
    add_experiment(root, description)
    variables = SubElement(root, "ModelVariables")
    references = {variable.name: str(variable.reference) for variable in description.variables}
    co_simulation = description.capabilities.get("cs")
    interpolates = co_simulation is not None and co_simulation.interpolates_inputs
    for variable in description.variables:
        _add_variable(variables, variable, references, interpolates=interpolates)
    add_structure(root, description, references, constant=constant)
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
    able = description.capabilities[interface_type]
    attributes = {
        "modelIdentifier": able.identifier,
        "canBeInstantiatedOnlyOncePerProcess": "false",
    }
    attributes |= flags(
        canGetAndSetFMUState=able.saves_state,
        canSerializeFMUState=able.serializes_state,
        providesDirectionalDerivatives=able.directional_derivatives,
        providesAdjointDerivatives=able.adjoint_derivatives,
    )
    if interface_type == "me":
        attributes["needsCompletedIntegratorStep"] = "true" if able.completed_step else "false"
        return attributes
    attributes |= flags(
        canHandleVariableCommunicationStepSize=able.variable_step,
        providesIntermediateUpdate=able.interpolates_inputs,
        hasEventMode=able.event_mode,
    )
    if able.fixed_step is not None:
        attributes["fixedInternalStepSize"] = repr(able.fixed_step)
    return attributes


def _add_variable(
    parent: Element, variable: Variable, references: dict[str, str], *, interpolates: bool
) -> None:
    element = SubElement(parent, "Float64", attributes_of(variable))
    if variable.causality == "input" and variable.variability == "continuous" and interpolates:
        element.set("intermediateUpdate", "true")
    set_real_attributes(element, variable, references)
    for size in variable.dimensions:
        SubElement(element, "Dimension", start=str(size))


def add_structure(
    root: Element, description: Description, references: dict[str, str], *, constant: bool
) -> Element:
    """Write which unknowns depend on what; return the element."""
    structure = SubElement(root, "ModelStructure")
    for section, names in unknowns(description, references).items():
        for name in names:
            unknown = SubElement(structure, TAGS[section], valueReference=references[name])
            needs = needs_of(description, section, name)
            set_dependencies(unknown, needs, references, constant=constant)
    return structure
