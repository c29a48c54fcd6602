"""The first row shows what FMUs start with: behind the initialization, and the event after it.

The FMUs of ``c/starting.c``: x' = u from x = 3 u, y = base + x / 6, where the base is -1 in
initialization mode, 10 behind it, and 20 behind the event. FMI 2.0.4 sections 3.2.3 and 4.2.4,
FMI 3.0 section 2.3.3.
"""

from functools import cache
from pathlib import Path

import fmpy
import numpy as np
import pytest

import cosim
from cosim.blocks.source import constant
from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.errors import CosimError, ScenarioError
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from cosim.testing import check_component
from tests.fmi.compiled import compile_fmu, kept_folder

HEADER = '<?xml version="1.0" encoding="UTF-8"?>'
ROUNDING = 1e-13  # of values below 100
STEP = 0.1
FMUS = [("2", "me"), ("3", "me"), ("2", "cs"), ("3", "cs"), ("3", "cs, events")]
BASE = {"me": 20.0, "cs": 10.0, "cs, events": 20.0}


def xml2(interface_type: str) -> str:
    element = "ModelExchange" if interface_type == "me" else "CoSimulation"
    return f"""{HEADER}
<fmiModelDescription fmiVersion="2.0" modelName="starting" guid="x" numberOfEventIndicators="0">
<{element} modelIdentifier="model"/>
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="x" valueReference="1" causality="output" initial="calculated"><Real/>
</ScalarVariable>
<ScalarVariable name="der(x)" valueReference="2" causality="local" initial="calculated">
<Real derivative="2"/></ScalarVariable>
<ScalarVariable name="y" valueReference="3" causality="output" initial="calculated"><Real/>
</ScalarVariable>
</ModelVariables>
<ModelStructure>
<Outputs><Unknown index="2" dependencies=""/><Unknown index="4" dependencies=""/></Outputs>
<Derivatives><Unknown index="3" dependencies="1"/></Derivatives>
<InitialUnknowns><Unknown index="2" dependencies="1"/><Unknown index="3" dependencies="1"/>
<Unknown index="4" dependencies="1"/></InitialUnknowns>
</ModelStructure>
</fmiModelDescription>"""


def xml3(interface_type: str) -> str:
    element = "ModelExchange" if interface_type == "me" else "CoSimulation"
    event_mode = ' hasEventMode="true"' if "events" in interface_type else ""
    return f"""{HEADER}
<fmiModelDescription fmiVersion="3.0" modelName="starting" instantiationToken="x">
<{element} modelIdentifier="model"{event_mode}/>
<ModelVariables>
<Float64 name="u" valueReference="0" causality="input" start="0"/>
<Float64 name="x" valueReference="1" causality="output" initial="calculated"/>
<Float64 name="der(x)" valueReference="2" causality="local" initial="calculated" derivative="1"/>
<Float64 name="y" valueReference="3" causality="output" initial="calculated"/>
</ModelVariables>
<ModelStructure>
<Output valueReference="1" dependencies=""/><Output valueReference="3" dependencies=""/>
<ContinuousStateDerivative valueReference="2" dependencies="0"/>
<InitialUnknown valueReference="1" dependencies="0"/>
<InitialUnknown valueReference="2" dependencies="0"/>
<InitialUnknown valueReference="3" dependencies="0"/>
</ModelStructure>
</fmiModelDescription>"""


@cache
def build(version: str, interface_type: str, *, fails: int = 0) -> Path:
    path = kept_folder() / "starting.fmu"
    xml = xml2(interface_type) if version == "2" else xml3(interface_type)
    defines = (f"FMI={version}", f"FAILS={fails}")
    return compile_fmu(path, xml, "starting.c", "unused.c", defines=defines)


@pytest.fixture
def opened():
    """Open FMUs, and close them at the end."""
    fmus = []

    def open_fmu(version, interface_type, **options):
        solver = "rk4" if interface_type == "me" else None
        fmus.append(load(build(version, interface_type, **options), FmuOptions(solver=solver)))
        return fmus[-1].component

    yield open_fmu
    for fmu in fmus:
        fmu.close()


def record(components, connections, **options):
    memory = Memory()
    run(Graph(components, connections, **options), Clock(0.3, STEP), memory)
    return memory


