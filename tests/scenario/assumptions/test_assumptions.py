"""`cosim check SCENARIO`: every assumption with what decides it, also where one fails."""

import json
import re
from contextlib import ExitStack

import numpy as np
import pytest

import cosim
from cosim.errors import CosimError
from cosim.report.tables.console import print_shown
from cosim.report.tables.preparation import show_assumptions
from cosim.report.verification import verify
from cosim.scenario.assumptions import method
from cosim.scenario.assumptions.report import BEGINNING, FILE, FILTER, RESOLUTION, check_assumptions
from cosim.scenario.building.build import Builder
from cosim.scenario.running.execution import load
from cosim.theory.observers.assumptions import DECOUPLING, DETECTABILITY, HURWITZ, INDEX

BOTH = ["1.35 + 0.25*sin(1.7*t)", "1.10 + 0.20*cos(2.3*t)"]
COARSE = {"scenario.step": 0.01}


def failing(report):
    """Return what is not fulfilled, as (subject, name)."""
    return [(name, one.name) for name, one in report.verdicts if one.fulfilled is False]


@pytest.mark.parametrize("name", ["academic-noisy", "closed-loop"])
def test_shipped_scenarios_fulfill_their_assumptions(name):
    report = check_assumptions(name)
    assert report.fulfilled
    assert all(one.fulfilled for _, one in report.verdicts)


def test_the_numbers_of_the_example_are_known():
    """Its zero, the eigenvalues of its observer, T_id (36)-(38), the class."""
    report = check_assumptions("academic")
    assert report.of("models.academic")[INDEX].values["condition_of_A22"] == pytest.approx(1.0)
    assert report.of("observer")[DETECTABILITY].values["zeros"] == pytest.approx([-2.0])
    eigenvalues = report.of("observer")[HURWITZ].values["eigenvalues"]
    assert sorted(eigenvalues) == pytest.approx([-4.0, -2.0])
    start = report.of("identifier")[method.START].values
    # (36)-(38): ln(1000)/2 + ln(1000)/1000 + 3
    assert start["T_id"] == pytest.approx(np.log(1e3) / 2.0 + np.log(1e3) / 1e3 + 3.0)
    assert report.of("regressor")[method.CLASS].values == {
        "basis_functions": 2,
        "groups": 2,
        "terms": 6,
    }


def test_the_excitation_is_that_of_the_exact_disturbance():
    """As printed: its smallest eigenvalue 1.70e-3, by 40-digit arithmetic; the prior outweighs."""
    settings = {"identifier.method": "least-squares"}
    without = check_assumptions("academic", set=settings)
    assert without.of("identifier")[method.EXCITATION].values["smallest"] == pytest.approx(
        1.7e-3, rel=0.01
    )
    report = check_assumptions("academic-as-printed")
    assert failing(report) == [("identifier", method.EXCITATION)]
    assert report.of("identifier")[method.EXCITATION].cure == "raise P0 or leave it out"


@pytest.mark.slow
def test_output_error_needs_a_disturbance_that_determines_theta_and_no_regression():
    """Six functions under three alphas have 630 terms of (25), which output error is without.

    A method of the regression is refused; of an expansion that there is not nothing is said.
    """
    unknown = [{"family": "t-exponential", "alpha": alpha} for alpha in BOTH]
    unknown.append({"family": "ramp"})
    terms = [one | {"level": 1.0, "slope": 0.5} for one in unknown]
    terms[0]["theta"], terms[1]["theta"] = -0.2, -0.4
    many = {
        "regressor.delays": [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5],
        "delta.terms": terms,
        "regressor.terms": unknown,
        "truth.identifier.theta": [-0.2, -0.4],
    }
    report = check_assumptions("academic", set=many)
    assert report.fulfilled
    assert "the disturbance determines theta" in report.of("identifier")[method.EXCITATION].evidence
    absent = {"delta.terms": [dict(terms[0], level=0.0, slope=0.0), *terms[1:]]}
    assert failing(check_assumptions("academic", set=many | absent)) == [
        ("identifier", method.EXCITATION)
    ]
    report = check_assumptions("academic", set=many | {"identifier.method": "rayleigh"})
    assert failing(report) == [("identifier", method.METHOD)]
    assert report.of("identifier")[method.EXCITATION].fulfilled is None


