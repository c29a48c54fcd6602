"""Tables of cases."""

from decimal import Decimal

import numpy as np
import pyarrow
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyarrow import parquet

from cosim.errors import UsageError
from cosim.studies.cases import read_cases


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("cases") / "cases.csv"


def read(path, text=None):
    if text is not None:
        path.write_text(text)
    return {name: values.tolist() for name, values in read_cases(path).items()}


def test_the_cells_of_a_csv_are_toml_and_empty_ones_are_left(path):
    """Numbers, words, lists, truth values; a component without a dot is swapped."""
    text = (
        "\ufeffa.x, components.a.n,a.kind,a.L,a.b,plant,replay,swap.c\r\n"
        '1.5,1,sine,"[1.0, 2]",true,x.fmu,a.mcap,/c.fmu\r\n'
        "\r\n"
        '-2e3,-7,"""1""",,false,,../b.mcap,\r\n'
    )
    folder = path.parent
    assert read(path, text) == {
        "a.x": [1.5, -2e3],
        "a.n": [1, -7],
        "a.kind": ["sine", "1"],
        "a.L": [[1.0, 2], None],
        "a.b": [True, False],
        "swap.plant": [str(folder / "x.fmu"), None],
        "recording": [str(folder / "a.mcap"), str(folder.parent / "b.mcap")],
        "swap.c": ["/c.fmu", None],
    }
    columns = read_cases(path)
    assert (columns["a.x"].dtype, columns["a.n"].dtype) == (np.float64, np.int64)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a.x\n1\n2.0\n0x10\n", {"a.x": [1, 2.0, 16]}),
        ("a.x,a.y\n,\n\n1,2\n", {"a.x": [None, 1], "a.y": [None, 2]}),  # a row of commas is a case
        ('a.x,a.y\n"p",q\x0cr\n', {"a.x": ["p"], "a.y": ["q\x0cr"]}),
    ],
)
def test_rows_and_types_stay_what_they_are(path, text, expected):
    """An empty line is no case; whole numbers beside others stay whole, as with --set."""
    assert repr(read(path, text)) == repr(expected)


def test_tables_of_cases_have_the_forms_of_other_tables(tmp_path):
    """Semicolons and decimal commas, comments and a preamble, UTF-16, sheets of Excel."""
    expected = {"a.x": [1.5, 2.0], "a.n": [3, None], "a.kind": ["sine", "step"]}
    text = "made by a tool\n# of May\na.x;a.n;a.kind\n1,5;3;sine\n2,0;;step\n"
    assert read(tmp_path / "cases.csv", text) == expected
    path = tmp_path / "cases.txt"
    path.write_text(text.replace(";", "\t"), encoding="utf-16")
    assert read(path) == expected
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (["Plan 7"], [], ["a.x", "a.n", "a.kind"], [1.5, 3, "sine"], ["2.0", None, "step"]):
        book.active.append(row)
    book.save(tmp_path / "cases.xlsx")
    assert read(tmp_path / "cases.xlsx") == expected


@given(st.lists(st.floats(allow_nan=False), min_size=1, max_size=20))
def test_floats_come_back_to_the_bit(path, values):
    """Of a CSV with what repr writes."""
    found = read(path, "\n".join(["a.x", *map(repr, values)]))["a.x"]
    assert list(map(repr, found)) == list(map(repr, values))


def test_a_parquet_table_has_the_same(tmp_path):
    """Numbers of its types, texts as cells, null for an empty cell, decimals by their digits."""
    path = tmp_path / "cases.parquet"
    columns = {
        "a.x": [0.1, 2.0],
        "a.n": pyarrow.array([1, 2], pyarrow.int32()),
        "a.f": pyarrow.array([0.5, 0.25], pyarrow.float32()),
        "a.d": pyarrow.array([Decimal("1.5"), Decimal("0.1")], pyarrow.decimal128(3, 1)),
        "a.y": [None, 2.0],
        "a.k": ["sine", None],
        "a.L": [[1.0], [2.0, 3.0]],
        "a.b": [True, None],
        "plant": ["x.fmu", None],
    }
    parquet.write_table(pyarrow.table(columns), path)
    expected = {name: values for name, values in columns.items() if "." in name}
    expected |= {"a.n": [1, 2], "a.f": [0.5, 0.25], "a.d": [1.5, 0.1]}
    assert read(path) == {**expected, "swap.plant": [str(tmp_path / "x.fmu"), None]}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no rows"),
        ("a.x,a.y\n1,2\n3\n", "line 3: .*2 cells, got 1"),
        ('a.x,a.y\n1,"2\n' + "1.5,2.5\n" * 100_000, "line 2 cannot be split"),  # not 40 s later
        ("a.x,a.x\n1,2\n", "two columns 'a.x'"),
        ("a.x,\n1,2\n", "without a name.*pandas"),
        ("a.x\n1979-05-27\n", r"column 'a.x': .*datetime.date\(1979, 5, 27\)"),
    ],
    ids=range(6),
)
def test_a_file_that_is_no_table_of_cases_is_refused(path, text, message):
    """The message names the file, and the line or the column."""
    with pytest.raises(UsageError, match=rf"file '.*cases.csv'.*{message}"):
        read(path, text)


def test_other_files_are_refused(tmp_path):
    """Missing ones, those of other types, and Parquet files that are none."""
    with pytest.raises(UsageError, match=r"cases.csv' cannot be read: No such file"):
        read(tmp_path / "cases.csv")
    with pytest.raises(UsageError, match=r"got '.*x.npz'"):
        read(tmp_path / "x.npz")
    path = tmp_path / "y.parquet"
    with pytest.raises(UsageError, match=r"y.parquet' cannot be read as Parquet: "):
        read(path, "a")
    for values, message in (([], "has no rows"), ([b"1"], ", column 'a.x': .*b'1'")):
        parquet.write_table(pyarrow.table({"a.x": pyarrow.array(values, pyarrow.binary())}), path)
        with pytest.raises(UsageError, match=rf"y.parquet'.*{message}"):
            read(path)
