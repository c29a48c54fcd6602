"""A member has what a run of its own has, in whatever order members are run in one process."""

import hashlib
import os
import shutil
import tempfile
from contextlib import closing
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import cosim
from cosim.core.recorders import Nothing, end_of_run
from cosim.digests import sha256_of
from cosim.errors import ChangedFileError, CosimError, Interrupted, ScenarioError, UsageError
from cosim.report.summary import summarize
from cosim.report.sweep import results_of
from cosim.scenario.swapping.swap_comparison import compare_swaps
from cosim.studies import members as module
from cosim.studies.contracts import COMPLETE, FAILED, StudyMember, StudySubject
from cosim.studies.members import OpenedSubject, inspect_member, run_member
from tests.fmi.compiled import kept_folder
from tests.fmi.small import able, compiled
from tests.scenario.user_modules import RELAY, THERMOSTAT

PID = """
scenario = {{ name = "pid", stop = 0.5, step = 1e-2 }}
actions = [
  {{ at = 0.1, signal = "pid.measurement", offset = 0.2 }},
  {{ at = 0.2, signal = "plant.u", noise = 0.1, seed = 3 }},
]
[components]
setpoint = {{ kind = "constant", value = 1.0 }}
pid = {{ kind = "pid", gain = 2.0, integral_time = 1.0, lower = -3.0, upper = 3.0 }}
plant = {{ kind = "lag", time_constant = 0.5, initial = 0.25 }}
fmu = {{ kind = "fmu", path = "{fmu}", start = {{ A = -1.0, B = 1.0, C = 1.0, x = 0.5 }} }}
count = {{ kind = "python", class = "counting:Counting", gain = 2.0 }}
[connections]
"pid.setpoint" = "setpoint.y"
"pid.measurement" = "plant.y"
"plant.u" = "pid.y"
"fmu.u" = "plant.y"
"count.u" = "fmu.y"
"""
COUNTING = '''
import numpy as np
from cosim.core import Interface, Signal


class Counting:
    """y = gain u + steps / 1000; it does not forget its steps where it is initialized again."""

    interface = Interface(inputs=(Signal("u"),), outputs=(Signal("y", variability="discrete"),))

    def __init__(self, gain: float):
        if gain < 0.0:
            raise ValueError("a negative gain")
        self.gain = gain
        self.steps = 0

    def initialize(self, t, u):
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([self.steps / 1000.0])

    def advance(self, t, h, u):
        steps = np.arange(1, len(t))
        values = self.gain * u[1:] + (self.steps + steps[:, np.newaxis]) / 1000.0
        self.steps += len(steps)
        return values
'''
EDITS = {
    "as it is": {},
    "start": {"fmu.start.x": 2.0},
    "parameter": {"fmu.start.A": -3.0},
    "user's parameter": {"count.gain": 1.5},
    "user's error": {"count.gain": -1.0},
    "not finite": {"fmu.start.x": 1.7e308, "count.gain": 1e3},
    "stop": {"scenario.stop": 0.25},
    "until": {"scenario.until": "plant.y > 0.5"},
    "model": {"fmu.interface_type": "me"},
    "action": {"actions[1].seed": 4},
    "kind": {"plant.time_constant": -1.0},
    "no such component": {"plent.x": 1.0},
}
METRICS = {"last": "last(count.y)", "crossing": "first(t, plant.y > 1e3)", "rms": "rms(pid.y)"}


class Digest(Nothing):
    """Keeps the hash of all rows: what is equal in it is equal bit for bit."""

    def __init__(self):
        super().__init__()
        self.hash = hashlib.sha256()
        self.steps = 0
        self.reason = ""

    def begin(self, plan):
        self.hash.update(repr(plan.layout).encode())

    def write(self, block, signals):
        first = min(self.steps, 1)
        self.steps = block.index + block.steps
        self.hash.update(block.time_ns[first:].tobytes() + signals[first:].tobytes())

    def event(self, event):
        self.hash.update(repr(event).encode())

    def __exit__(self, error_type, error, trace):
        self.reason = end_of_run(error).reason


@cache
def scenario():
    """Return the path of one with an FMU that can be instantiated once, and a class of a user."""
    folder = kept_folder()
    (folder / "counting.py").write_text(COUNTING)
    fmu = able(compiled(folder, "COUNTS"), folder / "once.fmu", "once", "state", "slopes", D=0.0)
    (folder / "pid.toml").write_text(PID.format(fmu=fmu.name))
    return str(folder / "pid.toml")


@cache
def binary():
    return compiled(kept_folder())


@cache
def alone(name):
    """Return what a member comes to in a run of its own."""
    digest = Digest()
    try:
        cosim.run(scenario(), set=EDITS[name], recorder=digest)
    except CosimError as error:
        return FAILED, str(error), digest.steps, digest.hash.digest()
    return COMPLETE, digest.reason, digest.steps, digest.hash.digest()


