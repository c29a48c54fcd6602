"""`cosim check SCENARIO`: every assumption with what decides it, also where one fails."""

import json

import numpy as np
import pytest
from scipy.linalg import expm

import cosim
from cosim.errors import UsageError
from cosim.report.verification import verify
from cosim.scenario.assumptions.method import ALPHAS, CLASS, DELAYS, EXCITATION, METHOD, START, STEP
from cosim.scenario.assumptions.report import FILTER, RESOLUTION, check_assumptions
from cosim.scenario.exporting import export_component
from cosim.scenario.record import recorded_warnings
from cosim.theory.observers.assumptions import DECOUPLING, DETECTABILITY, HURWITZ, INDEX, PENCIL

BOTH = ["1.35 + 0.25*sin(1.7*t)", "1.10 + 0.20*cos(2.3*t)"]


def failing(report):
    """Return what is not fulfilled, as (subject, name)."""
    return [(name, one.name) for name, one in report.verdicts if one.fulfilled is False]


@pytest.mark.parametrize(
    ("name", "undecided"),
    [
        ("academic-noisy", []),
        ("closed-loop", []),
        # its compensator cannot be linearized
        pytest.param("compensation", ["coupling", RESOLUTION], marks=pytest.mark.campaign),
    ],
)
def test_shipped_scenarios_fulfill_their_assumptions(name, undecided):
    report = check_assumptions(name)
    assert report.fulfilled
    left_open = [one.name for _, one in report.verdicts if one.fulfilled is None]
    assert [name.partition(" of ")[0] for name in left_open] == undecided


def test_the_numbers_of_the_example_are_known():
    """Its zero, the eigenvalues of its observer, T_id (36)-(38), the class."""
    report = check_assumptions("academic")
    assert report.of("models.academic")[INDEX].values["condition_of_A22"] == pytest.approx(1.0)
    assert report.of("observer")[DETECTABILITY].values["zeros"] == pytest.approx([-2.0])
    eigenvalues = report.of("observer")[HURWITZ].values["eigenvalues"]
    assert sorted(eigenvalues) == pytest.approx([-4.0, -2.0])
    start = report.of("identifier")[START].values
    # (36)-(38): ln(1000)/2 + ln(1000)/1000 + 3
    assert start["T_id"] == pytest.approx(np.log(1e3) / 2.0 + np.log(1e3) / 1e3 + 3.0)
    assert report.of("regressor")[CLASS].values == {"basis_functions": 2, "groups": 2, "terms": 6}


def test_the_excitation_is_that_of_the_exact_disturbance():
    """As printed: its smallest eigenvalue 1.70e-3, by 40-digit arithmetic; the prior outweighs."""
    settings = {"identifier.method": "least-squares"}
    without = check_assumptions("academic", set=settings)
    assert without.of("identifier")[EXCITATION].values["smallest"] == pytest.approx(
        1.7e-3, rel=0.01
    )
    report = check_assumptions("academic-as-printed")
    assert failing(report) == [("identifier", EXCITATION)]
    assert report.of("identifier")[EXCITATION].cure == "raise P0 or leave it out"


MANY = {
    "regressor.delays": [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5],
    "delta.terms": [
        {"family": "t-exponential", "theta": -0.2, "level": 1.0, "slope": 0.5, "alpha": BOTH[0]},
        {"family": "t-exponential", "theta": -0.4, "level": 0.5, "slope": 1.0, "alpha": BOTH[1]},
        {"family": "ramp", "level": 1.0, "slope": 0.1},
    ],
    "regressor.terms": [
        {"family": "t-exponential", "alpha": BOTH[0]},
        {"family": "t-exponential", "alpha": BOTH[1]},
        {"family": "ramp"},
    ],
    "truth.identifier.theta": [-0.2, -0.4],
}


