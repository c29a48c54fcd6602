"""Sensors that sample less often than at every communication point: each sample counts once."""

import numpy as np
import pytest

import cosim
from cosim.errors import CosimError
from cosim.scenario.exporting import export_component
from cosim.scenario.record import recorded_identification
from cosim.scenario.running.identifying import identifier_record
from tests.scenario.online import TWO_OUTPUTS

H = 1e-2  # s
PERIOD = 0.1  # s
SETTINGS = {
    "scenario.step": H,
    "scenario.stop": 40.0,
    "observer.filter_rate": 100.0,
    "identifier.start": 3.5,
    "identifier.period": 0.5,
}
# Cramer-Rao bound over the deviation of the noise for 40 s at 1 ms; tests/theory/experiments.py
BOUND = np.array([7.0863e-3, 6.2226e-2])


def run(**changes):
    """Run the example with a sensor of deviation 1e-3."""
    settings = {f"sensor.{key}": value for key, value in changes.items()}
    return cosim.run("academic-noisy", set={**SETTINGS, **settings})


@pytest.fixture(scope="module")
def slow():
    """Run it with ten communication steps between two samples."""
    return run(period=PERIOD)


def verdicts(log):
    """Return what output error says at the end of a run."""
    return recorded_identification(log)["identifier"]


def errors(log):
    """Return the standard errors of output error at the end of a run."""
    return np.array([one.standard_error for one in verdicts(log).parameters])


def check_online(log, part):
    """Check the estimate against the verdict, both of good data, with the truth in the interval."""
    found = verdicts(log)
    assert [one.verdict for one in found.parameters] == 2 * ["IDENTIFIABLE"]
    theta = np.array([one.value for one in found.parameters])
    assert (np.abs(theta - [-0.1, -0.3]) < 4.0 * errors(log)).all()
    assert (np.abs(log["identifier.theta"][-1] - theta) < part * errors(log)).all()


def test_standard_errors_are_those_of_the_samples_that_there_are(slow):
    """They are the bound for a hundredth of the samples, 10 times that for all.

    Their own noise is that of the deviation, 1/sqrt(800) = 3.5 %, and the sum over 401 samples is
    that over 40001 to 1 %: within 15 %. The residual of held samples would be no noise.
    """
    np.testing.assert_allclose(errors(slow), 10.0 * 1e-3 * BOUND, rtol=0.15)
    online = slow["identifier.standard_error"][-1]
    np.testing.assert_allclose(online, errors(slow), rtol=0.05)
    assert slow["identifier.deviation"][-1] == pytest.approx(1e-3, rel=0.15)
    check_online(slow, 0.05)


def test_the_data_of_a_log_are_the_samples(tmp_path):
    """401 of 40 s; the sensor's log has these rows alone, so all are there."""
    log = cosim.run(
        "academic-noisy", set={**SETTINGS, "sensor.period": PERIOD}, out=tmp_path / "slow.mcap"
    )
    record = identifier_record(log)
    assert int(record.data.measured.sum()) == 401
    assert len(record.data.t) == 4001
    np.testing.assert_array_equal(log["sensor.y_samples"], log["sensor.y"])
    assert cosim.diff(log, cosim.replay(log.path)).equal


@pytest.mark.slow
def test_errors_have_the_size_of_standard_errors_over_seeds():
    """Over 8 seeds: the sum of 16 squares is a chi-square of 16 degrees, 3e-4 below 3.3, above 43.

    Held samples as new ones would make it ten times that. Jitter, of which the sensor says nothing,
    is more noise: its deviation is found.
    """
    squares = 0.0
    for seed in range(8):
        log = run(period=PERIOD, jitter=1e-2, seed=seed)
        found = verdicts(log).parameters
        for one, true in zip(found, [-0.1, -0.3], strict=True):
            squares += ((one.value - true) / one.standard_error) ** 2
    assert 3.3 < squares < 43.0


def test_a_delay_that_no_sensor_tells_is_inconsistent():
    """A fiftieth of the period is enough: all samples are of an earlier time than they say."""
    found = verdicts(run(period=PERIOD, delay=PERIOD / 50.0))
    assert [one.verdict for one in found.parameters] == 2 * ["INCONSISTENT"]


@pytest.mark.parametrize(
    "changes",
    [
        {"period": PERIOD, "delay": 0.163, "dropout": 0.1},
        {"period": PERIOD, "delay": 0.025, "jitter": 0.02},
    ],
)
def test_samples_with_time_stamps_count_at_their_instants(changes):
    """Delay and jitter cost nothing: the deviation is that of the noise, the interval holds.

    Online as in the verdict, which has the last samples too: those of the delay.
    """
    log = run(time_stamps=True, **changes)
    assert verdicts(log).deviation[0] == pytest.approx(1e-3, rel=0.15)
    check_online(log, 0.2)


@pytest.mark.slow
def test_a_log_of_time_stamps_is_fitted_as_its_run(tmp_path):
    """The same samples, and a replay with the same bits."""
    settings = {"sensor.period": PERIOD, "sensor.delay": 0.05, "sensor.time_stamps": True}
    log = cosim.run("academic-noisy", set={**SETTINGS, **settings}, out=tmp_path / "late.mcap")
    record = identifier_record(log)
    assert int(record.data.measured.sum()) == 400  # that of t = 0 is of before the start
    assert len(record.data.t) == 4001
    found = cosim.identify(log).assessment.parameters
    assert [one.value for one in found] == [one.value for one in verdicts(log).parameters]
    assert cosim.diff(log, cosim.replay(log.path)).equal


