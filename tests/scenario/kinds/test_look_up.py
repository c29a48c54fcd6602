"""Look-up tables in scenario files."""

import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document
from tests.scenario.refusals import check_refused


def run(folder, table, inputs=("u",), **more):
    """Run a look-up table on ramps: u, u1 are t, u2 is 2 t."""
    sources = {"u": "once.y", "u1": "once.y", "u2": "twice.y"}
    connections = [f'"f.{name}" = "{sources[name]}"' for name in inputs]
    head = 'scenario = { name = "f", stop = 1.0, step = 0.25 }'
    once, twice = (f'{{ kind = "ramp", slope = {slope} }}' for slope in (1.0, 2.0))
    own = f'[components.f]\nkind = "look-up-table"\n{table}'
    parts = f"[components]\nonce = {once}\ntwice = {twice}\n{own}"
    text = "\n".join([head, parts, "[connections]", *connections])
    return cosim.run(parse(Document(text, "f", folder)), **more)


BOTH = ("u1", "u2")
SHORT = "u = [0.25, 0.5]\ny = [0.0, 1.0]\n"
PRODUCT = "u1 = [0.0, 1.0]\nu2 = [0.0, 2.0]\ny = [[0.0, 0.0], [0.0, 2.0]]"


@pytest.mark.parametrize(
    ("table", "inputs", "y"),
    [
        ("u = [0.0, 0.5, 1.0]\ny = [0.0, 1.0, 0.0]", ("u",), [0.0, 0.5, 1.0, 0.5, 0.0]),
        (f'{SHORT}extrapolation = "hold"', ("u",), [0.0, 0.0, 1.0, 1.0, 1.0]),
        (f'{SHORT}extrapolation = "linear"', ("u",), [-1.0, 0.0, 1.0, 2.0, 3.0]),
        (PRODUCT, BOTH, [0.0, 0.125, 0.5, 1.125, 2.0]),
        ('file = "f.csv"\ncolumns = ["a", "c"]', ("u",), [1.0, 1.5, 2.0, 2.5, 3.0]),
        ('file = "g.csv"', BOTH, [0.0, 0.125, 0.5, 1.125, 2.0]),
    ],
)
def test_a_function_by_its_values(tmp_path, table, inputs, y):
    """Arrays, or a file with a row for each point, in any order."""
    (tmp_path / "f.csv").write_text("a,b,c\n0,9,1\n1,9,3\n")
    (tmp_path / "g.csv").write_text("u1,u2,y\n1,2,2\n0,2,0\n0,0,0\n1,0,0\n")
    log = run(tmp_path, table, inputs, out=tmp_path / "f.mcap")
    assert log["f.y"].tolist() == y
    assert cosim.diff(log, cosim.replay(log)).equal


def test_a_file_says_the_units_of_its_columns(tmp_path):
    """Of u and y, so that connections convert to and from them: 0 to 1 s are 0 to 1000 ms."""
    (tmp_path / "f.csv").write_text("u [ms],y [kN]\n0,1\n1000,3\n")
    log = run(tmp_path, 'file = "f.csv"', set={"components.once.unit": "s"})
    assert [log.signals[name].unit for name in ("f.u", "f.y")] == ["ms", "kN"]
    assert log["f.y"].tolist() == [1.0, 1.5, 2.0, 2.5, 3.0]
    with pytest.raises(ScenarioError, match=r"unit of 'y': got 'N'.*declares 'kN'"):
        run(tmp_path, 'file = "f.csv"\nunit = "N"')


NO_FUNCTIONS = [
    ("u = [0.0, 1.0]", "or file, got u"),
    ("u1 = [0.0, 1.0]\ny = [0.0, 1.0]", "or file, got u1, y"),
    ("", "or file, got nothing"),
    ("u = [0.0, 1.0]\ny = [[0.0, 1.0]]", "y: expected one number per entry of u"),
    ("u1 = [0.0, 1.0]\nu2 = [0.0, 1.0]\ny = [0.0, 1.0]", "y: expected one number per entry"),
    ('file = "f.csv"\ny = [0.0]', "expected either file or arrays, got both"),
    ('file = "f.csv"\ncolumns = ["a"]', "one or two columns of inputs and one of y, got 1"),
    ('file = "f.csv"\ncolumns = ["a", "d"]', "no column 'd'; available: a, b, c"),
    ('file = "f.csv"', r"each pair of 2 x 2 .*4 rows.*got 3 rows"),
    ('file = "g.csv"', r"each pair of 2 x 2 .*4 rows.*got 4 rows"),
]


def test_a_table_without_a_function_is_refused(tmp_path):
    """With what was expected and what was found."""

    def refuse(table):
        (tmp_path / "f.csv").write_text("a,b,c\n0,0,1\n1,0,3\n1,1,3\n")
        (tmp_path / "g.csv").write_text("a,b,c\n0,0,1\n1,0,3\n1,1,3\n1,1,4\n")
        run(tmp_path, table)

    check_refused(NO_FUNCTIONS, refuse, ScenarioError)
