"""Components with steps of their own behind each other, with offsets, against tables by hand."""

from itertools import chain, repeat
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document
from tests.scenario.refusals import check_refused

# y = x, and x+ = x + u at the end of a period, with u sampled at its start; h = 1 s
ACCUMULATOR = 'kind = "discrete-state-space", A = [[1.0]], B = [[1.0]], C = [[1.0]]'


def chain_of(*rates, stop=12, offsets=None):
    """Return a chain of accumulators with these periods [s] behind u = t."""
    lines = [f'[scenario]\nname = "chain"\nstop = {stop}.0\nstep = 1.0', "[components]"]
    lines.append('p0 = { kind = "ramp", slope = 1.0 }')
    connections = ["[connections]"]
    for number, rate in enumerate(rates, start=1):
        offset = f", offset = {offsets[number - 1]}.0" if offsets else ""
        lines.append(f"p{number} = {{ {ACCUMULATOR}, period = {rate}.0{offset} }}")
        connections.append(f'"p{number}.u" = "p{number - 1}.y"')
    return parse(Document("\n".join(lines + connections), "chain", Path()))


def held(*runs):
    """Return a row of values, each of them so many times: ``(value, times)``."""
    return list(chain.from_iterable(repeat(value, times) for value, times in runs))


# At every sample instant the accumulator takes what its source has there, which at the end of a
# step of the source is the new value; what it makes of that appears at the end of its own step.
#
# Rate 2 behind u = t: samples 0, 2, 4, 6, 8, 10 at these times, so 0, 2, 6, 12, 20, 30 at 2 to 12.
TWO = held((0, 4), (2, 2), (6, 2), (12, 2), (20, 2), (30, 1))
# Rate 1, that of the steps: samples 0 to 11, so 0, 0, 1, 3, ... at 0 to 12.
ONE = [k * (k - 1) // 2 for k in range(13)]
# Rate 3: samples 0, 3, 6, 9, so 0, 3, 9, 18 at 3, 6, 9, 12.
THREE = held((0, 6), (3, 3), (9, 3), (18, 1))
# Rate 3 behind rate 2: samples at 0, 3, 6, 9 are 0, 0, 6, 12: 6 at 9, 18 at 12.
THREE_BEHIND_TWO = held((0, 9), (6, 3), (18, 1))
# Rate 2 behind rate 3: samples at 0 to 10 are 0, 0, 0, 3, 3, 9: 3 at 8, 6 at 10, 15 at 12.
TWO_BEHIND_THREE = held((0, 8), (3, 2), (6, 2), (15, 1))
# Rate 4 behind those of 3 behind 2 up to 24. Rate 2 has 42, 56, 72, 90, 110, 132 at 14 to 24; rate
# 3 samples 30, 42, 72, 90 at 12, 15, 18, 21: 48, 90, 162, 252 at 15 to 24. Rate 4 samples 0, 0, 0,
# 18, 48, 90 at 0 to 20, so 18, 66, 156 at 16, 20, 24.
FOUR = held((0, 16), (18, 4), (66, 4), (156, 1))
# Rate 2 from 1 on: samples 1, 3, 5, 7, 9 at these times: 1, 4, 9, 16, 25 at 3 to 11.
TWO_FROM_ONE = held((0, 3), (1, 2), (4, 2), (9, 2), (16, 2), (25, 2))
# Rate 3 from 2 on, behind it: samples at 2, 5, 8 are 0, 4, 9: 0, 4, 13 at 5, 8, 11.
THREE_FROM_TWO = held((0, 8), (4, 3), (13, 2))


def at_all_points(log, name):
    """Return what a component has at every point: its log has the rows in which that changes."""
    times = log.time(name)
    points = np.arange(log.end_ns // 10**9 + 1)
    return log[f"{name}.y"][np.searchsorted(times, points, side="right") - 1].tolist()


@pytest.mark.parametrize(
    ("rates", "offsets", "stop", "expected"),
    [
        ((1,), None, 12, [ONE]),
        ((2, 3), None, 12, [TWO, THREE_BEHIND_TWO]),
        ((3, 2), None, 12, [THREE, TWO_BEHIND_THREE]),
        ((2, 3, 4), None, 24, [None, None, FOUR]),
        ((2, 3), (1, 2), 12, [TWO_FROM_ONE, THREE_FROM_TWO]),
        ((2, 3), (0, 0), 12, [TWO, THREE_BEHIND_TWO]),
    ],
    ids=["1", "2, 3", "3, 2", "2, 3, 4", "2, 3 with offsets", "no offsets"],
)
def test_chain_follows_the_table(rates, offsets, stop, expected, subtests):
    for block in [1, 5, None]:
        with subtests.test(block=block):
            log = cosim.run(chain_of(*rates, stop=stop, offsets=offsets), block=block)
            for number, row in enumerate(expected, start=1):
                if row is not None:
                    assert at_all_points(log, f"p{number}") == row


def test_a_log_with_offsets_replays(tmp_path):
    """It keeps the rows in which samples change: one in the common divisor of period and offset."""
    scenario = chain_of(4, 2, offsets=(2, 1))
    log = cosim.run(scenario, out=tmp_path / "a.mcap")
    assert np.diff(log.time("p1")).tolist() == 6 * [2.0]
    assert cosim.diff(log, cosim.replay(log.path)).equal


FEEDTHROUGH = """
scenario = {{ name = "sampled", stop = 1.0, step = 0.01 }}
[components]
u = {{ kind = "ramp", slope = 1.0, offset = 1.0 }}
c = {{ kind = "controller", A = [[0.0]], B = [[1.0]], C = [[1.0]], D = [[2.0]]{keys} }}
[connections]
"c.u" = "u.y"
"""


def sampled(**keys):
    """Run x' = u, y = x + 2 u behind u = 1 + t with more keys."""
    text = "".join(f", {key} = {value!r}" for key, value in keys.items())
    return cosim.run(parse(Document(FEEDTHROUGH.format(keys=text), "sampled", Path())))


def test_feedthrough_begins_at_the_offset():
    """Until then y is 2 u(0); at 0.04 s it samples u = 1.04, at 0.14 s x is 0.1 times that."""
    log = sampled(period=0.1, offset=0.04)
    y = dict(zip(np.round(log.time("c"), 9), log["c.y"], strict=True))
    assert y[0.02] == 2.0
    assert y[0.04] == pytest.approx(2.08, abs=1e-15)
    assert y[0.12] == y[0.04]
    assert y[0.14] == pytest.approx(0.104 + 2.28, abs=1e-15)


def test_inputs_of_a_period_are_held_or_interpolated():
    """x is the sum of 0.1 u at the starts of the periods, or the integral t + t^2/2."""
    held_sum = sum(0.1 * (1.0 + 0.1 * k) for k in range(10))
    for keys in ({}, {"input_interpolation": "zero-order"}):
        assert sampled(period=0.1, **keys)["c.x"][-1] == pytest.approx(held_sum, abs=1e-14)
    linear = sampled(period=0.1, input_interpolation="linear")
    assert linear["c.x"][-1] == pytest.approx(1.5, abs=1e-14)
    assert len(np.unique(linear["c.x"])) == 11  # its outputs change once a period


NO_RATES = [
    ({"period": 0.0}, "period: expected at least 1 communication"),
    ({"period": -0.01}, "period: expected at least 1 communication"),
    ({"period": 0.1, "offset": 0.1}, "components.c: offset: .* >= 0 s and below"),
    ({"period": 0.1, "offset": -0.01}, ">= 0 s and below the period, 0.1 s, got -0.01 s"),
    ({"period": 0.1, "offset": 0.005}, "offset: 0.005 s is not a whole number of 0.01 s steps"),
    ({"offset": 0.01}, "offset: expected together with period, got 0.01 s"),
    ({"input_interpolation": "linear"}, "interpolation: .* with period, got 'linear'"),
]


def test_rates_that_are_none_are_refused():
    check_refused(NO_RATES, lambda keys: sampled(**keys), ScenarioError)
