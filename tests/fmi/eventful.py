"""The FMUs of ``c/events.c``: their descriptions, built once for each model, version and nominal value."""

from functools import cache
from pathlib import Path

import numpy as np

from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from tests.fmi.compiled import compile_fmu, kept_folder

VARIABLES = ("u", "d", "x", "v", "der(x)", "der(v)", "q", "count", "p", "evaluations", "completed")
STATES = {"BALL": 2, "FRICTION": 2, "COUNTER": 0}  # else 1
INDICATORS = {"FRICTION": 2, "TWO": 3, "SAW": 0, "COUNTER": 0, "MEMORY": 0}  # else 1
CAUSALITY = {"u": "input", "d": "input", "p": "parameter"} | dict.fromkeys(
    ("x", "v", "q", "count"), "output"
)


def _attributes(name: str, states: tuple[str, ...]) -> str:
    causality = CAUSALITY.get(name, "local")
    variability = {"p": "fixed", "d": "discrete", "q": "discrete", "count": "discrete"}.get(
        name, "continuous"
    )
    initial = {"input": "", "parameter": ' initial="exact"'}.get(causality, ' initial="calculated"')
    if name in states:
        initial = ' initial="exact"'
    return f'name="{name}" valueReference="{VARIABLES.index(name)}" causality="{causality}" variability="{variability}"{initial}'


def _start(name: str, states: tuple[str, ...]) -> str:
    return ' start="0"' if name in ("u", "d", "p", *states) else ""


def xml2(model: str) -> str:
    n = STATES.get(model, 1)
    states, rates = ("x", "v")[:n], ("der(x)", "der(v)")[:n]
    scalars = "\n".join(
        f"<ScalarVariable {_attributes(name, states)}><Real{_start(name, states)}"
        + (f' derivative="{3 + rates.index(name)}"' if name in rates else "")
        + "/></ScalarVariable>"
        for name in VARIABLES
    )
    outputs = "".join(
        f'<Unknown index="{VARIABLES.index(name) + 1}" dependencies="{"" if name in "xv" else "1 2"}"/>'
        for name in ("x", "v", "q", "count")
    )
    derivatives = "".join(f'<Unknown index="{VARIABLES.index(name) + 1}"/>' for name in rates)
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="{model}" guid="x" numberOfEventIndicators="{INDICATORS.get(model, 1)}">
<ModelExchange modelIdentifier="model" canGetAndSetFMUstate="true"/>
<ModelVariables>{scalars}</ModelVariables>
<ModelStructure><Outputs>{outputs}</Outputs>{f"<Derivatives>{derivatives}</Derivatives>" if rates else ""}</ModelStructure>
</fmiModelDescription>"""


def xml3(model: str) -> str:
    n, n_z = STATES.get(model, 1), INDICATORS.get(model, 1)
    states, rates = ("x", "v")[:n], ("der(x)", "der(v)")[:n]
    scalars = "\n".join(
        f"<Float64 {_attributes(name, states)}{_start(name, states)}"
        + (f' derivative="{2 + rates.index(name)}"' if name in rates else "")
        + "/>"
        for name in VARIABLES
    )
    indicators = "".join(
        f'<Float64 name="z{i}" valueReference="{20 + i}" causality="local"/>' for i in range(n_z)
    )
    outputs = "".join(
        f'<Output valueReference="{VARIABLES.index(name)}" dependencies="{"" if name in "xv" else "0 1"}"/>'
        for name in ("x", "v", "q", "count")
    )
    derivatives = "".join(
        f'<ContinuousStateDerivative valueReference="{VARIABLES.index(name)}"/>' for name in rates
    )
    crossings = "".join(f'<EventIndicator valueReference="{20 + i}"/>' for i in range(n_z))
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="{model}" instantiationToken="x">
<ModelExchange modelIdentifier="model" canGetAndSetFMUState="true" needsCompletedIntegratorStep="true"/>
<ModelVariables>{scalars}{indicators}</ModelVariables>
<ModelStructure>{outputs}{derivatives}{crossings}</ModelStructure>
</fmiModelDescription>"""


@cache
def build(model: str, version: int = 2, nominal: float = 1.0) -> Path:
    path = kept_folder() / f"{model}{version}.fmu"
    xml = {2: xml2, 3: xml3}[version](model)
    return compile_fmu(
        path, xml, "events.c", defines=(f"FMI={version}", f"MODEL={model}", f"NOMINAL={nominal}")
    )


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
    ):
        self.fmu = load(
            build(model, version, nominal),
            FmuOptions(solver=solver, tolerance=rtol, start={"p": p}),
        )
        self.component = self.fmu.component

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.fmu.close()

    def __call__(
        self, stop: float, step: float, *, u=None, blocks: int | None = None, held=(False, False)
    ):
        """Give x, v, q, count at every communication point; ``u`` gives the input u at a time."""
        steps = round(stop / step)
        t = np.arange(steps + 1) * round(step * 1e9) / 1e9
        rows = np.column_stack([[u(time) if u else 0.0 for time in t], np.zeros(steps + 1)])
        self.component.prepare(step, np.array(held), {})
        found = [self.component.initialize(0.0, rows[0])[np.newaxis]]
        size = blocks or steps
        for k in range(0, steps, size):
            found.append(self.component.advance(t[k : k + size + 1], step, rows[k : k + size + 1]))
        return np.concatenate(found)

    def value(self, name: str) -> float:
        """Give a variable, as it is."""
        unit = self.component._instance
        return float(unit.get_float64(unit.description.references_of([name]))[0])

    def events(self, kind: str) -> list[float]:
        """Give the times of the events of one kind since the last call."""
        return [
            float(text.split(" = ")[1][:-2])
            for *_, text in self.fmu.drain()
            if text.startswith(kind)
        ]
