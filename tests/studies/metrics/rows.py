"""Rows of a run to compute metrics of, written in blocks of any sizes."""

import numpy as np

from cosim.core.contracts import Block
from cosim.core.recorders import Memory
from cosim.core.recording import Plan
from cosim.core.signals import Interface, Signal
from cosim.core.structure.ports import layout_of
from cosim.studies.measuring import MetricRecorder
from cosim.studies.metrics import parse_metrics

STEP_NS = 10**6


class Outputs:
    """A component that has only outputs."""

    def __init__(self, *signals):
        self.interface = Interface((), signals)


SIGNALS = (Signal("y"), Signal("u"), Signal("gap", optional=True), Signal("v", 2))
LAYOUT = layout_of(
    {"plant": Outputs(*SIGNALS), "my-part": Outputs(Signal("der(x)")), "slow": Outputs(SIGNALS[0])},
    {"slow": 4},
)
PLAN = Plan(LAYOUT, STEP_NS, {}, {}, ())
CHANNELS = PLAN.channels


def columns(**values):
    """Return rows with these values of plant, of ``part`` and ``slow``; all else is 0."""
    count = len(next(iter(values.values())))
    rows = np.zeros((count, LAYOUT.width))
    for name, column in values.items():
        rows[:, {"y": 0, "u": 1, "gap": 2, "v0": 3, "v1": 4, "part": 5, "slow": 6}[name]] = column
    return rows


def write(recorder, rows, sizes=()):
    """Write rows of a run in blocks of some steps, and the rest in one."""
    recorder.begin(PLAN)
    index = 0
    sizes = list(sizes)
    while index < len(rows) - 1 or index == 0:
        steps = min(sizes.pop(0) if sizes else len(rows), len(rows) - 1 - index)
        time_ns = np.arange(index, index + steps + 1) * STEP_NS
        block = Block(index, time_ns, time_ns / 1e9, STEP_NS / 1e9)
        recorder.write(block, rows[index : index + steps + 1].copy())
        index += steps
        if len(rows) == 1:
            break
    return recorder


def memory_of(rows):
    return write(Memory(), rows)


def value(text, rows):
    """Return the value of one metric."""
    recorder = write(MetricRecorder(parse_metrics({"m": text})), rows)
    return recorder.values()["m"]