@pytest.mark.slow
def test_output_error_needs_a_disturbance_that_determines_theta_and_no_regression():
    """Six functions under three alphas have 630 terms of (25), which output error is without."""
    report = check_assumptions("academic", set=MANY)
    assert report.fulfilled
    assert "the disturbance determines theta" in report.of("identifier")[EXCITATION].evidence
    absent = [dict(MANY["delta.terms"][0], level=0.0, slope=0.0), *MANY["delta.terms"][1:]]
    report = check_assumptions("academic", set=MANY | {"delta.terms": absent})
    assert failing(report) == [("identifier", EXCITATION)]


def test_a_method_that_cannot_do_with_the_terms_leaves_their_excitation_open():
    """The method is refused; of a regression without an expansion (25) nothing is said."""
    report = check_assumptions("academic", set=MANY | {"identifier.method": "rayleigh"})
    assert failing(report) == [("identifier", METHOD)]
    assert report.of("identifier")[EXCITATION].fulfilled is None


COARSE = {"scenario.step": 0.01}
UNSTABLE_ZERO = {"models.academic.A": [[0, 1, 1], [0, 2, 1], [1, 0, 1]]}
CASES = {
    "zero at +2": (UNSTABLE_ZERO, ("observer", DETECTABILITY), "NOT_DETECTABLE"),
    "zero at -2, the other side": (
        {"models.academic.A": [[0, 1, 1], [0, -2, 1], [1, 0, 1]]},
        None,
        "",
    ),
    "no gain": ({"observer.L": [0.0, 0.0]}, ("observer", HURWITZ), ""),
    "two integrators": (
        {"models.academic.Bd": [[0], [1], [0]]},
        ("observer", DECOUPLING),
        "RELATIVE_DEGREE",
    ),
    "A22 = 0": (
        {"models.academic.A": [[0, 1, 1], [0, -2, 1], [1, 0, 0]]},
        ("models.academic", INDEX),
        "INDEX_2",
    ),
    "no equation": (
        {
            "models.academic.A": [[0, 1, 1], [0, -2, 1], [0, 0, 0]],
            "models.academic.Bu": [[0], [2], [0]],
        },
        ("models.academic", PENCIL),
        "PENCIL_SINGULAR",
    ),
    "two disturbances": (
        {"models.academic.Bd": [[1, 0], [0, 1], [0, 0]]},
        ("observer", DECOUPLING),
        "FEWER_OUTPUTS_THAN_DISTURBANCES",
    ),
    "equal delays": ({"regressor.delays": [1.0, 2.0, 2.0]}, ("regressor", DELAYS), ""),
    "two delays": ({"regressor.delays": [1.0, 2.0]}, ("regressor", DELAYS), ""),
    "delays between steps": ({"regressor.delays": [1.0, 2.0, 3.005]}, ("regressor", DELAYS), ""),
    "one alpha twice, scaled": (
        {"regressor.terms": [{"alpha": a, "family": "exponential"} for a in ("1 + t", "2 + 2*t")]},
        ("regressor", ALPHAS),
        "",
    ),
    "chirp": (
        {"regressor.terms": [{"family": "chirp"}], "regressor.delays": [0.0, 1.0]},
        ("regressor", CLASS),
        "",
    ),
    "a run that ends before": ({"scenario.stop": 6.0}, ("identifier", START), ""),
    "a run that ends just behind": ({"scenario.stop": 7.0}, None, ""),
    "a long step": (
        {"scenario.step": 0.5, "identifier.period": 0.5},
        ("identifier", STEP),
        "",
    ),
    "no formula": (
        {
            "identifier.method": "least-squares",
            "regressor.delays": [1.0, 2.0, 3.5],
            "regressor.terms": [{"family": "sine"}],
        },
        ("identifier", METHOD),
        "",
    ),
    "a component without amplitude": (
        {
            "delta.terms": [
                {"alpha": BOTH[0], "family": "exponential", "theta": -0.1},
                {"alpha": BOTH[1], "family": "exponential", "theta": -0.3, "amplitude": 0.0},
            ]
        },
        ("identifier", EXCITATION),
        "",
    ),
    "a component with a small one": (
        {
            "delta.terms": [
                {"alpha": BOTH[0], "family": "exponential", "theta": -0.1},
                {"alpha": BOTH[1], "family": "exponential", "theta": -0.3, "amplitude": 1e-3},
            ]
        },
        None,
        "",
    ),
}


