"""Write a description as a modelDescription.xml: what FMI 2.0 and 3.0 have in common.

(FMI 2.0.4 section 2.2, FMI 3.0.2 section 2.4.)
"""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement, indent, tostring

from cosim.fmi.description import Description, InterfaceType
from cosim.fmi.variable import Variable
from cosim.units import BASE, base_unit

ELEMENTS: dict[InterfaceType, str] = {"me": "ModelExchange", "cs": "CoSimulation"}


def begin(description: Description, text: str, **attributes: str) -> Element:
    """Open the document; ``text`` says what the model is, for people."""
    root = Element("fmiModelDescription", modelName=description.name)
    for name, value in attributes.items():
        root.set(name, value)
    root.set("generationTool", "cosim")
    root.set("variableNamingConvention", "structured")
    if text:
        root.set("description", text)
    return root


def add_units(root: Element, description: Description) -> None:
    """Define every unit that a variable has."""
    units = sorted(
        {variable.unit for variable in description.variables if variable.unit is not None}
    )
    if not units:
        return
    definitions = SubElement(root, "UnitDefinitions")
    for name in units:
        unit, base = SubElement(definitions, "Unit", name=name), base_unit(name)
        if base is not None:
            powers = {b: str(power) for b, power in zip(BASE, base.exponents, strict=True) if power}
            numbers = {"factor": (base.factor, 1.0), "offset": (base.offset, 0.0)}
            SubElement(
                unit,
                "BaseUnit",
                powers | {name: repr(x) for name, (x, default) in numbers.items() if x != default},
            )


def add_experiment(root: Element, description: Description) -> None:
    """Name the category of the messages, and the step where there is only one."""
    SubElement(SubElement(root, "LogCategories"), "Category", name="logStatusError")
    if description.default_step is not None:
        SubElement(root, "DefaultExperiment", stepSize=repr(description.default_step))


def attributes_of(variable: Variable) -> dict[str, str]:
    """Give what every variable says of itself."""
    found = {
        "name": variable.name,
        "valueReference": str(variable.reference),
        "causality": variable.causality,
        "variability": variable.variability,
    }
    if variable.doc:
        found["description"] = variable.doc
    if variable.initial is not None:
        found["initial"] = variable.initial
    return found


def start_of(variable: Variable) -> str | None:
    """Give the start values as text."""
    return None if variable.start is None else " ".join(map(repr, variable.start))


def unknowns(description: Description) -> tuple[tuple[str, list[str]], ...]:
    """Give the sections of ModelStructure: FMI 2.0's names of them, with the names of the unknowns."""
    outputs = [v.name for v in description.variables if v.causality == "output"]
    derivatives = [v.name for v in description.variables if v.derivative_of is not None]
    return (
        ("Outputs", outputs),
        ("Derivatives", derivatives),
        ("InitialUnknowns", list(description.initial_dependencies)),
    )


def needs_of(description: Description, section: str, name: str) -> tuple[str, ...] | None:
    """Give what an unknown depends on; None: not said."""
    if section == "InitialUnknowns":
        return description.initial_dependencies[name]
    if name in description.states and section == "Outputs":  # a state depends on itself
        return (name,)
    return description.dependencies.get(name)


def finish(root: Element) -> str:
    """Give the document as text."""
    indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{tostring(root, encoding="unicode")}\n'


def flags(**values: bool) -> dict[str, str]:
    """Give the flags that are set."""
    return {name: "true" for name, there in values.items() if there}
