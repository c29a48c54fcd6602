"""The FMUs of ``c/probe*.c``: their descriptions, and a unit of one, opened without a driver."""

from contextlib import contextmanager

from cosim.fmi.component import load

VARIABLES2 = """
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="x" valueReference="1" causality="local" initial="exact"><Real start="0"/></ScalarVariable>
<ScalarVariable name="der(x)" valueReference="2" causality="local" initial="calculated"><Real derivative="2"/></ScalarVariable>
<ScalarVariable name="y" valueReference="3" causality="output" initial="calculated"><Real/></ScalarVariable>
<ScalarVariable name="slope" valueReference="4" causality="local" initial="calculated"><Real/></ScalarVariable>
<ScalarVariable name="no_way_back" valueReference="5" causality="local" initial="calculated"><Real/></ScalarVariable>
<ScalarVariable name="answer" valueReference="10" causality="parameter" variability="fixed"><Integer start="0"/></ScalarVariable>
<ScalarVariable name="flag" valueReference="11" causality="parameter" variability="fixed"><Boolean start="0"/></ScalarVariable>
<ScalarVariable name="text" valueReference="20" causality="parameter" variability="fixed"><String start=""/></ScalarVariable>
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
<fmiModelDescription fmiVersion="2.0" modelName="probe" guid="probe" numberOfEventIndicators="{indicators}">
<ModelExchange {can}/><CoSimulation {can} canInterpolateInputs="true" canHandleVariableCommunicationStepSize="true"/>{VARIABLES2}
</fmiModelDescription>"""


@contextmanager
def opened(path, **options):
    """Give the opened FMU, its unit, and what sets and gets one variable by name."""
    with load(path, **options) as fmu:
        yield fmu, fmu.component._unit
