"""Field data as other tools write them: their times, units and gaps; fields of an MCAP."""

from __future__ import annotations

import json

import numpy as np
import pytest

import cosim
from cosim.errors import UsageError
from cosim.report.inspection import describe_samples
from cosim.scenario.data_files.field_file import read_field_data
from tests.log.foreign_files import EPOCH, write_json
from tests.scenario.data_files.test_tables import parquet
from tests.scenario.refusals import check_refused

RAMP = 0.5 * np.arange(4)


def written(folder, text, name="field.csv"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


# --- times ---

STAMPS = "y,Time\n1,2024-01-01\n2,2024-01-01 00:00:00.5\n3,2024-01-01T00:00:01.000000000Z\n"
STAMPS += "4,2024-01-01 01:00:01.5+01:00\n"
TIMES = [
    ("position,y,Time [s]\n1,1,0\n2,2,0.5\n3,3,1\n4,4,1.5\n", {}),
    ("T,time_ms,y\n1,0,1\n2,500,2\n3,1000,3\n4,1500,4\n", {}),
    ("y,Time (minutes)\n1,0\n2,0.008333333333333333\n3,0.016666666666666666\n4,0.025", {}),
    ("Zeit,Dauer [ms],y\n0,1,1\n0.5,2,2\n1,3,3\n1.5,4,4\n", {}),
    ("ramp,Milliseconds,y\n0,0,1\n3,500,2\n6,1000,3\n9,1500,4\n", {}),
    ("ramp,y,when\n0,1,00:00:00\n3,2,00:00:00.5\n6,3,00:00:01\n9,4,00:00:01.5\n", {}),
    (STAMPS, {"offset": "first"}),
    (",y\n0 days 00:00:00,1\n0 days 00:00:00.500000,2\n0 days 00:00:01,3\n", {}),
    ("t,y\n0,1\n500000,2\n1000000,3\n1500000,4\n", {"time_unit": "us"}),
    ("n,t,y\n9,0,1\n8,0.5,2\n7,1,3\n6,1.5,4\n", {"time": "t"}),
    ("t,y\n7,1\n7.5,2\n8,3\n8.5,4\n", {"offset": 7.0}),
    ("t [ns],y\n1700000000000000001,1\n1700000000500000001,2\n", {"offset": 1700000000000000001}),
]


@pytest.mark.parametrize(("text", "options"), TIMES)
def test_the_times_are_in_the_column_that_says_so(tmp_path, text, options):
    """By its name, else its unit, else its dates; T is a temperature. The offset is exact."""
    data = read_field_data(written(tmp_path, text), **options)
    count = len(data.t)
    assert data.t.tolist() == RAMP.tolist()[:count]
    assert data["y"][:, 0].tolist() == [1.0, 2.0, 3.0, 4.0][:count]
    assert data.diagnostics == ()


def test_the_first_column_is_that_of_the_times_if_no_column_says_so(tmp_path):
    """And this is said, once, unless it was selected; an index without a name stands first, too."""
    for name in ("when", "Temps (s) ?", ""):
        path = written(tmp_path, f"{name},y\n0,1\n1,2\n")
        with pytest.warns(cosim.CosimWarning) as warned:
            data = cosim.read_field_data(path)
        (note,) = data.diagnostics
        assert [str(warning.message) for warning in warned] == [note]
        assert repr(name) in note if name else "the index that pandas wrote, in s" in note
        assert "time selects another" in note
        assert describe_samples(str(path))["samples"]["note"] == note
    assert read_field_data(written(tmp_path, "when,y\n0,1\n"), time="when").diagnostics == ()


def test_numbers_for_dates_are_no_seconds(tmp_path):
    """As 20240301: they are times only where a unit says which."""
    path = written(tmp_path, "Takt,Date,y\n0,20240301,1\n0.5,20240302,2\n")
    data = read_field_data(path)
    assert data.t.tolist() == [0.0, 0.5]
    assert "'Takt'" in data.diagnostics[0]
    assert read_field_data(path, time="Date", time_unit="d", offset="first").t[1] == 86400.0
    with pytest.raises(UsageError, match=r"'Date': expected dates.*time_unit"):
        read_field_data(path, time="Date")


def test_a_frame_of_pandas_gives_its_index(tmp_path):
    """Of times, whatever is named like a time beside it; of others only where nothing else is.

    Then it is said. Evenly spaced integers are in no column of the file.
    """
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"y": [1.0, 2.0, 3.0, 4.0], "date": [7.0, 7.0, 8.0, 8.0]})
    timed = frame.assign(t=RAMP)
    durations = frame.set_index(pandas.to_timedelta(RAMP, "s"))
    frames = {
        "unit": frame.set_index(pandas.Index(1e3 * RAMP, name="instant [ms]")),
        "durations": durations,
        "range": frame.set_index(pandas.Index([0, 500, 1000, 1500], name="time_ms")),
        "rows": timed.rename_axis("row"),
        "said: unnamed": frame[["y"]].set_index(pandas.Index(RAMP)),
    }
    for name, one in frames.items():
        one.to_parquet(tmp_path / "a.parquet")
        data = read_field_data(tmp_path / "a.parquet")
        assert data.t.tolist() == RAMP.tolist(), name
        assert data["y"][:, 0].tolist() == [1.0, 2.0, 3.0, 4.0]
        is_said = any("index that pandas wrote" in text for text in data.diagnostics)
        assert is_said == name.startswith("said"), name
    durations[["y"]].to_csv(tmp_path / "durations.csv")
    assert read_field_data(tmp_path / "durations.csv").t.tolist() == RAMP.tolist()


