"""The log of a run in several files: each opens alone, and together they are the log of the run."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from shutil import copy

import numpy as np
import pytest
from mcap.reader import make_reader

from cosim.errors import LogError, LogWriteError, UsageError
from cosim.log import McapRecorder, open_log
from cosim.log.files import Rotation, UnfinishedLog, part_paths, read_rotation
from cosim.log.spans import merge
from tests.log.recordings import (
    LATE,
    STEP_NS,
    blocks,
    layout,
    make_chunks_small,
    parts_of,
    plan,
    record,
    same_bits,
    table,
)

MESSAGES = [(k * 100 * STEP_NS, "info", "run", f"message {k}") for k in range(11)]


SMALL = Rotation(40_000, None, "40kB")


@pytest.mark.slow
def test_merged_parts_are_the_log_of_the_run(tmp_path, monkeypatch, subtests):
    """The content hash is that of the same run in one file, whatever the blocks are."""
    for number, (rotation, period, size) in enumerate(
        [(LATE, 1, 1000), (LATE, 5, 1), (LATE, 7, 1000), (SMALL, 1, 1), (SMALL, 7, 1000)]
    ):
        folder = tmp_path / str(number)
        lay = layout(period=period)
        with monkeypatch.context() as small:
            make_chunks_small(small, 5_000)
            rows = record(folder / "one.mcap", size=size, lay=lay, messages=MESSAGES)
            options = {"rows": rows, "messages": MESSAGES, "rotation": rotation}
            record(folder / "run.mcap", size=size, lay=lay, **options)
        parts = parts_of(folder / "run.mcap")
        merged = merge(parts, folder / "whole.mcap")
        source = open_log(folder / "one.mcap")
        with subtests.test(case=(rotation, period, size)):
            assert len(parts) > 2
            assert (merged.status, merged.reason) == ("complete", "")
            assert merged.recorded_hash == merged.content_hash() == source.recorded_hash
            assert merged.messages() == source.messages()
            assert merged.results == source.results


def test_every_part_opens_alone(tmp_path):
    """To stock readers, with the head of all, its own rows and hash; times and steps go on."""
    path = tmp_path / "run.mcap"
    rows = record(path, steps=1000, rotation=LATE, messages=MESSAGES)
    first = open_log(path)
    for number, part in enumerate(parts_of(path)):
        log = open_log(part)
        begin = 300 * number
        end = min(begin + 299, 1000)
        text = f"part {number + 1} of its log, from {begin / 1000} s to {end / 1000} s"
        assert (log.status, log.reason) == ("partial", text)
        assert (log.steps, log.end_ns) == (end, end * STEP_NS)
        assert same_bits(log.rows("plant"), rows[begin : end + 1, :5])
        assert np.array_equal(log.time_ns("identifier"), np.arange(begin, end + 1, 5) * STEP_NS)
        assert log.recorded_hash == log.content_hash()
        assert log.metadata["cosim.schedule"] == first.metadata["cosim.schedule"]
        assert dict(log.channels) == dict(first.channels)
        with part.open("rb") as stream:
            found = list(make_reader(stream, validate_crcs=True).iter_messages(topics=["/plant"]))
        assert [message.sequence for _, _, message in found] == list(range(begin, end + 1))
    assert number == 3
    assert log.results["rms"] == 0.25
    assert log.metadata["cosim.partial"]["status"] == "complete"
    assert "rms" not in first.results
    assert "cosim.partial" not in first.metadata


def test_parts_of_a_size_are_about_as_large(tmp_path, monkeypatch):
    """By one piece too large at most; without compression a piece has an eighth."""
    make_chunks_small(monkeypatch, 5_000)
    path = tmp_path / "run.mcap"
    record(path, steps=2000, rotation=Rotation(100_000, None, "100kB"), compression="none")
    sizes = [part.stat().st_size for part in parts_of(path)]
    assert len(sizes) > 2
    for size in sizes[:-1]:
        # The summary of so small chunks, and the end, come on top.
        assert 100_000 <= size < 100_000 * 9 / 8 + 20_000


def test_a_run_within_the_limit_leaves_an_ordinary_log(tmp_path):
    """As without it."""
    path = tmp_path / "run.mcap"
    record(path, steps=299, rotation=LATE)
    assert open_log(path).status == "complete"
    assert list(tmp_path.iterdir()) == [path]


def test_a_numbered_log_takes_no_name_with_parts(tmp_path):
    """These would be taken for its own."""
    (tmp_path / "run.part2.mcap").touch()
    record(tmp_path / "run.mcap", steps=400, numbered=True, rotation=LATE)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["run-2.mcap", "run-2.part2.mcap", "run.part2.mcap"]


def test_a_name_that_is_taken_meanwhile_is_an_error_at_the_write(tmp_path):
    """The file before is closed, and nothing is replaced."""
    path = tmp_path / "run.mcap"
    run = list(blocks(table(layout(), 600), 200))

    def go_on():
        with McapRecorder(path, rotation=LATE, flush=1e-3) as recorder:
            recorder.begin(plan())
            recorder.write(*run[0])
            (tmp_path / "run.part2.mcap").write_text("mine")
            recorder.write(*run[1])
            recorder.write(*run[2])

    with pytest.raises(LogWriteError, match=r"run\.part2\.mcap was created"):
        go_on()
    assert (open_log(path).status, open_log(path).steps) == ("partial", 299)
    assert (tmp_path / "run.part2.mcap").read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 2


def test_a_disk_that_is_full_at_the_rotation_is_an_error_at_the_write(tmp_path, monkeypatch):
    """The file that was written ends as that of a run that failed."""
    create = UnfinishedLog.create

    def refuse(self):
        if "part" in self.path.stem:
            raise OSError(28, "No space left on device")
        return create(self)

    monkeypatch.setattr(UnfinishedLog, "create", refuse)
    with pytest.raises(LogWriteError, match=r"run\.mcap cannot be written further: No space left"):
        record(tmp_path / "run.mcap", steps=1000, rotation=LATE)
    log = open_log(tmp_path / "run.mcap")
    assert (log.status, log.steps) == ("failed", 299)
    assert log.content_hash() == log.recorded_hash


def test_a_run_that_fails_in_a_later_part_has_the_failure_there(tmp_path):
    """And in the merged log."""
    path = tmp_path / "run.mcap"
    run = list(blocks(table(layout(), 800), 400))

    def fail():
        with McapRecorder(path, rotation=LATE) as recorder:
            recorder.begin(plan())
            recorder.write(*run[0])
            raise ValueError("boom")

    with pytest.raises(ValueError, match="boom"):
        fail()
    merged = merge(parts_of(path), tmp_path / "whole.mcap")
    assert (merged.status, merged.reason) == ("failed", "ValueError: boom")
    assert merged.steps == 400


def test_a_run_that_is_killed_leaves_closed_parts_and_a_whole_one(tmp_path):
    """Which knows its steps and its end, though its rows begin late, and messages come before."""
    path = tmp_path / "run.mcap"
    rows = table(layout(), 800)
    metadata = {"cosim.run": {"start_time": "0.0"}}
    with McapRecorder(path, metadata=metadata, rotation=LATE, flush=1e-3) as recorder:
        recorder.begin(plan())
        for block, signals in list(blocks(rows, 100))[:7]:
            recorder.write(block, signals)
        last_step = 0
        while last_step != 700:
            recorder.message(0, "info", "run", "waiting")
            with suppress(LogError):  # none there yet, or its rows have moved since it was opened
                last_step = open_log(tmp_path / "run.part3.mcap").steps
        left = [Path(copy(part, tmp_path / f"left{part.name[3:]}")) for part in parts_of(path)]
    assert [open_log(part).status for part in left] == ["partial", "partial", "unfinished"]
    last = open_log(left[2])
    assert (last.steps, last.end_ns) == (700, 700 * STEP_NS)
    merged = merge(left, tmp_path / "whole.mcap")
    assert (merged.status, merged.reason) == ("partial", "the part from 0.0 s to 0.7 s")
    assert same_bits(merged.rows("plant"), rows[:701, :5])


def test_every_file_has_room_for_rows(tmp_path):
    """Refused before the first row; nothing is left."""
    for rotation, message in [
        (Rotation(5_000, None, "5kB"), r"rotate: expected at least \d+B .*5kB"),
        (Rotation(None, 4 * STEP_NS, "4ms"), r"rotate: expected at least 0\.005 s.*4ms"),
    ]:
        with pytest.raises(UsageError, match=message):
            record(tmp_path / "run.mcap", steps=10, rotation=rotation)
    assert list(tmp_path.iterdir()) == []


def test_parts_of_an_earlier_run_are_refused_or_replaced(tmp_path):
    """With the log that they belong to, when the new one is there; other files stay."""
    path = tmp_path / "run.mcap"
    record(path, steps=1000, rotation=LATE)
    other = tmp_path / "run2.part2.mcap"
    other.touch()
    path.unlink()
    with pytest.raises(LogError, match=r"run\.part2\.mcap exists, .* earlier log"):
        record(path, steps=10)
    assert len(parts_of(path)) == 4
    record(path, steps=400, rotation=LATE, force=True)
    assert [part.name for part in parts_of(path)] == ["run.mcap", "run.part2.mcap"]
    record(path, steps=10, force=True)
    assert sorted(tmp_path.iterdir()) == [path, other]


def test_a_file_that_is_only_named_like_a_part_is_not_removed(tmp_path):
    """It may be anybody's; what is no log says nothing of being a part of one."""
    path = tmp_path / "run.mcap"
    record(path, steps=10)
    other = tmp_path / "run.part2.mcap"
    record(tmp_path / "other.mcap", steps=10)
    for content in (b"mine", (tmp_path / "other.mcap").read_bytes()):
        other.write_bytes(content)
        before = path.read_bytes(), other.read_bytes()
        with pytest.raises(LogError, match=r"run\.part2\.mcap is named like a part of .*run\.mcap"):
            record(path, steps=20, force=True)
        assert (path.read_bytes(), other.read_bytes()) == before


