"""A tuning belongs to the files that its trials read, as a study does."""

import pytest

import cosim
from cosim.errors import ChangedFileError, DatasetError
from cosim.studies.study_file import read_study
from cosim.studies.plan import plan_study
from cosim.studies.tuning.keys import read_space
from cosim.studies.tuning.planning import plan_tuning
from cosim.studies.tuning.searching import TuningSearch
from cosim.studies.tuning.task import TuningTask

LAG = """
scenario = { name = "lag", stop = 0.2, step = 0.01 }
[components]
u = { kind = "table", file = "u.csv" }
plant = { kind = "lag", time_constant = 0.7, initial = 0.0 }
[connections]
"plant.u" = "u.y"
"""


@pytest.fixture
def lag(tmp_path, monkeypatch):
    """Return a scenario; the working directory is another folder, with files of the same names."""
    folder = tmp_path / "scenario"
    elsewhere = tmp_path / "elsewhere"
    for each in (folder, elsewhere):
        each.mkdir()
        for name in ("u", "a", "b"):
            (each / f"{name}.csv").write_text("t,y\n0,1\n1,1\n")
    (folder / "lag.toml").write_text(LAG)
    monkeypatch.chdir(elsewhere)
    return folder / "lag.toml"


@pytest.mark.slow
def test_a_relative_path_means_the_same_file_as_in_a_study(lag, tmp_path):
    """That in the working directory; what the scenario names is in its folder."""
    vary = {"plant": ["a.csv", "b.csv"]}
    search = TuningSearch(read_space(vary), "", method="optuna")
    tuned = plan_tuning(TuningTask(str(lag), "last(plant.y)", search)).study
    study = read_study(lag).with_options(vary=vary, metrics={"y": "last(plant.y)"})
    assert tuned.files == plan_study(study).files
    assert {str(tmp_path / "elsewhere" / name) for name in ("a.csv", "b.csv")} <= tuned.files.keys()
    assert str(lag.parent / "u.csv") in tuned.files


def test_a_tuning_stops_where_a_file_changes(lag, tmp_path):
    """And does not go on with another one."""
    table = lag.parent / "u.csv"
    content = table.read_text()

    def tune(**options):
        return cosim.tune(
            lag,
            minimize="abs(last(plant.y) - 0.1)",
            vary={"plant.time_constant": {"log": [0.1, 10.0]}},
            members=10,
            workers=1,
            out=tmp_path / "out",
            **options,
        )

    with pytest.raises(ChangedFileError, match=r"u\.csv has changed since this study began"):
        tune(progress=lambda *_: table.write_text(content.replace(",1", ",2")))
    with pytest.raises(DatasetError, match=r"table u\.csv changed"):
        tune()
    table.write_text(content)
    assert len(tune().history) <= 10
