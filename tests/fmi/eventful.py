"""The FMUs of ``c/events.c``: built once for each model, version and nominal value."""

from functools import cache
from pathlib import Path

import numpy as np

from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from tests.fmi.compiled import compile_fmu, kept_folder

VARIABLES = ("u", "d", "x", "v", "der(x)", "der(v)", "q", "count", "p", "evaluations", "completed")
STATES = {"BALL": 2, "FRICTION": 2, "COUNTER": 0, "WINDOW": 2}  # else 1
INDICATORS = {
    **dict.fromkeys(
        ("SAW", "COUNTER", "MEMORY", "STEPS", "TIRED", "SCALED", "REFUSES", "SAMPLE"), 0
    ),
    "FRICTION": 2,
    "TWO": 3,
}  # else 1
CAUSALITY = {
    "u": "input",
    "d": "input",
    "p": "parameter",
    "x": "output",
    "v": "output",
    "q": "output",
    "count": "output",
}
VARIABILITY = {"p": "fixed", "d": "discrete", "q": "discrete", "count": "discrete"}
LEVELS = {
    "BALL": 0.1,
    "FRICTION": 0.5,
    "SAW": 0.0733,
    "COUNTER": 0.05,
    "TWO": 0.0,
    "SLIDE": 0.5,
    "ENDLESS": 0.45,
    "ENDS": 0.45,
    "MEMORY": 0.0,
    "SWITCH": 0.3,
    "STEPS": 0.0733,
    "TIRED": 0.45,
    "SCALED": 0.11,
    "REFUSES": 0.08,
    "WINDOW": 0.5,
}
"""The models of ``c/events.c``, with their parameter p."""
OUTPUTS = ("x", "v", "q", "count")
HEADER = '<?xml version="1.0" encoding="UTF-8"?>'


def _attributes(name: str, states: tuple[str, ...]) -> str:
    causality = CAUSALITY.get(name, "local")
    variability = VARIABILITY.get(name, "continuous")
    initial = ' initial="calculated"'
    if name in states or causality == "parameter":
        initial = ' initial="exact"'
    elif causality == "input":
        initial = ""
    roles = f'causality="{causality}" variability="{variability}"{initial}'
    return f'name="{name}" valueReference="{VARIABLES.index(name)}" {roles}'


def _start(name: str, states: tuple[str, ...]) -> str:
    return ' start="0"' if name in ("u", "d", "p", *states) else ""


def _derivative(name: str, derivatives: tuple[str, ...], first: int) -> str:
    """Return the attribute of a derivative; ``first`` is the number of the first state."""
    if name not in derivatives:
        return ""
    return f' derivative="{first + derivatives.index(name)}"'


def xml2(model: str) -> str:
    n = STATES.get(model, 1)
    states = ("x", "v")[:n]
    derivatives = ("der(x)", "der(v)")[:n]
    scalars = []
    for name in VARIABLES:
        real = f"<Real{_start(name, states)}{_derivative(name, derivatives, 3)}/>"
        scalars.append(f"<ScalarVariable {_attributes(name, states)}>{real}</ScalarVariable>")
    outputs = ""
    for name in OUTPUTS:
        inputs = "" if name in "xv" else "1 2"
        outputs += f'<Unknown index="{VARIABLES.index(name) + 1}" dependencies="{inputs}"/>'
    rates = "".join(f'<Unknown index="{VARIABLES.index(name) + 1}"/>' for name in derivatives)
    return f"""{HEADER}
<fmiModelDescription fmiVersion="2.0" modelName="{model}" guid="x"
 numberOfEventIndicators="{INDICATORS.get(model, 1)}">
<ModelExchange modelIdentifier="model" canGetAndSetFMUstate="true"/>
<ModelVariables>{"".join(scalars)}</ModelVariables>
<ModelStructure><Outputs>{outputs}</Outputs>
{f"<Derivatives>{rates}</Derivatives>" if rates else ""}</ModelStructure>
</fmiModelDescription>"""


