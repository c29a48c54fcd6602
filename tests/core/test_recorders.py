"""Memory keeps the rows that a log would keep, and names what it has not."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.core.contracts import Block
from cosim.core.recorders import Memory
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import LogError


def memory(first=0, offset=0, period=3, sizes=(4, 4)):
    """Keep rows that hold the numbers of their steps, in blocks of some sizes.

    Each row is ``offset`` [ns] behind its grid point.
    """
    channel = Channel("c", Interface((), (Signal("n"), Signal("p.q", 2))), 0, period)
    kept = Memory()
    kept.begin(Plan(Layout((channel,)), 10, {}, {}, ()))
    for size in sizes:
        steps = np.arange(first, first + size + 1)
        kept.write(
            Block(first, steps * 10 + offset, steps / 1e8, 1e-8),
            np.repeat(steps[:, None], 3, axis=1).astype(float),
        )
        first += size
    return kept


@pytest.mark.parametrize("offset", [0, 3])
def test_rows_are_kept_by_the_number_of_their_step(offset):
    """A time off the grid loses no row."""
    kept = memory(offset=offset)
    assert kept["c.n"].tolist() == [0.0, 3.0, 6.0]
    assert kept.time_ns("c").tolist() == [offset, 30 + offset, 60 + offset]
    assert memory(first=5)["c.n"].tolist() == [6.0, 9.0, 12.0]


def test_the_end_of_a_run_is_its_last_step_kept_or_not():
    """The end is the last step, kept or not; a block that stopped at once adds nothing.

    Without rows it is 0.
    """
    assert (memory().steps, memory().end_ns) == (8, 80)
    assert (memory(sizes=(4, 4, 0)).steps, memory(sizes=(4, 4, 0)).end_ns) == (8, 80)
    assert (memory(sizes=()).steps, memory(sizes=()).end_ns, memory(sizes=())["c.p.q"].shape) == (
        0,
        0,
        (0, 2),
    )


def test_signal_names_may_have_dots_and_unknown_ones_name_the_nearest():
    """The first dot ends the component's name."""
    kept = memory(period=1)
    assert kept["c.p.q"].shape == (9, 2)
    assert kept.time("c.p.q").tolist() == kept.time("c").tolist()
    with pytest.raises(
        LogError,
        match=r"the run has no 'c\.p': 'c' has no signal 'p'; did you mean 'p\.q'\?.*n, p\.q",
    ):
        kept["c.p"]
    with pytest.raises(LogError, match="the run has no component 'd'; available: c"):
        kept.time("d.n")
