"""Tables as the field writes them, each with the numbers that stand there."""

import csv
import io
import math
import struct
import sys
from datetime import datetime, timedelta

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

import cosim
from cosim.errors import UsageError
from cosim.log.conversion import convert
from cosim.log.text import LogChoice
from cosim.scenario.data_files import table, tables
from cosim.scenario.data_files.field_file import read_field_data
from cosim.scenario.data_files.table import TableForm
from cosim.scenario.data_files.tables import read_table
from cosim.scenario.data_files.text_table import MOST_COLUMNS
from tests.scenario.refusals import check_refused

T = [0.0, 0.5, 1.0, 1.5]
Y = [1.0, 2.0, 3.5, 4.0]


@pytest.fixture
def written(tmp_path):
    """Return a function that writes a file and reads it as a table."""

    def read(content):
        path = tmp_path / "a.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_table(path)

    return read


def parquet(folder, columns, schema=None, name="field.parquet"):
    """Write columns with pyarrow; return the path."""
    pyarrow = pytest.importorskip("pyarrow")
    writer = pytest.importorskip("pyarrow.parquet")
    writer.write_table(pyarrow.table(columns, schema=schema), folder / name)
    return folder / name


# --- text ---


ROWS = "0,1\n0.5,2\n1,3.5\n1.5,4\n"
DATES = ["2024-03-01{0}12:00:00{1}", "2024-03-01{0}12:00:00.5{1}", "2024-03-01{0}12:00:01.000{1}"]
DATES.append("2024-03-01{0}12:00:01.500000000{1}")


def dated(blank, zone):
    rows = [f"{t.format(blank, zone)},{y}" for t, y in zip(DATES, Y, strict=True)]
    return "\n".join(["time,y", *rows])


TEXTS = {
    "plain": (f"t,y\n{ROWS}", None),
    "spaces and empty lines": (" t , y [mm] \n\n 0 , 1 \n0.5,2\n\n1,3.5\n 1.5,4", "mm"),
    "quotes": ('"t","p, q","y"\n0,"a",1\n0.5,"b, c","2"\n1,"d",3.5\n1.5,e,4e0\n', None),
    "bars": ("t|y\n0|1\n.5|2\n1|3.5\n1.5|4E0\n", None),
    "decimal commas": ("time;y\n0,0;1,0\n0,5;2,0\n1,0;3,5\n1,5;4,0\n", None),
    "tabs and decimal commas": ("time\ty [m/s]\n0\t1\n0,5\t2\n1\t3,5\n1,5\t4\n", "m/s"),
    "separators at the ends": ("time;y\n0;1;\n0,5;2;\n1;3,5;\n1,5;4;\n", None),
    "comments": (f"# tank 3\n# rate: 2 Hz, 4 rows\ntime,y\n0,1\n# paused\n{ROWS[4:]}", None),
    "names in a comment": (f"# of numpy\n# 2024-03-01,A\n# time,y\n{ROWS}", None),
    "a preamble": (f"Logger 5\nDevice,ABC\nDate,2024-01-01\n\ntime,y\n{ROWS}", None),
    "a date above": (f"Datum,01.03.2024\nwhen [s],y\n{ROWS}", None),
    "a row of units": ("time,y,n\nms,mm,-\n0,1,0\n500,2,0\n1000,3.5,0\n1500,4,0\n", "mm"),
    "units in brackets": ("time,y,n\n[ms],[rpm],\n0,1,0\n500,2,0\n1e3,3.5,0\n1500,4,0\n", "rpm"),
    "units in words": ("y;t\nBar;Millisekunden\n1,0;0\n2;500\n3,5;1000\n4;1500\n", "Bar"),
    "ISO dates": (dated("T", "Z"), None),
    "ISO dates as databases write them": (dated(" ", "+01"), None),
}


