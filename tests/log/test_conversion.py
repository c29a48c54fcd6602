"""Logs as files of other formats, read back bit for bit by the readers of these."""

from __future__ import annotations

import csv
import json
import sys
from decimal import Decimal
from itertools import count, islice

import numpy as np
import pyarrow.parquet
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import loadmat
from scipy.io.matlab import MatWriteError

import cosim
from cosim.core.recorders import Memory
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import LogError, UnknownSignalError, UsageError
from cosim.log import open_log
from cosim.log.conversion import ENDINGS, convert
from cosim.log.text import LogChoice, choose, exact_seconds, table_text
from cosim.scenario.data_files.field_file import read_field_data
from tests.log.recordings import STEP_NS, layout, record, same_bits, table

SLICES = {
    "plant.u": (slice(0, 1), 1),
    "plant.x_a": (slice(1, 3), 1),
    "plant.der(x)": (slice(3, 4), 1),
    "plant.n": (slice(4, 5), 1),
    "identifier.y": (slice(5, 8), 5),
    "identifier.theta": (slice(8, 10), 5),
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return a log whose slower component has every fifth row, and its rows."""
    path = tmp_path_factory.mktemp("recorded") / "a.mcap"
    rows = record(path, steps=400)
    return open_log(path), rows


def expected(rows, name):
    columns, period = SLICES[name]
    return rows[::period, columns]


def one_nan(values):
    """Return values with one NaN for all: text has only one."""
    return np.where(np.isnan(values), np.nan, values)


def text_of(choice, name="csv"):
    """Return a table as text."""
    return "".join(table_text(choice, name))


# --- every number ---


def test_npz_reads_back_bit_for_bit(recorded, tmp_path):
    """Every signal with the instants of its component, without pickles; equal logs, equal files."""
    log, rows = recorded
    for name in ("a.npz", "b.npz"):
        convert(LogChoice.of(log), tmp_path / name)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
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


def test_mat_reads_back_bit_for_bit(recorded, tmp_path):
    """Under names that MATLAB allows, with the names of the log beside them."""
    log, rows = recorded
    convert(LogChoice.of(log), tmp_path / "a.mat")
    read = loadmat(tmp_path / "a.mat", chars_as_strings=True)
    entries = [
        {key: own[key].item() if own[key].size else "" for key in own.dtype.names}
        for own in read["signals"][:, 0]
    ]
    assert [own["name"] for own in entries] == list(log)
    for own in entries:
        assert same_bits(read[own["variable"]], expected(rows, own["name"]))
        assert same_bits(read[own["time"]][:, 0], log.time(own["name"]))
    assert [own["unit"] for own in entries[:2]] == ["m/s", ""]
    assert entries[2]["variable"] == "plant_der_x_"


def test_parquet_reads_back_bit_for_bit(recorded, tmp_path):
    """Every NaN with its bits; null where a component has no row; units beside the columns."""
    log, rows = recorded
    convert(LogChoice.of(log), tmp_path / "a.parquet")
    read = pyarrow.parquet.read_table(tmp_path / "a.parquet")
    assert same_bits(read["t"].to_numpy(), log.t)
    assert read.schema.field("t").metadata == {b"unit": b"s"}
    about = {b"role": b"input", b"variability": b"continuous", b"type": b"real"}
    assert read.schema.field("plant.u").metadata == {b"unit": b"m/s"} | about
    assert b"unit" not in read.schema.field("plant.n").metadata
    for column in LogChoice.of(log).columns:
        period = log.channels[column.component].period
        values = read[column.name]
        assert values.null_count == 401 - len(range(0, 401, period))
        start = log.channels[column.component].start
        assert same_bits(values.drop_null().to_numpy(), rows[::period, start + column.column])


def test_csv_reads_back_bit_for_bit(recorded, tmp_path):
    """Every number; of NaN that it is one. Cells are empty where a component has no row."""
    log, rows = recorded
    convert(choose(log, ["plant.*,identifier.y[1]"], 0.1, 0.2), tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="", encoding="utf-8") as stream:
        header, *lines = csv.reader(stream)
    names = ["plant.u [m/s]", "plant.x_a[0]", "plant.x_a[1]", "plant.der(x) [1]", "plant.n"]
    assert header == ["t [s]", *names, "identifier.y[1]"]
    values = np.array([[float(cell) for cell in line[:6]] for line in lines])
    assert same_bits(values[:, 0], log.time("plant")[100:201])
    assert same_bits(one_nan(values[:, 1:]), one_nan(rows[100:201, :5]))
    assert [number for number, line in enumerate(lines) if line[6]] == list(range(0, 101, 5))
    assert [float(line[6]) for line in lines if line[6]] == rows[100:201:5, 6].tolist()


def test_json_lines_read_back_bit_for_bit(tmp_path):
    """What is missing is no key; what JSON has no number for is text, as protobuf writes it."""
    rows = table(layout(), 50)
    rows[:3, 0] = [np.nan, np.inf, -np.inf]
    record(tmp_path / "a.mcap", rows=rows)
    log = open_log(tmp_path / "a.mcap")
    entries = [
        json.loads(line, parse_constant=pytest.fail)
        for line in text_of(LogChoice.of(log), "jsonl").splitlines()
    ]
    assert len(entries) == 51
    for number, entry in enumerate(entries):
        values = np.array([float(value) for value in list(entry.values())[1:]])
        width = 5 if number % 5 else 10
        assert same_bits(one_nan(values), one_nan(rows[number, :width]))
        assert entry["t"] == number * STEP_NS / 1e9
    assert [own["plant.u"] for own in entries[:3]] == ["NaN", "Infinity", "-Infinity"]


@given(st.integers(0, 2**63 - 1))
def test_times_are_exact_decimals(time_ns):
    """Of all times that a log can have; their doubles are the times of a log."""
    (text,) = exact_seconds(np.array([time_ns]))
    assert Decimal(text).scaleb(9) == time_ns
    assert "e" not in text.lower()
    if time_ns < 2**53:
        assert float(text) == time_ns / 1e9


# --- what the signals are ---


@pytest.mark.parametrize("ending", ENDINGS)
def test_each_column_has_what_is_known_of_its_element(tmp_path, ending):
    """Its unit, the description and role where the format has a place; of arrays side by side."""
    text = """
        scenario = { name = "a", stop = 0.1, step = 0.1 }
        components.c = { kind = "constant", value = [1.0, 2.0], unit = { y = ["mm", "m/s"] } }
        components.b = { kind = "lag", time_constant = 1.0 }
        connections."b.u" = "c.y[0]"
    """
    (tmp_path / "a.toml").write_text(text)
    log = cosim.run(tmp_path / "a.toml", out=tmp_path / "a.mcap")
    assert log.signals["c.y"].unit == ("mm", "m/s")
    assert log.to_xarray("c.y")["c.y"].attrs["units"] == "mm, m/s"
    assert log.to_xarray("c.y[1]")["c.y[1]"].attrs["units"] == "m/s"
    assert log.to_xarray()["b.u"].attrs["role"] == log.signals["b.u"].role == "input"
    assert "<td>mm, m/s</td>" in log._repr_html_()
    choice = LogChoice.of(log, ["c.y", "b.u"])
    path = tmp_path / f"a{ending}"
    convert(choice, path)
    about = {name: port.described for name, port in choice.selection.items()}
    match ending:
        case ".csv":
            assert path.read_text().startswith("t [s],c.y[0] [mm],c.y[1] [m/s],b.u")
        case ".parquet":
            schema = pyarrow.parquet.read_table(path).schema
            units = [schema.field(i).metadata[b"unit"] for i in range(3)]
            assert units == [b"s", b"mm", b"m/s"]
            assert schema.field("b.u").metadata[b"role"] == b"input"
        case ".npz":
            with np.load(path) as arrays:
                told = json.loads(str(arrays["signals"]))
            assert (told["c.y"]["unit"], told["b.u"]["role"]) == ("mm, m/s", "input")
        case ".mat":
            told = loadmat(path)["signals"][:, 0]
            assert (told[0]["unit"].item(), told[1]["role"].item()) == ("mm, m/s", "input")
            for own, signal in zip(told, about.values(), strict=True):
                assert "".join(own["description"].tolist()) == signal.description
    if ending in (".csv", ".parquet"):
        assert read_field_data(path).signals[0].unit == ("mm", "m/s")


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
    with Memory() as memory:
        memory.begin(Plan(Layout(channels), STEP_NS, {}, {}, ()))
    convert(LogChoice.of(memory), tmp_path / "a.mat")
    read = loadmat(tmp_path / "a.mat")
    variables = [str(entry["variable"].item()) for entry in read["signals"][:, 0]]
    assert len(set(variables)) == len(names) + 2
    assert all(name.isidentifier() and name.isascii() and len(name) <= 63 for name in variables)
    assert set(variables) < set(read)


class Endless:
    """A run that never ends, of one component with some signals."""

    label = "endless"
    step_ns = 1

    def __init__(self, *names):
        interface = Interface((), tuple(Signal(name) for name in names))
        self.channels = {"c": Channel("c", interface, 0)}

    def blocks_of(self, components):
        for number in count():
            yield "c", np.arange(1000) + 1000 * number, np.zeros((1000, 2))


def test_rows_are_text_as_they_come():
    """No more is read than is asked for; names with commas and quotes are quoted as CSV has it."""
    choice = LogChoice.of(Endless("m[1,2]", 'say "x"'))
    for name in ("csv", "jsonl"):
        text = "".join(islice(table_text(choice, name), 10))
        assert len(text.splitlines()) > 5000
    assert next(csv.reader([next(table_text(choice, "csv"))])) == ["t [s]", "c.m[1,2]", 'c.say "x"']
    with pytest.raises(UsageError, match=r"--format.*'json'.*did you mean 'jsonl'\?.*: csv"):
        table_text(choice, "json")


# --- files ---


def test_a_choice_of_unknown_signals_or_no_time_is_refused(recorded):
    """Before a file is begun."""
    log, _ = recorded
    with pytest.raises(UnknownSignalError, match=r"'x\.\*'"):
        choose(log, ["x.*"], None, None)
    with pytest.raises(UsageError, match=r"--(from|to).*--(from|to)"):
        choose(log, None, 2.0, 1.0)


def test_a_window_without_rows_is_a_file(recorded, tmp_path):
    """Of the same signals; no reader stumbles."""
    log, _ = recorded
    empty = LogChoice.of(log.window(5.0, 6.0))
    for ending in ENDINGS:
        convert(empty, tmp_path / f"a{ending}")
    with np.load(tmp_path / "a.npz") as read:
        assert read["plant.x_a"].shape == (0, 2)
    assert loadmat(tmp_path / "a.mat")["plant_x_a"].size == 0
    assert pyarrow.parquet.read_table(tmp_path / "a.parquet").num_rows == 0
    assert len((tmp_path / "a.csv").read_text().splitlines()) == 1
    assert text_of(empty, "jsonl") == ""


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


def test_what_cannot_be_written_is_refused(recorded, tmp_path, monkeypatch):
    """Other formats, too large arrays, a full disk, no pyarrow; nothing is left of them."""
    log, _ = recorded
    choice = LogChoice.of(log)
    for name, found in (("a.xlsx", r"'\.xlsx'"), ("a", "none")):
        match = rf"{name}: expected .*\.csv, \.parquet, \.mat, \.npz, got {found}"
        with pytest.raises(UsageError, match=match):
            convert(choice, tmp_path / name)

    def refuse(error):
        def fail(*_, **__):
            raise error

        return fail

    full = OSError(28, "No space left on device")
    monkeypatch.setattr("cosim.log.conversion.write_array", refuse(full))
    with pytest.raises(LogError, match=r"a\.npz cannot be written: No space left on device"):
        convert(choice, tmp_path / "a.npz")
    large = MatWriteError("Matrix too large to save with Matlab 5 format")
    monkeypatch.setattr("scipy.io.savemat", refuse(large))
    with pytest.raises(UsageError, match=r"4 GB .*\(Matrix too large.*use npz"):
        convert(choice, tmp_path / "a.mat")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError, match=r"Parquet files need pyarrow, .* -e '\.\[parquet\]'"):
        convert(choice, tmp_path / "a.parquet")
    assert list(tmp_path.iterdir()) == []
    convert(choice, tmp_path / "missing" / "a.csv" / "c.csv")  # folders that are missing are made
    assert (tmp_path / "missing" / "a.csv" / "c.csv").is_file()
