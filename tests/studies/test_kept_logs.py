"""Logs of chosen members: those that the study names, each that of its row."""

from dataclasses import replace
from pathlib import Path

import pytest

import cosim
from cosim.errors import LogError, LogWriteError, RunError
from cosim.studies import members
from cosim.studies.contracts import MemberOutcome, StudyMember
from cosim.studies.dataset import StudyDataset
from cosim.studies.kept_logs import chosen_members, kept_count, limit_again
from cosim.studies.study_file import read_keep
from tests.fmi.compiled import compile_fmu
from tests.fmi.rogues import STATELESS
from tests.studies.test_dataset import add, opened

SINE = """
scenario = { name = "x", stop = 1.0, step = 0.1 }
[components]
u = { kind = "sine", amplitude = 1.0, rate = 1.0 }
"""
RANDOM = """
import random
import numpy as np
from cosim.core import Interface, Signal

class Random:
    interface = Interface(inputs=(), outputs=(Signal("y"),))

    def initialize(self, t, u):
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([random.random()])

    def advance(self, t, h, u):
        return np.array([[random.random()] for _ in t[1:]])
"""


@pytest.fixture
def run(tmp_path):
    """Return what runs a study of sines, and returns it with what it noticed."""
    (tmp_path / "x.toml").write_text(SINE)

    def run(amplitudes=(1.0, 2.0, 3.0), **given):
        notices = []
        common = {"metrics": {"y": "last(u.y)"}, "out": tmp_path / "out", "notice": notices.append}
        vary = {"u.amplitude": list(amplitudes)}
        study = cosim.study(tmp_path / "x.toml", vary=vary, workers=1, **(common | given))
        return study, notices

    return run


@pytest.mark.parametrize(
    ("keep", "expected", "count"),
    [
        (None, [], 0),
        ("all", range(25), 30),
        ("failed", [3, 10, 17, 24], None),
        ((2, 4, 29), [2, 4], 3),
        ("worst 3 of error", [0, 1, 2], 3),
        ("worst 2 of late", [22, 23], 2),
        ("best 99 of late", [n for n in range(25) if n % 4 and n % 7 != 3], 30),
    ],
)
def test_members_are_chosen_by_their_rows(tmp_path, keep, expected, count):
    """A member without a value is none of the worst; before they run, their number is known."""
    kept = read_keep(keep)
    assert kept_count(kept, 30) == count
    with opened(tmp_path, 30) as dataset:
        add(dataset, range(25))
        assert chosen_members(kept, dataset).tolist() == list(expected)


def test_logs_are_those_of_the_rows_and_made_once(run):
    """A study that has grown, and another choice, make those that are not there."""
    calls = []
    study, notices = run(keep="worst 1 of y")
    assert set(study.logs) == {2}
    made = Path(study.logs[2])
    made.with_name("_0.mcap.cosim-tmp").write_bytes(b"half")  # left by a study that was killed
    before = made.stat().st_mtime_ns
    given = {"keep": "all", "keep_progress": lambda *done: calls.append(done)}
    study, more = run((1.0, 2.0, 3.0, 4.0), **given)
    assert set(study.logs) == {0, 1, 2, 3}
    assert calls == [(2, 4, 0), (3, 4, 0), (4, 4, 0)]
    assert made.stat().st_mtime_ns == before
    assert not list(made.parent.glob("_*"))
    assert notices == more == []
    for row in study.table().to_pylist():
        log = cosim.open_log(row["log"])
        assert (log.status, log["u.y"][-1]) == ("complete", row["y"])


def test_a_full_disk_ends_a_study_whose_logs_are_written_later(run, monkeypatch):
    """Also where the log cannot even be begun."""
    begun = LogError("0.mcap cannot be written: No space left on device")
    written = LogWriteError("0.mcap cannot be written further: No space left on device")

    def full(error):
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(members, "record", lambda *_, **__: full(written))
        with pytest.raises(RunError, match=r"0.mcap cannot be written further: No space left"):
            run(keep="worst 1 of y")
        patch.setattr(members, "record", lambda *_, **__: full(begun))
        study, notices = run(keep="worst 1 of y")
    assert study.logs == {}
    assert any("No space left on device" in text for text in notices)
    study, _ = run(keep="worst 1 of y")
    assert set(study.logs) == {2}


def test_a_model_that_is_not_deterministic_is_noticed(run, tmp_path, monkeypatch):
    """Its log has other metrics than its row."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "randomness.py").write_text(RANDOM)
    more = 'r = { kind = "python", class = "randomness:Random" }\n'
    (tmp_path / "x.toml").write_text(SINE + more)
    study, notices = run([1.0], metrics={"y": "last(r.y)"}, keep="all")
    now = cosim.open_log(study.logs[0])["r.y"][-1]
    (row,) = study.table().to_pylist()
    (text,) = notices
    assert now != row["y"]
    assert text.startswith(
        f"member 0 was rerun for its log: y = {float(now)!r}; recorded: {row['y']!r}; "
    )


@pytest.mark.slow
@pytest.mark.usefixtures("worker_processes")
def test_logs_of_members_that_crash_or_hang_end_there(tmp_path):
    """One hangs after a few steps, one crashes in the first, one later, one fails and says so."""
    names = ["LIES", "HANGS_LATER", "CRASH", "FAILS_STEP", "CRASHES_LATER"]
    for name in names:
        compile_fmu(tmp_path / f"{name}.fmu", STATELESS, "rogue2.c", defines=(f"ROGUE={name}",))
    scenario = tmp_path / "x.toml"
    scenario.write_text(
        'scenario = { name = "x", stop = 0.1, step = 0.01 }\n'
        '[components]\nplant = { kind = "fmu", path = "LIES.fmu" }\n'
    )
    notices = []
    given = {
        "vary": {"plant.path": [str(tmp_path / f"{name}.fmu") for name in names]},
        "metrics": {"y": "last(plant.y)"},
        "out": tmp_path / "out",
        "workers": 2,
        "timeout": 3.0,
        "notice": notices.append,
    }
    study = cosim.study(scenario, keep="failed", **given)
    assert set(study.logs) == {1, 3, 4}
    log = cosim.open_log(study.logs[1])
    assert (log.status, log.steps >= 1) == ("unfinished", True)
    assert cosim.open_log(study.logs[3]).status == "failed"
    (text,) = notices
    assert text.startswith(
        "no log of members that failed: 2 (crashes: SIGSEGV, before a row of its log"
    )
    left = sorted((tmp_path / "out" / "logs").iterdir())
    assert [path.name for path in left] == ["1.mcap", "2.txt", "3.mcap", "4.mcap"]
    assert set(cosim.study(scenario, keep=[0], **given).logs) == {0, 1, 3, 4}


def test_members_that_hang_again_are_waited_for_no_longer_than_before(tmp_path):
    """Others ten times the longest, at least a minute."""
    with opened(tmp_path, 30) as dataset:
        add(dataset, range(20), seed=0.25)
        assert limit_again(dataset, None) == limit_again(dataset, 5.0) == 60.0
        assert limit_again(dataset, 100.0) == 100.0
        hung = MemberOutcome(20, "failed", "hangs: ...", wall_time=400.0)
        dataset.add(StudyMember(20), hung)
        assert limit_again(dataset, None) == 400.0
        dataset.add(StudyMember(21), replace(hung, number=21, reason="", wall_time=50.0))
        assert limit_again(dataset, None) == 500.0
    assert len(StudyDataset.open(tmp_path)) == 22