def xml3(model: str) -> str:
    n = STATES.get(model, 1)
    states = ("x", "v")[:n]
    derivatives = ("der(x)", "der(v)")[:n]
    variables = []
    for name in VARIABLES:
        numbers = _start(name, states) + _derivative(name, derivatives, 2)
        variables.append(f"<Float64 {_attributes(name, states)}{numbers}/>")
    structure = ""
    for name in OUTPUTS:
        inputs = "" if name in "xv" else "0 1"
        structure += f'<Output valueReference="{VARIABLES.index(name)}" dependencies="{inputs}"/>'
    for name in derivatives:
        reference = VARIABLES.index(name)
        structure += f'<ContinuousStateDerivative valueReference="{reference}"/>'
    for i in range(INDICATORS.get(model, 1)):
        variables.append(f'<Float64 name="z{i}" valueReference="{20 + i}" causality="local"/>')
        structure += f'<EventIndicator valueReference="{20 + i}"/>'
    return f"""{HEADER}
<fmiModelDescription fmiVersion="3.0" modelName="{model}" instantiationToken="x">
<ModelExchange modelIdentifier="model" canGetAndSetFMUState="true"
 needsCompletedIntegratorStep="true"/>
<ModelVariables>{"".join(variables)}</ModelVariables>
<ModelStructure>{structure}</ModelStructure>
</fmiModelDescription>"""


@cache
def build(model: str, version: int = 2, nominal: float = 1.0, *, saves: bool = True) -> Path:
    """Build the FMU; ``saves``: it says that it can save its state."""
    ending = "" if saves else "-forgets"
    path = kept_folder() / f"{model}{version}{ending}.fmu"
    xml = xml2(model) if version == 2 else xml3(model)
    if not saves:
        xml = xml.replace('canGetAndSetFMUstate="true"', "")
        xml = xml.replace('canGetAndSetFMUState="true"', "")
    defines = (f"FMI={version}", f"MODEL={model}", f"NOMINAL={nominal}")
    return compile_fmu(path, xml, "events.c", defines=defines)


def friction(folder: Path, version: int) -> Path:
    """Compile v' = u - p while it slips, with p tunable."""
    xml = (xml2 if version == 2 else xml3)("FRICTION")
    xml = xml.replace('variability="fixed"', 'variability="tunable"')
    defines = (f"FMI={version}", "MODEL=FRICTION", "NOMINAL=1.0")
    return compile_fmu(folder / f"friction{version}.fmu", xml, "events.c", defines=defines)


class Run:
    """A loaded FMU with its solver, run from 0."""

    def __init__(
        self,
        model: str,
        solver: str = "rk4",
        *,
        p: float = 0.0,
        version: int = 2,
        nominal: float = 1.0,
        rtol: float | None = None,
        max_step: float | None = None,
    ):
        options = FmuOptions(solver=solver, tolerance=rtol, max_step=max_step, start={"p": p})
        self.fmu = load(build(model, version, nominal), options)
        self.component = self.fmu.component

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.fmu.close()

    def __call__(
        self, stop: float, step: float, *, u=None, blocks: int | None = None, held=(False, False)
    ):
        """Return x, v, q, count at every communication point; ``u`` is the input u of time."""
        steps = round(stop / step)
        t = np.arange(steps + 1) * round(step * 1e9) / 1e9
        first_input = [u(time) if u else 0.0 for time in t]
        rows = np.column_stack([first_input, np.zeros(steps + 1)])
        self.component.prepare(step, np.array(held), {})
        outputs = [self.component.initialize(0.0, rows[0])[np.newaxis]]
        size = blocks or steps
        for k in range(0, steps, size):
            block = slice(k, k + size + 1)
            outputs.append(self.component.advance(t[block], step, rows[block]))
        return np.concatenate(outputs)

    def value(self, name: str) -> float:
        """Return the value that a variable has now."""
        instance = self.fmu._instance
        references = instance.description.references_of([name])
        return float(instance.get_float64(references)[0])

    def events(self, kind: str) -> list[float]:
        """Return the times of the events of one kind since the last call."""
        texts = [text for *_, text in self.fmu.drain() if text.startswith(kind)]
        return [float(text.split(" = ")[1][:-2]) for text in texts]
