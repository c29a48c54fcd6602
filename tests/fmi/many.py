"""An FMU with as many variables as are wanted: one input, a few outputs, all others local."""

from pathlib import Path

from tests.fmi.compiled import compile_fmu

OUTPUTS = 10


def many(path: Path, count: int) -> Path:
    """Write it; every fourth local variable is a parameter.

    Parameters
    ----------
    path : Path
    count : int
        Of variables.
    """
    variables = [_scalar(0, "u", 'causality="input"', 'start="0" unit="m"')]
    for i in range(1, OUTPUTS + 1):
        variables.append(_scalar(i, f"y{i}", 'causality="output"', 'unit="m"'))
    for i in range(OUTPUTS + 1, count):
        name = f"part{i % 100}.element.x_{i}"
        if i % 4:
            variables.append(_scalar(i, name, 'causality="local"', 'unit="m"'))
        else:
            roles = 'causality="parameter" variability="fixed"'
            variables.append(_scalar(i, name, roles, f'start="{i}.5" min="0" max="1e9"'))
    unknowns = [f'<Unknown index="{i + 1}" dependencies=""/>' for i in range(1, OUTPUTS + 1)]
    xml = f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="many" guid="many"
 variableNamingConvention="structured">
<CoSimulation modelIdentifier="model" canHandleVariableCommunicationStepSize="true"/>
<UnitDefinitions><Unit name="m"><BaseUnit m="1"/></Unit></UnitDefinitions>
<DefaultExperiment stepSize="0.01"/>
<ModelVariables>
{"".join(variables)}</ModelVariables>
<ModelStructure><Outputs>{"".join(unknowns)}</Outputs>
<InitialUnknowns>{"".join(unknowns)}</InitialUnknowns></ModelStructure>
</fmiModelDescription>"""
    return compile_fmu(path, xml, "many2.c", defines=(f"N={count}",))


def _scalar(reference: int, name: str, roles: str, attributes: str) -> str:
    return (
        f'<ScalarVariable name="{name}" valueReference="{reference}" {roles}>'
        f"<Real {attributes}/></ScalarVariable>\n"
    )
