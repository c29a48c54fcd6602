"""Logs as files of other formats, read back bit for bit by the readers of these."""

from __future__ import annotations

import csv
import json
import sys

import numpy as np
import pyarrow.parquet
import pytest
from scipy.io import loadmat
from scipy.io.matlab import MatWriteError

import cosim
from cosim.core.recorders import Memory
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import LogError, UnknownSignalError, UsageError
from cosim.log import open_log
from cosim.log.conversion.choice import LogChoice, choose
from cosim.log.conversion.files import ENDINGS, convert
from tests.log.recordings import STEP_NS, record, same_bits

SLICES = {
    "plant.u": (slice(0, 1), 1),
    "plant.x_a": (slice(1, 3), 1),
    "plant.der(x)": (slice(3, 4), 1),
    "plant.n": (slice(4, 5), 1),
    "identifier.y": (slice(5, 8), 5),
    "identifier.theta": (slice(8, 10), 5),
}


@pytest.fixture
def recorded(tmp_path):
    """Return a log whose slower component has every fifth row, and its rows."""
    rows = record(tmp_path / "a.mcap", steps=400)
    return open_log(tmp_path / "a.mcap"), rows


def expected(rows, name):
    columns, period = SLICES[name]
    return rows[::period, columns]


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


def test_npz_reads_back_bit_for_bit(recorded, tmp_path):
    """Every signal with the instants of its component, without pickles."""
    log, rows = recorded
    convert(LogChoice.of(log), tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as read:
        assert set(read) == {"signals", "t:plant", "t:identifier", *log}
        for name in log:
            assert same_bits(read[name].reshape(len(read[name]), -1), expected(rows, name))
            assert same_bits(read[name], log[name])
        assert same_bits(read["t:identifier"], log.time("identifier"))
        about = json.loads(str(read["signals"]))
    assert list(about) == list(log)
    assert about["plant.u"]["unit"] == "m/s"
    assert about["plant.x_a"] == {"role": "state", "variability": "continuous", "type": "real"}


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


def test_equal_logs_give_equal_npz_files(recorded, tmp_path):
    """No date of today is in them."""
    log, _ = recorded
    convert(LogChoice.of(log), tmp_path / "a.npz")
    convert(LogChoice.of(log), tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_mat_reads_back_bit_for_bit(recorded, tmp_path):
    """Under names that MATLAB allows, with the names of the log beside them."""
    log, rows = recorded
    convert(LogChoice.of(log), tmp_path / "a.mat")
    read = loadmat(tmp_path / "a.mat", chars_as_strings=True)
    entries = read["signals"]
    assert entries.shape == (6, 1)
    originals = [str(entry["name"].item()) for entry in entries[:, 0]]
    assert originals == list(log)
    for entry, name in zip(entries[:, 0], originals, strict=True):
        variable = str(entry["variable"].item())
        assert variable.isidentifier()
        assert variable.isascii()
        assert same_bits(read[variable], expected(rows, name))
        times = read[str(entry["time"].item())]
        assert same_bits(times[:, 0], log.time(name))
    assert str(entries[0, 0]["unit"].item()) == "m/s"
    assert entries[1, 0]["unit"].size == 0
    assert str(entries[2, 0]["variable"].item()) == "plant_der_x_"


def test_names_that_are_no_variables_stay_apart(tmp_path):
    """Long ones too, those that begin with a digit, and those that the file has itself."""
    stem = "n" * 70
    names = ["a b", "a_b", "a.b", f"{stem}1", f"{stem}2", "ü"]
    interface = Interface((), tuple(Signal(name) for name in names))
    others = Interface((), (Signal("1"),))
    channels = (
        Channel("1", interface, 0),
        Channel("t", others, len(names)),
        Channel("t_1", others, len(names) + 1),
    )
    plan = Plan(Layout(channels), STEP_NS, {}, {}, ())
    with Memory() as memory:
        memory.begin(plan)
    convert(LogChoice.of(memory), tmp_path / "a.mat")
    read = loadmat(tmp_path / "a.mat")
    variables = [str(entry["variable"].item()) for entry in read["signals"][:, 0]]
    assert len(set(variables)) == len(names) + 2
    assert all(name.isidentifier() and name.isascii() and len(name) <= 63 for name in variables)
    assert set(variables) < set(read)


def test_csv_has_the_rows_that_are_chosen(recorded, tmp_path):
    """Those of a window, of signals by pattern."""
    log, rows = recorded
    convert(choose(log.path, ["*.y", "plant.u,plant.n"], 0.1, 0.2), tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="", encoding="utf-8") as stream:
        header, *lines = csv.reader(stream)
    assert header[1:] == [*(f"identifier.y[{i}]" for i in range(3)), "plant.u [m/s]", "plant.n"]
    assert len(lines) == 101
    assert [float(line[4]) for line in lines] == rows[100:201, 0].tolist()


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_window_without_rows_is_a_file(recorded, tmp_path, ending):
    """Of the same signals; no reader stumbles."""
    log, _ = recorded
    out = tmp_path / f"a{ending}"
    convert(LogChoice.of(log.window(5.0, 6.0)), out)
    match ending:
        case ".npz":
            with np.load(out) as read:
                assert read["plant.x_a"].shape == (0, 2)
        case ".mat":
            assert loadmat(out)["plant_x_a"].size == 0
        case ".parquet":
            assert pyarrow.parquet.read_table(out).num_rows == 0
        case _:
            assert len(out.read_text().splitlines()) == 1


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_file_that_exists_is_not_replaced_unless_asked(recorded, tmp_path, ending):
    """Nor touched where the conversion fails; nothing else is left in the folder."""
    log, _ = recorded
    out = tmp_path / f"a{ending}"
    out.write_bytes(b"mine")
    with pytest.raises(LogError, match=r"exists; choose another path, or force=True to replace it"):
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


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.xlsx", r"found the ending '\.xlsx'; needed one of \.csv, \.parquet, \.mat, \.npz"),
        ("a", "found no ending; needed one of"),
        ("missing/a.csv/b.npz/c.csv", None),
    ],
)
def test_what_is_no_place_for_a_file_is_refused(recorded, tmp_path, name, text):
    """Folders that are missing are made, as for logs."""
    log, _ = recorded
    if text is None:
        convert(LogChoice.of(log), tmp_path / name)
        assert (tmp_path / name).is_file()
        return
    with pytest.raises(UsageError, match=text):
        convert(LogChoice.of(log), tmp_path / name)


