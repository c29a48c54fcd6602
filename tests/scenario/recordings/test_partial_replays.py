"""Replays of partial logs: what their recorded signals allow, and what is refused by name."""

import random

import pytest

import cosim
from cosim.errors import CosimError, LogError, UsageError
from cosim.log.contents.metadata import read_json
from cosim.report.verification import verify
from cosim.scenario.document.document import shipped

pytestmark = pytest.mark.usefixtures("without_verdicts")

SHORT = {"scenario.stop": 0.2}
ALL = {"record.signals": ["*"], "record.every": 1}
LOOP = """
scenario = { name = "loop", stop = 3.0, step = 1e-2 }
actions = [
  { at = 0.5, signal = "pid.measurement", offset = 0.2 },
  { at = 1.0, set = { "pid.gain" = 4.0 } },
  { at = 1.5, signal = "plant.u", override = 0.0 },
  { at = 2.0, signal = ["plant.u", "pid.measurement"], release = true },
]
[components]
setpoint = { kind = "constant", value = 1.0 }
pid = { kind = "pid", gain = 2.0, integral_time = 1.0, lower = -3.0, upper = 3.0 }
plant = { kind = "lag", time_constant = 2.0, initial = 0.0 }
behind = { kind = "lag", time_constant = 0.5, initial = 0.0 }
[connections]
"pid.setpoint" = "setpoint.y"
"pid.measurement" = "plant.y"
"plant.u" = "pid.y"
"behind.u" = { from = "plant.y", gain = 2.0 }
"""


def recorded(signals, every=1):
    """Return the settings of the table [record]."""
    return {"record.signals": signals, "record.every": every}


def origin(run):
    """Return what a replay says of where its components come from."""
    return read_json(run.metadata["cosim.run"]["replay"])


def check_bits(again, whole):
    """Check that all signals of a replay have the bits of the whole run."""
    assert len(again) > 0
    for name in again:
        assert again[name].tobytes() == whole[name].tobytes(), name


@pytest.fixture(scope="module")
def whole():
    """Run the example, and keep all of it."""
    return cosim.run("academic", set=SHORT)


@pytest.fixture
def part(tmp_path):
    """Return what records a part of the same run."""

    def record(signals, every=1, **changes):
        settings = SHORT | recorded(signals, every) | changes
        return cosim.run("academic", out=tmp_path / "a.mcap", force=True, set=settings)

    return record


@pytest.fixture
def loop(tmp_path):
    """Return what records a part of a run with a loop."""
    path = tmp_path / "loop.toml"
    path.write_text(LOOP)

    def record(signals, every=1):
        settings = recorded(signals, every)
        return cosim.run(path, out=tmp_path / "loop.mcap", force=True, set=settings)

    return record


@pytest.mark.fast(
    "signals4-copied4-computed4",
    "signals5-copied5-computed5",
    "signals3-copied3-computed3",
    "signals6-copied6-computed6",
)
@pytest.mark.parametrize(
    ("signals", "copied", "computed"),
    [
        (["plant.y"], {"plant"}, {"u", "delta", "observer", "regressor", "identifier"}),
        (["plant.*"], {"plant"}, {"u", "delta", "observer", "regressor", "identifier"}),
        # what the observer took in is what the plant gave
        (["observer.y"], {"plant"}, {"u", "delta", "observer", "regressor", "identifier"}),
        (["observer.delta"], {"observer"}, {"u", "delta", "regressor"}),
        (["regressor.delta"], {"observer"}, {"u", "delta", "regressor"}),
        (["identifier.theta"], {"identifier"}, {"u", "delta"}),
        (["u.y"], set(), {"u", "delta"}),
    ],
)
def test_a_replay_computes_what_the_recorded_signals_allow(whole, part, signals, copied, computed):
    """With the bits of the run; what the log has not is left out, each with its reason."""
    again = cosim.replay(part(signals), set=ALL)
    check_bits(again, whole)
    assert set(origin(again)["copied"]) == copied
    assert set(again.channels) == copied | computed
    assert set(origin(again)["absent"]) == set(whole.channels) - copied - computed


def test_plants_are_computed_again_from_sources_alone(whole, part):
    """Nothing needs to be recorded where everything can be computed."""
    again = cosim.replay(part(["u.y"], 50), rerun=True, set=ALL)
    check_bits(again, whole)
    assert list(again) == list(whole)


