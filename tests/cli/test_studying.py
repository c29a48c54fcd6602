"""The commands study and tune, and the metrics of a member that is run alone."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time

import pytest

import cosim
from cosim.cli.studies import stopped_text
from cosim.studies.plan import RecordedStudy

IN_THIS_PROCESS = pytest.mark.usefixtures("files", "members_in_this_process")


@IN_THIS_PROCESS
def test_a_study_runs_and_is_shown(call):
    """With and without the word run; the second call runs nothing."""
    code, printed, _ = call("study", "filters.toml", "--workers", "1")
    assert code == 0
    assert "2 of 2 members done, none failed" in printed
    place = "logs/filters-study"
    for command in (("run", "filters.toml"), ("show", place)):
        assert call("study", *command)[:2] == (0, printed)
    assert json.loads(call("study", "show", place, "--json")[1])["members"]["done"] == 2
    alone = call("study", "show", place, "--member", "1")[1]
    assert "cosim run academic --set scenario.stop=0.1 --set observer.filter_rate=" in alone


@pytest.mark.slow
@IN_THIS_PROCESS
def test_a_dry_run_estimates_and_records_nothing(call, files):
    """It refuses what the run would refuse: the dataset of another study in its place."""
    dry = ("study", "filters.toml", "--dry-run")
    assert "nothing was recorded" in call(*dry)[1]
    assert not (files / "logs").exists()
    estimate = json.loads(call(*dry, "--json")[1])
    assert (estimate["members"], estimate["study_time"] > 0) == (2, True)
    call("study", "filters.toml", "--set", "scenario.stop=0.05", "--out", "other", "-q")
    before = {path: path.read_bytes() for path in (files / "other").rglob("*") if path.is_file()}
    code, _, err = call(*dry, "--out", "other")
    assert code == 2
    assert "other holds the dataset of another study" in err
    assert {path: path.read_bytes() for path in before} == before
    assert "nothing was recorded" in call(*dry, "--out", "other", "--new")[1]


@pytest.mark.slow
def test_an_interrupted_study_says_how_to_go_on(tmp_path):
    """Ctrl-C: exit 130, no worker is left, and the same command goes on."""
    line = "study academic-noisy --seeds 500 --metric y=rms(sensor.y) --out out -q"
    command = [sys.executable, "-m", "cosim", *line.split()]
    child = subprocess.Popen(
        command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 60
    journal = tmp_path / "out" / "_journal.jsonl"
    while time.monotonic() < deadline and not (journal.exists() and journal.stat().st_size):
        time.sleep(0.05)
    os.kill(child.pid, signal.SIGINT)
    _, messages = child.communicate(timeout=60)
    assert child.returncode == 130
    assert "of 500 members are recorded in out; the same command resumes" in messages


@pytest.mark.slow
def test_members_fail_their_study(call):
    """By number, with the first as an example; one whose run fails does, too."""
    common = shlex.split(
        "study academic --vary observer.filter_rate=10,900 --metric e=last(plant.y) --stop 0.05 "
        "--set scenario.input_interpolation=zero-order --set observer.filter=first-order -q"
    )
    code, _, err = call(*common, "--out", "a", "--assert", "e < 1", "--fail-on", "warning")
    assert code == 1
    assert "cosim: --fail-on warning: 1 of 2 members (1); member 1: observer: " in err
    assert "--assert" not in err
    code, _, err = call(*common, "--out", "b", "--assert", "rms(plant.y) < 0.1")
    assert code == 1
    assert "cosim: --assert rms(plant.y) < 0.1: 2 of 2 members (0, 1); member 0: rms(" in err
    bad = "components.bad={ kind = 'expression', y = '1/(t - 0.03)' }"
    failing = ("study", "academic", "--set", bad, "--vary", "scenario.stop=0.02,0.1", "-q")
    assert call(*failing, "--metric", "y=last(plant.y)", "--out", "c")[0] == 1
    assert "2 of 2 members done, 1 failed" in call("study", "show", "c")[1]


# --- metrics of a study ---

METRICS = {
    "error": "rms(observer.delta - delta.y, t > 0.1)",
    "late": "first(t, abs(observer.delta - delta.y) < 1e-2 for 10 ms)",
    "never": "first(t, plant.y > 1e9)",
    "joined": "max(abs(plant.y)) - std(plant.y) / integral(plant.y)",
}
LONGER = {"scenario.stop": 0.5}
RATES = {"observer.filter_rate": [123.4, 1234.5]}
DRAWN = {
    "observer.filter_rate": {"log-uniform": [100.0, 1e3]},
    "plant.x_a0[0]": {"normal": [1.0, 0.1]},
}


@pytest.mark.slow
def test_a_member_that_is_run_alone_has_the_bits_of_its_study(call):
    """By the command that is printed, and from its log; in Python, too."""
    drawn = {"vary": DRAWN, "samples": 3, "seeds": 2, "set": LONGER}
    study = cosim.study("academic-noisy", **drawn, metrics=METRICS, out="x", workers=1)
    assert study.failures == {}
    command_of = RecordedStudy.read(study.text).command_of(study)
    for number, row in enumerate(study.table(list(METRICS)).to_pylist()):
        log = f"{number}.mcap"
        call(*shlex.split(command_of(number))[1:], "--out", log, "-q")
        values = json.loads(call("metrics", log, "--of", "x", "--json")[1])
        assert repr(values) == repr({name: row[name] for name in METRICS})
        assert cosim.metrics(log, METRICS) == values
    shown = dict(line.split("\t") for line in call("metrics", log, "--of", "x")[1].splitlines())
    assert shown == {n: "no value" if v is None else repr(v) for n, v in values.items()}


@pytest.mark.slow
@IN_THIS_PROCESS
def test_a_log_that_is_none_of_a_study_is_noticed(call):
    """Of another scenario; a study without metrics says nothing of what to compute."""
    cosim.study("academic", vary=RATES, set=LONGER, metrics=METRICS, out="x", workers=1)
    call("run", "lag.toml", "--out", "lag.mcap", "-q")
    noticed = "these may not be metrics of a member of x: "
    assert noticed not in call("metrics", "a.mcap", "--of", "x")[2]
    assert noticed in call("metrics", "lag.mcap", "--of", "x")[2]
    cosim.study("academic", set=LONGER, out="y", workers=1)
    code, _, err = call("metrics", "a.mcap", "--of", "y")
    assert code == 2
    assert "this study has no metrics" in err


# --- tunings ---

GOAL = "abs(last(plant.y) - 0.5)"
TUNE = ("tune", "lag.toml", "--workers=1", "--vary=plant.time_constant=log:0.1:10")


@IN_THIS_PROCESS
def test_a_tuning_says_the_best_values_and_how_to_run_them(call, files):
    """1 - exp(-1 / T) = 0.5 has T = 1 / log 2 = 1.4427; the stop is that of all members."""
    tune = (*TUNE, "--minimize", GOAL, "--stop=1", "--starts=1", "--out=d")
    code, out, _ = call(*tune)
    objective, value, *statements, again = out.splitlines()
    assert code == 0
    assert objective.startswith(f"{GOAL} = ")
    assert value.startswith("  plant.time_constant = 1.4427")
    assert statements == [
        "COBYQA converged: trust region 1e-05 of the bounds",
        "searched from one start; better values elsewhere are not excluded",
    ]
    command = f"cosim run {files}/lag.toml --set scenario.stop=1.0 --set plant.time_constant"
    assert again.startswith(f"again: {command}=1.4427")
    content = json.loads(call(*tune, "--json")[1])  # of the recorded members
    assert content["converged"]
    assert content["best"]["values"]["plant.time_constant"] == pytest.approx(1.4427, abs=1e-4)


@IN_THIS_PROCESS
def test_a_tuning_that_is_interrupted_says_how_to_go_on(call, files, monkeypatch):
    """Ctrl-C while its sixth member would run."""
    tune = (*TUNE, "--minimize", GOAL)
    call(*tune, "--out=d", "--members=5")

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("cosim.studies.search.Trials._try", interrupt)
    recorded = "stopped: 5 of 9 members are recorded in d; the same command "
    for options, said in [
        (["--out=d"], f"{recorded}resumes\n"),
        (["--out=d", "--new"], f"{recorded}without --new resumes from them"),
        (["--out=e"], "stopped before the first member was recorded"),
    ]:
        code, out, err = call(*tune, "--members=9", *options)
        assert (code, out) == (130, "")
        assert re.search(re.escape(said), err)
    (files / "d" / "study.json").write_text("{")
    assert "damaged" in stopped_text("d", new=True)
