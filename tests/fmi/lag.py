"""The FMUs of ``c/lag2.c`` and ``c/lag3.c``: a lag with feedthrough, x' = u + d - x, y = x + u, and its closed form."""

import zipfile
from pathlib import Path

import numpy as np

from cosim.fmi.platforms import SUFFIX, folders
from tests.fmi.compiled import compile_fmu

PARAMETERS = (
    "longest", "begin", "until", "inner", "returns", "event", "announces", "iterations", "end", "fail", "status", "asks"
)  # fmt: skip
STARTS = {"longest": 1e9, "until": 1e9, "iterations": 1.0, "end": 1e9, "fail": 1e9, "asks": 2.0}
CAN = {
    "2": {
        "D": "providesDirectionalDerivative",
        "state": "canGetAndSetFMUstate",
        "lines": "canInterpolateInputs",
        "any step": "canHandleVariableCommunicationStepSize",
    },
    "3": {
        "D": "providesDirectionalDerivatives",
        "state": "canGetAndSetFMUState",
        "lines": "providesIntermediateUpdate",
        "any step": "canHandleVariableCommunicationStepSize",
        "events": "hasEventMode",
    },
}


def xml(version: str, *can: str) -> str:
    """Describe the lag; ``can``: keys of ``CAN``."""
    abilities = " ".join(f'{CAN[version][key]}="true"' for key in can)
    if version == "2":
        head = 'fmiVersion="2.0" guid="lag"'
        outputs = '<Outputs><Unknown index="3" dependencies=""/><Unknown index="4" dependencies="1"/><Unknown index="5" dependencies=""/></Outputs>'

        def variable(number, name, causality, variability, initial, start):
            kind = f'<Real{"" if start is None else f""" start="{start}" """}/>'
            first = f'name="{name}" valueReference="{number}" causality="{causality}" variability="{variability}"'
            return f'<ScalarVariable {first}{f""" initial="{initial}" """ if initial else ""}>{kind}</ScalarVariable>'

    else:
        head = 'fmiVersion="3.0" instantiationToken="lag"'
        outputs = '<Output valueReference="2" dependencies=""/><Output valueReference="3" dependencies="0"/><Output valueReference="4" dependencies=""/>'

        def variable(number, name, causality, variability, initial, start):
            first = f'name="{name}" valueReference="{number}" causality="{causality}" variability="{variability}"'
            rest = (f' initial="{initial}"' if initial else "") + ("" if start is None else f' start="{start}"')
            return f"<Float64 {first}{rest}/>"

    rows = [
        ("u", "input", "continuous", None, 0.0),
        ("d", "input", "discrete", None, 0.0),
        ("x", "output", "continuous", "exact", 0.0),
        ("y", "output", "continuous", "calculated", None),
        ("calls", "output", "discrete", "exact", 0.0),
        *((name, "parameter", "fixed", "exact", STARTS.get(name, 0.0)) for name in PARAMETERS),
    ]
    variables = "".join(variable(number, *row) for number, row in enumerate(rows))
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription {head} modelName="lag">'
        f'<CoSimulation modelIdentifier="model" {abilities}/><ModelVariables>{variables}</ModelVariables>'
        f"<ModelStructure>{outputs}</ModelStructure></fmiModelDescription>"
    )


def build(folder: Path, version: str) -> Path:
    """Compile the lag of one version, able to do nothing."""
    return compile_fmu(folder / f"lag{version}.fmu", xml(version), f"lag{version}.c")


def able(fmu: Path, target: Path, version: str, *can: str) -> Path:
    """Copy a compiled lag with abilities."""
    member = f"binaries/{folders(f'{version}.0')[0]}/model{SUFFIX}"
    with zipfile.ZipFile(fmu) as source, zipfile.ZipFile(target, "w") as archive:
        archive.writestr("modelDescription.xml", xml(version, *can))
        archive.writestr(member, source.read(member))
    return target


def on_a_line(t, u0, slope, x0=0.0):
    """Give x(t) for u = u0 + slope t from x(0) = x0: a straight line that lags by 1 s, and what decays."""
    return u0 + slope * t - slope + (x0 - u0 + slope) * np.exp(-t)


def on_a_sine(t, x0=0.0):
    """Give x(t) for u = sin t: (sin t - cos t)/2 + (x0 + 1/2) exp(-t)."""
    return 0.5 * (np.sin(t) - np.cos(t)) + (x0 + 0.5) * np.exp(-t)