def amplitudes(of_second):
    """Return the terms of the example with another amplitude of its second component."""
    first = {"alpha": BOTH[0], "family": "exponential", "theta": -0.1}
    second = {"alpha": BOTH[1], "family": "exponential", "theta": -0.3, "amplitude": of_second}
    return [first, second]


def sine(rate, delays=(1.0, 2.0, 3.0)):
    """Return a disturbance that aliases where its delays are too far apart."""
    terms = [{"family": "sine", "theta": rate}]
    own = {"regressor.terms": SINE, "regressor.delays": list(delays)}
    return own | {"delta.terms": terms, "truth.identifier.theta": [rate]}


SINE = [{"family": "sine"}]
A = "models.academic.A"
UNSTABLE_ZERO = {A: [[0, 1, 1], [0, 2, 1], [1, 0, 1]]}
INTEGRATORS = {"models.academic.Bd": [[0], [1], [0]]}
INDEX_2 = {A: [[0, 1, 1], [0, -2, 1], [1, 0, 0]]}
ALIKE = [{"alpha": alpha, "family": "exponential"} for alpha in ("1 + t", "2 + 2*t")]
NO_FORMULA = {
    "identifier.method": "least-squares",
    "regressor.delays": [1.0, 2.0, 3.5],
    "regressor.terms": SINE,
}
CHIRP = {"regressor.terms": [{"family": "chirp"}], "regressor.delays": [0.0, 1.0]}
RAYLEIGH = {"identifier.method": "rayleigh"}


@pytest.mark.parametrize(
    ("settings", "subject", "assumption", "verdict"),
    [
        (UNSTABLE_ZERO, "observer", DETECTABILITY, "NOT_DETECTABLE"),
        ({A: [[0, 1, 1], [0, -2, 1], [1, 0, 1]]}, "", "", ""),  # a zero at -2, the other side
        ({"observer.L": [0.0, 0.0]}, "observer", HURWITZ, ""),
        (INTEGRATORS, "observer", DECOUPLING, "RELATIVE_DEGREE"),
        (INDEX_2, "models.academic", INDEX, "INDEX_2"),
        ({"regressor.delays": [1.0, 2.0, 2.0]}, "regressor", method.DELAYS, ""),
        ({"regressor.delays": [1.0, 2.0]}, "regressor", method.DELAYS, ""),
        ({"regressor.delays": [1.0, 2.0, 3.005]}, "regressor", method.DELAYS, ""),
        ({"regressor.terms": ALIKE}, "regressor", method.ALPHAS, ""),
        (CHIRP, "regressor", method.CLASS, ""),
        ({"scenario.stop": 6.0}, "identifier", method.START, ""),
        ({"scenario.stop": 7.0}, "", "", ""),
        ({"scenario.step": 0.5, "identifier.period": 0.5}, "identifier", method.STEP, ""),
        (NO_FORMULA, "identifier", method.METHOD, ""),
        (sine(3.1), "", "", ""),
        (sine(3.2), "regressor", method.DELAYS, ""),  # pi / 1 s, the delays' distance
        (sine(6.1, [0.0, 1.0, 2.5]), "", "", ""),  # of 1 and 1.5 s: pi / 0.5 s
        ({"delta.terms": amplitudes(0.0)}, "identifier", method.EXCITATION, ""),
        ({"delta.terms": amplitudes(0.0)} | RAYLEIGH, "identifier", method.EXCITATION, ""),
        ({"delta.terms": amplitudes(1e-3)}, "", "", ""),
    ],
)
def test_each_assumption_fails_alone_with_its_number_and_cure(
    settings, subject, assumption, verdict
):
    """What fails, first of all; neighbors on the other side of a border do not."""
    report = check_assumptions("academic", set={**COARSE, **settings})
    assert report.fulfilled is (not subject)
    if subject:
        assert failing(report)[0] == (subject, assumption)
        one = report.of(subject)[assumption]
        assert one.verdict == verdict
        assert len(one.evidence) > 20
        assert one.cure or "expected" in one.evidence or ";" in one.evidence


