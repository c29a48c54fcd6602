"""Small runs made by hand, for the tests of the log."""

from __future__ import annotations

from collections import Counter
from time import monotonic

import numpy as np
from mcap.reader import make_reader

from cosim.core.contracts import Block
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.log import McapRecorder, chunks, store
from cosim.log.files import Rotation, part_paths

STEP_NS = 1_000_000
LATE = Rotation(None, 300 * STEP_NS, "0.3s")  # three whole files and a shorter one of 1000 steps


PLANT = Interface(
    (Signal("u", unit="m/s", role="input"),),
    (
        Signal("x_a", 2, role="state"),
        Signal("der(x)", unit="1"),
        Signal("n", type="integer", variability="discrete"),
    ),
    {"x_a": (), "der(x)": ("u",)},
)


IDENTIFIER = Interface(
    (Signal("y", 3, role="input"),),
    (Signal("theta", 2, optional=True, role="estimate"),),
    {"theta": None},
)


# NaNs of unusual bits, minus zero, infinity.
ODD_BITS = [
    0x7FF8000000000000,
    0xFFF8000000000123,
    0x7FF0000000000001,
    0x8000000000000000,
    0x7FF0000000000000,
]


def layout(*, period=5, wide=0):
    """Return the layout of a plant, a slower identifier and, if asked for, a wide component."""
    interfaces = [("plant", PLANT, 1), ("identifier", IDENTIFIER, period)]
    if wide:
        interfaces.append(("wide", Interface((), (Signal("y", wide),)), 1))
    channels = []
    start = 0
    for name, interface, every in interfaces:
        channel = Channel(name, interface, start, every)
        channels.append(channel)
        start = channel.columns.stop
    return Layout(tuple(channels))


def plan(lay=None):
    """Return the plan of a run with a design of awkward numbers."""
    design = {
        "M": np.array([[0.1, -0.0], [np.nan, 5e-324]]),
        "empty": np.zeros((0, 3)),
        "scalar": np.array(np.pi),
    }
    held = {"plant": np.array([True]), "identifier": np.array([False, True, False])}
    schedule = ("cascade plant", "cascade identifier")
    return Plan(lay or layout(), STEP_NS, {"plant": design}, held, schedule)


def table(lay, steps, seed=1):
    """Return the rows of a run, shape (steps + 1, width), with odd values among them."""
    random = np.random.default_rng(seed)
    rows = random.normal(size=(steps + 1, lay.width))
    odd = np.array(ODD_BITS, dtype="u8").view(np.float64)
    rows.reshape(-1)[3 : 3 + 7 * len(odd) : 7] = odd
    return rows


def blocks(rows, size, first=0):
    """Yield the rows of a run in blocks of at most ``size`` steps."""
    for start in range(first, len(rows) - 1, size):
        stop = min(start + size, len(rows) - 1)
        time_ns = np.arange(start, stop + 1, dtype=np.int64) * STEP_NS
        block = Block(start, time_ns, time_ns / 1e9, STEP_NS / 1e9)
        yield block, rows[start : stop + 1]


def record(path, *, steps=1000, size=100, lay=None, rows=None, messages=(), **options):
    """Record a run; return its rows."""
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


def make_chunks_small(monkeypatch, size):
    """Let chunks, and flushes that are full, have about ``size`` bytes of records."""
    for module in (chunks, store):
        monkeypatch.setattr(module, "CHUNK_BYTES", size)
    monkeypatch.setattr(store, "_CHANNEL_BYTES", 0)


def numbered(times):
    """Return (instant, how many rows it had before) of each row."""
    seen = Counter()
    instants = []
    for time in times:
        instants.append((time, seen[time]))
        seen[time] += 1
    return instants


def same_bits(a, b):
    """Return whether two arrays have the same shape and the same bits."""
    bits_a = np.ascontiguousarray(a).view(np.int64)
    bits_b = np.ascontiguousarray(b).view(np.int64)
    return np.array_equal(bits_a, bits_b)


def many(count):
    """Return the layout of many components."""
    channels = []
    for i in range(count):
        interface = Interface((), (Signal("y", 2),))
        channels.append(Channel(f"c{i}", interface, 2 * i))
    return Layout(tuple(channels))


def parts_of(path):
    """Return the files of a log."""
    further = [other for other in path.parent.glob(f"{path.stem}.part*.mcap")]
    return part_paths(max([path, *further], key=lambda other: len(part_paths(other))))


def wait_for_rows(path, count):
    """Wait until a reader finds so many rows of the first component in a file being written."""
    deadline = monotonic() + 60.0
    found = 0
    while found != count:
        assert monotonic() < deadline, f"no {count} rows"
        with path.open("rb") as stream:
            statistics = make_reader(stream).get_summary().statistics
        found = statistics.channel_message_counts.get(1, 0)
