"""Members that run again alone: a bit that differs is found, and what has changed is named."""

import platform
import shutil

import numpy as np
import pyarrow as pa
import pytest

import cosim
from cosim.cli import main
from cosim.errors import DatasetError, UsageError
from cosim.studies import verifying
from cosim.studies.plan import own_environment
from cosim.studies.show import print_verification
from cosim.studies.verifying import verify_study
from tests.fmi.compiled import compile_fmu
from tests.fmi.rogues import STATELESS
from tests.studies.outcomes import change_part


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return a folder with a study, ``out``, of two plants, the second of which fails."""
    folder = tmp_path_factory.mktemp("verified")
    for name in ("LIES", "FAILS_STEP", "OTHER_START"):
        compile_fmu(folder / f"{name}.fmu", STATELESS, "rogue2.c", defines=(f"ROGUE={name}",))
    scenario = folder / "x.toml"
    scenario.write_text(
        'scenario = { name = "x", stop = 0.1, step = 0.01 }\n'
        '[components]\nplant = { kind = "fmu", path = "LIES.fmu" }\n'
    )
    cosim.study(
        scenario,
        vary={"plant.path": [str(folder / "LIES.fmu"), str(folder / "FAILS_STEP.fmu")]},
        metrics={"y": "last(plant.y)", "early": "first(t, plant.y > 99)"},
        out=folder / "out",
    )
    return folder


def change_one_bit(place):
    """Change the last bit of the metric ``y`` of member 0."""
    values = []

    def change(table):
        values.extend(table["y"].to_pylist())
        values[0] = float(np.nextafter(values[0], 2.0))
        column = table.schema.get_field_index("y")
        return table.set_column(column, table.field("y"), pa.array(values))

    change_part(place, change)
    return values[0]


def test_members_come_to_what_is_recorded(recorded):
    """One that fails and a metric without a value, too; what is not shown is said."""
    found = verify_study(recorded / "out", workers=2)
    assert found.members == (0, 1)
    assert found.differences == ()
    assert found.values == ("status", "steps", "y", "early")
    assert (found.elsewhere, found.environment) == ((), {})


def test_another_machine_and_other_versions_are_said(recorded, monkeypatch, capsys):
    """What is the same there may differ for their sake, and says more."""
    there = {**own_environment(), "numpy": "0.0"}
    monkeypatch.setattr(verifying, "own_environment", lambda: there)
    node = platform.node()
    monkeypatch.setattr(verifying.platform, "node", lambda: "elsewhere")
    print_verification(verify_study(recorded / "out", members=[1]))
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == (
        f"not verified: 1 member not rerun; results on the original machine ({node}): libraries of "
        f"this one may round differently; signals without a metric; numpy was {np.__version__}, "
        "is 0.0"
    )


def test_a_bit_that_differs_is_found(recorded, tmp_path, capsys):
    """Its value then and now, and the exit code, say so."""
    shutil.copytree(recorded / "out", tmp_path / "out")
    was = change_one_bit(tmp_path / "out")
    now = cosim.open_study(recorded / "out").table(["y"]).to_pylist()[0]["y"]
    with pytest.raises(SystemExit) as ended:
        main(["study", "verify", str(tmp_path / "out"), "--member", "0"])
    assert ended.value.code == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[1:] == [
        f"member 0: y was {was!r}, is {now!r}",
        "1 of 1 member differs from the record",
        "not verified: 1 member not rerun; results on other machines; signals without a metric",
    ]


def test_a_dataset_whose_fmu_has_changed_is_refused(recorded):
    """By its SHA-256, though it computes no metric otherwise."""
    plant = recorded / "LIES.fmu"
    before = plant.read_bytes()
    shutil.copy(recorded / "OTHER_START.fmu", plant)
    try:
        with pytest.raises(DatasetError, match=r"out: FMU LIES.fmu changed \(by SHA-256\)"):
            verify_study(recorded / "out")
    finally:
        plant.write_bytes(before)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"members": [2]}, "member: no outcome of member 2; available: 2 of 2 members"),
        ({"sample": 0}, "sample: .*got 0"),
    ],
)
def test_members_that_cannot_run_again_are_refused(recorded, given, text):
    """Before anything runs."""
    with pytest.raises(UsageError, match=text):
        verify_study(recorded / "out", **given)


@pytest.mark.slow
def test_replays_and_their_results_are_verified(tmp_path):
    """Designs of the study and what it keeps built have no part in it."""
    log = cosim.run("academic", out=tmp_path / "a.mcap", set={"scenario.stop": 0.5})
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
    assert found.members == (0, 2)
    assert len(found.values) > 3
    assert found.differences == ()
