"""The FMUs of ``c/lag*.c``, and their closed form: a lag x' = u + d - x, y = x + u."""

from pathlib import Path

import numpy as np

from tests.fmi.compiled import compile_fmu, with_description

PARAMETERS = (
    "longest",
    "begin",
    "until",
    "inner",
    "returns",
    "event",
    "announces",
    "iterations",
    "end",
    "fail",
    "status",
    "asks",
    "no_slopes",
)
STARTS = {
    "longest": 1e9,
    "until": 1e9,
    "iterations": 1.0,
    "end": 1e9,
    "fail": 1e9,
    "asks": 2.0,
    "no_slopes": 1e9,
}
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
        "returns": 'mightReturnEarlyFromDoStep="true"',
        "inner step of 30 ms": 'fixedInternalStepSize="0.03"',
        "inner step at 60 Hz": 'fixedInternalStepSize="0.016666666666666666"',
        "d moves": "",
        "d is shown": "",
    },
}


HEADER = '<?xml version="1.0" encoding="UTF-8"?>'


def xml(version: str, *can: str) -> str:
    """Describe the lag; ``can``: keys of ``CAN``.

    "d moves": it is continuous, but cannot be set inside a step. "d is shown": z = d is an output,
    and depends on d directly.
    """
    describe = {"1": _xml1, "2": _xml2, "3": _xml3}[version]
    description = HEADER + describe(" ".join(CAN[version][key] for key in can))
    if "d is shown" in can:
        output = f'<Output valueReference="{NUMBER["z"]}" dependencies="{NUMBER["d"]}"/>'
        end = "</ModelStructure>"
        description = description.replace('causality="local"', 'causality="output"')
        description = description.replace(end, output + end)
    if "d moves" in can:
        d = 'name="d" valueReference="1" causality="input"'
        discrete = f'{d} variability="discrete"'
        description = description.replace(discrete, f'{d} variability="continuous"')
    return description


def _attributes(number, name, *roles):
    return f'name="{name}" valueReference="{number}" ' + " ".join(roles)


def _roles(causality, variability, initial=None):
    roles = f'causality="{causality}" variability="{variability}"'
    return f'{roles} initial="{initial}"' if initial else roles


def _start(start):
    return "" if start is None else f'start="{start}"'


def _xml1(abilities):
    scalars = []
    for number, (name, causality, variability, _, start) in enumerate(VARIABLES):
        if causality == "local":
            continue
        roles = _roles(causality, variability)
        if causality == "parameter":
            roles = 'variability="parameter"'
        content = f"<Real {_start(start)}/>"
        if causality == "output":
            inputs = "<Name>u</Name>" if name == "y" else ""
            content = f"<Real/><DirectDependency>{inputs}</DirectDependency>"
        attributes = _attributes(number, name, roles)
        scalars.append(f"<ScalarVariable {attributes}>{content}</ScalarVariable>")
    return (
        '<fmiModelDescription fmiVersion="1.0" modelName="lag" modelIdentifier="model" guid="lag" '
        'numberOfContinuousStates="0" numberOfEventIndicators="0">'
        f"<ModelVariables>{''.join(scalars)}</ModelVariables>"
        f"<Implementation><CoSimulation_StandAlone><Capabilities {abilities}/>"
        "</CoSimulation_StandAlone></Implementation></fmiModelDescription>"
    )


def _xml2(abilities):
    scalars = []
    for number, (name, causality, variability, initial, start) in enumerate(VARIABLES):
        attributes = _attributes(number, name, _roles(causality, variability, initial))
        scalars.append(f"<ScalarVariable {attributes}><Real {_start(start)}/></ScalarVariable>")
    outputs = (
        '<Unknown index="3" dependencies=""/><Unknown index="4" dependencies="1"/>'
        '<Unknown index="5" dependencies=""/>'
    )
    return (
        '<fmiModelDescription fmiVersion="2.0" modelName="lag" guid="lag">'
        f'<CoSimulation modelIdentifier="model" {abilities}/>'
        f"<ModelVariables>{''.join(scalars)}</ModelVariables>"
        f"<ModelStructure><Outputs>{outputs}</Outputs></ModelStructure></fmiModelDescription>"
    )


def _xml3(abilities):
    variables = []
    for number, (name, causality, variability, initial, start) in enumerate(VARIABLES):
        update = 'intermediateUpdate="true"' if name == "u" else ""
        roles = _roles(causality, variability, initial)
        attributes = _attributes(number, name, roles, _start(start), update)
        variables.append(f"<Float64 {attributes}/>")
    outputs = (
        '<Output valueReference="2" dependencies=""/><Output valueReference="3" dependencies="0"/>'
        '<Output valueReference="4" dependencies=""/>'
    )
    return (
        '<fmiModelDescription fmiVersion="3.0" modelName="lag" instantiationToken="lag">'
        f'<CoSimulation modelIdentifier="model" {abilities}/>'
        f"<ModelVariables>{''.join(variables)}</ModelVariables>"
        f"<ModelStructure>{outputs}</ModelStructure></fmiModelDescription>"
    )


def build(folder: Path, version: str) -> Path:
    """Compile the lag of one version, without any capability."""
    return compile_fmu(folder / f"lag{version}.fmu", xml(version), f"lag{version}.c")


def able(fmu: Path, target: Path, version: str, *can: str) -> Path:
    """Copy a compiled lag with some capabilities."""
    return with_description(fmu, target, xml(version, *can))


def on_a_line(t, u0, slope, x0=0.0):
    """Return x(t) for u = u0 + slope t from x(0) = x0: u lagging by 1 s, and what decays."""
    return u0 + slope * t - slope + (x0 - u0 + slope) * np.exp(-t)


def on_a_sine(t, x0=0.0):
    """Return x(t) for u = sin t: (sin t - cos t)/2 + (x0 + 1/2) exp(-t)."""
    return 0.5 * (np.sin(t) - np.cos(t)) + (x0 + 0.5) * np.exp(-t)
