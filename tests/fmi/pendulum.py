"""A nonlinear plant as an FMU, compiled from C, and its Jacobian in closed form."""

import math

import numpy as np

from tests.fmi.compiled import compile_fmu

G = 9.81
FRICTION = 0.2

OF_TIME = 'variability="continuous" initial="calculated"'
VARIABLES = (  # value references as in c/pendulum.c; angle and push are aliases
    ("torque", 0, 'causality="input" variability="continuous"', 'start="0" unit="N.m"'),
    ("wind", 1, 'causality="input" variability="continuous"', 'start="0" unit="N.m"'),
    ("theta", 2, 'causality="local" variability="continuous" initial="exact"', 'start="0.5"'),
    ("omega", 3, 'causality="local" variability="continuous" initial="exact"', 'start="0"'),
    ("der(theta)", 4, f'causality="local" {OF_TIME}', 'derivative="3"'),
    ("der(omega)", 5, f'causality="local" {OF_TIME}', 'derivative="4"'),
    ("y", 6, f'causality="output" {OF_TIME}', ""),
    ("reach", 7, f'causality="output" {OF_TIME}', 'unit="rev"'),
    ("power", 8, f'causality="output" {OF_TIME}', ""),
    ("angle", 2, 'causality="output" variability="continuous"', ""),
    ("push", 5, f'causality="output" {OF_TIME}', ""),
    (
        "length",
        9,
        'causality="parameter" variability="fixed" initial="exact"',
        'start="1" min="0.1"',
    ),
)
LEVEL = (
    '<ScalarVariable name="level" valueReference="0" causality="input" variability="discrete">'
    '<Integer start="0"/></ScalarVariable>'
)
OUTPUTS = ("y", "reach", "power", "angle", "push")


def pendulum(path, *, derivatives: bool, level: bool = True, edit=lambda xml: xml, changes=""):
    """Compile the FMU; ``level``: with its integer input; ``changes``: a statement of C."""
    scalars = []
    for name, reference, roles, start in VARIABLES:
        attributes = f'name="{name}" valueReference="{reference}" {roles}'
        scalars.append(f"<ScalarVariable {attributes}><Real {start}/></ScalarVariable>")
    if level:
        scalars.append(LEVEL)
    able = str(derivatives).lower()
    outputs = "".join(f'<Unknown index="{i}"/>' for i in (7, 8, 9, 10, 11))
    xml = f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="pendulum" guid="{{p}}" numberOfEventIndicators="0">
<ModelExchange modelIdentifier="model" providesDirectionalDerivative="{able}"/>
<UnitDefinitions><Unit name="N.m"><BaseUnit kg="1" m="2" s="-2"/></Unit>
<Unit name="rev"><BaseUnit rad="1" factor="{math.tau}"/></Unit></UnitDefinitions>
<ModelVariables>{"".join(scalars)}</ModelVariables>
<ModelStructure><Outputs>{outputs}</Outputs>
<Derivatives><Unknown index="5"/><Unknown index="6"/></Derivatives></ModelStructure>
</fmiModelDescription>"""
    defines = ("DERIVATIVES",) if derivatives else ()
    if changes:
        defines += (f"CHANGES={changes}",)
    return compile_fmu(path, edit(xml), "pendulum.c", defines=defines)


def jacobian(theta, omega, torque, length=1.0):
    """Return A, B, C, D: states theta, omega; inputs torque, wind; outputs as in OUTPUTS."""
    slope = -G / length * np.cos(theta)
    arm = 1.0 / length**2
    height_slope = length * np.cos(theta)
    A = np.array([[0.0, 1.0], [slope, -FRICTION]])
    B = np.array([[0.0, 0.0], [arm, arm]])
    C = np.array([[2.0, 1.0], [height_slope, 0.0], [0.0, torque], [1.0, 0.0], A[1]])
    D = np.array([[0.0, 0.0], [0.0, 0.0], [omega, 0.0], [0.0, 0.0], B[1]])
    return A, B, C, D
