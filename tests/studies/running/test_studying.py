"""Studies from their file to their dataset: run, resumed, grown, refused, kept."""

import json
import os
import re
import signal
import subprocess
import sys

import numpy as np
import pytest

import cosim
from cosim.errors import DatasetError, UsageError
from cosim.studies.analysis.independence import StudyLayout
from cosim.studies.design.planning import plan_design
from cosim.studies.document.reading import read_study
from cosim.studies.document.study_file import study_of
from cosim.studies.metrics import parse_metrics
from cosim.studies.running.estimate import estimate_study
from cosim.studies.running.plan import plan_study
from cosim.studies.running.recorded_study import RecordedStudy
from tests.scenario.user_modules import RELAY, THERMOSTAT, write
from tests.studies.tuning.fitted_fmu import write_fit

SHORT = {"scenario.stop": 0.5}
METRICS = {"error": "rms(observer.delta - delta.y)", "last": "last(plant.y)"}
VARIED = ("member", "wall_time", "worker")


def rows(study):
    """Return what members came to, without what differs from run to run."""
    return study.table().drop_columns(["wall_time", "worker", "log"]).to_pylist()


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    """Return a study of four members."""
    return cosim.study(
        "academic",
        vary={"observer.filter_rate": {"log": [10.0, 1e3], "points": 4}},
        metrics=METRICS,
        set=SHORT,
        out=tmp_path_factory.mktemp("studies") / "grid",
        workers=2,
    )


@pytest.mark.slow
def test_every_member_has_the_metrics_of_its_run_alone(grid):
    """The parameters of a row are those of a run with the same metrics, bit for bit."""
    for row in grid.table().to_pylist():
        edits = {**SHORT, "observer.filter_rate": row["observer.filter_rate"]}
        alone = cosim.run("academic", set=edits)
        assert row["last"] == alone["plant.y"][-1]
        assert row["status"] == "complete"
    assert grid.failures == {}
    assert len(grid) == grid.planned == 4


def test_a_study_that_is_done_runs_nothing_again(grid, tmp_path):
    """The rows keep their wall times and workers."""
    place = grid._dataset.label
    again = cosim.study(
        "academic",
        vary={"observer.filter_rate": {"log": [10.0, 1e3], "points": 4}},
        metrics=METRICS,
        set=SHORT,
        out=place,
    )
    assert again.table().equals(grid.table())


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"metrics": {"error": "rms(plant.y)"}}, "the metrics changed"),
        ({"set": {"scenario.stop": 0.4}}, "study: key scenario.stop changed; choose"),
        (
            {"set": {**SHORT, "observer.L": [3.0, 0.5]}},
            "study: key components.observer changed; choose",
        ),
        (
            {"set": {**SHORT, "scenario.until": "t > 0.2"}},
            "study: key scenario.until is new; choose",
        ),
        (
            {"vary": {"observer.filter_rate": {"log": [10.0, 1e4], "points": 4}}},
            "member 1 was observer.filter_rate",
        ),
        ({"vary": {"plant.x_a0[0]": [1.0, 2.0]}}, "plant.x_a0[0] is varied now"),
    ],
)
def test_the_dataset_of_another_study_is_refused(grid, changed, text):
    """The message says what differs."""
    given = {
        "vary": {"observer.filter_rate": {"log": [10.0, 1e3], "points": 4}},
        "metrics": METRICS,
        "set": SHORT,
    }
    with pytest.raises(DatasetError) as caught:
        cosim.study("academic", out=grid._dataset.label, **(given | changed))
    assert text in str(caught.value)


def test_a_study_that_has_grown_runs_only_what_is_new(tmp_path):
    """The members that were there are not touched."""
    place = tmp_path / "grown"

    def run(seeds):
        return cosim.study(
            "academic-noisy", seeds=seeds, metrics={"y": "rms(sensor.y)"}, set=SHORT, out=place
        )

    few = run(3).table()
    more = run(5)
    assert len(more) == 5
    assert more.table(members=[0, 1, 2]).equals(few)
    assert len({row["y"] for row in more.table().to_pylist()}) == 5


