"""Write a description as a modelDescription.xml: what FMI 2.0 and 3.0 have in common.

(FMI 2.0.4 section 2.2, FMI 3.0.2 section 2.4.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from cosim.fmi.description import Description, InterfaceType
from cosim.fmi.variable import Variable
from cosim.units import BASE, BaseUnit, base_unit

ELEMENTS: dict[InterfaceType, str] = {"me": "ModelExchange", "cs": "CoSimulation"}


def begin(description: Description, summary: str, **attributes: str) -> Element:
    """Begin the document; ``summary`` describes the model for people."""
    root = Element("fmiModelDescription", modelName=description.name)
    for name, value in attributes.items():
        root.set(name, value)
    root.set("generationTool", "cosim")
    root.set("variableNamingConvention", "structured")
    if summary:
        root.set("description", summary)
    return root


def add_units(root: Element, description: Description) -> None:
    """Define every unit that a variable has."""
    names = {variable.unit for variable in description.variables if variable.unit is not None}
    if not names:
        return
    definitions = SubElement(root, "UnitDefinitions")
    for name in sorted(names):
        unit = SubElement(definitions, "Unit", name=name)
        base = base_unit(name)
        if base is not None:
            SubElement(unit, "BaseUnit", _base_unit_attributes(base))


def _base_unit_attributes(base: BaseUnit) -> dict[str, str]:
    exponents = zip(BASE, base.exponents, strict=True)
    attributes = {symbol: str(exponent) for symbol, exponent in exponents if exponent}
    if base.factor != 1.0:
        attributes["factor"] = repr(base.factor)
    if base.offset != 0.0:
        attributes["offset"] = repr(base.offset)
    return attributes


def add_experiment(root: Element, description: Description) -> None:
    """Name the category of the messages, and the step where there is only one."""
    SubElement(SubElement(root, "LogCategories"), "Category", name="logStatusError")
    if description.default_step is not None:
        SubElement(root, "DefaultExperiment", stepSize=repr(description.default_step))


def attributes_of(variable: Variable) -> dict[str, str]:
    """Return the attributes that every variable has."""
    attributes = {
        "name": variable.name,
        "valueReference": str(variable.reference),
        "causality": variable.causality,
        "variability": variable.variability,
    }
    if variable.doc:
        attributes["description"] = variable.doc
    if variable.initial is not None:
        attributes["initial"] = variable.initial
    return attributes


def set_real_attributes(element: Element, variable: Variable, labels: Mapping[str, str]) -> None:
    """Set unit, start value and state of a real variable; ``labels``: by which one is named."""
    if variable.unit is not None:
        element.set("unit", variable.unit)
    if variable.start is not None:
        element.set("start", " ".join(map(repr, variable.start)))
    if variable.derivative_of is not None:
        element.set("derivative", labels[variable.derivative_of])


# --- ModelStructure ---


def unknowns(description: Description, labels: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the sections of ModelStructure, by their names in FMI 2.0: their unknowns in order.

    ``labels``: the numbers by which each variable is named in ModelStructure.
    """

    def number(name: str) -> int:
        return int(labels[name])

    outputs = []
    derivatives = []
    for variable in description.variables:
        if variable.causality == "output":
            outputs.append(variable.name)
        if variable.derivative_of is not None:
            derivatives.append(variable.name)
    return {
        "Outputs": sorted(outputs, key=number),
        "Derivatives": sorted(derivatives, key=number),
        "InitialUnknowns": sorted(description.initial_dependencies, key=number),
    }


def needs_of(description: Description, section: str, name: str) -> tuple[str, ...] | None:
    """Return what an unknown depends on; None: not declared."""
    if section == "InitialUnknowns":
        return description.initial_dependencies[name]
    if name in description.states and section == "Outputs":  # a state depends on itself
        return (name,)
    return description.dependencies.get(name)


def set_dependencies(
    unknown: Element, needs: Sequence[str] | None, labels: Mapping[str, str], *, constant: bool
) -> None:
    """Set what an unknown depends on; None: not declared.

    ``constant``: it is a sum of constants times what it depends on.
    """
    if needs is None:
        return
    numbers = sorted((labels[name] for name in needs), key=int)
    unknown.set("dependencies", " ".join(numbers))
    if needs and constant:
        unknown.set("dependenciesKind", " ".join(["constant"] * len(needs)))


def finish(root: Element) -> str:
    """Return the document as text."""
    indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{tostring(root, encoding="unicode")}\n'


def flags(**values: bool) -> dict[str, str]:
    """Return the flags that are set."""
    return {name: "true" for name, is_set in values.items() if is_set}
