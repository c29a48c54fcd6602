"""Members that a search chose run again alone, with the same bits, from what they were made of."""

import pyarrow as pa
import pytest
from pyarrow import parquet

import cosim
from cosim.errors import DatasetError, UsageError
from cosim.studies.running.verifying import verify_study

LAG = """
scenario = { name = "lag", stop = 0.2, step = 0.01 }
[components]
u = { kind = "table", file = "u.csv" }
plant = { kind = "lag", time_constant = 0.7, initial = 0.0 }
[connections]
"plant.u" = "u.y"
"""


@pytest.fixture
def lag(tmp_path):
    """Return a scenario, beside tables that its plant may be swapped for."""
    for name, value in (("u", 1.0), ("low", 0.5), ("high", 0.9)):
        (tmp_path / f"{name}.csv").write_text(f"t,y\n0,{value}\n2,{value}\n")
    path = tmp_path / "lag.toml"
    path.write_text(LAG)
    return path


def tune(scenario, place, vary, **options):
    """Tune a scenario to half of its input."""
    given = {"minimize": "rms(plant.y - 0.5)", "workers": 1, **options}
    return cosim.tune(scenario, vary=vary, out=place, **given)


def test_members_of_a_search_come_to_what_is_recorded(tmp_path):
    """Those that failed fail again, for the same reason."""
    key = "models.academic.A[2][2]"
    tune(
        "academic",
        tmp_path / "d",
        {key: {"linear": [0.0, 1.0]}},
        minimize="-max(abs(plant.x_b))",
        set={"scenario.stop": 0.1},
        members=8,
    )
    study = cosim.open_study(tmp_path / "d")
    failed = list(study.failures)[:1]
    assert failed
    completed = next(number for number in range(len(study)) if number not in study.failures)
    found = verify_study(tmp_path / "d", members=[*failed, completed])
    assert found.members == tuple(sorted([*failed, completed]))
    assert found.values == ("status", "steps", "objective")
    assert found.differences == ()


def test_a_bit_of_the_objective_that_differs_is_found(lag, tmp_path):
    """As in a study."""
    tune(lag, tmp_path / "d", {"plant.time_constant": {"log": [0.1, 1.0]}}, members=3)
    (path,) = (tmp_path / "d" / "parts").iterdir()
    table = parquet.read_table(path)
    values = table["objective"].to_pylist()
    place = table.schema.get_field_index("objective")
    changed = pa.array([value * (1 + 2**-52) for value in values])
    parquet.write_table(table.set_column(place, table.field("objective"), changed), path)
    found = verify_study(tmp_path / "d", members=[1])
    assert [(item.member, item.name) for item in found.differences] == [(1, "objective")]


def test_what_members_of_a_search_are_made_of_must_not_have_changed(lag, tmp_path):
    """Files that were swapped in, and the scenario's own, are among it."""
    pytest.importorskip("optuna")
    swaps = [str(tmp_path / "low.csv"), str(tmp_path / "high.csv")]
    tune(lag, tmp_path / "d", {"plant": swaps}, method="optuna", members=9)
    assert verify_study(tmp_path / "d").differences == ()
    for path, old, new, what in (
        (tmp_path / "low.csv", "0.5", "0.6", r"table \S*low.csv changed"),
        (tmp_path / "u.csv", "1.0", "1.1", r"table \S*u.csv changed"),
        (lag, "initial = 0.0", "initial = 0.1", "key components.plant changed"),
        (
            lag,
            "[connections]",
            "w = { kind = 'constant', value = 1.0 }\n[connections]",
            "components.w is new",
        ),
    ):
        content = path.read_text()
        path.write_text(content.replace(old, new))
        with pytest.raises(DatasetError, match=what):
            verify_study(tmp_path / "d")
        path.write_text(content)
    assert verify_study(tmp_path / "d", sample=1).differences == ()


def test_where_no_member_was_completed_nothing_is_verified(lag, tmp_path):
    """Nothing says what they are made of."""
    tune(lag, tmp_path / "d", {"plant.time_constant": {"log": [0.1, 1.0]}}, members=2)
    (path,) = (tmp_path / "d" / "parts").iterdir()
    table = parquet.read_table(path)
    place = table.schema.get_field_index("status")
    failed = pa.array(["failed"] * len(table))
    parquet.write_table(table.set_column(place, table.field("status"), failed), path)
    with pytest.raises(UsageError, match="no member was completed"):
        verify_study(tmp_path / "d")
