"""Sensors in scenario files: in front of an observer, replayed, changed, refused."""

import re

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document

MEASURED = """
[scenario]
name = "measured"
stop = 2.0
step = 1e-3

[models.academic]
n_a = 2
A  = [[0, 1, 1], [0, -2, 1], [1, 0, 1]]
Bu = [[0], [2], [1]]
Bd = [[1], [0], [0]]
C  = [[2, 0, 1]]

[components.u]
kind = "sine"
rate = 1.0

[components.delta]
kind = "disturbance"
terms = [{ family = "exponential", theta = -0.3 }]

[components.plant]
kind = "descriptor"
model = "academic"
x_a0 = [1.0, -1.0]

[components.sensor]
kind = "sensor"
ERRORS

[components.observer]
kind = "unknown-input-observer"
model = "academic"
L = [4.0, 0.0]
filter_rate = 1e3

[connections]
"plant.u" = "u.y"
"plant.delta" = "delta.y"
"sensor.u" = "plant.y"
"observer.u" = "u.y"
"observer.y" = "sensor.y"
"""
EVERY = """
delay = 1.5e-3
jitter = 2e-4
bias = 0.01
noise = 1e-3
lower = -5
upper = 5
bits = 12
dropout = 0.01
seed = 7
"""


def measured(folder, errors=""):
    return parse(Document(MEASURED.replace("ERRORS", errors), "measured", folder))


def test_a_sensor_without_errors_changes_nothing_behind_it(tmp_path):
    """The observer has the same bits as on the plant's own output: y is no zero-order hold."""
    log = cosim.run(measured(tmp_path), out=tmp_path / "sensor.mcap")
    text = MEASURED.replace("ERRORS", "").replace('"sensor.y"', '"plant.y"')
    direct = cosim.run(parse(Document(text, "direct", tmp_path)), out=tmp_path / "direct.mcap")
    for name in ("observer.delta", "observer.x_a"):
        np.testing.assert_array_equal(log[name], direct[name])


def test_noise_of_a_sensor_needs_no_warning(tmp_path):
    """Unlike a jumping noise that is added to a signal, its samples are joined by lines."""
    notices = []
    scenario = measured(tmp_path, "noise = 1e-3\nseed = 1")
    log = cosim.run(scenario, out=tmp_path / "noisy.mcap", notice=notices.append)
    assert notices == []
    error = log["sensor.y"] - log["plant.y"]
    # five standard errors of the deviation of 2001 samples
    assert abs(error.std() / 1e-3 - 1.0) < 5.0 / np.sqrt(2 * 2001)


@pytest.mark.parametrize("period", ["", "period = 5e-3"])
def test_a_replay_of_a_sensor_is_bit_exact(tmp_path, period):
    """Its numbers follow from the file, which is in the log; blocks do not matter."""
    scenario = measured(tmp_path, EVERY + period)
    log = cosim.run(scenario, out=tmp_path / "run.mcap")
    assert cosim.diff(log, cosim.replay(log.path)).equal
    single = cosim.run(scenario, out=tmp_path / "single.mcap", block=1)
    assert cosim.diff(log, single).equal
    lost = np.count_nonzero(log["sensor.valid"] == 0.0)
    assert 0 < lost < 0.1 * len(log["sensor.valid"])


def test_a_replay_with_another_seed_changes_the_noise_alone(tmp_path):
    """What is before the sensor is taken as it was."""
    log = cosim.run(measured(tmp_path, "noise = 1e-3\nseed = 7"), out=tmp_path / "run.mcap")
    other = cosim.replay(log.path, set={"sensor.seed": 8})
    np.testing.assert_array_equal(other["plant.y"], log["plant.y"])
    assert (other["sensor.y"] != log["sensor.y"]).all()


def test_the_log_keeps_the_samples_of_a_period(tmp_path):
    """One row each, the first at the start."""
    log = cosim.run(measured(tmp_path, "period = 0.1"), out=tmp_path / "run.mcap")
    time = log.time("sensor.y")
    np.testing.assert_array_equal(time, np.arange(21) / 10.0)
    np.testing.assert_array_equal(log["sensor.y"], log["plant.y"][::100])


def test_times_are_seconds(tmp_path):
    """A delay of 2.5 steps lies between two of the plant's outputs."""
    log = cosim.run(measured(tmp_path, "delay = 2.5e-3"), out=tmp_path / "run.mcap")
    y = log["plant.y"]
    # outputs of a few ones, rounded
    middle = (y[:-3] + y[1:-2]) / 2.0
    np.testing.assert_allclose(log["sensor.y"][3:], middle, rtol=1e-15, atol=1e-15)


def test_valid_drives_another_component(tmp_path):
    """A switch takes another signal for samples that are lost."""
    text = MEASURED.replace("ERRORS", "dropout = 0.2\nseed = 3")
    text += '"switch.u1" = "sensor.y"\n"switch.u2" = "u.y"\n"switch.control" = "sensor.valid"\n'
    text = text.replace("[connections]", '[components.switch]\nkind = "switch"\n[connections]')
    log = cosim.run(parse(Document(text, "switch", tmp_path)), out=tmp_path / "run.mcap")
    expected = np.where(log["sensor.valid"] == 1.0, log["sensor.y"], log["u.y"])
    np.testing.assert_array_equal(log["switch.y"], expected)


@pytest.mark.parametrize(
    ("errors", "text"),
    [
        ("noise = 0.1", "seed"),
        ("noise = -0.1\nseed = 1", "noise: "),
        (
            "noise = [0.1, 0.2]\nseed = 1",
            "noise: ",
        ),
        ("delay = -1e-3", "delay: expected a time >= 0 s, got -0.001 s"),
        ("jitter = -1e-3\nseed = 1", "jitter: expected a time >= 0 s, got -0.001 s"),
        ("jitter = 1e-3\nseed = 1", "jitter: "),
        ("delay = 1.5e-10", "1.5e-10 s"),
        ("lower = 1\nupper = 1", "lower < upper"),
        ("bits = 12", "bits: "),
        ("dropout = 1.0\nseed = 1", "dropout: "),
        ("period = 1.5e-3", "period of 'sensor': "),
    ],
)
def test_a_wrong_value_is_one_problem_of_the_file(tmp_path, errors, text):
    """With the line of the component, what was expected and what was found."""
    scenario = measured(tmp_path, errors)
    with pytest.raises(ScenarioError, match=re.escape(text)) as error:
        cosim.run(scenario, out=tmp_path / "run.mcap")
    assert str(error.value).count("components.sensor") == 1
