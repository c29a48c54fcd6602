"""The hash of a signal covers the times and bits of its rows, and nothing else."""

import hashlib
import struct

import pytest

from cosim.errors import UnknownSignalError
from cosim.log import open_log
from tests.log.recordings import STEP_NS, layout, record, table


def test_the_hash_of_a_signal_is_that_of_its_times_and_doubles(tmp_path):
    """As anybody may compute it: SHA-256 of int64 and doubles, little-endian, row by row."""
    rows = record(tmp_path / "a.mcap", steps=40)
    hashes = open_log(tmp_path / "a.mcap").signal_hashes()
    assert list(hashes) == list(open_log(tmp_path / "a.mcap"))
    for name, first, size, period in [("plant.x_a", 1, 2, 1), ("identifier.y", 5, 3, 5)]:
        digest = hashlib.sha256()
        for k in range(0, 41, period):
            digest.update(struct.pack(f"<q{size}d", k * STEP_NS, *rows[k, first : first + size]))
        assert hashes[name] == digest.hexdigest()


def test_it_does_not_depend_on_compression_and_blocks(tmp_path):
    """Two files with other bytes have equal hashes."""
    rows = table(layout(), 300)
    record(tmp_path / "a.mcap", rows=rows, size=7)
    record(tmp_path / "b.mcap", rows=rows, compression="none")
    assert (tmp_path / "a.mcap").read_bytes() != (tmp_path / "b.mcap").read_bytes()
    hashes = open_log(tmp_path / "a.mcap").signal_hashes()
    assert hashes == open_log(tmp_path / "b.mcap").signal_hashes()


def test_one_bit_changes_the_hash_of_its_signal_only(tmp_path):
    """Minus zero is not zero."""
    rows = table(layout(), 50)
    rows[20, 2] = 0.0
    record(tmp_path / "a.mcap", rows=rows)
    rows[20, 2] = -0.0
    record(tmp_path / "b.mcap", rows=rows)
    a = open_log(tmp_path / "a.mcap").signal_hashes()
    b = open_log(tmp_path / "b.mcap").signal_hashes()
    assert [name for name in a if a[name] != b[name]] == ["plant.x_a"]


def test_equal_signals_have_one_hash(tmp_path):
    """Whatever they are called; elements are chosen as everywhere."""
    rows = table(layout(), 50)
    rows[:, 2] = rows[:, 1]
    record(tmp_path / "a.mcap", rows=rows)
    log = open_log(tmp_path / "a.mcap")
    hashes = log.signal_hashes(["plant.x_a[0]", "plant.x_a[1]", "plant.u"])
    assert hashes["plant.x_a[0]"] == hashes["plant.x_a[1]"] != hashes["plant.u"]
    with pytest.raises(UnknownSignalError, match=r"'nothing\.\*'"):
        log.signal_hashes("nothing.*")
