"""Connections of a scenario: conversion of units, and loops through FMUs.

These FMUs do not declare what feeds through.
"""

import json

import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.report.inspection import describe_scenario
from cosim.scenario.exporting import export_component
from tests.scenario.fmu_edits import rewritten
from tests.scenario.refusals import check_refused

UNITS = """
scenario = {{ name = "units", stop = 1.0, step = 0.01 }}
[components]
room = {{ kind = "sine", amplitude = 5.0, rate = 6.0, offset = 20.0, unit = "degC" }}
sensor = {{ kind = "lag", time_constant = 0.2, unit = "K" }}
readout = {{ kind = "lag", time_constant = 0.1, unit = "{readout}" }}
[connections]
"sensor.u" = "room.y"
"readout.u" = {{ from = "sensor.y", gain = 2.0, offset = -3.0 }}
"""

LOOP = """
scenario = {{ name = "loop", stop = 0.5, step = 0.01, coupling = "{coupling}" }}
[components]
one = {{ kind = "constant", value = 1.0 }}
plant = {{ kind = "fmu", path = "{path}" }}
k = {{ kind = "gain", K = 0.5 }}
[connections]
"plant.u" = "k.y"
"plant.delta" = "one.y"
"plant.gain" = "one.y"
"plant.sign" = "one.y"
"k.u" = "plant.y"
"""


@pytest.fixture
def units(tmp_path):
    """Write the scenario with units to a file."""
    path = tmp_path / "units.toml"
    path.write_text(UNITS.format(readout="degC"))
    return path


def test_units_are_converted_on_the_way(units):
    """The room in degC drives the sensor in K, and that its readout in degC.

    Both are converted by the documented formula, bit for bit.
    """
    log = cosim.run(units)
    assert (log["sensor.u"] == log["room.y"] + 273.15).all()
    assert (log["readout.u"] == (2.0 * log["sensor.y"] - 3.0) - 273.15).all()


def test_a_conversion_is_recorded_and_replayed_bit_for_bit(units, tmp_path):
    """The log has the conversion, and a replay computes the same; so does info."""
    log = cosim.run(units, out=tmp_path / "units.mcap")
    recorded = json.loads(log.metadata["cosim.connections"]["sensor.u"])
    assert recorded["conversions"] == [
        {"factor1": 1.0, "offset1": 273.15, "offset2": 0.0, "factor2": 1.0}
    ]
    assert cosim.diff(log, cosim.replay(log.path)).equal
    rows = {row["to"]: row for row in describe_scenario(str(units))["connections"]}
    assert rows["sensor.u"]["conversion"] == "((v * 1.0 + 273.15) - 0.0) / 1.0"
    assert (rows["readout.u"]["map"], rows["readout.u"]["unit"]) == ("2.0 v - 3.0", "K -> degC")


FMU = """
scenario = {{ name = "fmu", stop = 0.5, step = 0.01 }}
[components]
u = {{ kind = "sine", amplitude = 5.0, rate = 6.0, unit = "degC" }}
zero = {{ kind = "constant", value = 0.0 }}
plant = {{ kind = "fmu", path = "{path}" }}
readout = {{ kind = "lag", time_constant = 0.1, unit = "mm" }}
[connections]
"plant.u" = "u.y"
"plant.delta" = "zero.y"
"readout.u" = "plant.y"
"""


def test_units_that_cannot_be_converted_are_refused(units):
    """Also one that is not known, unless a connection takes its values as they are.

    What a connection names has to be known: it is converted.
    """
    units.write_text(UNITS.format(readout="degF"))
    scaled = {"from": "sensor.y", "gain": 2.0, "unit": "NM"}
    cases = [
        ({"readout.unit": "Pa"}, r"sensor\.y -> readout\.u: .*'K'.*'Pa'"),
        ({"sensor.unit": "parsec"}, r"sensor\.y -> readout\.u: 'parsec' is not known.*\"as is\""),
        (
            {"sensor.unit": {"u": "degF", "y": "furlong"}},
            r"readout\.u: 'furlong' is not known.*'degF'.*\"as is\"",
        ),
        ({"connections.readout.u": scaled}, r"readout\.u.*: .*'NM'"),
    ]
    check_refused(cases, lambda changes: cosim.run(units, set=changes), ScenarioError)
    as_is = {"from": "sensor.y", "unit": "as is"}
    changes = {"sensor.unit": {"y": "furlong"}, "connections.readout.u": as_is}
    log = cosim.run(units, set=changes)
    assert (log["readout.u"] == log["sensor.y"]).all()
    sensor = next(channel for channel in log.channels.values() if channel.name == "sensor")
    assert sensor.interface.by_name["y"].unit == "furlong"


