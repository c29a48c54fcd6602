"""`cosim check SCENARIO` and the beginning of a run: a compensator, the graph, initial values."""

from contextlib import ExitStack

import numpy as np
import pytest

import cosim
from cosim.errors import CosimError
from cosim.report.tables.preparation import print_assumptions
from cosim.scenario.assumptions.method import (
    ACTIVATION,
    FEEDBACK,
    LIMITS,
    STABILITY,
    ZEROS,
)
from cosim.scenario.assumptions.report import BEGINNING, FILE, RESOLUTION, check_assumptions
from cosim.scenario.building.build import Builder
from cosim.scenario.running.execution import load
from cosim.theory.observers.assumptions import INDEX

OF_COMPENSATOR = (FEEDBACK, ZEROS, STABILITY, ACTIVATION, LIMITS)


@pytest.fixture(scope="module")
def compensation():
    """Return the shipped scenario, with a shorter interval, which takes less time."""
    return load("compensation").edit(set={"compensator.interval": [[1.5, 1.7]]})


@pytest.fixture(scope="module")
def checked(compensation):
    return check_assumptions(compensation)


def test_the_numbers_of_a_compensator_are_those_of_its_plant(checked):
    """The transfers to the position are (0.8 s + 4) / d of u and (s^2 + 1.8 s + 5) / d of delta.

    So its zero is at -5, 5 1/s from the constant of the disturbance, and u is
    -(s^2 + 1.8 s + 5) / (0.8 s + 4) delta, with delta = 0.5 + sin(1.6 t + 0.5).
    """
    rows = checked.of("compensator")
    assert tuple(rows) == OF_COMPENSATOR
    assert all(rows[name].fulfilled for name in OF_COMPENSATOR)
    assert rows[ZEROS].values["zeros"] == pytest.approx([-5.0])
    assert rows[ZEROS].values["distance"] == pytest.approx(5.0)
    s = 1.6j
    amplitude = abs((s**2 + 1.8 * s + 5.0) / (0.8 * s + 4.0))
    lowest, highest = rows[LIMITS].values["needed"]
    # the crest of the sine is within half a step of a communication point: 1.6 x 0.005 rad
    assert lowest == pytest.approx([-0.625 - amplitude], abs=amplitude * 0.008**2)
    assert highest == pytest.approx([-0.625 + amplitude], abs=amplitude * 0.008**2)
    # of a 95 % interval about 1.6 within [1.5, 1.7]; 5 % of theta would be 0.08
    allowed = rows[ACTIVATION].values["largest_standard_error"]
    assert allowed == pytest.approx([0.1 / 1.96], rel=1e-4)
    assert rows[STABILITY].values["decay_rate"] > 0.0
    assert rows[STABILITY].values["spectral_radius"] < 1.0
    assert checked.of(FILE)[BEGINNING].fulfilled


CASES = {
    "modes alike": ({"compensator.interval": [[0.0, 50.0]]}, STABILITY, "NOT_STABILIZABLE"),
    "a long step for the gain": (
        {"scenario.step": 0.1, "compensator.Q": [1e6, 1e6, 1e6, 1e6]},
        STABILITY,
        "",
    ),
    "much noise": ({"sensor.noise": 100.0}, ACTIVATION, ""),
    "theta elsewhere": ({"compensator.interval": [[1.7, 2.0]]}, ACTIVATION, ""),
    "narrow limits": ({"compensator.lower": -1.0, "compensator.upper": 1.0}, LIMITS, ""),
    "two outputs": (
        {"compensator.regulated": [0, 1]},
        FEEDBACK,
        "FEWER_INPUTS_THAN_REGULATED_OUTPUTS",
    ),
    "a zero at the constant": ({"compensator.regulated": [1]}, ZEROS, "TRANSMISSION_ZERO"),
}
RUNS_ALL_THE_SAME = ("much noise", "theta elsewhere", "narrow limits")


@pytest.mark.slow
def test_a_compensator_is_refused_by_the_check_as_by_the_run(compensation, subtests):
    """The row says what the error of the run says, with its name and its cure."""
    for case, (settings, assumption, verdict) in CASES.items():
        with subtests.test(case=case):
            report = check_assumptions(compensation, set=settings)
            assert not report.fulfilled
            of_compensator = report.of("compensator")
            failing = [name for name, one in of_compensator.items() if one.fulfilled is False]
            assert failing == [assumption]
            one = of_compensator[assumption]
            assert one.verdict == verdict
            assert one.cure
            if case not in RUNS_ALL_THE_SAME:
                with pytest.raises(CosimError) as caught:
                    cosim.run(compensation, set=settings)
                assert one.evidence in str(caught.value)
                assert one.cure in str(caught.value)


