"""A run that two recorders take."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.blocks import sine
from cosim.core import Clock, Graph, Memory, run
from cosim.core.passing_recorders import PassingRecorder, TwoRecorders, Watched
from cosim.core.recorders import Nothing
from cosim.scenario.recordings.replay_request import ReplayWindow, WindowRecorder


class FullError(Exception):
    """A recorder cannot take more."""


def graph():
    """Return a source."""
    return Graph({"u": sine(rate=1.0)}, {})


def full(block, _):
    """Refuse what is behind 0.5 s."""
    if block.time[-1] > 0.5:
        raise FullError


def test_both_take_the_whole_run():
    """Rows, and what a scenario adds to them."""
    first = Memory()
    second = Memory()
    both = TwoRecorders(first, second)
    run(graph(), Clock(stop=1.0, step=0.1, block=3), both)
    both.message(0, "info", "run", "text")
    both.result({"a": 1})
    assert first["u.y"].tolist() == second["u.y"].tolist()
    assert len(first["u.y"]) == 11
    assert first.messages() == second.messages() != []
    assert first.results == second.results == {"a": 1}


class Followed(Nothing):
    """Follows the rows of a block under way, as a log does."""

    rows = None

    def follow(self, rows):
        """Keep what returns them."""
        self.rows = rows


@pytest.mark.parametrize(
    "wrap",
    [
        PassingRecorder,
        lambda log: TwoRecorders(log, Nothing()),
        lambda log: TwoRecorders(Nothing(), log),  # as with --assert, which is first to refuse
    ],
)
def test_a_log_follows_blocks_under_way_behind_any_other_recorder(wrap):
    """Else what a run has computed is lost where an FMU hangs in it."""
    log = Followed()
    run(graph(), Clock(stop=1.0, step=0.1, block=10), wrap(log))
    block, rows = log.rows()
    assert (block.index, block.steps, len(rows)) == (0, 10, 11)


def test_a_window_shifts_the_rows_that_are_followed():
    """As those that it passes on; before the window there are none."""
    log = Followed()
    source = Clock(stop=1.0, step=0.1)
    WindowRecorder(log, ReplayWindow(200_000_000, 900_000_000, 2)).follow(lambda: found)
    found = None
    assert log.rows() is None
    found = (source.block_at(0, 1), np.zeros((2, 1)))
    assert log.rows() is None
    found = (source.block_at(3, 4), np.arange(5.0).reshape(5, 1))
    block, rows = log.rows()
    assert (block.index, block.steps, len(rows)) == (1, 4, 5)


@pytest.mark.parametrize("is_first", [True, False])
def test_an_error_of_one_ends_the_run_for_both(is_first):
    """Both are closed with it; what the first has taken it keeps."""
    kept = Memory()
    refusing = Watched(Nothing(), full)
    pair = (refusing, kept) if is_first else (kept, refusing)
    with pytest.raises(FullError):
        run(graph(), Clock(stop=1.0, step=0.1, block=1), TwoRecorders(*pair))
    assert kept.status == "failed"
    assert len(kept["u.y"]) == (6 if is_first else 7)


def test_both_are_closed_where_closing_fails():
    """The error of the first is raised."""
    closed = []

    def ended(recorder, error):
        closed.append(recorder)
        raise FullError

    first = Watched(Nothing(), lambda *_: None, ended=ended)
    second = Memory()
    with pytest.raises(FullError), TwoRecorders(first, second):
        raise KeyboardInterrupt
    assert closed
    assert second.status == "interrupted"
