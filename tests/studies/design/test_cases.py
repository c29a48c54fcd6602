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
from cosim.studies.design import plain_values


@pytest.fixture
def write(tmp_path):
    def write(text, name="cases.csv"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def plain(columns):
    return {name: plain_values(values) for name, values in columns.items()}


def test_the_cells_of_a_csv_are_toml_and_empty_ones_are_left(write, tmp_path):
    """Numbers, words, lists, truth values; a component without a dot is swapped."""
    path = write(
        "\ufeffa.x, components.a.n,a.kind,a.L,a.b,plant,replay,swap.c\r\n"
        '1.5,1,sine,"[1.0, 2]",true,x.fmu,a.mcap,/c.fmu\r\n'
        "\r\n"
        '-2e3,-7,"""1""",,false,,../b.mcap,\r\n'
    )
    found = read_cases(path)
    assert plain(found) == {
        "a.x": [1.5, -2e3],
        "a.n": [1, -7],
        "a.kind": ["sine", "1"],
        "a.L": [[1.0, 2], None],
        "a.b": [True, False],
        "swap.plant": [str(tmp_path / "x.fmu"), None],
        "recording": [str(tmp_path / "a.mcap"), str(tmp_path.parent / "b.mcap")],
        "swap.c": ["/c.fmu", None],
    }
    assert found["a.x"].dtype == np.float64
    assert found["a.n"].dtype == np.int64


def test_integers_and_floats_of_a_column_stay_what_they_are(write):
    """As --set has them, not one type for all."""
    values = plain(read_cases(write("a.x\n1\n2.0\n,\n".replace(",", "0x10"))))["a.x"]
    assert values == [1, 2.0, 16]
    assert [type(value) for value in values] == [int, float, int]


def test_tables_of_cases_have_the_forms_of_other_tables(write, tmp_path):
    """Semicolons and decimal commas, comments and a preamble, UTF-16, sheets of Excel."""
    expected = {"a.x": [1.5, 2.0], "a.n": [3, None], "a.kind": ["sine", "step"]}
    text = "made by a tool\n# of May\na.x;a.n;a.kind\n1,5;3;sine\n2,0;;step\n"
    assert plain(read_cases(write(text))) == expected
    path = tmp_path / "cases.txt"
    path.write_text(text.replace(";", "\t"), encoding="utf-16")
    assert plain(read_cases(path)) == expected
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (["Plan 7"], [], ["a.x", "a.n", "a.kind"], [1.5, 3, "sine"], ["2.0", None, "step"]):
        book.active.append(row)
    book.save(tmp_path / "cases.xlsx")
    assert plain(read_cases(tmp_path / "cases.xlsx")) == expected


def test_a_row_of_commas_is_a_case_of_the_own_values(write):
    """An empty line is none."""
    assert plain(read_cases(write("a.x,a.y\n,\n\n1,2\n"))) == {"a.x": [None, 1], "a.y": [None, 2]}
    assert plain(read_cases(write("\na.x\n\n 1 \n  \n"))) == {"a.x": [1]}


def test_a_form_feed_between_quoted_cells_ends_no_row(write):
    """As it ends none without quotes."""
    assert plain(read_cases(write('a.x,a.y,a.z\n"p",q\x0cr,1\n'))) == {
        "a.x": ["p"],
        "a.y": ["q\x0cr"],
        "a.z": [1],
    }


def test_a_quote_that_is_not_closed_costs_no_more_than_its_lines(write):
    """Not the square of their number: 40 s of 100 000 lines."""
    path = write('a.x,a.y\n1,"2\n' + "1.5,2.5\n" * 100_000)
    with pytest.raises(UsageError, match="line 2 cannot be split"):
        read_cases(path)


@given(st.lists(st.floats(allow_nan=False), min_size=1, max_size=20))
def test_floats_come_back_to_the_bit(values):
    """Of a CSV with what repr writes."""
    import tempfile
    from pathlib import Path

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "c.csv"
        path.write_text("\n".join(["a.x", *map(repr, values)]))
        found = plain_values(read_cases(path)["a.x"])
    assert list(map(repr, found)) == list(map(repr, values))


def test_a_parquet_table_has_the_same(tmp_path):
    """Numbers of its types, texts as cells, null for an empty cell."""
    path = tmp_path / "cases.parquet"
    table = pyarrow.table(
        {
            "a.x": [0.1, 2.0],
            "a.n": pyarrow.array([1, 2], pyarrow.int32()),
            "a.f": pyarrow.array([0.5, 0.25], pyarrow.float32()),
            "a.y": [None, 2.0],
            "a.k": ["sine", None],
            "a.L": [[1.0], [2.0, 3.0]],
            "a.b": [True, None],
            "plant": ["x.fmu", None],
        }
    )
    parquet.write_table(table, path)
    assert plain(read_cases(path)) == {
        "a.x": [0.1, 2.0],
        "a.n": [1, 2],
        "a.f": [0.5, 0.25],
        "a.y": [None, 2.0],
        "a.k": ["sine", None],
        "a.L": [[1.0], [2.0, 3.0]],
        "a.b": [True, None],
        "swap.plant": [str(tmp_path / "x.fmu"), None],
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no rows"),
        ("a.x,a.y\n", "has no rows"),
        ("a.x,a.y\n1,2\n3\n", "line 3: .*2 cells, got 1"),
        ("a.x\n[1,2]\n", "line 2: .*1 cells, got 2"),
        ('a.x\n"1\n', "line 2 cannot be split"),
        ("a.x,a.x\n1,2\n", "two columns 'a.x'"),
        ("a.x,components.a.x\n1,2\n", "two columns 'components.a.x'"),
        ("a.x,\n1,2\n", r"a column without a name.* \(of pandas: "),
        ("a.x,a.y,a.n\n-,V,s\n1,2.5,3\n2,,4\n", "line 2: .*got units; take that row out"),
        ("plant\n3\n", "column 'plant': .*got 3"),
        ("a.x\n" + 60 * "[" + 60 * "]" + "\n", r"column 'a.x': .*nested"),
        ("a.x\n1979-05-27\n", r"column 'a.x': .*datetime.date\(1979, 5, 27\)"),
    ],
)
def test_a_file_that_is_no_table_of_cases_is_refused(write, text, message):
    """The message names the file, and the line or the column."""
    with pytest.raises(UsageError, match=rf"file '.*cases.csv'.*{message}"):
        read_cases(write(text))


