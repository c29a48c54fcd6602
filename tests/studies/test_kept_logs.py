"""Logs of chosen members: those that the study names, each that of its row."""

from pathlib import Path

import pytest

import cosim
from cosim.errors import LogError, LogWriteError, RunError
from cosim.studies import members
from cosim.studies.contracts import MemberOutcome, StudyMember
from cosim.studies.kept_logs import chosen_members, kept_count, limit_again
from cosim.studies.study_file import read_keep
from tests.studies.test_dataset import add, opened

SINE = """
scenario = { name = "x", stop = 1.0, step = 0.1 }
[components]
u = { kind = "sine", amplitude = 1.0, rate = 1.0 }
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
    assert calls == [(2, 4, 0), (3, 4, 0), (4, 4, 0)]
    assert made.stat().st_mtime_ns == before
    assert not list(made.parent.glob("_*"))
    assert notices == more == []
    for row in study.table().to_pylist():
        log = cosim.open_log(row["log"])
        assert (log.status, log["u.y"][-1]) == ("complete", row["y"])


def test_a_full_disk_ends_a_study_whose_logs_are_written_later(run, monkeypatch):
    """A log that cannot even be begun is noticed."""

    def full(error):
        raise error("0.mcap cannot be written further: No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(members, "record", lambda *_, **__: full(LogWriteError))
        with pytest.raises(RunError, match=r"0.mcap cannot be written further: No space left"):
            run(keep="worst 1 of y")
        patch.setattr(members, "record", lambda *_, **__: full(LogError))
        study, notices = run(keep="worst 1 of y")
    assert study.logs == {}
    assert any("No space left on device" in text for text in notices)
    study, _ = run(keep="worst 1 of y")
    assert set(study.logs) == {2}


def test_a_model_that_is_not_deterministic_is_noticed(run, monkeypatch):
    """Its log has other metrics than its row."""
    values = iter([0.25, 0.5])
    monkeypatch.setattr(members.MetricRecorder, "values", lambda _: {"y": next(values)})
    _, (text,) = run([1.0], keep="all")
    assert text.startswith("member 0 was rerun for its log: y = 0.5; recorded: 0.25; the model is")


def test_members_that_hang_again_are_waited_for_no_longer_than_before(tmp_path):
    """Others ten times the longest, at least a minute."""
    with opened(tmp_path, 30) as dataset:
        add(dataset, range(20), seed=0.25)  # seconds
        assert [limit_again(dataset, given) for given in (None, 5.0, 100.0)] == [60.0, 60.0, 100.0]
        for reason, seconds, limit in (("hangs: ...", 400.0, 400.0), ("", 50.0, 500.0)):
            number = len(dataset)
            outcome = MemberOutcome(number, "failed", reason, wall_time=seconds)
            dataset.add(StudyMember(number), outcome)
            assert limit_again(dataset, None) == limit
