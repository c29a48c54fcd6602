"""Tables as CSV and JSON Lines, read back by the readers of the standard library."""

from __future__ import annotations

import csv
import io
import json
from decimal import Decimal
from itertools import count, islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.core.signals import Channel, Interface, Signal
from cosim.errors import UsageError
from cosim.log import open_log
from cosim.log.text import LogChoice, exact_seconds, table_text
from cosim.scenario.data_files.field_file import read_field_data
from tests.log.recordings import STEP_NS, layout, record, same_bits, table


def one_nan(values):
    """Return values with one NaN for all: text has only one."""
    return np.where(np.isnan(values), np.nan, values)


def test_csv_reads_back_bit_for_bit(recorded):
    """Every number, minus zero and infinities too; of NaN that it is one."""
    log, rows = recorded
    text = "".join(table_text(LogChoice.of(log, "plant.*"), "csv"))
    header, *lines = csv.reader(io.StringIO(text, newline=""))
    assert header == [
        "t [s]",
        "plant.u [m/s]",
        "plant.x_a[0]",
        "plant.x_a[1]",
        "plant.der(x) [1]",
        "plant.n",
    ]
    values = np.array([[float(cell) for cell in line] for line in lines])
    assert same_bits(one_nan(values[:, 1:]), one_nan(rows[:, :5]))
    assert same_bits(values[:, 0], log.time("plant"))


def test_a_component_without_a_row_has_empty_cells(recorded):
    """All rows of the slower one are there, and nothing between."""
    log, rows = recorded
    text = "".join(table_text(LogChoice.of(log, ["identifier.y[1]", "plant.u"]), "csv"))
    lines = list(csv.reader(io.StringIO(text, newline="")))[1:]
    slow = [line[1] for line in lines]
    assert [number for number, cell in enumerate(slow) if cell] == list(range(0, 401, 5))
    kept = np.array([float(cell) for cell in slow if cell])
    assert same_bits(one_nan(kept), one_nan(rows[::5, 6]))


def test_names_with_commas_and_quotes_are_quoted():
    """As CSV has it."""
    run = Endless(["m[1,2]", 'say "x"'])
    first = next(table_text(LogChoice.of(run), "csv"))
    assert next(csv.reader([first])) == ["t [s]", "c.m[1,2]", 'c.say "x"']


def test_json_lines_read_back_bit_for_bit(recorded):
    """What is missing is no key; what JSON has no number for is text."""
    log, rows = recorded
    lines = "".join(table_text(LogChoice.of(log), "jsonl")).splitlines()
    entries = [json.loads(line, parse_constant=pytest.fail) for line in lines]
    assert len(entries) == 401
    for number, entry in enumerate(entries):
        has_slow = number % 5 == 0
        assert ("identifier.theta[0]" in entry) == has_slow
        values = np.array([float(value) for value in list(entry.values())[1:]])
        width = 10 if has_slow else 5
        assert same_bits(one_nan(values), one_nan(rows[number, :width]))
        assert entry["t"] == number * STEP_NS / 1e9


def test_json_lines_name_what_is_no_number(tmp_path):
    """As the JSON of protobuf does."""
    rows = table(layout(), 20)
    rows[:3, 0] = [np.nan, np.inf, -np.inf]
    record(tmp_path / "a.mcap", rows=rows)
    text = "".join(table_text(LogChoice.of(open_log(tmp_path / "a.mcap"), "plant.u"), "jsonl"))
    assert text.splitlines()[:3] == [
        '{"t": 0.0, "plant.u": "NaN"}',
        '{"t": 0.001, "plant.u": "Infinity"}',
        '{"t": 0.002, "plant.u": "-Infinity"}',
    ]


@given(st.integers(0, 2**63 - 1))
def test_times_are_exact_decimals(time_ns):
    """Of all times that a log can have; their doubles are the times of a log."""
    (text,) = exact_seconds(np.array([time_ns]))
    assert Decimal(text).scaleb(9) == time_ns
    assert "e" not in text.lower()
    if time_ns < 2**53:
        assert float(text) == time_ns / 1e9


class Endless:
    """A run that never ends, of one component with some signals."""

    label = "endless"

    def __init__(self, names):
        interface = Interface((), tuple(Signal(name) for name in names))
        self.channels = {"c": Channel("c", interface, 0)}
        self._width = len(names)

    step_ns = 1

    def blocks_of(self, components):
        for number in count():
            times = np.arange(1000) + 1000 * number
            yield "c", times, np.full((1000, self._width), float(number))


def test_rows_are_text_as_they_come():
    """No more is read than is asked for: the memory that this takes is bounded."""
    for name in ("csv", "jsonl"):
        text = "".join(islice(table_text(LogChoice.of(Endless(["x"])), name), 10))
        assert len(text.splitlines()) > 5000


def test_a_table_is_read_as_samples(recorded, tmp_path):
    """With the units of its first line, by what reads tables of samples here."""
    log, rows = recorded
    window = log.window(0.1, 0.2)
    text = "".join(table_text(LogChoice.of(window, ["plant.u", "identifier.y"]), "csv"))
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    data = read_field_data(tmp_path / "a.csv")
    found = {signal.name: signal for signal in data.signals}
    assert found["plant.u"].unit == "m/s"
    assert same_bits(found["plant.u"].values[:, 0], rows[100:201, 0])
    assert found["identifier.y"].values.shape == (101, 3)
    assert same_bits(found["identifier.y"].values[::5], rows[100:201:5, 5:8])


def test_an_unknown_format_is_refused(recorded):
    """With those that there are."""
    log, _ = recorded
    with pytest.raises(UsageError, match=r"--format.*'json'.*did you mean 'jsonl'\?.*: csv"):
        table_text(LogChoice.of(log), "json")


def test_a_run_without_rows_is_a_header(recorded):
    """Or nothing."""
    log, _ = recorded
    empty = LogChoice.of(log.window(5.0, 6.0), "plant.u")
    texts = ["".join(table_text(empty, name)) for name in ("csv", "jsonl")]
    assert texts == ["t [s],plant.u [m/s]\n", ""]
