"""Descriptions of FMI 1, 2 and 3 with something of everything that the standards know."""

FMI1 = """<?xml version="1.0"?>
<fmiModelDescription fmiVersion="1.0" modelName="one" modelIdentifier="one" guid="{1}"
  generationTool="tool 1" numberOfContinuousStates="2" numberOfEventIndicators="3">
<UnitDefinitions><BaseUnit unit="N">
  <DisplayUnitDefinition displayUnit="kN" gain="0.001"/></BaseUnit></UnitDefinitions>
<TypeDefinitions>
  <Type name="Force"><RealType unit="N" min="-1" max="2" nominal="10"/></Type>
  <Type name="Mode"><EnumerationType><Item name="off"/><Item name="on"/></EnumerationType></Type>
</TypeDefinitions>
<DefaultExperiment startTime="0" tolerance="1e-5"/>
<ModelVariables>
  <ScalarVariable name="u" valueReference="0" causality="input" description="force">
    <Real declaredType="Force" start="1"/>
  </ScalarVariable>
  <ScalarVariable name="y" valueReference="1" causality="output"><Real/><DirectDependency>
    <Name>u</Name></DirectDependency>
  </ScalarVariable>
  <ScalarVariable name="z" valueReference="1" causality="output" alias="alias">
    <Real/></ScalarVariable>
  <ScalarVariable name="w" valueReference="1" alias="negatedAlias"><Real/></ScalarVariable>
  <ScalarVariable name="v" valueReference="2" causality="output"><Real/>
    <DirectDependency/></ScalarVariable>
  <ScalarVariable name="k" valueReference="3" variability="parameter">
    <Real start="2"/></ScalarVariable>
  <ScalarVariable name="guess" valueReference="4"><Real start="2" fixed="false"/></ScalarVariable>
  <ScalarVariable name="mode" valueReference="5" variability="constant">
    <Enumeration declaredType="Mode" start="2"/>
  </ScalarVariable>
  <ScalarVariable name="text" valueReference="6" causality="none">
    <String start="a b"/></ScalarVariable>
  <ScalarVariable name="n" valueReference="7" causality="output"><Integer/></ScalarVariable>
</ModelVariables>{implementation}
</fmiModelDescription>"""
CO_SIMULATION = """<Implementation><CoSimulation_{what}>
  <Capabilities canInterpolateInputs="true" canHandleVariableCommunicationStepSize="true"
    canBeInstantiatedOnlyOncePerProcess="true"/></CoSimulation_{what}>
</Implementation>"""

FMI2 = """<?xml version="1.0"?>
<fmiModelDescription fmiVersion="2.0" modelName="two" guid="{2}" generationTool="tool 2"
  numberOfEventIndicators="2">
<ModelExchange modelIdentifier="two" providesDirectionalDerivative="true"
  canGetAndSetFMUstate="1" needsExecutionTool="true"/>
<CoSimulation modelIdentifier="two_cs" canInterpolateInputs="true" canSerializeFMUstate="true"/>
<UnitDefinitions>
  <Unit name="degC"><BaseUnit K="1" offset="273.15"/>
    <DisplayUnit name="degF" factor="1.8" offset="32"/></Unit>
  <Unit name="kN"><BaseUnit kg="1" m="1" s="-2" factor="1000"/></Unit>
  <Unit name="item"/>
</UnitDefinitions>
<TypeDefinitions>
  <SimpleType name="Rise">
    <Real unit="degC" relativeQuantity="true" min="0" nominal="5"/></SimpleType>
  <SimpleType name="Mode"><Enumeration><Item name="off" value="-3"/>
    <Item name="on" value="7"/></Enumeration></SimpleType>
</TypeDefinitions>
<DefaultExperiment stepSize="0.01" tolerance="1e-6"/>
<ModelVariables>
  <ScalarVariable name="u" valueReference="0" causality="input" description="temperature">
    <Real unit="degC" start="20"/>
  </ScalarVariable>
  <ScalarVariable name="rise" valueReference="1" causality="output">
    <Real declaredType="Rise" max="50" displayUnit="degF"/>
  </ScalarVariable>
  <ScalarVariable name="x" valueReference="2" causality="output" initial="approx">
    <Real start="1.5"/></ScalarVariable>
  <ScalarVariable name="der(x)" valueReference="3"><Real derivative="3"/></ScalarVariable>
  <ScalarVariable name="mode" valueReference="4" causality="parameter" variability="fixed">
    <Enumeration declaredType="Mode" start="7"/></ScalarVariable>
  <ScalarVariable name="path" valueReference="5" causality="parameter" variability="fixed">
    <String start="a b"/></ScalarVariable>
  <ScalarVariable name="h" valueReference="6"><Real derivative="8"/></ScalarVariable>
  <ScalarVariable name="hidden" valueReference="7" initial="exact">
    <Real start="4" unit="kN"/></ScalarVariable>
  <ScalarVariable name="late" valueReference="8" causality="output"><Boolean/></ScalarVariable>
  <ScalarVariable name="i[1]" valueReference="9" causality="input">
    <Integer start="3"/></ScalarVariable>
  <ScalarVariable name="i[2]" valueReference="10" causality="input">
    <Integer start="4"/></ScalarVariable>
</ModelVariables>
<ModelStructure>
  <Outputs><Unknown index="2" dependencies="1 3"/><Unknown index="3"/>
    <Unknown index="9" dependencies=""/></Outputs>
  <Derivatives><Unknown index="4" dependencies="1 3"/><Unknown index="7"/></Derivatives>
  <InitialUnknowns><Unknown index="3" dependencies="1"/><Unknown index="2"/>
    <Unknown index="4" dependencies=""/></InitialUnknowns>
</ModelStructure>
</fmiModelDescription>"""