def test_a_step_is_judged_by_the_alphas_that_are_known_before_the_run():
    """Where all are signals that only the run computes, nothing is said of 1 %."""
    for alphas, evidence in (
        (BOTH, "over a step of 0.01 s linear interpolation of .*, .* is within 1 %"),
        ([{"from": "plant.x_a[0]"}, {"from": "plant.x_a[1]"}], "the alphas are signals of the run"),
        ([{"from": "plant.x_a[0]"}, BOTH[1]], "linear interpolation of [^,]* is within 1 %"),
    ):
        terms = [{"family": "exponential", "alpha": alpha} for alpha in alphas]
        report = check_assumptions("academic", set={**COARSE, "regressor.terms": terms})
        step = report.of("identifier")[method.STEP]
        assert step.fulfilled
        assert re.search(evidence, step.evidence)
        assert step.values == {"step": 0.01}


def test_matrices_that_do_not_fit_leave_the_rest_open():
    """The regressor is judged all the same; nothing that rests on the model counts as fulfilled."""
    report = check_assumptions("academic", set={**COARSE, "models.academic.C": [[2, 0]]})
    assert failing(report) == [("models.academic", "matrices")]
    assert "got (1, 2)" in report.of("models.academic")["matrices"].evidence
    assert {one.fulfilled for one in report.of("observer").values()} == {None}
    assert report.of("identifier")[method.METHOD].fulfilled is None
    assert report.of("regressor")[method.DELAYS].fulfilled


def test_numbers_out_of_range_are_no_verdict_on_the_zeros():
    """A plant that cannot be computed with is not called undetectable."""
    report = check_assumptions("academic", set={A: [[1e300, 1e300, 1], [0, -2, 1], [1, 0, 1]]})
    assert all(one.verdict == "" for _, one in report.verdicts)
    assert "choose other units" in report.of("observer")[DECOUPLING].evidence


@pytest.mark.usefixtures("in_this_process")
def test_the_command_exits_with_1_where_one_fails(call):
    """A line for each; the same as JSON; --strict is of FMUs alone."""
    code, out, _ = call("check", "academic")
    assert (code, "academic: 15 of 15 assumptions are fulfilled" in out) == (0, True)
    assert "observer\tdecoupling (Assumption 5)\tfulfilled\tan integrator leads from 1" in out
    changed = ["--set", "models.academic.Bd=[[0],[1],[0]]"]
    assert "NOT FULFILLED: RELATIVE_DEGREE" in call("check", "academic", *changed)[1]
    code, out, _ = call("check", "academic", *changed, "--json")
    content = json.loads(out)
    assert (code, content["fulfilled"]) == (1, False)
    assert [one["verdict"] for one in content["assumptions"]].count("RELATIVE_DEGREE") == 1
    assert call("check", "academic", "--strict")[0] == 2


# --- the beginning of a run ---

