"""Field data as other tools write them: separators, decimal signs, units, time stamps."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

import cosim
from cosim.errors import UsageError
from cosim.log.conversion.choice import LogChoice
from cosim.log.conversion.files import convert
from cosim.report.inspection import describe_samples
from cosim.scenario.data_files import table, tables
from cosim.scenario.data_files.field_file import read_field_data
from cosim.theory.disturbed_plant import DataSet, disturbed_plant
from cosim.theory.plants.descriptor import reduce
from tests.scenario.refusals import check_refused
from tests.theory.academic import academic, alpha

T = np.array([0.0, 0.001, 0.0021, 0.0029])
Y = np.array([1.0, -2.5, np.nan, 4e-3])


def written(folder, text, name="field.csv"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


FORMS = [
    ("t,y\n0,1\n0.001,-2.5\n0.0021,\n0.0029,4e-3\n", {}),
    ("\ufefft;y\r\n0;1\r\n0.001;-2.5\r\n\r\n0.0021;NaN\r\n0.0029;0.004\r\n", {}),
    ("t;y\n0;1,0\n0,001;-2,5\n0,0021;\n0,0029;4e-3\n", {"decimal": ","}),
    ("t\ty\n0\t1\n0.001\t-2.5\n0.0021\t\n0.0029\t.004\n", {}),
    ("t|y\n0|1\n0.001|-2.5\n0.0021| \n0.0029|4E-3\n", {}),
    ('"t, time"; "y"\n0;"1"\n0.001;-2.5\n0.0021;nan\n0.0029;4e-3\n', {}),
    ("t#y\n0#1\n0.001#-2.5\n0.0021#\n0.0029#4e-3\n", {"separator": "#"}),
    ("t [ms],y\n0,1\n1,-2.5\n2.1,\n2.9,4e-3\n", {}),
    ("t,y\n0,1\n1000,-2.5\n2100,\n2900,4e-3\n", {"time_unit": "us"}),
    ("n,t(s),y\n9,0,1\n8,0.001,-2.5\n7,0.0021,\n6,0.0029,4e-3\n", {"time": "t"}),
    ("t,y,\n7,1,\n7.001,-2.5,\n7.0021,,\n7.0029,4e-3,\n", {"offset": 7.0}),
    ("t,level\n7,1\n7.001,-2.5\n7.0021,\n7.0029,4e-3\n", {"offset": "first"}),
    (
        "t [ns],y\n1700000000000000000,1\n1700000000001000000,-2.5\n1700000000002100000,\n"
        "1700000000002900000,4e-3\n",
        {"offset": "first"},
    ),
    ("  t     y\n 0.0   1\n 0.001 -2.5\n 0.0021 nan \n 0.0029 4e-3\n", {"separator": " "}),
    ('"t","y"\n"0,0","1"\n"0,001","-2,5"\n"0,0021",""\n"0,0029","4e-3"\n', {"decimal": ","}),
    ("t [h],y\n0.5,1\n0.50000027777777778,-2.5\n0.5000005833333333,\n", {"offset": 0.5}),
]


def test_the_same_samples_are_read_from_every_form(tmp_path):
    """Times to a rounding, also where a time stamp has 19 digits; empty cells are not measured."""
    for text, options in FORMS:
        data = read_field_data(written(tmp_path, text), **options)
        count = len(data.t)
        rtol = 1e-8 if "[h]" in text else 1e-15
        np.testing.assert_allclose(data.t, T[:count], rtol=rtol, err_msg=text)
        np.testing.assert_array_equal(data.signals[-1].values[:, 0], Y[:count], err_msg=text)


RAMP = 0.5 * np.arange(4)
BY_NAME = [
    "position,z,Time [s]\n1,5,0\n2,6,0.5\n3,7,1\n4,8,1.5\n",
    "y,time,z\n1,0,5\n2,0.5,6\n3,1,7\n4,1.5,8\n",
    "T,time_ms\n1,0\n2,500\n3,1000\n4,1500\n",
    "y,Time Stamp\n1,2024-01-01\n2,2024-01-01 00:00:00.5\n"
    "3,2024-01-01T00:00:01.000000000Z\n4,2024-01-01 01:00:01.5+01:00\n",
    "ramp,y,zeit [s]\n0,1,0\n3,2,0.5\n6,3,1\n9,4,1.5\n",
    "ramp,y,when\n0,1,00:00:00\n3,2,00:00:00.5\n6,3,00:00:01\n9,4,00:00:01.5\n",
    "Zeit,Dauer [ms],y\n0,1,1\n0.5,2,2\n1,3,3\n1.5,4,4\n",
    "Datum;y\n2024-01-01 00:00:00 UTC;1\n2024-01-01 00:00:00.5 UTC;2\n"
    "2024-01-01 00:00:01Z;3\n2024-01-01 00:00:01.5Z;4\n",
    "ramp,Milliseconds,y\n0,0,1\n3,500,2\n6,1000,3\n9,1500,4\n",
    "ramp,Time (minutes),y\n0,0,1\n30,0.008333333333333333,2\n60,0.016666666666666666,3\n"
    "90,0.025,4\n",
    "t,delay [ms],y\n0,1,1\n0.5,2,2\n1,3,3\n1.5,4,4\n",
    ",y\n0 days 00:00:00,1\n0 days 00:00:00.500000,2\n0 days 00:00:01,3\n0 days 00:00:01.5,4\n",
]


def test_the_times_are_in_the_column_that_says_so(tmp_path):
    """Wherever it stands: by its name, else its unit, else its dates; T is a temperature."""
    for text in BY_NAME:
        offset = "first" if "2024" in text else None
        data = read_field_data(written(tmp_path, text), offset=offset)
        assert data.t.tolist() == RAMP.tolist(), text
        name = "T" if text.startswith("T,") else "position" if "position" in text else "y"
        assert data[name][:, 0].tolist() == [1.0, 2.0, 3.0, 4.0]
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
    text = "Takt,Date,y\n0,20240301,1\n0.5,20240302,2\n"
    path = written(tmp_path, text)
    data = read_field_data(path)
    assert data.t.tolist() == [0.0, 0.5]
    assert "'Takt'" in data.diagnostics[0]
    assert read_field_data(path, time="Date", time_unit="d", offset="first").t[1] == 86400.0
    for refused, options in ((path, {"time": "Date"}), ("Date,y\n20240301,1\n", {})):
        file = written(tmp_path, refused, "d.csv") if isinstance(refused, str) else refused
        with pytest.raises(UsageError, match=r"'Date': expected dates.*time_unit"):
            read_field_data(file, **options)


@pytest.mark.parametrize(("one", "other"), [("timestamp", "time"), ("Beginn (s)", "Dauer [s]")])
def test_two_columns_of_times_are_refused_with_the_key_that_decides(tmp_path, one, other):
    path = written(tmp_path, f"{one},{other},y\n0,5,1\n1,6,2\n")
    with pytest.raises(UsageError, match=rf"of times, got '{one[:4]}.*', '{other[:4]}.*by time"):
        read_field_data(path)
    assert read_field_data(path, time=other).t.tolist() == [5.0, 6.0]


def test_a_frame_of_pandas_gives_its_index(tmp_path):
    """Of times, whatever is named like a time beside it; of others only where nothing else is.

    Then it is said. Evenly spaced integers are in no column of the file.
    """
    pandas = pytest.importorskip("pandas")
    values = {"y": [1.0, 2.0, 3.0, 4.0], "date": [7.0, 7.0, 8.0, 8.0]}
    frame = pandas.DataFrame(values, index=pandas.Index(RAMP, name="instant"))
    frame[["y"]].to_parquet(tmp_path / "named.parquet")
    frame.to_parquet(tmp_path / "dates.parquet")
    frame.assign(t=RAMP).set_index(pandas.Index([0, 1, 2, 4], name="sample")).to_parquet(
        tmp_path / "samples.parquet"
    )
    steps = pandas.Index([0, 10, 20, 30], name="time_ms")
    frame.set_index(steps).to_parquet(tmp_path / "range.parquet")
    numbered = pandas.DataFrame({"y": values["y"], "t": RAMP}).rename_axis("row")
    numbered.to_parquet(tmp_path / "rows.parquet")
    frame.set_index(pandas.to_timedelta(RAMP, "s")).to_parquet(tmp_path / "durations.parquet")
    frame.set_index(pandas.to_timedelta(RAMP, "s"))[["y"]].to_csv(tmp_path / "durations.csv")
    frame[["y"]].set_index(pandas.Index(RAMP)).to_parquet(tmp_path / "unnamed.parquet")
    frame.rename(columns={"date": "t"}).assign(t=RAMP).to_parquet(
        tmp_path / "both.parquet", index=False
    )
    for name in (
        "named.parquet",
        "durations.csv",
        "durations.parquet",
        "unnamed.parquet",
        "both.parquet",
        "rows.parquet",
        "samples.parquet",
        "dates.parquet",
    ):
        data = read_field_data(tmp_path / name)
        assert data.t.tolist() == RAMP.tolist(), name
        assert data["y"][:, 0].tolist() == values["y"]
        is_said = name in ("named.parquet", "unnamed.parquet", "dates.parquet")
        assert any("index that pandas wrote" in text for text in data.diagnostics) == is_said, name
    assert read_field_data(tmp_path / "range.parquet").t.tolist() == [0.0, 0.01, 0.02, 0.03]


def test_an_index_is_known_by_all_of_its_name(tmp_path):
    """With its unit, too."""
    pandas = pytest.importorskip("pandas")
    index = pandas.Index(RAMP * 1e3, name="instant [ms]")
    pandas.DataFrame({"y": [1.0, 2.0, 3.0, 4.0]}, index=index).to_parquet(tmp_path / "a.parquet")
    data = read_field_data(tmp_path / "a.parquet")
    np.testing.assert_allclose(data.t, RAMP, rtol=1e-15)
    assert not data.diagnostics


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


def test_a_table_of_many_columns_is_read_in_time_of_their_number(tmp_path):
    """Elements of one vector, or signals of their own."""
    for names in ([f"x[{i}]" for i in range(5_000)], [f"y{i}" for i in range(5_000)]):
        text = ",".join(["t", *names]) + "\n" + ",".join(["0"] * 5_001) + "\n"
        data = read_field_data(written(tmp_path, text))
        assert sum(signal.values.shape[1] for signal in data.signals) == 5_000


def test_columns_of_one_name_are_refused_where_all_are_read(tmp_path):
    """With their units they are told apart."""
    path = written(tmp_path, "t,y [mm],y [m]\n0,1,2\n")
    with pytest.raises(UsageError, match="expected a unique column 'y', got 2"):
        read_field_data(path)
    assert read_field_data(path, columns={"y": "y [m]"})["y"].tolist() == [[2.0]]


def test_a_log_written_as_a_table_is_read_as_it_was(tmp_path):
    """By `to_pandas` and by `cosim convert`, whose fields have units."""
    pytest.importorskip("pandas")
    log = cosim.run("closed-loop", set={"scenario.stop": 0.1}, out=tmp_path / "a.mcap")
    name = "plant.x_a[1]"
    log.to_pandas().to_parquet(tmp_path / "frame.parquet")
    convert(LogChoice.of(log), tmp_path / "converted.parquet")
    for path in (tmp_path / "frame.parquet", tmp_path / "converted.parquet"):
        data = read_field_data(path)
        assert data.t.tolist() == log.t.tolist()
        np.testing.assert_array_equal(data["plant.x_a"][:, 1], log[name])


def test_a_field_of_parquet_may_have_its_unit_beside_it(tmp_path):
    """As `cosim convert` writes it; another one in the name is refused."""
    pyarrow = pytest.importorskip("pyarrow")
    for name, unit, expected in (("y", b"mm", "mm"), ("y [mm]", b"mm", "mm"), ("y", b"-", "1")):
        fields = [
            pyarrow.field("t", pyarrow.float64(), metadata={"unit": "ms"}),
            pyarrow.field(name, pyarrow.float64(), metadata={"unit": unit}),
        ]
        path = parquet(tmp_path, {"t": T, name: Y}, pyarrow.schema(fields))
        data = read_field_data(path)
        assert [(signal.name, signal.unit) for signal in data.signals] == [("y", expected)]
        np.testing.assert_allclose(data.t, T * 1e-3, rtol=1e-15)
    fields[1] = pyarrow.field("y [m]", pyarrow.float64(), metadata={"unit": "mm"})
    path = parquet(tmp_path, {"t": T, "y [m]": Y}, pyarrow.schema(fields))
    with pytest.raises(UsageError, match=r"'y \[m\]': expected one unit, got 'm'.*'mm'"):
        read_field_data(path)


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


def test_text_in_a_column_that_is_not_used_does_not_matter(tmp_path):
    """As where a recorder writes its state beside the numbers."""
    path = written(tmp_path, "t,state,y\n0,on,1\n1,off,2\n")
    np.testing.assert_array_equal(read_field_data(path, columns={"y": "y"})["y"], [[1.0], [2.0]])
    with pytest.raises(UsageError, match=r"line 2, column 2 \('state'\): expected a number"):
        read_field_data(path)


NO_SAMPLES = [
    (("", {}), r"at least two named columns .*got 0"),
    (("t,y\n", {}), r"rows of numbers, got none"),
    (("t y\n0 1\n", {}), r"at least two named columns .*got 1"),
    (("0,1\n1,2\n", {}), r"column names in line 1, got numbers"),
    (("t,y\n0,1\n2,1\n1,1\n", {}), r"line 4: .*increasing .*1.0 s after 2.0 s in line 3"),
    (("t,y\n0,1\n\n0,1\n", {}), r"line 4: .*increasing .*0.0 s after 0.0 s in line 2"),
    (("t,y\n0,1\n,1\n", {}), r"line 3, column 1 \('t'\): expected a time"),
    (("t,y\n0,1\nnan,1\n", {}), r"line 3, column 1 \('t'\): expected a time"),
    (("t,y\n0,1\n1,inf\n", {}), r"line 3, column 2 \('y'\): expected a finite number, got inf"),
    (("t,y\n0,1\ninf,1\n", {}), r"line 3: expected a finite time, got inf"),
    (("t,y\n0,1\n1,n/a\n", {}), r"line 3, column 2 \('y'\): .*empty cell, got text$"),
    (("t,y\n0,1\n1,1_0\n", {}), r"line 3, column 2 \('y'\): .*got text$"),
    (("t;y\n0;1.5\n1;2,5\n", {}), r"line 3, column 2 \('y'\): .*'\.', see decimal = \",\""),
    (("t;y\n0;1\n1;2.5\n", {"decimal": ","}), r"',', see decimal = \"\.\""),
    (("t,y\n0,1\n1,2,3\n", {}), r"line 3: expected 2 cells, got 3"),
    (("t,y\n0,1\n1\n", {}), r"line 3: expected 2 cells, got 1"),
    (("t,y,y\n0,1,2\n", {}), r"unique column 'y', got 2"),
    (("t,level\n0,1\n", {"columns": {"y": "levl"}}), r"no column 'levl'; did you mean 'level'"),
    (("t,level\n0,1\n", {"time": "tt"}), r"no column 'tt'; did you mean 't'"),
    (("t,level\n0,1\n", {"columns": {"y": []}}), r"columns: expected a column .*'y': \[\]"),
    (("t [mm],y\n0,1\n", {}), r"column 't': .*unit of time.*'mm'"),
    (("t,x[0] [m],x[1]\n0,1,1\n", {}), r"'x', or in none, got 'x\[0\]' in m, 'x\[1\]' in no unit"),
    (('t,y\n0,"1\n1,2"\n', {}), r"line 2 cannot be split"),
    (('t,y\n0,"1"x\n', {}), r"line 2 cannot be split"),
    (("t,y\n0,1\n", {"decimal": ";"}), r"decimal: expected .*got ';'"),
    (("t,y\n0,1\n", {"decimal": ","}), r"separator: .*',', got ','"),
    (("t,y\n0,1\n", {"separator": "::"}), r"separator: .*got '::'"),
    (("t\0y", {}), r"got a NUL"),
    (("t  y\n0  1\n", {}), r"at least two named columns .*got 1 .*; separator = \" \" splits"),
    (('"t","y"\n"0,0","1,5"\n', {}), r"line 2, column 1 .*decimal = \",\", and separator = \",\""),
    (("Zeit,y\nTakte,bar\n0,1\n", {}), r"'Zeit': .*unit of time.*'Takte'.*time_unit"),
    (("Date,Time,y\n2024-03-01,12:00:00,1\n", {}), r"'Date', 'Time'; .*T12:00:00, .* by columns"),
    (
        ("t,y\n0,9007199254740992\n1,-9007199254740993\n", {}),
        r"line 3, column 2 \('y'\): .*2\*\*53",
    ),
    *(
        ((f"Datum;y\n{date};1\n2024-03-01 12:00:02;2\n", {}), rf"line 2, .*ISO 8601.* got '{date}'")
        for date in ("01.03.2024 12:00:00", "2024/03/01 12:00", "2024-02-30", "2024-03-01 12:00:60")
    ),
    (("t;y\n2024-03-01;1\n2024-02-30;2\n", {}), r"line 3, column 1 \('t'\): .*got '2024-02-30'"),
]


def test_another_file_than_a_table_of_samples_is_refused(tmp_path):
    """With the line and the column, never with what stands there."""

    def read(case):
        text, options = case
        read_field_data(written(tmp_path, text), **options)

    of_file = r"(?s)^(?!.*n/a|.*skip = )(?=.*field\.csv|decimal|separator|columns).*"
    check_refused([(case, of_file + pattern) for case, pattern in NO_SAMPLES], read)


def test_files_that_cannot_be_read_are_refused(tmp_path, monkeypatch):
    """Missing, another thing than a file, or larger than is allowed."""
    with pytest.raises(UsageError, match=r"gone.csv' cannot be read: No such file"):
        read_field_data(tmp_path / "gone.csv")
    with pytest.raises(UsageError, match="cannot be read: it is a folder"):
        read_field_data(tmp_path)
    path = written(tmp_path, "t,y\n0,1\n")
    monkeypatch.setattr("cosim.scenario.data_files.table.LARGEST", 7)
    with pytest.raises(UsageError, match="cannot be read: it is too large: more than 7 bytes"):
        read_field_data(path)


def parquet(folder, columns, schema=None, name="field.parquet"):
    pyarrow = pytest.importorskip("pyarrow")
    writer = pytest.importorskip("pyarrow.parquet")
    path = folder / name
    writer.write_table(pyarrow.table(columns, schema=schema), path)
    return path


def test_parquet_gives_the_samples_of_a_csv(tmp_path):
    """Nulls and NaN are not measured; whole numbers are numbers."""
    path = parquet(
        tmp_path, {"t [ms]": T * 1e3, "y [mm]": Y, "n": [1, None, 3, 4], "s": list("abcd")}
    )
    data = read_field_data(path, columns={"y": "y", "n": "n"})
    np.testing.assert_allclose(data.t, T, rtol=1e-15)
    np.testing.assert_array_equal(data["y"][:, 0], Y)
    np.testing.assert_array_equal(data["n"][:, 0], [1.0, np.nan, 3.0, 4.0])
    assert data.signals[0].unit == "mm"


def test_time_stamps_of_parquet_have_their_unit(tmp_path):
    """To the ns, in 2023 too."""
    pyarrow = pytest.importorskip("pyarrow")
    stamps = 1_700_000_000_000_000_000 + np.array([0, 1_000_000, 2_100_001])
    for kind in (pyarrow.timestamp("ns"), pyarrow.duration("ns")):
        path = parquet(tmp_path, {"when": pyarrow.array(stamps, kind), "y": Y[:3]})
        data = read_field_data(path, offset="first")
        np.testing.assert_allclose(data.t, [0.0, 1e-3, 2.100001e-3], rtol=1e-15)


def test_parquet_without_a_table_of_samples_is_refused(tmp_path):
    """As a CSV is, with the row."""
    cases = [
        ({"t": [0.0, 1.0], "y": ["a", "b"]}, r"column 'y': expected numbers, got type string"),
        ({"t": ["a", "b"], "y": [0.0, 1.0]}, r"column 't': expected numbers, got type string"),
        ({"t": [0.0, None], "y": [0.0, 1.0]}, r"row 2, column .t.: expected a time, got an empty"),
        ({"t": [1.0, 0.5], "y": [0.0, 1.0]}, r"row 2: .*0.5 s after 1.0 s in row 1"),
        ({"t": [0.0, 1.0], "y": [0.0, np.inf]}, r"row 2, column 'y': .*finite number, got inf"),
        ({"t": [0.0]}, r"at least two named columns .*got 1"),
    ]
    check_refused(cases, lambda columns: read_field_data(parquet(tmp_path, columns)))


@pytest.mark.parametrize("stamps", [[np.inf, np.inf], [0.0, np.inf], [-np.inf, 0.0]])
@pytest.mark.parametrize("offset", [None, "first", 1.0])
def test_a_time_that_is_not_finite_is_refused(tmp_path, stamps, offset):
    """Also as the one that becomes t = 0; so is such an offset."""
    path = parquet(tmp_path, {"t": stamps, "y": [0.0, 1.0]})
    csv = written(tmp_path, "".join(f"{t},0\n" for t in ("t", *stamps)))
    for file in (path, csv):
        with pytest.raises(UsageError, match=r"(row|line) \d: expected a finite time, got -?inf"):
            read_field_data(file, offset=offset)
    with pytest.raises(UsageError, match=r"offset: expected a finite number or .*, got inf"):
        read_field_data(path, offset=np.inf)


def test_damaged_and_large_parquet_is_refused(tmp_path, monkeypatch):
    """By its name, and before its numbers are read."""
    path = parquet(tmp_path, {"t": T, "y": Y})
    content = path.read_bytes()
    names = parquet(tmp_path, {"t": T, "position": Y}).read_bytes()
    no_utf8 = names.replace(b"position", b"pos\xfftion")
    for damaged in (b"PAR1", content[:-20], content[:10] + bytes(40) + content[50:], no_utf8):
        broken = tmp_path / "broken.parquet"
        broken.write_bytes(damaged)
        with pytest.raises(UsageError, match=r"broken.parquet': not a valid Parquet file"):
            read_field_data(broken)
    monkeypatch.setattr(tables, "LARGEST", 63)
    monkeypatch.setattr(table, "read_bounded", lambda path, largest: path.read_bytes())
    with pytest.raises(UsageError, match="at most 7 numbers, got 4 rows of 2 columns"):
        read_field_data(path)


def test_without_pyarrow_the_way_out_is_said(tmp_path, monkeypatch):
    """What to install, or another format."""
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError, match=r"pip install 'cosim\[parquet\]'"):
        read_field_data(tmp_path / "field.parquet")


def test_samples_of_a_file_are_a_data_set(tmp_path):
    """The functions of theory fit them without a scenario; see test_field_data for the figures."""
    t = np.array([0.0, 0.001, 0.0021, 0.0029])
    path = written(tmp_path, "t,y\n0,1\n0.001,2\n0.0021,\n0.0029,4\n")
    data = cosim.read_field_data(path)
    record = DataSet(data.t, data["y"], np.sin(t)[:, np.newaxis], alpha(t))
    assert record.measured[:, 0].tolist() == [True, True, False, True]
    assert disturbed_plant(reduce(academic()), [0, 0]).C.shape == (1, 2)


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


def test_codes_for_missing_values_are_not_measured(tmp_path):
    """Numbers in every format, as they are; texts as they are written."""
    values = {"t": [0.0, 1.0, 2.0], "y": [-9999.0, 5.0, 7.0]}
    path = written(tmp_path, "t,y,z\n0,-9999,NA\n1,5,1\n2,7.0,-\n")
    for file in (path, parquet(tmp_path, values)):
        data = read_field_data(file, columns={"y": "y"}, missing=[-9999, "NA", 7])
        np.testing.assert_array_equal(data["y"][:, 0], [np.nan, 5.0, np.nan])
    with pytest.raises(UsageError, match=r"line 2, column 3 \('z'\): .*got text"):
        read_field_data(path, missing=[-9999])


def test_a_code_for_missing_values_is_a_number_also_in_quotes_and_of_float32(tmp_path):
    """A column of float32 has the float32 next to it; "-999.9" is meant as a number."""
    pyarrow = pytest.importorskip("pyarrow")
    text = written(tmp_path, "t,y\n0,-999.90\n1,5\n2,7\n")
    for kind in ("float32", "float64"):
        y = pyarrow.array([-999.9, 5.0, 7.0], kind)
        typed = parquet(tmp_path, {"t": [0.0, 1.0, 2.0], "y": y})
        for file in (text, typed):
            for code in (-999.9, "-999.9"):
                values = read_field_data(file, missing=[code])["y"][:, 0]
                np.testing.assert_array_equal(values, [np.nan, 5.0, 7.0])


def test_values_of_another_kind_are_refused_by_their_key(tmp_path):
    path = written(tmp_path, "t,y\n0,1\n1,9\n")
    for key, value in [
        ("missing", "-9999"),
        ("offset", "firstt"),
        ("offset", True),
        ("same_time", "first"),
    ]:
        with pytest.raises(UsageError, match=f"^{key}: expected .*, got {value!r}"):
            read_field_data(path, **{key: value})


def test_names_that_numpy_writes_are_read_where_blanks_separate(tmp_path):
    np.savetxt(tmp_path / "field.txt", [[0.0, 1.0], [1.0, 2.0]], header="t y")
    data = read_field_data(tmp_path / "field.txt", separator=" ")
    assert data["y"][:, 0].tolist() == [1.0, 2.0]


def test_a_whole_offset_is_exact_to_the_ns(tmp_path):
    """Of 19 digits, of which a double has 16."""
    begin = 1_700_000_000_123_456_789
    path = written(tmp_path, f"t [ns],y\n{begin},1\n{begin + 3},2\n")
    assert read_field_data(path, offset=begin).t.tolist() == [0.0, 3e-9]
    text = f"""
    scenario = {{ name = "s", stop = 3e-9, step = 1e-9 }}
    [components]
    d = {{ kind = "field-data", path = "field.csv", offset = {begin} }}
    """
    log = cosim.run(written(tmp_path, text, "s.toml"))
    np.testing.assert_allclose(log["d.y"], 1.0 + np.arange(4) / 3.0, rtol=1e-12)


def test_info_shows_what_is_read(tmp_path):
    """Times, distances, signals with their units, and how much was not measured."""
    path = written(tmp_path, "t [ms];y [mm];x[0];x[1]\n0;1;2;3\n1;;2;4\n4;1;2;4\n")
    content = describe_samples(str(path))
    assert content["samples"] == {
        "samples": 3,
        "times": "0.0 s to 0.004 s",
        "median distance": "0.002 s",
        "largest distance": "0.003 s",
    }
    assert content["signals"] == [
        {"signal": "y", "size": 1, "unit": "mm", "not measured": 1},
        {"signal": "x", "size": 2, "unit": None, "not measured": 0},
    ]
    found = {row["read as"]: (row["found"], row["key"]) for row in content["reading"]}
    assert found == {
        "separator": (";", "separator"),
        "decimal sign": (".", "decimal"),
        "names": ("line 1", "skip"),
        "not measured": ("empty cells, NaN", "missing"),
        "times": ("'t'", "time"),
        "time unit": ("ms", "time_unit"),
        "t = 0": ("0", "offset"),
    }


def test_info_shows_what_cannot_be_read_beside_what_can(tmp_path):
    """A column of texts is no reason to say nothing of the others."""
    path = written(tmp_path, "t,state,y\n0,on,1\n1,off,2\n")
    content = describe_samples(str(path))
    assert [row["signal"] for row in content["signals"]] == ["y"]
    (row,) = content["not read"]
    assert row["signal"] == "state"
    assert "line 2, column 2 ('state'): expected a number" in row["problem"]
