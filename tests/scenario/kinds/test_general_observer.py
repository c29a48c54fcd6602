"""Observers on models in the general form, and of disturbances that reach y directly."""

import json

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.report.summary import summarize
from cosim.scenario.record import component_record, recorded_warnings
from tests.scenario.general_plant import GENERAL, MIXING_Q, PARTITIONED, X0, write
from tests.scenario.refusals import check_refused

OBSERVER = """
"observer.u" = "u.y"
"observer.y" = "plant.y"
[components.observer]
kind = "unknown-input-observer"
model = "m"
{keys}
[truth]
"observer.x" = "plant.x"
"observer.delta" = "delta.y"
"""
# the first disturbance is that of the example, the second one reaches its second output directly
DIRECT = """\
E = [[1, 0, 0], [0, 1, 0], [0, 0, 0]]
A = [[0, 1, 1], [0, -2, 1], [1, 0, 1]]
B = [[1, 0, 0], [0, 2, 1], [0, 1, 0]]
C = [[2, 0, 1], [0, 1, 0]]
D = [[0, 0, 0], [0, 0, 0.5]]
disturbances = [0, 2]
"""
SECOND = 'second = { kind = "sine", amplitude = 0.3, rate = 3.0, phase = 0.7 }'
FILTERS = {
    "first-order": "filter_rate = 1e4",
    "consistent": 'filter = "consistent"\nfilter_rate = 200.0',
    "savitzky-golay": 'filter = "savitzky-golay"\nhalf_width = 0.05',
}


@pytest.fixture
def direct(tmp_path):
    """Return a function that writes a scenario with a direct disturbance, for a filter.

    Two components drive delta.
    """

    def written(name):
        keys = f"poles = [-4.0]\n{FILTERS[name]}\nx0 = [0.5, 0.0, 0.0]"
        more = OBSERVER.format(keys=keys)
        path = write(tmp_path / "direct.toml", DIRECT, "x0 = [1.0, -1.0, -1.0]", more)
        text = path.read_text().replace('delta" = "delta.y"', 'delta" = ["delta.y", "second.y"]')
        path.write_text(text.replace("[components.plant]", f"{SECOND}\n[components.plant]"))
        return path

    return written


@pytest.mark.parametrize("name", FILTERS)
def test_every_filter_reconstructs_both_disturbances(direct, name):
    """Poles at -4 and the zero: after 3 s e^-6 of the start is left, times 1e-2 what lag leaves.

    The direct one follows y - x at once, or is averaged as the other is: one lag for all of delta.
    """
    log = cosim.run(direct(name), set={"scenario.step": 1e-3, "scenario.stop": 8.0})
    lag = {"first-order": 0, "consistent": 5, "savitzky-golay": 50}[name]
    delta = np.column_stack([log["delta.y"], log["second.y"]])
    late = 6000
    found = log["observer.delta"][late:]
    expected = delta[late - lag : len(delta) - lag]
    # first-order: rate 1e4, so w''/rate; averages: second order in the window
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-3)
    x = log["plant.x"]
    np.testing.assert_allclose(log["observer.x"][late:], x[late:], rtol=0, atol=1e-3)


def test_an_observer_in_any_coordinates_estimates_the_users_x(tmp_path):
    """E singular and mixed: x_hat converges to x at the rates of the gain and the zero, 4 and 2."""
    keys = "poles = [-4.0]\nfilter_rate = 1e3"
    more = OBSERVER.format(keys=keys)
    path = write(tmp_path / "mixed.toml", GENERAL, f"x0 = {X0.tolist()}", more)
    log = cosim.run(path, out=tmp_path / "mixed.mcap")
    error = np.abs(log["observer.x"] - log["plant.x"]).max(axis=1)
    t = log.time("plant.x")
    assert error[t == 2.0] < 2.0 * np.exp(-4.0) * error[0]
    assert error[t == 4.0] < 2.0 * np.exp(-8.0) * error[0]
    replayed = cosim.replay(log)
    np.testing.assert_array_equal(replayed["observer.x"], log["observer.x"])
    given = {"observer.x0": X0.tolist(), "delta.amplitude": 0.0}
    exact = cosim.run(path, set=given)
    np.testing.assert_allclose(exact["observer.x"][0], X0, rtol=0, atol=1e-13)
    # y is no straight line within a step of 1e-2: an error of its second order
    np.testing.assert_allclose(exact["observer.x"], exact["plant.x"], rtol=0, atol=1e-5)


