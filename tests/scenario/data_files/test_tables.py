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
from cosim.log.conversion.choice import LogChoice
from cosim.log.conversion.files import convert
from cosim.scenario.data_files.field_file import read_field_data
from cosim.scenario.data_files.table import TableForm
from cosim.scenario.data_files.tables import read_table
from cosim.scenario.data_files.text_table import MOST_COLUMNS
from tests.scenario.refusals import check_refused


@pytest.fixture
def written(tmp_path):
    """Return a function that writes a file and reads it as a table."""

    def read(content):
        path = tmp_path / "a.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_table(path)

    return read


@pytest.mark.parametrize(
    "content",
    [
        "t,u\n0,1\n0.5,-2e3\n",
        "t,u\n0,1\n0.5,-2e3",
        "t,u\r\n0,1\r\n0.5,-2e3\r\n",
        "t,u\r0,1\r0.5,-2e3\r",
        "\ufefft,u\n0,1\n0.5,-2e3\n",
        '"t","u"\n"0","1"\n"0.5","-2e3"\n',
        " t , u \n\n 0 , 1 \n\n 0.5 , -2e3 \n\n",
    ],
    ids=["plain", "no end of line", "CRLF", "CR", "byte order mark", "quoted", "spaces"],
)
def test_the_ways_to_write_one_table(written, content):
    """Programs differ in their ends of lines, byte order marks, quotes and spaces."""
    table = written(content)
    assert [header.text for header in table.find(None)] == ["t", "u"]
    assert table.columns(table.find(None)).tolist() == [[0.0, 1.0], [0.5, -2000.0]]
    assert table.columns(table.find(["u", "t"])).tolist() == [[1.0, 0.0], [-2000.0, 0.5]]


def test_columns_are_found_with_and_without_their_units(written):
    """All of the first line is a name too; one name of several columns is refused."""
    table = written("t [ms],y [mm],y [N],x[0]\n0,1,2,3\n")
    found = table.find(["t", "y [N]", "x[0]"])
    assert [(header.name, header.unit) for header in found] == [
        ("t", "ms"),
        ("y", "N"),
        ("x[0]", None),
    ]
    assert table.columns(found).tolist() == [[0.0, 2.0, 3.0]]
    with pytest.raises(UsageError, match=r"unique column 'y', got 2"):
        table.find(["y"])


T = [0.0, 0.5, 1.0, 1.5]
Y = [1.0, 2.0, 3.5, 4.0]
ROWS_BELOW = "0,1\n0.5,2\n1,3.5\n1.5,4\n"
DATES = ["2024-03-01{0}12:00:00{1}", "2024-03-01{0}12:00:00.5{1}", "2024-03-01{0}12:00:01.000{1}"]
DATES.append("2024-03-01{0}12:00:01.500000000{1}")


def dated(blank, zone):
    rows = [f"{t.format(blank, zone)},{y}" for t, y in zip(DATES, Y, strict=True)]
    return "\n".join(["time,y", *rows])


TEXTS = {
    "ISO dates with T": (dated("T", ""), None),
    "ISO dates with a blank": (dated(" ", ""), None),
    "ISO dates of UTC": (dated("T", "Z"), None),
    "ISO dates with an offset": (dated("T", "+01:00"), None),
    "ISO dates as databases write them": (dated(" ", "+01"), None),
    "comments": (f"# tank 3\n# rate: 2 Hz, 4 rows\ntime,y\n0,1\n# paused\n{ROWS_BELOW[4:]}", None),
    "names in a comment": (f"# of numpy\n# time,y\n{ROWS_BELOW}", None),
    "a preamble": (f"Logger 5\nDevice,ABC\nDate,2024-01-01\n\ntime,y\n{ROWS_BELOW}", None),
    "a date above": (f"Datum,01.03.2024\nwhen [s],y\n{ROWS_BELOW}", None),
    "a preamble of as many cells": (f"Rate,100\nDate,2024-01-01\ntime,y\n{ROWS_BELOW}", None),
    "a row of units": ("time,y,n\nms,mm,-\n0,1,0\n500,2,0\n1000,3.5,0\n1500,4,0\n", "mm"),
    "units in brackets": ("time,y,n\n[ms],[rpm],\n0,1,0\n500,2,0\n1e3,3.5,0\n1500,4,0\n", "rpm"),
    "units in words": ("y;t\nBar;Millisekunden\n1,0;0\n2;500\n3,5;1000\n4;1500\n", "Bar"),
    "units of German words": ("Zeit;y\nSekunden;Bar\n0;1,0\n0,5;2\n1;3,5\n1,5;4\n", "Bar"),
    "decimal commas": ("time;y\n0,0;1,0\n0,5;2,0\n1,0;3,5\n1,5;4,0\n", None),
    "separators at the ends": ("time;y\n0;1;\n0,5;2;\n1;3,5;\n1,5;4;\n", None),
    "tabs and decimal commas": ("time\ty [m/s]\n0\t1\n0,5\t2\n1\t3,5\n1,5\t4\n", "m/s"),
    "commas within cells": (
        "t;place;y\n0;a, b;1\n0.5;c, d;2\n1;e, f;3.5\n1.5;g, h;4\n",
        None,
    ),
}


