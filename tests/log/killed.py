"""Processes that write logs until they are killed, and what their files must hold then."""

from __future__ import annotations

import io
import multiprocessing
import os
import random
import signal
import time
import zlib
from contextlib import suppress
from dataclasses import dataclass
from functools import cache

import numpy as np
from mcap import records
from mcap.reader import NonSeekingReader, make_reader

from cosim.core.recorders import EndOfRun
from cosim.log import McapRecorder, open_log, store
from cosim.log.live_file import PAGE
from cosim.log.mcap_records import HEADER, IndexEntry, RecordGroup, encoded, record_header
from tests.log.direct import content, open_store
from tests.log.recordings import STEP_NS, blocks, layout, plan, same_bits

WIDE = 1000  # doubles of a row, so that a chunk has few rows


FLUSH = 100  # rows of a large flush, about 1 MiB


FILLER = 2**24  # bytes of a chunk without rows


OPAQUE = 0x90  # opcode of a private record


FIELD = np.dtype([("tag", "u1"), ("value", "<f8")])  # of a message of the plant


processes = multiprocessing.get_context("forkserver")


processes.set_forkserver_preload([__name__])


def table(count):
    """Return the rows of a run, the same in every process, shape (count, width)."""
    base = np.sqrt(np.arange(2, layout(wide=WIDE).width + 2))
    return np.arange(1, count + 1)[:, None] * base


@dataclass(frozen=True)
class Job:
    """What a process writes.

    Attributes
    ----------
    path : Path
    seed : int
        Of the sizes of the flushes.
    flushes : int
        After so many the log is closed.
    kind : str
        ``store``: flush by flush; ``recorder``: by the recorder's thread, as fast as it can.
    filled : int
        Bytes of chunks without rows that the file begins with, holes on the disk.
    cut : (int, float), optional
        The number of the write that kills the process, and how much of it is done.
    """

    path: object
    seed: int
    flushes: int = 8
    kind: str = "store"
    filled: int = 0
    cut: tuple | None = None

    @property
    def sizes(self):
        """Rows of the flushes."""
        chance = random.Random(self.seed)
        choices = [[FLUSH], [1, 2, 5], [1, 5, 40, FLUSH]][self.seed % 3]
        return [chance.choice(choices) for _ in range(self.flushes)]

    @property
    def rows(self):
        """Rows of the whole run."""
        return table(sum(self.sizes))

    @property
    def compression(self):
        """How the chunks are compressed."""
        return "none" if self.seed % 2 else "zstd"


