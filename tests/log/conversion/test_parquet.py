"""Logs as Parquet files, read back bit for bit by pyarrow."""

from __future__ import annotations

import sys

import pyarrow.parquet
import pytest

from cosim.errors import UsageError
from cosim.log.conversion import convert
from cosim.log.text import LogChoice
from tests.log.recordings import same_bits


def test_parquet_reads_back_bit_for_bit(recorded, tmp_path):
    """Every NaN with its bits; null where a component has no row; units beside the columns."""
    log, rows = recorded
    convert(LogChoice.of(log), tmp_path / "a.parquet")
    read = pyarrow.parquet.read_table(tmp_path / "a.parquet")
    assert same_bits(read["t"].to_numpy(), log.t)
    assert read.schema.field("t").metadata == {b"unit": b"s"}
    assert read.schema.field("plant.u").metadata == {
        b"unit": b"m/s",
        b"role": b"input",
        b"variability": b"continuous",
        b"type": b"real",
    }
    assert b"unit" not in read.schema.field("plant.n").metadata
    for column in LogChoice.of(log).columns:
        period = log.channels[column.component].period
        values = read[column.name]
        assert values.null_count == 401 - len(range(0, 401, period))
        start = log.channels[column.component].start
        kept = values.drop_null().to_numpy()
        assert same_bits(kept, rows[::period, start + column.column])


def test_parquet_without_pyarrow_names_it(recorded, tmp_path, monkeypatch):
    """Before anything is written."""
    log, _ = recorded
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError, match=r"Parquet files need pyarrow, .* -e '\.\[parquet\]'"):
        convert(LogChoice.of(log), tmp_path / "a.parquet")
    assert not (tmp_path / "a.parquet").exists()
