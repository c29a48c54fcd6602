"""Parts of an earlier log are replaced with it; files that only have such names stay."""

from __future__ import annotations

import pytest

from cosim.errors import LogError
from cosim.log import McapRecorder
from cosim.log.files import part_paths
from cosim.log.spans import merge
from tests.log.recordings import (
    LATE,
    blocks,
    layout,
    parts_of,
    plan,
    record,
    table,
)


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
