"""The largest step that keeps tolerances, and what is said where there is none."""

import numpy as np
import pytest

import cosim
from cosim.errors import RunError, UsageError
from cosim.scenario.running import step_search
from tests.scenario import certified
from tests.scenario.certified import lag_behind, write


def test_found_step_is_the_largest_that_keeps_the_tolerance(tmp_path):
    """A lag of 0.5 s behind t^2 / 2 from 0: straight lines lag by nothing, and are h^2/12 too high.

    So after the transient y errs by h^2/12, and h = 0.05 s keeps 2.1e-4, the next larger step of
    those that divide 4 s and the delay of 0.8 s, 0.08 s, does not: it errs by 5.3e-4.
    """
    scenario = certified.parsed("""
        [components]
        parabola = { kind = "expression", y = "t**2 / 2" }
        lag = { kind = "lag", time_constant = 0.5, initial = 0.0 }
        delay = { kind = "delay", delay = 0.8 }

        [connections]
        "lag.u" = "parabola.y"
        "delay.u" = "lag.y"
        """)
    log = cosim.run(scenario, find_step={"lag.y": 2.2e-4})
    assert log.step_ns == 50_000_000
    t = log.time("lag")
    exact = t**2 / 2 - 0.5 * t + 0.25 * (1.0 - np.exp(-2.0 * t))
    found = cosim.certificate(log)
    assert found["lag.y"].largest == pytest.approx(np.abs(log["lag.y"] - exact).max(), rel=0.05)
    assert found["lag.y"].largest <= 2.2e-4
    assert found.tolerances == {"lag.y": 2.2e-4}
    failed = {trial.step: trial.failure for trial in found.trials if trial.failure}
    assert "the error of lag.y is 0.000" in failed[0.08]
    assert all(step > 0.05 for step in failed)
    divided = [0.8 / trial.step for trial in found.trials]
    assert divided == pytest.approx(np.round(divided), abs=1e-12)


def test_found_step_divides_the_delay_of_a_sensor():
    """0.25 s would keep the tolerance, and does not divide 0.05 s; 0.05 s does."""
    meter = 'meter = { kind = "sensor", delay = 0.05 }\n    [connections]\n    "meter.u" = "sine.y"'
    scenario = certified.parsed(certified.SMOOTH.replace("[connections]", meter))
    log = cosim.run(scenario, find_step={"meter.y": 1.0})
    assert log.step_ns == 50_000_000


@pytest.mark.slow
def test_several_tolerances_are_kept_together():
    scenario = certified.parsed(certified.SPRING)
    log = cosim.run(scenario, find_step={"mass.y": 0.02, "speed.y": 1.0})
    found = cosim.certificate(log)
    assert found["mass.y"].largest <= 0.02
    assert found["speed.y"].largest <= 1.0
    t = log.time("mass")
    assert np.abs(log["mass.y"] - np.cos(2.0 * t)).max() <= 1.1 * 0.02


@pytest.mark.parametrize(("signal", "tolerance"), [("third.y", 1e-6), ("lag.y", 1e-12)])
def test_an_exact_signal_takes_the_largest_step(signal, tolerance):
    """Of an output that no run changes, but for rounding: the largest leaves 16 points."""
    log = cosim.run(certified.parsed(certified.EXACT), find_step={signal: tolerance})
    assert log.step_ns == 250_000_000
    found = cosim.certificate(log)[signal]
    assert found.largest == 0.0 or found.is_rounding


def test_a_step_that_is_given_beside_is_refused():
    """One of both would be ignored; that of the file is only where the search begins."""
    scenario = certified.parsed(certified.EXACT)
    edits = {"scenario.step": 0.1}
    for edited, set_ in ((scenario, edits), (scenario.set(edits), {})):
        with pytest.raises(UsageError, match=r"find_step or set\['scenario.step'\], got both"):
            cosim.run(edited, find_step={"third.y": 1e-6}, set=set_)


# --- where the confident sentence would be false ---


def test_a_search_ends_where_no_step_has_an_estimate():
    """The point of a condition depends on every step: none below the scenario's own is tried."""
    action = '\n[[actions]]\nwhen = "sine.y > 0.5"\nsignal = "lag.u"\noverride = 0.3\n'
    with pytest.raises(RunError) as caught:
        cosim.run(certified.parsed(certified.SMOOTH + action), find_step={"lag.y": 1e-3})
    assert str(caught.value).endswith(
        "down to 0.0078125 s, achieves lag.y 0.001: no estimate of lag.y: the action when "
        "'sine.y > 0.5' takes effect at a point that depends on the step, whatever the step; use "
        "an action at a fixed time, or another signal"
    )


@pytest.mark.parametrize(
    ("text", "tolerances", "words"),
    [
        # it multiplies by -1.02 a step: with every halving it grows, until it leaves all bounds
        (certified.ECHO, {"echo.y": 0.1}, "echo.y 0.1: .*halved, as with an unstable coupling"),
        (lag_behind(("Jump", 1.00001)), {"lag.y": 1e-12}, r"of lag\.y: source\.y jumps"),
        # smaller steps would show no more than rounding
        (certified.EXACT, {"lag.y": 1e-20}, "lag.y 1e-20: .*rounding"),
    ],
)
def test_no_step_is_no_success(tmp_path, monkeypatch, text, tolerances, words):
    monkeypatch.setattr(step_search, "MOST_STEPS", 10**4)
    with pytest.raises(RunError, match=f"find_step: none of .* achieves .*{words}"):
        cosim.run(write(tmp_path, text), find_step=tolerances)


# --- wrong use ---


@pytest.mark.parametrize(
    ("tolerances", "match"),
    [
        *(
            ({"lag.y": value}, r"find_step\['lag.y'\]: expected a positive number in the unit")
            for value in (0.0, -1e-3, float("nan"), float("inf"), True, "1e-3")
        ),
        ({"lag.x": 1.0}, r"find_step\['lag.x'\]: the scenario has no 'lag.x'.*available: u, y"),
        (1.0, r"find_step: .*mapping.* got 1\.0$"),
        ({}, "find_step: expected at least one signal"),
    ],
)
def test_wrong_tolerances_are_refused(tolerances, match):
    with pytest.raises(UsageError, match=match):
        cosim.run(certified.parsed(certified.EXACT), find_step=tolerances)