def test_the_log_of_a_run_that_writes_a_later_part_is_not_replaced(tmp_path):
    """Nobody writes to its first file any more."""
    path = tmp_path / "run.mcap"
    run = list(blocks(table(layout(), 800), 400))
    with McapRecorder(path, rotation=LATE, flush=1e-3) as recorder:
        recorder.begin(plan())
        recorder.write(*run[0])
        while not part_paths(tmp_path / "run.part2.mcap")[1].exists():
            recorder.message(0, "info", "run", "waiting")
        with pytest.raises(LogError, match=r"run\.part2\.mcap is being written by another run"):
            record(path, steps=10, force=True)
        recorder.write(*run[1])
    assert merge(parts_of(path), tmp_path / "whole.mcap").steps == 800


def test_sizes_and_times_are_read():
    """Sizes in powers of 10 or 2, times of the simulation."""
    limits = {
        "1GB": (10**9, None),
        "2.5 MB": (2_500_000, None),
        "4MiB": (2**22, None),
        "3000000B": (3_000_000, None),
        "0.002TB": (2 * 10**9, None),
        "1h": (None, 3600 * 10**9),
        "2min": (None, 120 * 10**9),
        "0.5s": (None, 5 * 10**8),
    }
    found = {text: read_rotation(text) for text in limits}
    assert {text: (read.size, read.span_ns) for text, read in found.items()} == limits


def test_other_limits_are_refused(subtests):
    """With what is expected."""
    for text, expected in [
        *((text, "a size in B, kB, .* GiB or a") for text in ("1 parsec", "1gb", "GB", "-1GB", 5)),
        ("10kB", "at least 1MB"),
        *((text, "nanoseconds > 0") for text in ("0s", "0.0000000001s", "999999999999h")),
    ]:
        match = rf"^rotate: expected .*{expected}.*got {text!r}"
        with subtests.test(case=text), pytest.raises(UsageError, match=match):
            read_rotation(text)
