"""Logs that workers of a cluster make: they go where the dataset is, not through the scheduler."""

import fsspec
import pytest

import cosim
from cosim.studies.running import keeping
from tests.fmi.compiled import compile_fmu
from tests.fmi.rogues import STATELESS

pytestmark = pytest.mark.slow


@pytest.fixture
def study(tmp_path):
    """Return what runs a study of three plants on a cluster, and returns it with its notices."""
    names = ["LIES", "FAILS_STEP", "CRASH"]
    for name in names:
        compile_fmu(tmp_path / f"{name}.fmu", STATELESS, "rogue2.c", defines=(f"ROGUE={name}",))
    scenario = tmp_path / "x.toml"
    scenario.write_text(
        'scenario = { name = "x", stop = 0.1, step = 0.01 }\n'
        '[components]\nplant = { kind = "fmu", path = "LIES.fmu" }\n'
    )

    def run(out, scheduler):
        notices = []
        study = cosim.study(
            scenario,
            vary={"plant.path": [str(tmp_path / f"{name}.fmu") for name in names]},
            metrics={"y": "last(plant.y)"},
            keep="all",
            out=out,
            scheduler=scheduler,
            notice=notices.append,
            workers=1,
        )
        return study, notices

    return run


@pytest.mark.usefixtures("bucket", "worker_processes")
def test_workers_put_logs_where_the_dataset_is(two_workers, study, tmp_path, monkeypatch):
    """In a bucket, and in a folder that is shared; none is made here."""
    monkeypatch.setattr(keeping, "_log_here", None)
    stored, notices = study("s3://studies/kept", two_workers.address)
    shared, others = study(tmp_path / "out", two_workers.address)
    files = fsspec.filesystem("s3")
    assert stored.logs == {n: f"s3://studies/kept/logs/{n}.mcap" for n in (0, 1)}
    for number, place in stored.logs.items():
        copy = tmp_path / f"{number}.mcap"
        files.get_file(place, str(copy))
        log = cosim.open_log(copy)
        assert log.status == ("complete", "failed")[number]
        assert log.content_hash() == cosim.open_log(shared.logs[number]).content_hash()
    assert notices == [
        "no log of 1 failed member that is kept: 2 (crashes: SIGSEGV; its partial log "
        "is lost with its process)"
    ]
    assert others == [
        "no log of 1 failed member that is kept: 2 (crashes: SIGSEGV before a row of its log "
        "was written)"
    ]
    assert len(list((tmp_path / "out" / "logs").iterdir())) == 2
