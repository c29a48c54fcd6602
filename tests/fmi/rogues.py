"""The FMUs of ``c/rogue2.c``: a good one, and those that do one thing wrong."""

from pathlib import Path

from tests.fmi.compiled import compile_fmu

XML = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="rogue" guid="rogue">
<CoSimulation modelIdentifier="model" canGetAndSetFMUstate="true"/>
<UnitDefinitions><Unit name="m"><BaseUnit m="1"/></Unit></UnitDefinitions>
<TypeDefinitions>
  <SimpleType name="Mode">
    <Enumeration><Item name="off" value="1"/><Item name="on" value="3"/></Enumeration>
  </SimpleType>
</TypeDefinitions>
<ModelVariables>
  <ScalarVariable name="u" valueReference="0" causality="input">
    <Real start="0" unit="m"/></ScalarVariable>
  <ScalarVariable name="y" valueReference="1" causality="output" initial="exact">
    <Real start="1"/></ScalarVariable>
  <ScalarVariable name="k" valueReference="2"
    causality="parameter" variability="fixed"><Real start="2" min="0" max="5"/></ScalarVariable>
  <ScalarVariable name="z" valueReference="3" causality="output">
    <Real nominal="2"/></ScalarVariable>
  <ScalarVariable name="mode" valueReference="4" causality="parameter" variability="fixed">
    <Enumeration declaredType="Mode" start="3"/></ScalarVariable>
</ModelVariables>
<ModelStructure>
  <Outputs>
    <Unknown index="2" dependencies=""/>
    <Unknown index="4" dependencies="1" dependenciesKind="dependent"/>
  </Outputs>
  <InitialUnknowns><Unknown index="4" dependencies="1 2"/></InitialUnknowns>
</ModelStructure>
</fmiModelDescription>"""
STATELESS = XML.replace('canGetAndSetFMUstate="true"', "")  # so that nothing is tried before


def compile_rogue(path: Path, rogue: str, xml: str = XML, *defines: str) -> Path:
    """Compile the FMU that does one thing wrong, or nothing: ``"GOOD"``."""
    return compile_fmu(path, xml, "rogue2.c", defines=(f"ROGUE={rogue}", *defines))
