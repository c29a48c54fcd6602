"""Filters of delta in scenarios: what lags is read at its instant, what was chosen is replayed."""

import json
import re

import numpy as np
import pytest
from fmpy.validation import validate_fmu

import cosim
from cosim.errors import LogError, ScenarioError
from cosim.report.summary import summarize
from cosim.scenario.exporting import export_component
from tests.log.crafting import put_together, take_apart
from tests.scenario.refusals import check_refused

SHORT = {"scenario.stop": 9.0}
WINDOW = {"observer.filter": "savitzky-golay", "observer.half_width": 0.1}
CONSISTENT = {"observer.filter": "consistent"}
AUTO = {"observer.filter": "auto", "observer.noise": 1e-3}

# two outputs, one disturbance with a rate and an exponent
ALPHA = "1.0 + 0.3*cos(2.3*t)"
DELAYS = [0.4, 1.0, 1.6, 2.2]
TERMS = [{"alpha": "1", "family": "sine"}, {"alpha": ALPHA, "family": "exponential"}]
TWO = {
    "scenario.stop": 30.0,
    "models.academic.A": [[-1.0, 2.0], [-2.0, -1.5]],
    "models.academic.Bu": [[0.0], [1.0]],
    "models.academic.Bd": [[1.0], [0.5]],
    "models.academic.C": [[1.0, 0.0], [0.0, 1.0]],
    "u.rate": 0.7,
    "delta.terms": [dict(TERMS[0], theta=1.3), dict(TERMS[1], theta=-0.05)],
    "observer.L": [[5.6, 1.0], [-1.2, 2.0]],  # poles at -4 and -5
    "observer.filter_rate": 200.0,
    "regressor.terms": TERMS,
    "regressor.delays": DELAYS,
}


@pytest.fixture(scope="module")
def two(academic):
    """Return the scenario with two outputs."""
    return cosim.load(academic).set(TWO)


@pytest.fixture(scope="module")
def academic(tmp_path_factory):
    """Return the path of the shipped example without its identifier: nothing is fitted here."""
    text = cosim.load("academic").document.text
    text = re.sub(r'(?s)\[components\.identifier\].*?(?=\[conn)|"identifier\.[^\n]*', "", text)
    path = tmp_path_factory.mktemp("academic") / "academic.toml"
    path.write_text(text, encoding="utf-8")
    return path


def settled_error(recording, lag, since=8.0):
    """Return |delta hat(t) - delta(t - lag)| behind the transients, the truth interpolated."""
    t = recording.time("observer.delta")
    true = np.interp(t - lag, recording.time("delta.y"), recording["delta.y"])
    return np.abs(recording["observer.delta"] - true)[t >= since]


def metadata(recording, component):
    return json.loads(recording.metadata[f"cosim.component.{component}"]["metadata"])


@pytest.mark.slow
def test_a_known_lag_of_delta_leaves_no_bias():
    """The paper's filter reads w' 1/200 s late; others leave 1/rate^2 or the fourth order."""
    errors = []
    for changes in ({}, CONSISTENT, WINDOW):
        own = {"identifier.method": "least-squares", "identifier.start": 5.0, **changes}
        run = cosim.run("academic", set=TWO | own)
        errors.append(np.abs(run["identifier.theta"][-1] - [1.3, -0.05]))
    assert errors[0][1] > 5e-3
    assert (np.array(errors[1:]) < 5e-5).all()


@pytest.mark.parametrize(
    ("changes", "lag", "factor"),
    [
        (CONSISTENT, 0.5e-3 / np.tanh(0.5), 0.5e-6),  # delta''/(2 rate^2)
        ({**CONSISTENT, "observer.filter_rate": 130.0}, 0.5e-3 / np.tanh(0.065), 0.5 / 130.0**2),
        ({**WINDOW, "observer.order": 2}, 0.1, 0.1**2 / 10.0),  # (m h)^2/10 delta''
    ],
)
def test_the_error_is_that_of_the_instant_that_delta_belongs_to(changes, lag, factor, academic):
    """The summary compares with the truth that much earlier, and says so.

    The curvature of delta is at most about that of its terms, 0.25 1.7^2 + 0.2 2.3^2 = 1.8.
    """
    run = cosim.run(academic, set=SHORT | changes)
    errors = {signal.estimate: signal for signal in summarize(run).signals}
    assert errors["observer.delta"].lag == pytest.approx(lag, rel=1e-5)
    assert errors["observer.x_a"].lag == 0.0
    # the drift is interpolated linearly between samples of y, which adds h^2/12 y''
    lag = errors["observer.delta"].lag
    error = settled_error(run, lag)
    assert 0.2 * factor < error.max() < 1.8 * factor + 2e-6
    assert errors["observer.delta"].last == pytest.approx(error[-1], abs=1e-13)
    assert metadata(run, "observer")["lags"] == {"delta": lag}
    assert metadata(run, "regressor")["lag"] == lag


