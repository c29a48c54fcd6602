"""Trials run on a cluster where the method tries many at a time."""

import pytest

import cosim
from cosim.errors import UsageError
from cosim.studies.cluster import connection
from tests.studies.tuning.lags import LAG, rows_of

pytestmark = pytest.mark.slow


@pytest.fixture
def lag(tmp_path):
    path = tmp_path / "lag.toml"
    path.write_text(LAG)
    return path


def tuned(lag, **options):
    """Tune the lag by generations of ten."""
    given = {"minimize": "abs(last(plant.y) - 0.5)", "method": "global", "members": 31}
    vary = {"plant.time_constant": {"log": [0.1, 10.0]}}
    return cosim.tune(lag, vary=vary, **{**given, **options})


def test_a_tuning_on_a_cluster_is_that_on_one_machine(two_workers, lag, tmp_path):
    """Row for row; one that began here goes on there."""
    here = tuned(lag, out=tmp_path / "here", workers=1)
    tuned(lag, out=tmp_path / "there", workers=1, members=15)
    address = two_workers.address
    there = tuned(lag, out=tmp_path / "there", workers=1, scheduler=address)
    kept = tuned(lag, workers=1, scheduler=address)
    assert there.to_dict() == here.to_dict()
    assert kept.to_dict() == here.to_dict()
    assert rows_of(tmp_path / "there") == rows_of(tmp_path / "here")


@pytest.mark.parametrize("method", ["cobyqa", "nelder-mead"])
def test_a_method_that_tries_one_after_the_other_is_refused(lag, tmp_path, method):
    message = f"scheduler: the method '{method}' runs one member at a time"
    with pytest.raises(UsageError, match=message):
        tuned(lag, method=method, scheduler="tcp://127.0.0.1:1", out=tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_a_scheduler_that_is_not_there_leaves_the_dataset(lag, tmp_path, monkeypatch):
    monkeypatch.setattr(connection, "CONNECTING", 0.2)
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "study.json").write_text("{}")
    with pytest.raises(UsageError, match="cannot connect to a dask scheduler at 'tcp:"):
        tuned(lag, scheduler="tcp://127.0.0.1:1", out=tmp_path / "d", new=True)
    assert (tmp_path / "d" / "study.json").exists()