def test_each_assumption_fails_alone_with_its_number_and_cure(subtests):
    """What fails, first of all; neighbors on the other side of a border do not."""
    for case, (settings, first, verdict) in CASES.items():
        with subtests.test(case=case):
            report = check_assumptions("academic", set={**COARSE, **settings})
            if first is None:
                assert report.fulfilled
                continue
            found = failing(report)
            assert found[0] == first
            name, assumption = first
            one = report.of(name)[assumption]
            assert one.verdict == verdict
            assert len(one.evidence) > 20
            assert one.cure or "expected" in one.evidence or ";" in one.evidence


def test_a_sine_aliases_where_its_delays_are_too_far_apart():
    """At 1 s a rate of 3.1 rad/s is its own, 3.2 rad/s that of a slower sine."""
    for rate, fulfilled in ((3.1, True), (3.2, False)):
        settings = {
            **COARSE,
            "regressor.terms": [{"family": "sine"}],
            "delta.terms": [{"family": "sine", "theta": rate}],
        }
        delays = check_assumptions("academic", set=settings).of("regressor")[DELAYS]
        assert delays.fulfilled is fulfilled
        assert delays.values.get("fastest_rate", 3.2) == pytest.approx(rate)
    assert delays.cure == "choose two delays less than 0.982 s apart"


def test_a_step_is_judged_by_the_alphas_that_are_known_before_the_run():
    """Where all are signals that only the run computes, nothing is said of 1 %."""
    for alphas, evidence in (
        (BOTH, "over a step of 0.01 s linear interpolation of every alpha is within 1 %"),
        ([{"from": "plant.x_a[0]"}, {"from": "plant.x_a[1]"}], "the alphas are signals of the run"),
        ([{"from": "plant.x_a[0]"}, BOTH[1]], "within 1 %"),
    ):
        terms = [{"family": "exponential", "alpha": alpha} for alpha in alphas]
        report = check_assumptions("academic", set={**COARSE, "regressor.terms": terms})
        step = report.of("identifier")[STEP]
        assert step.fulfilled
        assert evidence in step.evidence
        assert step.values == {"step": 0.01}


@pytest.mark.parametrize("rate", [3.2, 6.1])
def test_delays_that_are_not_equally_spaced_distinguish_faster_sines(rate):
    """With (0, 1, 2.5) s only a rate above pi / 0.5 s has a slower one with the same chi."""
    delays = np.array([0.0, 1.0, 2.5])

    def chi(omega):
        apart = delays[:, np.newaxis] - delays
        return np.sin(omega * apart[np.triu_indices(3, 1)])

    settings = {
        "regressor.terms": [{"family": "sine"}],
        "regressor.delays": delays.tolist(),
        "delta.terms": [{"family": "sine", "theta": rate}],
    }
    assert check_assumptions("academic", set=settings).of("regressor")[DELAYS].fulfilled
    np.testing.assert_allclose(chi(4.0 * np.pi - rate), -chi(rate), atol=1e-12)
    slower = np.linspace(0.05, 0.98 * rate, 400)
    alike = [abs(chi(one) @ chi(rate)) / np.linalg.norm(chi(one)) for one in slower]
    assert max(alike) < (1.0 - 1e-4) * np.linalg.norm(chi(rate))