def test_parquet_without_pyarrow_names_it(recorded, tmp_path, monkeypatch):
    """Before anything is written."""
    log, _ = recorded
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError, match=r"Parquet files need pyarrow, .* -e '\.\[parquet\]'"):
        convert(LogChoice.of(log), tmp_path / "a.parquet")
    assert not (tmp_path / "a.parquet").exists()


def test_an_array_that_is_too_large_for_mat_names_another_format(recorded, tmp_path, monkeypatch):
    """The format counts its bytes in 32 bits."""
    log, _ = recorded

    def refuse(*_, **__):
        raise MatWriteError("Matrix too large to save with Matlab 5 format")

    monkeypatch.setattr("scipy.io.savemat", refuse)
    with pytest.raises(UsageError, match=r"less than 4 GB an array \(Matrix too large.*use npz"):
        convert(LogChoice.of(log), tmp_path / "a.mat")
    assert not (tmp_path / "a.mat").exists()


def test_a_full_disk_is_said(recorded, tmp_path, monkeypatch):
    """And nothing is left."""
    log, _ = recorded

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("cosim.log.conversion.files.write_npz", fail)
    with pytest.raises(LogError, match=r"a\.npz cannot be written: No space left on device"):
        convert(LogChoice.of(log), tmp_path / "a.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_a_choice_of_what_is_not_there_is_refused(recorded):
    """Before a file is begun."""
    log, _ = recorded
    with pytest.raises(UnknownSignalError, match=r"no signal matches 'x\.\*'"):
        choose(log.path, ["x.*"], None, None)
    with pytest.raises(UsageError, match=r"found --from = 2\.0 s after --to = 1\.0 s"):
        choose(log.path, None, 2.0, 1.0)


def test_an_input_is_one_to_a_reader(tmp_path):
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
