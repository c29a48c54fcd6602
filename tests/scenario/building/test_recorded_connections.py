"""A replay takes as it is what its run took so: an earlier version knew fewer units."""

import json

import pytest

import cosim
from cosim.errors import LogError
from cosim.report.verification import verify
from tests.log.crafting import put_together, take_apart

SCENARIO = """
scenario = { name = "units", stop = 0.5, step = 0.1 }
[components]
a = { kind = "sine", rate = 1.0, unit = "psi" }
b = { kind = "gain", K = 1.0, unit = { u = "Pa" } }
[connections]
"b.u" = "a.y"
"""
PSI = 6894.757293168362  # Pa


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "units.toml"
    path.write_text(SCENARIO)
    return cosim.run(path, out=tmp_path / "a.mcap")


def of_old(log, connection=None):
    """Return the log of a version that does not know psi, with its rows and what it recorded."""
    content = take_apart(log.path)
    recorded = dict(content.metadata)["cosim.connections"]
    values = json.loads(recorded["b.u"])
    del values["conversions"]
    recorded["b.u"] = json.dumps(values) if connection is None else connection
    return cosim.open_log(put_together(content, log.path.with_name("old.mcap")))


def test_a_replay_converts_as_its_run_did(log):
    assert log["b.u"] == pytest.approx(PSI * log["a.y"])
    assert verify(log, cosim.replay(log)).passed
    old = of_old(log)
    again = cosim.replay(old)
    assert again["b.u"].tolist() == again["b.y"].tolist() == log["a.y"].tolist()
    assert not verify(old, again).passed  # its rows are not those of a version that copied


def test_a_recorded_connection_that_is_no_table_is_refused(log):
    with pytest.raises(LogError, match=r"recorded connection to 'b\.u': expected a table"):
        cosim.replay(of_old(log, connection="[]"))
