"""``[scenario] until``: where a run ends, what its log and reports say, what is refused."""

import numpy as np
import pytest

import cosim
from cosim.core.contracts import Stopped
from cosim.errors import ScenarioError
from cosim.report.inspection import describe_log, describe_scenario
from cosim.report.summary import summarize
from cosim.report.verification import verify

BASE = """
scenario = {{ name = "ended", stop = 4.0, step = 0.1{until} }}
[components]
s = {{ kind = "sine", rate = 1.0 }}
x = {{ kind = "lag", time_constant = 0.5 }}
z = {{ kind = "lag", time_constant = 0.5 }}
[connections]
"x.u" = "s.y"
"z.u" = "x.y"
"""
HALF = 'until = "x.y > 0.5 for 300 ms"'


def file(folder, until, more=""):
    path = folder / "ended.toml"
    path.write_text(BASE.format(until=until and f", {until}") + more)
    return path


def end_of(folder):
    """Return the row where x.y was above 0.5 at four rows, by a run without a condition."""
    above = cosim.run(file(folder, ""))["x.y"] > 0.5
    return next(row for row in range(3, 41) if above[row - 3 : row + 1].all())


def test_a_run_ends_where_its_condition_came_true(tmp_path):
    """The last row is that one, whatever the blocks; the log says why, and when."""
    end = end_of(tmp_path)
    path = file(tmp_path, HALF)
    reason = f"until 'x.y > 0.5 for 300 ms': came true at t = {end / 10} s"
    hashes = set()
    for block in (1, 3, 1000, None):
        log = cosim.run(path, out=tmp_path / "a.mcap", force=True, block=block)
        assert (log.steps, log.status, log.reason) == (end, "complete", reason)
        hashes.add(log.content_hash())
    messages = [tuple(message) for message in log.messages() if message.source == "run"]
    assert messages == [(end * 10**8, "info", "run", reason)]
    short = cosim.run(path, set={"scenario.stop": end / 10, "scenario.until": "t < 0"})
    assert cosim.diff(log, short).equal
    assert len(hashes) == 1
    summary = summarize(log)
    assert (summary.until, summary.until_came_true) == ("x.y > 0.5 for 300 ms", True)
    assert describe_log(str(log.path))["run"]["until"] == "x.y > 0.5 for 300 ms"
    assert describe_scenario(str(path))["scenario"]["until"] == "x.y > 0.5 for 300 ms"


def test_a_replay_goes_to_the_recorded_end(tmp_path):
    """It does not look for the condition; what it is told to look for it does."""
    log = cosim.run(file(tmp_path, HALF), out=tmp_path / "a.mcap")
    again = cosim.replay(log.path, out=tmp_path / "b.mcap")
    assert again.steps == log.steps
    assert again.content_hash() == log.content_hash()
    assert (again.status, again.reason) == ("complete", "")
    assert summarize(again).until_came_true is None
    verification = verify(log, again)
    assert verification.passed, verification.problems
    changed = cosim.replay(log.path, set={"scenario.until": "x.y > 0.2"})
    assert changed.reason.startswith("until 'x.y > 0.2': came true at t = ")
    assert 0 < changed.steps < log.steps
    later = cosim.replay(log.path, set={"x.time_constant": 5.0})
    assert later.steps == log.steps


def test_a_log_that_names_another_condition_contradicts_its_scenario(tmp_path):
    """What a log says of its condition is compared with its scenario."""
    log = cosim.run(file(tmp_path, HALF), out=tmp_path / "a.mcap")
    again = cosim.replay(log.path)
    log.metadata["cosim.run"]["until"] = "x.y > 0.6"
    problems = verify(log, again).problems
    assert any("until: 'x.y > 0.6' in the log, 'x.y > 0.5 for" in p for p in problems)