def test_limits_that_suffice_are_said(compensation):
    """With what becomes of the internal model at them."""
    settings = {"lower": -3.0, "upper": 3.0, "anti_windup": False}
    changes = {f"compensator.{key}": value for key, value in settings.items()}
    row = check_assumptions(compensation, set=changes).of("compensator")[LIMITS]
    assert row.fulfilled
    assert row.evidence.startswith(
        "limits from -3 to 3; rejecting the disturbance takes u from -1.5"
    )
    assert "at a limit the internal model winds up" in row.evidence


PARTS = """
[scenario]
name = "parts"
stop = 1.0
step = 0.1
[components.a]
{a}
[components.b]
kind = "gain"
K = {K}
[connections]
"b.u" = "a.y"
{more}
"""
CONSTANT = 'kind = "constant"\nvalue = 1e300'
LOOP = {"a": 'kind = "gain"\nK = 0.5', "K": 2.0, "more": '"a.u" = "b.y"'}
JUMPING = {
    "a": 'kind = "step"\ntime = 0.5',
    "K": 1.0,
    "more": '[components.d]\nkind = "disturbance"\n'
    'terms = [{ alpha = { from = "a.y" }, family = "constant", level = 1.0 }]',
}
OVERFLOW = {"a": CONSTANT, "K": 1e300, "more": ""}
BEGINNINGS = {
    "an algebraic loop": (LOOP, BEGINNING),
    "an alpha that jumps": (JUMPING, "components.d"),
    "an initial value that is not finite": (OVERFLOW, BEGINNING),
}


def parts(tmp_path, changes):
    """Return a scenario of two parts as a file."""
    path = tmp_path / "parts.toml"
    path.write_text(PARTS.format(**changes))
    return path


def test_the_check_refuses_whatever_a_run_refuses_before_its_first_step(tmp_path, subtests):
    """Also where it shows only in the graph, or as components are initialized."""
    for case, (changes, place) in BEGINNINGS.items():
        with subtests.test(case=case):
            path = parts(tmp_path, changes)
            report = check_assumptions(path)
            assert not report.fulfilled
            found = report.of(FILE)
            assert list(found) == [place]
            with pytest.raises(CosimError) as caught:
                cosim.run(path)
            assert found[place].evidence in str(caught.value)


def test_a_scenario_without_any_assumption_has_a_beginning(tmp_path):
    """Its parts fit together and have initial values: that is what there is to check."""
    path = parts(tmp_path, {"a": CONSTANT, "K": 1.0, "more": ""})
    report = check_assumptions(path)
    assert report.fulfilled
    assert list(report.of(FILE)) == [BEGINNING, RESOLUTION]
    assert "2 component(s) are prepared for steps of 0.1 s" in report.of(FILE)[BEGINNING].evidence


def test_a_model_that_is_not_known_well_is_said_by_check_and_run(tmp_path, capsys):
    """E = Q diag(1, 1e-9) Q': what is left of its second equation rests on nine digits less."""
    Q = np.array([[0.8, -0.6], [0.6, 0.8]])
    E = (Q * [1.0, 1e-9] @ Q.T).tolist()
    path = tmp_path / "stiff.toml"
    path.write_text(
        '[scenario]\nname = "stiff"\nstop = 0.1\nstep = 0.01\n[models.stiff]\n'
        f"E = {E}\nA = [[-1.0, 0.5], [0.2, -2.0]]\nBu = [[1.0], [0.0]]\nC = [[1.0, 0.0]]\n"
        '[components.plant]\nkind = "descriptor"\nmodel = "stiff"\nx0 = [0.0, 0.0]\n'
        '[components.u]\nkind = "constant"\nvalue = 1.0\n[connections]\n"plant.u" = "u.y"\n'
    )
    words = "the reduced system is known only up to"
    report = check_assumptions(path)
    index = report.of("models.stiff")[INDEX]
    assert index.fulfilled
    assert words in index.evidence
    with ExitStack() as resources:
        warnings = Builder(load(path), resources).experiment().warnings
    assert any(name == "plant" and words in text for name, text in warnings)
    assert report.warnings == warnings
    assert report.to_dict()["warnings"] == [{"of": name, "text": text} for name, text in warnings]
    print_assumptions(report, as_json=False)
    assert f"warning: plant: {words}" in capsys.readouterr().err
