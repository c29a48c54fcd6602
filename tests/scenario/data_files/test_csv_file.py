"""Tables of numbers from CSV files."""

import csv
import io
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.errors import UsageError
from cosim.scenario.data_files.csv_file import MOST_COLUMNS, read_csv
from tests.scenario.refusals import check_refused


@pytest.fixture
def written(tmp_path):
    """Return a function that writes a file and reads it as a table."""

    def read(content):
        path = tmp_path / "a.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_csv(path)

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
    assert table.names == ("t", "u")
    assert table.values.tolist() == [[0.0, 1.0], [0.5, -2000.0]]
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


NO_TABLES = [
    (b"", r"a\.csv': expected a header line and rows"),
    (b"t\n1\n", r"at least two .*columns, got one"),
    (b"t,u\n", r"rows of numbers, got no rows"),
    (b"t;u\n0;1\n1;2\n", r"line 1 has semicolons"),
    (b"t\tu\n0\t1\n1\t2\n", r"line 1 has tabs"),
    (b"t,u\n0,5;1,5\n", r"line 2, column 2: expected a number, got text"),
    (b"t,u\n0,1\n\n1\n", r"line 4: expected 2 columns .*got 1"),
    (b"t,u\n0,1,2\n1,2,3\n", r"line 2: expected 2 columns .*got 3"),
    (b"t,u\n0,1\n1,\n", r"line 3, column 2: expected a number, got an empty cell"),
    (b"t,u\n0,1\n1,1_0\n", r"line 3, column 2: expected a number, got text"),
    (b"t,u\n0,1 # first\n1,2\n", r"line 2, column 2: expected a number, got text"),
    (b't,u\n0,"1\n1,"2\n', r"line 2 cannot be split"),
    (b'"t,u\n0,1\n', r"line 1 cannot be split"),
    (b"0,1\n1,2\n", r"names of 2 columns in line 1, got numbers"),
    (b"t,u,u\n0,1,2\n", r"unique column names, got 2 columns 'u'"),
    (b"t,u\n0,\x001\n", r"UTF-8 text, got a NUL"),
    ("t,u\n0,1\n".encode("utf-16"), r"UTF-8 text.*byte 0"),
    ("t,größe\n0,1\n".encode("latin-1"), r"UTF-8 text.*byte 4"),
    (b"t" + b",u" * MOST_COLUMNS + b"\n0\n", r"at most 100000 columns, got 100001"),
]


def test_another_file_than_a_table_is_refused_with_its_place(written):
    """Line and column, counted from 1."""
    check_refused(NO_TABLES, written)


def test_a_column_that_is_not_there_is_refused(written):
    """With the name that was probably meant; of very many names the first are listed."""
    with pytest.raises(UsageError, match=r"no column 'u'; available: t, force$"):
        written("t,force\n0,1\n").find(["u"])
    names = [f"c{i}" for i in range(5000)]
    zeros = ["0"] * len(names)
    with pytest.raises(UsageError, match=r"c99, and 4900 more$"):
        written(f"{','.join(names)}\n{','.join(zeros)}\n").find(["elsewhere"])


SECRETS = [
    "root:$6$ZebraQuagga:19000:0:99999:7:::\ndaemon:*:19000:0:99999:7:::\n",
    "ZebraQuagga\n",
    "Zebra,Quagga\nZebraQuagga,1\n",
    "Zebra;Quagga\n1;2\n",
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
    rows = [line for line in lines[1:] if line]
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
        table = read_csv(path)
    except UsageError:
        return
    names, values = reference(text.removeprefix("\ufeff"))
    assert list(table.names) == names
    assert np.array_equal(table.values, np.array(values), equal_nan=True)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.lists(st.floats(), min_size=2, max_size=2), min_size=1, max_size=20))
def test_numbers_come_back_bit_for_bit(tmp_path_factory, rows):
    """The shortest text of a double is read as that double."""
    path = tmp_path_factory.getbasetemp() / "numbers.csv"
    lines = ["t,u", *(",".join(map(repr, row)) for row in rows)]
    path.write_text("\n".join(lines))
    read = read_csv(path).values.tolist()
    for found_row, row in zip(read, rows, strict=True):
        for found, value in zip(found_row, row, strict=True):
            assert found == value or (math.isnan(found) and math.isnan(value))
