"""Logs of chosen members: those that the study names, and no others; nothing is lost."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import fsspec
import pytest
from cosim.studies.dataset.log_files import LogRecord
from cosim.studies.members.left_log import readable_log
from cosim.studies.running.keeping import LogKeeper, keep_logs
from cosim.studies.running.kept_members import chosen_members

import cosim
from cosim.errors import UsageError
from cosim.studies.contracts import FAILED, MemberOutcome
from cosim.studies.dataset import StudyDataset
from cosim.studies.plan import RecordedStudy, plan_study
from cosim.studies.study_file import read_keep
from cosim.studies.studying import open_dataset
from tests.fmi.compiled import compile_fmu
from tests.fmi.rogues import STATELESS
from tests.studies.outcomes import add, identity

SINE = """
scenario = { name = "x", stop = 1.0, step = 0.1 }
[components]
u = { kind = "sine", amplitude = 1.0, rate = 1.0 }
v = { kind = "sine", amplitude = 1.0, rate = 2.0 }
"""


@pytest.fixture
def run(tmp_path):
    """Return what runs a study of sines, and returns it with what it noticed."""
    scenario = tmp_path / "x.toml"
    scenario.write_text(SINE)

    def run(amplitudes=(1.0, 2.0, 3.0), out=tmp_path / "out", **given):
        notices = []
        study = cosim.study(
            scenario,
            vary={"u.amplitude": list(amplitudes)},
            metrics={"y": "max(u.y)"},
            out=out,
            workers=1,
            notice=notices.append,
            **given,
        )
        return study, notices

    return run


@pytest.mark.parametrize(
    ("keep", "expected"),
    [
        ("all", range(25)),
        ("failed", [3, 10, 17, 24]),
        ([2, 4, 99], [2, 4]),
        ("worst 3 of error", [0, 1, 2]),
        ("best 2 of error", [22, 23]),
        ("worst 2 of late", [22, 23]),
        ("best 99 of late", [n for n in range(25) if n % 4 and n % 7 != 3]),
    ],
)
def test_members_are_chosen_by_the_columns_of_all_parts(tmp_path, keep, expected):
    """Three parts, the last one in the journal; a member without a value is none of the worst."""
    kept = read_keep(keep if isinstance(keep, str) else tuple(keep))
    with StudyDataset.open_or_create(tmp_path, identity(30)) as dataset:
        add(dataset, range(25))
        assert chosen_members(kept, dataset).tolist() == list(expected)


def test_the_folder_has_the_logs_of_the_members_that_are_kept_now(run, tmp_path):
    """A study that has grown, another choice; logs of somebody else, and without a choice, stay."""
    assert set(run(keep="worst 1 of y")[0].logs) == {2}
    study, notices = run((1.0, 2.0, 3.0, 4.0), keep="worst 1 of y")
    assert set(study.logs) == {3}
    (text,) = notices
    assert text.startswith("removed the logs of member 2, which keep no longer names")
    (tmp_path / "out" / "logs" / "1.mcap").write_bytes(b"mine")
    study, notices = run((1.0, 2.0, 3.0, 4.0), keep=[0])
    assert set(study.logs) == {0, 1}
    assert notices[1].startswith("keep does not name member 1, whose logs are left in place")
    assert set(run((1.0, 2.0, 3.0, 4.0))[0].logs) == {0, 1}


def test_a_log_that_was_cut_short_is_made_again(run):
    study, _ = run(keep=[0, 1])
    whole = [Path(study.logs[n]).read_bytes() for n in (0, 1)]
    Path(study.logs[1]).write_bytes(whole[1][:1000])
    study, notices = run(keep=[0, 1])
    assert notices == [
        "the logs of member 1 were cut short or replaced since this study wrote them: they are "
        "written again"
    ]
    assert len(cosim.open_log(study.logs[1])["u.y"]) == len(cosim.open_log(study.logs[0])["u.y"])
    assert run(keep=[0, 1])[1] == []


def test_a_log_that_differs_from_the_recorded_run_is_never_removed(run):
    """It is the only one of its kind."""
    run(keep=[1])
    with StudyDataset.open(run(keep=[1])[0]._dataset.label) as dataset:
        logs = dataset.log_files()
        logs.note(LogRecord(1, logs.records[1].recording, is_same=False))
        logs.close()
        assert logs.present() == {1}
    study, notices = run(keep=[2])
    assert set(study.logs) == {1, 2}
    assert notices == [
        "keep does not name member 1, whose logs are left in place: another run may give another "
        "result"
    ]


def test_a_study_that_records_less_makes_its_logs_again(run, tmp_path):
    """It is the same study: [record] says nothing of what members come to."""
    study, _ = run(keep=[1])
    assert len(cosim.open_log(study.logs[1])["v.y"]) == 11
    study, notices = run(keep=[1], set={"record.signals": ["u.y"], "record.every": 5})
    assert notices == []
    log = cosim.open_log(study.logs[1])
    assert list(log["u.y"]) == pytest.approx([0.0, 2 * 0.479425538604203, 2 * 0.8414709848078965])
    assert "v.y" not in log.signals


def test_logs_are_kept_where_the_dataset_is(run):
    """Also where that is no folder: each is put whole; members run in processes of their own."""
    study, _ = run(out="memory://kept/x", keep="worst 2 of y")
    assert study.logs == {n: f"memory://kept/x/logs/{n}.mcap" for n in (1, 2)}
    study, notices = run(out="memory://kept/x", keep="worst 1 of y")
    assert set(study.logs) == {2}
    assert len(notices) == 1
    files = fsspec.filesystem("memory")
    assert files.cat_file("/kept/x/logs/2.mcap")[-8:] == b"\x89MCAP0\r\n"
    files.rm("/kept", recursive=True)


@pytest.mark.slow
def test_results_of_members_are_compared_with_those_of_their_logs(tmp_path):
    """Where there are no metrics, a log is known to be made again by them."""
    given = {"vary": {"observer.filter_rate": [100.0, 200.0]}, "set": {"scenario.stop": 0.2}}
    notices = []
    given |= {"out": tmp_path / "out", "workers": 1, "notice": notices.append}
    cosim.study("academic", keep=[0], **given)
    assert notices == []
    cosim.study("academic", keep=[1], **given)
    (text,) = notices
    assert text.startswith("removed the logs of member 0")


class Unreached:
    """A client of a cluster whose workers do not reach a dataset."""

    def run(self, function, *values, on_error):
        """Answer for one that is not there, and one that says no."""
        return {"tcp://a": False, "tcp://b": OSError()}


@pytest.mark.slow
def test_logs_are_made_here_where_no_worker_reaches_the_dataset(run, tmp_path):
    """They never go through the scheduler; it is said."""
    study, _ = run()
    file = RecordedStudy.read(study.text).study.with_options(keep=[1])
    plan = plan_study(file)
    notices = []
    with open_dataset(plan, tmp_path / "out", new=False) as dataset:
        keep_logs(plan, dataset, workers=1, notice=notices.append, client=Unreached())
    assert set(study.logs) == {1}
    assert notices == [
        "logs are written on this machine, as no worker of the cluster reaches "
        f"{tmp_path / 'out'}; with storage that workers reach, such as s3://, they write them"
    ]


@pytest.mark.slow
@pytest.mark.usefixtures("worker_processes")
def test_logs_of_failed_members_are_kept_and_missing_ones_named(tmp_path):
    """One hangs after a few steps, one crashes in the first, one fails there and says so."""
    names = ["LIES", "HANGS_LATER", "CRASH", "FAILS_STEP"]
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
    assert study.failures[1].startswith("hangs: ")
    assert study.failures[2] == "crashes: SIGSEGV"
    assert "fmi2DoStep returned 3 (error)" in study.failures[3]
    assert set(study.logs) == {1, 3}
    log = cosim.open_log(study.logs[1])
    assert log.status == "unfinished"
    assert log.steps >= 1
    assert cosim.open_log(study.logs[3]).status == "failed"
    (text,) = notices
    assert text.startswith("no log of 1 failed member that is kept: 2 (crashes: SIGSEGV before")
    left = sorted(path.name for path in (tmp_path / "out" / "logs").iterdir())
    assert left == ["1.mcap", "3.mcap"]
    made = [(tmp_path / "out" / "logs" / name).stat().st_mtime_ns for name in left]
    cosim.study(scenario, keep="failed", **given)
    assert notices == [text, text]
    assert made == [(tmp_path / "out" / "logs" / name).stat().st_mtime_ns for name in left]
    study = cosim.study(scenario, keep=[0], **given)
    assert set(study.logs) == {0, 1}  # nothing makes the log of a crash or a hang again


def test_a_log_in_which_nothing_can_be_read_is_none(run, tmp_path):
    """What recovery finds of a log is kept, in its place; without a row there is no log."""
    run(keep=[1])
    content = (tmp_path / "out" / "logs" / "1.mcap").read_bytes()
    left = tmp_path / "_1.unfinished.mcap"
    left.write_bytes(content[: len(content) * 2 // 3])
    assert readable_log(left) != left
    assert readable_log(left) is not None
    left.write_bytes(content[:40])
    assert readable_log(left) is None


def test_a_log_that_failed_for_another_reason_is_made_again(run, tmp_path):
    """Such as a full disk; what the member itself fails for stays as it is."""
    study, _ = run()
    plan = plan_study(RecordedStudy.read(study.text).study.with_options(keep="all"))
    recorded = {
        **study.table(members=[0]).to_pylist()[0],
        "status": FAILED,
        "reason": "crashes: SIGSEGV",
    }
    outcome = MemberOutcome(0, FAILED, reason="No space left on device")
    with (
        open_dataset(plan, tmp_path / "out", new=False) as dataset,
        closing(dataset.log_files()) as logs,
    ):
        keeper = LogKeeper(plan, dataset, logs, notice=lambda _: None, progress=None)
        keeper.take(outcome, recorded)
        assert 0 not in logs.records
        keeper.take(replace(outcome, reason="crashes: SIGSEGV"), recorded)
        assert logs.records[0].problem == "crashes: SIGSEGV before a row of its log was written"


def test_keeping_has_a_progress_of_its_own(run):
    """How many logs are there, of how many; those of an earlier call among them."""
    calls = []
    run(keep=[0], keep_progress=lambda *done: calls.append(done))
    run(keep="all", keep_progress=lambda *done: calls.append(done))
    assert calls == [(1, 1, 0), (2, 3, 0), (3, 3, 0)]


def test_the_metric_of_kept_logs_is_a_number(tmp_path):
    """What results say is known when one member has run; the dataset is not begun."""
    with pytest.raises(UsageError, match="keep: 'nothing' is not a numeric metric"):
        cosim.study(
            "academic",
            set={"scenario.stop": 0.1},
            keep="worst 1 of nothing",
            out=tmp_path / "out",
        )
    assert not (tmp_path / "out").exists()
