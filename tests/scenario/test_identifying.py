"""Identification from logs: the same as at the end of the run, and of several logs at once."""

from __future__ import annotations

import re

import numpy as np
import pytest

import cosim
from cosim.documents import plain
from cosim.errors import CosimError, UsageError
from cosim.scenario.record import IDENTIFICATION
from cosim.scenario.running.identifying import identifier_record
from tests.scenario.refusals import check_refused

FAST = {"scenario.step": 0.01, "observer.filter_rate": 100.0}


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Return the logs of three runs of one plant: noise, amplitudes and start are others."""
    folder = tmp_path_factory.mktemp("logs")
    changes = (
        {},
        {"sensor.seed": 2, "plant.x_a0": [0.0, 2.0]},
        {"sensor.seed": 3, "identifier.method": "least-squares"},
    )
    return [
        cosim.run("academic-noisy", out=folder / f"{i}.mcap", set={**FAST, **change})
        for i, change in enumerate(changes)
    ]


@pytest.mark.slow
def test_a_log_says_what_the_run_said(logs):
    """Parameters, amplitudes, tests and noise are those recorded at its end."""
    found = cosim.identify(logs[0])
    recorded = dict(logs[0].results[IDENTIFICATION]["identifier"])
    recorded.pop("estimate")
    assert recorded.pop("amplitudes") == [list(map(plain, own)) for own in found.amplitudes]
    undetected = recorded.pop("undetected")
    assert [own["half_widths"] for own in undetected] == [
        dict(own.half_widths) for own in found.undetected
    ]
    assert found.assessment.to_dict() == recorded


def test_the_data_are_what_the_observer_took_in(logs):
    """At every communication point, with the known factors there."""
    record = identifier_record(logs[0], "identifier")
    assert record.identifier == "identifier"
    np.testing.assert_array_equal(record.data.y[:, 0], logs[0]["sensor.y"])
    np.testing.assert_array_equal(record.data.u[:, 0], logs[0]["u.y"])
    t = logs[0].time("sensor")
    np.testing.assert_allclose(record.data.alpha[:, 0], 1.35 + 0.25 * np.sin(1.7 * t), rtol=1e-15)
    assert record.data.held is not None
    assert not record.data.held.any()


@pytest.mark.parametrize(
    ("scenario", "options", "closed"),
    [
        ("closed-loop", {}, True),
        ("academic", {"identifier.closed_loop": True}, True),
        ("academic", {}, False),
    ],
)
@pytest.mark.usefixtures("without_verdicts")
def test_the_data_say_which_inputs_carry_the_noise_of_y(scenario, options, closed):
    """By the connections, or as the identifier states of a recording."""
    memory = cosim.run(scenario, set={"scenario.stop": 1.0, **options})
    assert identifier_record(memory).data.is_in_feedback.tolist() == [closed]


@pytest.mark.slow
def test_several_logs_are_one_fit(logs):
    """Two of equal information halve the variance; amplitudes and x(0) are their own.

    They may be opened or paths, one or several.
    """
    one = cosim.identify(logs[0].path)
    assert [record.log.label for record in one.records] == [logs[0].label]
    assert len(one.smoothed().t) == len(one.records[0].data.t)
    both = cosim.identify(logs[:2])
    fit = both.assessment.fit
    by_path = cosim.identify([str(log.path) for log in logs[:2]])
    np.testing.assert_array_equal(by_path.assessment.fit.theta, fit.theta)
    ratio = fit.standard_error / one.assessment.fit.standard_error
    np.testing.assert_allclose(ratio, np.sqrt(0.5), rtol=0.05)
    np.testing.assert_allclose(np.array(fit.x0), [[1.0, -1.0], [0.0, 2.0]], atol=5e-3)
    assert (np.abs(fit.theta - [-0.1, -0.3]) < both.assessment.half_width).all()


def test_the_log_of_another_method_is_identified_by_output_error(logs):
    """Least squares was wrong in it, and is said to be; its theta is no start.

    It has no key for an offset: what is offered is the option that there is.
    """
    recorded = logs[2].results[IDENTIFICATION]["identifier"]
    assert [one["verdict"] for one in recorded["parameters"]] == ["IDENTIFIABLE"] * 2
    assert [one["verdict"] for one in recorded["estimate"]] == ["INCONSISTENT"] * 2
    assert "biased" in recorded["estimate"][0]["reason"]
    found = cosim.identify(logs[2])
    assert found.records[0].estimate is None
    np.testing.assert_allclose(found.assessment.fit.theta, [-0.1, -0.3], atol=1e-3)
    offered = []
    for log in (logs[0], logs[2]):
        told = log.results[IDENTIFICATION]["identifier"]["undetected"]
        offered += [one["remedy"] for one in told if one["error"] == "a constant on y"]
    assert offered == ["`offset = true`", "`cosim identify --offset`"]


def test_options_are_those_of_the_fit(logs):
    """An offset is one more unknown, and then no undetected error; equal bounds fix a theta."""
    plain = cosim.identify(logs[0])
    offset = cosim.identify(logs[0], offset=True)
    assert offset.assessment.fit.freedom == plain.assessment.fit.freedom - 1
    assert "a constant on y" not in [one.error for one in offset.undetected]
    fixed = cosim.identify(logs[0], bounds={0: (-0.1, -0.1)})
    assert fixed.assessment.fit.theta[0] == -0.1
    assert fixed.assessment.fit.freedom == plain.assessment.fit.freedom + 1
    listed = cosim.identify(logs[0], bounds=[[-0.1, -0.1], (-np.inf, np.inf)])
    np.testing.assert_array_equal(listed.assessment.fit.theta, fixed.assessment.fit.theta)


NO_BOUNDS = [
    ([[-1, 0]], r"expected \[lower, upper\] for each of the 2 parameters"),
    (3, r"bounds: expected \[lower, upper\]"),
    ({2: (0.0, 1.0)}, r"bounds: no theta\[2\]; there are 2 parameters"),
    ({0: 1.0}, r"bounds of theta\[0\]: expected two numbers, \[lower, upper\]"),
    ({0: (1.0, 0.0)}, r"bounds of theta\[0\]: expected lower <= upper"),
]


def test_bounds_that_are_none_are_refused(logs):
    """As rows or by index, with the same messages as in a scenario."""
    check_refused(NO_BOUNDS, lambda bounds: cosim.identify(logs[0], bounds=bounds))


def test_anything_but_a_log_is_refused(logs):
    """Alone, beside a log, none at all, and as the number of a log that the fit does not have."""
    for given in (3, [logs[0], None]):
        with pytest.raises(UsageError, match=r"logs: expected a path.*got (3|None)"):
            cosim.identify(given)
    with pytest.raises(UsageError, match="logs: expected at least one"):
        cosim.identify([])
    with pytest.raises(UsageError, match=r"index: expected 0 to 0.*got -1"):
        cosim.identify(logs[0]).smoothed(-1)


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    """Return a short log of a plant with another A, without verdicts."""
    settings = {**FAST, "scenario.stop": 10.0, "scenario.verdicts": False}
    settings["models.academic.A"] = [[0, 1, 1], [0, -3, 1], [1, 0, 1]]
    path = tmp_path_factory.mktemp("other") / "a.mcap"
    return cosim.run("academic-noisy", out=path, set=settings)


def test_logs_of_other_models_are_refused(logs, other):
    """They would share a theta that is not one; nor do they validate, nor does a log itself."""
    with pytest.raises(UsageError, match=r"a\.mcap: the design models differ in A;"):
        cosim.identify([logs[0], other])
    found = cosim.identify(logs[0])
    for log, words in (
        (other, r"a\.mcap: the design models differ in A;"),
        (logs[0], "the rows of"),
    ):
        with pytest.raises(UsageError, match=words):
            found.validate(identifier_record(log))


def test_an_identifier_that_is_not_there_is_refused(logs):
    """Of a wrong name what there is; of none what is needed."""
    with pytest.raises(UsageError, match="no identifier 'identifer' with a model of y; did you"):
        identifier_record(logs[0], "identifer")
    with pytest.raises(UsageError, match="expected an identifier with a model of y, got none"):
        identifier_record(cosim.run("pair", stop=0.1))


@pytest.mark.usefixtures("without_verdicts")
def test_a_partial_log_says_that_it_is_one():
    """It has an identifier, but not what that needs."""
    patterns = r"'observer': .*recorded with \[record\] signals = \[\"plant\.\*\"\]"
    cases = [
        ({"record.every": 7}, r"recorded with \[record\] every = 7\); available: u\.y, "),
        ({"record.signals": ["plant.*"]}, patterns),
    ]

    def act(record):
        identifier_record(cosim.run("academic", set={"scenario.stop": 1.0, **record}))

    check_refused(cases, act, CosimError)


@pytest.mark.slow
def test_a_run_in_memory_is_identified_like_its_log(tmp_path):
    """The same numbers, to the last bit; and its samples do not count twice either."""
    settings = {"scenario.step": 0.02, "observer.filter_rate": 50.0, "scenario.stop": 20.0}
    memory = cosim.run("academic-noisy", set=settings)
    log = cosim.run("academic-noisy", set=settings, out=tmp_path / "log.mcap")
    found = [cosim.identify(run).assessment.to_dict() for run in (memory, log)]
    assert found[0] == found[1]
    for other in (memory, log):
        with pytest.raises(UsageError, match="has the rows of the run"):
            cosim.identify([memory, other])


@pytest.mark.slow
def test_a_weak_parameter_has_its_advice_in_the_run_and_from_the_log(tmp_path):
    """What would supply the missing direction stands in both."""
    settings = {"scenario.step": 0.02, "observer.filter_rate": 50.0, "sensor.noise": 0.15}
    settings["sensor.seed"] = 2  # of the first one another optimum explains the data, too
    log = cosim.run("academic-noisy", set=settings, out=tmp_path / "log.mcap")
    reason = log.results[IDENTIFICATION]["identifier"]["parameters"][1]["reason"]
    assert re.search(r"a disturbance \d times larger over the noise \[", reason)
    assert "data of any length [" in reason.partition("would supply it, ")[2]
    assert cosim.identify(log).assessment.parameters[1].reason == reason