def test_time_stamps_that_nothing_can_keep_are_refused(tmp_path):
    """Of samples after their report, or at several instants; in an FMU, which has no past."""
    refused = [{"jitter": 0.005}, {"jitter": 0.005, "delay": 0.01, "size": 2}]
    for changes in refused:
        with pytest.raises(CosimError, match="time_stamps: "):
            run(time_stamps=True, **changes)
    stamped = cosim.load("academic-noisy").set({"sensor.period": 0.1, "sensor.time_stamps": True})
    with pytest.raises(CosimError, match="expected a sensor without time_stamps"):
        export_component(stamped, "identifier", tmp_path / "identifier.fmu")


@pytest.mark.slow
def test_an_exported_identifier_takes_samples(tmp_path):
    """With the same bits."""
    changes = {"scenario.step": H, "observer.filter_rate": 100.0, "sensor.period": 0.1}
    slow = cosim.load("academic-noisy").set({**changes, "scenario.stop": 12.0})
    fmu = tmp_path / "identifier.fmu"
    export_component(slow, "identifier", fmu)
    expected = cosim.run(slow)["identifier.theta"]
    swapped = cosim.run(slow, swap={"identifier": fmu}, set={"identifier.interface_type": "cs"})
    assert np.isfinite(expected[-1]).all()
    assert np.array_equal(swapped["identifier.theta"][::10], expected, equal_nan=True)


def test_other_methods_get_no_verdict_on_held_samples():
    """They take y at every communication point; the reason is said, and no log is fitted by it."""
    log = cosim.run(
        "academic-noisy", set={**SETTINGS, "sensor.period": PERIOD, "identifier.method": "rayleigh"}
    )
    text = "y has values between the samples of 'sensor'"
    assert text in verdicts(log).problem
    with pytest.raises(CosimError, match=text):
        identifier_record(log)


FIRST = {"kind": "sensor", "noise": 0.1, "seed": 1, "period": PERIOD}
SECOND = {"kind": "sensor", "noise": 1e-3, "seed": 2}


@pytest.mark.fast("second1-201", "second3-667")
@pytest.mark.parametrize(
    ("second", "samples"),
    [({}, 2001), ({"period": PERIOD}, 201), ({"period": 0.05}, 401), ({"period": 0.03}, 667)],
)
def test_each_sensor_counts_at_its_own_times(tmp_path, second, samples):
    """At every point, in turn with the other or not; a later fit of the log is that of the run."""
    sensors = {
        "components.first": FIRST,
        "components.second": {**SECOND, **second},
        "connections.first.u": "plant.y[0]",
        "connections.second.u": "plant.y[1]",
        "connections.observer.y": ["first.y", "second.y"],
    }
    log = cosim.run("academic-noisy", set={**TWO_OUTPUTS, **sensors}, out=tmp_path / "two.mcap")
    np.testing.assert_allclose(verdicts(log).deviation, [0.1, 1e-3], rtol=0.2)
    check_online(log, 0.2)
    record = identifier_record(log)
    np.testing.assert_array_equal(record.data.measured.sum(axis=0), [201, samples])
    later = cosim.identify(log).assessment
    offline = [one.value for one in verdicts(log).parameters]
    np.testing.assert_array_equal(later.fit.theta, offline)


@pytest.mark.parametrize("bare", [0, 1])
def test_an_output_without_a_sensor_counts_at_every_point(tmp_path, bare):
    """Beside one that a sensor samples every 0.1 s, before it or behind it in y."""
    sources = ["first.y", "first.y"]
    sources[bare] = f"plant.y[{bare}]"
    sensor = {
        "components.first": FIRST,
        "connections.first.u": f"plant.y[{1 - bare}]",
        "connections.observer.y": sources,
        "scenario.stop": 1.0,
    }
    log = cosim.run("academic-noisy", set={**TWO_OUTPUTS, **sensor}, out=tmp_path / "one.mcap")
    record = identifier_record(log)
    counts = [11, 11]
    counts[bare] = 101
    np.testing.assert_array_equal(record.data.measured.sum(axis=0), counts)
    np.testing.assert_array_equal(record.data.y[:, bare], log["plant.y"][:, bare])


def test_an_unstable_plant_is_identified_by_the_samples_that_are_there(tmp_path):
    """Online as after the run, with the truth in the interval; and a replay has the same bits."""
    changes = {
        "models.academic.A": [[2, 1, 1], [0, -2, 1], [1, 0, 1]],
        "scenario.stop": 20.0,
        "scenario.step": 1e-2,
        "observer.filter_rate": 50.0,
        "identifier.period": 2.0,
        "sensor.dropout": 0.2,
    }
    log = cosim.run("academic-noisy", set=changes, out=tmp_path / "unstable.mcap")
    np.testing.assert_allclose(log["identifier.standard_error"][-1], errors(log), rtol=0.05)
    check_online(log, 0.1)
    again = cosim.replay(log)
    assert again["identifier.theta"].tobytes() == log["identifier.theta"].tobytes()
