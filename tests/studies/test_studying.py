"""Studies from their file to their dataset: run, resumed, grown, refused, estimated."""

import gc
import os
import re
import signal
import subprocess
import sys

import numpy as np
import pytest

import cosim
from cosim.errors import ChangedFileError, DatasetError, UsageError
from cosim.report.summary import results_of, summarize
from cosim.studies.design import plan_design
from cosim.studies.plan import RecordedStudy, plan_study
from cosim.studies.study_file import StudyOptions, read_study
from cosim.studies.studying import estimate_study
from tests.studies.deeds import wait_until

GRID = {
    "vary": {"observer.filter_rate": {"log": [10.0, 1e3], "points": 4}},
    "metrics": {"error": "rms(observer.delta - delta.y)", "last": "last(plant.y)"},
    "set": {"scenario.stop": 0.1},
}
FILES = """
scenario = { name = "x", stop = 1.0, step = 0.1 }
[components]
u = { kind = "table", file = "u.csv" }
s = { kind = "sine", amplitude = 1.0, rate = 1.0 }
v = { kind = "expression", y = "1/(t - 0.5)" }
"""


def rows(study):
    """Return what members came to, without what differs from run to run."""
    return study.table().drop_columns(["wall_time", "worker", "log"]).to_pylist()


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    """Return the place of a study of four members."""
    place = str(tmp_path_factory.mktemp("studies") / "grid")
    cosim.study("academic", **GRID, out=place, workers=2)
    return place


@pytest.fixture
def scenario(tmp_path):
    """Return a scenario with a table; it fails if it runs for longer than half a second."""
    path = tmp_path / "x.toml"
    path.write_text(FILES)
    (tmp_path / "u.csv").write_text("t,y\n0,1.0\n1,1.0\n")
    return path


def test_every_member_is_its_run_alone(grid):
    """With the command that is shown for it; what is done does not run again."""
    study = cosim.open_study(grid)
    command_of = RecordedStudy.read(study.text).command_of(study)
    for row in study.table().to_pylist():
        rate = row["observer.filter_rate"]
        alone = cosim.run("academic", set={**GRID["set"], "observer.filter_rate": rate})
        assert row["last"] == alone["plant.y"][-1]
        assert (row["status"], row["steps"]) == ("complete", 100)
        command = f"--set scenario.stop=0.1 --set observer.filter_rate={rate!r}"
        assert command_of(row["member"]) == f"cosim run academic {command}"
    again = cosim.study("academic", **GRID, out=grid)
    assert again.table().equals(study.table())


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"metrics": {"a": "rms(observer.delt)"}}, "did you mean 'delta'"),
        ({"metrics": {}, "keep": "worst 1 of no"}, "keep: 'no' is not a numeric metric"),
        ({"new": 1}, "new"),
    ],
)
def test_wrong_input_is_refused_before_anything_is_made(tmp_path, given, text):
    with pytest.raises(UsageError, match=re.escape(text)):
        cosim.study("academic", **({**GRID, "out": tmp_path / "x"} | given))
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nowhere", "tls://127.0.0.1:1", "x://y"])
def test_a_scheduler_that_is_not_there_is_found_before_anything_is_removed(
    grid, address, monkeypatch
):
    """A new beginning is one only where it can begin."""
    monkeypatch.setattr("cosim.studies.cluster._CONNECTING", 0.1)
    gc.collect()  # dask hangs where a client that failed is collected while another one starts
    with pytest.raises(UsageError, match="scheduler: cannot connect to a dask scheduler at"):
        cosim.study("academic", **GRID, out=grid, scheduler=address, new=True)
    assert len(cosim.open_study(grid)) == 4


@pytest.mark.parametrize(
    "few",
    [{"seeds": 3}, {"vary": {"sensor.noise": {"uniform": [0.0, 1.0]}}, "samples": 3}],
)
def test_a_study_that_has_grown_runs_only_what_is_new(tmp_path, few):
    """The members that were there are not touched; with samples in layers none would be."""
    given = {"metrics": {"y": "rms(sensor.y)"}, "set": {"scenario.stop": 0.02}, **few}
    before = cosim.study("academic-noisy", **given, out=tmp_path / "grown").table()
    calls = []
    given |= {"seeds" if "seeds" in few else "samples": 5}
    grown = cosim.study(
        "academic-noisy", **given, out=tmp_path / "grown", progress=lambda *n: calls.append(n)
    )
    assert calls == [(4, 5, 0), (5, 5, 0)]
    assert grown.table(members=range(3)).equals(before)
    whole = cosim.study("academic-noisy", **given, out=tmp_path / "whole")
    assert rows(whole) == rows(grown)
    assert len({row["y"] for row in rows(grown)}) == 5
    if "samples" in few:
        with pytest.raises(DatasetError, match=r"member 0 was sensor.noise = .*; members keep"):
            cosim.study(
                "academic-noisy", **given, out=tmp_path / "grown", sampling="latin-hypercube"
            )


