"""Recordings of other tools read as runs: tables, and messages in MCAP files."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest
from mcap_protobuf.writer import Writer

import cosim
from cosim.core.contracts import Block
from cosim.core.recorders import Memory
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import CosimWarning, LogError, UnknownSignalError, UsageError
from cosim.log.conversion import ENDINGS, convert
from cosim.log.text import LogChoice, csv_text, exact_seconds
from tests.log.foreign_files import state_class, write_json

HEADER = "t [s],table.a,table.b,table.x[0],table.x[1]"


def table(folder, text):
    path = folder / "a.csv"
    path.write_text(text)
    return cosim.open_recording(path)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_converted_log_is_the_run(tmp_path, ending):
    """Every signal has the same bits at the same times, those of slower components, too."""
    changes = {"scenario.stop": 1.0, "identifier.period": 0.02}
    log = cosim.run("closed-loop", set=changes, out=tmp_path / "a.mcap")
    convert(LogChoice.of(log), tmp_path / f"a{ending}")
    found = cosim.open_recording(tmp_path / f"a{ending}")
    difference = cosim.diff(log, found)
    assert {row.status for row in difference.rows} == {"equal"}
    assert difference.equal
    assert found.time("identifier")[1] == 0.02
    expressions = {"rms": "rms(plant.y - observer.y)"}
    assert cosim.metrics(found, expressions) == cosim.metrics(log, expressions)
    convert(LogChoice.of(log.window(5.0), ["plant.y"]), tmp_path / f"b{ending}")
    if ending != ".csv" and ending != ".parquet":
        assert cosim.open_recording(tmp_path / f"b{ending}")["plant.y"].shape == (0,)


@pytest.mark.parametrize("ending", [".parquet", ".mat", ".npz"])
def test_a_converted_signal_keeps_its_unit_and_how_it_is_between_rows(tmp_path, ending):
    """Of each element; text has no place for the latter."""
    interface = Interface(
        (),
        (Signal("y", 2, unit=("mm", "m/s")), Signal("n", type="integer", variability="discrete")),
    )
    with Memory() as memory:
        memory.begin(Plan(Layout((Channel("/a b", interface, 0),)), 1_000_000, {}, {}, ()))
        times = np.arange(3) * 1_000_000
        memory.write(Block(0, times, times / 1e9, 1e-3), np.arange(9.0).reshape(3, 3))
    convert(LogChoice.of(memory), tmp_path / f"a{ending}")
    found = cosim.open_recording(tmp_path / f"a{ending}")
    signals = found.channels["/a b"].by_name
    assert signals["y"].unit == ("mm", "m/s")
    assert (signals["n"].type, signals["n"].variability) == ("integer", "discrete")
    assert cosim.diff(memory, found).equal


@pytest.mark.parametrize("ending", [".mat", ".npz"])
def test_damaged_arrays_are_refused_or_read(tmp_path, ending):
    """Without running code or another error, whatever byte is another."""
    log = cosim.run("pair", set={"scenario.stop": 0.1}, out=tmp_path / "a.mcap")
    path = tmp_path / f"a{ending}"
    convert(LogChoice.of(log), path)
    good = path.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(150):
        damaged = bytearray(good)
        damaged[rng.integers(len(good))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged[: rng.integers(len(good)) if rng.random() < 0.2 else None])
        try:
            with warnings.catch_warnings(action="ignore"):
                cosim.open_recording(path)
        except UsageError:
            refused += 1
    assert refused > 20


def test_other_files_of_arrays_are_refused(tmp_path):
    """What numpy advises then, to allow code in them, is not passed on."""
    objects = np.array([print], object)
    np.savez(tmp_path / "other.npz", y=np.arange(3.0))
    np.savez(tmp_path / "objects.npz", signals=objects)
    np.savez(tmp_path / "times.npz", **{"signals": np.array('{"a.y": {}}'), "t:a": objects})
    (tmp_path / "text.npz").write_text("no archive")
    (tmp_path / "empty.npz").touch()
    for path in sorted(tmp_path.iterdir()):
        with pytest.raises(UsageError) as refused:
            cosim.open_recording(path)
        assert f"{path.name}': expected arrays as 'cosim convert' writes them" in str(refused.value)
        assert "pickle" not in str(refused.value)


def test_rows_of_one_time_are_those_of_a_jump(tmp_path):
    """Both are kept, as tools write them at events; which is said."""
    with pytest.warns(cosim.CosimWarning, match="1 of 4 rows have the time of the row before"):
        run = table(tmp_path, "t,y\n0,0\n1,0\n1,5\n2,5\n")
    assert run.time_ns("table").tolist() == [0, 10**9, 10**9, 2 * 10**9]
    assert run["table.y"].tolist() == [0, 0, 5, 5]
    assert run.step_ns == 10**9
    with pytest.raises(UsageError, match=r"a\.csv.*line 4: expected increasing times"):
        table(tmp_path, "t,y\n0,1\n2,2\n1,3\n")


GAPS = "t [s],a,b,x[0],x[1]\n0.0,1.0,,1.0,\n1.0,,5.0,,2.0\n2.0,3.0,6.0,,\n"


@pytest.mark.parametrize("ending", ["", *ENDINGS])
def test_an_empty_cell_is_no_row_of_its_signal(tmp_path, ending):
    """Converted and read again, too; elements of one signal have rows of their own."""
    run = table(tmp_path, GAPS)
    if ending:
        convert(LogChoice.of(run), tmp_path / f"b{ending}")
        run = cosim.open_recording(tmp_path / f"b{ending}")
    found = {name: (run.time(name).tolist(), run[name].tolist()) for name in ("table.a", "table.b")}
    assert found == {"table.a": ([0.0, 2.0], [1.0, 3.0]), "table.b": ([1.0, 2.0], [5.0, 6.0])}
    assert run.time("table.x").tolist() == [0.0, 1.0]
    assert (run.time("table.x[1]").tolist(), run["table.x[1]"].tolist()) == ([1.0], [2.0])
    expressions = {
        "b": "initial(table.b)",
        "both": "max(table.a + table.b)",
        "a": "integral(table.a)",
    }
    assert cosim.metrics(run, expressions) == {"b": 5.0, "both": 9.0, "a": 4.0}
    assert run["table.a"].shape == run.window(0.0, 2.0)["table.a"].shape
    with pytest.raises(LogError, match="same instants"):
        run[["table.a", "table.b"]]


def test_a_table_is_shown_as_it_was_written(tmp_path):
    """Rows of which nothing is chosen are left out."""
    run = table(tmp_path, GAPS)
    assert "".join(csv_text(LogChoice.of(run))) == GAPS.replace("t [s],a,b,x[0],x[1]", HEADER)
    assert "".join(csv_text(LogChoice.of(run, ["table.a"]))) == "t [s],table.a\n0.0,1.0\n2.0,3.0\n"
    assert np.isnan(run.to_pandas()["table.a"].tolist()).tolist() == [False, True, False]


@pytest.mark.parametrize("ending", ENDINGS)
def test_nan_and_infinity_are_values(tmp_path, ending):
    """As of an estimate before there is one; a file has them as the log has, none is a gap."""
    with Memory() as memory:
        interface = Interface((), (Signal("y"), Signal("z")))
        memory.begin(
            Plan(Layout((Channel("a", interface, 0),)), 1_000_000, {}, {"a": np.zeros(0, bool)}, ())
        )
        times = np.arange(3) * 1_000_000
        rows = np.array([[np.nan, np.nan], [1.0, -np.inf], [2.0, 3.0]])
        memory.write(Block(0, times, times / 1e9, 1e-3), rows)
    convert(LogChoice.of(memory), tmp_path / f"a{ending}")
    found = cosim.open_recording(tmp_path / f"a{ending}")
    assert cosim.diff(memory, found).equal
    numbers = table(tmp_path, "t,a.y,a.z\n0,0,1\n0.001,1,2\n0.002,2,3\n")
    for options in ({}, {"interpolate": True}, {"tube": 1e-4}):
        for runs in ((found, numbers), (numbers, found), (memory, numbers), (numbers, memory)):
            difference = cosim.diff(*runs, **options, atol=1e9)
            assert [row.status for row in difference.rows] == ["outside", "outside"]


def test_an_empty_cell_is_no_nan(tmp_path):
    """Of one element of a vector, neither with a tolerance nor without."""
    empty, nan = (table(tmp_path, f"t,x[0],x[1]\n0,1,1\n1,2,{own}\n2,3,3\n") for own in ("", "nan"))
    for options in ({}, {"atol": 1.0}):
        assert not cosim.diff(empty, nan, **options).within
    assert not cosim.diff(nan, empty, interpolate=True).within


def test_what_a_signal_has_beyond_the_other_is_said_of_it_alone(tmp_path):
    """Though another signal of its component has rows there."""
    a = table(tmp_path, "t,x,y\n0,1,1\n1,1,1\n2,,1\n")
    b = table(tmp_path, "t,x,y\n0,1,1\n1,1,1\n2,9,1\n")
    difference = cosim.diff(a, b, interpolate=True)
    assert difference.within
    assert difference.not_compared == (
        "table.x: b has rows from 0.0 s to 2.0 s, a only from 0.0 s to 1.0 s",
    )


@pytest.mark.parametrize("ending", ENDINGS)
def test_times_before_zero_are_read_again(tmp_path, ending):
    """Also those that are no whole seconds, and in tables those long before."""
    run = table(tmp_path, "t,y\n-1.25,1\n-0.1,2\n0.5,3\n")
    convert(LogChoice.of(run), tmp_path / f"b{ending}")
    found = cosim.open_recording(tmp_path / f"b{ending}")
    assert found.time_ns("table").tolist() == [-1_250_000_000, -100_000_000, 500_000_000]
    for times in ([-2208988800_000000001, 0], [0, 8500000_000000001]):
        cells = [f"{time},1" for time in exact_seconds(np.array(times))]
        run = table(tmp_path, "\n".join(["t,y", *cells]))
        convert(LogChoice.of(run), tmp_path / f"c{ending}", force=True)
        if ending in (".csv", ".parquet"):
            found = cosim.open_recording(tmp_path / f"c{ending}")
            assert found.time_ns("table").tolist() == times


@pytest.mark.parametrize("ending", ["", *ENDINGS])
def test_times_since_1970_keep_their_ns_or_a_warning_says_so(tmp_path, ending):
    """A double has them to 256 ns."""
    run = table(tmp_path, "t,y\n1764570000.123456789,1\n1764570000.123456790,2\n")
    if ending in (".npz", ".mat"):
        with pytest.warns(CosimWarning, match="rounded"):
            convert(LogChoice.of(run), tmp_path / f"b{ending}")
        return
    if ending:
        convert(LogChoice.of(run), tmp_path / f"b{ending}")
        run = cosim.open_recording(tmp_path / f"b{ending}")
    assert run.time_ns("table").tolist() == [1764570000123456789, 1764570000123456790]


def test_a_column_that_cannot_be_read_costs_itself_alone(tmp_path):
    """It is named, with its place and what is there, and makes files differ."""
    with pytest.warns(CosimWarning, match=r"left out: table.state: .*expected a number"):
        run = table(tmp_path, "t,y,state\n0,1,on\n1,2,off\n")
    assert list(run) == ["table.y"]
    assert run.left_out.keys() == {"table.state"}
    assert [warning.text for warning in run.warnings] == [
        f"{run.label}: left out: table.state: {run.left_out['table.state']}"
    ]
    difference = cosim.diff(run, run)
    assert {row.signal: row.status for row in difference.rows} == {
        "table.y": "equal",
        "table.state": "not read",
    }
    assert (difference.equal, difference.within) == (False, False)
    assert cosim.diff(run, run, signals=["table.y"]).equal
    with pytest.raises(UsageError, match="column of numbers"):
        table(tmp_path, "t,state\n0,on\n1,off\n")


def test_columns_are_signals_of_components(tmp_path):
    """With their units; one that names no component belongs to the table, and a gap is no row."""
    run = table(tmp_path, "t [ms],a.y [mm],a.x[0],a.x[1],p\n0,1,2,3,4\n1,,,,5\n2,6,,7,8\n")
    assert list(run.channels) == ["a", "table"]
    np.testing.assert_array_equal(run.time_ns("a"), [0, 2_000_000])
    np.testing.assert_array_equal(run["a.x"], [[2, 3], [np.nan, 7]])
    np.testing.assert_array_equal(run["table.p"], [4, 5, 8])
    assert run["a.y"].tolist() == [1, 6]
    assert run.channels["a"].by_name["y"].unit == "mm"
    assert (run.end_ns, run.step_ns, run.status) == (2_000_000, 1_000_000, "complete")
    assert run.window(0.001)["a.y"].tolist() == [6]
    with pytest.raises(UnknownSignalError, match=r"table\.q.*p"):
        run["table.q"]


def test_topics_are_components(tmp_path):
    """Each with the times of its messages; fields that are no numbers are left out."""
    path = tmp_path / "a.mcap"
    messages = {
        "/drive": [(0, {"y": 1.5, "name": "d"}), (2_000_000, {"y": 2.5, "name": "d"})],
        "/valve": [(1_000_000, {"open": True, "p": [1, 2]})],
    }
    write_json(path, messages)
    run = cosim.open_recording(path)
    assert run["/drive.y"].tolist() == [1.5, 2.5]
    assert run.time_ns("/drive").tolist() == [0, 2_000_000]
    assert run["/valve.p"].tolist() == [[1, 2]]
    assert run.channels["/valve"].by_name["open"].variability == "discrete"
    assert cosim.diff(run, run).equal


def test_topics_and_fields_of_every_name_are_signals(tmp_path):
    """Whatever has to be in quotes elsewhere; a message that is an array is ``value``."""
    path = tmp_path / "a.mcap"
    messages = {"/a": [(0, {"b.d": 1, "n": 2})], "/a.b": [(0, {"c": 3})], "/v": [(0, [4, 5])]}
    write_json(path, messages)
    run = cosim.open_recording(path)
    names = [f"{name}.{port.name}" for name, one in run.channels.items() for port in one.signals]
    assert names == ["/a.b.d", "/a.n", "/a.b.c", "/v.value"]
    assert run["/v.value"].tolist() == [[4, 5]]
    messages["/a.b"] = [(0, {"d": 3})]
    write_json(path, messages)
    with pytest.raises(LogError, match=r"one field of each name, got two of '/a\.b\.d'"):
        cosim.open_recording(path)


def test_messages_have_arrays_of_any_length_and_several_at_an_instant(tmp_path):
    """Every message is a row; what no message has is no signal, though a schema lists it."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream, Writer(stream) as writer:
        for time_ns, effort in [(5, [1.0, 2.0]), (5, [3.0]), (7, [])]:
            writer.write_message("/t", state_class()(position=1.5, effort=effort), time_ns, time_ns)
    run = cosim.open_recording(path)
    names = [port.name for port in run.channels["/t"].signals]
    assert names == ["position", "effort", "mode", "on", "count"]
    assert run.time_ns("/t").tolist() == [5, 5, 7]
    assert run["/t.position"].tolist() == [1.5, 1.5, 1.5]
    np.testing.assert_array_equal(run["/t.effort"], [[1.0, 2.0], [3.0, np.nan]])
    assert run["/t.effort[1]"].tolist() == [2.0]
    assert cosim.diff(run, run).equal


