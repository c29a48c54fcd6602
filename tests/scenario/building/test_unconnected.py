"""Inputs of FMUs that nothing drives keep their start values."""

import numpy as np
import pytest

import cosim
from cosim.core.recorders import Memory
from cosim.errors import GraphError, ScenarioError
from cosim.fmi.component import load
from cosim.report.inspection import describe_scenario
from tests.fmi.compiled import compile_fmu
from tests.fmi.rogues import XML

STATELESS = XML.replace('canGetAndSetFMUstate="true"', "")
STEP = 0.01
STEPS = 5


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    """Compile x' = u - x by Euler's method from x = 1, y = x, where u has the start value 0.25."""
    xml = STATELESS.replace('start="0" unit="m"', 'start="0.25" unit="m"')
    assert xml != STATELESS
    path = tmp_path_factory.mktemp("unconnected") / "lag.fmu"
    return compile_fmu(path, xml, "rogue2.c", defines=("ROGUE=GOOD",))


@pytest.fixture
def scenario(fmu, tmp_path):
    """Write a scenario with the FMU: lines of its table, and connections."""

    def write(table="", connections=""):
        path = tmp_path / "one.toml"
        path.write_text(
            f'[scenario]\nname = "one"\nstop = {STEP * STEPS}\nstep = {STEP}\n'
            '[components.c]\nkind = "constant"\nvalue = 0.5\n'
            f'[components.plant]\nkind = "fmu"\npath = "{fmu}"\n{table}\n'
            f"[connections]\n{connections}\n"
        )
        return path

    return write


def euler(u):
    x = [1.0]
    for _ in range(STEPS):
        x.append(x[-1] + STEP * (u - x[-1]))
    return np.array(x)


@pytest.mark.parametrize(
    ("table", "u"), [("", 0.25), ("start = { u = 0.75 }", 0.75), ("start = { u = 0.0 }", 0.0)]
)
def test_an_input_that_nothing_drives_keeps_its_start_value(scenario, table, u):
    """The FMU's, or the one that the scenario sets; it is recorded, and said once."""
    path = scenario(table)
    memory = cosim.run(path, recorder=Memory())
    assert memory["plant.u"].tolist() == [u] * (STEPS + 1)
    assert memory["plant.y"] == pytest.approx(euler(u), rel=1e-15)
    said = [message for message in memory.messages() if "not connected" in message.text]
    assert [(m.time_ns, m.level, m.source, m.text) for m in said] == [
        (0, "info", "plant", f"not connected, so at their start values: u = {u}")
    ]
    rows = {row["to"]: row for row in describe_scenario(str(path))["connections"]}
    assert rows["plant.u"]["from"] == f"start value {u:g}"


def test_a_start_value_of_a_connected_input_is_refused(scenario):
    """The connection would overwrite it at once."""
    path = scenario("start = { u = 0.75 }", '"plant.u" = "c.y"')
    with pytest.raises(
        ScenarioError, match=r"'plant\.u' is connected and has an explicit start value"
    ):
        cosim.run(path, recorder=Memory())


def test_an_input_without_a_start_value_must_be_connected(tmp_path):
    """FMI 1.0 does not need one."""
    xml = STATELESS.replace('<Real start="0" unit="m"/>', '<Real unit="m"/>')
    path = compile_fmu(tmp_path / "lag.fmu", xml, "rogue2.c", defines=("ROGUE=GOOD",))
    with load(path) as opened, pytest.raises(GraphError, match=r"'plant\.u' is not connected"):
        cosim.core.Graph({"plant": opened.component}, {})