def test_held_outputs_do_no_harm_to_averages(academic):
    """The paper's filter reads a ramp 58 % too high; increments are what they are."""
    held = {"scenario.input_interpolation": "zero-order"}
    errors = {}
    for name, changes in (("first-order", {}), ("consistent", CONSISTENT), ("window", WINDOW)):
        run = cosim.run(academic, set=SHORT | held | changes)
        errors[name] = settled_error(run, summarize(run).signals[1].lag).max()
        warned = "filter reads a ramp 58% too high" in run.metadata["cosim.run"]["warnings"]
        assert warned == (name == "first-order")
    assert errors["first-order"] > 0.1
    # u held in plant and observer alike; y held in the drift lags by half a step
    assert errors["consistent"] < 2e-3
    assert errors["window"] < 2e-3


def test_there_is_no_value_until_the_window_is_full(academic):
    """The regressor waits for it too, by its longest delay; a shorter run has no error of 0."""
    run = cosim.run(academic, set=SHORT | WINDOW)
    t = run.time("observer.delta")
    assert np.array_equal(np.isnan(run["observer.delta"]), t < 0.2 - 1e-9)
    assert np.array_equal(np.isnan(run["regressor.mu"]).any(axis=1), t < 3.2 - 1e-9)
    assert not np.isnan(run["observer.x_a"]).any()
    short = cosim.run(academic, set=WINDOW | {"scenario.stop": 0.1})
    delta = summarize(short).signals[1]
    assert np.isnan([delta.largest, delta.rms, delta.last]).all()


@pytest.mark.parametrize("changes", [CONSISTENT, WINDOW, AUTO])
def test_blocks_and_replays_do_not_change_a_bit(changes, academic, tmp_path):
    """K = 1000 and K = 7, and the replay of the log with what was chosen."""
    settings = SHORT | {"scenario.stop": 2.0} | changes
    log = cosim.run(academic, out=tmp_path / "a.mcap", set=settings)
    assert cosim.diff(log, cosim.run(academic, block=7, set=settings)).equal
    again = cosim.replay(log)
    assert cosim.diff(log, again).equal
    assert metadata(again, "observer") == metadata(log, "observer")


def test_a_gain_on_the_way_keeps_the_lag(two):
    """What has no memory adds no lag; a sum of signals that lag differently has no instant."""
    halved = {
        "components.half": {"kind": "gain", "K": 0.5},
        "connections.half.u": "observer.delta",
        "connections.regressor.delta": "half.y",
        "scenario.stop": 8.0,
    }
    direct = cosim.run(two, set=CONSISTENT | {"scenario.stop": 8.0})
    scaled = cosim.run(two, set=CONSISTENT | halved)
    assert metadata(scaled, "regressor")["lag"] == metadata(direct, "regressor")["lag"] > 0.0
    half = 0.5 * direct["regressor.mu"]
    assert np.array_equal(scaled["regressor.mu"], half, equal_nan=True)
    added = {
        "components.both": {"kind": "sum", "signs": [1.0, 1.0]},
        "connections.both.u1": "observer.delta",
        "connections.both.u2": "delta.y",
        "connections.regressor.delta": "both.y",
    }
    with pytest.raises(ScenarioError, match=r"'delta': expected .*observer.delta by 0.005"):
        cosim.run(two, set=CONSISTENT | added)


