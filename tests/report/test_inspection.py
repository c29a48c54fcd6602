"""What info shows of a scenario and of a log."""

import platform
from datetime import UTC, datetime, timedelta
from time import process_time

import pytest

import cosim
from cosim.report import inspection
from cosim.report.inspection import describe_log, describe_scenario
from cosim.scenario.exporting import export_component
from tests.log.recordings import STEP_NS, record
from tests.scenario.user_modules import RELAY

SCENARIO = """
[scenario]
name = "x"
stop = 0.2
step = 0.1

[components.length]
kind = "constant"
value = 1.0
unit = "m"

[components.width]
kind = "constant"
value = 2.0
unit = "m"

[components.area]
kind = "sum"
signs = [1.0]
size = 2
unit = "mm"

[connections]
"area.u1" = { from = ["length.y", "width.y"], offset = -0.5 }
"""


def test_a_connection_shows_all_its_sources_and_one_conversion(tmp_path):
    """Two sources in m stacked to an input in mm: the map and the conversion stand once."""
    path = tmp_path / "x.toml"
    path.write_text(SCENARIO)
    (row,) = describe_scenario(str(path))["connections"]
    assert row["to"] == "area.u1"
    assert row["from"] == "length.y, width.y"
    assert row["map"] == "v - 0.5"
    assert row["unit"] == "m -> mm"
    assert row["conversion"] == "((v * 1.0 + 0.0) - 0.0) / 0.001"


def test_signals_are_shown_with_what_they_are():
    """What the component itself says of a port; nothing where it says nothing."""
    rows = {row["signal"]: row["description"] for row in describe_scenario("academic")["signals"]}
    assert rows["observer.delta"] == "reconstructed disturbance"
    assert rows["identifier.theta"] == "estimated parameters of the disturbance"
    assert rows["u.y"] is None


def test_an_fmu_that_saves_its_state_is_shown(tmp_path):
    """The description is enough, whatever the FMU could do if it ran."""
    fmu = tmp_path / "plant.fmu"
    export_component("closed-loop", "plant", fmu)
    path = tmp_path / "x.toml"
    for interface_type in ("me", "cs"):
        path.write_text(
            f'''
[scenario]
name = "x"
stop = 0.2
step = 0.1

[components]
plant = {{ kind = "fmu", path = "{fmu}", interface_type = "{interface_type}" }}
'''
        )
        signals = [row["signal"] for row in describe_scenario(str(path))["signals"]]
        assert signals == ["plant.u", "plant.delta", "plant.y", "plant.x_a", "plant.x_b"]


def test_messages_are_shown_in_the_order_of_time_up_to_a_number(tmp_path, monkeypatch):
    """How many are left out is said."""
    path = tmp_path / "x.mcap"
    texts = [f"message {i}" for i in range(4)]
    record(path, messages=[(i * STEP_NS, "info", "plant", text) for i, text in enumerate(texts)])
    shown = describe_log(str(path))
    assert [row["text"] for row in shown["messages"]] == texts
    assert "more messages" not in shown
    monkeypatch.setattr(inspection, "MOST_MESSAGES", 3)
    shown = describe_log(str(path))
    assert [row["text"] for row in shown["messages"]] == texts[:3]
    assert shown["more messages"] == {"not shown": 1}


def test_a_log_says_when_by_what_and_on_which_machine_it_was_written(tmp_path):
    """The clock of the machine, to a second; the version; the system and the processor."""
    path = tmp_path / "x.mcap"
    before = datetime.now(UTC) - timedelta(seconds=1)
    record(path)
    shown = describe_log(str(path))["run"]
    assert before <= datetime.fromisoformat(shown["written"]) <= datetime.now(UTC)
    assert f"cosim {cosim.__version__}" in shown["written by"]
    assert platform.python_version() in shown["written by"]
    assert platform.platform() in shown["machine"]
    assert platform.node() not in shown["machine"]  # the name of the machine is its owner's


def test_a_log_has_no_path_of_its_sender(tmp_path, monkeypatch):
    """Whatever was given with a whole path: scenario, swaps, log of a replay, and its files."""
    folder = tmp_path / "sender"
    scenarios = folder / "scenarios"
    scenarios.mkdir(parents=True)
    (scenarios / "relay.py").write_text(RELAY)
    (scenarios / "few.csv").write_text("t,y\n0,1\n0.2,2\n")  # a warning names it
    export_component("closed-loop", "plant", folder / "plant.fmu")
    text = SCENARIO.replace(
        "[connections]",
        """
[components.few]
kind = "field-data"
path = "few.csv"

[components.relay]
kind = "python"
class = "relay:Relay"
width = 0.1

[components.plant]
kind = "constant"
value = 1.0

[connections]
"relay.u" = "length.y"
""",
    )
    (scenarios / "x.toml").write_text(text)
    monkeypatch.chdir(folder)
    swaps = {"plant": folder / "plant.fmu", "width": scenarios / "few.csv"}
    with pytest.warns(cosim.CosimWarning):
        run = cosim.run(
            scenarios / "x.toml",
            swap=swaps,
            map={"width.y": "y"},
            out=folder / "x.mcap",
        )
    with pytest.warns(cosim.CosimWarning):
        again = cosim.replay(folder / "x.mcap", out=folder / "y.mcap")
    for log in (run, again):
        shown = describe_log(str(log.path))
        assert str(tmp_path) not in f"{shown} {log.metadata}"
        for name in log.attachments:
            assert str(tmp_path).encode() not in log.attachment(name)
    assert shown["run"]["replay of"]["log"] == "x.mcap"
    assert describe_log(str(run.path))["metadata"]["plant"]["path"] == "plant.fmu"


def describing_cost(folder, size):
    """Return the processor time for each component to describe a chain of gains."""
    lines = ["[scenario]", 'name = "gains"', "stop = 0.01", "step = 1e-3"]
    connections = ["[connections]"]
    lines += ["[components.g0]", 'kind = "constant"', "value = 1.0"]
    for i in range(1, size):
        lines += [f"[components.g{i}]", 'kind = "gain"', "K = 2.0"]
        connections.append(f'"g{i}.u" = "g{i - 1}.y"')
    path = folder / f"{size}.toml"
    path.write_text("\n".join(lines + connections), encoding="utf-8")
    began = process_time()
    assert len(describe_scenario(str(path))["connections"]) == size - 1
    return (process_time() - began) / size


@pytest.mark.usefixtures("frozen_heap")
def test_the_cost_to_describe_a_component_does_not_grow(tmp_path):
    """The table of the ports is made once, not for every connection."""
    ratio = float("inf")
    for _ in range(5):  # the smallest counts: another process can only add time
        base = min(describing_cost(tmp_path, 100) for _ in range(2))
        ratio = min(ratio, describing_cost(tmp_path, 600) / base)
        if ratio <= 1.5:
            return
    raise AssertionError(f"a component costs {ratio} times as much to describe")