def test_workers_do_not_change_what_members_come_to(grid, tmp_path):
    """One worker, two, and another order of members."""
    one = cosim.study(
        "academic",
        vary={"observer.filter_rate": {"log": [10.0, 1e3], "points": 4}},
        metrics=METRICS,
        set=SHORT,
        out=tmp_path / "one",
        workers=1,
    )
    assert rows(one) == rows(grid)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"vary": {"observer.filter_rat": [1.0]}}, "did you mean 'filter_rate'"),
        ({"vary": {"observer.filter_rate": {"normal": [1.0, -1.0]}}, "samples": 3}, "deviation"),
        ({"metrics": {"a": "rms(observer.delt)"}}, "did you mean 'delta'"),
        ({"metrics": {"a": "observer.delta"}}, "metrics.a"),
        ({"workers": 0}, "workers"),
        ({"keep": "worst 3 of b"}, "no metric 'b'"),
        ({"swap": {"plant": "none.fmu"}}, "none.fmu"),
    ],
)
def test_wrong_input_is_refused_before_anything_runs(tmp_path, given, text):
    """No dataset is begun."""
    place = tmp_path / "refused"
    with pytest.raises(UsageError) as caught:
        cosim.study("academic", **({"metrics": METRICS, "out": place} | given))
    assert text in str(caught.value)
    assert not place.exists()


@pytest.mark.slow
def test_the_logs_of_the_worst_members_are_kept(tmp_path):
    """They are the runs of these members: their metrics are those of the rows."""
    place = tmp_path / "kept"
    study = cosim.study(
        "academic-noisy",
        seeds=4,
        metrics={"y": "last(sensor.y)"},
        set=SHORT,
        keep="worst 2 of y",
        out=place,
    )
    table = study.table().to_pylist()
    worst = sorted(table, key=lambda row: -row["y"])[:2]
    assert set(study.logs) == {row["member"] for row in worst}
    for row in worst:
        log = cosim.open_log(study.logs[row["member"]])
        assert log["sensor.y"][-1] == row["y"]


def test_a_study_says_how_each_member_is_run_alone(grid):
    """What is recorded of the study is enough for that."""
    command_of = RecordedStudy.read(grid.text).command_of(grid)
    for row in grid.table().to_pylist():
        value = row["observer.filter_rate"]
        assert command_of(row["member"]) == (
            f"cosim run academic --set scenario.stop=0.5 --set observer.filter_rate={value!r}"
        )


def test_changed_files_of_members_are_another_study(tmp_path):
    """The digests name each file."""
    scenario = tmp_path / "x.toml"
    table = tmp_path / "u.csv"
    table.write_text("t,u\n0,1\n1,2\n")
    scenario.write_text(
        'scenario = { name = "x", stop = 1.0, step = 0.1 }\n'
        '[components]\nu = { kind = "table", file = "u.csv" }\n'
    )
    study = read_study(scenario).with_options(metrics={"u": "last(u.y)"})
    before = plan_study(study).identity({}).digests
    table.write_text("t,u\n0,1\n1,3\n")
    after = plan_study(study).identity({}).digests
    assert [name for name in before if before[name] != after[name]] == ["table u.csv"]


@pytest.mark.slow
def test_a_refusal_leaves_the_dataset_that_is_there(grid):
    """A scheduler that is not there is found before --new removes anything."""
    before = grid.table()
    with pytest.raises(UsageError, match="scheduler"):
        cosim.study(
            "academic",
            vary={"observer.filter_rate": [1.0]},
            metrics=METRICS,
            out=grid._dataset.label,
            scheduler="tcp://127.0.0.1:1",
            new=True,
        )
    assert cosim.open_study(grid._dataset.label).table().equals(before)


def test_the_command_of_a_member_is_that_of_its_row(tmp_path):
    """Also where the scenario has changed since, or is gone."""
    scenario = tmp_path / "x.toml"
    text = (
        'scenario = { name = "x", stop = 1.0, step = 0.1 }\n'
        '[components]\nu = { kind = "sine", amplitude = AMPLITUDE, rate = 1.0 }\n'
    )
    scenario.write_text(text.replace("AMPLITUDE", "1.0"))
    study = cosim.study(
        scenario,
        vary={"u.amplitude": {"tolerance": 0.1}},
        samples=2,
        metrics={"y": "max(u.y)"},
        out=tmp_path / "out",
    )
    recorded = study.table().to_pylist()[1]["u.amplitude"]
    for change in (lambda: scenario.write_text(text.replace("AMPLITUDE", "2.0")), scenario.unlink):
        change()
        command = RecordedStudy.read(study.text).command_of(study)(1)
        assert command.endswith(f"--set u.amplitude={recorded!r}")


@pytest.mark.slow
def test_the_log_of_a_study_that_was_killed_is_written_again(tmp_path):
    """Only a member with an outcome has a log under its number."""
    place = tmp_path / "kept"
    given = {"seeds": 2, "metrics": {"y": "last(sensor.y)"}, "set": SHORT, "out": place}
    cosim.study("academic-noisy", **given)
    (place / "logs").mkdir()
    (place / "logs" / "_0.unfinished.mcap").write_bytes(b"half")
    study = cosim.study("academic-noisy", **given, keep="all")
    assert set(study.logs) == {0, 1}
    assert cosim.open_log(study.logs[0]).status == "complete"
    assert not list((place / "logs").glob("_*"))


