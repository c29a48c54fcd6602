"""Logs of chosen members: those that the study names; nothing is lost."""

import fsspec
import numpy as np
import pytest

import cosim
from cosim.errors import UsageError
from cosim.studies.dataset import StudyDataset
from cosim.studies.kept_logs import chosen_members, different
from cosim.studies.study_file import read_keep
from tests.fmi.compiled import compile_fmu
from tests.fmi.rogues import STATELESS
from tests.studies.outcomes import add, change_part, identity

SINE = """
scenario = { name = "x", stop = 1.0, step = 0.1 }
[components]
u = { kind = "sine", amplitude = 1.0, rate = 1.0 }
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
@pytest.mark.usefixtures("parts_of_ten")
def test_members_are_chosen_by_the_columns_of_all_parts(tmp_path, keep, expected):
    """Three parts, the last one in the journal; a member without a value is none of the worst."""
    kept = read_keep(keep if isinstance(keep, str) else tuple(keep))
    with StudyDataset.open_or_create(tmp_path, identity(30)) as dataset:
        add(dataset, range(25))
        assert chosen_members(kept, dataset).tolist() == list(expected)


def test_the_folder_has_the_logs_that_were_kept(run):
    """Those that another choice or a larger study names are added; a log has the row's metrics."""
    calls = []
    study, notices = run(keep="worst 1 of y", keep_progress=lambda *done: calls.append(done))
    assert (set(study.logs), notices, calls) == ({2}, [], [(1, 1, 0)])
    log = cosim.open_log(study.logs[2])
    assert cosim.metrics(log, {"y": "max(u.y)"})["y"] == study.to_pandas()["y"][2]
    before = log.path.stat().st_mtime_ns
    study, _ = run((1.0, 2.0, 3.0, 4.0), keep="worst 2 of y")
    assert set(study.logs) == {2, 3}
    assert log.path.stat().st_mtime_ns == before
    assert set(run((1.0, 2.0, 3.0, 4.0), keep=[0])[0].logs) == {0, 2, 3}
    assert set(run((1.0, 2.0, 3.0, 4.0))[0].logs) == {0, 2, 3}


def test_a_log_whose_run_is_another_one_is_noticed(run, tmp_path):
    """By the first metric that has another bit."""
    run()

    def change(table):
        values = table["y"].to_pylist()
        values[1] = float(np.nextafter(values[1], 9.0))
        return table.set_column(table.schema.get_field_index("y"), table.field("y"), [values])

    change_part(tmp_path / "out", change)
    study, (notice,) = run(keep=[0, 1])
    assert set(study.logs) == {0, 1}
    assert "member 1 was rerun for its log: y = 1.68" in notice


def test_hangs_of_other_limits_are_the_same_and_zeros_of_other_signs_are_not(tmp_path):
    """Bit for bit, but for how long a member was waited for."""
    with StudyDataset.open_or_create(tmp_path, identity(1)) as dataset:
        row = dict.fromkeys(("error", "late", "other_results"))
        row |= {"status": "failed", "reason": "hangs: did not end within 2 s", "steps": 3}
        again = {**row, "reason": "hangs: did not end within 60 s"}
        assert different(row, again, dataset) == []
        now = {**row, "error": 0.0}
        assert different({**row, "error": -0.0}, now, dataset) == [("error", -0.0, 0.0)]
        assert different({**row, "error": 0}, now, dataset) == [("error", 0, 0.0)]


def test_logs_are_kept_where_the_dataset_is(run):
    """Also where that is no folder: each is put whole."""
    study, _ = run(out="memory://kept/x", keep="worst 2 of y")
    assert study.logs == {n: f"memory://kept/x/logs/{n}.mcap" for n in (1, 2)}
    files = fsspec.filesystem("memory")
    assert files.cat_file("/kept/x/logs/2.mcap")[-8:] == b"\x89MCAP0\r\n"
    files.rm("/kept", recursive=True)


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
        "keep": "failed",
    }
    study = cosim.study(scenario, **given)
    assert study.failures[1].startswith("hangs: ")
    assert study.failures[2] == "crashes: SIGSEGV"
    assert "fmi2DoStep returned 3 (error)" in study.failures[3]
    assert set(study.logs) == {1, 3}
    log = cosim.open_log(study.logs[1])
    assert (log.status, log.steps >= 1) == ("unfinished", True)
    assert cosim.open_log(study.logs[3]).status == "failed"
    assert notices == [
        f"no log of failed members: 2 ({study.failures[2]}, before a row of its log was written)"
    ]
    left = sorted((tmp_path / "out" / "logs").iterdir())
    assert [path.name for path in left] == ["1.mcap", "2.txt", "3.mcap"]
    made = [path.stat().st_mtime_ns for path in left]
    cosim.study(scenario, **given)
    assert made == [path.stat().st_mtime_ns for path in left]


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
