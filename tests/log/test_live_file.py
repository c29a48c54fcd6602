"""A file of a run is whole after every write, as it is left where the process is killed then."""

from __future__ import annotations

import io
import random
from contextlib import suppress
from itertools import product
from statistics import median

import pytest
from mcap.exceptions import McapError
from mcap.reader import FOOTER_SIZE as MCAP_FOOTER_SIZE
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC

from cosim.core.recorders import EndOfRun
from cosim.log import live_file, open_log
from cosim.log.mcap_records import FOOTER_SIZE, MAGIC
from tests.log.direct import content, open_store
from tests.log.paged import PagedStream, Recording, count_rows
from tests.log.recordings import STEP_NS, layout, make_chunks_small, plan, same_bits, table


def final_counts(recording):
    """Return what readers of a file count."""
    return set(count_rows(bytes(recording.stream.content)))


@pytest.mark.parametrize(
    ("seeds", "sizes"),
    [
        ([3], [2000]),
        pytest.param(range(3), [2000], marks=pytest.mark.slow),
        pytest.param(range(4, 60), [200, 2000, 20_000], marks=pytest.mark.campaign),
    ],
    ids=["short", "slow", "campaign"],
)
def test_readers_see_the_rows_before_or_after_the_flush_in_progress(seeds, sizes, subtests):
    """After every write: those that go by the indexes and those that read on from the start."""
    for seed, largest in product(seeds, sizes):
        with subtests.test(case=(seed, largest)):
            recording = Recording(random.Random(seed), largest=largest)
            for _ in range(20):
                recording.call()
            recording.close()
            assert recording.looks > 50
            assert final_counts(recording) == set(recording.allowed)


def test_a_loss_of_power_leaves_what_was_flushed(monkeypatch):
    """All that was written since the disk was waited for last may be lost then."""
    on_disk = b""

    def wait_for_disk(descriptor):
        nonlocal on_disk
        on_disk = bytes(recording.stream.content)

    monkeypatch.setattr(live_file, "_fdatasync", wait_for_disk)
    recording = Recording(random.Random(3), sync=True)
    recording.replace_tail(1, 10)
    for _ in range(8):
        recording.call()
        assert set(count_rows(on_disk)) == set(recording.allowed)
    recording.close()
    assert on_disk == recording.stream.content


@pytest.mark.parametrize("flushes", [1, 2])
def test_a_file_with_a_long_summary_grows(flushes):
    """The new room for it does not begin within the old, whichever of its halves is in use."""
    recording = Recording(random.Random(1), summary_bytes=40_000)
    for _ in range(flushes):
        recording.replace_tail(1, 10)
        recording.keep_tail()
    recording.replace_tail(15, 5000)
    recording.close()
    assert final_counts(recording) == set(recording.allowed)


def run_failing(failing, *, seed=1, largest=200, longest=None):
    """Write a file whose writes of some numbers fail; return it, and whether it was closed."""
    recording = Recording(random.Random(seed), largest=largest)
    recording.stream.failing = failing
    recording.stream.longest = longest
    for _ in range(12):
        with suppress(OSError):
            recording.call()
    # Beyond the room that there is: the file grows.
    recording.largest = 10_000
    with suppress(OSError):
        recording.call()
    try:
        recording.close()
    except OSError:
        return recording, False
    return recording, True


@pytest.mark.parametrize(
    "stride",
    [44, pytest.param(3, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.campaign)],
)
def test_a_write_that_fails_leaves_a_whole_file(stride, subtests):
    """Whichever it is; the calls behind it, which do or do not fail too, leave a whole file."""
    begun = Recording(random.Random(1)).stream.writes
    whole, _ = run_failing(range(0))
    assert whole.stream.writes - begun > 50
    numbers = range(begun, whole.stream.writes, stride)
    closed = 0
    for number in numbers:
        for last in (number + 1, 10**9):  # once, and from then on
            recording, is_closed = run_failing(range(number, last))
            with subtests.test(case=(number, last)):
                assert final_counts(recording) <= set(recording.allowed)
            closed += is_closed and last == number + 1
    assert closed > len(numbers) / 2


def test_growth_that_finds_no_room_takes_just_what_is_needed():
    """Then there is room for the rows, though not for twice as many, as there would be else."""
    recording = Recording(random.Random(1))
    recording.stream.longest = 150_000
    recording.replace_tail(5, 20_000)
    assert recording.allowed == (5,)
    recording.keep_tail()
    with pytest.raises(OSError, match="No space left"):
        recording.replace_tail(5, 20_000)
    recording.close()
    assert final_counts(recording) == {5}


def test_a_file_is_not_whole_where_it_ended_before_it_grew():
    """If it is cut there, that shows."""
    recording = Recording(random.Random(1))
    recording.replace_tail(1, 10)
    recording.keep_tail()
    end_before = len(recording.stream.content)
    recording.replace_tail(6, 10_000)
    content = bytes(recording.stream.content)
    assert len(content) > end_before
    with pytest.raises(McapError):
        make_reader(io.BytesIO(content[:end_before])).get_summary()


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


def test_magic_and_footer_are_those_of_mcap():
    """They stand here, as the modules of mcap that have them load every compressor."""
    assert MAGIC == MCAP0_MAGIC
    assert FOOTER_SIZE == MCAP_FOOTER_SIZE
