"""Write a description as an FMI 2.0 modelDescription.xml (FMI 2.0.4 section 2.2)."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from cosim.fmi.description import Description, Mode, Variable
from cosim.units import BASE, base_unit

ELEMENTS: dict[Mode, str] = {"me": "ModelExchange", "cs": "CoSimulation"}


def write_model_description(
    description: Description, *, text: str = "", sources: Sequence[str] = (), initial: dict[str, tuple[str, ...]]
) -> str:
    """Write the XML of a unit with Real variables.

    Parameters
    ----------
    description : Description
    text : str
        What the model is, for people.
    sources : sequence of str
        C files under ``sources/`` that make up the unit.
    initial : mapping of name to names
        The unknowns of the initialization with what they depend on (ModelStructure/InitialUnknowns).
    """
    root = Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=description.name,
        guid=description.token,
        generationTool="cosim",
        variableNamingConvention="structured",
        numberOfEventIndicators="0",
    )
    if text:
        root.set("description", text)
    for mode, capabilities in description.capabilities.items():
        element = SubElement(root, ELEMENTS[mode], _capabilities(description, mode))
        if sources:
            files = SubElement(element, "SourceFiles")
            for name in sources:
                SubElement(files, "File", name=name)
        assert capabilities.identifier
    _units(root, description)
    variables = SubElement(root, "ModelVariables")
    numbers = {variable.name: str(index + 1) for index, variable in enumerate(description.variables)}
    for variable in description.variables:
        _variable(variables, variable, numbers)
    _structure(root, description, numbers, initial)
    indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{tostring(root, encoding="unicode")}\n'


def _capabilities(description: Description, mode: Mode) -> dict[str, str]:
    capabilities = description.capabilities[mode]
    found = {"modelIdentifier": capabilities.identifier, "canNotUseMemoryManagementFunctions": "true"}
    flags = {
        "canGetAndSetFMUstate": capabilities.saves_state,
        "canSerializeFMUstate": capabilities.saves_state,
        "providesDirectionalDerivative": capabilities.directional_derivatives,
        "completedIntegratorStepNotNeeded": mode == "me" and not capabilities.completed_step,
        "canHandleVariableCommunicationStepSize": mode == "cs" and capabilities.variable_step,
        "canInterpolateInputs": mode == "cs" and capabilities.interpolates_inputs,
    }
    return found | {name: "true" for name, there in flags.items() if there}


def _units(root: Element, description: Description) -> None:
    units = sorted({variable.unit for variable in description.variables if variable.unit is not None})
    if not units:
        return
    definitions = SubElement(root, "UnitDefinitions")
    for name in units:
        unit, base = SubElement(definitions, "Unit", name=name), base_unit(name)
        if base is not None:
            powers = {b: str(power) for b, power in zip(BASE, base.exponents, strict=True) if power}
            numbers = {"factor": (base.factor, 1.0), "offset": (base.offset, 0.0)}
            SubElement(unit, "BaseUnit", powers | {name: repr(x) for name, (x, default) in numbers.items() if x != default})


def _variable(parent: Element, variable: Variable, numbers: dict[str, str]) -> None:
    attributes = {
        "name": variable.name,
        "valueReference": str(variable.reference),
        "causality": variable.causality,
        "variability": variable.variability,
    }
    if variable.initial is not None:
        attributes["initial"] = variable.initial
    real = SubElement(SubElement(parent, "ScalarVariable", attributes), "Real")
    if variable.unit is not None:
        real.set("unit", variable.unit)
    if variable.start is not None:
        real.set("start", repr(variable.start[0]))
    if variable.derivative_of is not None:
        real.set("derivative", numbers[variable.derivative_of])


def _structure(root: Element, description: Description, numbers: dict[str, str], initial: dict[str, tuple[str, ...]]) -> None:
    structure = SubElement(root, "ModelStructure")
    outputs = [v.name for v in description.variables if v.causality == "output"]
    derivatives = [v.name for v in description.variables if v.derivative_of is not None]
    direct = {name: description.dependencies.get(name) for name in (*outputs, *derivatives)}
    known = {v.name for v in description.variables if v.causality == "input"} | set(description.states)
    for name in outputs:
        if name in description.states:  # a state depends on itself
            direct[name] = (name,)
    sections = (("Outputs", outputs, direct), ("Derivatives", derivatives, direct), ("InitialUnknowns", list(initial), initial))
    for tag, names, dependencies in sections:
        section = SubElement(structure, tag) if names else structure
        for name in sorted(names, key=lambda name: int(numbers[name])):
            unknown, needs = SubElement(section, "Unknown", index=numbers[name]), dependencies[name]
            if needs is not None:
                assert set(needs) <= known
                unknown.set("dependencies", " ".join(sorted((numbers[need] for need in needs), key=int)))
