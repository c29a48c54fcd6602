"""The arguments of public functions."""

import pytest

import cosim
from cosim.errors import UsageError


def test_a_profile_is_filled_and_so_has_to_be_a_dict(tmp_path):
    """Of a run and of a replay."""
    log = cosim.run("closed-loop", set={"scenario.stop": 0.1}, out=tmp_path / "a.mcap")
    for again in (cosim.run, cosim.replay):
        with pytest.raises(UsageError, match=r"profile: expected a dict .*\[\]"):
            again(log.path if again is cosim.replay else "closed-loop", profile=[])