@pytest.mark.parametrize("form", TEXTS)
def test_texts_of_every_form_have_the_same_samples(tmp_path, form):
    """In every encoding that says what it is, with every end of line."""
    text, unit = TEXTS[form]
    path = tmp_path / "field.txt"
    for encoding, end in (("utf-8", "\n"), ("utf-8-sig", "\r"), ("utf-16", "\r\n")):
        path.write_bytes(text.replace("\n", end).encode(encoding))
        data = read_field_data(path, offset="first", columns={"y": "y"})
        assert (data.t.tolist(), data["y"][:, 0].tolist()) == (T, Y)
        assert data.signals[0].unit == unit
        assert data.diagnostics == ()


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("t#y\n0#1\n0.5#2\n1#3.5\n1.5#4\n", {"separator": "#"}),
        ("  t    y\n 0.0  1\n 0.5  2\n 1.0  3.5 \n 1.5  4\n", {"separator": " "}),
        ("# t y\n0 1\n0.5 2\n1 3.5\n1.5 4\n", {"separator": " "}),
        ('"t","y"\n"0,0","1"\n"0,5","2"\n"1,0","3,5"\n"1,5","4"\n', {"decimal": ","}),
        ("%1,2\n1,2\nt,y\n%x\n0,1\n0.5,2\n1,3.5\n1.5,4\n", {"skip": 2, "comment": "%"}),
    ],
)
def test_keys_say_what_is_not_found(tmp_path, text, options):
    """A separator, several blanks as one, the decimal sign, where the names are, comments."""
    path = tmp_path / "field.csv"
    path.write_text(text)
    data = read_field_data(path, **options)
    assert (data.t.tolist(), data["y"][:, 0].tolist()) == (T, Y)


def test_columns_are_found_with_and_without_their_units(written):
    """All of the first line is a name too; one name of several columns is refused."""
    table = written("t [ms],y [mm],y [N],x[0]\n0,1,2,3\n")
    found = table.find(["t", "y [N]", "x[0]"])
    assert [(one.name, one.unit) for one in found] == [("t", "ms"), ("y", "N"), ("x[0]", None)]
    assert table.columns(found).tolist() == [[0.0, 2.0, 3.0]]
    names = [f"c{i}" for i in range(5000)]
    many = written(f"{','.join(names)}\n{','.join('0' * 5000)}\n")
    gap = written("t,u\n0,1\n1,\n")
    for refused, pattern in [
        (lambda: table.find(["y"]), r"unique column 'y', got 2"),
        (lambda: table.find(["T"]), r"no column 'T'; available: t, y, x\[0\]$"),
        (lambda: written("t,u,u\n0,1,2\n").find(None), r"unique column names, got 2 columns 'u'"),
        (lambda: gap.columns(gap.headers), r"line 3, column 2 \('u'\): .*got an empty cell"),
        (lambda: many.find(["elsewhere"]), r"c99, and 4900 more$"),
    ]:
        with pytest.raises(UsageError, match=pattern):
            refused()


def test_a_table_source_and_a_look_up_read_the_same_forms(tmp_path):
    """Semicolons, decimal commas and a row of units."""
    (tmp_path / "s.csv").write_text("t;level\nms;mm\n0;1,5\n1000;2,5\n", encoding="utf-16")
    u = '{ kind = "table", file = "s.csv" }'
    f = '{ kind = "look-up-table", file = "s.csv", columns = ["level", "t"], skip = 0 }'
    head = 'scenario = { name = "s", stop = 1.0, step = 0.5 }'
    connections = '[connections]\n"f.u" = "u.y"\n'
    (tmp_path / "s.toml").write_text(f"{head}\n[components]\nu = {u}\nf = {f}\n{connections}")
    log = cosim.run(tmp_path / "s.toml")
    assert log["u.y"].tolist() == [1.5, 2.0, 2.5]
    assert log["f.y"].tolist() == [0.0, 500.0, 1000.0]


NO_TABLES = [
    (b"0,1\n1,2\n", r"column names in line 1, got numbers"),
    (b"t,u\n0,1,2\n1,2,3\n", r"3 names of columns above line 2.*got 2 in line 1"),
    (b"t,u\n0,1\n1,2\n1\n", r"line 4: expected 2 cells, got 1"),
    (b"t,u\n0\n1,2\n1,3\n", r"line 2: expected 2 cells, got 1"),
    (b"t,u\n0,1\n1,2,3\n", r"line 3: expected 2 cells, got 3; quote a cell"),
    (b't,u\n0,"1\n1,2"\n', r"line 2 cannot be split"),
    (b't,u\n0,"1"x\n', r"line 2 cannot be split"),
    (b"a,b\n1,2\n3,4\nt,u,v\n0,1,2\n1,1,2\n2,1,2\n", r"line 2: .*above the names .*skip = 3"),
    (b"Logger,A\nt,n/a\nn/a,1\n0,1\n", r"line 3: expected names .*or numbers, got both; skip = 2"),
    (b"t;u\n0;1,500\n1;2,250\n", r"decimal signs or separate thousands.*decimal = "),
    (b"t,u\na,b\nc,d\n", r"expected rows of numbers, got text"),
    (b"t  u\n0  1\n", r"at least two named columns .*got 1 .*; separator = \" \" splits"),
    (b"", r"at least two named columns .*got 0"),
    (b"t\0u", r"got a NUL"),
    ("t,gr\u00f6\u00dfe\n0,1\n".encode("latin-1"), r"UTF-8 or UTF-16 text.*byte 4"),
    (b"t" + b",u" * MOST_COLUMNS + b"\n0\n", r"at most 100000 columns, got 100001"),
]


