"""The FMUs of ``c/lag*.c``: a lag with feedthrough, x' = u + d - x, y = x + u, and its closed form."""

import zipfile
from pathlib import Path

import numpy as np

from cosim.fmi.platforms import SUFFIX, folders
from tests.fmi.compiled import compile_fmu

PARAMETERS = (
    "longest", "begin", "until", "inner", "returns", "event", "announces", "iterations", "end", "fail", "status", "asks"
)  # fmt: skip
STARTS = {"longest": 1e9, "until": 1e9, "iterations": 1.0, "end": 1e9, "fail": 1e9, "asks": 2.0}
VARIABLES = (  # name, causality, variability, initial, start
    ("u", "input", "continuous", None, 0.0),
    ("d", "input", "discrete", None, 0.0),
    ("x", "output", "continuous", "exact", 0.0),
    ("y", "output", "continuous", "calculated", None),
    ("calls", "output", "discrete", "exact", 0.0),
    ("z", "local", "discrete", "calculated", None),
    *((name, "parameter", "fixed", "exact", STARTS.get(name, 0.0)) for name in PARAMETERS),
)
NUMBER = {name: number for number, (name, *_) in enumerate(VARIABLES)}
CAN = {
    "1": {
        "lines": 'canInterpolateInputs="true"',
        "any step": 'canHandleVariableCommunicationStepSize="true"',
    },
    "2": {
        "D": 'providesDirectionalDerivative="true"',
        "state": 'canGetAndSetFMUstate="true"',
        "lines": 'canInterpolateInputs="true"',
        "any step": 'canHandleVariableCommunicationStepSize="true"',
    },
    "3": {
        "D": 'providesDirectionalDerivatives="true"',
        "state": 'canGetAndSetFMUState="true"',
        "lines": 'providesIntermediateUpdate="true"',
        "any step": 'canHandleVariableCommunicationStepSize="true"',
        "events": 'hasEventMode="true"',
        "inner step of 30 ms": 'fixedInternalStepSize="0.03"',
        "d moves": "",
        "d is shown": "",
    },
}


def xml(version: str, *can: str) -> str:
    """Describe the lag; ``can``: keys of ``CAN``. "d moves": it is continuous, but cannot be set inside a step.

    "d is shown": z = d is an output, and depends on d directly.
    """
    describe = {"1": _xml1, "2": _xml2, "3": _xml3}[version]
    found = f'<?xml version="1.0" encoding="UTF-8"?>{describe(" ".join(CAN[version][key] for key in can))}'
    before, after = (
        'name="d" valueReference="1" causality="input" variability="' + kind
        for kind in ("discrete", "continuous")
    )
    if "d is shown" in can:
        output = f'<Output valueReference="{NUMBER["z"]}" dependencies="{NUMBER["d"]}"/>'
        found = found.replace('causality="local"', 'causality="output"').replace(
            "</ModelStructure>", f"{output}</ModelStructure>"
        )
    return found.replace(before, after) if "d moves" in can else found


def _attributes(number, name, *rest):
    return f'name="{name}" valueReference="{number}" ' + " ".join(rest)


def _start(start):
    return "" if start is None else f'start="{start}"'


def _xml1(abilities):
    found = []
    for number, (name, causality, variability, _, start) in enumerate(VARIABLES):
        if causality == "local":
            continue
        fed = f"<DirectDependency>{'<Name>u</Name>' if name == 'y' else ''}</DirectDependency>"
        rest = (
            'variability="parameter"'
            if causality == "parameter"
            else f'causality="{causality}" variability="{variability}"'
        )
        body = f"<Real/>{fed}" if causality == "output" else f"<Real {_start(start)}/>"
        found.append(f"<ScalarVariable {_attributes(number, name, rest)}>{body}</ScalarVariable>")
    return (
        '<fmiModelDescription fmiVersion="1.0" modelName="lag" modelIdentifier="model" guid="lag" numberOfContinuousStates="0" '
        f'numberOfEventIndicators="0"><ModelVariables>{"".join(found)}</ModelVariables><Implementation><CoSimulation_StandAlone>'
        f"<Capabilities {abilities}/></CoSimulation_StandAlone></Implementation></fmiModelDescription>"
    )


def _xml2(abilities):
    found = []
    for number, (name, causality, variability, initial, start) in enumerate(VARIABLES):
        rest = (
            f'causality="{causality}" variability="{variability}"',
            f'initial="{initial}"' if initial else "",
        )
        found.append(
            f"<ScalarVariable {_attributes(number, name, *rest)}><Real {_start(start)}/></ScalarVariable>"
        )
    outputs = "".join(
        f'<Unknown index="{i}" dependencies="{inputs}"/>'
        for i, inputs in ((3, ""), (4, "1"), (5, ""))
    )
    return (
        f'<fmiModelDescription fmiVersion="2.0" modelName="lag" guid="lag"><CoSimulation modelIdentifier="model" {abilities}/>'
        f"<ModelVariables>{''.join(found)}</ModelVariables><ModelStructure><Outputs>{outputs}</Outputs></ModelStructure>"
        "</fmiModelDescription>"
    )


def _xml3(abilities):
    found = []
    for number, (name, causality, variability, initial, start) in enumerate(VARIABLES):
        rest = (
            f'causality="{causality}" variability="{variability}"',
            f'initial="{initial}"' if initial else "",
            _start(start),
        )
        asked = 'intermediateUpdate="true"' if name == "u" else ""
        found.append(f"<Float64 {_attributes(number, name, *rest, asked)}/>")
    outputs = "".join(
        f'<Output valueReference="{i}" dependencies="{inputs}"/>'
        for i, inputs in ((2, ""), (3, "0"), (4, ""))
    )
    return (
        f'<fmiModelDescription fmiVersion="3.0" modelName="lag" instantiationToken="lag"><CoSimulation modelIdentifier="model" '
        f"{abilities}/><ModelVariables>{''.join(found)}</ModelVariables><ModelStructure>{outputs}</ModelStructure>"
        "</fmiModelDescription>"
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
