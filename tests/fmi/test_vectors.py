"""Scalars of an FMU that are numbered from 1 are one signal, whose elements count from 0."""

import json

import pytest

import cosim
from cosim.errors import CosimError
from tests.fmi.compiled import compile_fmu

XML = """<fmiModelDescription fmiVersion="2.0" modelName="arm" guid="arm">
<CoSimulation modelIdentifier="model" canHandleVariableCommunicationStepSize="true"/>
<ModelVariables>
<ScalarVariable name="tau[1]" valueReference="0" causality="input"><Real start="0"/>
</ScalarVariable>
<ScalarVariable name="tau[2]" valueReference="3" causality="input"><Real start="0"/>
</ScalarVariable>
<ScalarVariable name="q[1]" valueReference="1" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="q[2]" valueReference="3" causality="output"><Real/></ScalarVariable>
</ModelVariables>
<ModelStructure><Outputs><Unknown index="3" dependencies=""/><Unknown index="4" dependencies=""/>
</Outputs></ModelStructure></fmiModelDescription>"""
SCENARIO = """
[scenario]
name = "arm"
stop = 0.1
step = 0.05
[components]
arm = { kind = "fmu", path = "arm.fmu" }
a = { kind = "constant", value = 1.0 }
b = { kind = "constant", value = 5.0 }
double = { kind = "gain", K = 2.0 }
[connections]
"arm.tau" = ["a.y", "b.y"]
"double.u" = "arm.q[1]"
"""


@pytest.fixture
def scenario(tmp_path):
    compile_fmu(tmp_path / "arm.fmu", XML, "many2.c", defines=("N=4",))

    def write(text=SCENARIO):
        path = tmp_path / "arm.toml"
        path.write_text(text)
        return path

    return write


def test_an_element_of_an_fmu_that_counts_from_1_is_named(scenario):
    """arm.q[1] is the second element, the FMU's q[2]: nothing is wrong, but the user must know."""
    log = cosim.run(scenario())
    assert log["double.u"].tolist() == log["arm.q"][:, 1].tolist()
    text = "arm.q[1] is q[2] of the FMU, as elements are numbered from 0 here; write arm.q[1:2]"
    assert text in log.metadata["cosim.run"]["warnings"]
    meant = cosim.run(scenario(SCENARIO.replace("arm.q[1]", "arm.q[1:2]")))
    assert "numbered from 0" not in meant.metadata["cosim.run"]["warnings"]


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        (
            '"arm.tau" = ["a.y", "b.y"]',
            '"arm.tau[1]" = "a.y"\n"arm.tau[2]" = "b.y"',
            r"'arm.tau\[1\]' is a part of the input 'arm.tau', which has 2 elements \(of the FMU: "
            r"tau\[1\] to tau\[2\]\) and is connected as a whole: \"arm.tau\" = ",
        ),
        (
            '"arm.q[1]"',
            '"arm.q[2]"',
            r"'arm.q' has 2 elements, numbered from 0 \(of the FMU: q\[1\] to q\[2\]\)",
        ),
    ],
)
def test_elements_that_cannot_be_connected(scenario, before, after, text):
    """The message says what the FMU calls them."""
    with pytest.raises(CosimError, match=text):
        cosim.run(scenario(SCENARIO.replace(before, after)))


def test_info_shows_which_variables_are_one_signal(scenario, call, tmp_path):
    """By the names that a connection takes."""
    found = json.loads(call("info", tmp_path / "arm.fmu", "--json")[1])
    assert found["vectors"] == {"tau": ["tau[1]", "tau[2]"], "q": ["q[1]", "q[2]"]}
    assert "tau\ttau[1], tau[2]" in call("info", tmp_path / "arm.fmu")[1].splitlines()