def test_what_is_left_out_of_messages_is_said(tmp_path):
    """By the run and by warnings, ten at most; without any signal an error has the reasons."""
    mixed = [
        (0, {f"a{index}": 1 for index in range(12)}),
        (1, {f"a{index}": "x" for index in range(12)}),
    ]
    path = write_json(tmp_path / "a.mcap", {"/t": [*mixed, (2, {"y": 5, "big": 2**60 + 1})]})
    with pytest.warns(cosim.CosimWarning) as warned:
        run = cosim.open_recording(path)
    assert list(run.left_out) == [*(f"/t.a{index}" for index in range(12)), "/t.big"]
    assert "message 2" in run.left_out["/t.a0"]
    texts = [str(each.message) for each in warned]
    assert len(texts) == 2  # one for each reason
    assert "a.mcap: left out: /t.a0, /t.a1" in texts[0]
    assert "/t.big: message 3" in texts[1]
    assert run["/t.y"].tolist() == [5.0]
    with pytest.raises(UnknownSignalError):
        run["/t.a0"]
    path = write_json(tmp_path / "b.mcap", {"/t": mixed, "/n": [(0, {"big": 2**60 + 1})]})
    with pytest.raises(LogError, match=r"b\.mcap: .*numeric fields.*/n\.big: message 1.*/t\.a0"):
        cosim.open_recording(path)
    many = {f"/t{index}": [(0, {"y": 1, "x": 2**60 + 1 + 512 * index})] for index in range(14)}
    with pytest.warns(cosim.CosimWarning) as warned:
        cosim.open_recording(write_json(tmp_path / "c.mcap", many))
    assert len(warned) == 11
    assert "4 more" in str(warned[-1].message)


