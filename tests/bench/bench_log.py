"""What writing a log costs, beside mcap-protobuf-support, foxglove-sdk and bare memory and disk.

Every pair takes the same messages, in one run. Run with ``python tests/bench/bench_log.py``; every
figure is the median of five, that of mcap-protobuf-support is of one round over a part of the
messages. foxglove-sdk takes bytes: it is compared without and with the time of their serialization.
What was written is read back by mcap's reader and compared bit for bit.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import foxglove
import numpy as np
from foxglove.mcap import MCAPCompression, MCAPWriteOptions
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.writer import Writer

from cosim.core.contracts import Block
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.log import McapRecorder, open_log
from cosim.log.messages import component_schema

STEPS = 133_333
PART = 10  # the slow writer takes a tenth of the messages
STEP_NS = 1_000_000
COMPONENTS = {"plant": 6, "observer": 5, "identifier": 13}
COUNT = (STEPS + 1) * len(COMPONENTS)
PIECE = 2**20  # bytes that memcpy and write take at once
REPEAT = 5


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
        for start in range(0, len(rows) - 1, size):
            stop = min(start + size, len(rows) - 1)
            time_ns = np.arange(start, stop + 1) * STEP_NS
            block = Block(start, time_ns, time_ns / 1e9, 1e-3)
            recorder.write(block, rows[start : stop + 1])


def message_classes() -> dict[str, tuple[type, bytes, list[str]]]:
    """Return for each component the class of its messages, its schema and its fields."""
    classes = {}
    for name, size in COMPONENTS.items():
        fields = [f"y{i}" for i in range(size)]
        schema = component_schema(name, fields)
        pool = descriptor_pool.DescriptorPool()
        pool.Add(descriptor_pb2.FileDescriptorSet.FromString(schema).file[0])
        descriptor = pool.FindMessageTypeByName(f"cosim.{name}")
        classes[name] = (message_factory.GetMessageClass(descriptor), schema, fields)
    return classes


def by_protobuf_support(path: Path, rows: np.ndarray, compression: str) -> None:
    """Write message by message, as mcap-protobuf-support does."""
    kind = {"zstd": CompressionType.ZSTD, "none": CompressionType.NONE}[compression]
    classes = message_classes()
    with path.open("wb") as stream:
        writer = Writer(stream, compression=kind)
        for step, row in enumerate(rows.tolist()):
            start = 0
            for name, (kind_of_message, _, fields) in classes.items():
                values = dict(zip(fields, row[start : start + len(fields)], strict=True))
                start += len(fields)
                message = kind_of_message(**values)
                writer.write_message(f"/{name}", message, step * STEP_NS, step * STEP_NS, step)
        writer.finish()


def serialized(rows: np.ndarray) -> list[tuple[str, int, bytes]]:
    """Return topic, time and bytes of all messages."""
    messages = []
    classes = message_classes()
    for step, row in enumerate(rows.tolist()):
        start = 0
        for name, (kind, _, fields) in classes.items():
            values = dict(zip(fields, row[start : start + len(fields)], strict=True))
            start += len(fields)
            messages.append((f"/{name}", step * STEP_NS, kind(**values).SerializeToString()))
    return messages


def by_foxglove(path: Path, messages: list[tuple[str, int, bytes]], compression: str) -> None:
    """Write messages that are serialized already: what foxglove-sdk itself costs."""
    kind = {"zstd": MCAPCompression.Zstd, "none": None}[compression]
    context = foxglove.Context()
    channels = {}
    for name, (_, schema, _) in message_classes().items():
        declared = foxglove.Schema(name=f"cosim.{name}", encoding="protobuf", data=schema)
        channels[f"/{name}"] = foxglove.Channel(
            f"/{name}", schema=declared, message_encoding="protobuf", context=context
        )
    options = MCAPWriteOptions(compression=kind)
    with foxglove.open_mcap(path, allow_overwrite=True, context=context, writer_options=options):
        for topic, time_ns, data in messages:
            channels[topic].log(data, log_time=time_ns)


def memcpy_and_write(path: Path, size: int) -> None:
    """Copy a number of bytes in memory, and write them."""
    source = os.urandom(PIECE)
    target = bytearray(PIECE)
    with path.open("wb", buffering=0) as stream:
        for _ in range(size // PIECE):
            target[:] = source
            stream.write(target)


def check(path: Path, rows: np.ndarray) -> None:
    """Compare what mcap's reader finds with what was written, bit for bit."""
    columns: dict[str, list[list[float]]] = {f"/{name}": [] for name in COMPONENTS}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        messages = reader.iter_decoded_messages(list(columns), log_time_order=False)
        for _, channel, _, message in messages:
            values = [getattr(message, field.name) for field in message.DESCRIPTOR.fields]
            columns[channel.topic].append(values)
    found = np.hstack([np.array(values) for values in columns.values()])
    if not np.array_equal(found.view(np.int64), rows.view(np.int64)):
        raise SystemExit(f"{path}: other values than were written")


