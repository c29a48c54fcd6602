"""Initial states that the algebraic equations do not allow: made consistent, and said."""

import json

import numpy as np
import pytest

import cosim
from tests.scenario.general_plant import GENERAL, MIXING_Q, PARTITIONED, X0, write

PLAIN = """\
E = [[1, 0, 0], [0, 1, 0], [0, 0, 0]]
A = [[0, 1, 1], [0, -2, 1], [1, 0, 1]]
B = [[1, 0], [0, 2], [0, 1]]
C = [[2, 0, 1]]
disturbances = [0]
"""


def changes(run):
    """Return what a run says of its initial states."""
    return run.results.get("initial_states", {})


def test_an_inconsistent_entry_is_named_before_and_after(call, tmp_path):
    """x_b(0) = -x1 - u = -1 by the algebraic row; x1 and x2 stay as they are given.

    A replay and the command line say the same.
    """
    path = write(tmp_path / "x.toml", PLAIN, "x0 = [1.0, -1.0, 5.0]")
    log = cosim.run(path, out=tmp_path / "x.mcap")
    assert changes(log) == {"plant": [{"entry": "x[2]", "before": 5.0, "after": -1.0}]}
    np.testing.assert_allclose(log["plant.x"][0], [1.0, -1.0, -1.0], rtol=0, atol=1e-15)
    (message,) = [message for message in log.messages() if message.source == "plant"]
    assert message.level == "warning"
    assert message.text.endswith("E x0 is kept, and x[2] = 5 is -1")
    _, out, err = call("replay", "x.mcap", "--out", "again.mcap")
    assert "warning: plant: x0 does not fulfill the algebraic equations" in err
    assert "plant.x[2]\tinitial value -1 instead of 5 (x0)" in out
    _, out, _ = call("replay", "again.mcap", "--json")
    (change,) = json.loads(out)["changed_states"]
    assert change == {"component": "plant", "entry": "x[2]", "before": 5.0, "after": -1.0}


def test_in_mixed_coordinates_E_x0_is_what_is_kept(tmp_path):
    """Any other x0 with the same E x0 is the same run; entries that change are said."""
    E = np.diag([1.0, 1.0, 0.0]) @ MIXING_Q
    kernel = np.linalg.solve(MIXING_Q, [0.0, 0.0, 1.0])
    assert np.abs(E @ kernel).max() < 1e-15
    given = X0 + 2.0 * kernel
    log = cosim.run(write(tmp_path / "x.toml", GENERAL, f"x0 = {given.tolist()}"))
    np.testing.assert_allclose(log["plant.x"][0], X0, rtol=0, atol=1e-14)
    changed = {change["entry"]: change for change in changes(log)["plant"]}
    assert set(changed) == {f"x[{i}]" for i in range(3) if kernel[i] != 0.0}
    for i in range(3):
        assert changed[f"x[{i}]"]["before"] == given[i]


@pytest.mark.parametrize("window", [False, True])
def test_an_estimate_is_made_consistent_too(tmp_path, window):
    """x_b hat(0) = -x1 - u; a window has no x that follows delta yet, here x does not."""
    filter_keys = "filter_rate = 1e3"
    if window:
        filter_keys = 'filter = "savitzky-golay"\nhalf_width = 0.1'
    observer = (
        '"observer.u" = "u.y"\n"observer.y" = "plant.y"\n[components.observer]\n'
        f'kind = "unknown-input-observer"\nmodel = "m"\npoles = [-4.0]\n{filter_keys}\n'
        "x0 = [0.5, 0.0, 0.0]\n"
    )
    log = cosim.run(write(tmp_path / "x.toml", PLAIN, "x0 = [1.0, -1.0, -1.0]", observer))
    expected = [{"entry": "x[2]", "before": 0.0, "after": -0.5}]
    assert changes(log) == {"observer": expected}


@pytest.mark.parametrize(
    ("model", "initial"),
    [
        (GENERAL, f"x0 = {X0.tolist()}"),  # as computed: consistent to rounding
        (PARTITIONED, "x_a0 = [1.0, -1.0]"),
        ("A = [[-1.0]]\nB = [[1.0, 1.0]]\nC = [[1.0]]\ndisturbances = [1]", "x0 = [3.0]"),
    ],
)
def test_nothing_is_said_where_nothing_changes(tmp_path, model, initial):
    """A consistent x0, the form that has x_a0 alone, a regular E."""
    log = cosim.run(write(tmp_path / "x.toml", model, initial))
    assert changes(log) == {}
