"""Read the manifest of the layered standard FMI-LS-DAE (a draft): the residual form of an FMU.

The draft's text, schema and sample disagree. All of their variants are read: the root fmiLayeredStandardManifest or fmi-dae,
attributes with or without the namespace, versions 0.0.1 and 0.1, and any description. With the root fmi-dae the attribute
isDaeFmu says whether there is a residual form at all; without it, what the manifest lists.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final
from xml.etree.ElementTree import Element

from cosim.fmi.description import Dae, Formulation
from cosim.fmi.reading.markup import Attributes, flag, parse
from cosim.fmi.variable import Variable

NAME: Final = "org.fmi-standard.fmi-ls-dae"
MANIFEST: Final = f"extra/{NAME}/fmi-ls-manifest.xml"
NAMESPACE: Final = "http://fmi-standard.org/fmi-ls-manifest"
ROOT: Final = "fmiLayeredStandardManifest"
ROOTS: Final = (ROOT, "fmi-dae")
VERSIONS: Final = ("0.0.1", "0.1")
UNKNOWNS: Final = ("Output", "ContinuousStateDerivative")


def read_dae(raw: bytes, variables: Sequence[Variable]) -> Dae | None:
    """Read a manifest; None: it says that there is no residual form. What is wrong with it is among its ``problems``."""
    try:
        root = parse(raw)
    except ValueError as error:
        return Dae("", problems=(f"it is not well-formed: {error}",))
    attributes = Attributes([])
    version = _about(root, attributes)
    structure = next(_children(root, "ModelStructure"), Element("none"))
    lists = next(_children(root, "AlgebraicVariables"), Element("none"))
    if (
        _local(root) == "fmi-dae"
        and not flag(root, "isDaeFmu")
        and not len(structure)
        and not len(lists)
    ):
        return None
    reader = _Reader(variables, attributes)
    algebraic = [reader.variable(element) for element in _children(lists, "AlgebraicVariable")]
    residuals = [
        [reader.formulation(element) for element in _children(residual, "Formulation")]
        for residual in _children(structure, "Residual")
    ]
    unknowns = [
        reader.formulation(element) for tag in UNKNOWNS for element in _children(structure, tag)
    ]
    _check(algebraic, residuals, reader, attributes.problems)
    return Dae(
        version,
        tuple(name for name in algebraic if name),
        tuple(tuple(one for one in formulations if one) for formulations in residuals),
        {unknown.name: unknown.dependencies for unknown in unknowns if unknown},
        tuple(attributes.problems),
    )


def _about(root: Element, attributes: Attributes) -> str:
    """Check whose manifest it is; give its version."""
    name, version = (
        root.get(f"{{{NAMESPACE}}}fmi-ls-{key}", root.get(f"fmi-ls-{key}", ""))
        for key in ("name", "version")
    )
    for what, found, needed in (
        ("the root", _local(root), ROOTS),
        ("fmi-ls-name", name, (NAME,)),
        ("fmi-ls-version", version, VERSIONS),
    ):
        if found not in needed:
            attributes.problems.append(f"{what}: found {found!r}, needed {' or '.join(needed)}")
    return version


def _local(element: Element) -> str:
    """Give the name of an element without its namespace; of a comment, which has a function for it, nothing."""
    return element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""


def _children(element: Element, tag: str) -> Iterator[Element]:
    return (child for child in element if _local(child) == tag)


class _Reader:
    """Finds the variables that a manifest refers to; what it does not find goes to the problems."""

    def __init__(self, variables: Sequence[Variable], attributes: Attributes) -> None:
        self.named = {v.name: v for v in variables}
        self._names = {v.reference: v.name for v in variables if v.alias_of is None}
        self._attributes = attributes

    def variable(self, element: Element) -> str | None:
        """Give the name behind the attribute valueReference."""
        where = _local(element)
        reference = self._attributes.integer(element, "valueReference", where)
        if reference is None or reference not in self._names:
            self._attributes.problems.append(
                f"{where}: valueReference={element.get('valueReference')} is no variable"
            )
            return None
        return self._names[reference]

    def formulation(self, element: Element) -> Formulation | None:
        """Give an unknown with what it depends on."""
        name = self.variable(element)
        if name is None:
            return None
        where = f"{_local(element)} {name!r}"
        known = self._attributes.integers(element, "dependencies", where)
        missing = [str(other) for other in known or () if other not in self._names]
        if missing:
            self._attributes.problems.append(
                f"{where}: dependencies name no variable: {', '.join(missing)}"
            )
        needs = (
            None
            if known is None
            else tuple(self._names[other] for other in known if other in self._names)
        )
        return Formulation(name, needs, self._attributes.integer(element, "index", where))


def _check(
    algebraic: Sequence[str | None],
    residuals: Sequence[Sequence[Formulation | None]],
    reader: _Reader,
    problems: list[str],
) -> None:
    """Check that the variables are what they should be, and as many equations as unknowns."""
    formulations = [one.name for equation in residuals for one in equation if one]
    for where, names in (
        ("AlgebraicVariable", [name for name in algebraic if name]),
        ("Formulation", formulations),
    ):
        for name in dict.fromkeys(names):
            if names.count(name) > 1:
                problems.append(
                    f"{where} {name!r} is listed {names.count(name)} times, needed once"
                )
            if reader.named[name].kind != "real" or reader.named[name].variability != "continuous":
                problems.append(
                    f"{where} {name!r}: found a variable that is not real and continuous, needed one that is"
                )
    if any(not equation for equation in residuals):
        problems.append("Residual: found no Formulation, needed one at least")
    problems += (
        _count([name for name in algebraic if name], residuals, reader) if not problems else []
    )


def _count(
    algebraic: Sequence[str], residuals: Sequence[Sequence[Formulation | None]], reader: _Reader
) -> list[str]:
    """Compare the elements of algebraic variables and equations; a fully implicit form has equations for the states too."""
    implicit = set()
    derivatives = {v.name for v in reader.named.values() if v.derivative_of is not None}
    for equation in residuals:
        implicit |= {
            name
            for one in equation
            if one
            for name in one.dependencies or ()
            if name in derivatives
        }
    unknowns = sum(reader.named[name].size for name in algebraic)
    equations = sum(reader.named[equation[0].name].size for equation in residuals if equation[0])
    if implicit or unknowns == equations:
        return []
    return [f"found {equations} residuals for {unknowns} algebraic variables, needed as many"]