def test_a_replay_records_what_its_scenario_says(part):
    """So that it is equal to its log, as that of a whole one."""
    log = part(["plant.y", "observer.delta"], 4)
    again = cosim.replay(part(["plant.y", "observer.delta"]))
    assert list(again) == ["plant.y", "observer.delta"]
    assert cosim.diff(log, again).equal


def test_rows_between_the_recorded_ones_are_not_made_up(part, tmp_path):
    """Every tenth row drives nothing: what needs it is refused, in a replay and as a swap."""
    log = part(["*"], 3)
    again = cosim.replay(log, set=ALL)
    assert set(again.channels) == {"u", "delta"}
    reason = origin(again)["absent"]["observer"]
    assert reason == (
        "its input 'observer.y' comes from 'plant.y', which is neither computed nor recorded at "
        "each step; the log has no output of it at every step"
    )
    texts = [message.text for message in again.messages() if message.source == "observer"]
    assert texts == [f"not in this replay: {reason}"]
    with pytest.raises(CosimError, match=r"has one row of 'plant' in 3 steps .recorded with"):
        cosim.run("academic", swap={"plant": log.path}, set=SHORT)


def test_a_chosen_component_that_cannot_be_computed_is_refused_by_name(part):
    """With the reason, and with how the log was recorded."""
    log = part(["observer.delta"])
    with pytest.raises(
        UsageError,
        match=r"'identifier' cannot be computed: its input 'identifier\.y' comes from 'plant\.y', "
        r"which is neither computed nor recorded .* recorded with \[record\] signals",
    ):
        cosim.replay(log, components=["regressor", "identifier", "u", "delta"])
    with pytest.raises(LogError, match=r"no component can be computed: the log is partial, .*\["):
        cosim.replay(part(["observer.delta"]), components=["identifier"])


@pytest.mark.slow
def test_a_change_reaches_only_what_is_computed(whole, part):
    """What is not in the replay cannot be changed; what is follows as in a whole one."""
    changed = {"observer.filter_rate": 500.0}
    whole_log = cosim.run("academic", set=SHORT | changed)
    again = cosim.replay(part(["plant.y"]), set=ALL | changed)
    check_bits(again, whole_log)
    with pytest.raises(UsageError, match=r"recording; its input 'observer\.y' comes from"):
        cosim.replay(part(["observer.delta"]), set=changed)
    with pytest.raises(UsageError, match=r"rate'\]: 'observer' is not in this replay"):
        cosim.replay(part(["regressor.mu"]), set=changed)


def test_a_loop_is_computed_as_a_whole_or_beside_members_recorded_whole(loop):
    """Faults and steps of parameters happen in it again."""
    whole = loop(["*"])
    all_of_it = {name: whole[name].copy() for name in whole}
    again = cosim.replay(loop(["behind.y"], 5), set=ALL)
    assert origin(again)["copied"] == []
    check_bits(again, all_of_it)
    members = ["plant.*", "pid.*", "setpoint.y"]
    again = cosim.replay(loop(members), set=ALL, components=["pid"])
    assert set(again.channels) == {"setpoint", "pid", "plant"}
    check_bits(again, all_of_it)
    with pytest.raises(LogError, match="pid: it is in a loop with 'plant', which is not recorded"):
        cosim.replay(loop(["plant.y", "pid.*", "setpoint.y"]), components=["pid"])
    with pytest.raises(LogError, match="with 'plant', which is copied, and is not"):
        cosim.replay(loop(["plant.*", "pid.y", "setpoint.y"]), components=["pid"])


def test_a_faulty_input_is_not_what_drives_it(loop):
    """The input of the controller has the fault, so that it says nothing of the plant."""
    with pytest.raises(LogError, match=r"its input 'behind\.u' comes from 'plant\.y'"):
        cosim.replay(loop(["pid.measurement"]), components=["behind"])
    # it comes with a gain
    with pytest.raises(LogError, match=r"its input 'behind\.u' comes from 'plant\.y'"):
        cosim.replay(loop(["behind.u"]), components=["behind"])
    again = cosim.replay(loop(["plant.y", "behind.y"]), components=["behind"])
    assert verify(loop(["plant.y", "behind.y"]), again).passed