def test_failures_of_an_earlier_call_are_counted(tmp_path):
    """A study that goes on knows how many have failed in all."""
    scenario = tmp_path / "x.toml"
    scenario.write_text(
        'scenario = { name = "x", stop = 1.0, step = 0.1 }\n'
        '[components]\nu = { kind = "expression", y = "1/(t - 0.5)" }\n'
    )
    counts = []
    for stops in ([0.2, 1.0], [0.2, 1.0, 0.3]):
        cosim.study(
            scenario,
            vary={"scenario.stop": stops},
            metrics={"y": "last(u.y)"},
            out=tmp_path / "out",
            progress=lambda *done: counts.append(done),
        )
    assert counts[-1] == (3, 3, 1)


KILLED = """
import sys, cosim
cosim.study("academic-noisy", seeds=30, metrics={"y": "rms(sensor.y)"},
            set={"scenario.stop": 0.5}, out=sys.argv[1], workers=2)
"""


def kill_and_resume(place, counts):
    """Kill the study when so many members are recorded, once for each count; return what was."""
    journal = place / "_journal.jsonl"
    left = []
    for count in counts:
        child = subprocess.Popen([sys.executable, "-c", KILLED, str(place)], start_new_session=True)
        while child.poll() is None:
            if journal.exists() and journal.read_bytes().count(b"\n") >= count:
                os.kill(child.pid, signal.SIGKILL)
            try:
                child.wait(0.005)
            except subprocess.TimeoutExpired:
                continue
        assert child.returncode == -signal.SIGKILL
        left.append(len(cosim.open_study(place)))
    return left


def noisy(place):
    """Return the study that is killed, run to its end."""
    return cosim.study(
        "academic-noisy", seeds=30, metrics={"y": "rms(sensor.y)"}, set=SHORT, out=place
    )


@pytest.mark.slow
def test_a_killed_study_goes_on_to_the_same_dataset(tmp_path):
    """kill -9 of the whole study, several times at other instants: row for row the same."""
    left = kill_and_resume(tmp_path / "killed", (1, 15))
    assert 0 < left[0] < left[1] < 30
    assert rows(noisy(tmp_path / "killed")) == rows(noisy(tmp_path / "whole"))


@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(5))
def test_a_study_killed_at_twenty_instants_goes_on_to_the_same_dataset(tmp_path, seed):
    """After the first of its thirty members, after the 25th, and between them."""
    counts = np.sort(np.random.default_rng(seed).choice(np.arange(1, 26), 20, replace=False))
    left = kill_and_resume(tmp_path / "killed", counts.tolist())
    assert 0 < left[0] < left[-1] < 30
    assert len(set(left)) > 10
    assert rows(noisy(tmp_path / "killed")) == rows(noisy(tmp_path / "whole"))


def test_members_with_refused_draws_fail_and_no_others(tmp_path):
    """They are announced, the study is planned, timed and run; with an FMU, too."""
    write_fit(tmp_path)
    scenario = tmp_path / "noisy.toml"
    source = (tmp_path / "fit.toml").read_text()
    sensor = 'sensor = { kind = "sensor", noise = 1.0, seed = 1 }'
    source = source.replace("[components]", f"[components]\n{sensor}")
    scenario.write_text(f'{source}"sensor.u" = "plant.y"\n')
    for seed in range(20):
        study = read_study(scenario).with_options(
            vary={"sensor.noise": {"normal": [0.0, 1.0]}},
            samples=5,
            seed=seed,
            metrics={"y": "last(plant.y)"},
            set={"scenario.stop": 0.1},
        )
        drawn = plan_design(study, cosim.load(scenario)).column("sensor.noise")
        if drawn[0] < 0.0 < drawn.max():
            break
    notices = []
    done = cosim.study(study, out=tmp_path / "x", workers=1, notice=notices.append)
    assert sorted(done.failures) == np.flatnonzero(drawn < 0.0).tolist()
    assert all("noise: " in reason for reason in done.failures.values())
    (notice,) = notices
    assert notice.startswith("member 0 will fail: ")
    assert re.search(r"noise: .*-\d", notice)
    assert estimate_study(plan_study(study), 1).members == 5
    hopeless = study.with_options(vary={"sensor.noise": {"uniform": [-2.0, -1.0]}})
    with pytest.raises(UsageError, match=r"member 0: .*noise: .*-\d"):
        cosim.study(hopeless, out=tmp_path / "y")