def test_numbers_that_nobody_wrote_for_times_are_refused(tmp_path):
    """Of an index with more rows than there can be, and of days with thousands of digits."""
    pyarrow = pytest.importorskip("pyarrow")
    entry = {"kind": "range", "name": "t", "start": 0, "stop": 2**70, "step": 1}
    metadata = {"pandas": json.dumps({"index_columns": [entry]})}
    schema = pyarrow.schema([("s", "double"), ("y", "double")], metadata=metadata)
    data = read_field_data(parquet(tmp_path, {"s": RAMP, "y": RAMP}, schema))
    assert data.t.tolist() == RAMP.tolist()
    with pytest.raises(UsageError, match="expected a number or an empty cell, got text"):
        read_field_data(written(tmp_path, f"t,y\n{'9' * 5000} days,1\n"))


@pytest.mark.parametrize("stamps", [[np.inf, np.inf], [0.0, np.inf], [-np.inf, 0.0]])
def test_a_time_that_is_not_finite_is_refused(tmp_path, stamps):
    """Also as the one that becomes t = 0."""
    path = parquet(tmp_path, {"t": stamps, "y": [0.0, 1.0]})
    csv = written(tmp_path, "".join(f"{t},0\n" for t in ("t", *stamps)))
    for offset in (None, "first", 1.0):
        for file in (path, csv):
            with pytest.raises(UsageError, match=r"column .*: expected a finite time, got -?inf"):
                read_field_data(file, offset=offset)


def test_samples_of_one_time_stamp_are_spread_or_the_last_counts(tmp_path):
    """By whole seconds, of which the first and the last are cut off; else both are the ways out."""
    stamps = [10, 10, 11, 11, 11, 11, 12, 12, 12, 12, 13]
    lines = [f"{stamp},{number}" for number, stamp in enumerate(stamps)]
    path = written(tmp_path, "\n".join(["t [s],y", *lines]))
    with pytest.raises(UsageError, match=r'line 3: .*same_time: "spread" .*, "last" takes'):
        read_field_data(path)
    spread = read_field_data(path, same_time="spread")
    np.testing.assert_array_equal(spread.t, 10.5 + 0.25 * np.arange(11))
    last = read_field_data(path, same_time="last")
    assert (last.t.tolist(), last["y"][:, 0].tolist()) == ([10, 11, 12, 13], [1, 5, 9, 10])
    assert "7 of 11 rows dropped" in last.diagnostics[0]
    uneven = written(tmp_path, "t,y\n0,1\n0,2\n2,3\n3,4\n3,5\n")
    assert read_field_data(uneven, same_time="spread").t.tolist() == [0.0, 1.0, 2.0, 3.0, 3.5]
    with pytest.raises(UsageError, match="two different time stamps, got one"):
        read_field_data(written(tmp_path, "t,y\n0,1\n0,2\n"), same_time="spread")