@settings(max_examples=5, deadline=None, suppress_health_check=list(HealthCheck))
@given(names=st.permutations([*EDITS] * 2))
def test_a_member_has_the_bits_of_its_own_run_in_any_order(names):
    """Also behind those that fail; nothing of a member is left for the next."""
    with closing(OpenedSubject(StudySubject(scenario()))) as opened:
        for name in names[:12]:
            digest = Digest()
            found = opened.run(StudyMember(7, EDITS[name]), sink=digest)
            result = found.status, found.reason, found.steps, digest.hash.digest()
            assert result == alone(name), name


def test_metrics_and_edits_are_those_of_a_run():
    """The edits of all members come first, also wrong ones; a metric may have no value."""
    common = {"count.gain": 3.0, "pid.gain": -1.0, **EDITS["kind"]}
    subject = StudySubject(scenario(), set=common, metrics=METRICS)
    assert run_member(subject, StudyMember(0)).status == FAILED
    for number, gain in enumerate((2.0, 2.5)):
        own = {"pid.gain": gain, "plant.time_constant": 0.5}
        outcome = run_member(subject, StudyMember(number, own))
        run = cosim.run(scenario(), set={"count.gain": 3.0, **own})
        assert (outcome.number, outcome.status, outcome.steps) == (number, COMPLETE, 50)
        assert outcome.metrics["last"] == run["count.y"][-1]
        assert outcome.metrics["crossing"] is None
        assert outcome.worker.endswith(f":{os.getpid()}")
        assert outcome.wall_time > 0.0


@pytest.mark.parametrize("name", ["kind", "user's error", "not finite"])
def test_a_member_that_fails_says_what_its_run_says(name):
    """It has no metrics, whichever the member before it had."""
    subject = StudySubject(scenario(), metrics=METRICS)
    assert run_member(subject, StudyMember(0)).status == COMPLETE
    outcome = run_member(subject, StudyMember(1, EDITS[name]))
    assert (outcome.status, outcome.reason, outcome.steps) == alone(name)[:3]
    assert outcome.metrics == dict.fromkeys(METRICS)


def test_what_cannot_be_opened_is_refused():
    """A metric that is none, and a scenario that is none; no signal is the member's failure."""
    with pytest.raises(UsageError, match="x: "):
        run_member(StudySubject(scenario(), metrics={"x": "plant.y"}), StudyMember(0))
    with pytest.raises(ScenarioError, match="acadmic"):
        run_member(StudySubject("acadmic"), StudyMember(0))
    outcome = run_member(StudySubject(scenario(), metrics={"x": "last(plant.z)"}), StudyMember(0))
    assert outcome.status == FAILED
    assert "plant.z" in outcome.reason


def test_an_interruption_is_no_outcome(monkeypatch):
    """It ends the study, not the member alone."""

    def interrupted(*_):
        raise Interrupted("interrupted by the user")

    monkeypatch.setattr(module, "run_rows", interrupted)
    with pytest.raises(Interrupted):
        run_member(StudySubject(scenario()), StudyMember(0))


def test_the_log_of_a_member_is_that_of_its_run(tmp_path):
    """Its metrics are those without a log; it replaces one that is there."""
    subject = StudySubject(scenario(), metrics=METRICS)
    out = tmp_path / "member.mcap"
    for name in ("start", "parameter"):
        member = StudyMember(0, EDITS[name])
        logged = run_member(subject, member, out)
        cosim.run(scenario(), set=EDITS[name], out=tmp_path / "run.mcap", force=True)
        run = cosim.open_log(tmp_path / "run.mcap")
        assert cosim.open_log(out).content_hash() == run.content_hash()
        assert logged.metrics == run_member(subject, member).metrics
    failed = run_member(subject, StudyMember(0, EDITS["not finite"]), out)
    assert (failed.status, cosim.open_log(out).status) == (FAILED, "failed")


@pytest.mark.slow
def test_results_of_a_run_are_kept_beside_its_metrics():
    """With the names and values that a sweep has."""
    changes = {"scenario.stop": 1.0, "plant.x_a0": [0.5, -1.0]}
    subject = StudySubject("academic", metrics={"y": "last(plant.y)"}, with_results=True)
    outcome = run_member(subject, StudyMember(0, changes))
    run = cosim.run("academic", set=changes)
    assert outcome.metrics == {**results_of(summarize(run)), "y": run["plant.y"][-1]}
    assert "observer.delta rms error" in outcome.metrics


