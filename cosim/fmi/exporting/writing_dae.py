"""Write the residual form of a description as a manifest of FMI-LS-DAE, a draft.

Text, schema and sample of the draft (https://github.com/modelica/fmi-ls-dae, 30 September 2025)
disagree: the schema knows no structure at all, and has another name for the root. What is written
follows the text, section "Layered Standard Manifest File", version 0.0.1; the file says so.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final
from xml.etree.ElementTree import Comment, Element, SubElement

from cosim.fmi.description import Description
from cosim.fmi.exporting.writing import finish, set_dependencies
from cosim.fmi.exporting.writing_fmi3 import add_structure
from cosim.fmi.reading.dae import NAME, NAMESPACE, ROOT

VERSION: Final = "0.0.1"
NOTE: Final = (
    f" Follows the text of the draft of {NAME}, version {VERSION}; its schema (root fmi-dae, "
    "attribute isDaeFmu, no structure) and its sample (version 0.1) say otherwise. "
)


def write_dae(description: Description, *, constant: bool) -> str:
    """Write the manifest.

    Parameters
    ----------
    description : Description
        With a residual form.
    constant : bool
        Every unknown is a sum of constants times what it depends on.
    """
    dae = description.dae
    assert dae is not None
    root = Element(ROOT, _root_attributes())
    root.append(Comment(NOTE))
    references = {variable.name: str(variable.reference) for variable in description.variables}
    algebraic = SubElement(root, "AlgebraicVariables")
    for name in dae.algebraic:
        SubElement(algebraic, "AlgebraicVariable", valueReference=references[name])
    described = replace(description, dependencies=dae.dependencies)
    structure = add_structure(root, described, references, constant=constant)
    for formulations in dae.residuals:
        residual = SubElement(structure, "Residual")
        for formulation in formulations:
            reference = references[formulation.name]
            unknown = SubElement(residual, "Formulation", valueReference=reference)
            set_dependencies(unknown, formulation.dependencies, references, constant=constant)
    return finish(root)


def _root_attributes() -> dict[str, str]:
    attributes = {
        "name": NAME,
        "version": VERSION,
        "description": "Layered standard for DAE support in FMI",
    }
    prefixed = {f"fmi-ls:fmi-ls-{name}": value for name, value in attributes.items()}
    return {"xmlns:fmi-ls": NAMESPACE} | prefixed
