"""A study belongs to the files that its members read: those that it began with, all of them."""

import pytest

import cosim
from cosim.cli.app import main
from cosim.errors import ChangedFileError, DatasetError, RunError
from cosim.studies import plan
from cosim.studies.members import MemberSources
from cosim.studies.plan import RecordedStudy, plan_study
from cosim.studies.study_file import read_study
from tests.scenario.user_modules import RELAY, THERMOSTAT

TABLE = """
scenario = { name = "x", stop = 1.0, step = 0.1 }
[components]
u = { kind = "table", file = "u.csv" }
s = { kind = "sine", amplitude = 1.0, rate = 1.0 }
"""
METRICS = {"y": "last(u.y)"}


@pytest.fixture
def scenario(tmp_path):
    path = tmp_path / "x.toml"
    path.write_text(TABLE)
    write_table(tmp_path / "u.csv", 1.0)
    return path


def exit_code(arguments):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    return caught.value.code


def test_a_file_that_changes_while_a_study_is_planned_is_named():
    """Nothing has begun that could go on."""
    found = {0: MemberSources(files={"/u.csv": "ab"})}
    with pytest.raises(RunError, match=r"/u.csv has changed while the study was being planned"):
        plan._sources({"/u.csv": "cd"}, found)


def write_table(path, value):
    path.write_text(f"t,y\n0,{value}\n1,{value}\n")


@pytest.mark.slow
def test_a_study_stops_where_a_file_changes(scenario, tmp_path):
    """What is recorded is of the file as it was; put back, the study goes on."""
    table = tmp_path / "u.csv"
    given = {
        "vary": {"s.amplitude": {"linear": [0.0, 1.0], "points": 200}},
        "metrics": METRICS,
        "out": tmp_path / "out",
        "workers": 1,
    }
    with pytest.raises(ChangedFileError, match=r"u\.csv has changed since this study began"):
        cosim.study(scenario, **given, progress=lambda *_: write_table(table, 2.0))
    stopped = cosim.open_study(tmp_path / "out")
    assert 0 < len(stopped) < 200
    with pytest.raises(DatasetError, match=r"table u\.csv changed"):
        cosim.study(scenario, **given)
    write_table(table, 1.0)
    done = cosim.study(scenario, **given)
    assert len(done) == 200
    assert set(done.table().column("y").to_pylist()) == {1.0}


@pytest.mark.slow
def test_every_varied_file_belongs_to_the_study(scenario, tmp_path):
    """Also the 101st, which no member is built with when the study is planned."""
    tables = [tmp_path / f"{number}.csv" for number in range(101)]
    for number, table in enumerate(tables):
        write_table(table, float(number))
    given = {"vary": {"u.file": list(map(str, tables))}, "metrics": METRICS}
    given["out"] = tmp_path / "out"
    study = cosim.study(scenario, **given)
    assert study.table().column("y").to_pylist() == list(map(float, range(101)))
    write_table(tables[100], 7.0)
    with pytest.raises(DatasetError, match=r"table 100\.csv changed"):
        cosim.study(scenario, **given)


def test_every_log_belongs_to_the_study(scenario, tmp_path, monkeypatch):
    """Also those that no member is built with when the study is planned."""
    logs = [tmp_path / f"{number}.mcap" for number in range(3)]
    for log in logs:
        cosim.run(scenario, out=log)
    monkeypatch.setattr("cosim.studies.checking.MOST_INSPECTED", 1)
    given = {"replay": list(map(str, logs)), "metrics": METRICS}
    names = plan_study(read_study(scenario).with_options(**given)).identity({}).digests
    assert {f"log {log.name}" for log in logs} <= names.keys()
    assert "table u.csv" not in names  # a replay has it from its log


def test_the_modules_of_users_belong_to_the_study(tmp_path):
    """By their classes, wherever they are; those in the scenario's folder can be sent."""
    (tmp_path / "x.toml").write_text(THERMOSTAT)
    (tmp_path / "relay.py").write_text(RELAY)
    study = read_study(tmp_path / "x.toml").with_options(metrics={"y": "max(room.y)"})
    before = plan_study(study)
    assert str(tmp_path / "relay.py") in before.files
    (tmp_path / "relay.py").write_text(RELAY + "\n")
    after = plan_study(study).identity({}).digests
    changed = [
        name for name, digest in before.identity({}).digests.items() if after[name] != digest
    ]
    assert changed == ["code of relay:Relay"]


@pytest.mark.slow
@pytest.mark.usefixtures("worker_processes")
def test_a_member_that_cannot_be_built_is_no_silence(tmp_path, capsys):
    """The study goes on, as that costs the member only; the dataset says what is not known."""
    (tmp_path / "x.toml").write_text(THERMOSTAT)
    (tmp_path / "relay.py").write_text("import os\nos._exit(3)\n" + RELAY)
    place = tmp_path / "out"
    arguments = [
        "study",
        str(tmp_path / "x.toml"),
        "--metric",
        "y=max(room.y)",
        "--out",
        str(place),
    ]
    assert exit_code(arguments) == 1
    text = (
        "warning: member 0 could not be built when the study was planned: ends the process with "
        "exit code 3; the files that are named are known, but not whether more are read, and the "
        "metrics were not checked"
    )
    assert capsys.readouterr().err.count(text) == 1
    assert f"warning: {RecordedStudy.read(cosim.open_study(place).text).warnings[0]}" == text
    assert exit_code(["study", "show", str(place)]) == 0
    assert capsys.readouterr().err.count(text) == 1
