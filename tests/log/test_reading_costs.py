"""What is read of a log: no more than what was asked for; bytes are counted by the file object."""

from __future__ import annotations

import io
import os
import tracemalloc
from time import process_time

import numpy as np
import pytest
from mcap.reader import make_reader

from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.log import McapRecorder, container, open_log
from cosim.log import rows as log_rows
from cosim.log.diff import diff
from cosim.report.inspection import describe_log
from tests.log.recordings import STEP_NS, blocks, many, plan, record, same_bits, table

COMPONENTS = 20


STEPS = 20_000


READ_AHEAD = 8192  # bytes that a buffered file may read too many, at each of its pieces


class CountedFile(io.FileIO):
    """A file that counts the bytes that are read from it."""

    count = 0

    def readinto(self, buffer):
        number = super().readinto(buffer)
        CountedFile.count += number
        return number


@pytest.fixture(scope="module")
def log_path(tmp_path_factory):
    """Return the log of a run of 20 components of two doubles, in chunks of a component each."""
    channels = [
        Channel(f"c{i}", Interface((), (Signal("y"), Signal("z"))), 2 * i)
        for i in range(COMPONENTS)
    ]
    layout = Layout(tuple(channels))
    path = tmp_path_factory.mktemp("logs") / "a.mcap"
    rows = table(layout, STEPS)
    with McapRecorder(path, compression="none") as recorder:
        recorder.begin(plan(layout))
        for block, signals in blocks(rows, 1000):
            recorder.write(block, signals)
    return path, rows


@pytest.fixture(autouse=True)
def counting(monkeypatch):
    """Count the bytes that logs read; of small components too nothing else is read ahead."""
    monkeypatch.setattr(container, "open_file", lambda path: io.BufferedReader(CountedFile(path)))
    monkeypatch.setattr(log_rows, "_MOST_KEPT", 2**16)
    CountedFile.count = 0


def summary_of(path):
    """Return the summary that mcap reads, and how many bytes it has."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        stream.seek(-28, os.SEEK_END)
        start = int.from_bytes(stream.read(8), "little")
    return summary, path.stat().st_size - start


def bytes_of_metadata(summary):
    """Return how many bytes the metadata records have."""
    return sum(index.length for index in summary.metadata_indexes)


def test_a_log_is_described_by_its_summary_and_metadata(log_path):
    """However many rows it has: none is read."""
    path, _ = log_path
    summary, size = summary_of(path)
    describe_log(str(path))
    pieces = len(summary.metadata_indexes) + 3
    assert CountedFile.count <= size + bytes_of_metadata(summary) + pieces * READ_AHEAD
    assert CountedFile.count < path.stat().st_size / 50


@pytest.mark.parametrize(("signal", "column"), [("y", 14), ("z", 15)])
def test_one_signal_takes_the_chunks_of_its_component(log_path, signal, column):
    """At most a tenth more, and a fifth more memory than the array that is returned.

    That is all that is kept, whether the signal is the first of its component or another one.
    """
    path, rows = log_path
    summary, _ = summary_of(path)
    own = sum(
        index.chunk_length
        for index in summary.chunk_indexes
        if set(index.message_index_offsets) == {8}
    )
    log = open_log(path)
    CountedFile.count = 0
    tracemalloc.start()
    values = log[f"c7.{signal}"]
    kept, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert same_bits(values, rows[:, column])
    assert values.nbytes <= kept <= 1.2 * values.nbytes
    assert own <= CountedFile.count <= 1.1 * own
    largest = max(index.chunk_length for index in summary.chunk_indexes)
    assert peak <= 1.2 * values.nbytes + 3 * largest  # of a long log the chunk in hand is little


def test_a_window_takes_the_chunks_that_overlap_it(log_path):
    """Of its component, by the times of the chunks."""
    path, rows = log_path
    summary, _ = summary_of(path)
    first = STEPS // 2
    window = range(first, first + 500)
    overlapping = 0
    for index in summary.chunk_indexes:
        begins = index.message_start_time <= window[-1] * STEP_NS
        ends = index.message_end_time >= first * STEP_NS
        if begins and ends and set(index.message_index_offsets) == {8}:
            overlapping += index.chunk_length
    log = open_log(path)
    CountedFile.count = 0
    found = log.window(first * STEP_NS / 1e9, window[-1] * STEP_NS / 1e9)["c7.z"]
    assert same_bits(found, rows[first : window[-1] + 1, 15])
    assert 0 < CountedFile.count <= overlapping + 4 * READ_AHEAD


def test_times_take_the_chunks_of_one_component(log_path):
    """Those of the fastest."""
    path, _ = log_path
    log = open_log(path)
    CountedFile.count = 0
    assert np.array_equal(log.t, np.arange(STEPS + 1) * STEP_NS / 1e9)
    assert CountedFile.count < path.stat().st_size / COMPONENTS * 1.1


def reading_costs(path, count):
    """Return the processor time for each component: to hash it, to read it."""
    hashed = open_log(path)
    log = open_log(path)
    began = process_time()
    hashed.content_hash()
    between = process_time()
    for name in log.channels:
        log.rows(name)
        assert not log.kinds[name]
    return np.diff([began, between, process_time()]) / count


@pytest.mark.slow
@pytest.mark.usefixtures("frozen_heap")
def test_the_cost_to_read_a_component_does_not_grow(tmp_path):
    """As a ratio within one run; the smallest counts, as another process can only add time."""
    small = tmp_path / "small.mcap"
    large = tmp_path / "large.mcap"
    record(small, steps=100, size=100, lay=many(100))
    record(large, steps=100, size=100, lay=many(1000))
    ratios = np.full(2, np.inf)
    for _ in range(5):
        base = np.min([reading_costs(small, 100) for _ in range(2)], axis=0)
        ratios = np.minimum(ratios, reading_costs(large, 1000) / base)
        if (ratios <= 1.5).all():
            return
    raise AssertionError(f"a component costs {ratios} times as much to hash and to read")


@pytest.mark.slow
def test_a_log_may_be_larger_than_memory(tmp_path):
    """Hash, diff and info of 70 MB of rows, in less than 0.7 MB, take less than a quarter of it.

    The rows of a chunk of 1 MiB are there a few times, as records, values and differences.
    """
    lay = Layout((Channel("c", Interface((), (Signal("y", 800),)), 0),))
    big = tmp_path / "big.mcap"
    rows = np.zeros((1001, 800))
    with McapRecorder(big) as recorder:
        recorder.begin(plan(lay))
        for k in range(11):
            for block, signals in blocks(rows, 1000):
                first = k * 1000
                times = block.time_ns + first * STEP_NS
                shifted = type(block)(first, times, times / 1e9, block.h)
                recorder.write(shifted, signals)
    size = 11_000 * 800 * 8
    assert big.stat().st_size < size / 100
    log = open_log(big)
    for read in (
        log.content_hash,
        lambda: diff(log, open_log(big), rtol=0.1).equal,
        lambda: describe_log(str(big)),
    ):
        tracemalloc.start()
        assert read()
        assert tracemalloc.get_traced_memory()[1] < size / 4
        tracemalloc.stop()