FMI3 = """<?xml version="1.0"?>
<fmiModelDescription fmiVersion="3.0" modelName="three" instantiationToken="{3}">
<ModelExchange modelIdentifier="three" providesDirectionalDerivatives="true"
  providesAdjointDerivatives="true" canGetAndSetFMUState="true" canSerializeFMUState="true"
  needsCompletedIntegratorStep="true"/>
<CoSimulation modelIdentifier="three" providesIntermediateUpdate="true"
  mightReturnEarlyFromDoStep="true" hasEventMode="true"
  canHandleVariableCommunicationStepSize="true" fixedInternalStepSize="0.5"
  canBeInstantiatedOnlyOncePerProcess="true"/>
<UnitDefinitions><Unit name="mm"><BaseUnit m="1" factor="0.001"/></Unit></UnitDefinitions>
<TypeDefinitions>
  <EnumerationType name="Mode"><Item name="off" value="0"/>
    <Item name="on" value="9007199254740993"/></EnumerationType>
  <UInt8Type name="Small" max="9"/></TypeDefinitions>
<ModelVariables>
  <Float64 name="time" valueReference="0" causality="independent"/>
  <UInt64 name="n" valueReference="1" causality="structuralParameter" start="3" min="1" max="5"/>
  <Float64 name="u" valueReference="2" causality="input" start="0.5" unit="mm">
    <Dimension valueReference="1"/>
    <Dimension start="2"/><Alias name="second" description="the same"/></Float64>
  <Float32 name="y" valueReference="3" causality="output"><Dimension valueReference="1"/></Float32>
  <Float64 name="x" valueReference="4" start="1 2 3" initial="exact">
    <Dimension valueReference="1"/></Float64>
  <Float64 name="dx" valueReference="5" derivative="4"><Dimension valueReference="1"/></Float64>
  <Float64 name="z" valueReference="6"><Dimension valueReference="1"/></Float64>
  <UInt8 name="small" valueReference="7" causality="parameter" declaredType="Small" start="4"/>
  <Int64 name="large" valueReference="8" causality="parameter" start="9007199254740993"/>
  <String name="words" valueReference="9" causality="parameter"><Dimension start="2"/>
    <Start value="a b"/><Start value="c"/></String>
  <Binary name="bytes" valueReference="10" causality="parameter"><Start value="00ff"/></Binary>
  <Enumeration name="mode" valueReference="11" declaredType="Mode" causality="output"/>
  <Boolean name="on" valueReference="12" causality="parameter" start="true false">
    <Dimension start="2"/></Boolean>
  <Clock name="tick" valueReference="13" causality="input" intervalVariability="triggered"/>
</ModelVariables>
<ModelStructure>
  <Output valueReference="3" dependencies="2 4"/><Output valueReference="11" dependencies=""/>
  <ContinuousStateDerivative valueReference="5" dependencies="2"/>
  <InitialUnknown valueReference="3" dependencies="4"/><InitialUnknown valueReference="5"/>
  <EventIndicator valueReference="6"/>
</ModelStructure>
</fmiModelDescription>"""


def fmi1(implementation=""):
    return FMI1.replace("{implementation}", implementation)
