"""Integer nanoseconds and blocks."""

from decimal import Decimal
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.blocks.source import ramp
from cosim.core import clock as clock_module
from cosim.core.clock import LARGEST_NS, Clock, nanoseconds, seconds, whole_steps
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.errors import ClockError


@given(st.integers(-(10**15), 10**15))
def test_nanoseconds_are_exact(ns):
    """Decimal text, and the float that prints as it, give the exact number.

    15 digits survive in a double, and 16 to 17 in its repr.
    """
    text = str(Decimal(ns) / 10**9)
    assert nanoseconds(text) == ns
    assert nanoseconds(ns / 10**9) == ns


@given(st.integers(0, 10**18).filter(lambda n: n % 10))
def test_a_tenth_of_a_nanosecond_is_refused(tenths):
    """Not rounded."""
    with pytest.raises(ClockError, match=r"is not a whole number of nanoseconds; nearest: "):
        nanoseconds(str(Decimal(tenths) / 10**10))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.5e-9, r"1.5e-09 s is not a whole number of nanoseconds; nearest: 2e-09 s"),
        (float("nan"), r"a finite number.*seconds.*nan"),
        (float("inf"), r"a finite number.*seconds.*inf"),
        ("soon", r"a finite number.*seconds.*soon"),
        (1e10, r"10000000000.0 s does not fit into 64-bit nanoseconds; at most 9.223e\+09 s"),
    ],
)
def test_only_times_are_taken(value, text):
    """With what was found and the nearest value that would do."""
    with pytest.raises(ClockError, match=text):
        nanoseconds(value)
    assert nanoseconds(str(Decimal(LARGEST_NS) / 10**9)) == LARGEST_NS


def test_seconds_are_never_accumulated():
    """Every point is its integer divided once.

    Adding up 40 000 steps of 1 ms, or k h, gives other numbers.
    """
    blocks = list(Clock(40.0, 1e-3, 1000).blocks(10**6))
    time = np.concatenate([blocks[0].time[:1], *(block.time[1:] for block in blocks)])
    assert all(
        found == k / 1000 for k, found in enumerate(time)
    )  # k/1000 is the nearest double to k ms
    assert (np.cumsum(np.full(40_000, 1e-3)) != time[1:]).mean() > 0.9
    assert (seconds(np.array([15_345_000_000])) == 15.345).all()


@settings(deadline=None)
@given(
    st.integers(1, 3000),
    st.integers(1, 10**7),
    st.one_of(st.none(), st.integers(1, 4000)),
    st.integers(1, 4000),
)
def test_blocks_cover_the_grid_once_whatever_their_size(steps, step_ns, size, limit):
    """Each block begins at the last point of the one before.

    None is longer than the limit or the size.
    """
    clock = Clock(steps * step_ns / 1e9, step_ns / 1e9, size)
    assert clock.steps == steps
    blocks = list(clock.blocks(limit))
    assert max(block.steps for block in blocks) <= min(limit, size or limit)
    ns = np.concatenate([blocks[0].time_ns[:1], *(block.time_ns[1:] for block in blocks)])
    assert (ns == np.arange(steps + 1) * step_ns).all()
    assert [block.index for block in blocks] == np.cumsum(
        [0, *(block.steps for block in blocks[:-1])]
    ).tolist()
    for before, after in pairwise(blocks):
        assert before.time_ns[-1] == after.time_ns[0]
    assert all(
        (block.time == block.time_ns / 1e9).all() and block.h == step_ns / 1e9 for block in blocks
    )


def test_times_are_converted_once(monkeypatch):
    """Not for every block: reading a decimal takes longer than the block."""
    converted = []
    whole = clock_module.nanoseconds

    def counted(time):
        converted.append(time)
        return whole(time)

    monkeypatch.setattr(clock_module, "nanoseconds", counted)
    clock = Clock(1.0, 0.01, block=1, start_time=0.5)
    assert sum(block.steps for block in clock.blocks(100)) == 50
    assert converted.count(0.01) == 1
    assert converted.count(0.5) == 1


