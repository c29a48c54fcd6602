"""Verdicts: intervals that are guaranteed for an irregular part, and the noise of a residual."""

import numpy as np
import pytest
from scipy.signal import lfilter

import cosim
from cosim.scenario.record import IDENTIFICATION
from cosim.scenario.recordings.verdicts import residual_noise
from cosim.theory.bounded import irregular_part
from cosim.theory.bounded.set_membership import FeasibleInterval

FAST = {"scenario.step": 0.02, "observer.filter_rate": 50.0}
# a disturbance that the class does not contain: 0.003 sin(0.9 t) beside its two components
TERMS = [
    {"alpha": "1.35 + 0.25*sin(1.7*t)", "family": "exponential", "theta": -0.1},
    {"alpha": "1.10 + 0.20*cos(2.3*t)", "family": "exponential", "theta": -0.3},
    {"alpha": "sin(0.9*t)", "family": "exponential", "theta": 0.0, "amplitude": 0.003},
]


def verdict(**changes):
    """Run the noisy example; return what is said of its identifier."""
    settings = {**FAST, **{f"identifier.{key}": value for key, value in changes.items()}}
    return cosim.run("academic-noisy", set=settings).results[IDENTIFICATION]["identifier"]


@pytest.fixture
def no_programs(monkeypatch):
    """Forbid linear programs."""

    def forbidden(*arguments):
        raise AssertionError("a linear program was solved")

    monkeypatch.setattr(irregular_part, "feasible_interval", forbidden)


@pytest.mark.usefixtures("no_programs")
def test_a_run_does_not_pay_for_intervals_that_nobody_asked_for():
    """They are off by default, and where the first order holds no linear program is solved."""
    assert "irregular" not in verdict()
    part = verdict(irregular=2e-3)["irregular"]
    assert part["bound"] == 2e-3
    assert part["confidence"] == 0.999
    for effect, true in zip(part["effects"], (-0.1, -0.3), strict=True):
        assert effect["holds"]
        assert effect["lower"] <= true <= effect["upper"]
        assert effect["upper"] - effect["lower"] < 3.0 * effect["first_order"]


def test_beyond_the_first_order_linear_programs_decide(monkeypatch):
    """Both intervals hold, so that what they have in common does."""
    asked = []

    def feasible(problem, recorded, starts, watch):
        asked.append(problem.bound)
        ends = np.array([-0.3, -0.31]), np.array([-0.099, 0.5])
        return FeasibleInterval(*ends, np.zeros((0, 2)))

    monkeypatch.setattr(irregular_part, "feasible_interval", feasible)
    first, second = verdict(irregular=0.02)["irregular"]["effects"]
    assert len(asked) == 1
    assert not second["holds"]
    assert (first["upper"], second["lower"]) == (-0.099, -0.31)
    assert first["lower"] > -0.3
    assert second["upper"] < 0.5


@pytest.mark.slow
@pytest.mark.usefixtures("no_programs")
def test_the_interval_holds_where_that_of_noise_does_not():
    """With an irregular part in the data, as large as its bound, there is no other interval."""
    changes = {**FAST, "delta.terms": TERMS, "identifier.irregular": 0.003}
    results = cosim.run("academic-noisy", set=changes).results
    found = results[IDENTIFICATION]["identifier"]
    effects = found["irregular"]["effects"]
    for parameter, effect, true in zip(found["parameters"], effects, (-0.1, -0.3), strict=True):
        assert parameter["verdict"] == "INCONSISTENT"
        assert parameter["lower"] is None
        assert effect["lower"] <= true <= effect["upper"]


def test_an_interval_without_a_guarantee_is_reported():
    """A theta that is fixed was not estimated; the rest of the verdict stands."""
    found = verdict(irregular=1e-3, bounds=[[-np.inf, np.inf], [-0.3, -0.3]])
    assert found["irregular"]["bound"] == 1e-3
    assert "theta[1] was not estimated" in found["irregular"]["problem"]
    assert found["parameters"][0]["verdict"] == "IDENTIFIABLE"


@pytest.mark.slow
def test_noise_that_is_stated_is_not_taken_from_the_residual():
    """Stated larger than it is it makes wider intervals."""
    plain = verdict(irregular=2e-3)["irregular"]["effects"][0]
    stated = verdict(irregular=2e-3, deviation=1e-3)["irregular"]["effects"][0]
    wide = verdict(irregular=2e-3, deviation=1e-2)["irregular"]["effects"][0]
    widths = [effect["upper"] - effect["lower"] for effect in (plain, stated, wide)]
    assert widths[1] == pytest.approx(widths[0], rel=0.05)
    assert widths[2] > 1.2 * widths[1]


# --- the noise of a residual ---

SAMPLES = 2000


@pytest.mark.parametrize("pause", [0.0, 1.0, 1000.0])
def test_a_pause_in_the_record_hides_no_color(pause):
    """AR(1) has (1 + a)/(1 - a) of its mean power at 0, known to 8 ((1 - a^2)/N)^1/2; four times.

    Also where the samples of the middle of the record, in time, are none.
    """
    noise = lfilter([1.0], [1.0, -0.5], np.random.default_rng(1).standard_normal(SAMPLES))
    t = 0.01 * np.arange(SAMPLES)
    t[SAMPLES // 2 :] += pause
    problem, power, _ = residual_noise(t, noise)
    assert problem == ""
    assert power == pytest.approx(3.0, abs=4.0 * 8.0 * np.sqrt(0.75 / SAMPLES))
