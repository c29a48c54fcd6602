"""Write the residual form of a description as a manifest of the layered standard FMI-LS-DAE, a draft.

Text, schema and sample of the draft (https://github.com/modelica/fmi-ls-dae, 30 September 2025) disagree: the schema knows no
structure at all, and has another name for the root. What is written follows the text, section "Layered Standard Manifest File",
version 0.0.1; the file says so.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final
from xml.etree.ElementTree import Comment, Element, SubElement

from cosim.fmi.description import Description
from cosim.fmi.exporting.writing import finish
from cosim.fmi.exporting.writing_fmi3 import add_structure, add_unknown
from cosim.fmi.reading.dae import NAME, NAMESPACE, ROOT

VERSION: Final = "0.0.1"
NOTE: Final = (
    f" Follows the text of the draft of {NAME}, version {VERSION}; its schema (root fmi-dae, attribute isDaeFmu, no structure) "
    "and its sample (version 0.1) say otherwise. "
)


def write_dae(description: Description, *, constant: bool) -> str:
    """Write the manifest; ``constant``: every unknown is a sum of constants times what it depends on."""
    dae = description.dae
    assert dae is not None
    about = {
        "name": NAME,
        "version": VERSION,
        "description": "Layered standard for DAE support in FMI",
    }
    root = Element(
        ROOT,
        {"xmlns:fmi-ls": NAMESPACE} | {f"fmi-ls:fmi-ls-{key}": text for key, text in about.items()},
    )
    root.append(Comment(NOTE))
    references = {variable.name: str(variable.reference) for variable in description.variables}
    listed = SubElement(root, "AlgebraicVariables")
    for name in dae.algebraic:
        SubElement(listed, "AlgebraicVariable", valueReference=references[name])
    structure = add_structure(
        root, replace(description, dependencies=dae.dependencies), references, constant
    )
    for formulations in dae.residuals:
        residual = SubElement(structure, "Residual")
        for one in formulations:
            add_unknown(residual, "Formulation", one.name, one.dependencies, references, constant)
    return finish(root)
