"""The FMU of ``c/clocked3.c``, with the clocks that a test needs."""

from functools import cache
from pathlib import Path

from tests.fmi.compiled import compile_fmu, kept_folder, with_description

CLOCKS = {  # name: value reference, causality, interval
    "sample": (1, "input", 'intervalVariability="constant" intervalDecimal="0.1"'),
    "asked": (2, "input", 'intervalVariability="fixed"'),
    "next": (3, "input", 'intervalVariability="changing"'),
    "in": (4, "input", 'intervalVariability="triggered"'),
    "later": (5, "input", 'intervalVariability="countdown"'),
    "out": (6, "output", 'intervalVariability="triggered"'),
}
CLOCKED = {  # name: value reference, causality, clock
    "u": (10, "input", "sample"),
    "v": (11, "input", "in"),
    "count": (12, "output", "sample"),
    "sum": (13, "output", "sample"),
    "when": (14, "output", "sample"),
    "asked_count": (15, "output", "asked"),
    "next_count": (16, "output", "next"),
    "in_count": (17, "output", "in"),
    "latched": (18, "output", "in"),
    "later_count": (19, "output", "later"),
    "later_when": (20, "output", "later"),
    "shown": (21, "output", "out"),
}
INPUT_OF = {"sum": "u", "shown": "u", "latched": "v"}
PARAMETERS = {
    "every": (24, 2.0),
    "period": (25, 0.3),
    "offset": (26, 0.0),
    "step": (27, 0.01),
    "delay": (28, 0.025),
}
CAN = {
    "any step": 'canHandleVariableCommunicationStepSize="true"',
    "state": 'canGetAndSetFMUState="true"',
    "events": 'hasEventMode="true"',
}


def xml(clocks: tuple[str, ...], can: tuple[str, ...], changes: dict[str, str]) -> str:
    """Describe the FMU with some of its clocks; ``changes`` are other attributes of them."""
    variables = ['<Float64 name="time" valueReference="0" causality="independent"/>']
    outputs = ['<Output valueReference="22" dependencies=""/>']
    for name in clocks:
        reference, causality, interval = CLOCKS[name]
        attributes = changes.get(name, interval)
        variables.append(
            f'<Clock name="{name}" valueReference="{reference}" causality="{causality}" '
            f"{attributes}/>"
        )
        if causality == "output":
            outputs.append(f'<Output valueReference="{reference}" dependencies=""/>')
    for name, (reference, causality, clock) in CLOCKED.items():
        if clock not in clocks:
            continue
        start = ' start="0"' if causality == "input" else ""
        variables.append(
            f'<Float64 name="{name}" valueReference="{reference}" causality="{causality}" '
            f'variability="discrete" clocks="{CLOCKS[clock][0]}"{start}/>'
        )
        if causality == "output":
            source = INPUT_OF.get(name)
            is_there = source is not None and CLOCKED[source][2] in clocks
            dependencies = CLOCKED[source][0] if is_there else ""
            outputs.append(f'<Output valueReference="{reference}" dependencies="{dependencies}"/>')
    variables += [
        '<Float64 name="x" valueReference="22" causality="output" initial="exact" start="0"/>',
        '<Float64 name="der(x)" valueReference="23" derivative="22"/>',
    ]
    for name, (reference, start) in PARAMETERS.items():
        variability = "tunable" if name == "period" else "fixed"
        variables.append(
            f'<Float64 name="{name}" valueReference="{reference}" causality="parameter" '
            f'variability="{variability}" start="{start}"/>'
        )
    state = CAN["state"] if "state" in can else ""
    abilities = " ".join(CAN[key] for key in can)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>'
        '<fmiModelDescription fmiVersion="3.0" modelName="clocked" instantiationToken="x">'
        f'<ModelExchange modelIdentifier="model" {state}/>'
        f'<CoSimulation modelIdentifier="model" {abilities}/>'
        f"<ModelVariables>{''.join(variables)}</ModelVariables>"
        f"<ModelStructure>{''.join(outputs)}"
        '<ContinuousStateDerivative valueReference="23" dependencies=""/>'
        '<InitialUnknown valueReference="23" dependencies=""/>'
        "</ModelStructure></fmiModelDescription>"
    )


@cache
def _compiled() -> Path:
    return compile_fmu(kept_folder() / "clocked.fmu", xml((), (), {}), "clocked3.c")


def build(
    path: Path,
    *clocks: str,
    can: tuple[str, ...] = ("any step", "events"),
    changes: dict[str, str] | None = None,
) -> Path:
    """Write the FMU with some of its clocks."""
    return with_description(_compiled(), path, xml(clocks, can, changes or {}))
