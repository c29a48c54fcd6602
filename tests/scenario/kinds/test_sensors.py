"""Sensors in scenario files: in front of an observer, replayed, changed, refused."""

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError
from tests.scenario.refusals import check_refused

EVERY = {
    "delay": 1.5e-3,
    "jitter": 2e-4,
    "bias": 0.01,
    "noise": 1e-3,
    "lower": -5,
    "upper": 5,
    "bits": 12,
    "dropout": 0.01,
    "seed": 7,
}
PLANT = cosim.load("academic").set({"scenario.stop": 2.0, "scenario.verdicts": False})


def measured(**errors):
    """Return the plant of the paper with a sensor in front of its observer."""
    return PLANT.set(
        {
            "components.sensor": {"kind": "sensor", **errors},
            "connections.sensor.u": "plant.y",
            "connections.observer.y": "sensor.y",
        }
    )


def test_a_sensor_without_errors_changes_nothing_behind_it():
    """The observer has the same bits as on the plant's own output: y is no zero-order hold."""
    run = cosim.run(measured())
    direct = cosim.run(PLANT)
    for name in ("observer.delta", "observer.x_a"):
        np.testing.assert_array_equal(run[name], direct[name])


def test_noise_needs_no_warning_and_is_changed_by_its_seed_alone(tmp_path):
    """Its samples are joined by lines; in a replay with another seed the plant is as it was."""
    log = cosim.run(measured(noise=1e-3, seed=1), out=tmp_path / "noisy.mcap")
    assert [message for message in log.messages() if message.source == "sensor"] == []
    other = cosim.replay(log.path, set={"sensor.seed": 8})
    np.testing.assert_array_equal(other["plant.y"], log["plant.y"])
    assert (other["sensor.y"] != log["sensor.y"]).all()


@pytest.mark.parametrize("period", [{}, {"period": 5e-3}])
def test_a_replay_of_a_sensor_is_bit_exact(tmp_path, period):
    """Its numbers follow from the file, which is in the log; blocks do not matter."""
    scenario = measured(**EVERY, **period)
    log = cosim.run(scenario, out=tmp_path / "run.mcap")
    assert cosim.diff(log, cosim.replay(log.path)).equal
    assert cosim.diff(log, cosim.run(scenario, block=1)).equal
    lost = np.count_nonzero(log["sensor.valid"] == 0.0)
    assert 0 < lost < 0.1 * len(log["sensor.valid"])


def test_times_are_seconds_and_the_log_keeps_the_samples_of_a_period():
    """A delay of 2.5 steps lies between two outputs of the plant; one row a sample, from 0 on."""
    run = cosim.run(measured(delay=2.5e-3))
    y = run["plant.y"]
    # outputs of a few ones, rounded
    middle = (y[:-3] + y[1:-2]) / 2.0
    np.testing.assert_allclose(run["sensor.y"][3:], middle, rtol=1e-15, atol=1e-15)
    run = cosim.run(measured(period=0.1))
    np.testing.assert_array_equal(run.time("sensor.y"), np.arange(21) / 10.0)
    np.testing.assert_array_equal(run["sensor.y"], run["plant.y"][::100])


WRONG_VALUES = [
    ({"noise": 0.1}, ": seed: expected"),
    ({"delay": -1e-3}, "delay[^ ]*: expected a number >= 0, got -0.001"),
    ({"jitter": -1e-3, "seed": 1}, "jitter[^ ]*: expected a number >= 0, got -0.001"),
    ({"delay": 1.5e-10}, "1.5e-10 s"),
    ({"period": 1.5e-3}, "period of 'sensor': "),
]


def test_a_wrong_value_is_one_problem_of_the_component():
    def refuse(errors):
        cosim.run(measured(**errors))

    place = r"\Aset\['sensor'\]"
    cases = [(errors, rf"{place}[^\n]*{text}[^\n]*\Z") for errors, text in WRONG_VALUES]
    check_refused(cases, refuse, ScenarioError)
