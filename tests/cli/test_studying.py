"""The command study: run, show, plot, and what it refuses."""

import inspect
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import fields

import pytest

import cosim
from cosim.cli import main
from cosim.cli.studies import run
from cosim.studies.study_file import StudyOptions

STUDY = """
[study]
name = "filters"
scenario = "academic"
set = { "scenario.stop" = 0.5 }

[vary]
"observer.filter_rate" = { log = [10.0, 1e3], points = 2 }

[metrics]
error = "rms(observer.delta - delta.y)"
"""


@pytest.fixture
def call(tmp_path, monkeypatch, capsys):
    """Return what runs a command line in a folder with a study, and returns what it prints."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "filters.toml").write_text(STUDY)

    def run(*arguments, code=0):
        with pytest.raises(SystemExit) as ended:
            main(list(arguments))
        captured = capsys.readouterr()
        assert ended.value.code == code, captured.err
        return captured.out if code == 0 else captured.err

    return run


def test_a_study_runs_and_is_shown(call, tmp_path):
    """With and without the word run; the second call runs nothing."""
    printed = call("study", "filters.toml", "--workers", "1")
    assert "2 of 2 members done, none failed" in printed
    assert call("study", "run", "filters.toml") == printed
    place = "logs/filters-study"
    assert call("study", "show", place) == printed
    shown = json.loads(call("study", "show", place, "--json"))
    assert shown["members"]["done"] == 2
    alone = call("study", "show", place, "--member", "1")
    assert "cosim run academic --set scenario.stop=0.5 --set observer.filter_rate=" in alone
    assert call("study", "plot", place, "--out", "a.png") == "a.png\n"
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.usefixtures("members_in_this_process")
@pytest.mark.slow
def test_options_are_those_of_a_file(call):
    """Everything of the file stands on one line, too."""
    call("study", "filters.toml", "-q", "--out", "one")
    call(
        "study",
        "academic",
        "--stop",
        "0.5",
        "--vary",
        "observer.filter_rate=log:10:1e3:2",
        "--metric",
        "error=rms(observer.delta - delta.y)",
        "--out",
        "two",
        "-q",
    )
    one = json.loads(call("study", "show", "one", "--json"))
    two = json.loads(call("study", "show", "two", "--json"))
    assert one["statistics"] == two["statistics"]


@pytest.mark.usefixtures("members_in_this_process")
@pytest.mark.slow
def test_a_dry_run_records_nothing(call, tmp_path):
    """It says how many members there are, and what they take."""
    printed = call("study", "filters.toml", "--dry-run")
    assert "nothing was recorded" in printed
    assert not (tmp_path / "logs").exists()
    estimate = json.loads(call("study", "filters.toml", "--dry-run", "--json"))
    assert estimate["members"] == 2
    assert estimate["study_time"] > 0


@pytest.mark.usefixtures("members_in_this_process")
@pytest.mark.slow
def test_a_dry_run_refuses_what_the_run_would_refuse(call, tmp_path):
    """The dataset of another study in its place, and what it does not show."""
    call("study", "filters.toml", "--set", "scenario.stop=0.25", "--out", "other", "-q")
    before = {path: path.read_bytes() for path in (tmp_path / "other").rglob("*") if path.is_file()}
    text = call("study", "filters.toml", "--dry-run", "--out", "other", code=2)
    assert "other holds the dataset of another study" in text
    assert {path: path.read_bytes() for path in before} == before
    assert "nothing was recorded" in call(
        "study", "filters.toml", "--dry-run", "--out", "other", "--new"
    )


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--vary", "observer.filter_rate=log:10:1e3"], "log:FIRST:LAST:POINTS"),
        (["--vary", "observer.filter_rate=lgo:10:1e3:3"], "did you mean 'log'"),
        (["--metric", "error=rms("], r"metrics\.error: metric 'rms\('"),
        (["--keep", "1,,2"], "--keep: .*'1,,2'"),
        (["--keep", "wurst"], "--keep"),
        (["--keep", "0,4"], "--keep: .*member 4"),
        (["--workers", "0"], "--workers: .*0"),
        (["--timeout", "-1"], "--timeout"),
        (["--sampling", "sobol"], "nothing is drawn"),
        (["--seeds", "3"], "nothing in the scenario has a seed"),
        (["--set", "observer.filter_rate=1"], "it is varied"),
        (["--cases", "a.csv", "--cases", "b.csv"], "--cases: .*given 2 times"),
        (["--out", "a", "-o", "b"], "--out: .*given 2 times"),
        (["--out", "memory://a"], "--out: .*'memory://a'"),
    ],
)
def test_wrong_options_are_named(call, arguments, text):
    """One clear error each, with exit code 2."""
    assert re.search(text, call("study", "filters.toml", *arguments, code=2))


def test_only_a_dataset_is_shown(call):
    """A folder, a file, nothing."""
    for place in (".", "filters.toml", "none"):
        assert "dataset of a study" in call("study", "show", place, code=2)


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


@pytest.mark.usefixtures("members_in_this_process")
@pytest.mark.slow
def test_a_study_with_failed_members_exits_with_1(call, tmp_path):
    """All of it is recorded and shown all the same."""
    (tmp_path / "x.toml").write_text(
        'scenario = { name = "x", stop = 1.0, step = 0.1 }\n'
        '[components]\nu = { kind = "expression", y = "1/(t - 0.5)" }\n'
    )
    arguments = ["x.toml", "--vary", "scenario.stop=0.2,1.0", "--metric", "y=last(u.y)"]
    call("study", *arguments, code=1)
    assert "2 of 2 members done, 1 failed" in call("study", "show", "logs/x-study")


def test_all_options_of_a_study_can_be_given_everywhere():
    """In a file, to cosim.study and on the command line, under their names."""
    of_file = {each.name for each in fields(StudyOptions)}
    of_function = set(inspect.signature(cosim.study).parameters)
    of_command = set(inspect.signature(run).parameters)
    assert of_file < of_function
    assert of_file - {"metrics"} | {"metric", "stop"} < of_command
    assert "stop" in of_function