def test_units_of_an_fmu_are_what_it_defines(tmp_path):
    """The definitions count, not the names: a temperature u by factor and offset, a length y."""
    export_component("academic", "plant", tmp_path / "plain.fmu")
    definitions = (
        '</CoSimulation><UnitDefinitions><Unit name="F"><BaseUnit K="1" factor="0.5" '
        'offset="255.0"/></Unit>'
        '<Unit name="long"><BaseUnit m="1" factor="0.25"/></Unit></UnitDefinitions>'
    )
    path = rewritten(
        tmp_path / "plain.fmu",
        tmp_path / "units.fmu",
        ("</CoSimulation>", definitions),
        ('<Real start="0.0" />', '<Real start="0.0" unit="F"/>'),
        ("<Real />", '<Real unit="long"/>'),
    )
    (tmp_path / "fmu.toml").write_text(FMU.format(path=path))
    log = cosim.run(tmp_path / "fmu.toml", out=tmp_path / "fmu.mcap")
    assert (log["plant.u"] == ((log["u.y"] + 273.15) - 255.0) / 0.5).all()
    assert (log["readout.u"] == log["plant.y"] * 0.25 / 1e-3).all()
    assert cosim.diff(log, cosim.replay(log)).equal


def test_a_unit_of_an_fmu_that_is_not_known_is_refused(tmp_path):
    """With the way out, which is taken."""
    export_component("academic", "plant", tmp_path / "plain.fmu")
    edit = ("<Real />", '<Real unit="widget"/>')
    path = rewritten(tmp_path / "plain.fmu", tmp_path / "widgets.fmu", edit)
    file = tmp_path / "fmu.toml"
    file.write_text(FMU.format(path=path))
    with pytest.raises(ScenarioError, match=r"'widget' is not known.*'mm'.*unit = \"as is\""):
        cosim.run(file)
    log = cosim.run(file, set={"connections.readout.u": {"from": "plant.y", "unit": "as is"}})
    assert log["readout.u"].tobytes() == log["plant.y"].tobytes()


STACK = """
scenario = { name = "stack", stop = 0.1, step = 0.01 }
[components]
a = { kind = "constant", value = 1.0, unit = "m" }
b = { kind = "constant", value = 1.0, unit = "mm" }
lag = { kind = "lag", time_constant = 1.0, size = 2 }
[connections]
"lag.u" = ["a.y", "b.y"]
"""


def test_a_stack_of_lengths_in_several_units_is_warned_of(tmp_path):
    """An input without a unit takes both as they are; one with a unit converts each."""
    file = tmp_path / "stack.toml"
    file.write_text(STACK)
    mixed = cosim.run(file)
    text = "a.y, b.y -> lag.u: the input has no unit, so values in 'm', 'mm' are stacked"
    assert text in str(mixed.messages())
    assert mixed["lag.u"][0].tolist() == [1.0, 1.0]
    declared = cosim.run(file, set={"lag.unit": "m"})
    assert declared["lag.u"][0].tolist() == [1.0, 1e-3]
    assert "stacked" not in str(declared.messages())


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
def test_a_loop_through_an_fmu_without_dependencies_runs_with_a_warning(
    coupling, foreign2, tmp_path
):
    """pythonfmu writes no dependencies, but its y = x1 - u does feed through.

    The loop is solved at initialization and one step late afterwards, which a warning reports. At
    the start u = y / 2 and y = 1 - u, so y = 2 / 3.
    """
    (tmp_path / "loop.toml").write_text(LOOP.format(coupling=coupling, path=foreign2))
    log = cosim.run(tmp_path / "loop.toml", out=tmp_path / "loop.mcap")
    text = "plant.y may depend directly on plant.u (the FMU does not say): taken as not feeding"
    assert any(warning.source == "plant" and text in warning.text for warning in log.warnings)
    assert abs(log["plant.y"][0] - 2.0 / 3.0) <= 1e-15
    assert (log["k.y"] == 0.5 * log["plant.y"]).all()
    assert (log["plant.u"] == log["k.y"]).all()
    assert cosim.diff(log, cosim.replay(log.path)).equal


INITIAL_LOOP = """
scenario = { name = "initial-loop", stop = 0.1, step = 0.01 }
[components]
r = { kind = "constant", value = 1.1 }
s = { kind = "sum", signs = [1.0, -1.0] }
lag = { kind = "lag", time_constant = 1.0 }
k = { kind = "gain", K = 3.3 }
[connections]
"s.u1" = "r.y"
"s.u2" = "k.y"
"k.u" = "lag.y"
"lag.u" = "s.y"
"""


@pytest.mark.slow
@pytest.mark.parametrize("interface_type", ["me", "cs"])
def test_a_loop_at_initialization_through_an_fmu_is_solved_and_replayed(interface_type, tmp_path):
    """The lag starts at its input, y = 1.1 - 3.3 y = 1.1 / 4.3.

    This holds for the component, and for its FMU by InitialUnknowns.
    """
    scenario = tmp_path / "loop.toml"
    fmu = tmp_path / "lag.fmu"
    path = tmp_path / "loop.mcap"
    scenario.write_text(INITIAL_LOOP)
    export_component(str(scenario), "lag", fmu)
    own = cosim.run(scenario)
    run = cosim.run(
        scenario, out=path, swap={"lag": fmu}, set={"lag.interface_type": interface_type}
    )
    assert abs(own["lag.y"][0] - 1.1 / 4.3) <= 1e-15
    assert (run["lag.y"][0], run["k.y"][0]) == (own["lag.y"][0], own["k.y"][0])
    assert cosim.diff(run, cosim.replay(path)).equal