@pytest.mark.parametrize(("version", "interface_type"), FMUS)
def test_the_first_row_is_that_of_fmpy(opened, version, interface_type):
    """FMPy records its first row behind the event of the initialization too."""
    component = opened(version, interface_type)
    memory = record({"fmu": component, "two": constant([2.0])}, {"fmu.u": "two.y"})
    expected = fmpy.simulate_fmu(
        str(build(version, interface_type)),
        validate=False,
        stop_time=0.3,
        output_interval=STEP,
        solver="Euler",
        step_size=STEP,
        start_values={"u": 2.0},
        use_event_mode="events" in interface_type,
    )
    for name in ("x", "y"):
        assert memory[f"fmu.{name}"] == pytest.approx(expected[name], abs=ROUNDING)
    assert memory["fmu.y"][0] == BASE[interface_type] + 1.0


@pytest.mark.parametrize(("version", "interface_type"), FMUS)
def test_the_first_value_drives_what_follows(opened, version, interface_type):
    """With a zero-order hold: x = 3 y at the start, and after the first step x + h y.

    No trace is left of the -1 of the initialization mode.
    """
    components = {
        "follower": opened(version, interface_type),
        "starter": opened(version, interface_type),
    }
    connections = {"follower.u": "starter.y"}
    memory = record(components, connections, input_interpolation="zero-order")
    base = BASE[interface_type]
    assert memory["starter.y"].tolist() == [base] * 4
    assert memory["follower.u"].tolist() == [base] * 4
    steps = np.arange(4)
    assert memory["follower.x"] == pytest.approx(base * (3.0 + STEP * steps), abs=ROUNDING)


@pytest.mark.parametrize(("version", "interface_type"), FMUS)
def test_a_loop_is_solved_for_what_its_components_start_with(opened, version, interface_type):
    """At the start u = base + u / 2 in both, so u = 2 base, but in initialization mode u = -2.

    A component that starts anew with its recorded inputs shows the recorded outputs.
    """
    names = ("a", "b")
    components = {name: opened(version, interface_type) for name in names}
    graph = Graph(components, {"a.u": "b.y", "b.u": "a.y"})
    graph.prepare(round(STEP * 1e9))
    row = np.zeros(graph.layout.width)
    graph.initialize(0.0, row)
    u = 2.0 * BASE[interface_type]
    for name in names:
        channel = graph.layout[name]
        assert row[channel.columns] == pytest.approx([u, 3.0 * u, u], abs=ROUNDING)
        alone = opened(version, interface_type)
        alone.initialize(0.0, row[channel.inputs])
        outputs = alone.outputs(0.0, row[channel.inputs])
        assert outputs == pytest.approx(row[channel.outputs], abs=ROUNDING)


@pytest.mark.parametrize(("version", "interface_type"), FMUS)
def test_an_event_that_fails_at_the_start_is_named(opened, version, interface_type):
    """With the component and the time; where there is no event, nothing fails."""
    component = opened(version, interface_type, fails=1)
    if interface_type == "cs":
        record({"fmu": component}, {})
        return
    with pytest.raises(CosimError, match=r"'fmu' stopped at t = 0\.0 s: .*DiscreteStates"):
        record({"fmu": component}, {})


@pytest.mark.fast("3")
@pytest.mark.parametrize("version", ["2", "3"])
def test_they_keep_the_contract(opened, version):
    """Runs of blocks of all sizes begin with the same row."""
    check_component(lambda: opened(version, "me"))


# --- by the names of variables, in a scenario ---


def set_value(scenario, key, value):
    with pytest.raises(ScenarioError) as error:
        cosim.run(scenario, set={key: value})
    return str(error.value)


def test_a_key_that_is_none_hints_at_the_start_value_of_a_variable(exported, tmp_path):
    """``start`` is FMI's word; a name with dots is one name, though TOML makes tables of it."""
    scenario = tmp_path / "one.toml"
    scenario.write_text(
        '[scenario]\nname = "one"\nstop = 1.0\nstep = 0.1\n'
        f'[components.motor]\nkind = "fmu"\npath = "{exported}"\n'
    )
    assert "set by motor.start.J;" in set_value(scenario, "motor.J", 0.02)
    assert "set by motor.start.damper.d;" in set_value(scenario, "motor.damper.d", 3.0)
    # what the hints say reaches the FMU, which has no such variables
    assert "no variable 'J'" in set_value(scenario, "motor.start.J", 0.02)
    assert "no variable 'damper.d'" in set_value(scenario, "motor.start.damper.d", 3.0)
    scenario.write_text(scenario.read_text() + 'start = { "damper.d" = 1.0 }\n')
    assert "'damper.d' is given twice" in set_value(scenario, "motor.start.damper.d", 3.0)
