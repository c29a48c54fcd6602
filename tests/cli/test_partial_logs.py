"""The commands on logs of which a part is recorded."""

import json

import pytest

RECORD = ("--set", "record.signals=['plant.*', 'observer.delta']", "--set", "record.every=10")
SHORT = ("--set", "scenario.stop=0.2")
REASON = (
    'the log is partial (recorded with [record] signals = ["plant.*", "observer.delta"], '
    "every = 10); available: plant.u, plant.delta, plant.y, plant.x_a, plant.x_b, observer.delta"
)


@pytest.fixture
def logs(call):
    """Write a partial log and a whole one."""
    assert call("run", "academic", *SHORT, *RECORD, "--out", "part.mcap", "--quiet")[0] == 0
    assert call("run", "academic", *SHORT, "--out", "whole.mcap", "--quiet")[0] == 0


@pytest.mark.usefixtures("logs")
def test_info_says_what_is_recorded_of_what(call):
    """As a table and as JSON."""
    code, out, _ = call("info", "part.mcap")
    assert code == 0
    assert "partial" in out.splitlines()
    assert "of signals\t24" in out
    about = json.loads(call("info", "part.mcap", "--json")[1])["partial"]
    missing = about.pop("not recorded")
    assert about == {
        "signals": ["plant.*", "observer.delta"],
        "every": 10,
        "recorded signals": 6,
        "of signals": 24,
        "recorded components": 2,
        "of components": 6,
    }
    assert missing["u"] == ["y"]
    assert "plant" not in missing
    assert "partial" not in json.loads(call("info", "whole.mcap", "--json")[1])


@pytest.mark.fast("words1")
@pytest.mark.usefixtures("logs")
@pytest.mark.parametrize(
    "words",
    [
        ("cat", "part.mcap", "--signals", "u.y"),
        ("convert", "part.mcap", "a.csv", "--signals", "u.*"),
        ("plot", "part.mcap", "u.y", "--out", "a.png"),
        ("diff", "part.mcap", "whole.mcap", "u.y"),
    ],
)
def test_an_unrecorded_signal_is_refused_with_the_reason(call, words):
    """Every command says that the log is partial, and how it was recorded."""
    code, out, err = call(*words)
    assert (code, out) == (2, "")
    assert REASON in err


@pytest.mark.usefixtures("logs")
def test_commands_work_on_what_is_recorded(call):
    """On all of it, where no signals are named."""
    code, out, _ = call("cat", "part.mcap")
    assert code == 0
    header, *rows = out.splitlines()
    assert header.endswith("plant.x_a[0],plant.x_a[1],plant.x_b,observer.delta")
    assert [row.partition(",")[0] for row in rows[:3]] == ["0.0", "0.01", "0.02"]
    assert len(rows) == 21
    assert call("convert", "part.mcap", "a.csv")[0] == 0
    assert call("plot", "part.mcap", "--out", "a.png")[0] == 0
    assert call("hash", "part.mcap")[0] == 0
    code, out, _ = call("diff", "part.mcap", "whole.mcap")
    assert code == 0
    assert "u.y\tnot recorded in a" in out


@pytest.mark.slow
@pytest.mark.usefixtures("logs")
def test_a_replay_refuses_by_name_what_the_log_does_not_allow(call):
    """Nothing of this one but its sources can be computed, and they were not recorded."""
    code, _, err = call("replay", "part.mcap", "--verify")
    assert code == 2
    assert "matches no signal of this run's components: u, delta" in err
    code, _, err = call("replay", "part.mcap", "--component", "observer", "--verify")
    assert code == 2
    assert "its input 'observer.u' comes from 'u.y', which is neither computed nor recorded" in err
    all_of_it = ("--set", "record.signals=['*']")
    assert call("replay", "part.mcap", "--rerun", *all_of_it, "--verify")[0] == 0


def test_the_keys_are_listed(call):
    """With the others of a scenario."""
    code, out, _ = call("list", "--json")
    assert code == 0
    assert json.loads(out)["record"].keys() == {"signals", "every"}
    assert "every" in call("list")[1]


@pytest.mark.slow
@pytest.mark.usefixtures("logs")
def test_diff_says_where_it_compares(call):
    """Rows that one log has not are not equal: they are not there."""
    short = ("--stop", "0.2")
    call("run", "academic", *short, "--out", "all.mcap")
    call("run", "academic", *short, "--set", "record.every=7", "--out", "some.mcap")
    code, out, _ = call("diff", "all.mcap", "some.mcap")
    assert code == 0
    text = "note: compared only where both logs have rows: u.y at 29 instants (201 in a, 29 in b)"
    assert text in out.splitlines()
    assert "note: compared" not in call("diff", "all.mcap", "all.mcap")[1]
    call("run", "academic", "--stop", "0.3", "--out", "longer.mcap")
    code, out, _ = call("diff", "all.mcap", "longer.mcap")
    assert code == 1
    assert "u.y at 201 instants (201 in a, 301 in b)" in out