def test_all_is_said_that_can_be_said():
    """Of an index of 2 and three other failures all four; what rests on it is not decided."""
    settings = {
        "models.academic.A": [[0, 1, 1], [0, -2, 1], [1, 0, 0]],
        "models.academic.Bd": [[1, 0], [0, 1], [0, 0]],
        "regressor.delays": [1.0, 2.0, 2.0],
    }
    report = check_assumptions("academic", set={**COARSE, **settings})
    found = failing(report)
    for expected in (("models.academic", INDEX), ("observer", DECOUPLING), ("regressor", DELAYS)):
        assert expected in found
    assert report.of("observer")[HURWITZ].fulfilled is None
    assert report.of("regressor")[CLASS].fulfilled


def test_matrices_that_do_not_fit_leave_the_rest_open():
    """The regressor is judged all the same; nothing that rests on the model counts as fulfilled."""
    report = check_assumptions("academic", set={**COARSE, "models.academic.C": [[2, 0]]})
    assert failing(report) == [("models.academic", "matrices")]
    assert "got (1, 2)" in report.of("models.academic")["matrices"].evidence
    assert {one.fulfilled for one in report.of("observer").values()} == {None}
    assert report.of("identifier")[METHOD].fulfilled is None
    assert report.of("regressor")[DELAYS].fulfilled


def test_numbers_out_of_range_are_no_verdict_on_the_zeros():
    """A plant that cannot be computed with is not called undetectable."""
    A = [[1e300, 1e300, 1], [0, -2, 1], [1, 0, 1]]
    report = check_assumptions("academic", set={**COARSE, "models.academic.A": A})
    assert not report.fulfilled
    assert all(one.verdict == "" for _, one in report.verdicts)
    assert ("observer", DECOUPLING) in failing(report)
    assert "choose other units" in report.of("observer")[DECOUPLING].evidence


def test_terms_without_parameters_leave_nothing_to_excite():
    """A constant alone: its amplitude is estimated, theta is empty."""
    settings = {
        "regressor.terms": [{"family": "constant"}],
        "regressor.delays": [0.0, 0.5],
        "delta.terms": [{"family": "constant", "level": 1.0}],
    }
    report = check_assumptions("academic", set=settings)
    assert report.of("identifier")[EXCITATION].fulfilled is None
    assert report.of("identifier")[METHOD].fulfilled


def test_a_failure_is_said_as_the_run_says_it():
    """The error of a run has evidence and cure of the report, one source of both."""
    report = check_assumptions("academic", set=UNSTABLE_ZERO)
    one = report.of("observer")[DETECTABILITY]
    with pytest.raises(UsageError) as caught:
        cosim.run("academic", set=UNSTABLE_ZERO)
    assert f"{one.evidence}; {one.cure}" in str(caught.value)
    (beginning,) = report.of("the scenario").values()
    assert beginning.fulfilled is None


def test_other_problems_of_a_run_are_listed():
    """A sensor without a seed is no assumption, and not lost."""
    report = check_assumptions("academic-noisy", set={"sensor.seed": -1})
    assert not report.fulfilled
    others = report.of("the scenario")
    assert list(others) == ["components.sensor"]


@pytest.mark.usefixtures("in_this_process")
def test_the_command_exits_with_1_where_one_fails(call):
    """A line for each; the same as JSON; --strict is of FMUs alone."""
    code, out, _ = call("check", "academic")
    assert code == 0
    assert "academic: 15 of 15 assumptions are fulfilled" in out
    assert "observer\tdecoupling (Assumption 5)\tfulfilled\tan integrator leads from 1" in out
    changed = ["--set", "models.academic.Bd=[[0],[1],[0]]"]
    code, out, _ = call("check", "academic", *changed)
    assert code == 1
    assert "NOT FULFILLED: RELATIVE_DEGREE" in out
    code, out, _ = call("check", "academic", *changed, "--json")
    content = json.loads(out)
    assert code == 1
    assert content["fulfilled"] is False
    verdicts = [one["verdict"] for one in content["assumptions"]]
    assert verdicts.count("RELATIVE_DEGREE") == 1
    assert call("check", "academic", "--strict")[0] == 2