# --- signals ---


def test_units_and_elements_come_from_the_names_of_the_columns(tmp_path):
    """``x[0]`` is an element, ``[mm]`` a unit, what is no unit belongs to the name."""
    header = "t,y [mm],x[0] [m],x[1] [m],gain [1],z [-],w (kN),level (left),T[degC],v[2]"
    path = written(tmp_path, f"{header}\n0,1,2,3,4,5,6,7,8,9\n")
    units = {signal.name: signal.unit for signal in read_field_data(path).signals}
    expected = {"y": "mm", "x": "m", "gain": "1", "z": "1", "w": "kN"}
    assert units == {**expected, "level (left)": None, "T": "degC", "v[2]": None}
    np.testing.assert_array_equal(read_field_data(path)["x"], [[2.0, 3.0]])
    chosen = read_field_data(path, columns={"q": ["x[1]", "x[0]"], "p": "y [mm]"})
    np.testing.assert_array_equal(chosen["q"], [[3.0, 2.0]])
    assert chosen.signals[1].unit == "mm"


def test_codes_for_missing_values_are_not_measured(tmp_path):
    """Numbers in every format, in quotes and as float32 too; texts as they are written."""
    pyarrow = pytest.importorskip("pyarrow")
    path = written(tmp_path, "t,y,z\n0,-999.90,NA\n1,5,1\n2,7.0,-\n")
    columns = {"y": "y"}
    files = [path]
    for kind in ("float32", "float64"):
        y = pyarrow.array([-999.9, 5.0, 7.0], kind)
        files.append(parquet(tmp_path, {"t": [0.0, 1.0, 2.0], "y": y}, name=f"{kind}.parquet"))
    for file in files:
        for code in (-999.9, "-999.9"):
            data = read_field_data(file, columns=columns, missing=[code, "NA", 7])
            np.testing.assert_array_equal(data["y"][:, 0], [np.nan, 5.0, np.nan])
    data = read_field_data(path, missing=["NA", "-"])
    np.testing.assert_array_equal(data["z"][:, 0], [np.nan, 1.0, np.nan])
    with pytest.raises(UsageError, match=r"line 2, column 3 \('z'\): .*got text"):
        read_field_data(path, missing=[-999.9])


