"""Small runs made by hand, for the tests of the log."""

from __future__ import annotations

import numpy as np

from cosim.core.contracts import Block, Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.log import McapRecorder

STEP_NS = 1_000_000


def layout(*, period=5, wide=0):
    """Lay out a plant, a slower identifier with an optional signal, and if asked for a wide component."""
    plant = Interface(
        (Signal("u", unit="m/s", role="input"),),
        (
            Signal("x_a", 2, role="state"),
            Signal("der(x)", unit="1"),
            Signal("n", kind="integer", variability="discrete"),
        ),
        {"x_a": (), "der(x)": ("u",)},
    )
    identifier = Interface(
        (Signal("y", 3, role="input"),),
        (Signal("theta", 2, optional=True, role="estimate"),),
        {"theta": None},
    )
    interfaces = [("plant", plant, 1), ("identifier", identifier, period)]
    if wide:
        interfaces.append(("wide", Interface((), (Signal("y", wide),)), 1))
    channels, start = [], 0
    for name, interface, every in interfaces:
        channels.append(Channel(name, interface, start, every))
        start = channels[-1].columns.stop
    return Layout(tuple(channels))


def plan(lay=None):
    """Plan a run with a design of awkward numbers."""
    design = {
        "M": np.array([[0.1, -0.0], [np.nan, 5e-324]]),
        "empty": np.zeros((0, 3)),
        "scalar": np.array(np.pi),
    }
    held = {"plant": np.array([True]), "identifier": np.array([False, True, False])}
    return Plan(
        lay or layout(), STEP_NS, {"plant": design}, held, ("cascade plant", "cascade identifier")
    )


def table(lay, steps, seed=1):
    """Give the rows of a run, shape (steps + 1, width), with NaNs of unusual bits, infinities and both zeros among them."""
    rows = np.random.default_rng(seed).normal(size=(steps + 1, lay.width))
    odd = np.array(
        [
            0x7FF8000000000000,
            0xFFF8000000000123,
            0x7FF0000000000001,
            0x8000000000000000,
            0x7FF0000000000000,
        ],
        dtype="u8",
    )
    rows.reshape(-1)[3 : 3 + 7 * len(odd) : 7] = odd.view(np.float64)
    return rows


def blocks(rows, size, first=0):
    """Cut the rows of a run into blocks of at most ``size`` steps."""
    for start in range(first, len(rows) - 1, size):
        stop = min(start + size, len(rows) - 1)
        time_ns = np.arange(start, stop + 1, dtype=np.int64) * STEP_NS
        yield Block(start, time_ns, time_ns / 1e9, STEP_NS / 1e9), rows[start : stop + 1]


def record(path, *, steps=1000, size=100, lay=None, rows=None, messages=(), **options):
    """Record a run; give its rows."""
    lay = lay or layout()
    rows = table(lay, steps) if rows is None else rows
    with McapRecorder(path, **options) as recorder:
        recorder.begin(plan(lay))
        for message in messages:
            recorder.message(*message)
        for block, signals in blocks(rows, size):
            recorder.write(block, signals)
        recorder.result({"rms": np.float64(0.25)})
    return rows


def same_bits(a, b):
    """Say whether two arrays have one shape and the same bits."""
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    return a.shape == b.shape and np.array_equal(a.view(np.int64), b.view(np.int64))
