"""A run that two recorders take."""

from __future__ import annotations

import pytest

from cosim.blocks import sine
from cosim.core import Clock, Graph, Memory, run
from cosim.core.passing_recorders import TwoRecorders, Watched
from cosim.core.recorders import Nothing


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
