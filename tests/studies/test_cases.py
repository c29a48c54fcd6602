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


UNCLOSED = 'a.x,a.y\n1,"2\n' + "1.5,2.5\n" * 100_000  # is refused at once


def read(path, content=None):
    match content:
        case str():
            path.write_text(content)
        case dict():
            parquet.write_table(pyarrow.table(content), path)
    return {name: values.tolist() for name, values in read_cases(path).items()}


def test_the_cells_of_a_csv_are_toml_and_empty_ones_are_left(path):
    """Numbers, words, lists, truth values; a component without a dot is swapped."""
    text = (
        "\ufeffa.x, components.a.n,a.kind,a.L,a.b,plant,replay,swap.c\r\n"
        '1.5,1,sine,"[1.0, 2]",true,x.fmu,a.mcap,/c.fmu\r\n'
        "\r\n"  # no case, unlike a row of commas
        '-2e3,0x10,"""1""",,false,,../b.mcap,\r\n'
        ",,,,,,,\r\n"
    )
    folder = path.parent
    found = {
        "a.x": [1.5, -2e3, None],
        "a.n": [1, 16, None],
        "a.kind": ["sine", "1", None],
        "a.L": [[1.0, 2], None, None],
        "a.b": [True, False, None],
        "swap.plant": [str(folder / "x.fmu"), None, None],
        "recording": [str(folder / "a.mcap"), str(folder.parent / "b.mcap"), None],
        "swap.c": ["/c.fmu", None, None],
    }
    assert repr(read(path, text)) == repr(found)
    assert repr(read(path, "a.x\n1\n2.0\n")) == "{'a.x': [1, 2.0]}"  # as with --set
    path.write_text("a.x,a.n\n1.0,1\n")
    assert [column.dtype for column in read_cases(path).values()] == [np.float64, np.int64]


def test_tables_of_cases_have_the_forms_of_other_tables(tmp_path):
    """Semicolons and decimal commas, comments and a preamble, sheets of Excel."""
    expected = {"a.x": [1.5, 2.0], "a.n": [3, None], "a.kind": ["sine", "step"]}
    text = "made by a tool\n# of May\na.x;a.n;a.kind\n1,5;3;sine\n2,0;;step\n"
    assert read(tmp_path / "cases.csv", text) == expected
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
    expected = {**columns, "a.n": [1, 2], "a.f": [0.5, 0.25], "a.d": [1.5, 0.1]}
    expected["swap.plant"] = [str(tmp_path / expected.pop("plant")[0]), None]
    assert read(path, columns) == expected


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", "", "has no rows"),
        ("a.csv", "a.x,a.y\n1,2\n3\n", "line 3: .*2 cells, got 1"),
        ("a.csv", UNCLOSED, "line 2 cannot be split"),
        ("a.csv", "a.x,a.x\n1,2\n", "two columns 'a.x'"),
        ("a.csv", "a.x,\n1,2\n", "without a name.*pandas"),
        ("a.csv", "a.x\n1979-05-27\n", r"column 'a.x': .*datetime.date\(1979, 5, 27\)"),
        ("b.csv", None, "cannot be read: No such file"),
        ("a.npz", None, ""),
        ("a.parquet", "a", "cannot be read as Parquet: "),
        ("a.parquet", {"a.x": pyarrow.array([], "float64")}, "has no rows"),
        ("a.parquet", {"a.x": [b"1"]}, ", column 'a.x': .*b'1'"),
    ],
    ids=range(11),
)
def test_a_file_that_is_no_table_of_cases_is_refused(tmp_path, name, content, message):
    """The message names the file, and the line or the column."""
    with pytest.raises(UsageError, match=f"'{tmp_path / name}'.*{message}"):
        read(tmp_path / name, content)