class CutFile(io.FileIO):
    """A file whose n-th write is not finished; it leaves holes for what is nothing but zeros."""

    def __init__(self, path, cut):
        super().__init__(path, "x+")
        self.writes = 0
        self.cut = cut

    def write(self, data):
        if len(data) >= FILLER // 2:
            stop = self.tell() + len(data) - PAGE
            super().write(data[:PAGE])
            self._clear(stop)
            super().write(data[-PAGE:])
            return len(data)
        if self.cut is not None and self.writes == self.cut[0]:
            super().write(data[: self._whole_pages(self.cut[1] * len(data))])
            os.kill(os.getpid(), signal.SIGKILL)
        self.writes += 1
        return super().write(data)

    def _clear(self, stop):
        """Write zeros up to a position, but for the holes, which are left."""
        position = self.tell()
        with suppress(OSError):  # behind the last data there is an error
            while (position := os.lseek(self.fileno(), position, os.SEEK_DATA)) < stop:
                end = min(os.lseek(self.fileno(), position, os.SEEK_HOLE), stop)
                os.pwrite(self.fileno(), bytes(end - position), position)
                position = end
        self.seek(stop)

    def _whole_pages(self, size):
        """Return how much of a write is done at the end of a page: none is left within one."""
        position = self.tell()
        return max((position + int(size)) // PAGE * PAGE - position, 0)


def start(job):
    """Start a process; return it and the pipe that it reports numbers of rows through.

    It stays until something is sent to it, or it is killed: its id is that of no other.
    """
    ours, theirs = processes.Pipe()
    process = processes.Process(target=_run, args=(job, theirs))
    process.start()
    theirs.close()
    return process, ours


def reports(pipe):
    """Yield what a process reports until it is gone."""
    while True:
        try:
            yield pipe.recv()
        except (EOFError, OSError):
            return


def answer_of(function, *arguments):
    """Return what a function sends that is called in a process of its own, with a pipe."""
    receiver, sender = processes.Pipe(duplex=False)
    process = processes.Process(target=function, args=(sender, *arguments))
    process.start()
    sender.close()
    (answer,) = reports(receiver)
    process.join()
    return answer


def _run(job, pipe):
    """Write all; last report the number of writes, as text."""
    pipe.send(str((_with_recorder if job.kind == "recorder" else _with_store)(job, pipe)))
    pipe.recv()


def _with_store(job, pipe):
    """Write flush by flush, report after each, and close; return the number of writes."""
    stream = CutFile(job.path, job.cut)
    log = open_store(stream, plan(layout(wide=WIDE)), compression=job.compression)
    for _ in range(0, job.filled, FILLER):
        log._file.commit(filler())
    rows = job.rows
    written = 0
    pipe.send(0)
    for size in job.sizes:
        log.add(content(rows, written, written + size))
        written += size
        pipe.send(written)
    log.close(EndOfRun("complete", ""), {})
    return stream.writes


def _with_recorder(job, pipe):
    """Write as a run does; report when the thread has written."""
    add = store.LogStore.add
    written = 0

    def report(log, flushed):
        nonlocal written
        add(log, flushed)
        written += len(flushed.steps)
        pipe.send(written)

    store.LogStore.add = report
    lay = layout(wide=WIDE)
    with McapRecorder(job.path, flush=0.0, compression=job.compression) as recorder:
        recorder.begin(plan(lay))
        pipe.send(0)
        for block, signals in blocks(job.rows, 3):
            recorder.write(block, signals)
    return written


@cache
def filler():
    """Return a chunk of zeros that belong to no channel of a component."""
    data = record_header(OPAQUE, FILLER - HEADER) + bytes(FILLER - HEADER)
    chunk = encoded(records.Chunk("", data, 0, 0, zlib.crc32(data), len(data)))
    log_channel = 4
    message_index = encoded(records.MessageIndex(log_channel, []))
    index = records.ChunkIndex(
        chunk_length=len(chunk),
        chunk_start_offset=0,
        compression="",
        compressed_size=len(data),
        message_end_time=0,
        message_index_length=len(message_index),
        message_index_offsets={log_channel: len(chunk)},
        message_start_time=0,
        uncompressed_size=len(data),
    )
    crc = zlib.crc32(chunk + message_index)
    return RecordGroup([chunk, message_index], [IndexEntry(index, {log_channel: 0})], crc)


def check(job, reported):
    """Check a file: all that was reported is there, bit for bit, for every reader.

    Returns
    -------
    int
        Rows of the file.
    """
    rows = job.rows
    log = open_log(job.path)
    assert log.status in ("unfinished", "complete")
    log.load()
    count = len(log.time_ns("plant"))
    assert count >= reported
    assert np.array_equal(log.time_ns("plant"), np.arange(count) * STEP_NS)
    for name, channel in log.channels.items():
        expected = rows[: count : channel.period, channel.columns]
        assert same_bits(log.rows(name), expected), name
    for make in (make_reader, NonSeekingReader):
        with open(job.path, "rb") as stream:
            reader = make(stream, validate_crcs=True)
            assert count_messages(reader.iter_messages(), rows) >= reported
    return count


def count_messages(messages, rows):
    """Return how many messages the plant has; they are its first rows, bit for bit."""
    found = 0
    for _, channel, message in messages:
        if channel.topic == "/plant":
            assert message.sequence == found
            fields = np.frombuffer(message.data, FIELD)
            assert same_bits(fields["value"], rows[found, :5])
            found += 1
    return found


def whole_run(job):
    """Let a process write all; return how long that took [s], and the number of its writes."""
    process, pipe = start(job)
    assert pipe.recv() == 0
    begun = time.perf_counter()
    report = 0
    while not isinstance(report, str):
        report = pipe.recv()
    duration = time.perf_counter() - begun
    pipe.send(None)
    process.join()
    assert process.exitcode == 0
    job.path.unlink()
    return duration, int(report)


def killed_run(job, delay=None, name="SIGKILL"):
    """Kill a process after a while [s], or let it kill itself.

    Returns
    -------
    int
        The rows that it reported.
    bool
        Whether it had closed the log.
    """
    process, pipe = start(job)
    reported = pipe.recv()
    if delay is not None:
        deadline = time.perf_counter() + delay
        while time.perf_counter() < deadline:  # to the microsecond, which no sleep is
            pass
        os.kill(process.pid, getattr(signal, name))
    is_closed = False
    for report in reports(pipe):
        is_closed = isinstance(report, str)
        reported = reported if is_closed else report
        if is_closed and delay is None:
            pipe.send(None)
    process.join()
    assert process.exitcode == -getattr(signal, name)
    return reported, is_closed