def read_ours(path: Path) -> None:
    """Read all components to arrays, CRCs checked."""
    open_log(path).load()


def read_stock(path: Path) -> None:
    """Decode all messages to arrays, as a user of mcap does; CRCs are checked."""
    columns: dict[str, list[list[float]]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(log_time_order=False):
            values = [getattr(message, field.name) for field in message.DESCRIPTOR.fields]
            columns.setdefault(channel.topic, []).append(values)
    for topic in (f"/{name}" for name in COMPONENTS):
        np.array(columns[topic])


def timed(
    task: Callable[..., None], *arguments: object, repeat: int = REPEAT, new: Path | None = None
) -> np.ndarray:
    """Return the median wall time and the median processor time of a task [s].

    The file ``new`` is removed before each round: a file system may write out at once, when it is
    closed, what takes the place of an old file's content.
    """
    wall = []
    processor = []
    for _ in range(repeat):
        if new is not None:
            new.unlink(missing_ok=True)
        began = time.perf_counter(), time.process_time()
        task(*arguments)
        wall.append(time.perf_counter() - began[0])
        processor.append(time.process_time() - began[1])
    return np.array([median(wall), median(processor)])


def main() -> None:
    """Print ratios."""
    rows = table()
    part = np.ascontiguousarray(rows[: len(rows) // PART])
    share = len(part) / len(rows)
    began = time.perf_counter()
    messages = serialized(rows)
    serialization = time.perf_counter() - began
    out = sys.stdout.write
    out(f"{COUNT} messages of 3 components, 8 doubles on average\n")
    with tempfile.TemporaryDirectory(dir=sys.argv[1] if len(sys.argv) > 1 else None) as folder:
        mine = Path(folder) / "ours.mcap"
        theirs = Path(folder) / "theirs.mcap"
        for compression in ("zstd", "none"):
            own = timed(ours, mine, rows, compression, new=mine)
            size = mine.stat().st_size
            floor = timed(memcpy_and_write, theirs, size, new=theirs)
            support = timed(by_protobuf_support, theirs, part, compression, repeat=1, new=theirs)
            check(theirs, part)
            sdk = timed(by_foxglove, theirs, messages, compression, repeat=3, new=theirs)
            single = timed(ours, mine, part, compression, 1, repeat=3, new=mine)
            check(mine, part)
            ours(mine, rows, compression)
            out(f"write, {compression}: {own[0] * 1e9 / COUNT:.0f} ns a message, ")
            out(f"{support[0] / share / own[0]:.0f} x mcap-protobuf-support, ")
            out(f"{sdk[0] / own[0]:.1f} x foxglove-sdk with messages that were serialized before, ")
            out(f"{(sdk[0] + serialization) / own[0]:.0f} x with their serialization, ")
            out(f"{own[1] / floor[1]:.2f} x the processor time and {own[0] / floor[0]:.2f} x the ")
            out("wall time of memcpy and write; in blocks of one step ")
            out(f"{support[0] / single[0]:.1f} x mcap-protobuf-support\n")
            found = timed(read_ours, mine)
            ours(theirs, part, compression)
            stock = timed(read_stock, theirs, repeat=1)
            out(f"read, {compression}: {found[0] * 1e9 / COUNT:.0f} ns a message, ")
            out(f"{stock[0] / share / found[0]:.0f} x mcap's reader\n")


if __name__ == "__main__":
    main()
