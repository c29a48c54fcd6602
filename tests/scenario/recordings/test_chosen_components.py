"""Replays that compute some components, and take the others from the log."""

import json

import pytest

import cosim
from cosim.errors import LogError, ScenarioError, UsageError
from cosim.report.verification import verify
from cosim.scenario.document.document import shipped
from cosim.scenario.record import replay_origin
from tests.log.crafting import change_rows, put_together, take_apart

pytestmark = pytest.mark.usefixtures("without_verdicts")

LOOP = """
[scenario]
name = "loop"
stop = 0.5
step = 0.01
coupling = "{coupling}"

[components]
reference = {{ kind = "step", time = 0.1 }}
control = {{ kind = "pid", gain = 2.0, integral_time = 0.5 }}
body = {{ kind = "lag", time_constant = 0.2, initial = 0.5 }}
digital = {{ kind = "pid", gain = 1.0, period = 0.05 }}

[connections]
"control.setpoint" = "reference.y"
"control.measurement" = "body.y"
"body.u" = "control.y"
"digital.setpoint" = "reference.y"
"digital.measurement" = "body.y"
"""


def check_each(log):
    """Check that every component alone follows, bit for bit, from the rows of the others."""
    others = set(replay_origin(cosim.replay(log)).copied)
    for name in log.channels.keys() - others:
        again = cosim.replay(log, components=[name])
        assert set(replay_origin(again).copied) == log.channels.keys() - {name}
        verification = verify(log, again)
        assert verification.passed, (name, verification.problems)
        statuses = {entry.component: entry.status for entry in verification.components}
        assert statuses.pop(name) == "equal"
        assert set(statuses.values()) == {"copied"}


@pytest.mark.fast("pair")
@pytest.mark.parametrize("name", shipped())
def test_each_component_alone_follows_from_the_others(name, tmp_path):
    """Whatever the period of the component, and of those that it takes from the log."""
    check_each(cosim.run(name, out=tmp_path / "a.mcap", set={"scenario.stop": 0.2}))


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi", "newton"])
def test_each_component_of_a_loop_follows_from_the_others(coupling, tmp_path):
    """With a jump, and beside a sampled controller."""
    (tmp_path / "loop.toml").write_text(LOOP.format(coupling=coupling))
    check_each(cosim.run(tmp_path / "loop.toml", out=tmp_path / "a.mcap"))


@pytest.mark.slow
def test_a_log_that_ends_between_the_rows_of_a_component_is_replayed(tmp_path):
    """What is taken from the log keeps its value up to the end of the log, not of its rows."""
    changes = {"scenario.stop": 0.057, "identifier.period": 0.01}
    log = cosim.run("academic", out=tmp_path / "a.mcap", set=changes)
    assert log.time("identifier")[-1] == 0.05
    again = cosim.replay(log, components=["observer"])
    assert again.end_ns == 57_000_000
    check_each(log)


@pytest.mark.parametrize(
    ("name", "signal"),
    [("academic", "observer.u"), ("closed-loop", "plant.u")],  # which feedback.u[0:2] follows
)
def test_overrides_reach_a_component_whichever_are_chosen(name, signal, tmp_path):
    """Of a component from the log its rows know; one that is computed gets them again."""
    scenario = cosim.load(name).set({"scenario.stop": 0.2})
    with scenario.start(out=tmp_path / "a.mcap") as session:
        session.step(50)
        session[signal] = 1.0
        session.step(150)
    check_each(cosim.open_log(tmp_path / "a.mcap"))


def test_a_chosen_component_is_computed_from_the_rows_of_the_log(tmp_path):
    """A changed row of the observer is found in it; the regressor follows from it, as it is."""
    log = cosim.run("academic", out=tmp_path / "a.mcap", set={"scenario.stop": 0.2})
    observer = log.channels["observer"]
    column = observer.signal_columns["delta"].start - observer.start
    content = take_apart(log.path)

    def change(number, values):
        if number == 100:
            values[column] += 1.0

    change_rows(content, "observer", change)
    path = put_together(content, tmp_path / "b.mcap")
    found = verify(cosim.open_log(path), cosim.replay(path, components=["observer"]))
    assert found.difference.first.signal == "observer.delta"
    assert found.difference.first.time_ns == 100_000_000
    found = verify(cosim.open_log(path), cosim.replay(path, components=["regressor"]))
    first = {entry.component: entry.first for entry in found.components if entry.first is not None}
    assert {element.time_ns for element in first.values()} == {100_000_000}
    assert set(first) == {"regressor", "identifier"}  # what the observer drives