NO_SAMPLES = [
    ("t,y\n", {}, r"rows of numbers, got none"),
    ("t,y\n0,1\n2,1\n1,1\n", {}, r"line 4: .*increasing .*1.0 s after 2.0 s in line 3"),
    ("t,y\n0,1\n\n0,1\n", {}, r"line 4: .*increasing .*0.0 s after 0.0 s in line 2"),
    ("t,y\n0,1\n,1\n", {}, r"line 3, column 1 \('t'\): expected a finite time"),
    ("t,y\n0,1\n1,inf\n", {}, r"line 3, column 2 \('y'\): expected a finite number, got inf"),
    ("t,y\n0,1\n1,n/a\n", {}, r"line 3, column 2 \('y'\): .*empty cell, got text$"),
    ("t,y\n0,1\n1,1_0\n", {}, r"line 3, column 2 \('y'\): .*got text$"),
    ("t;y\n0;1.5\n1;2,5\n", {}, r"line 3, column 2 \('y'\): .*'\.', see decimal = \",\""),
    ("t;y\n0;1\n1;2.5\n", {"decimal": ","}, r"',', see decimal = \"\.\""),
    ('"t","y"\n"0,0","1,5"\n', {}, r"line 2, column 1 .*decimal = \",\""),
    ("t,y\n0,9007199254740992\n1,-9007199254740993\n", {}, r"line 3, column 2 .*2\*\*53"),
    ("t,y,y\n0,1,2\n", {}, r"unique column 'y', got 2"),
    ("t,level\n0,1\n", {"columns": {"y": "levl"}}, r"no column 'levl'; did you mean 'level'"),
    ("t,level\n0,1\n", {"time": "tt"}, r"no column 'tt'; did you mean 't'"),
    ("t,level\n0,1\n", {"columns": {"y": []}}, r"columns: expected a column .*'y': \[\]"),
    ("t [mm],y\n0,1\n", {}, r"column 't': .*unit of time.*'mm'"),
    ("Zeit,y\nTakte,bar\n0,1\n", {}, r"'Zeit': .*unit of time.*'Takte'.*time_unit"),
    ("t,y\n00:00:01,1\n", {"time_unit": "ms"}, r"'t': expected numbers, .*leave out time_unit"),
    ("t,x[0] [m],x[1]\n0,1,1\n", {}, r"'x', or in none, got 'x\[0\]' in m, 'x\[1\]' in no unit"),
    ("Date,Time,y\n2024-03-01,12:00:00,1\n", {}, r"'Date', 'Time'; .*T12:00:00, .* by columns"),
    *(
        (f"Datum;y\n{date};1\n2024-03-01 12:00:02;2\n", {}, rf"line 2, .*ISO 8601.* got '{date}'")
        for date in ("01.03.2024 12:00:00", "2024-02-30")
    ),
    ("t;y\n2024-03-01;1\n2024-02-30;2\n", {}, r"line 3, column 1 \('t'\): .*got '2024-02-30'"),
    ("t;y\n2024-03-01;1\nsoon;2\n", {}, r"line 3, column 1 .*date .*duration, got other"),
    ("t,y\n0,1\n", {"decimal": ";"}, r"^decimal: .*';'"),
    ("t,y\n0,1\n", {"decimal": ","}, r"separator: .*',', got ','"),
    ("t,y\n0,1\n", {"separator": "::"}, r"separator: .*got '::'"),
    ("timestamp,time,y\n0,5,1\n", {}, r"of times, got 'timestamp', 'time'.*by time"),
    ("Beginn (s),Dauer [s],y\n0,5,1\n", {}, r"of times, got 'Begi.*', 'Daue.*by time"),
    ("t,y\n0,1\n", {"missing": "-9999"}, r"^missing: expected .*, got '-9999'"),
    ("t,y\n0,1\n", {"offset": True}, r'^offset: expected a finite number or "first", got True'),
    ("t,y\n0,1\n", {"offset": np.inf}, r'^offset: expected a finite number or "first", got inf'),
]


def test_another_file_than_a_table_of_samples_is_refused(tmp_path):
    """With the line and the column, or the key, never with what stands there."""
    of_file = r"(?s)^(?!.*n/a)(?=.*field\.csv|decimal|separator|columns|missing|offset|same_time)"
    cases = []
    for text, options, pattern in NO_SAMPLES:
        cases.append((text, options, pattern if pattern[0] == "^" else f"{of_file}.*{pattern}"))
    check_refused(cases, lambda text, options: read_field_data(written(tmp_path, text), **options))


def test_info_shows_what_is_read(tmp_path):
    """Times, distances, signals with their units, how much was not measured, and how it is read."""
    path = written(tmp_path, "t [ms];y [mm];x[0];x[1]\n0;1;2;3\n1;;2;4\n4;1;2;4\n")
    content = describe_samples(str(path))
    assert content["samples"]["times"] == "0.0 s to 0.004 s"
    assert content["samples"]["largest distance"] == "0.003 s"
    rows = [list(row.values()) for row in content["signals"]]
    assert rows == [["y", 1, "mm", 1], ["x", 2, None, 0]]
    found = {row["key"]: row["found"] for row in content["reading"]}
    expected = {"separator": ";", "decimal": ".", "skip": "line 1", "missing": "empty cells, NaN"}
    assert found == expected | {"time": "'t'", "time_unit": "ms", "offset": "0"}


