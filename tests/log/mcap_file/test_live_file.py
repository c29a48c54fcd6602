"""A file of a run is whole after every write, as it is left where the process is killed then."""

from __future__ import annotations

import io
import random
from contextlib import suppress
from itertools import product

import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader

from cosim.log import live_file
from tests.log.mcap_file.paged import Recording, count_rows


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
