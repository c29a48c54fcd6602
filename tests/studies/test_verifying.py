"""Members that run again alone: a bit that differs is found, and what has changed is named."""

import platform
import shutil
from dataclasses import replace

import numpy as np
import pytest

import cosim
from cosim.cli import main
from cosim.errors import DatasetError, UsageError
from cosim.studies import verifying
from cosim.studies.contracts import MemberOutcome
from cosim.studies.dataset import StudyDataset
from cosim.studies.plan import own_environment
from cosim.studies.verifying import verify_study
from cosim.version import __version__
from tests.studies.rogue_plants import rogue_plants


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return a folder with a study, ``out``, of two plants, the second of which fails."""
    folder = tmp_path_factory.mktemp("verified")
    scenario, fmus = rogue_plants(folder, "LIES", "FAILS_STEP", "OTHER_START")
    metrics = {"y": "last(plant.y)", "early": "first(t, plant.y > 99)"}
    cosim.study(scenario, vary={"plant.path": fmus[:2]}, metrics=metrics, out=folder / "out")
    return folder


def tampered(recorded, place, number=0, version=__version__, **changes):
    """Write the dataset again with another row of a member."""
    study = cosim.open_study(recorded / "out")
    identity = StudyDataset.open(recorded / "out").identity
    with StudyDataset.open_or_create(place, replace(identity, version=version)) as dataset:
        for row, member in zip(study.table().to_pylist(), study.members(range(2)), strict=True):
            new = row | (changes if member.number == number else {})
            metrics = {name: new[name] for name in study.metrics}
            given = (new["status"], new["reason"] or "", new["steps"], metrics, 0.1, new["worker"])
            dataset.add(member, MemberOutcome(member.number, *given))
    return place


def verify(capsys, code, *arguments):
    """Return the lines that ``cosim study verify`` prints."""
    with pytest.raises(SystemExit) as ended:
        main(["study", "verify", *map(str, arguments)])
    assert ended.value.code == code
    return capsys.readouterr().out.splitlines()


def test_members_come_to_what_is_recorded(recorded, capsys):
    """One that fails and a metric without a value, too; what is not shown is said."""
    calls = []
    found = verify_study(recorded / "out", workers=2, progress=lambda *n: calls.append(n))
    assert (found.members, found.done, found.differences) == ((0, 1), 2, ())
    assert (found.elsewhere, found.environment, found.is_searched) == ((), {}, False)
    assert calls == [(1, 2, 0), (2, 2, 0)]
    lines = verify(capsys, 0, recorded / "out")
    assert any("identical bit for bit: status, steps, y, early" in line for line in lines)


@pytest.mark.parametrize(
    ("number", "name", "value"),
    [(0, "y", None), (0, "early", 0.0), (0, "steps", 9), (1, "reason", "other"), (1, "y", 0.0)],
)
def test_what_differs_is_found(recorded, tmp_path, capsys, number, name, value):
    """Its value then and now, and the exit code, say so; others are not run."""
    now = cosim.open_study(recorded / "out").table([name]).to_pylist()[number][name]
    was = float(np.nextafter(now, 2.0)) if value is None else value
    place = tampered(recorded, tmp_path / "out", number, **{name: was})
    lines = verify(capsys, 1, place, "--member", number)
    assert f"member {number}: {name} was {was!r}, is {now!r}" in lines
    assert "1 of 1 member differs from the record" in lines
    if name == "y":
        (found,) = verify_study(place).differences
        assert (found.member, found.name, found.recorded, found.now) == (number, "y", was, now)


def test_another_machine_and_other_versions_are_said(recorded, monkeypatch):
    """What is the same there may differ for their sake."""
    monkeypatch.setattr(verifying, "own_environment", lambda: own_environment() | {"numpy": "0"})
    node = platform.node()
    monkeypatch.setattr(verifying.platform, "node", lambda: "elsewhere")
    found = verify_study(recorded / "out", members=[1])
    assert (found.members, found.elsewhere) == ((1,), (node,))
    assert found.environment == {"numpy": (np.__version__, "0")}


def test_what_members_are_made_of_must_be_as_it_was(recorded, tmp_path):
    """By its SHA-256, also while they run, where one differs; by the version of cosim."""
    plant, other = recorded / "LIES.fmu", recorded / "OTHER_START.fmu"
    before = plant.read_bytes()
    differs = tampered(recorded, tmp_path / "x", y=0.0)
    try:
        with pytest.raises(DatasetError, match=r"x: FMU LIES.fmu changed \(by SHA-256\)"):
            verify_study(differs, progress=lambda *_: shutil.copy(other, plant))
        with pytest.raises(DatasetError, match=r"out: FMU LIES.fmu changed \(by SHA-256\)"):
            verify_study(recorded / "out")
    finally:
        plant.write_bytes(before)
    with pytest.raises(DatasetError, match="the version of cosim was 9, is"):
        verify_study(tampered(recorded, tmp_path / "y", version="9"))


def test_members_that_cannot_run_again_are_refused(recorded, tmp_path):
    """Before anything runs."""
    with pytest.raises(UsageError, match="no outcome of member 2; available: 2 of 2 members"):
        verify_study(recorded / "out", members=[2])
    with pytest.raises(UsageError, match=r"sample: .*got 0"):
        verify_study(recorded / "out", sample=0)
    identity = StudyDataset.open(recorded / "out").identity
    StudyDataset.open_or_create(tmp_path, identity).close()
    with pytest.raises(UsageError, match="no member has run yet"):
        verify_study(tmp_path)


def test_replays_and_their_results_are_verified(tmp_path):
    """With all of their values; some, spread over all."""
    log = cosim.run("academic", out=tmp_path / "a.mcap", set={"scenario.stop": 0.1})
    cosim.study(
        "academic",
        replay=str(log.path),
        vary={"observer.filter_rate": [100.0, 200.0, 300.0]},
        metrics={"error": "rms(observer.delta - delta.y)"},
        results=True,
        out=tmp_path / "out",
        workers=1,
    )
    found = verify_study(tmp_path / "out", sample=2)
    assert (found.members, found.differences) == ((0, 2), ())
    assert len(found.values) > 3