# --- whether the step resolves the model ---

MOTOR = """
[scenario]
name = "motor"
stop = 0.02
step = 1e-3

[models.motor]  # current, speed, voltage across the resistance of 1.2 ohm
E = [[0.5e-3, 0, 0], [0, 2e-3, 0], [0, 0, 0]]
A = [[0, -0.05, -1], [0.05, -1e-4, 0], [-1.2, 0, 1]]
B = [[1, 0], [0, -1], [0, 0]]
C = [[1, 0, 0], [0, 1, 0]]
disturbances = [1]

[components]
u = { kind = "step", time = 0.01, after = 12.0 }
load = { kind = "constant", value = 0.0 }
plant = { kind = "descriptor", model = "motor", x0 = [0, 0, 0] }

[components.observer]
kind = "unknown-input-observer"
model = "motor"
poles = [-50.0, -60.0]
filter_rate = 100.0

[connections]
"plant.u" = "u.y"
"plant.delta" = "load.y"
"observer.u" = "u.y"
"observer.y" = "plant.y"
"""


@pytest.fixture
def motor(tmp_path):
    """Return a motor whose current follows the voltage within half a millisecond."""
    path = tmp_path / "motor.toml"
    path.write_text(MOTOR)
    return path


def current_error(log):
    """Return the largest error of the estimated current, and the largest current [A]."""
    A = np.array([[-1.2 / 0.5e-3, -0.05 / 0.5e-3], [0.05 / 2e-3, -1e-4 / 2e-3]])
    b = np.array([12.0 / 0.5e-3, 0.0])
    t = np.maximum(log.time("observer.x") - 0.01, 0.0)
    steady = -np.linalg.solve(A, b)
    exact = steady - expm(t[:, np.newaxis, np.newaxis] * A) @ steady
    return np.abs(log["observer.x"][:, 0] - exact[:, 0]).max(), exact[:, 0].max()


@pytest.mark.parametrize(("step", "error"), [(1e-3, 3.97), (1e-4, 0.043)])
def test_a_step_is_fulfilled_where_results_are_within_one_percent(motor, step, error):
    """The estimated current is off by 3.97 A of 10 A at 1 ms, and by 0.043 A at 0.1 ms."""
    changes = {"scenario.step": step}
    log = cosim.run(motor, set=changes)
    found, largest = current_error(log)
    assert found == pytest.approx(error, rel=0.01)
    is_resolved = found <= 0.01 * largest
    row = check_assumptions(motor, set=changes).of("the scenario")[RESOLUTION]
    assert row.fulfilled == is_resolved
    assert f"times the step of {step:g} s is {2400.0 * step:.2g}" in row.evidence
    assert row.values["fastest_rate"] == pytest.approx(2400.0, rel=0.01)
    texts = [text for name, text in recorded_warnings(log) if name == "scenario.step"]
    assert texts == ([] if is_resolved else [f"{row.evidence}; {row.cure}"])


def test_a_replay_keeps_the_warnings_of_what_it_takes_over(motor, tmp_path):
    """As recorded, once, also where it is replayed again; and verification agrees."""
    log = cosim.run(motor, out=tmp_path / "a.mcap")
    (recorded,) = log.warnings
    with pytest.warns(cosim.CosimWarning, match=r"scenario.step: as recorded at t = 0.0 s: the"):
        replay = cosim.replay(log, out=tmp_path / "b.mcap")
    (kept,) = replay.warnings
    assert kept.source == recorded.source
    assert kept.text == f"as recorded at t = 0.0 s: {recorded.text}"
    again = cosim.replay(replay)
    assert again.warnings == replay.warnings
    assert verify(log, replay).passed
    assert verify(replay, again).passed


