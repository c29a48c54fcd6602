"""The FMUs of ``c/small2.c``: linear systems of first order, and the parts of a nonlinear loop."""

from collections.abc import Mapping
from pathlib import Path

from tests.fmi.compiled import compile_fmu, with_description

NAMES = ("u", "v", "x", "y", "z", "A", "B", "C", "D", "KIND", "SAYS")
CAN = {
    "state": 'canGetAndSetFMUstate="true"',
    "slopes": 'canInterpolateInputs="true"',
    "D": 'providesDirectionalDerivative="true"',
    "steps": 'canHandleVariableCommunicationStepSize="true"',
    "once": 'canBeInstantiatedOnlyOncePerProcess="true"',
}
USED: Mapping[str, float] = {"A": -1.0, "D": 1.0}  # y = u
# the pair of ``test_coupled.py``
ONE = {"A": -0.9, "B": 0.5, "C": 3.0, "D": 1.0, "x": 1.0}
TWO = {"A": -1.0, "B": 10.0, "C": -31.0, "D": -0.9, "x": 1.0}


def compiled(folder: Path, *defines: str) -> Path:
    """Compile the FMU, which can do nothing; :func:`able` makes one that can."""
    sources = ("small2.c", "unused.c")
    return compile_fmu(folder / "small.fmu", xml(), *sources, defines=("FMI=2", *defines))


def able(fmu: Path, target: Path, *can: str, **values: float) -> Path:
    """Copy it with capabilities of ``CAN`` and start values, such as ``A=-1.0``, ``x=1.0``."""
    return with_description(fmu, target, xml(*can, **values))


def xml(*can: str, **values: float) -> str:
    """Describe it; a linear system has u and y, the others their own inputs and outputs."""
    kind = values.get("KIND", 0.0)
    inputs = {0.0: "u", 1.0: "u", 2.0: "uv", 3.0: ""}[kind]
    outputs = {0.0: "xy", 1.0: "yz", 2.0: "y", 3.0: "y"}[kind]
    scalars = []
    unknowns = []
    feeds = kind != 0.0 or values.get("D", 1.0) != 0.0
    numbers = " ".join(str(1 + NAMES.index(name)) for name in inputs) if feeds else ""
    for i, name in enumerate(NAMES):
        start = f'start="{values.get(name, 0.0)!r}"'
        roles = 'causality="parameter" variability="fixed" initial="exact"'
        if name in inputs:
            roles = 'causality="input" variability="continuous"'
        elif name in outputs:
            causality = 'causality="output" variability="continuous"'
            roles = f'{causality} initial="{"exact" if name == "x" else "calculated"}"'
            start = start if name == "x" else ""
            depends = "" if name == "x" else numbers
            unknowns.append(f'<Unknown index="{i + 1}" dependencies="{depends}"/>')
        elif name.islower():
            roles = 'causality="local" variability="continuous" initial="calculated"'
            start = ""
        attributes = f'name="{name}" valueReference="{i}" {roles}'
        scalars.append(f"<ScalarVariable {attributes}><Real {start}/></ScalarVariable>")
    abilities = " ".join(CAN[key] for key in can)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>'
        '<fmiModelDescription fmiVersion="2.0" modelName="small" guid="small">'
        f'<CoSimulation modelIdentifier="model" {abilities}/>'
        f"<ModelVariables>{''.join(scalars)}</ModelVariables>"
        f"<ModelStructure><Outputs>{''.join(unknowns)}</Outputs></ModelStructure>"
        "</fmiModelDescription>"
    )