def test_a_block_can_be_cut():
    """It keeps its first rows."""
    block = next(Clock(1.0, 0.1, 10).blocks(100)).part(0, 3)
    assert block.steps == 3
    assert block.time.tolist() == [0.0, 0.1, 0.2, 0.3]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            {"stop": 1.0, "step": 0.3},
            r"stop: 1.0 s is not a whole number of 0.3 s steps; nearest: 0.9 s",
        ),
        ({"stop": 1.0, "step": 0.0}, r"step:.*a time.*0\.0 s"),
        ({"stop": 1.0, "step": -1e-3}, r"step:.*a time.*-0\.001 s"),
        ({"stop": 0.0, "step": 1e-3}, r"stop:.*a time.*0\.0 s"),
        (
            {"stop": 1.0, "step": 1e-10},
            r"1e-10 s is not a whole number of nanoseconds; nearest: 1e-09 s",
        ),
        ({"stop": "1", "step": 0.1}, r"stop:.*a number of seconds.*'1'"),
        ({"stop": 1.0, "step": 1e-3, "block": 0}, r"block:.*steps.*1.*0"),
    ],
)
def test_a_grid_that_is_none_is_refused(options, text):
    """Before the first step, with the nearest value that would do."""
    with pytest.raises(ClockError, match=text):
        Clock(**options)


def test_a_step_that_stands_for_a_fraction_gets_the_fraction_as_a_hint():
    """Where the run does not end at one of its multiples."""
    with pytest.raises(ClockError, match=r'nearest: 1.00000002 s, or a step of .* "1/60"$'):
        Clock(1.0, 0.016666667)
    with pytest.raises(ClockError, match=r"nearest: 0.9 s$"):
        Clock(1.0, 0.3)


def test_a_duration_off_the_grid_is_refused_by_name():
    """Delays and periods are whole numbers of steps."""
    assert whole_steps(3.0, 1_000_000, "delays[2]") == 3000
    with pytest.raises(
        ClockError,
        match=r"period: 0.0003 s is not a whole number of 0.001 s steps; nearest: 0.001 s",
    ):
        whole_steps(3e-4, 1_000_000, "period")


@given(st.integers(0, 10**12), st.integers(1, 200), st.integers(1, 10**7))
def test_a_grid_may_begin_later(start_ns, steps, step_ns):
    """Its points are whole steps after the start, and the instants before and between are none."""
    start_time = start_ns / 10**9
    stop = (start_ns + steps * step_ns) / 10**9
    clock = Clock(stop, step_ns / 10**9, start_time=start_time)
    assert clock.steps == steps
    block = list(clock.blocks(10**6))[-1]
    assert block.time_ns[-1] == start_ns + steps * step_ns
    assert clock.steps_until(stop, "time") == steps
    if step_ns > 1:
        with pytest.raises(ClockError, match=r"time: .* is not a whole number of"):
            clock.steps_until((start_ns + 1) / 10**9, "time")


def test_a_billion_steps_end_at_the_nanosecond():
    """1e9 steps of 1 ms: computed from integers, so that nothing adds up."""
    clock = Clock(1e6, 1e-3)
    assert clock.steps == 10**9
    last = clock.block_at(clock.steps - 3, 3)
    assert last.time_ns.tolist() == [10**15 - 3 * 10**6, 10**15 - 2 * 10**6, 10**15 - 10**6, 10**15]
    assert last.time[-1] == 1e6


def test_ten_steps_of_a_tenth_have_eleven_rows():
    """The first at t = 0 with the initial state, the last at exactly 1 s; none is a step early."""
    memory = Memory()
    run(Graph({"r": ramp(slope=1.0)}, {}), Clock(1.0, 0.1), memory)
    times = memory.time("r")
    assert len(times) == 11
    assert (times[0], times[-1]) == (0.0, 1.0)
    np.testing.assert_allclose(memory["r.y"], times, rtol=1e-15)
