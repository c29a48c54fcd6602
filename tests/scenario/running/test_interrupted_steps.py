"""A run that has turned slow is interrupted between two calls, or within one."""

import os
import signal
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

import cosim
from cosim.core import Clock, Graph, Interface, Memory, Signal
from cosim.errors import Interrupted
from cosim.scenario.building.build import Builder
from cosim.scenario.recordings import recording

SLOW_FROM = 20_000  # steps


class Slow:
    """Takes 500 times as long for a step from some step on; there it sends signals."""

    interface = Interface((), (Signal("y"),))

    def __init__(self, signals):
        self.signals = signals

    def initialize(self, t, u):
        self.k = 0
        return np.zeros(1)

    def outputs(self, t, u):
        return np.array([float(self.k)])

    def advance(self, t, h, u):
        first = self.k + 1.0
        for _ in range(len(t) - 1):
            self.k += 1
            for _ in range(self.signals if self.k == SLOW_FROM else 0):
                signal.raise_signal(signal.SIGINT)
            sum(range(100_000 if self.k > SLOW_FROM else 200))
        return np.arange(first, self.k + 1.0)[:, np.newaxis]


def interrupted(signals, block):
    """Return the steps behind the signals that were computed, and those that were kept."""
    slow = Slow(signals)
    memory = Memory()
    clock = Clock(10_000.0, 1e-3, block)
    with ExitStack() as resources:
        experiment = Builder(cosim.load("academic"), resources).experiment()
        experiment = replace(experiment, graph=Graph({"x": slow}, {}), clock=clock, identified={})
        with pytest.raises((Interrupted, KeyboardInterrupt)) as error:
            recording.run_into(memory, experiment, progress=None, profile=None)
    assert error.type is Interrupted
    assert memory.status == "interrupted"
    rows = len(memory["x.y"]) - 1
    assert (memory["x.y"] == np.arange(rows + 1.0)).all()
    return slow.k - SLOW_FROM, rows - SLOW_FROM


@pytest.mark.slow
@pytest.mark.parametrize("block", [None, 13_000])
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_an_interrupt_ends_a_run_that_has_turned_slow(block):
    """Between two calls: of the millions of steps to go some hundreds are computed, and kept.

    A step before took some microseconds, so that a call had some hundreds of steps. Of the fixed
    block 6000 steps are left.
    """
    computed, kept = interrupted(1, block)
    assert 0 <= kept == computed < 3_000


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_second_interrupt_ends_it_at_once():
    """Within the call; what was recorded stays."""
    computed, kept = interrupted(2, None)
    assert computed == 0
    assert kept <= 0