def test_a_verification_names_what_it_did_not_check(part):
    """Components are verified as a whole where all of their signals are in the log."""
    log = part(["observer.*", "regressor.mu", "plant.y"])
    verification = verify(log, cosim.replay(log))
    assert verification.passed
    status = {entry.component: entry.status for entry in verification.components}
    assert status == {
        "u": "unrecorded",
        "delta": "unrecorded",
        "plant": "copied",
        "observer": "equal",
        "regressor": "partial",
        "identifier": "unrecorded",
    }
    lines = "\n".join(verification.lines)
    assert "no signals of: u, delta, identifier" in lines
    assert "verified only in part, as the log is partial: regressor (without " in lines
    thinned = part(["u.y"], 5)
    (first, *_) = verify(thinned, cosim.replay(thinned)).components
    assert (first.status, first.reason) == ("partial", "one row in 5 steps")


def test_a_verification_names_what_nothing_computed(part):
    """And says where no signal was verified at all."""
    log = part(["observer.delta"])
    verification = verify(log, cosim.replay(log))
    absent = {e.component: e.reason for e in verification.components if e.status == "absent"}
    assert set(absent) == {"plant", "identifier"}
    assert "comes from 'plant.y'" in absent["identifier"]
    lines = "\n".join(verification.lines)
    assert "recomputed no signal of the log, so none is verified" in lines
    assert "neither it nor its inputs: plant (" in lines


def test_a_change_of_what_a_partial_log_has_is_found(part, tmp_path):
    """Also in a component of which it has only a part."""
    from tests.log.crafting import change_rows, put_together, take_apart

    log = part(["plant.y", "observer.delta"])
    content = take_apart(log.path)

    def change(number, values):
        if number == 100:
            values[0] += 1.0

    change_rows(content, "observer", change)
    path = tmp_path / "changed.mcap"
    put_together(content, path)
    changed = cosim.open_log(path)
    verification = verify(changed, cosim.replay(changed))
    assert not verification.passed
    status = {entry.component: entry.status for entry in verification.components}
    assert status["observer"] == "differs"
    assert "observer.delta at t = 0.1 s" in "\n".join(verification.problems)


def test_a_log_of_nothing_that_a_replay_has_cannot_be_verified(part):
    """It does not pass by having nothing to compare."""
    log = part(["plant.x_a"], 2)
    again = cosim.replay(log, set={"record.signals": ["*"]})
    with pytest.raises(LogError, match="nothing to verify: the partial log"):
        verify(log, again)
    with pytest.raises(UsageError, match="matches no signal of this run's components: u, delta"):
        cosim.replay(log)


@pytest.mark.fast("pair")
@pytest.mark.parametrize("name", sorted(set(shipped()) - {"compensation"}))
def test_whatever_is_recorded_a_replay_has_the_bits_of_the_run(name, tmp_path):
    """Of any signals of any scenario; and its verification passes."""
    check_draws(name, 3, tmp_path)


@pytest.mark.parametrize("signals", [["motor.y"], ["motor.x"], ["motor.x", "motor.u"]])
def test_a_plant_without_its_states_or_inputs_is_replayed(signals, tmp_path):
    """Whether its initial states were made consistent is not known then."""
    settings = {"scenario.stop": 0.1, "motor.x0": [0.0, 1.0]}
    log = cosim.run("pair", out=tmp_path / "a.mcap", set=settings | recorded(signals))
    assert "x[1] = 1 is 0" in " ".join(message.text for message in log.messages())
    assert verify(log, cosim.replay(log, set=ALL)).passed
    assert verify(log, cosim.replay(log)).passed


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped())
def test_more_of_what_is_recorded_has_the_bits_of_the_run(name, tmp_path):
    """The same, of more choices."""
    check_draws(name, 12, tmp_path)


def check_draws(name, count, tmp_path):
    """Check replays of a scenario that was recorded in part, as drawn by its name."""
    settings = {"scenario.stop": 0.1}
    whole = cosim.run(name, set=settings)
    source = random.Random(name)
    for _ in range(count):
        patterns = [source.choice([f"{c}.*" for c in whole.channels]), source.choice([*whole])]
        every = source.choice([1, 1, 10])
        changes = settings | recorded(patterns, every)
        log = cosim.run(name, out=tmp_path / "a.mcap", force=True, set=changes)
        check_bits(cosim.replay(log, set=ALL), whole)
        try:
            again = cosim.replay(log)
        except UsageError as error:
            assert "matches no signal of this run's components" in str(error)  # noqa: PT017
        else:
            assert verify(log, again).passed