def test_decimals_are_the_numbers_of_their_digits(tmp_path):
    """As DuckDB makes them of literals."""
    column = pyarrow.array([Decimal("1.5"), Decimal("0.1")], pyarrow.decimal128(3, 1))
    parquet.write_table(pyarrow.table({"a.x": column}), tmp_path / "x.parquet")
    assert plain(read_cases(tmp_path / "x.parquet")) == {"a.x": [1.5, 0.1]}


def test_other_files_are_refused(tmp_path, write):
    """Missing ones, those of other types, and Parquet files that are none."""
    with pytest.raises(UsageError, match=r"cases.csv' cannot be read: No such file"):
        read_cases(tmp_path / "cases.csv")
    with pytest.raises(UsageError, match=r"got '.*x.npz'"):
        read_cases(tmp_path / "x.npz")
    with pytest.raises(UsageError, match=r"x.parquet' cannot be read as Parquet: "):
        read_cases(write("a", "x.parquet"))
    path = tmp_path / "y.parquet"
    parquet.write_table(pyarrow.table({"a.x": pyarrow.array([], pyarrow.float64())}), path)
    with pytest.raises(UsageError, match=r"y.parquet' has no rows"):
        read_cases(path)
    parquet.write_table(pyarrow.table({"a.x": [b"1"]}), path)
    with pytest.raises(UsageError, match=r"y.parquet', column 'a.x': .*b'1'"):
        read_cases(path)