def test_members_replay_recordings_and_swap(tmp_path, monkeypatch):
    """With the bits of a replay alone."""
    monkeypatch.syspath_prepend(Path(scenario()).parent)
    logs = []
    for number in range(2):
        logs.append(str(tmp_path / f"{number}.mcap"))
        cosim.run(scenario(), set={"setpoint.value": 1.0 + number}, out=logs[-1])
    fmu = able(binary(), tmp_path / "b.fmu", A=-2.0, B=1.0, C=1.0, D=0.0, x=0.5)
    subject = StudySubject(scenario(), metrics=METRICS, allow_code=True)
    for number in range(4):
        swap = {"fmu": str(fmu)} if number > 1 else {}
        changes = {"count.gain": 3.0 + number, **({"fmu.start": {"A": -1.0}} if swap else {})}
        member = StudyMember(number, changes, swap, logs[number % 2])
        given = {"set": member.set, "swap": swap, "allow_code": True}
        out = tmp_path / "out.mcap"
        outcome = run_member(subject, member, out)
        cosim.replay(member.recording, out=tmp_path / "replay.mcap", force=True, **given)
        log = cosim.open_log(tmp_path / "replay.mcap")
        assert (outcome.reason, outcome.metrics["last"]) == ("", log["count.y"][-1])
        assert cosim.open_log(out).content_hash() == log.content_hash()
    missing = run_member(subject, StudyMember(0, recording=str(tmp_path / "x.mcap")))
    assert "x.mcap" in missing.reason
    refused = run_member(replace(subject, allow_code=False), replace(member, swap={}))
    assert "allow_code" in refused.reason


def test_warnings_are_those_of_each_member():
    """Whatever a member before it warned of."""
    edits = {
        "scenario.input_interpolation": "zero-order",
        "scenario.stop": 0.05,
        "observer.filter": "first-order",
    }
    subject = StudySubject("academic", set=edits, metrics={"e": "rms(plant.y)"})
    for rate, count in ((900.0, 2), (10.0, 0)):
        member = StudyMember(0, {"observer.filter_rate": rate})
        run = cosim.run("academic", set={**edits, **member.set})
        texts = sorted(f"{warning.source}: {warning.text}" for warning in run.warnings)
        assert len(texts) == count
        assert run_member(subject, member).warnings == texts


def test_nothing_stays_of_members_but_one_unpacked_fmu(tmp_path, monkeypatch):
    """Nor of those that fail; when the subject is closed it is gone, too."""
    scenario()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    module.close()
    for number, name in enumerate(("start", "user's error", "not finite", "stop")):
        outcome = run_member(StudySubject(scenario()), StudyMember(number, EDITS[name]))
        assert str(tmp_path) not in outcome.reason
    assert len(os.listdir(tmp_path)) == 1
    module.close()
    assert os.listdir(tmp_path) == []


def test_the_sources_of_a_member_are_found(study):
    """Files by path, the code of a user's class by its name; or why it cannot be built."""
    subject, folder = study
    found = inspect_member(subject, StudyMember(0, swap={"plant": str(folder / "b.fmu")}))
    assert found.refused == ""
    assert found.files == {path: sha256_of(path) for path in found.files}
    assert {str(folder / "b.fmu"), str(folder / "u.csv")} <= found.files.keys()
    own = inspect_member(StudySubject(scenario()), StudyMember(0))
    assert [path.rpartition("/")[2] for path in own.modules] == ["counting.py"]
    assert [*own.codes] == ["code of counting:Counting"]
    wrong = inspect_member(StudySubject(scenario()), StudyMember(0, EDITS["kind"]))
    assert "time_constant" in wrong.refused
    unknown = StudySubject(scenario(), metrics={"x": "last(plant.z)"})
    assert "plant.z" in inspect_member(unknown, StudyMember(0)).refused


# --- files that change ---

TABLE = """
scenario = { name = "x", stop = 0.1, step = 0.01 }
[components]
u = { kind = "table", file = "u.csv" }
plant = { kind = "fmu", path = "a.fmu" }
[connections]
"plant.u" = "u.y"
"""


@pytest.fixture
def study(tmp_path):
    """Return what members of a scenario with a table and FMUs have in common, and its folder."""
    module.close()
    (tmp_path / "x.toml").write_text(TABLE)
    (tmp_path / "u.csv").write_text("t,y\n0,1\n1,1\n")
    for name, x in (("a", 1.0), ("b", 2.0), ("c", 3.0)):
        able(binary(), tmp_path / f"{name}.fmu", A=-1.0, B=1.0, C=1.0, D=0.0, x=x)
    digests = {str(path): sha256_of(path) for path in tmp_path.iterdir()}
    subject = StudySubject(
        str(tmp_path / "x.toml"),
        {"plant.start": {"A": -1.0}},
        metrics={"y": "last(plant.y)"},
        digests=digests,
    )
    return subject, tmp_path


