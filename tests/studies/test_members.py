"""A member has what a run of its own has, in whatever order members are run in one process."""

import os
import shutil
import tempfile
from contextlib import closing
from dataclasses import replace
from functools import cache
from itertools import cycle
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import cosim
from cosim.digests import sha256_of
from cosim.errors import ChangedFileError, CosimError, Interrupted
from cosim.scenario.recordings.swap_comparison import compare_swaps
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
    """Return what a run of its own comes to, and the hash of its log; None: it cannot begin."""
    out = kept_folder() / "run.mcap"
    reason = ""
    try:
        cosim.run(scenario(), set=EDITS[name], out=out)
    except CosimError as error:
        reason = str(error)
    if not out.exists():
        return FAILED, reason, 0, dict.fromkeys(METRICS), None
    log = cosim.open_log(out)
    values = dict.fromkeys(METRICS) if reason else cosim.metrics(log, METRICS)
    return log.status, reason or log.reason, log.steps, values, log.content_hash()


@settings(max_examples=3, deadline=None, suppress_health_check=list(HealthCheck))
@given(names=st.permutations([*EDITS] * 2))
def test_a_member_has_the_bits_of_its_own_run_in_any_order(names):
    """Also behind those that fail: nothing of a member is left for the next; so has its log."""
    out = kept_folder() / "member.mcap"
    with closing(OpenedSubject(StudySubject(scenario(), metrics=METRICS))) as opened:
        for name, log in zip(names[:12], cycle([None, out]), strict=False):
            found = opened.run(StudyMember(7, EDITS[name]), log)
            *expected, content = alone(name)
            assert [found.status, found.reason, found.steps, found.metrics] == expected, name
            assert None in (log, content) or cosim.open_log(out).content_hash() == content
    assert (found.number, found.worker.partition(":")[2]) == (7, str(os.getpid()))
    assert found.wall_time > 0.0


def test_edits_of_a_member_come_after_those_of_all():
    """Also where those of all are wrong."""
    subject = StudySubject(scenario(), set={"count.gain": 3.0, **EDITS["kind"]}, metrics=METRICS)
    own = {"pid.gain": 2.5, "plant.time_constant": 0.5}
    run = cosim.run(scenario(), set={"count.gain": 3.0, **own})
    assert run_member(subject, StudyMember(0, own)).metrics["last"] == run["count.y"][-1]
    assert run_member(subject, StudyMember(0)).status == FAILED


def test_an_interruption_ends_the_study_and_a_signal_that_is_not_there_the_member(monkeypatch):
    outcome = run_member(StudySubject(scenario(), metrics={"x": "last(plant.z)"}), StudyMember(0))
    assert outcome.status == FAILED
    assert "plant.z" in outcome.reason

    def interrupted(*_):
        raise Interrupted("interrupted by the user")

    monkeypatch.setattr(module, "run_rows", interrupted)
    with pytest.raises(Interrupted):
        run_member(StudySubject(scenario()), StudyMember(0))


def test_members_replay_recordings_and_swap(tmp_path, monkeypatch):
    """With the bits of a replay alone."""
    monkeypatch.syspath_prepend(Path(scenario()).parent)
    logs = [str(tmp_path / f"{number}.mcap") for number in range(2)]
    for number, log in enumerate(logs):
        cosim.run(scenario(), set={"setpoint.value": 1.0 + number}, out=log)
    swap = {"fmu": str(able(binary(), tmp_path / "b.fmu", A=-2.0, B=1.0, C=1.0, D=0.0, x=0.5))}
    subject = StudySubject(scenario(), metrics=METRICS, allow_code=True)
    members = [StudyMember(n, {"count.gain": 3.0 + n}, {}, logs[n]) for n in range(2)]
    swapped = {"count.gain": 6.0, "fmu.start": {"A": -1.0}}
    for member in [*members, StudyMember(2, swapped, swap, logs[0])]:
        out = tmp_path / "out.mcap"
        outcome = run_member(subject, member, out)
        edits = {"set": member.set, "swap": member.swap, "allow_code": True}
        cosim.replay(member.recording, out=tmp_path / "replay.mcap", force=True, **edits)
        log = cosim.open_log(tmp_path / "replay.mcap")
        assert (outcome.reason, outcome.metrics["last"]) == ("", log["count.y"][-1])
        assert cosim.open_log(out).content_hash() == log.content_hash()
    missing = run_member(subject, StudyMember(0, recording=str(tmp_path / "x.mcap")))
    assert "x.mcap" in missing.reason
    assert "allow_code" in run_member(replace(subject, allow_code=False), members[0]).reason


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
    path, given = str(tmp_path / "x.toml"), {"plant.start": {"A": -1.0}}
    return StudySubject(path, given, metrics={"y": "last(plant.y)"}, digests=digests), tmp_path


def swapping(folder, name, **values):
    """Return a member with another plant."""
    return StudyMember(0, values, swap={"plant": str(folder / f"{name}.fmu")})


def test_a_swap_is_compared_once_and_without_what_is_varied_beside_it(study, monkeypatch):
    """What members vary is meant to differ: it is no warning of each of them."""
    subject, folder = study
    compared = []

    def compare(scenario, fmus):
        compared.append(scenario.tree["components"]["plant"]["start"]["A"])
        return compare_swaps(scenario, fmus)

    monkeypatch.setattr("cosim.scenario.recordings.swap_comparison.compare_swaps", compare)
    for number, name in enumerate("bcbc"):
        member = swapping(folder, name, **{"plant.start.A": -2.0 - number})
        assert run_member(subject, member).status == COMPLETE
    assert compared == [-1.0, -1.0]


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
    b, c = swapping(folder, "b"), swapping(folder, "c")
    assert run_member(subject, b).reason == ""
    shutil.copy(folder / "a.fmu", folder / "copy")
    (folder / "copy").replace(folder / "b.fmu")
    assert run_member(subject, c).status == COMPLETE
    with pytest.raises(ChangedFileError, match=r"b\.fmu"):
        run_member(subject, b)
    (folder / "b.fmu").unlink()
    with pytest.raises(ChangedFileError, match=r"b\.fmu .*cannot be read"):
        run_member(subject, b)


def test_a_file_that_changes_during_a_member_discards_its_outcome(study, monkeypatch):
    """Nobody knows which of the two contents it read; the same content is the same file."""
    subject, folder = study
    os.utime(folder / "u.csv", ns=(1, 1))
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
    log, part, other = (tmp_path / f"{name}.mcap" for name in ("run", "run.part2", "other"))
    cosim.run("academic", out=log, set={"scenario.stop": 0.2})
    digests = {str(log): sha256_of(log), str(part): "0", str(other): "0"}
    subject = StudySubject("academic", metrics={"y": "last(plant.y)"}, digests=digests)
    member = StudyMember(0, recording=str(log))
    assert run_member(subject, member).status == COMPLETE
    assert run_member(subject, replace(member, set={"no.such": 1.0})).status == FAILED
    with pytest.raises(ChangedFileError, match=r"run\.mcap"):
        run_member(replace(subject, digests={str(log): ""}), member)
    log.write_bytes(b"")
    for recording in (part, log):
        with pytest.raises(ChangedFileError, match=r"run\.(part2\.)?mcap"):
            run_member(subject, StudyMember(0, recording=str(recording)))