def test_another_file_than_a_table_is_refused_with_its_place(written):
    """Line and column, counted from 1."""
    check_refused(NO_TABLES, written)


def test_files_that_cannot_be_read_are_refused(tmp_path, monkeypatch):
    """Missing, another thing than a file, or larger than is allowed."""
    path = tmp_path / "field.csv"
    path.write_text("t,y\n0,1\n")
    monkeypatch.setattr(table, "LARGEST", 7)
    for file, pattern in [
        (tmp_path / "gone.csv", r"gone.csv' cannot be read: No such file"),
        (tmp_path, r"cannot be read: it is a folder"),
        (path, r"cannot be read: it is too large: more than 7 bytes"),
    ]:
        with pytest.raises(UsageError, match=pattern):
            read_table(file)


SECRETS = [
    "root:$6$ZebraQuagga:19000:0:99999:7:::\ndaemon:*:19000:0:99999:7:::\n",
    "Zebra,Quagga\nZebraQuagga,Quagga\n",
    "ZebraQuagga\n-----BEGIN PRIVATE KEY-----\n",
    "Zebra\xfcQuagga\n1",
]


def test_the_content_of_another_file_than_a_table_is_not_quoted(written):
    """A file named in a scenario of another must not come out by way of a message."""
    quoted = []
    for secret in SECRETS:
        for encoding in ("utf-8", "latin-1"):
            with pytest.raises(UsageError) as error:
                written(secret.encode(encoding)).find(["t"])
            chain = [str(error.value), str(error.value.__cause__)]
            quoted += [text for text in chain if "Zebra" in text or "Quagga" in text]
    assert quoted == []


CELLS = st.one_of(
    st.floats().map(repr),
    st.sampled_from(
        ["", " ", "1", " 2 ", "nan", "-inf", "1e400", '"3"', '"', "1_0", "x", "t", "#"]
    ),
    st.text(alphabet='0123456789.eE+-_ "#;\t\0\x85\u2028\u0661abcxX\ufeff', max_size=6),
)
FILES = st.tuples(
    st.sampled_from(["t,u", "t", "u,t", '"t",u', "1,2", "t,t", ""]),
    st.lists(st.lists(CELLS, min_size=1, max_size=3).map(",".join), max_size=4),
    st.sampled_from(["\n", "\r\n", "\r"]),
)


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(FILES)
def test_a_crafted_file_is_read_right_or_refused(tmp_path_factory, file):
    """Whatever comes out is what the csv module and Python's floats give; all else is one error."""
    header, rows, end = file
    text = end.join([header, *rows])
    path = tmp_path_factory.getbasetemp() / "crafted.csv"
    path.write_bytes(text.encode())
    try:
        table = read_table(path, TableForm(separator=",", comment="", skip=0))
        found = table.columns(table.find(None))
    except UsageError:
        return
    lines = text.removeprefix("\ufeff").split(end)
    if any(row.what == "units" for row in table.reading):
        lines.pop(next(i for i, line in enumerate(lines) if i and line.strip()))
    filled = [line for line in lines if line.strip()]
    cells = list(csv.reader(io.StringIO("\n".join(filled), newline=None), strict=True))
    names = [name.strip() for name in cells[0]]
    values = [list(map(float, row)) for row in cells[1:] if any(map(str.strip, row))]
    if len(table.headers) < len(names):
        assert all(line.rstrip().endswith(",") for line in filled)
        values = [row[:-1] for row in values]
        names.pop()
    assert [header.text for header in table.headers] == names
    assert np.array_equal(found, np.array(values).reshape(found.shape))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.lists(st.floats(allow_infinity=False), min_size=2, max_size=2), min_size=1))
