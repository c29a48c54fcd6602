"""The largest step that keeps tolerances, and what is said where there is none."""

import numpy as np
import pytest

import cosim
from cosim.cli import main
from cosim.errors import RunError, UnknownSignalError, UsageError
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
    scenario = certified.parsed("""
        [components]
        ramp = { kind = "ramp", slope = 1.0 }
        meter = { kind = "sensor", delay = 0.05 }

        [connections]
        "meter.u" = "ramp.y"
        """)
    log = cosim.run(scenario, find_step={"meter.y": 1.0})
    assert log.step_ns == 50_000_000


def test_several_tolerances_are_kept_together():
    scenario = certified.parsed(certified.SPRING)
    log = cosim.run(scenario, find_step={"mass.y": 0.02, "speed.y": 1.0})
    found = cosim.certificate(log)
    assert found["mass.y"].largest <= 0.02
    assert found["speed.y"].largest <= 1.0
    t = log.time("mass")
    assert np.abs(log["mass.y"] - np.cos(2.0 * t)).max() <= 1.1 * 0.02


def test_an_exact_signal_takes_the_largest_step():
    """Of an output that no run changes: any step is fine, and leaves 16 points."""
    log = cosim.run(certified.parsed(certified.EXACT), find_step={"third.y": 1e-6})
    assert log.step_ns == 250_000_000


def test_a_step_that_is_given_beside_is_refused(tmp_path, capsys):
    """One of both would be ignored; that of the file is only where the search begins."""
    path = write(tmp_path, certified.EXACT)
    tolerances = {"third.y": 1e-6}
    edits = {"scenario.step": 0.1}
    for scenario, set_ in ((path, edits), (cosim.load(path).set(edits), {})):
        with pytest.raises(UsageError) as raised:
            cosim.run(scenario, find_step=tolerances, set=set_)
        assert "find_step or set['scenario.step'], got both" in str(raised.value)
    command = ["run", str(path), "--find-step", "third.y=1e-6"]
    for given in (["--step", "0.1"], ["--set", "scenario.step=0.1"]):
        with pytest.raises(SystemExit) as left:
            main([*command, *given])
        assert left.value.code == 2
        name = given[0] if given[0] == "--step" else "--set scenario.step"
        err = capsys.readouterr().err
        assert "--find-step" in err
        assert name in err
        assert err.count("\n") == 1


# --- where the confident sentence would be false ---


def test_a_search_ends_where_no_step_has_an_estimate(tmp_path):
    """The point of a condition depends on every step: none below the scenario's own is tried."""
    text = """
    [components]
    sine = { kind = "sine", rate = 1.0 }
    lag = { kind = "lag", time_constant = 0.5, initial = 0.0 }

    [connections]
    "lag.u" = "sine.y"

    [[actions]]
    when = "sine.y > 0.5"
    signal = "lag.u"
    override = 0.3
    """
    path = write(tmp_path, text)
    with pytest.raises(RunError) as caught:
        cosim.run(path, find_step={"lag.y": 1e-3})
    assert str(caught.value).endswith(
        "down to 0.0078125 s: no estimate of lag.y: the action when 'sine.y > 0.5' takes effect "
        "at a point that depends on the step, whatever the step; use an action at a fixed time, "
        "or another signal"
    )


def test_an_unstable_coupling_is_no_success(tmp_path, monkeypatch):
    """It multiplies by -1.02 a step: with every halving it grows, until it leaves all bounds."""
    monkeypatch.setattr(step_search, "MOST_STEPS", 10**4)
    path = write(tmp_path, certified.ECHO)
    with pytest.raises(
        RunError, match=r"find_step: no step achieves echo.y 0.1; tried \d+, down"
    ) as e:
        cosim.run(path, find_step={"echo.y": 0.1})
    assert "the error grows as the step is halved: the coupling is unstable" in str(e.value)


def test_a_jump_between_points_has_no_step(tmp_path, monkeypatch):
    monkeypatch.setattr(step_search, "MOST_STEPS", 10**4)
    path = write(tmp_path, lag_behind(("Jump", 1.00001)))
    with pytest.raises(RunError, match=r"no estimate of lag\.y: source\.y jumps"):
        cosim.run(path, find_step={"lag.y": 1e-12})


def test_differences_of_rounding_keep_a_larger_tolerance():
    """The exact lag has the same values with every step, but for rounding: the largest will do."""
    log = cosim.run(certified.parsed(certified.EXACT), find_step={"lag.y": 1e-12})
    assert log.step_ns == 250_000_000
    assert cosim.certificate(log)["lag.y"].is_rounding


def test_rounding_ends_the_search():
    with pytest.raises(
        RunError, match=r"tried 1, down to 0.25 s: no estimate of lag.y: .*rounding"
    ):
        cosim.run(certified.parsed(certified.EXACT), find_step={"lag.y": 1e-20})


# --- wrong use ---


def test_a_tolerance_is_a_positive_number(subtests):
    for tolerance in [0.0, -1e-3, float("nan"), float("inf"), True, "1e-3"]:
        with subtests.test(tolerance=tolerance):
            match = r"find_step\['lag.y'\]: expected a positive number in the unit of the signal"
            with pytest.raises(UsageError, match=match):
                cosim.run(certified.parsed(certified.EXACT), find_step={"lag.y": tolerance})


def test_an_unknown_signal_is_named():
    match = r"find_step\['lag.x'\]: the scenario has no 'lag.x'.*available: u, y"
    with pytest.raises(UsageError, match=match):
        cosim.run(certified.parsed(certified.EXACT), find_step={"lag.x": 1.0})
    assert not issubclass(UsageError, UnknownSignalError)


def test_tolerances_are_a_mapping_that_is_not_empty():
    with pytest.raises(UsageError, match=r"find_step: .*mapping.* got 1\.0$"):
        cosim.run(certified.parsed(certified.EXACT), find_step=1.0)
    with pytest.raises(UsageError, match="find_step: expected at least one signal"):
        cosim.run(certified.parsed(certified.EXACT), find_step={})


def test_noise_of_every_step_is_refused():
    with pytest.raises(UsageError, match="step error: sensor draws random numbers"):
        cosim.run("academic-noisy", find_step={"observer.x_a": 1.0})