def test_the_cure_of_a_step_is_one_that_resolves_the_model(motor):
    row = check_assumptions(motor).of("the scenario")[RESOLUTION]
    step = float(row.cure.removeprefix("use step = "))
    error, largest = current_error(cosim.run(motor, set={"scenario.step": step}))
    assert error <= 0.01 * largest


@pytest.mark.slow
@pytest.mark.parametrize("interface_type", ["me", "cs"])
def test_the_modes_of_an_fmu_count_as_those_of_its_source(motor, tmp_path, interface_type):
    """The run is that of the model itself, to the tolerance of its solver."""
    export_component(str(motor), "plant", tmp_path / "plant.fmu")
    fmu = {"kind": "fmu", "path": "plant.fmu", "interface_type": interface_type}
    swapped = {"components.plant": fmu}
    row = check_assumptions(motor, set=swapped).of("the scenario")[RESOLUTION]
    assert row.fulfilled is False
    log = cosim.run(motor, set=swapped)
    error, _ = current_error(log)
    assert error == pytest.approx(3.97, rel=0.01)
    texts = [text for name, text in recorded_warnings(log) if name == "scenario.step"]
    assert texts == [f"{row.evidence}; {row.cure}"]


SLOW_PLANT = """
[scenario]
name = "slow"
stop = 3.0
step = 0.01

[models.m]
E = [[1, 0], [0, 1]]
A = [[-1, 0.5], [0.2, -2]]
B = [[0, 1], [1, 0]]
C = [[1, 0]]
disturbances = [1]

[components]
u = { kind = "step", time = 1.0, after = 1.0 }
d = { kind = "constant", value = 0.0 }
plant = { kind = "descriptor", model = "m", x0 = [0, 0] }
observer = { kind = "unknown-input-observer", model = "m", poles = [-3.0], filter_rate = 100.0 }

[connections]
"plant.u" = "u.y"
"plant.delta" = "d.y"
"observer.u" = "u.y"
"observer.y" = "plant.y"
"""


def test_a_filter_that_differentiates_counts_as_a_mode(tmp_path):
    """The plant is slow: 2.1 1/s. Against a run with a twentieth of the step."""
    path = tmp_path / "slow.toml"
    path.write_text(SLOW_PLANT)
    coarse = cosim.run(path)["observer.delta"]
    fine = cosim.run(path, set={"scenario.step": 5e-4})["observer.delta"][::20]
    row = check_assumptions(path).of("the scenario")[RESOLUTION]
    assert row.fulfilled is False
    assert "observer.delta is off by" in row.evidence
    error = np.abs(coarse - fine).max() / np.abs(fine).max()
    assert row.values["error"] == pytest.approx(error, rel=0.2)


def test_what_is_not_linear_behind_a_fast_mode_is_not_decided(tmp_path):
    path = tmp_path / "square.toml"
    path.write_text("""
scenario = { name = "square", stop = 3.0, step = 0.01 }
[components]
u = { kind = "step", time = 1.0, after = 1.0 }
f = { kind = "lag", time_constant = 0.00333 }
g = { kind = "expression", y = "f.y**2" }
c = { kind = "lag", time_constant = 0.02 }
[connections]
"f.u" = "u.y"
"c.u" = "g.y"
""")
    row = check_assumptions(path).of("the scenario")[RESOLUTION]
    assert row.fulfilled is None
    assert row.evidence.endswith(" in g")
    doubled = {"components.g": {"kind": "expression", "y": "2*f.y"}}
    assert check_assumptions(path, set=doubled).of("the scenario")[RESOLUTION].fulfilled is False


def test_check_does_not_fulfill_what_a_run_warns_not_to_trust():
    """A filter that reads an input that is held; one that does not read it is not warned of."""
    jumping = {"components.u": {"kind": "step", "time": 8.0}}
    report = check_assumptions("academic", set=jumping)
    assert failing(report) == [("observer", FILTER)]
    assert "do not trust delta" in report.of("observer")[FILTER].evidence
    assert report.warnings == ()