def test_numbers_come_back_bit_for_bit(tmp_path_factory, rows):
    """The shortest text of a double is read as that double; NaN was not measured."""
    path = tmp_path_factory.getbasetemp() / "numbers.csv"
    path.write_text("\n".join(["t,u", *(",".join(map(repr, row)) for row in rows)]))
    table = read_table(path)
    for position in (0, 1):
        for found, row in zip(table.values(position).tolist(), rows, strict=True):
            assert found == row[position] or (math.isnan(found) and math.isnan(row[position]))


# --- Excel ---


def sheet(path, *sheets):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.remove(book.active)
    for title, rows in sheets:
        page = book.create_sheet(title)
        for row in rows:
            page.append(row)
    book.save(path)
    return path


def test_sheets_of_excel(tmp_path):
    """Names above the numbers, units below them, dates and durations, texts; one that is not empty.

    Dates of Excel are days in a double: they are read to the ms.
    """
    begin = datetime(2024, 3, 1, 12)
    pairs = list(zip(T, Y, strict=True))
    units = [["Logger 5"], [], ["time", "y", "n"], ["ms", "mm"], *[[1e3 * t, y] for t, y in pairs]]
    forms = {
        "plain": [["time", "y"], *pairs],
        "units": units,
        "dates": [["when", "y"], *[[begin + timedelta(seconds=t), y] for t, y in pairs]],
        "durations": [["when", "y"], *[[timedelta(days=1, seconds=t), y] for t, y in pairs]],
        "texts": [["t", "y"], *[[str(t), str(y)] for t, y in pairs]],
    }
    for form, rows in forms.items():
        path = sheet(tmp_path / "a.xlsx", (form, rows), ("empty", []))
        data = read_field_data(path, offset="first", columns={"y": "y"})
        assert (data.t.tolist(), data["y"][:, 0].tolist()) == (T, Y), form
        assert data.signals[0].unit == ("mm" if form == "units" else None)


def test_sheets_that_are_not_what_is_asked_for_are_refused(tmp_path, monkeypatch):
    """One of several is selected; a formula without a value was saved by no Excel."""
    tables = [(name, [["t", "y"], [0, value]]) for name, value in (("one", 1), ("two", 2))]
    two = sheet(tmp_path / "two.xlsx", *tables)
    assert read_field_data(two, sheet="two")["y"].tolist() == [[2.0]]
    rows = [["t", "y"], [0, 1], [1, "=B2+1"], [2, None]]
    formula = sheet(tmp_path / "formula.xlsx", ("one", rows))
    broken = tmp_path / "broken.xlsx"
    broken.write_bytes(b"PK\3\4")
    cases = [
        (two, {}, r"one sheet with cells, got one, two; .*by sheet"),
        (two, {"sheet": "tow"}, r"no sheet 'tow'; did you mean 'two'"),
        (formula, {}, r"sheet 'one', cell B3: .*formula.*save it in Excel"),
        (broken, {}, r"broken\.xlsx': not a valid Excel file"),
    ]
    check_refused(cases, lambda path, options: read_field_data(path, **options))
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with pytest.raises(UsageError, match=r"pip install 'cosim\[excel\]', or save .* as CSV"):
        read_table(two)


# --- Parquet ---


def test_parquet_gives_the_samples_of_a_csv(tmp_path):
    """Nulls and NaN are not measured; whole numbers are numbers; a unit may be beside the name."""
    pyarrow = pytest.importorskip("pyarrow")
    y = [1.0, None, math.nan, 4.0]
    path = parquet(tmp_path, {"t [ms]": [0, 500, 1000, 1500], "y [mm]": y, "s": list("abcd")})
    data = read_field_data(path, columns={"y": "y"})
    assert data.t.tolist() == T
    np.testing.assert_array_equal(data["y"][:, 0], [1.0, np.nan, np.nan, 4.0])
    assert data.signals[0].unit == "mm"
    for name, unit, expected in (("y", b"mm", "mm"), ("y [mm]", b"mm", "mm"), ("y", b"-", "1")):
        time = pyarrow.field("t", pyarrow.float64(), metadata={"unit": "ms"})
        values = pyarrow.field(name, pyarrow.float64(), metadata={"unit": unit})
        path = parquet(tmp_path, {"t": T, name: Y}, pyarrow.schema([time, values]))
        data = read_field_data(path)
        assert [(signal.name, signal.unit) for signal in data.signals] == [("y", expected)]
        np.testing.assert_allclose(data.t, np.multiply(T, 1e-3), rtol=1e-15)
    values = pyarrow.field("y [m]", pyarrow.float64(), metadata={"unit": "mm"})
    path = parquet(tmp_path, {"t": T, "y [m]": Y}, pyarrow.schema([time, values]))
    with pytest.raises(UsageError, match=r"'y \[m\]': expected one unit, got 'm'.*'mm'"):
        read_field_data(path)