def test_an_impossible_choice_is_refused(tmp_path):
    """Unknown names, plants, code that is not allowed, and no name at all."""
    log = cosim.run("academic", out=tmp_path / "a.mcap", set={"scenario.stop": 0.1})
    with pytest.raises(UsageError, match=r"'obserer'; did you mean 'observer'\? Available"):
        cosim.replay(log, components=["obserer"])
    message = (
        "'plant' cannot be computed, as a replay takes it from the log: rerun=True computes it; "
        "available: u, delta, observer, regressor"
    )
    with pytest.raises(UsageError, match=message):
        cosim.replay(log, components=["observer", "plant"])
    with pytest.raises(UsageError, match=r"components: expected at least one .*; got none"):
        cosim.replay(log, components=[])
    with pytest.raises(UsageError, match=r"components: .*'observer'"):
        cosim.replay(log, components="observer")


def test_changes_of_what_is_not_chosen_are_refused(tmp_path):
    """It comes from the log, which knows nothing of them; so does what follows from them."""
    log = cosim.run("academic", out=tmp_path / "a.mcap", set={"scenario.stop": 0.1})
    message = "'observer' is taken from the recording; compute this component, too"
    with pytest.raises(UsageError, match=message):
        cosim.replay(log, components=["regressor"], set={"observer.filter_rate": 500.0})
    # it rests on the observer
    message = "'regressor' is taken from the recording; compute this component, too"
    with pytest.raises(UsageError, match=message):
        cosim.replay(log, components=["observer"], set={"observer.filter_rate": 500.0})
    chosen = ["observer", "regressor", "identifier"]
    changes = {"observer.filter_rate": 500.0}
    again = cosim.replay(log, components=chosen, set=changes)
    assert cosim.diff(again, cosim.replay(log, set=changes)).equal


SAMPLES = {
    "components.sensor": {"kind": "sensor", "period": 0.01},
    "connections.sensor.u": "plant.y",
    "scenario.stop": 0.1,
}


def test_a_sensor_whose_log_has_not_all_its_rows_is_to_be_computed(tmp_path):
    """Between its samples it has no value, and no row."""
    log = cosim.run("academic", out=tmp_path / "a.mcap", set=SAMPLES)
    message = (
        r"set\['sensor'\]: .* only every 10 communication steps .*; "
        "recompute it, too"
    )
    with pytest.raises(ScenarioError, match=message):
        cosim.replay(log, components=["observer"])
    assert verify(log, cosim.replay(log, components=["observer", "sensor"])).passed


def test_the_command_line_names_what_was_not_verified(tmp_path, call):
    """In words, and by component in --json."""
    cosim.run("academic", out=tmp_path / "a.mcap", set={"scenario.stop": 0.1})
    code, out, _ = call("replay", "a.mcap", "--component", "observer", "--verify")
    assert code == 0
    assert "not verified, as not chosen: u.y, delta.y, regressor.mu" in out
    command = ("replay", "a.mcap", "--component", "observer", "--component", "u", "--verify")
    _, out, _ = call(*command, "--json")
    found = {entry["component"]: entry for entry in json.loads(out)["components"]}
    equal = {name for name, entry in found.items() if entry["status"] == "equal"}
    assert equal == {"observer", "u"}
    assert found["regressor"]["reason"] == "not chosen"
    assert "a plant" in found["plant"]["reason"] or "plants" in found["plant"]["reason"]
    code, _, err = call("replay", "a.mcap", "--component", "nothing")
    assert code == 2
    assert err.startswith("cosim: the log has no component 'nothing'; available: u, delta")


def test_a_log_that_is_no_log_of_a_scenario_is_refused_as_before(tmp_path):
    """Components are those of the scenario."""
    from cosim.blocks import sine
    from cosim.core import Clock, Graph, run
    from cosim.log import McapRecorder

    run(Graph({"u": sine(rate=1.0)}, {}), Clock(1.0, 0.1), McapRecorder(tmp_path / "a.mcap"))
    with pytest.raises(LogError, match=r"the log has no scenario\.toml"):
        cosim.replay(tmp_path / "a.mcap", components=["u"])