def test_failures_are_rows_and_counted(scenario, tmp_path):
    """Also those of an earlier call; they do not run again."""
    counts = []
    for stops in ([0.2, 1.0], [0.2, 1.0, 0.3]):
        study = cosim.study(
            scenario,
            vary={"scenario.stop": stops},
            metrics={"y": "last(v.y)"},
            out=tmp_path / "out",
            progress=lambda *done: counts.append(done),
        )
    assert counts == [(1, 2, 0), (2, 2, 1), (3, 3, 1)]
    assert list(study.failures) == [1]
    assert "v.y" in study.failures[1]
    assert [row["y"] for row in rows(study)] == [1 / (0.2 - 0.5), None, 1 / (0.3 - 0.5)]


def test_members_with_refused_draws_fail_and_no_others(tmp_path):
    """They are announced; a study that has only such ones is refused."""
    study = read_study("academic-noisy").with_options(
        StudyOptions(
            vary={"sensor.noise": {"normal": [0.0, 1.0]}},
            samples=5,
            metrics={"y": "last(plant.y)"},
            set={"scenario.stop": 0.01},
        )
    )
    drawn = plan_design(study, cosim.load("academic-noisy")).column("sensor.noise")
    assert drawn.min() < 0.0 < drawn.max()
    count = np.count_nonzero(drawn < 0.0)
    said = rf"\A{count} of 5 samples .* will fail, such as member \d: .*noise: .*-\d"
    with pytest.warns(cosim.CosimWarning, match=said):
        done = cosim.study(study, out=tmp_path / "x", workers=1)
    assert sorted(done.failures) == np.flatnonzero(drawn < 0.0).tolist()
    assert all("noise: " in reason for reason in done.failures.values())
    notices = []
    cosim.study(study, out=tmp_path / "x", workers=1, notice=notices.append)
    assert re.search(said, notices[0])
    hopeless = study.with_options(StudyOptions(vary={"sensor.noise": {"uniform": [-2.0, -1.0]}}))
    with pytest.raises(UsageError, match=r"member 0: .*noise: .*-\d"):
        cosim.study(hopeless, out=tmp_path / "y")


def test_what_members_warn_of_is_a_column_and_a_warning(tmp_path):
    """What its run alone warns of; in Python once for each text of all members."""
    held = {"scenario.input_interpolation": "zero-order", "observer.filter": "first-order"}
    given = {"scenario.stop": 0.01, **held}
    rates = [900.0, 10.0]
    with pytest.warns(cosim.CosimWarning, match=r"1 of 2 members warns, 0: observer: ") as shown:
        study = cosim.study(
            "academic",
            vary={"observer.filter_rate": rates},
            metrics={"last": "last(plant.y)"},
            set=given,
            out=tmp_path / "study",
            workers=1,
        )
    assert len(shown) == 3
    assert [len(lines) for lines in study.warnings.values()] == [2, 1]
    for number, rate in enumerate(rates):
        run = cosim.run("academic", set={**given, "observer.filter_rate": rate})
        assert study.warnings[number] == sorted(f"{w.source}: {w.text}" for w in run.warnings)


def test_a_study_stops_where_a_file_changes(scenario, tmp_path):
    """What is recorded is of the file as it was; put back, the study goes on."""
    table = tmp_path / "u.csv"
    before = table.read_text()
    given = {"vary": {"s.amplitude": [1.0, 2.0, 3.0]}, "metrics": {"y": "last(u.y)"}}
    given |= {"set": {"scenario.stop": 0.3}, "out": tmp_path / "out", "workers": 1}

    def change(*_):
        table.write_text("t,y\n0,2.0\n1,2.0\n")

    with pytest.raises(ChangedFileError, match=r"u\.csv has changed since this study began"):
        cosim.study(scenario, **given, progress=change)
    assert len(cosim.open_study(tmp_path / "out")) == 1
    with pytest.raises(DatasetError, match=r"table u\.csv changed"):
        cosim.study(scenario, **given)
    table.write_text(before)
    done = cosim.study(scenario, **given)
    assert done.table().column("y").to_pylist() == [1.0, 1.0, 1.0]