def test_time_stamps_of_parquet_have_their_unit(tmp_path):
    """To the ns, in 2023 too."""
    pyarrow = pytest.importorskip("pyarrow")
    stamps = 1_700_000_000_000_000_000 + np.array([0, 1_000_000, 2_100_001])
    for kind in (pyarrow.timestamp("ns"), pyarrow.duration("ns")):
        path = parquet(tmp_path, {"when": pyarrow.array(stamps, kind), "y": Y[:3]})
        data = read_field_data(path, offset="first")
        np.testing.assert_allclose(data.t, [0.0, 1e-3, 2.100001e-3], rtol=1e-15)


def test_columns_of_one_name_are_each_their_own(tmp_path):
    """As of units beside them, which tell them apart where one has the times."""
    pyarrow = pytest.importorskip("pyarrow")
    stamps = pyarrow.array([0, 500], pyarrow.duration("ms"))
    columns = pyarrow.Table.from_arrays([pyarrow.array([3.0, 4.0]), stamps], ["t [s]", "t [s]"])
    pytest.importorskip("pyarrow.parquet").write_table(columns, tmp_path / "a.parquet")
    table = read_table(tmp_path / "a.parquet")
    assert table.values(0).tolist() == [3.0, 4.0]
    assert list(map(float, table.times(1))) == [0.0, 500.0]


def test_parquet_without_a_table_of_samples_is_refused(tmp_path):
    """As a CSV is, with the row."""
    cases = [
        ({"t": [0.0, 1.0], "y": ["a", "b"]}, r"column 'y': expected numbers, got type string"),
        ({"t": ["a", "b"], "y": [0.0, 1.0]}, r"column 't': expected numbers, got type string"),
        ({"t": [0.0, None], "y": [0.0, 1.0]}, r"row 2, column 't': expected a finite time"),
        ({"t": [1.0, 0.5], "y": [0.0, 1.0]}, r"row 2: .*0.5 s after 1.0 s in row 1"),
        ({"t": [0.0, 1.0], "y": [0.0, np.inf]}, r"row 2, column 'y': .*finite number, got inf"),
        ({"t": [0, 1], "y": [0, 2**53 + 1]}, r"row 2, column 'y': .*2\*\*53"),
        ({"t": [0.0]}, r"at least two named columns .*got 1"),
    ]
    check_refused(cases, lambda columns: read_field_data(parquet(tmp_path, columns)))


def test_damaged_and_large_parquet_is_refused(tmp_path, monkeypatch):
    """By its name, and before its numbers are read; without pyarrow with the way out."""
    path = parquet(tmp_path, {"t": T, "y": Y})
    content = path.read_bytes()
    named = parquet(tmp_path, {"t": T, "position": Y}, name="named.parquet").read_bytes()
    no_utf8 = named.replace(b"position", b"pos\xfftion")
    broken = tmp_path / "broken.parquet"
    for damaged in (b"PAR1", content[:-20], content[:10] + bytes(40) + content[50:], no_utf8):
        broken.write_bytes(damaged)
        with pytest.raises(UsageError, match=r"broken.parquet': not a valid Parquet file"):
            read_field_data(broken)
    monkeypatch.setattr(tables, "LARGEST", 63)
    with pytest.raises(UsageError, match="at most 7 numbers, got 4 rows of 2 columns"):
        read_field_data(path)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError, match=r"pip install 'cosim\[parquet\]'"):
        read_field_data(path)


# --- MAT-files ---


def mat4(**variables):
    """Return a MAT-file of version 4, as Dymola and OpenModelica write them."""
    content = b""
    for name, values in variables.items():
        array = np.asarray(values)
        kind = {"U": 51, "i": 20}.get(array.dtype.kind, 10 if array.dtype == np.float32 else 0)
        if kind == 51:
            array = np.vectorize(ord)(array).astype(np.uint8)
        array = array.astype({0: "<f8", 10: "<f4", 20: "<i4"}.get(kind, "u1"))
        content += struct.pack("<5i", kind, *array.shape, 0, len(name) + 1)
        content += name.encode() + b"\0" + array.tobytes(order="F")
    return content