def test_a_swap_is_compared_once_and_without_what_is_varied_beside_it(study, monkeypatch):
    """What members vary is meant to differ: it is no warning of each of them."""
    subject, folder = study
    compared = []

    def compare(scenario, fmus):
        compared.append(scenario.tree["components"]["plant"])
        return compare_swaps(scenario, fmus)

    monkeypatch.setattr("cosim.scenario.swapping.swap_comparison.compare_swaps", compare)
    for number in range(6):
        swap = {"plant": str(folder / f"{'bc'[number % 2]}.fmu")}
        outcome = run_member(subject, StudyMember(number, {"plant.start.A": -2.0 - number}, swap))
        assert outcome.status == COMPLETE
    assert [table["start"]["A"] for table in compared] == [-1.0, -1.0]


@pytest.mark.parametrize("name", ["x.toml", "u.csv", "a.fmu"])
@pytest.mark.parametrize("content", [b"\n", None], ids=["that can be read", "that cannot"])
def test_a_process_that_starts_later_refuses_changed_files(name, content, study):
    """Also where nothing can be built of what is there now."""
    subject, folder = study
    path = folder / name
    path.write_bytes(b"\0" if content is None else path.read_bytes() + content)
    with pytest.raises(ChangedFileError, match=rf"{name} has changed .*\n?.*new=True"):
        run_member(subject, StudyMember(0))


def test_a_file_that_changes_between_members_is_found(study):
    """Also where the process knows it already; not the files of others."""
    subject, folder = study
    members = [StudyMember(n, swap={"plant": str(folder / f"{n}.fmu")}) for n in "bcb"]
    assert run_member(subject, members[0]).reason == ""
    (folder / "b.fmu").unlink()
    shutil.copy(folder / "a.fmu", folder / "b.fmu")
    assert run_member(subject, members[1]).status == COMPLETE
    with pytest.raises(ChangedFileError, match=r"b\.fmu"):
        run_member(subject, members[2])
    (folder / "b.fmu").unlink()
    with pytest.raises(ChangedFileError, match=r"b\.fmu .*cannot be read"):
        run_member(subject, members[2])


def test_a_file_that_changes_during_a_member_discards_its_outcome(study, monkeypatch):
    """Nobody knows which of the two contents it read; the same content is the same file."""
    subject, folder = study
    os.utime(folder / "u.csv", ns=(1, 1))
    shutil.copy(folder / "a.fmu", folder / "copy")
    (folder / "copy").replace(folder / "a.fmu")
    assert run_member(subject, StudyMember(0)).status == COMPLETE
    run_rows = module.run_rows

    def changing(*arguments):
        run_rows(*arguments)
        (folder / "u.csv").write_text("t,y\n0,2\n1,2\n")

    monkeypatch.setattr(module, "run_rows", changing)
    with pytest.raises(ChangedFileError, match=r"u\.csv"):
        run_member(subject, StudyMember(0))


def test_the_class_of_a_user_is_checked(tmp_path):
    """It is imported again where it has changed, so that later members had another class."""
    (tmp_path / "x.toml").write_text(THERMOSTAT)
    (tmp_path / "relay.py").write_text(RELAY)
    path = str(tmp_path / "x.toml")
    subject = StudySubject(path, {"scenario.stop": 1.0}, digests={path: sha256_of(path)})
    assert run_member(subject, StudyMember(0)).status == COMPLETE
    codes = inspect_member(subject, StudyMember(0)).codes
    (tmp_path / "relay.py").write_text(RELAY + "\n")
    with pytest.raises(ChangedFileError, match=r"relay"):
        run_member(subject, StudyMember(1))
    other = replace(subject, digests={**subject.digests, **codes})
    with pytest.raises(ChangedFileError, match="the code of relay:Relay has changed"):
        run_member(other, StudyMember(0))


def test_a_recording_is_checked_with_the_files_before_it(tmp_path):
    """Also where it cannot be read any more; logs of other members are left alone."""
    log = tmp_path / "run.mcap"
    cosim.run("academic", out=log, set={"scenario.stop": 0.2})
    other = str(tmp_path / "other.mcap")
    subject = StudySubject("academic", metrics={"y": "last(plant.y)"}, digests={str(log): ""})
    member = StudyMember(0, recording=str(log))
    with pytest.raises(ChangedFileError, match=r"run\.mcap"):
        run_member(subject, member)
    part = str(tmp_path / "run.part2.mcap")
    subject = replace(subject, digests={str(log): sha256_of(log), part: "", other: ""})
    assert run_member(subject, member).status == COMPLETE
    assert run_member(subject, replace(member, set={"no.such": 1.0})).status == FAILED
    log.write_bytes(b"")
    for recording in (part, str(log)):
        with pytest.raises(ChangedFileError, match=r"run\.(part2\.)?mcap"):
            run_member(subject, StudyMember(0, recording=recording))