def test_replays_may_compute_the_classes_of_users(tmp_path, monkeypatch):
    """As those of cosim.replay; without leave they are taken from the log, and cannot be varied."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path, relay=RELAY)
    (tmp_path / "thermostat.toml").write_text(THERMOSTAT)
    cosim.run("thermostat.toml", out="a.mcap")
    options = {"vary": {"relay.width": [0.25, 0.5]}, "metrics": {"mean": "mean(room.y)"}}
    with pytest.raises(UsageError, match="or allow its code to run with allow_code=True"):
        cosim.study("a.mcap", **options, out="refused")
    study = cosim.study("a.mcap", **options, out="x", allow_code=True, workers=1)
    again = cosim.replay("a.mcap", set={"relay.width": 0.25}, allow_code=True)
    assert (
        study.table()["mean"].to_pylist()[0] == parse_metrics(options["metrics"]).of(again)["mean"]
    )
    command = RecordedStudy.read(study.text).command_of(study)(0)
    log = tmp_path / "a.mcap"
    assert command == f"cosim replay {log} --set relay.width=0.25 --allow-code"
    assert not (tmp_path / "refused").exists()


@pytest.mark.fast("changed1")
@pytest.mark.parametrize(
    "changed", [{"set": {"observer.filter_rate": 200.0}}, {"allow_code": True}]
)
def test_settings_of_all_replays_belong_to_the_dataset(tmp_path, changed):
    """Their log does not have it."""
    log = tmp_path / "a.mcap"
    cosim.run("academic", set={"scenario.stop": 0.1}, out=log)
    given = {
        "replay": str(log),
        "metrics": {"last": "last(observer.delta)"},
        "set": {"observer.filter_rate": 100.0},
        "out": tmp_path / "x",
        "workers": 1,
    }
    cosim.study("academic", **given)
    with pytest.raises(DatasetError, match="what all members have changed"):
        cosim.study("academic", **{**given, **changed})


def test_empty_cells_of_a_table_of_cases_are_noticed(tmp_path):
    """Each is a value of the scenario's own, and a row of commas a member of the scenario."""
    (tmp_path / "x.toml").write_text(
        'scenario = { name = "x", stop = 1.0, step = 0.1 }\n[components]\n'
        'u = { kind = "sine", amplitude = 1.0, rate = 1.0 }\n'
    )
    (tmp_path / "cases.csv").write_text("u.amplitude,u.rate\n1.5,0.5\n,\n2.5,\n")
    notices = []
    given = {"metrics": {"y": "max(u.y)"}, "workers": 1, "notice": notices.append}
    cosim.study(tmp_path / "x.toml", cases=tmp_path / "cases.csv", out=tmp_path / "a", **given)
    [text] = notices
    assert "cases.csv': 3 empty cells, where members have the scenario's own value; all" in text
    assert text.endswith("all empty is row 2")
    (tmp_path / "cases.csv").write_text("u.amplitude,u.rate\n1.5,0.5\n2.5,1\n")
    cosim.study(tmp_path / "x.toml", cases=tmp_path / "cases.csv", out=tmp_path / "b", **given)
    assert len(notices) == 1


def test_what_members_warn_of_is_a_column_and_a_warning(tmp_path):
    """By number, by line, and in Python once for each text of all members."""
    held = {"scenario.input_interpolation": "zero-order", "observer.filter": "first-order"}
    with pytest.warns(cosim.CosimWarning, match=r"1 of 2 members warns, 1: observer: ") as shown:
        study = cosim.study(
            "academic",
            vary={"observer.filter_rate": [10.0, 900.0]},
            metrics={"last": "last(plant.y)"},
            set={"scenario.stop": 0.01, **held},
            out=tmp_path / "study",
            workers=1,
        )
    assert len(shown) == 3
    (own,), (held_inputs, step) = study.warnings.values()
    assert own.startswith("scenario.step: ")
    assert held_inputs.endswith("do not trust delta")
    assert study.table(["warnings"])["warnings"].to_pylist() == [own, f"{held_inputs}\n{step}"]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("warnings", 5),
        ("warnings", "abc"),
        ("warnings", [["a"]]),
        ("environment", [1]),
        ("layout", {"kind": "grid", "grid": 10**30}),
        ("layout", None),
        ("search", {"metric": "m"}),
        ("source", None),
    ],
)
def test_what_a_dataset_says_of_its_study_has_the_types_it_rests_on(key, value):
    """A dataset may be somebody else's."""
    tables = {"study": {"scenario": "pair", "name": "pair"}, "metrics": {"m": "last(motor.y)"}}
    study, _ = study_of({**tables, "vary": {"controller.gain": [1]}}, "pair")
    said = json.loads(RecordedStudy(study, StudyLayout("grid"), {}).to_text())
    assert RecordedStudy.read(json.dumps(said)).study.name == study.name
    with pytest.raises(UsageError, match=key):
        RecordedStudy.read(json.dumps({**said, key: value}))
    with pytest.raises(UsageError, match=r"nested too deeply|recursion"):
        RecordedStudy.read("[" * 100_000)
