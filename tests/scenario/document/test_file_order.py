"""A scenario is what it says, in whatever order its file says it."""

import os
import random
import signal
import subprocess
import sys
import tomllib

import pytest

import cosim
from cosim.scenario.document.document import find

SHIPPED = ["academic", "academic-as-printed", "closed-loop"]


def toml(value):
    """Write a value of TOML: only what the shipped scenarios need."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f'"{key}" = {toml(item)}' for key, item in value.items()) + " }"
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)


def shuffled(text, seed):
    """Return the text of a scenario with its tables, and their keys, in another order."""
    chance = random.Random(seed)
    content = tomllib.loads(text)
    lines = []
    for table, entries in content.items():
        items = list(entries.items())
        chance.shuffle(items)
        for key, value in items:
            path = f'{table}."{key}"'
            lines.append(f"{path} = {toml(value)}")
    return "\n".join(lines)


@pytest.mark.fast("academic-as-printed")
@pytest.mark.parametrize("name", SHIPPED)
def test_the_content_hash_does_not_depend_on_the_order_of_a_file(name, tmp_path):
    """Components, connections and parameters in other orders give the same bits."""
    hashes = set()
    text = find(name).text
    for seed in (None, 1, 2):
        path = tmp_path / f"{seed}.toml"
        path.write_text(text if seed is None else shuffled(text, seed))
        log = tmp_path / f"{seed}.mcap"
        cosim.run(path, out=log, set={"scenario.stop": 0.5})
        hashes.add(cosim.open_log(log).content_hash())
    assert len(hashes) == 1


SLOW = """
import os, signal, sys
from contextlib import ExitStack
from dataclasses import replace
import numpy as np
import cosim
from cosim.core import Clock, Graph, Interface, Memory, Signal
from cosim.errors import Interrupted
from cosim.scenario.recordings import recording
from cosim.scenario.building.build import Builder

class Slow:
    # From step 20 000 on a step takes 500 times as long as before; there the signals are sent.
    interface = Interface((), (Signal("y"),))

    def initialize(self, t, u):
        self.k = self.after = 0
        return np.zeros(1)

    def outputs(self, t, u):
        return np.array([float(self.k)])

    def advance(self, t, h, u):
        for k in range(len(t) - 1):
            self.k += 1
            if self.k == 20_000:
                for _ in range(int(sys.argv[1])):
                    os.kill(os.getpid(), signal.SIGINT)
            self.after += self.k > 20_000
            sum(range(100_000 if self.k > 20_000 else 200))
        return np.arange(self.k - len(t) + 2.0, self.k + 1.0)[:, np.newaxis]

slow = Slow()
with ExitStack() as resources:
    experiment = Builder(cosim.load("academic"), resources).experiment()
    clock = Clock(10_000.0, 1e-3, int(sys.argv[2]) or None)
    experiment = replace(experiment, graph=Graph({"x": slow}, {}), clock=clock, identified={})
    memory = Memory()
    try:
        recording.run_into(memory, experiment, progress=None, profile=None)
    except (Interrupted, KeyboardInterrupt) as error:
        rows = len(memory["x.y"]) - 1
        same = (memory["x.y"] == np.arange(rows + 1.0)).all()
        print(type(error).__name__, memory.status, slow.after, rows - 20_000, same)
"""


@pytest.mark.slow
@pytest.mark.parametrize("block", [0, 13_000])
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_an_interrupt_ends_a_run_that_has_turned_slow(block):
    """Between two calls: of the millions of steps to go some hundreds are computed, and kept.

    A step before took some microseconds, so that a call had some hundreds of steps. Of the fixed
    block 6000 steps are left.
    """
    name, status, after, kept, same = interrupted(1, block)
    assert (name, status, same) == ("Interrupted", "interrupted", "True")
    assert 0 <= int(kept) == int(after) < 3_000


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_second_interrupt_ends_it_at_once():
    """Within the call; what was recorded stays."""
    name, status, after, kept, same = interrupted(2, 0)
    assert (name, status, same) == ("Interrupted", "interrupted", "True")
    assert int(after) == 0
    assert int(kept) <= 0


def interrupted(signals, block):
    """Return what a run in another process prints that interrupts itself."""
    assert signal.SIGINT
    command = [sys.executable, "-c", SLOW, str(signals), str(block)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=100)
    return done.stdout.split()
