"""The FMUs of ``c/probe*.c``: their descriptions, and calls of an instance."""

from contextlib import contextmanager

import numpy as np

from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions

VARIABLES2 = """
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="x" valueReference="1" causality="local" initial="exact">
<Real start="0"/></ScalarVariable>
<ScalarVariable name="der(x)" valueReference="2" causality="local" initial="calculated">
<Real derivative="2"/></ScalarVariable>
<ScalarVariable name="y" valueReference="3" causality="output" initial="calculated">
<Real/></ScalarVariable>
<ScalarVariable name="slope" valueReference="4" causality="local" initial="calculated">
<Real/></ScalarVariable>
<ScalarVariable name="no_way_back" valueReference="5" causality="local" initial="calculated">
<Real/></ScalarVariable>
<ScalarVariable name="answer" valueReference="10" causality="parameter" variability="fixed">
<Integer start="0"/></ScalarVariable>
<ScalarVariable name="flag" valueReference="11" causality="parameter" variability="fixed">
<Boolean start="0"/></ScalarVariable>
<ScalarVariable name="text" valueReference="20" causality="parameter" variability="fixed">
<String start=""/></ScalarVariable>
</ModelVariables>
<ModelStructure>
<Outputs><Unknown index="4" dependencies="2"/></Outputs>
<Derivatives><Unknown index="3" dependencies="1"/></Derivatives>
<InitialUnknowns><Unknown index="3"/><Unknown index="4"/></InitialUnknowns>
</ModelStructure>
"""


def xml2(*, state: bool = True, indicators: int = 0) -> str:
    can = f'modelIdentifier="model" canGetAndSetFMUstate="{str(state).lower()}"'
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="probe" guid="probe"
 numberOfEventIndicators="{indicators}">
<ModelExchange {can}/>
<CoSimulation {can} canInterpolateInputs="true" canHandleVariableCommunicationStepSize="true"/>
{VARIABLES2}
</fmiModelDescription>"""


NUMBERS = (
    "Float32",
    "Int8",
    "UInt8",
    "Int16",
    "UInt16",
    "Int32",
    "UInt32",
    "Int64",
    "UInt64",
    "Boolean",
)


def _numbers3() -> str:
    """Return a scalar and an array of three of every type; references from 100."""
    roles = 'causality="parameter" variability="fixed"'
    variables = []
    for k, tag in enumerate(NUMBERS, start=10):
        zero = "false" if tag == "Boolean" else "0"
        scalar = f'name="{tag}" valueReference="{10 * k}" {roles} start="{zero}"'
        variables.append(f"<{tag} {scalar}/>")
        array = f'name="{tag}s" valueReference="{10 * k + 1}" {roles} start="{zero} {zero} {zero}"'
        variables.append(f'<{tag} {array}><Dimension start="3"/></{tag}>')
    return "\n".join(variables)


def xml3(*, event_mode: bool = False, token: str = "probe") -> str:
    can = 'modelIdentifier="model" canGetAndSetFMUState="true"'
    local = 'causality="local" initial="calculated"'
    fixed = 'causality="parameter" variability="fixed"'
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="probe" instantiationToken="{token}">
<ModelExchange {can}/>
<CoSimulation {can} canHandleVariableCommunicationStepSize="true" providesIntermediateUpdate="true"
 hasEventMode="{str(event_mode).lower()}"/>
<ModelVariables>
<Float64 name="u" valueReference="10" causality="input" start="0" intermediateUpdate="true"/>
<Float64 name="x" valueReference="20" causality="output" initial="exact" start="0"/>
<Float64 name="der(x)" valueReference="30" {local} derivative="20"/>
<Float64 name="no_way_back" valueReference="40" {local}/>
<Float64 name="Float64s" valueReference="51" {fixed} start="0 0 0"><Dimension start="3"/></Float64>
<UInt8 name="behavior" valueReference="500" {fixed} start="0"/>
<Boolean name="event_mode" valueReference="510" {local} variability="discrete"/>
<Boolean name="early_return" valueReference="520" {local} variability="discrete"/>
<UInt8 name="configured" valueReference="530" {local} variability="discrete"/>
<String name="texts" valueReference="201" {fixed}>
<Dimension start="2"/><Start value=""/><Start value=""/></String>
<Binary name="binaries" valueReference="211" {fixed}>
<Dimension start="2"/><Start value=""/><Start value=""/></Binary>
{_numbers3()}
</ModelVariables>
<ModelStructure>
<Output valueReference="20"/><ContinuousStateDerivative valueReference="30"/>
<InitialUnknown valueReference="30"/>
</ModelStructure>
</fmiModelDescription>"""


def xml1(*, interface_type: str = "cs", once: bool = False) -> str:
    capabilities = 'canInterpolateInputs="true" canHandleVariableCommunicationStepSize="true"'
    implementation = f"""<Implementation><CoSimulation_StandAlone>
<Capabilities {capabilities} canBeInstantiatedOnlyOncePerProcess="{str(once).lower()}"/>
</CoSimulation_StandAlone></Implementation>"""
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="1.0" modelName="probe" modelIdentifier="model" guid="probe"
 numberOfContinuousStates="1" numberOfEventIndicators="1">
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="x0" valueReference="1" variability="parameter">
<Real start="0"/></ScalarVariable>
<ScalarVariable name="x" valueReference="2" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="der(x)" valueReference="3"><Real/></ScalarVariable>
<ScalarVariable name="y" valueReference="4" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="slope" valueReference="5"><Real/></ScalarVariable>
<ScalarVariable name="behavior" valueReference="10" variability="parameter">
<Integer start="0"/></ScalarVariable>
<ScalarVariable name="count" valueReference="11"><Integer/></ScalarVariable>
<ScalarVariable name="flag" valueReference="12" variability="parameter">
<Boolean start="false"/></ScalarVariable>
<ScalarVariable name="text" valueReference="13" variability="parameter">
<String start=""/></ScalarVariable>
</ModelVariables>{implementation if interface_type == "cs" else ""}
</fmiModelDescription>"""


@contextmanager
def opened(path, **options):
    """Yield the opened FMU and its instance."""
    with load(path, FmuOptions(**options)) as fmu:
        yield fmu, fmu._instance


def put(instance, **values):
    references = instance.description.references_of(values)
    instance.set_float64(references, np.array(list(values.values()), np.float64))


def got(instance, *names):
    references = instance.description.references_of(names)
    return instance.get_float64(references).tolist()
