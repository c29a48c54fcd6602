"""Runs at the pace of the wall clock: when they wait, how late they say they were, their rows."""

import pytest

import cosim
from cosim.core.clock import Clock
from cosim.core.recorders import Memory
from cosim.report.summary import summarize
from cosim.scenario.document.document import find
from cosim.scenario.running import real_time
from cosim.scenario.running.real_time import RealTimePace, block_steps
from tests.scenario.refusals import check_refused


class WallClock:
    """A wall clock that goes on by what somebody sleeps or works."""

    def __init__(self):
        self.time = 100.0
        self.slept = []

    def now(self):
        return self.time

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.time += seconds


def paced(works, factor=2.0, step=0.5):
    """Pass blocks of one step that take some work each; return the clock and the result."""
    wall = WallClock()
    pace = RealTimePace(factor, 0.0, now=wall.now, sleep=wall.sleep)
    clock = Clock(step * len(works), step, 1)
    pace.begin()
    pace.wait(clock.block_at(0, 0))
    for block, work in zip(clock.blocks(1), works, strict=True):
        wall.time += work
        pace.wait(block)
    memory = Memory()
    with memory:
        pace.end(memory, None)
    return wall, memory.results["real_time"]


def test_a_run_that_is_faster_waits_for_the_wall_clock():
    """Steps of 0.5 s at twice the pace are due every 0.25 s, whatever they took."""
    wall, lateness = paced([0.05, 0.2, 0.0])
    assert wall.slept == pytest.approx([0.2, 0.05, 0.25])
    assert wall.time == pytest.approx(100.75)
    assert lateness == {"factor": 2.0, "blocks": 3, "late": 0, "largest": 0.0, "time": 0.0}


def test_a_run_that_is_slower_says_how_late_it_was_and_where():
    """The latest block counts, not the last one; what was late is caught up with."""
    wall, lateness = paced([0.35, 0.25, 0.0, 0.0])
    assert wall.slept == pytest.approx([0.15, 0.25])
    assert lateness["late"] == 2
    assert lateness["largest"] == pytest.approx(0.1)
    assert lateness["time"] == 0.5


def test_blocks_last_10_ms():
    """One step at least."""
    assert block_steps(Clock(1.0, 1e-3), 1.0) == 10
    assert block_steps(Clock(1.0, 1e-3), 5.0) == 50
    assert block_steps(Clock(1.0, 0.1), 1.0) == 1


ACTION = """
[[actions]]
at = 0.105
signal = "plant.u"
offset = 0.5
"""


@pytest.mark.parametrize("actions", ["", ACTION], ids=["plain", "actions"])
@pytest.mark.usefixtures("without_verdicts")
def test_the_rows_are_those_of_any_other_run(actions, monkeypatch, tmp_path):
    """In blocks of 10 ms at most; the summary shows the pace, which other runs do not have."""
    wall = WallClock()
    blocks = []

    class Pace(RealTimePace):
        def __init__(self, factor, start_time):
            super().__init__(factor, start_time, now=wall.now, sleep=wall.sleep)

        def wait(self, block):
            blocks.append(block.steps)
            super().wait(block)

    monkeypatch.setattr(real_time, "RealTimePace", Pace)
    path = tmp_path / "closed.toml"
    path.write_text(find("closed-loop").text + actions)
    scenario = cosim.load(path).set({"scenario.stop": 0.2})
    usual = cosim.run(scenario)
    at_pace = cosim.run(scenario, realtime=1.0)
    for signal in usual:
        assert at_pace[signal].tobytes() == usual[signal].tobytes()
    assert max(blocks) == 10
    assert sum(blocks) == 200
    assert summarize(usual).lateness is None
    assert summarize(at_pace).lateness.late == 0
    assert sum(wall.slept) == pytest.approx(0.2)


def test_a_pace_that_is_none_is_refused():
    """Before anything runs."""
    factors = [0.0, -1.0, float("nan"), float("inf"), "fast", True]
    cases = [(factor, r"realtime: (expected|found) ") for factor in factors]
    check_refused(cases, lambda factor: cosim.run("academic", realtime=factor))
