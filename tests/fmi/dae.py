"""Models with a residual form: a descriptor system, and nonlinear ones compiled from C.

The descriptor system has two algebraic states.
"""

from functools import cache
from pathlib import Path

import numpy as np

from cosim.blocks.plant import descriptor_form
from cosim.core.linear import DescriptorModel
from cosim.fmi.reading.dae import MANIFEST, NAME
from cosim.theory.plants.descriptor import DescriptorSystem
from tests.fmi.compiled import compile_fmu, kept_folder

SYSTEM = DescriptorSystem.partitioned(
    A=np.array(
        [
            [-1.0, 0.5, 1.0, 0.0],
            [0.0, -2.0, 0.25, -1.0],
            [1.0, 0.0, 2.0, 0.5],
            [0.5, -1.0, -0.25, 1.5],
        ]
    ),
    Bu=np.array([[0.0], [2.0], [1.0], [0.5]]),
    Bd=np.array([[1.0], [0.0], [0.0], [-0.5]]),
    C=np.array([[2.0, 0.0, 1.0, -1.0]]),
    n_a=2,
)
START = [1.0, -1.0]


def descriptor() -> DescriptorModel:
    return descriptor_form(SYSTEM, START)


ABOUT = (
    'xmlns:fmi-ls="http://fmi-standard.org/fmi-ls-manifest" '
    f'fmi-ls:fmi-ls-name="{NAME}" fmi-ls:fmi-ls-version="0.0.1" '
    'fmi-ls:fmi-ls-description="Layered standard for DAE support in FMI"'
)
LISTS = '<AlgebraicVariables><AlgebraicVariable valueReference="2"/></AlgebraicVariables>'
STRUCTURE = (
    '<ModelStructure>{rate}<Residual><Formulation valueReference="4"/></Residual></ModelStructure>'
)
RATE = '<ContinuousStateDerivative valueReference="3" dependencies="2"/>'


def manifest(content: str, root: str = "fmiLayeredStandardManifest", about: str = ABOUT) -> str:
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<{root} {about}>{content}</{root}>'


def xml(model: str, *, derivatives: bool) -> str:
    """Describe a model of ``c/dae.c``."""
    moves = model != "STATIC"
    able = str(derivatives).lower()
    state = (
        '<Float64 name="x" valueReference="1" causality="output" initial="exact" start="1"/>'
        '<Float64 name="der(x)" valueReference="3" causality="local" derivative="1"/>'
    )
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="{model}" instantiationToken="x">
<ModelExchange modelIdentifier="model" canGetAndSetFMUState="true"
 providesDirectionalDerivatives="{able}"/>
<ModelVariables>
<Float64 name="time" valueReference="20" causality="independent" variability="continuous"/>
<Float64 name="u" valueReference="0" causality="input" start="0"/>{state if moves else ""}
<Float64 name="z" valueReference="2" causality="output" initial="approx" start="1"/>
<Float64 name="r" valueReference="4" causality="local"/>
<Float64 name="p" valueReference="5" causality="parameter" variability="fixed" start="-1e9"/>
<Float64 name="q" valueReference="6" causality="output" variability="discrete"
 initial="calculated"/>
<Float64 name="beyond" valueReference="7" causality="local"/>
<Float64 name="y" valueReference="8" causality="output"/></ModelVariables>
<ModelStructure>{'<Output valueReference="1" dependencies=""/>' if moves else ""}
<Output valueReference="2"/><Output valueReference="6"/><Output valueReference="8"/>
{RATE if moves else ""}<InitialUnknown valueReference="2"/><InitialUnknown valueReference="6"/>
<InitialUnknown valueReference="8"/><EventIndicator valueReference="7"/></ModelStructure>
</fmiModelDescription>"""


@cache
def build(model: str = "CUBIC", *, derivatives: bool = True, extra: str | None = "") -> Path:
    """Compile a model once; ``extra``: its manifest, "" for the right one, None for none."""
    path = kept_folder() / f"{model}.fmu"
    right = manifest(LISTS + STRUCTURE.format(rate="" if model == "STATIC" else RATE))
    members = {} if extra is None else {MANIFEST: extra or right}
    defines = [f"MODEL={model}"]
    if derivatives:
        defines.append("DERIVATIVES")
    text = xml(model, derivatives=derivatives)
    return compile_fmu(path, text, "dae.c", defines=tuple(defines), extra=members)
