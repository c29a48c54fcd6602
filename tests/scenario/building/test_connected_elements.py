"""Elements of an input are connected one by one in a scenario, and its components swapped."""

from dataclasses import replace

import numpy as np
import pytest

import cosim
from cosim.core.recorders import Memory
from cosim.errors import ScenarioError
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import find
from tests.fmi.compiled import compile_fmu
from tests.scenario.refusals import check_refused

SCENARIO = """
[scenario]
name = "plant"
stop = 0.3
step = 0.05
[components]
a = { kind = "sine", amplitude = 1.0, rate = 3.0 }
b = { kind = "step", time = 0.1, before = 1.0, after = 4.0 }
meter = { kind = "gain", K = 2.0 }
[components.plant]
kind = "controller"
A = [[-1.0]]
B = [[1.0, 2.0]]
C = [[1.0]]
D = [[0.0, 0.0]]
[connections]
"plant.u[1]" = "b.y"
"plant.u[0]" = "a.y"
"meter.u" = "plant.y"
"""
OTHER = """<fmiModelDescription fmiVersion="2.0" modelName="other" guid="other">
<CoSimulation modelIdentifier="model" canHandleVariableCommunicationStepSize="true"/>
<ModelVariables>
<ScalarVariable name="force" valueReference="0" causality="input"><Real start="0"/>
</ScalarVariable>
<ScalarVariable name="torque" valueReference="2" causality="input"><Real start="0"/>
</ScalarVariable>
<ScalarVariable name="out" valueReference="1" causality="output"><Real/></ScalarVariable>
</ModelVariables>
<ModelStructure><Outputs><Unknown index="3" dependencies=""/></Outputs></ModelStructure>
</fmiModelDescription>"""


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "plant.toml"
    path.write_text(SCENARIO)
    return path


@pytest.fixture
def other(tmp_path):
    return compile_fmu(tmp_path / "other.fmu", OTHER, "many2.c", defines=("N=3",))


def stacked(path):
    text = path.read_text().replace('"plant.u[1]" = "b.y"\n', "")
    copy = path.with_name("stacked.toml")
    copy.write_text(text.replace('"plant.u[0]" = "a.y"', '"plant.u" = ["a.y", "b.y"]'))
    return copy


@pytest.mark.parametrize("interpolation", ["linear", "zero-order"])
def test_the_run_is_that_of_a_stack(path, tmp_path, interpolation):
    """The same content hash, whatever the interpolation; each element is held or not by itself."""
    options = {"set": {"scenario.input_interpolation": interpolation}}
    one = cosim.run(path, out=tmp_path / "one.mcap", **options)
    both = cosim.run(stacked(path), out=tmp_path / "both.mcap", **options)
    assert one.content_hash() == both.content_hash()
    held = [False, True] if interpolation == "linear" else [True, True]
    assert one.held["plant"].tolist() == held


def test_a_map_names_elements_of_an_input(path, other, tmp_path):
    """The FMU's force and torque are plant.u, and each is driven as the scenario says."""
    names = {"plant.u[1]": "torque", "plant.u[0]": "force", "meter.u": "out"}
    swap = {"plant": other}
    run = cosim.run(path, swap=swap, map=names, out=tmp_path / "swapped.mcap")
    assert run["plant.u[1]"].tolist() == run["b.y"].tolist()
    assert run["plant.u[0]"].tolist() == run["a.y"].tolist()
    whole = cosim.run(path, swap=swap, map={"plant.u": ["force", "torque"], "plant.y": "out"})
    assert whole["plant.u"].tobytes() == run["plant.u"].tobytes()
    assert whole["plant.y"].tobytes() == run["plant.y"].tobytes()
    assert cosim.diff(run, cosim.replay(tmp_path / "swapped.mcap")).equal


def test_wrong_elements_are_named(path):
    """With the line or the option that they come from."""
    cases = [
        (
            {"connections.plant.u": "a.y"},
            r"set\['connections\.plant\.u'\]: a\.y -> plant\.u: .*size 1"
            r".*'plant\.u\[0\]', 'plant\.u\[1\]'",
        ),
        (
            {"connections.plant.u[2]": "a.y"},
            r"set\['connections\.plant\.u\[2\]'\]: 'plant\.u\[2\]'",
        ),
        (
            {"plant.B": [[1.0, 2.0, 3.0]], "plant.D": [[0.0] * 3]},
            r"plant\.toml:18: connections\.plant\.u\[0\]: 'plant\.u\[2\]' is not connected",
        ),
    ]
    check_refused(cases, lambda change: cosim.run(path, set=change), ScenarioError)


def test_an_identifier_finds_its_regressor_behind_slices():
    """Its start is computed from the observer that drives the regressor, also by elements."""
    document = find("academic")
    whole = '"identifier.regressor" = "regressor.mu"'
    assert whole in document.text
    slices = [f'"identifier.regressor[{i}]" = "regressor.mu[{i}]"' for i in ("0:2", "2", "3:6")]
    text = document.text.replace(whole, "\n".join(slices))
    text = text.replace('"regressor.delta" =', '"regressor.delta[0]" =')
    short = {"scenario.stop": 40.0, "scenario.step": 0.01}
    runs = []
    for changed in (document, replace(document, text=text)):
        runs.append(cosim.run(parse(changed.with_changes(short)), recorder=Memory()))
    first, second = runs
    assert first["identifier.theta"].tobytes() == second["identifier.theta"].tobytes()
    assert np.isfinite(first["identifier.theta"]).any()


@pytest.mark.parametrize("wrong", ["5.0", '{ from = "a.y", gain = "2" }', '"ay"'])
def test_an_element_that_cannot_be_read_is_the_one_problem(path, wrong):
    """It is not reported as missing too, and the other elements are checked all the same."""
    text = path.read_text().replace('"plant.u[0]" = "a.y"', f'"plant.u[0]" = {wrong}')
    path.write_text(text.replace('"b.y"', '"b.yy"'))
    with pytest.raises(ScenarioError, match=r"plant\.toml:18: connections\.plant\.u\[0\]") as error:
        cosim.load(path)
    first, second = str(error.value).splitlines()
    assert "plant.toml:17: connections.plant.u[1]: 'b.yy': 'b' has no output" in second + first