def test_a_recorded_observer_keeps_its_lag(academic, tmp_path):
    """In the place of the observer, and in the replay of that run."""
    log = cosim.run(academic, out=tmp_path / "a.mcap", set=SHORT | WINDOW)
    swapped = cosim.load(academic).set(SHORT).swap(observer=log.path)
    run = cosim.run(swapped, out=tmp_path / "b.mcap")
    assert np.array_equal(run["regressor.mu"], log["regressor.mu"], equal_nan=True)
    again = cosim.replay(run, out=tmp_path / "c.mcap")
    third = cosim.replay(again)
    for replayed in (again, third):
        assert np.array_equal(replayed["regressor.mu"], log["regressor.mu"], equal_nan=True)
        assert summarize(replayed).signals[1].lag == 0.1


# --- the choice ---


SENSOR = {
    "components.sensor": {"kind": "sensor", "noise": 1e-3, "seed": 3},
    "connections.sensor.u": "plant.y",
    "connections.observer.y": "sensor.y",
}


def test_the_choice_is_for_the_noise_that_is_there(academic):
    """Predicted with the amplitude and the rate of alpha, found on a run with that noise.

    The window is one of 0.6 s, with 0.37 of the noise of y: 764 with the paper's filter.
    """
    run = cosim.run(academic, set=SHORT | {"scenario.stop": 12.0} | AUTO | SENSOR)
    record = metadata(run, "observer")
    result = record["choice"]["result"]
    assert result["noise"] == [1e-3]
    assert result["bandwidth"] == pytest.approx(2.3, rel=1e-2)
    assert result["amplitude"] == pytest.approx(np.hypot(1.3616, 1.1091), rel=1e-2)
    predicted = np.hypot(result["error_by_noise"], result["error_by_bias"])
    rms = np.sqrt(np.mean(settled_error(run, record["lags"]["delta"]) ** 2))
    # bias of a sine of this amplitude at the highest rate is more than there is; noise is not
    assert 0.5 * result["error_by_noise"] < rms < 1.5 * predicted
    (reconstruction,) = summarize(run).reconstructions
    assert reconstruction.noise_gain[0] * 1e-3 == pytest.approx(result["error_by_noise"], rel=0.02)
    assert "each exponential of size 1" in reconstruction.choice.assumption


def test_the_noise_can_be_that_of_a_log_which_a_replay_does_not_need(academic, tmp_path):
    """The choice is in the log of the run, with its noise; the log of another has none."""
    source = tmp_path / "noisy.mcap"
    cosim.run(academic, out=source, set=SHORT | SENSOR)
    changes = {"observer.filter": "auto", "observer.noise_from": str(source)}
    log = cosim.run(academic, out=tmp_path / "a.mcap", set=SHORT | changes)
    (found,) = metadata(log, "observer")["choice"]["result"]["noise"]
    assert found == pytest.approx(1e-3, rel=0.05)
    text = academic.read_text(encoding="utf-8").replace('"observer.', '"watcher.')
    other = tmp_path / "watcher.toml"
    other.write_text(text.replace("components.observer", "components.watcher"), encoding="utf-8")
    watched = {key.replace("observer", "watcher"): value for key, value in changes.items()}
    with pytest.raises(ScenarioError, match=r"noise_from: .*without 'watcher\.y'"):
        cosim.run(other, set=watched)
    source.unlink()
    assert cosim.diff(log, cosim.replay(log)).equal
    with pytest.raises(ScenarioError, match="a replay opens no files that only the log names"):
        cosim.replay(log, set={"observer.bandwidth": 3.0})


NO_CHOICES = [
    ("half_width_steps", 0, "choice of 'observer' cannot be used: .*half width: .*got 0$"),
    ("order", "six", "cannot be understood: choice.result.order"),
]


@pytest.mark.slow
def test_a_damaged_recorded_choice_is_refused(academic, tmp_path):
    """A log may come from anywhere."""

    def refuse(key, value):
        log = cosim.run(academic, out=tmp_path / "a.mcap", set=SHORT | AUTO, force=True)
        content = take_apart(log.path)
        items = dict(content.metadata)["cosim.component.observer"]
        table = json.loads(items["metadata"])
        table["choice"]["result"][key] = value
        items["metadata"] = json.dumps(table)
        cosim.replay(put_together(content, tmp_path / "b.mcap"))

    check_refused(NO_CHOICES, refuse, (LogError, ScenarioError))


# --- refusals ---