@pytest.mark.parametrize("form", TEXTS)
def test_texts_of_every_form_have_the_same_samples(tmp_path, form):
    """And of every encoding that says what it is."""
    text, unit = TEXTS[form]
    path = tmp_path / "field.txt"
    for encoding in ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"):
        path.write_bytes(text.replace("\n", "\r\n").encode(encoding))
        data = read_field_data(path, offset="first", columns={"y": "y"})
        assert (data.t.tolist(), data["y"][:, 0].tolist()) == (T, Y)
        assert data.signals[0].unit == unit
        assert data.diagnostics == ()


def test_keys_say_what_is_not_found(tmp_path):
    """Lines before the names, other comments, and codes for what was not measured."""
    path = tmp_path / "field.csv"
    path.write_text("%1,2\n1,2\nt,3,4\n%x\n0,-9999,NA\n1,7,-\n2,-9999.0,1\n")
    data = read_field_data(path, skip=2, comment="%", missing=[-9999, "NA", "-"])
    np.testing.assert_array_equal(data["3"][:, 0], [np.nan, 7.0, np.nan])
    np.testing.assert_array_equal(data["4"][:, 0], [np.nan, np.nan, 1.0])
    with pytest.raises(UsageError, match=r"line 2: expected no row of numbers above.*skip = 2"):
        read_field_data(path, comment="%", missing=["NA", "-"])
    with pytest.raises(UsageError, match=r"line 5, column 3 \('4'\): expected a number .*got text"):
        read_field_data(path, skip=2, comment="%")


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
    """Names above the numbers, units below them, dates and durations; one sheet of several.

    Dates of Excel are days in a double: they are read to the ms.
    """
    begin = datetime(2024, 3, 1, 12)
    pairs = list(zip(T, Y, strict=True))
    forms = {
        "plain": [["time", "y"], *pairs],
        "named": [
            ["Logger 5"],
            [],
            ["time", "y", "n"],
            ["ms", "mm"],
            *[[1e3 * t, y] for t, y in pairs],
        ],
        "dates": [["when", "y"], *[[begin + timedelta(seconds=t), y] for t, y in pairs]],
        "durations": [["when", "y"], *[[timedelta(days=1, seconds=t), y] for t, y in pairs]],
        "texts": [
            ["t", "y"],
            *[[str(t).replace(".", ","), str(y)[:-2] or y] for t, y in pairs[:2]],
        ],
    }
    for form, rows in forms.items():
        data = read_field_data(
            sheet(tmp_path / "a.xlsx", (form, rows), ("empty", [])),
            offset="first",
            columns={"y": "y"},
        )
        count = len(data.t)
        assert (data.t.tolist(), data["y"][:, 0].tolist()) == (T[:count], Y[:count]), form
        assert data.signals[0].unit == ("mm" if form == "named" else None)
    path = sheet(
        tmp_path / "two.xlsx", ("one", [["t", "y"], [0, 1]]), ("two", [["t", "y"], [0, 2]])
    )
    assert read_field_data(path, sheet="two")["y"].tolist() == [[2.0]]
    with pytest.raises(UsageError, match=r"one sheet with cells, got one, two; .*by sheet"):
        read_field_data(path)
    with pytest.raises(UsageError, match="no sheet 'tow'; did you mean 'two'"):
        read_field_data(path, sheet="tow")
    path = sheet(tmp_path / "formula.xlsx", ("one", [["t", "y"], [0, 1], [1, "=B2+1"], [2, None]]))
    with pytest.raises(UsageError, match=r"sheet 'one', cell B3: .*formula.*save it in Excel"):
        read_field_data(path)
    path = tmp_path / "two.xlsx"
    path.write_bytes(b"PK\3\4")
    with pytest.raises(UsageError, match=r"two\.xlsx': not a valid Excel file"):
        read_field_data(path)


