"""What a log says of itself is true of what it holds, wherever the disk failed."""

from __future__ import annotations

import random
from statistics import median

import pytest

from cosim.core.recorders import EndOfRun
from cosim.log import open_log
from tests.log.mcap_file.paged import PagedStream
from tests.log.recordings import STEP_NS, layout, make_chunks_small, plan, same_bits, table
from tests.log.writing.direct import content, open_store

ROWS = table(layout(), 700)


def write(failing):
    """Write a log, of which some writes fail; return the stream and the rows of all flushes."""
    stream = PagedStream()
    store = open_store(stream, plan())
    stream.failing = failing
    sizes = random.Random(1)
    written = 0
    try:
        while written < 600:
            count = sizes.choice([1, 3, 10, 40])
            store.add(content(ROWS, written, written + count))
            written += count
        store.finish(content(ROWS, written, written + 5), EndOfRun("complete", ""), {})
    except OSError:
        store.fail("the disk", {})
        return stream, written
    return stream, written + 5


@pytest.mark.parametrize("stride", [46, pytest.param(2, marks=pytest.mark.slow)])
def test_a_failed_write_leaves_all_flushed_rows_and_their_hash(
    tmp_path, monkeypatch, stride, subtests
):
    """Whichever it is; and the rows that were being flushed are there whole, or not at all."""
    make_chunks_small(monkeypatch, 6000)
    begun = PagedStream()
    open_store(begun, plan())
    whole, _ = write(range(0))
    assert whole.writes > begun.writes + 100
    path = tmp_path / "a.mcap"
    numbers = range(begun.writes, whole.writes, stride)
    closed = 0
    for number in numbers:
        for last in (number + 1, 10**9):  # once, and from then on
            stream, written = write(range(number, last))
            path.write_bytes(stream.content)
            with subtests.test(case=(number, last)):
                closed += check(open_log(path), written) and last == number + 1
    assert closed > len(numbers) / 3


def check(log, written):
    """Check the rows and the hash of a log; return whether it was closed."""
    count = len(log.rows("plant"))
    assert count >= written
    assert same_bits(log.rows("plant"), ROWS[:count, :5])
    assert same_bits(log.rows("identifier"), ROWS[:count:5, 5:])
    if log.status == "unfinished":
        return False
    assert (log.steps, log.end_ns) == (count - 1, (count - 1) * STEP_NS) or not count
    assert log.recorded_hash == log.content_hash()
    return True


def test_a_flush_of_a_long_log_writes_as_much_as_one_of_a_short_log(monkeypatch):
    """What it writes does not grow with the chunks that the summary lists."""
    make_chunks_small(monkeypatch, 1000)
    stream = CountingStream()
    store = open_store(stream, plan())
    rows = table(layout(), 2000)
    written = []
    for start in range(0, 2000, 4):
        before = stream.bytes
        store.add(content(rows, start, start + 4))
        written.append(stream.bytes - before)
    # A flush that lengthens the file writes the whole summary: the median is of those that do not.
    assert median(written[-100:]) <= 2 * median(written[:100])
    store.close(EndOfRun("complete", ""), {})


class CountingStream(PagedStream):
    """Counts the bytes that are written."""

    bytes = 0

    def write(self, data):
        count = super().write(data)
        self.bytes += count
        return count