PARTS = """
scenario = {{ name = "parts", stop = 1.0, step = 0.1 }}
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


@pytest.mark.parametrize(
    ("changes", "place"), [(LOOP, BEGINNING), (JUMPING, "components.d"), (OVERFLOW, BEGINNING)]
)
def test_the_check_refuses_whatever_a_run_refuses_before_its_first_step(tmp_path, changes, place):
    """Also where it shows only in the graph, or as components are initialized."""
    path = tmp_path / "parts.toml"
    path.write_text(PARTS.format(**changes))
    report = check_assumptions(path)
    assert not report.fulfilled
    found = report.of(FILE)
    assert list(found) == [place]
    with pytest.raises(CosimError) as caught:
        cosim.run(path)
    assert found[place].evidence in str(caught.value)


STIFF = """
scenario = { name = "stiff", stop = 0.1, step = 0.01 }
models.stiff = { E = EE, A = [[-1.0, 0.5], [0.2, -2.0]], Bu = [[1.0], [0.0]], C = [[1.0, 0.0]] }
[components]
plant = { kind = "descriptor", model = "stiff", x0 = [0.0, 0.0] }
u = { kind = "constant", value = 1.0 }
[connections]
"plant.u" = "u.y"
"""


def test_a_model_that_is_not_known_well_is_said_by_check_and_run(tmp_path, capsys):
    """E = Q diag(1, 1e-9) Q': what is left of its second equation rests on nine digits less."""
    Q = np.array([[0.8, -0.6], [0.6, 0.8]])
    E = (Q * [1.0, 1e-9] @ Q.T).tolist()
    path = tmp_path / "stiff.toml"
    path.write_text(STIFF.replace("EE", str(E)))
    words = "the reduced system is known only up to"
    report = check_assumptions(path)
    index = report.of("models.stiff")[INDEX]
    assert index.fulfilled
    assert words in index.evidence
    with ExitStack() as resources:
        warnings = Builder(load(path), resources).experiment().built.warnings
    assert any(name == "plant" and words in text for name, text in warnings)
    assert list(report.warnings) == warnings
    print_shown(show_assumptions(report), as_json=False)
    assert f"warning: plant: {words}" in capsys.readouterr().err


# --- whether the step resolves the model ---

FAST = """
scenario = {{ name = "fast", stop = 3.0, step = 0.01 }}
[components]
u = {{ kind = "step", time = 1.0, after = 1.0 }}
f = {{ kind = "lag", time_constant = 0.00333 }}
g = {{ kind = "expression", y = "{}" }}
c = {{ kind = "lag", time_constant = 0.02 }}
[connections]
"f.u" = "u.y"
"c.u" = "g.y"
"""


def test_a_step_that_does_not_resolve_the_model_is_told_by_check_run_and_replay(tmp_path):
    """The error is that against a run with a twentieth of the step, and the cure removes it."""
    path = tmp_path / "fast.toml"
    path.write_text(FAST.format("2*f.y"))
    row = check_assumptions(path).of(FILE)[RESOLUTION]
    assert row.fulfilled is False
    assert row.values["fastest_rate"] == pytest.approx(1.0 / 0.00333)
    log = cosim.run(path, out=tmp_path / "a.mcap")
    fine = cosim.run(path, set={"scenario.step": 5e-4})["c.y"][::20]
    error = np.abs(log["c.y"] - fine).max() / np.abs(fine).max()
    assert error > 0.01
    assert row.values["error"] == pytest.approx(error, rel=0.2)
    (warning,) = log.warnings
    assert (warning.source, warning.text) == ("scenario.step", f"{row.evidence}; {row.cure}")
    with pytest.warns(cosim.CosimWarning, match=r"scenario.step: as recorded at t = 0.0 s: the"):
        replay = cosim.replay(log, out=tmp_path / "b.mcap")
    assert cosim.replay(replay).warnings == replay.warnings  # once
    assert verify(log, replay).passed
    cured = {"scenario.step": float(row.cure.removeprefix("use step = "))}
    assert check_assumptions(path, set=cured).of(FILE)[RESOLUTION].fulfilled
    assert cosim.run(path, set=cured).warnings == []


def test_what_is_not_linear_behind_a_fast_mode_is_not_decided(tmp_path):
    path = tmp_path / "fast.toml"
    path.write_text(FAST.format("f.y**2"))
    row = check_assumptions(path).of(FILE)[RESOLUTION]
    assert row.fulfilled is None
    assert row.evidence.endswith(" in g")


