"""Members that a search chose run again alone, with the same bits, from what they were made of."""

import shutil

import pytest

import cosim
from cosim.errors import DatasetError
from cosim.studies.verifying import verify_study
from tests.fmi.compiled import compile_fmu
from tests.fmi.rogues import STATELESS

LAG = """
scenario = { name = "lag", stop = 0.2, step = 0.01 }
[components]
u = { kind = "table", file = "u.csv" }
plant = { kind = "lag", time_constant = 0.7, initial = 0.0 }
[connections]
"plant.u" = "u.y"
"""
LIMITS = """
scenario = { name = "limits", stop = 0.1, step = 0.01 }
[components]
u = { kind = "constant", value = 0.7 }
plant = { kind = "limit", lower = 0.2, upper = 0.4 }
[connections]
"plant.u" = "u.y"
"""
FMU = """
scenario = { name = "x", stop = 0.1, step = 0.01 }
[components]
plant = { kind = "fmu", path = "LIES.fmu" }
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


@pytest.mark.slow
def test_a_changed_file_refuses_the_verification_of_a_search(lag, tmp_path):
    """Files that were swapped in, and the scenario's own, are among it."""
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


def test_a_file_behind_a_link_is_the_one_that_it_was(lag, tmp_path):
    """Though the name stays: a link that points to another file is a change."""
    link = tmp_path / "link.csv"
    link.symlink_to(tmp_path / "low.csv")
    lag.write_text(LAG.replace("u.csv", "link.csv"))
    tune(lag, tmp_path / "d", {"plant.time_constant": {"log": [0.1, 1.0]}}, members=2)
    found = verify_study(tmp_path / "d")
    assert (found.differences, found.is_searched) == ((), True)
    link.unlink()
    link.symlink_to(tmp_path / "high.csv")
    with pytest.raises(DatasetError, match=r"table \S*low.csv is no longer part of it"):
        verify_study(tmp_path / "d")


def test_values_that_never_ran_together_are_not_refused(tmp_path):
    """Each of two bounds would be wrong beside some values of the other."""
    path = tmp_path / "limits.toml"
    path.write_text(LIMITS)
    vary = {"plant.lower": {"linear": [0.0, 1.0]}, "plant.upper": {"linear": [0.1, 2.0]}}
    tune(path, tmp_path / "d", vary, members=25)
    study = cosim.open_study(tmp_path / "d")
    assert study.failures
    completed = [number for number in range(len(study)) if number not in study.failures]
    chosen = [completed[-1], *list(study.failures)[:1]]
    assert verify_study(tmp_path / "d", members=chosen).differences == ()


@pytest.mark.slow
def test_a_file_that_only_failed_members_read_must_not_have_changed(tmp_path):
    """Its members would fail otherwise, or not at all."""
    good, bad, other = (tmp_path / f"{name}.fmu" for name in ("LIES", "FAILS_STEP", "OTHER_START"))
    for fmu in (good, bad, other):
        compile_fmu(fmu, STATELESS, "rogue2.c", defines=(f"ROGUE={fmu.stem}",))
    scenario = tmp_path / "x.toml"
    scenario.write_text(FMU.replace("LIES.fmu", str(good)))
    tune(
        scenario,
        tmp_path / "d",
        {"plant.path": [str(good), str(bad)]},
        minimize="last(plant.y)",
        method="optuna",
        members=9,
    )
    assert len(cosim.open_study(tmp_path / "d").failures) == 1
    assert verify_study(tmp_path / "d").differences == ()
    shutil.copy(other, bad)
    with pytest.raises(DatasetError, match=r"FMU \S*FAILS_STEP.fmu changed"):
        verify_study(tmp_path / "d")
