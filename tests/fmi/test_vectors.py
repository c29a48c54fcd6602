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
STACK = '"arm.tau" = ["a.y", "b.y"]'
ELEMENTS = SCENARIO.replace(STACK, '"arm.tau[1]" = "b.y"\narm."tau[0]" = "a.y"')


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
            STACK,
            '"arm.tau[1]" = "a.y"\n"arm.tau[2]" = "b.y"',
            r"'arm.tau\[2\]': 'arm.tau' has 2 elements, numbered from 0 \(of the FMU: tau\[1\] to "
            r"tau\[2\]\)$",
        ),
        (
            STACK,
            '"arm.tau" = ["a.y", "b.y"]\n"arm.tau[0]" = "b.y"',
            r"'arm.tau\[0\]' overlaps 'arm.tau'",
        ),
        (
            STACK,
            '"arm.tau[1]" = "a.y"\n"arm.tau[01]" = "b.y"',
            r"'arm.tau\[1\]' is given twice; an input has one source",
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


def test_elements_of_an_input_have_connections_of_their_own(scenario, call, tmp_path):
    """The same run as with a stack, with the same hash; the log shows each connection."""
    stacked = cosim.run(scenario(), out=tmp_path / "stacked.mcap")
    path = scenario(ELEMENTS)
    log = cosim.run(path, out=tmp_path / "elements.mcap")
    assert log.content_hash() == stacked.content_hash()
    recorded = log.metadata["cosim.connections"]
    assert {to: json.loads(text)["from"] for to, text in recorded.items()} == {
        "arm.tau[0]": "a.y",
        "arm.tau[1]": "b.y",
        "double.u": "arm.q[1]",
    }
    rows = json.loads(call("info", path, "--json")[1])["connections"]
    assert {row["to"]: row["from"] for row in rows} == {
        "arm.tau[0]": "a.y",
        "arm.tau[1]": "b.y",
        "double.u": "arm.q[1]",
    }
    assert cosim.diff(log, cosim.replay(log)).equal


def test_an_element_is_set_from_outside(scenario, call, tmp_path):
    """On the command line and in Python, under either spelling of the file."""
    path = scenario(ELEMENTS)
    stack = '"arm.tau" = { from = ["b.y", "b.y"], gain = [[1.0, 0.0], [0.0, 1.0]] }'
    expected = cosim.run(scenario(SCENARIO.replace(STACK, stack)))
    path = scenario(ELEMENTS)
    change = "connections.arm.tau[0]=b.y"
    assert call("run", path, "--set", change, "--out", tmp_path / "set.mcap")[0] == 0
    log = cosim.open_log(tmp_path / "set.mcap")
    assert log["arm.tau"].tobytes() == expected["arm.tau"].tobytes()
    table = {"from": "a.y", "gain": 4.0, "offset": 1.0}
    again = cosim.run(path, set={"connections.arm.tau[0]": table})
    assert again["arm.tau"].tolist() == [[5.0, 5.0]] * 3


def test_elements_that_nothing_drives_keep_their_start_values(scenario, call, tmp_path):
    """The run says so once, and which variable of the FMU an element is."""
    path = scenario(SCENARIO.replace(STACK, '"arm.tau[1]" = "b.y"'))
    log = cosim.run(path, out=tmp_path / "part.mcap")
    assert log["arm.tau"].tolist() == [[0.0, 5.0]] * 3
    texts = [message.text for message in log.messages()]
    assert "not connected, so at their start values: tau[0] = 0.0" in texts
    text = "arm.tau[1] is tau[2] of the FMU, as elements are numbered from 0 here; write arm."
    assert text in log.metadata["cosim.run"]["warnings"]
    rows = json.loads(call("info", path, "--json")[1])["connections"]
    assert {row["to"]: row["from"] for row in rows}["arm.tau[0]"] == "start value 0"
    assert cosim.diff(log, cosim.replay(log)).equal


@pytest.mark.parametrize("own", [False, True])
def test_units_of_elements_are_converted_and_recorded(scenario, tmp_path, own):
    """tau in N m: 1 kN m and 5 mN m are 1000 and 0.005 N m.

    Two variables that are no vector, as their numbers are not, keep names that look like elements.
    """
    names = ("tau[1]", "tau[5]") if own else ("tau[0]", "tau[1]")
    described = XML.replace("tau[2]", "tau[5]") if own else XML
    xml = described.replace(
        "<ModelVariables>",
        '<UnitDefinitions><Unit name="N.m"><BaseUnit kg="1" m="2" s="-2"/></Unit>'
        "</UnitDefinitions><ModelVariables>",
    ).replace('<Real start="0"/>', '<Real start="0" unit="N.m"/>')
    path = scenario(
        SCENARIO.replace("value = 1.0", 'value = 1.0, unit = "kN.m"')
        .replace("value = 5.0", 'value = 5.0, unit = "mN.m"')
        .replace(STACK, f'"arm.{names[0]}" = "a.y"\n"arm.{names[1]}" = "b.y"')
    )
    compile_fmu(tmp_path / "arm.fmu", xml, "many2.c", defines=("N=4",))
    log = cosim.run(path, out=tmp_path / "units.mcap")
    found = [log[f"arm.{name}"][0].item() for name in names]
    assert found == [1000.0, 0.005]
    for name in names:
        recorded = json.loads(log.metadata["cosim.connections"][f"arm.{name}"])
        assert len(recorded["conversions"]) == 1