def test_a_condition_that_never_comes_true_is_said(tmp_path):
    """In the log and in the summary; the run is complete. At the start it leaves the first row."""
    log = cosim.run(file(tmp_path, 'until = "x.y > 5"'), out=tmp_path / "a.mcap")
    assert (log.steps, log.status, log.reason) == (40, "complete", "")
    assert tuple(log.messages()[-1]) == (4 * 10**9, "info", "run", "until 'x.y > 5': never met")
    assert summarize(log).until_came_true is False
    log = cosim.run(file(tmp_path, 'until = "x.y < 5"'), out=tmp_path / "b.mcap")
    assert (log.steps, len(log["x.y"]), log.status) == (0, 1, "complete")
    assert log.reason == "until 'x.y < 5': came true at t = 0.0 s"


def test_a_session_stops_where_its_condition_came_true(tmp_path):
    """As at a component's end; its log is that of the run."""
    end = end_of(tmp_path)
    path = file(tmp_path, HALF)
    log = cosim.run(path, out=tmp_path / "a.mcap")
    with cosim.load(path).start(out=tmp_path / "b.mcap") as sim:
        sim.step(3)
        with pytest.raises(Stopped, match=r"came true at t = ") as stop:
            sim.step(30)
        assert not stop.value.failed
        assert sim.t_ns == end * 10**8
        assert sim.rows.steps == end - 3
    other = cosim.open_log(tmp_path / "b.mcap")
    assert (other.status, other.reason) == (log.status, log.reason)
    assert other.content_hash() == log.content_hash()


@pytest.mark.slow
def test_a_signal_without_a_value_ends_no_run(tmp_path):
    """theta_hat has none at first: then it is neither below 0 nor not above it."""
    for until in ("identifier.theta[0] < 0", "not identifier.theta[0] >= 0"):
        run = cosim.run("academic", set={"scenario.stop": 10.0, "scenario.until": until})
        theta = run["identifier.theta"][:, 0]
        assert run.reason.startswith(f"until {until!r}: came true at t = ")
        assert run.steps > 100
        assert np.isnan(theta[0])
        assert not (theta[:-1] < 0.0).any()
        assert theta[-1] < 0.0


def test_actions_go_on_up_to_the_end(tmp_path):
    """Those before it are in the log; a replay follows them, and passes."""
    more = '\n[[actions]]\nat = {}\nsignal = "z.u"\noverride = 3.0\n'
    text = more.format(0.5) + more.replace("override = 3.0", "release = true").format(3.5)
    path = file(tmp_path, HALF, text)
    log = cosim.run(path, out=tmp_path / "a.mcap")
    assert [event.cause for event in log.events()] == ["override"]
    for block in (1, 7):
        assert cosim.diff(log, cosim.run(path, block=block)).equal
    assert verify(log, cosim.replay(log.path)).passed


REFUSED = {
    "x.y > 0.5 for 150 ms": "for: 0.15 s is not a whole number of 0.1 s steps; nearest: 0.2 s",
    "x.v > 0.5": "the graph has no 'x.v': 'x' has no signal 'v'; available: u, y",
    "xx.y > 0.5": "the graph has no component 'xx'; did you mean 'x'? Available: s, x, z",
    "x.y": "expected a comparison",
    "x.y > limit": "unknown name 'limit'",
    "open('x') > 1": "unknown function 'open'",
    "x.y[1] > 1": "'x.y' has 1 element, numbered from 0",
}


def test_a_condition_that_is_wrong_is_refused_with_its_line(tmp_path, subtests):
    """Once, beside the other problems of the file."""
    for until in REFUSED:
        with subtests.test(until=until):
            path = file(tmp_path, f'until = "{until}"', '\n[components.w]\nkind = "lagg"\n')
            with pytest.raises(ScenarioError) as error:
                cosim.load(path).start()
            (line,) = [line for line in str(error.value).splitlines() if "scenario.until" in line]
            assert line.startswith(f"{path}:2: scenario.until: condition {until!r}: ")
            assert REFUSED[until] in line