def test_without_openpyxl_the_way_out_is_said(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with pytest.raises(UsageError, match=r"pip install 'cosim\[excel\]', or save .* as CSV"):
        read_table(tmp_path / "a.xlsx")


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


def characters(*texts):
    width = max(map(len, texts))
    return np.array([list(text.ljust(width)) for text in texts])


@pytest.mark.parametrize("form", ["binTrans", "binNormal"])
def test_a_trajectory_of_dymola_has_names_units_and_aliases(tmp_path, form):
    """An alias may have the other sign, a parameter has one value.

    At an event two rows have one time: the later one counts.
    """
    turned = np.transpose if form == "binTrans" else np.asarray
    t = [0.0, 0.5, 1.0, 1.0, 1.5]
    speed = [1.0, 2.0, 3.0, 3.5, 4.0]
    info = np.array([[0, 1, 0, -1], [2, 2, 0, -1], [1, 2, 0, 0], [2, -2, 0, -1], [1, 3, 0, 0]])
    content = mat4(
        Aclass=characters("Atrajectory", "1.1", "", form),
        name=turned(characters("time", "motor.w[1]", "k", "load.w", "der(m)")),
        description=turned(characters("Time in [s]", "speed [rad/s|rpm]", "gain", "[rad/s]", "")),
        dataInfo=turned(info),
        data_1=turned(np.array([[0.0, 7.0, 9.0], [1.5, 7.0, 9.0]])),
        data_2=turned(np.array([t, speed], np.float32).T),
    )
    path = tmp_path / "result.mat"
    path.write_bytes(content)
    data = read_field_data(path)
    assert data.t.tolist() == T
    names = ("motor.w[1]", "load.w", "k", "der(m)")
    found = {name: data[name][:, 0].tolist() for name in names}
    assert found == {names[0]: Y, "load.w": [-y for y in Y], "k": [7.0] * 4, "der(m)": [9.0] * 4}
    assert [signal.unit for signal in data.signals] == ["rad/s", None, "rad/s", None]
    (note,) = data.diagnostics
    assert "1 of 5 rows dropped" in note
    path.write_bytes(content[:-3])
    with pytest.raises(UsageError, match=r"result\.mat': not a valid MAT-file"):
        read_field_data(path)


def test_matrices_of_equally_many_rows_are_read(tmp_path):
    """Of arrays as MATLAB saves them; a converted log is refused, as the log itself says more."""
    arrays = {"t": T, "y": np.array(Y), "x": np.ones((4, 2)), "gain": 3.0, "name": "tank"}
    scipy.io.savemat(tmp_path / "b.mat", arrays)
    data = read_field_data(tmp_path / "b.mat")
    assert (data.t.tolist(), data["y"][:, 0].tolist(), data["x"].shape) == (T, Y, (4, 2))
    assert [signal.name for signal in data.signals] == ["y", "x"]
    log = cosim.run("pair", set={"scenario.stop": 0.1}, out=tmp_path / "a.mcap")
    convert(LogChoice.of(log), tmp_path / "a.mat")
    with pytest.raises(UsageError, match=r"a\.mat': .*use the log itself"):
        read_field_data(tmp_path / "a.mat")


def test_a_table_source_and_a_look_up_read_the_same_forms(tmp_path):
    """Semicolons, decimal commas and a row of units."""
    (tmp_path / "s.csv").write_text("t;level\nms;mm\n0;1,5\n1000;2,5\n", encoding="utf-16")
    (tmp_path / "s.toml").write_text(
        """
        scenario = { name = "s", stop = 1.0, step = 0.5 }
        [components]
        u = { kind = "table", file = "s.csv" }
        f = { kind = "look-up-table", file = "s.csv", columns = ["level", "t"], skip = 0 }
        [connections]
        "f.u" = "u.y"
        """
    )
    log = cosim.run(tmp_path / "s.toml")
    assert log["u.y"].tolist() == [1.5, 2.0, 2.5]
    assert log["f.y"].tolist() == [0.0, 500.0, 1000.0]


NO_TABLES = [
    (b"0,1\n1,2\n", r"column names in line 1, got numbers"),
    (b"t,u\n0,1,2\n1,2,3\n", r"3 names of columns above line 2.*got 2 in line 1"),
    (b"t,u\n0,1\n1,2\n1\n", r"line 4: expected 2 cells, got 1"),
    (b"t,u\n0\n1,2\n1,3\n", r"line 2: expected 2 cells, got 1"),
    (b't,u\n0,"1\n1,"2\n', r"line 2 cannot be split"),
    (b'"t,u\n"0,1\n', r"line 2 cannot be split"),
    (b"a,b\n1,2\n3,4\nt,u,v\n0,1,2\n1,1,2\n2,1,2\n", r"line 2: .*above the names .*skip = 3"),
    (b"Logger,A\nt,n/a\nn/a,1\n0,1\n", r"line 3: expected names .*or numbers, got both"),
    (b"t;u\n0;1,500\n1;2,250\n", r"decimal signs or separate thousands.*decimal = "),
    ("t,gr\u00f6\u00dfe\n0,1\n".encode("latin-1"), r"UTF-8 or UTF-16 text.*byte 4"),
    (b"t" + b",u" * MOST_COLUMNS + b"\n0\n", r"at most 100000 columns, got 100001"),
]


def test_another_file_than_a_table_is_refused_with_its_place(written):
    """Line and column, counted from 1."""
    check_refused(NO_TABLES, written)


def test_a_column_that_is_not_there_is_refused(written):
    """With the name that was probably meant; of very many names the first are listed."""
    with pytest.raises(UsageError, match=r"no column 'u'; available: t, force$"):
        written("t,force\n0,1\n").find(["u"])
    with pytest.raises(UsageError, match=r"unique column names, got 2 columns 'u'"):
        written("t,u,u\n0,1,2\n").find(None)
    table = written("t,u\n0,1\n1,\n")
    with pytest.raises(UsageError, match=r"line 3, column 2 .*: expected a number, got an empty"):
        table.columns(table.find(None))
    names = [f"c{i}" for i in range(5000)]
    zeros = ["0"] * len(names)
    with pytest.raises(UsageError, match=r"c99, and 4900 more$"):
        written(f"{','.join(names)}\n{','.join(zeros)}\n").find(["elsewhere"])


SECRETS = [
    "root:$6$ZebraQuagga:19000:0:99999:7:::\ndaemon:*:19000:0:99999:7:::\n",
    "ZebraQuagga\n",
    "Zebra,Quagga\nZebraQuagga,Quagga\n",
    "ZebraQuagga\n-----BEGIN PRIVATE KEY-----\n",
    "token=ZebraQuagga\nZebra = 1\n",
    "Zebra\xfcQuagga\n1",
    "ZebraQuagga\n1\n",
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


def reference(text):
    """Read a table cell by cell, by the csv module and Python's floats; None: it is none."""
    lines = list(csv.reader(io.StringIO(text, newline=None), strict=True))
    rows = [line for line in lines[1:] if any(cell.strip() for cell in line)]
    values = [[float(cell) for cell in row] for row in rows]
    return [name.strip() for name in lines[0]], values


CELLS = st.one_of(
    st.floats().map(repr),
    st.sampled_from(
        ["", " ", "1", " 2 ", "nan", "-inf", "1e400", '"3"', '"', "1_0", "x", "t", "#"]
    ),
    st.text(alphabet='0123456789.eE+-_ "#;\t\0\x85\u2028\u0661abcxX\ufeff', max_size=6),
)
ROWS = st.lists(CELLS, min_size=1, max_size=3).map(",".join)
FILES = st.tuples(
    st.sampled_from(["t,u", "t", "u,t", '"t",u', "1,2", "t,t", ""]),
    st.lists(ROWS, max_size=4),
    st.sampled_from(["\n", "\r\n", "\r"]),
)


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(FILES)
def test_a_crafted_file_is_read_right_or_refused(tmp_path_factory, file):
    """Whatever comes out is what reading cell by cell gives; all else is one error."""
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
    names, values = reference("\n".join(filled))
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
    lines = ["t,u", *(",".join(map(repr, row)) for row in rows)]
    path.write_text("\n".join(lines))
    table = read_table(path)
    for position in (0, 1):
        for found, row in zip(table.values(position).tolist(), rows, strict=True):
            assert found == row[position] or (math.isnan(found) and math.isnan(row[position]))


@pytest.mark.slow
def test_a_damaged_file_of_matlab_is_refused_or_read(tmp_path):
    """Of structs and texts, too: no other error, no crash."""
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"t": T, "y": np.array(Y), "x": np.eye(4), "name": "tank"})
    trajectory = mat4(
        Aclass=characters("Atrajectory", "1.1", "", "binNormal"),
        name=characters("time", "y"),
        description=characters("Time in [s]", ""),
        dataInfo=np.array([[0, 1, 0, -1], [2, 2, 0, -1]]),
        data_1=np.zeros((2, 1)),
        data_2=np.array([T, Y]).T,
    )
    rng = np.random.default_rng(0)
    refused = 0
    for good in (path.read_bytes(), trajectory):
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
    assert refused > 100