SG = {"filter": "savitzky-golay"}
WRONG_FILTERS = [
    ({"filter": "median"}, r"filter"),
    (SG, r"half_width is missing; filter = 'savitzky-"),
    ({"half_width": 0.1}, r"half_width: .*got filter = 'first-order'"),
    ({"noise": 0.1}, r"noise: .*filter = 'auto' only, got filter = 'first-order'"),
    ({"filter": "auto"}, r"expected either noise, .*or noise_from"),
    ({"filter": "auto", "noise": 1.0, "noise_from": "x.mcap"}, r"expected either noise"),
    ({"filter": "auto", "noise": -1.0}, r"noise.*: expected a number >= 0, got -1.0"),
    ({"filter": "auto", "noise": [1.0, 2.0]}, r"noise: expected one .*1 elements, got 2"),
    ({"filter": "auto", "noise": 1e3}, r"leaves an error of"),
    ({"filter": "auto", "noise_from": "no.mcap"}, r"no\.mcap"),
    ({**SG, "half_width": 0.0105}, r"half_width.*nearest"),
    ({**SG, "half_width": 0.0}, r"half width: expected 1 to .* samples, got 0$"),
    ({**SG, "half_width": 0.1, "order": 11}, r"order: .*201 samples, got 11$"),
]


def test_a_wrong_filter_is_refused(academic):
    """Each with what was found, what is needed and the way out; nothing is guessed."""

    def refuse(changes):
        named = {f"observer.{key}": value for key, value in changes.items()}
        cosim.run(academic, set=SHORT | named)

    check_refused(WRONG_FILTERS, refuse, ScenarioError)


def test_an_identifier_waits_for_the_window():
    """Its start comes after the longest delay and the window; a computed one by itself."""
    changes = {"scenario.stop": 9.0, "identifier.start": 8.0, "observer.half_width": 2.6}
    changes["observer.filter"] = "savitzky-golay"
    message = "at least the longest delay, 3.0 s and the observer's window, 5.2"
    with pytest.raises(ScenarioError, match=message):
        cosim.run("academic", set=changes)
    start = {"epsilon_observer": 1e-3, "epsilon_filter": 1e-3}
    computed = {"identifier.method": "least-squares", "identifier.start": start}
    run = cosim.run("academic", set=WINDOW | computed | {"scenario.stop": 7.0})
    times = metadata(run, "identifier")
    assert times["T_f"] == 0.2
    assert times["T_id"] == pytest.approx(np.log(1e3) / 2.0 + 3.2)


def test_the_choice_needs_what_delta_is_like(two):
    """A sine has no rate that is known before: it is what is identified; a constant has none."""
    constant = {"regressor.terms": [{"family": "exponential"}], "regressor.delays": [0.5, 1.0]}
    for changes in (AUTO, AUTO | constant):
        with pytest.raises(ScenarioError, match="requires amplitude and bandwidth of delta"):
            cosim.run(two, set=changes)
    given = {"observer.amplitude": 2.0, "observer.bandwidth": 2.3}
    run = cosim.run(two, set=AUTO | given | {"scenario.stop": 8.0})
    assert metadata(run, "observer")["choice"]["result"]["bandwidth"] == 2.3


# --- FMUs ---


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "changes", "fmi"),
    [("observer", WINDOW, "2"), ("observer", CONSISTENT, "3"), ("regressor", WINDOW, "3")],
)
def test_an_exported_average_gives_what_the_component_gave(name, changes, fmi, academic, tmp_path):
    """In its place as an FMU for co-simulation; no problems for FMPy."""
    scenario = cosim.load(academic).set({**changes, "scenario.stop": 4.0})
    run = cosim.run(scenario)
    path = tmp_path / "exported.fmu"
    export_component(scenario, name, path, fmi=fmi)
    assert validate_fmu(str(path)) == []
    # of an FMU the regressor does not know that there is no value at first
    of_others = {"connections.regressor.delta": "delta.y"} if name == "observer" else changes
    settings = {**of_others, "scenario.stop": 4.0}
    swapped = cosim.run(academic, set=settings, swap={name: f"{path}#cs"})
    signal = {"observer": "observer.delta", "regressor": "regressor.mu"}[name]
    # an input is u0 + h (u1 - u0)/h there, which may be 1e-16 off u1; times 1/step
    np.testing.assert_allclose(swapped[signal], run[signal], rtol=0, atol=1e-12)