def test_results_are_columns_beside_the_metrics(tmp_path):
    """Those of a run; a study that goes on has those of its dataset."""
    given = {"vary": {"observer.filter_rate": [100.0, 200.0]}, "set": {"scenario.stop": 0.1}}
    given |= {"metrics": {"y": "last(plant.y)"}, "results": True, "out": tmp_path / "x"}
    study = cosim.study("academic", **given, workers=1)
    for row in study.table().to_pylist():
        edits = {"scenario.stop": 0.1, "observer.filter_rate": row["observer.filter_rate"]}
        run = cosim.run("academic", set=edits)
        results = {**results_of(summarize(run)), "y": run["plant.y"][-1]}
        assert {name: row[name] for name in study.metrics} == results
    assert "observer.delta rms error" in results
    given["vary"] = {"observer.filter_rate": [100.0, 200.0, 300.0]}
    assert cosim.study("academic", **given, workers=1).metrics == study.metrics
    with pytest.raises(DatasetError, match="the metrics changed"):
        cosim.study("academic", **(given | {"results": False}))


KILLED = """
import sys, cosim
cosim.study("academic-noisy", seeds=30, metrics={"y": "rms(sensor.y)"},
            set={"scenario.stop": 0.5}, out=sys.argv[1], workers=2)
"""


@pytest.mark.slow
@pytest.mark.usefixtures("worker_processes")
def test_a_killed_study_goes_on_to_the_same_dataset(tmp_path):
    """kill -9 of the whole study, several times at other instants: row for row the same."""
    journal = tmp_path / "killed" / "_journal.jsonl"
    left = []
    for count in (1, 15):
        command = [sys.executable, "-c", KILLED, str(tmp_path / "killed")]
        with subprocess.Popen(command, start_new_session=True) as child:
            wait_until(
                lambda count=count: journal.exists() and journal.read_bytes().count(b"\n") >= count
            )
            os.kill(child.pid, signal.SIGKILL)
        assert child.returncode == -signal.SIGKILL
        left.append(len(cosim.open_study(tmp_path / "killed")))
    assert 0 < left[0] < left[1] < 30
    given = {"seeds": 30, "metrics": {"y": "rms(sensor.y)"}, "set": {"scenario.stop": 0.5}}
    killed, whole = (
        rows(cosim.study("academic-noisy", **given, out=tmp_path / name))
        for name in ("killed", "whole")
    )
    assert killed == whole


# --- estimates ---


def test_a_study_takes_what_was_said(scenario, tmp_path):
    """Logs as large as one that was timed; texts their length, numbers 8 bytes."""
    study = read_study(scenario).with_options(
        StudyOptions(
            vary={"s.amplitude": {"linear": [1.0, 2.0], "points": 7}},
            metrics={"y": "max(s.y)"},
            set={"v.y": "t", "scenario.step": 0.001},
            keep="all",
            results=True,
        )
    )
    estimate = estimate_study(plan_study(study), 2)
    assert (estimate.members, estimate.workers) == (7, 2)
    assert estimate.study_time > estimate.first_time + 3 * estimate.member_time  # and their logs
    assert not (tmp_path / "logs").exists()
    done = cosim.study(study, out=tmp_path / "out", workers=2)
    size = sum(path.stat().st_size for path in (tmp_path / "out" / "logs").iterdir())
    assert estimate.log_bytes == pytest.approx(size, rel=0.1)
    values = [value for row in done.table().to_pylist() for value in list(row.values())[:-1]]
    total = sum(len(value) if isinstance(value, str) else 8 for value in values)
    assert estimate.dataset_bytes == pytest.approx(total, rel=0.1)


def test_members_that_fail_are_no_measure(scenario):
    """They are named with their reasons."""
    study = read_study(scenario).with_options(
        StudyOptions(vary={"s.rate": [1.0, 2.0]}, metrics={"y": "last(v.y)"})
    )
    with pytest.raises(UsageError, match=r"none of the first 2 members .*member 1: .*v\.y"):
        estimate_study(plan_study(study), 1)