def test_check_does_not_fulfill_what_a_run_warns_not_to_trust():
    """A filter that reads an input that is held; one that does not read it is not warned of."""
    jumping = {"components.u": {"kind": "step", "time": 8.0}}
    report = check_assumptions("academic", set=jumping)
    assert failing(report) == [("observer", FILTER)]
    assert "do not trust delta" in report.of("observer")[FILTER].evidence
    assert report.warnings == ()


# --- compensators ---


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
    assert tuple(rows) == (
        method.FEEDBACK,
        method.ZEROS,
        method.STABILITY,
        method.ACTIVATION,
        method.LIMITS,
    )
    assert all(row.fulfilled for row in rows.values())
    assert rows[method.ZEROS].values["zeros"] == pytest.approx([-5.0])
    assert rows[method.ZEROS].values["distance"] == pytest.approx(5.0)
    s = 1.6j
    amplitude = abs((s**2 + 1.8 * s + 5.0) / (0.8 * s + 4.0))
    lowest, highest = rows[method.LIMITS].values["needed"]
    # the crest of the sine is within half a step of a communication point: 1.6 x 0.005 rad
    assert lowest == pytest.approx([-0.625 - amplitude], abs=amplitude * 0.008**2)
    assert highest == pytest.approx([-0.625 + amplitude], abs=amplitude * 0.008**2)
    # of a 95 % interval about 1.6 within [1.5, 1.7]; 5 % of theta would be 0.08
    allowed = rows[method.ACTIVATION].values["largest_standard_error"]
    assert allowed == pytest.approx([0.1 / 1.96], rel=1e-4)
    assert rows[method.STABILITY].values["decay_rate"] > 0.0
    assert rows[method.STABILITY].values["spectral_radius"] < 1.0
    assert checked.of(FILE)[BEGINNING].fulfilled


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "assumption", "verdict", "is_refused"),
    [
        ({"interval": [[0.0, 50.0]]}, method.STABILITY, "NOT_STABILIZABLE", True),
        ({"scenario.step": 0.1, "Q": [1e6, 1e6, 1e6, 1e6]}, method.STABILITY, "", True),
        ({"regulated": [0, 1]}, method.FEEDBACK, "FEWER_INPUTS_THAN_REGULATED_OUTPUTS", True),
        ({"regulated": [1]}, method.ZEROS, "TRANSMISSION_ZERO", True),
        ({"sensor.noise": 100.0}, method.ACTIVATION, "", False),
        ({"interval": [[1.7, 2.0]]}, method.ACTIVATION, "", False),
        ({"lower": -1.0, "upper": 1.0}, method.LIMITS, "", False),
    ],
)
def test_a_compensator_is_refused_by_the_check_as_by_the_run(
    compensation, settings, assumption, verdict, is_refused
):
    """The row says what the error of the run says, with its name and its cure."""
    changes = {key if "." in key else f"compensator.{key}": settings[key] for key in settings}
    rows = check_assumptions(compensation, set=changes).of("compensator")
    assert [name for name, row in rows.items() if row.fulfilled is False] == [assumption]
    one = rows[assumption]
    assert one.verdict == verdict
    assert one.cure
    if is_refused:
        with pytest.raises(CosimError) as caught:
            cosim.run(compensation, set=changes)
        assert one.evidence in str(caught.value)
        assert one.cure in str(caught.value)


def test_limits_that_suffice_are_said(compensation):
    """With what becomes of the internal model at them."""
    limits = {"lower": -3.0, "upper": 3.0, "anti_windup": False}
    changes = {f"compensator.{key}": value for key, value in limits.items()}
    row = check_assumptions(compensation, set=changes).of("compensator")[method.LIMITS]
    assert row.fulfilled
    assert row.evidence.startswith("limits from -3 to 3; rejecting the disturbance takes u from")
    assert "at a limit the internal model winds up" in row.evidence