def trajectory(form="binTrans"):
    """Return a trajectory with an event at 1 s, an alias of the other sign and a parameter."""

    def characters(*texts):
        width = max(map(len, texts))
        return np.array([list(text.ljust(width)) for text in texts])

    turned = np.transpose if form == "binTrans" else np.asarray
    info = np.array([[0, 1, 0, -1], [2, 2, 0, -1], [1, 2, 0, 0], [2, -2, 0, -1], [1, 3, 0, 0]])
    rows = [[0.0, 0.5, 1.0, 1.0, 1.5], [1.0, 2.0, 3.0, 3.5, 4.0]]
    return mat4(
        Aclass=characters("Atrajectory", "1.1", "", form),
        name=turned(characters("time", "motor.w[1]", "k", "load.w", "der(m)")),
        description=turned(characters("Time in [s]", "speed [rad/s|rpm]", "gain", "[rad/s]", "")),
        dataInfo=turned(info),
        data_1=turned(np.array([[0.0, 7.0, 9.0], [1.5, 7.0, 9.0]])),
        data_2=turned(np.array(rows, np.float32).T),
    )


@pytest.mark.parametrize("form", ["binTrans", "binNormal"])
def test_a_trajectory_of_dymola_has_names_units_and_aliases(tmp_path, form):
    """At an event two rows have one time: the later one counts."""
    path = tmp_path / "result.mat"
    path.write_bytes(trajectory(form))
    data = read_field_data(path)
    assert data.t.tolist() == T
    expected = {"motor.w[1]": ("rad/s", Y), "load.w": ("rad/s", [-y for y in Y])}
    expected |= {"k": (None, [7.0] * 4), "der(m)": (None, [9.0] * 4)}
    found = {one.name: (one.unit, one.values[:, 0].tolist()) for one in data.signals}
    assert found == expected
    (note,) = data.diagnostics
    assert "1 of 5 rows dropped" in note
    path.write_bytes(trajectory(form)[:-3])
    with pytest.raises(UsageError, match=r"result\.mat': not a valid MAT-file"):
        read_field_data(path)


def test_matrices_of_equally_many_rows_are_read(tmp_path):
    """As MATLAB saves them, in the usual order of bytes; a converted log is refused."""
    arrays = {"t": T, "y": np.array(Y), "x": np.ones((4, 2)), "gain": 3.0, "name": "tank"}
    scipy.io.savemat(tmp_path / "b.mat", arrays)
    data = read_field_data(tmp_path / "b.mat")
    assert (data.t.tolist(), data["y"][:, 0].tolist(), data["x"].shape) == (T, Y, (4, 2))
    assert [signal.name for signal in data.signals] == ["y", "x"]
    content = (tmp_path / "b.mat").read_bytes()
    for mark in (b"\1\0MI", b"\0\1XX"):  # scipy would read the first, without checks
        (tmp_path / "other.mat").write_bytes(content[:124] + mark + content[128:])
        with pytest.raises(UsageError, match=r"MAT-file: expected .* version 4 to 7: .*save -v7"):
            read_field_data(tmp_path / "other.mat")
    log = cosim.run("pair", set={"scenario.stop": 0.1}, out=tmp_path / "a.mcap")
    convert(LogChoice.of(log), tmp_path / "a.mat")
    with pytest.raises(UsageError, match=r"a\.mat': .*use the log itself"):
        read_field_data(tmp_path / "a.mat")


@pytest.mark.slow
def test_a_damaged_trajectory_is_refused_or_read(tmp_path):
    """No other error, no crash; see test_model_sources for files as MATLAB writes them."""
    path = tmp_path / "a.mat"
    good = trajectory()
    rng = np.random.default_rng(0)
    refused = 0
    for trial in range(300):
        damaged = bytearray(good)
        for place in rng.integers(0, len(good), 3):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged[: rng.integers(len(damaged))] if trial % 5 == 0 else damaged)
        try:
            table = read_table(path)
            for header in table.headers:
                table.values(header.position)
        except UsageError:
            refused += 1
    assert refused > 50
