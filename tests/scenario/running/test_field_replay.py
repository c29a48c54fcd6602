"""Replay of a recording of another tool: its scenario is named beside it."""

from __future__ import annotations

import numpy as np
import pytest

import cosim
from cosim.errors import UsageError, shell_language
from tests.scenario.field_recordings import BOTH, LOOP, PLANT, field_log


@pytest.fixture
def loop(tmp_path):
    path = tmp_path / "loop.toml"
    path.write_text(LOOP, encoding="utf-8")
    return path


def test_mapped_components_are_taken_and_others_computed(loop, tmp_path):
    """As a run with these components swapped, with other parameters of the rest, too."""
    path = field_log(tmp_path)
    changes = {"model.time_constant": 0.1}
    out = tmp_path / "replay.mcap"
    again = cosim.replay(path, scenario=loop, map=BOTH, set=changes, out=out)
    run = cosim.run(cosim.load(loop).swap(plant=path, map=BOTH).set(changes))
    assert list(again) == list(run)
    for signal in run:
        np.testing.assert_array_equal(again[signal], run[signal])
    assert not np.array_equal(again["model.y"], cosim.run(loop)["model.y"])


@pytest.mark.parametrize("port", ["error.u1", "plant.y"])
def test_a_mapped_input_of_another_is_an_output_of_what_drives_it(loop, tmp_path, port):
    """``error.u1`` is driven by ``plant.y``: the plant is recorded."""
    again = cosim.replay(
        field_log(tmp_path), scenario=cosim.load(loop), map={port: "/drive/state.position"}
    )
    run = cosim.run(cosim.load(loop).swap(plant=field_log(tmp_path), map=PLANT))
    np.testing.assert_array_equal(again["plant.y"], run["plant.y"])
    np.testing.assert_array_equal(again["error.y"], run["error.y"])


def test_missing_fields_of_a_foreign_recording_are_reported(loop, tmp_path):
    """A scenario, a map; what only a log of a run has is refused."""
    path = field_log(tmp_path)
    with pytest.raises(UsageError) as refused, shell_language():
        cosim.replay(path, map=PLANT)
    for text in (str(path), "--scenario", "--map plant.y=/topic.field"):
        assert text in str(refused.value)
    with pytest.raises(UsageError, match="'loop'; expected a map"):
        cosim.replay(path, scenario=loop)
    for options, name in (
        ({"allow_code": True}, "allow_code=True"),
        ({"window": (0.0, 1.0)}, "a window of time"),
        ({"components": ["model"]}, "components to compute"),
    ):
        with pytest.raises(UsageError, match=f"{name} does not apply to a recording"):
            cosim.replay(path, scenario=loop, map=PLANT, **options)


def test_a_recording_that_is_replayed_is_not_written_over(loop, tmp_path):
    """Not even with force."""
    path = field_log(tmp_path)
    with pytest.raises(UsageError):
        cosim.replay(path, scenario=loop, map=PLANT, out=path, force=True)
    assert cosim.replay(path, scenario=loop, map=PLANT)["plant.y"].size
