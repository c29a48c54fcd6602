"""Read what an .fmu says about itself, without unpacking it; refuse what is no FMU.

``archive.py`` judges the archive; the XML is parsed by fmpy.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree

from cosim.errors import FmuError
from cosim.fmi.archive import look
from cosim.fmi.description import Capabilities, Description, Mode, Variable
from cosim.fmi.references import VariableType

XML = "modelDescription.xml"


@dataclass(frozen=True, slots=True)
class Archive:
    """An .fmu file that was looked into.

    Parameters
    ----------
    path : Path
    sha256 : str
        Of the file, in hexadecimal.
    xml : str
        Its modelDescription.xml.
    members : frozenset of str
        Names of the files in it.
    description : Description
    """

    path: Path
    sha256: str
    xml: str
    members: frozenset[str]
    description: Description


def read(path: Path | str) -> Archive:
    """Look into an .fmu.

    Raises
    ------
    FmuError
        If the file is missing, no zip archive or one that cannot be unpacked, without modelDescription.xml, or the XML is
        broken or of a version that is not supported.
    """
    path = Path(path)
    if not path.is_file():
        raise FmuError(f"{path}: there is no such file" if not path.exists() else f"{path}: needed an .fmu file, found a folder")
    members, raw = look(path, XML)
    if raw is None:
        raise FmuError(f"{path}: not an FMU, as the archive has no {XML}")
    try:
        root = ElementTree.fromstring(raw)
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # the last two: an encoding that is not known
        raise FmuError(f"{path}: {XML} is not well-formed: {error}") from error
    _check_version(path, root.get("fmiVersion"))
    description = _description(path, raw, root, members)
    return Archive(path, hashlib.sha256(path.read_bytes()).hexdigest(), raw.decode("utf-8", "replace"), members, description)


def _check_version(path: Path, version: str | None) -> None:
    if version == "1.0":
        raise FmuError(f"{path}: FMI 1.0 is not supported yet; FMI 2.0 and 3.0 are")
    if version is None or not (version == "2.0" or version.startswith("3.")):
        raise FmuError(f"{path}: unknown FMI version {version!r}; FMI 2.0 and 3.0 are supported")


def _description(path: Path, raw: bytes, root: ElementTree.Element, members: frozenset[str]) -> Description:
    from fmpy.model_description import read_model_description

    try:
        with TemporaryDirectory(prefix="cosim-xml-") as folder:  # from the archive, fmpy would leave it open where reading fails
            (file := Path(folder) / XML).write_bytes(raw)
            found = read_model_description(str(file), validate=False)
        return _described(found, root, members, path.stem)
    except Exception as error:  # fmpy raises what its parsing happens to raise: KeyError, ValueError, Exception, ...
        raise FmuError(f"{path}: {XML} cannot be read: {type(error).__name__}: {error}") from error


def _described(found: Any, root: ElementTree.Element, members: frozenset[str], stem: str) -> Description:
    variables = tuple(_variable(v, found.fmiMajorVersion) for v in found.modelVariables if v.alias is None)
    states = tuple(unknown.variable.derivative.name for unknown in found.derivatives)
    causality = {variable.name: variable.causality for variable in variables}
    kinds: dict[Mode, Any] = {"me": found.modelExchange, "cs": found.coSimulation}
    return Description(
        name=found.modelName or stem,
        token=found.guid or "",
        version=found.fmiVersion,
        variables=variables,
        states=states,
        dependencies={u.variable.name: _names(u.dependencies) for u in (*found.outputs, *found.derivatives)},
        capabilities={mode: _capabilities(kind, root, mode) for mode, kind in kinds.items() if kind is not None},
        event_indicators=found.numberOfEventIndicators,
        clocks=tuple(v.name for v in variables if v.type == "Clock"),
        platforms=tuple(sorted({name.split("/")[1] for name in members if name.startswith("binaries/") and name.count("/") > 1})),
        read=tuple(name for name in states if causality.get(name) == "local"),
    )


def _capabilities(kind: Any, root: ElementTree.Element, mode: Mode) -> Capabilities:
    element = root.find({"me": "ModelExchange", "cs": "CoSimulation"}[mode])
    assert element is not None

    def flag(*names: str) -> bool:
        return any(element.get(name) in ("true", "1") for name in names)

    needs_step = flag("needsCompletedIntegratorStep") if str(root.get("fmiVersion")).startswith("3.") else True
    return Capabilities(
        identifier=kind.modelIdentifier,
        directional_derivatives=flag("providesDirectionalDerivative", "providesDirectionalDerivatives"),
        saves_state=flag("canGetAndSetFMUstate", "canGetAndSetFMUState"),
        interpolates_inputs=flag("canInterpolateInputs"),
        variable_step=flag("canHandleVariableCommunicationStepSize"),
        fixed_step=_fixed_step(element.get("fixedInternalStepSize")),
        completed_step=needs_step and not flag("completedIntegratorStepNotNeeded"),
    )


def _fixed_step(text: str | None) -> float | None:
    if text is None:
        return None
    step = float(text)
    if not 0.0 < step < math.inf:
        raise ValueError(f"fixedInternalStepSize: found {text}, needed a positive number")
    return step


def _names(variables: Any) -> tuple[str, ...] | None:
    return None if variables is None else tuple(variable.name for variable in variables)


def _variable(found: Any, version: int) -> Variable:
    integer: VariableType = "Int32" if version == 2 else "Int64"
    kind: VariableType = {"Real": "Float64", "Integer": "Int32", "Enumeration": integer}.get(found.type, found.type)
    declared = found.declaredType

    def attribute(name: str) -> Any:
        own = getattr(found, name)
        return own if own is not None or declared is None else getattr(declared, name)

    low, high = attribute("min"), attribute("max")
    return Variable(
        name=found.name,
        reference=found.valueReference,
        causality=found.causality,
        type=kind,
        variability=found.variability if kind in ("Float32", "Float64") or found.variability != "continuous" else "discrete",
        initial=found.initial,
        size=math.prod(found.shape or (1,)),
        unit=attribute("unit"),
        start=_start(found.start, kind),
        minimum=-math.inf if low is None else float(low),
        maximum=math.inf if high is None else float(high),
        derivative_of=None if found.derivative is None else found.derivative.name,
    )


def _start(text: str | None, kind: str) -> tuple[float, ...] | None:
    if text is None or kind in ("String", "Binary", "Clock"):
        return None
    if kind == "Boolean":
        return tuple(float(word in ("true", "1")) for word in text.split())
    return tuple(float(word) for word in text.split())
