"""Rates of writing and reading a log, beside mcap's own writer and reader, in one run.

Both take the same messages. Run with ``python tests/bench/bench_log.py``; every number is the
median of three.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from cosim.core.contracts import Block
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.log import McapRecorder, open_log
from cosim.log.schema import component_schema

STEPS = 60_000
STEP_NS = 1_000_000
COMPONENTS = {"plant": 6, "observer": 5, "identifier": 13}


def layout() -> Layout:
    """Lay out three components of 6, 5 and 13 elements."""
    channels = []
    start = 0
    for name, size in COMPONENTS.items():
        channels.append(Channel(name, Interface((), (Signal("y", size),)), start))
        start += size
    return Layout(tuple(channels))


def table() -> np.ndarray:
    """Return smooth signals with a little noise, shape (STEPS + 1, width)."""
    t = np.arange(STEPS + 1)[:, None] * 1e-3
    rates = np.linspace(0.5, 3.0, layout().width)
    return np.sin(rates * t) + 1e-9 * np.random.default_rng(1).normal(size=(STEPS + 1, len(rates)))


def ours(path: Path, rows: np.ndarray, compression: str, size: int = 1000) -> None:
    """Record with McapRecorder, in blocks of ``size`` steps."""
    with McapRecorder(path, force=True, compression=compression) as recorder:
        recorder.begin(Plan(layout(), STEP_NS, {}, {}, ()))
        for start in range(0, STEPS, size):
            time_ns = np.arange(start, start + size + 1) * STEP_NS
            recorder.write(
                Block(start, time_ns, time_ns / 1e9, 1e-3), rows[start : start + size + 1]
            )


def stock(path: Path, rows: np.ndarray, compression: str) -> None:
    """Record with mcap's Writer and protobuf's SerializeToString."""
    kind = {"zstd": CompressionType.ZSTD, "none": CompressionType.NONE}[compression]
    with path.open("wb") as stream:
        writer = Writer(stream, compression=kind)
        targets = []
        start = 0
        writer.start()
        for name, size in COMPONENTS.items():
            names = [f"y{i}" for i in range(size)]
            schema = component_schema(name, names)
            pool = descriptor_pool.DescriptorPool()
            pool.Add(descriptor_pb2.FileDescriptorSet.FromString(schema).file[0])
            message = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"cosim.{name}"))
            registered = writer.register_schema(f"cosim.{name}", "protobuf", schema)
            channel = writer.register_channel(f"/{name}", "protobuf", registered)
            targets.append((channel, message, names, slice(start, start + size)))
            start += size
        for step, row in enumerate(rows.tolist()):
            for channel, message, names, columns in targets:
                data = message(**dict(zip(names, row[columns], strict=True))).SerializeToString()
                writer.add_message(channel, step * STEP_NS, data, step * STEP_NS, step)
        writer.finish()


def raw(path: Path, rows: np.ndarray) -> None:
    """Write the bare bytes: the floor."""
    with path.open("wb", buffering=0) as stream:
        for start in range(0, STEPS, 5000):
            stream.write(rows[start : start + 5000].tobytes())


def read_ours(path: Path) -> None:
    """Read all components to arrays, CRCs checked."""
    open_log(path).load()


def read_stock(path: Path) -> None:
    """Iterate over all messages, CRCs checked, without decoding them."""
    with path.open("rb") as stream:
        for _ in make_reader(stream, validate_crcs=True).iter_messages():
            pass


def timed(task, *arguments, repeat: int = 3) -> float:
    """Return the median time of ``task`` [s]."""
    times = []
    for _ in range(repeat):
        begin = time.perf_counter()
        task(*arguments)
        times.append(time.perf_counter() - begin)
    return median(times)


def main() -> None:
    """Print rates and ratios."""
    count = STEPS * len(COMPONENTS)
    rows = table()
    out = sys.stdout.write
    with tempfile.TemporaryDirectory() as folder:
        mine = Path(folder) / "ours.mcap"
        theirs = Path(folder) / "stock.mcap"
        floor = timed(raw, mine, rows)
        out(
            f"{count} messages of 8 doubles on average; "
            f"bare bytes to a file: {floor * 1e9 / count:.0f} ns a message\n"
        )
        for compression in ("none", "zstd"):
            fast = timed(ours, mine, rows, compression)
            slow = timed(stock, theirs, rows, compression, repeat=1)
            single = timed(ours, mine, rows, compression, 1, repeat=1)
            out(
                f"write, {compression}: {slow / fast:.1f}x stock, "
                f"{fast / floor:.1f}x the time of bare bytes; "
            )
            out(f"in blocks of one step {slow / single:.1f}x stock; ")
            size = mine.stat().st_size / theirs.stat().st_size
            out(f"{fast * 1e9 / count:.0f} ns a message, size {size:.2f} of stock\n")
            fast = timed(read_ours, mine)
            slow = timed(read_stock, mine, repeat=1)
            out(
                f"read, {compression}: {slow / fast:.1f}x stock, "
                f"{fast * 1e9 / count:.0f} ns a message\n"
            )


if __name__ == "__main__":
    main()
