"""Logs as files of other formats, read back bit for bit by the readers of these."""

from __future__ import annotations

import csv
import json

import numpy as np
import pyarrow.parquet
import pytest
from scipy.io import loadmat

import cosim
from cosim.errors import LogError, UsageError
from cosim.log import open_log
from cosim.log.conversion import ENDINGS, convert
from cosim.log.text import LogChoice, choose
from cosim.scenario.data_files.field_file import read_field_data
from tests.log.recordings import record


def test_descriptions_are_kept_where_the_format_has_a_place(tmp_path):
    """Beside the units."""
    run = cosim.run("academic", set={"scenario.stop": 0.01})
    text = run.signals["observer.delta"].description
    assert text
    choice = LogChoice.of(run, "observer.delta")
    for ending in (".parquet", ".npz", ".mat"):
        convert(choice, tmp_path / f"a{ending}")
    read = pyarrow.parquet.read_table(tmp_path / "a.parquet")
    assert read.schema.field("observer.delta").metadata[b"description"] == text.encode()
    with np.load(tmp_path / "a.npz") as arrays:
        assert json.loads(str(arrays["signals"]))["observer.delta"]["description"] == text
    assert loadmat(tmp_path / "a.mat")["signals"][0, 0]["description"].item() == text


def test_each_column_has_the_unit_of_its_element(tmp_path):
    """In every format; of an array the units stand side by side. The log has them too."""
    text = """
        scenario = { name = "a", stop = 0.1, step = 0.1 }
        components.c = { kind = "constant", value = [1.0, 2.0], unit = { y = ["mm", "m/s"] } }
    """
    (tmp_path / "a.toml").write_text(text)
    log = cosim.run(tmp_path / "a.toml", out=tmp_path / "a.mcap")
    assert log.signals["c.y"].unit == ("mm", "m/s")
    assert log.to_xarray("c.y")["c.y"].attrs["units"] == "mm, m/s"
    assert log.to_xarray("c.y[1]")["c.y[1]"].attrs["units"] == "m/s"
    assert "<td>mm, m/s</td>" in log._repr_html_()
    choice = LogChoice.of(log)
    for ending in ENDINGS:
        convert(choice, tmp_path / f"a{ending}")
    assert (tmp_path / "a.csv").read_text().splitlines()[0] == "t [s],c.y[0] [mm],c.y[1] [m/s]"
    schema = pyarrow.parquet.read_table(tmp_path / "a.parquet").schema
    assert [schema.field(i).metadata[b"unit"] for i in range(3)] == [b"s", b"mm", b"m/s"]
    with np.load(tmp_path / "a.npz") as arrays:
        assert json.loads(str(arrays["signals"]))["c.y"]["unit"] == "mm, m/s"
    assert loadmat(tmp_path / "a.mat")["signals"][0, 0]["unit"].item() == "mm, m/s"
    layout = json.loads(log.attachment("viewer-layout.json"))
    labels = [panel["yAxisLabel"] for panel in layout["configById"].values()]
    assert labels == ["mm", "m/s"]
    for ending in (".csv", ".parquet"):
        (signal,) = read_field_data(tmp_path / f"a{ending}").signals
        assert (signal.name, signal.unit) == ("c.y", ("mm", "m/s"))


def test_csv_has_the_rows_that_are_chosen(recorded, tmp_path):
    """Those of a window, of signals by pattern."""
    log, rows = recorded
    convert(choose(log, ["*.y", "plant.u,plant.n"], 0.1, 0.2), tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="", encoding="utf-8") as stream:
        header, *lines = csv.reader(stream)
    assert header[1:] == [*(f"identifier.y[{i}]" for i in range(3)), "plant.u [m/s]", "plant.n"]
    assert len(lines) == 101
    assert [float(line[4]) for line in lines] == rows[100:201, 0].tolist()


def test_a_window_without_rows_is_a_file(recorded, tmp_path):
    """Of the same signals; no reader stumbles."""
    log, _ = recorded
    for ending in ENDINGS:
        convert(LogChoice.of(log.window(5.0, 6.0)), tmp_path / f"a{ending}")
    with np.load(tmp_path / "a.npz") as read:
        assert read["plant.x_a"].shape == (0, 2)
    assert loadmat(tmp_path / "a.mat")["plant_x_a"].size == 0
    assert pyarrow.parquet.read_table(tmp_path / "a.parquet").num_rows == 0
    assert len((tmp_path / "a.csv").read_text().splitlines()) == 1


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_file_that_exists_is_not_replaced_unless_asked(tmp_path, ending):
    """Nor touched where the conversion fails; nothing else is left in the folder."""
    record(tmp_path / "a.mcap", steps=50)
    log = open_log(tmp_path / "a.mcap")
    out = tmp_path / f"a{ending}"
    out.write_bytes(b"mine")
    with pytest.raises(LogError, match=r"exists; .* force=True"):
        convert(LogChoice.of(log), out)
    broken = LogChoice.of(log)
    (tmp_path / "a.mcap").write_bytes(b"")  # the log has changed: its rows cannot be read
    with pytest.raises(LogError, match="has changed since it was opened"):
        convert(broken, out, force=True)
    assert out.read_bytes() == b"mine"
    record(tmp_path / "a.mcap", steps=20, force=True)
    convert(LogChoice.of(open_log(tmp_path / "a.mcap")), out, force=True)
    assert out.read_bytes() != b"mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["a.mcap", out.name])


def test_files_of_other_formats_are_refused(recorded, tmp_path):
    """Folders that are missing are made, as for logs."""
    log, _ = recorded
    for name, found in (("a.xlsx", r"'\.xlsx'"), ("a", "none")):
        match = rf"{name}: expected .*\.csv, \.parquet, \.mat, \.npz, got {found}"
        with pytest.raises(UsageError, match=match):
            convert(LogChoice.of(log), tmp_path / name)
    convert(LogChoice.of(log), tmp_path / "missing" / "a.csv" / "c.csv")
    assert (tmp_path / "missing" / "a.csv" / "c.csv").is_file()


def test_a_full_disk_is_reported(recorded, tmp_path, monkeypatch):
    """And nothing is left."""
    log, _ = recorded

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("cosim.log.conversion.write_npz", fail)
    with pytest.raises(LogError, match=r"a\.npz cannot be written: No space left on device"):
        convert(LogChoice.of(log), tmp_path / "a.npz")
    assert list(tmp_path.iterdir()) == []


def test_a_connected_input_has_the_role_input_in_every_format(tmp_path):
    """Also of a component that declares no roles; files, tables and the log say so."""
    file = tmp_path / "lag.toml"
    file.write_text(
        'scenario = { name = "lag", stop = 1.0, step = 0.1 }\n[components]\n'
        'a = { kind = "constant", value = 1.0 }\nb = { kind = "lag", time_constant = 1.0 }\n'
        '[connections]\n"b.u" = "a.y"\n'
    )
    log = cosim.run(file, out=tmp_path / "a.mcap")
    assert {name: signal.role for name, signal in log.signals.items()} == {
        "a.y": "output",
        "b.u": "input",
        "b.y": "state",
    }
    convert(LogChoice.of(log), tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as read:
        assert json.loads(str(read["signals"]))["b.u"]["role"] == "input"
    convert(LogChoice.of(log), tmp_path / "a.parquet")
    read = pyarrow.parquet.read_table(tmp_path / "a.parquet")
    assert read.schema.field("b.u").metadata[b"role"] == b"input"
    assert log.to_xarray()["b.u"].attrs["role"] == "input"