def test_a_column_of_texts_does_not_matter_where_others_are_used(tmp_path):
    """As where a recorder writes its state; information shows it beside what can be read."""
    path = written(tmp_path, "t,state,y\n0,on,1\n1,off,2\n")
    np.testing.assert_array_equal(read_field_data(path, columns={"y": "y"})["y"], [[1.0], [2.0]])
    content = describe_samples(str(path))
    assert [row["signal"] for row in content["signals"]] == ["y"]
    (row,) = content["not read"]
    assert row["signal"] == "state"
    assert "line 2, column 2 ('state'): expected a number" in row["problem"]


# --- fields of messages ---

COUNT = 20
MS = 1_000_000


@pytest.fixture
def recording(tmp_path):
    """Write two topics of different rates; the second begins 5 ms later."""
    fast = []
    for i in range(COUNT):
        row = {"x": [i, -i], "s": (EPOCH // MS) + 10 * i}
        fast.append((EPOCH + i * 10 * MS, row))
    slow = [(EPOCH + 5 * MS + i * 40 * MS, {"z": i / 3}) for i in range(5)]
    return write_json(tmp_path / "log.mcap", {"/fast": fast, "/slow": slow})


def test_topics_of_different_rates_share_one_table(recording):
    """Each is measured at its own times, and not at those of the other."""
    columns = {"x": "/fast.x", "z": ["/slow.z", "/fast.x[0]"]}
    data = cosim.read_field_data(recording, columns=columns)
    fast = (np.arange(COUNT) * 10 - 5) * MS
    slow = np.arange(5) * 40 * MS
    times = np.sort(np.concatenate([fast, slow]))
    np.testing.assert_array_equal(data.t, times / 1e9)
    of_fast = np.isin(times, fast)
    np.testing.assert_array_equal(data["x"][of_fast], np.outer(np.arange(COUNT), [1, -1]))
    assert np.isnan(data["x"][~of_fast]).all()
    np.testing.assert_array_equal(data["z"][~of_fast, 0], np.arange(5) / 3)
    assert np.isnan(data["z"][~of_fast, 1]).all()
    # the element of /slow is measured from t = 0 on
    assert data.zero_ns == EPOCH + 5 * MS
    # a field of numbers that are ms since 1970, as the offset is
    options = {"time": "s", "time_unit": "ms", "offset": EPOCH / MS + 20}
    data = cosim.read_field_data(recording, columns={"x": "/fast.x"}, **options)
    np.testing.assert_array_equal(data.t, (np.arange(COUNT) * 10 - 20) / 1e3)


def test_options_that_select_no_samples_are_refused(recording, monkeypatch):
    """With the way out; so are more numbers than memory has, of topics at all times."""
    monkeypatch.setattr("cosim.scenario.data_files.field_file.MOST_VALUES", 60)
    y = {"y": "/fast.x"}
    cases = [
        ({}, r"expected a map, .*columns"),
        ({"columns": {"y": []}}, r"columns: expected a column .*'y': \[\]"),
        ({"columns": y, "same_time": "spread"}, r"same_time: .*\"last\" .*'spread'"),
        ({"columns": y, "time_unit": "ps"}, r"time_unit: .*'ps'"),
        ({"columns": y, "offset": 1e12}, r"within 2\*\*63 ns of the offset"),
        ({"columns": {**y, "z": "/slow.z"}}, r"at most 60 numbers, got 3 at 25 times"),
    ]
    check_refused(cases, lambda options: cosim.read_field_data(recording, **options))