def test_a_name_that_no_signal_can_have_is_refused_with_the_file(tmp_path):
    """Of a column, and of a topic."""
    with pytest.raises(UsageError, match=r"a\.csv: signal name"):
        table(tmp_path, "t,y,x.\n0,1,2\n1,2,3\n")
    write_json(tmp_path / "a.mcap", {"": [(0, {"y": 1.0})]})
    with pytest.raises(LogError, match=r"a\.mcap: expected topics with names"):
        cosim.open_recording(tmp_path / "a.mcap")


def test_what_is_no_recording_is_refused(tmp_path):
    """Each by one error that names the file and what was expected."""
    with pytest.raises(UsageError, match=r"a\.csv.*at least 1 ns apart"):
        table(tmp_path, "t,y\n0,1\n0.0000000001,2\n")
    with pytest.raises(UsageError, match=r"a\.csv.*292 years.*got 10000000000"):
        table(tmp_path, "t,y\n0,1\n1e10,2\n")
    write_json(tmp_path / "b.mcap", {"/text": [(0, {"text": "x"})]})
    with pytest.raises(LogError, match=r"b\.mcap: expected messages with numeric fields"):
        cosim.open_recording(tmp_path / "b.mcap")
    with pytest.raises(LogError, match=r"c\.mcap.*No such file"):
        cosim.open_recording(tmp_path / "c.mcap")
    for value in (None, 3, b"a.csv", ["a.csv"]):
        with pytest.raises(UsageError, match=rf"^path: expected a path.* {re.escape(repr(value))}"):
            cosim.open_recording(value)
