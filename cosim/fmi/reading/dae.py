"""Read the manifest of the layered standard FMI-LS-DAE (a draft): the residual form of an FMU.

The draft's text, schema and sample disagree. All of their variants are read: the root
fmiLayeredStandardManifest or fmi-dae, attributes with or without the namespace, versions 0.0.1 and
0.1, and any description. With the root fmi-dae the attribute isDaeFmu says whether there is a
residual form at all; without it, what the manifest lists.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final
from xml.etree.ElementTree import Element

from cosim.fmi.description import Dae, Formulation
from cosim.fmi.reading.dependencies import known_names
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
    """Read a manifest; None: it says that there is no residual form.

    What is wrong with the manifest is among the ``problems`` of the result.
    """
    try:
        root = parse(raw)
    except ValueError as error:
        return Dae("", problems=(f"it is not well-formed: {error}",))
    attributes = Attributes()
    version = _read_version(root, attributes)
    structure = _child(root, "ModelStructure")
    algebraic_variables = _child(root, "AlgebraicVariables")
    lists_nothing = not len(structure) and not len(algebraic_variables)
    if _local_name(root) == "fmi-dae" and lists_nothing and not flag(root, "isDaeFmu"):
        return None
    reader = _ManifestReader(variables, attributes)
    algebraic = reader.variables(algebraic_variables, "AlgebraicVariable")
    residuals = [
        reader.formulations(element, "Formulation") for element in _children(structure, "Residual")
    ]
    dependencies = {}
    for tag in UNKNOWNS:
        for unknown in reader.formulations(structure, tag):
            dependencies[unknown.name] = unknown.dependencies
    _check_variables("AlgebraicVariable", algebraic, reader)
    _check_residuals(structure, residuals, reader)
    attributes.problems += attributes.warnings
    if not attributes.problems:
        _check_count(algebraic, residuals, reader)
    problems = tuple(attributes.problems)
    return Dae(version, tuple(algebraic), tuple(residuals), dependencies, problems)


def _read_version(root: Element, attributes: Attributes) -> str:
    """Check which layered standard a manifest belongs to; return its version."""
    _check_word("the root", _local_name(root), ROOTS, attributes)
    name = _manifest_attribute(root, "name")
    _check_word("fmi-ls-name", name, (NAME,), attributes)
    version = _manifest_attribute(root, "version")
    _check_word("fmi-ls-version", version, VERSIONS, attributes)
    return version


def _check_word(what: str, word: str, allowed: Sequence[str], attributes: Attributes) -> None:
    if word not in allowed:
        attributes.report(what, repr(word), " or ".join(allowed))


def _manifest_attribute(root: Element, key: str) -> str:
    """Return an attribute of the manifest, with or without its namespace."""
    plain = root.get(f"fmi-ls-{key}", "")
    return root.get(f"{{{NAMESPACE}}}fmi-ls-{key}", plain)


def _local_name(element: Element) -> str:
    """Return the name of an element without its namespace; "" of a comment."""
    # The tag of a comment is a function.
    return element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""


def _children(element: Element, tag: str) -> list[Element]:
    return [child for child in element if _local_name(child) == tag]


def _child(element: Element, tag: str) -> Element:
    """Return the first child of a name; an empty element where there is none."""
    return next(iter(_children(element, tag)), Element("none"))


class _ManifestReader:
    """Finds the variables that a manifest refers to; what it does not find goes to ``problems``."""

    def __init__(self, variables: Sequence[Variable], attributes: Attributes) -> None:
        self.named = {variable.name: variable for variable in variables}
        self.problems = attributes.problems
        self._names = {v.reference: v.name for v in variables if v.alias_of is None}
        self._attributes = attributes

    def variables(self, parent: Element, tag: str) -> list[str]:
        """Return the names of the variables that the children of one tag refer to."""
        names = [self._variable(element) for element in _children(parent, tag)]
        return [name for name in names if name]

    def formulations(self, parent: Element, tag: str) -> tuple[Formulation, ...]:
        """Return the unknowns that the children of one tag refer to."""
        formulations = [self._formulation(element) for element in _children(parent, tag)]
        return tuple(formulation for formulation in formulations if formulation is not None)

    def _variable(self, element: Element) -> str | None:
        """Return the name behind the attribute valueReference."""
        where = _local_name(element)
        reference = self._attributes.integer(element, "valueReference", where)
        if reference is None or reference not in self._names:
            found = element.get("valueReference")
            self.problems.append(f"{where}: valueReference={found} is no variable")
            return None
        return self._names[reference]

    def _formulation(self, element: Element) -> Formulation | None:
        """Return an unknown with what it depends on."""
        name = self._variable(element)
        if name is None:
            return None
        where = f"{_local_name(element)} {name!r}"
        dependencies = known_names(element, self._names, where, self._attributes)
        index = self._attributes.integer(element, "index", where)
        return Formulation(name, dependencies, index)


def _check_variables(where: str, names: Sequence[str], reader: _ManifestReader) -> None:
    """Check that variables are listed once, and are real and continuous."""
    for name in dict.fromkeys(names):
        count = names.count(name)
        if count > 1:
            reader.problems.append(f"{where} {name!r} is listed {count} times; expected once")
        variable = reader.named[name]
        if variable.signal_type != "real" or variable.variability != "continuous":
            reader.problems.append(f"{where} {name!r}: expected a real, continuous variable")


def _check_residuals(
    structure: Element, residuals: Sequence[Sequence[Formulation]], reader: _ManifestReader
) -> None:
    """Check the variables of the equations, and that none is without."""
    names: list[str] = []
    for residual in residuals:
        names += [formulation.name for formulation in residual]
    _check_variables("Formulation", names, reader)
    elements = _children(structure, "Residual")
    if not all(_children(element, "Formulation") for element in elements):
        reader.problems.append("Residual: expected at least one Formulation, got none")


def _check_count(
    algebraic: Sequence[str],
    residuals: Sequence[Sequence[Formulation]],
    reader: _ManifestReader,
) -> None:
    """Check that there are as many equations as algebraic variables, element by element.

    A fully implicit form, where equations depend on derivatives, has equations for the states too.
    """
    variables = reader.named.values()
    derivatives = {v.name for v in variables if v.derivative_of is not None}
    for residual in residuals:
        for formulation in residual:
            if not derivatives.isdisjoint(formulation.dependencies or ()):
                return
    unknowns = sum(reader.named[name].size for name in algebraic)
    equations = sum(reader.named[residual[0].name].size for residual in residuals)
    if unknowns != equations:
        reader.problems.append(
            f"expected as many residuals as algebraic variables ({unknowns}), got {equations}"
        )