def test_a_gain_is_one_of_the_users_states(tmp_path):
    """L of x has a row a state, or is a list of one column."""
    keys = "L = [[4.0], [0.0]]\nfilter_rate = 1e3"
    model = "A = [[-1, 1], [-1, -2]]\nBu = [[-1], [1]]\nBd = [[1], [0]]\nC = [[1, 0]]\nDu = [[-1]]"
    path = write(tmp_path / "gain.toml", model, "x0 = [1.0, -1.0]", OBSERVER.format(keys=keys))
    column = cosim.run(path)
    listed = cosim.run(path, set={"observer.L": [4.0, 0.0]})
    np.testing.assert_array_equal(column["observer.x"], listed["observer.x"])
    with pytest.raises(ScenarioError, match=r"L: expected shape \(2, 1\).*got \(1, 1\)"):
        cosim.run(path, set={"observer.L": [[4.0]]})


WHOLLY_DIRECT = "A = [[-1]]\nB = [[1, 0.5]]\nC = [[1]]\nD = [[0, 2]]\ndisturbances = [1]"
IDENTIFIED = """
"regressor.delta" = "observer.delta"
"identifier.regressor" = "regressor.mu"
[components.regressor]
kind = "regressor"
terms = [{ family = "sine" }]
delays = [0.0, 0.3, 0.6]
[components.identifier]
kind = "identifier"
method = "least-squares"
"""


def test_a_filter_of_no_derivative_is_not_needed(tmp_path):
    """Where y - x is 2 delta there is no q, and held inputs do no harm to a derivative.

    T_id is that of observer and delays; the one fixed mode is -1 - 0.5 / 2. Noise of y counts by
    1/2. The keys of the filter change nothing.
    """
    observer = '"observer.u" = "u.y"\n"observer.y" = "plant.y"'
    more = observer + IDENTIFIED + OBSERVER.format(keys="poles = []").replace(observer, "")
    path = write(tmp_path / "direct.toml", WHOLLY_DIRECT, "x0 = [1.0]", more)
    log = cosim.run(path, set={"scenario.stop": 10.0})
    assert "observer.q" not in log
    # e^-12.5 of the start, and y is no straight line within a step of 1e-2
    np.testing.assert_allclose(log["observer.delta"][-1], log["delta.y"][-1], rtol=0, atol=1e-5)
    times = component_record(log, "identifier").times
    assert times["T_f"] == 0.0
    assert times["T_id"] == pytest.approx(np.log(1e3) / 1.25 + 0.6)
    (reconstruction,) = summarize(log).reconstructions
    assert reconstruction.filter == "direct"
    assert reconstruction.bias.coefficient == 0.0
    np.testing.assert_allclose(reconstruction.noise_gain, [0.5], rtol=0.3)  # and what x hat adds
    held = {"scenario.stop": 1.0, "scenario.input_interpolation": "zero-order"}
    assert recorded_warnings(cosim.run(path, set=held)) == []
    useless = {"observer.filter_rate": 100.0, "observer.q0": [0.0]}
    same = cosim.run(path, set={"scenario.stop": 1.0, **useless})
    np.testing.assert_array_equal(same["observer.delta"], log["observer.delta"][: len(same["u.y"])])
    ((_, warning),) = recorded_warnings(same)
    assert warning.startswith("filter_rate and q0: without effect, as delta follows from y direct")


CALM = GENERAL.replace("disturbances = [0]", "")
THREE = DIRECT.replace("disturbances = [0, 2]", "disturbances = [0, 1, 2]")
RATE = "filter_rate = 1.0"
CHOSEN = 'filter = "auto"\nnoise = 0.1\namplitude = 1.0\nbandwidth = 1.0'
IMPOSSIBLE = [
    (CALM, f"poles = []\n{RATE}", "components.observer: expected a design model with a dist"),
    (THREE, f"poles = []\n{RATE}", "3 outputs"),
    (DIRECT, "poles = [-4.0]", "filter_rate is missing; filter = "),
    (GENERAL, f"poles = [-4.0]\n{RATE}\nx_a0 = [1.0, 2.0]", "x_a0: .*'m' .* expected x0"),
    (GENERAL, f"poles = [-4.0]\n{RATE}\nx0 = [1.0, 2.0]", r"\(3,\)"),
    (WHOLLY_DIRECT, f"poles = []\n{CHOSEN}", "filter = 'auto' .*, but delta feeds through"),
]


def test_an_observer_that_cannot_be_is_refused(tmp_path):
    """Before any run, with what is expected."""

    def refuse(model, keys):
        path = write(tmp_path / "wrong.toml", model, "x0 = [1.0]", OBSERVER.format(keys=keys))
        cosim.run(path)

    check_refused(IMPOSSIBLE, refuse, ScenarioError)


# --- initial states that the algebraic equations do not allow: made consistent, and said ---

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
