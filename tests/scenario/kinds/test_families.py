"""The table of terms: every family as a source and in a regressor, and wrong numbers refused."""

import math
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

import cosim
from cosim.errors import CosimError
from cosim.scenario.assumptions.method import ALPHAS as OF_ALPHAS
from cosim.scenario.assumptions.method import CLASS, DELAYS
from cosim.scenario.assumptions.report import check_assumptions
from cosim.scenario.building.build import Builder, parse
from cosim.scenario.document.document import Document, find
from cosim.scenario.record import recorded_identification
from tests.scenario.refusals import check_refused

SOURCE = """
scenario = {{ name = "source", stop = 3.0, step = 0.01 }}
[components]
delta = {{ kind = "disturbance", terms = [{terms}] }}
"""

MATRIX = "G0 = [[0, 1], [-4, 0]], c = [1, 0], constants = [1, 2]"
STIFFNESS = "G0 = [[0, 1], [0, 0]], G = [[[0, 0], [-1, 0]]], c = [1, 0], parameters = ['stiffness']"
# a term, and what it is
TERMS = [
    ('family = "exponential", theta = -0.4, amplitude = 1.7', "1.7*exp(-0.4*t)"),
    ('family = "sine", theta = [2.0], phase = 0.3', "sin(2*t + 0.3)"),
    ('family = "damped-sine", theta = [0.2, 2.0], phase = 0.3', "exp(-0.2*t)*sin(2*t + 0.3)"),
    ('family = "damped-sine", theta = [-0.2, 2.0], amplitude = -1.5', "-1.5*exp(0.2*t)*sin(2*t)"),
    ('alpha = "1 + t", family = "constant", level = -0.5', "-0.5*(1 + t)"),
    ('family = "ramp", slope = -2.0, level = 1.0', "1 - 2*t"),
    ('family = "polynomial", degree = 3, constants = [1.0, -2.0, 0.0, 0.5]', "1 - 2*t + 0.5*t**3"),
    ('family = "t-exponential", theta = -0.7, level = 1.0, slope = 2.0', "(1 + 2*t)*exp(-0.7*t)"),
    (f'alpha = "2", family = "linear", {MATRIX}', "2*cos(2*t) + 2*sin(2*t)"),
    (f'family = "linear", {STIFFNESS}, theta = 4.0, constants = [1, 2]', "cos(2*t) + sin(2*t)"),
]


def source(folder, terms):
    return parse(Document(SOURCE.format(terms=", ".join(terms)), "source", folder))


def test_a_term_is_its_family(tmp_path):
    """y = alpha(t) f(theta, t), by the closed form of each family; an element is a sum of terms."""
    terms = [f"{{ element = {i}, {term} }}" for i, (term, _) in enumerate(TERMS)]
    constant = '{ element = 0, family = "constant", level = 2.0 }'
    log = cosim.run(source(tmp_path, [*terms, constant]))
    names = {"t": log.time("delta.y"), "sin": np.sin, "cos": np.cos, "exp": np.exp}
    for i, (term, formula) in enumerate(TERMS):
        # elementary functions to the last bit; a matrix exponential of norm 15 to 1e-14
        expected = eval(formula, names) + (2.0 if i == 0 else 0.0)
        np.testing.assert_allclose(log["delta.y"][:, i], expected, rtol=0, atol=1e-12, err_msg=term)


LINEAR = 'family = "linear", c = [1, 0], constants = [1, 1]'
WRONG_TERMS = [
    ('family = "sinus", theta = 1.0', r"did you mean 'sine'"),
    ('family = "chirp", theta = 1.0', r"'chirp'"),
    ('family = "exponential"', r"'exponential': expected 1 .*got 0 numbers"),
    ('family = "damped-sine", theta = 1.0', r"expected 2 \(decay, rate\), got 1 number: 1"),
    ('family = "constant", theta = 1.0, level = 1.0', r"expected none, got 1 number: 1"),
    ('family = "constant"', r"level is missing; family 'constant'"),
    ('family = "ramp", constants = [1.0, 2.0]', r"constants: .*available: level, slope"),
    ('family = "polynomial", degree = 1, level = 1.0', r"level: .*'polynomial'.*: constants"),
    ('family = "polynomial", degree = 2, constants = [1.0]', r"expected 3 .*got 1 number: 1"),
    ('family = "exponential", theta = 1.0, phase = 1.0', r"phase: .*'exponential'"),
    ('family = "polynomial", constants = [1.0]', r"degree is missing; family 'polynomial'"),
    ('family = "polynomial", degree = 9, constants = [1.0]', r"degree: expected .* <= 8, got 9"),
    ('family = "ramp", degree = 1, level = 1.0, slope = 1.0', r"degree: .*'polynomial' only"),
    ('family = "linear", c = [1.0], constants = [1.0]', r"G0 is missing; family 'linear'"),
    (f"{LINEAR}, G0 = [[0, 1], [0]]", r"G0: .*\[2, 1\]"),
    (f"{LINEAR}, G0 = [[0, 0], [0, -1]]", r"terms\[0\]: .*'linear': c = \[1.0, 0.0\]"),
    ('family = "constant", level = 1.0, element = -1', r"element"),
]


def test_wrong_numbers_of_a_term_are_refused(tmp_path):
    """Every message names the term, what was expected and what was found."""

    def refuse(term):
        cosim.run(source(tmp_path, [f"{{ {term} }}"]))

    check_refused(WRONG_TERMS, refuse, CosimError)
    with pytest.raises(CosimError, match="terms"):
        cosim.run(source(tmp_path, []))


WITHOUT = ("theta", "amplitude", "phase", "level", "slope", "constants")
ALPHAS = ("1 + 0.8*sin(1.7*t)", "1 + 0.8*cos(2.3*t)", "1 + 0.8*sin(0.9*t)", "1 + 0.8*cos(3.1*t)")
MATRICES = {
    "A": [[-1, 0.5, 0], [0, -2, 1], [0.3, 0, -1.5]],
    "B": [[1, 1, 0], [0, 0, 1], [0.5, 0, 0]],
    "disturbances": [1, 2],
    "C": [[1, 0, 0], [0, 1, 0]],
}
OBSERVER = {"kind": "unknown-input-observer", "poles": [-4.0, -5.0], "filter_rate": 200.0}
PAIR = {  # a plant with two disturbances
    "models.academic": MATRICES,
    "components.plant": {"kind": "descriptor", "model": "academic", "x0": [1.0, -1.0, 0.5]},
    "components.observer": OBSERVER | {"model": "academic"},
}


def identified(terms, delays, changes=MappingProxyType({}), **options):
    """Return the example with terms in its disturbance and in its regressor, and options."""
    text, _, _ = find("academic").text.partition("[truth]")
    unknown = [{key: term[key] for key in term if key not in WITHOUT} for term in terms]
    own = {
        "scenario.stop": 12.0,
        "scenario.step": 0.02,
        "observer.filter_rate": 100.0,
        "delta.terms": terms,
        "regressor.terms": unknown,
        "regressor.delays": delays,
        "identifier.period": 12.0,
        **changes,
    }
    own |= {f"identifier.{key}": value for key, value in options.items()}
    return parse(Document(text, "identified", Path())).edit(set=own)


def test_constants_of_every_name_are_told_with_their_verdicts():
    """Amplitude and phase of a damped sine, level and slope of a ramp, as the scenario has them."""
    terms = [
        {"family": "damped-sine", "theta": [0.15, 2.0], "amplitude": 1.2, "phase": 0.5},
        {"alpha": ALPHAS[0], "family": "ramp", "level": 0.7, "slope": -0.05},
    ]
    log = cosim.run(identified(terms, [0.4, 0.8, 1.2, 1.6, 2.0]))
    np.testing.assert_allclose(log["identifier.theta"][-1], [0.15, 2.0], rtol=1e-8)
    told = recorded_identification(log)["identifier"]
    values = {one.name: one.value for one in (*told.parameters, *told.amplitudes[0])}
    expected = {"theta[0]": 0.15, "theta[1]": 2.0, "amplitude[0]": 1.2, "phase[0]": 0.5}
    expected |= {"level[1]": 0.7, "slope[1]": -0.05}
    # exact data, but for the rounding of y, which a record of two slow functions magnifies
    assert values == pytest.approx(expected, rel=1e-6)
    reasons = {one.name: one.reason for one in told.amplitudes[0]}
    assert reasons["slope[1]"] == "in level[1] + slope[1] t"


def test_terms_without_parameters_have_amplitudes_alone():
    """There is no theta; a method that estimates theta alone says which does more."""
    terms = [{"alpha": ALPHAS[0], "family": "constant", "level": 0.7}]
    log = cosim.run(identified(terms, [0.4, 0.8]))
    assert "identifier.theta" not in log.signals
    told = recorded_identification(log)["identifier"]
    assert told.parameters == ()
    (level,) = told.amplitudes[0]
    assert (level.name, str(level.verdict)) == ("level[0]", "IDENTIFIABLE")
    assert level.value == pytest.approx(0.7, rel=1e-9)
    for method in ("least-squares", "rayleigh", "gradient", "extended-kalman"):
        scenario = identified(terms, [0.4, 0.8], method=method)
        with pytest.raises(CosimError, match=rf'"{method}": .*constant.*output-error'):
            cosim.run(scenario)


def exponentials(*theta):
    pairs = zip((*ALPHAS, "1"), theta, strict=False)
    return [{"alpha": alpha, "family": "exponential", "theta": value} for alpha, value in pairs]


def test_what_least_squares_does_not_tell_apart_is_noted(subtests):
    """Rates from pi over the spacing of the delays on, and which exponential is which; no more."""
    sine = {"alpha": ALPHAS[0], "family": "sine", "theta": 2.0}
    decays = [{"family": "exponential", "theta": theta} for theta in (-0.3, -0.8)]
    of_sine = (
        f"theta[0]: a rate above {math.pi / 0.4:.4g} rad/s is taken for a slower one "
        "(delays 0.4 s apart)"
    )
    of_decays = "theta[0], theta[1]: two exponentials under one alpha come back the larger first"
    for terms, notes in [([sine, decays[0]], [of_sine]), (decays, [of_decays]), (decays[:1], [])]:
        with subtests.test(notes=notes), ExitStack() as resources:
            count = 1 + len(terms) + (sine in terms)
            delays = [round(0.4 * (j + 1), 1) for j in range(count)]
            scenario = identified(terms, delays, method="least-squares")
            metadata = Builder(scenario, resources).experiment().built.metadata
            assert metadata["identifier"]["notes"] == notes


@pytest.mark.slow
def test_five_alphas_are_identified_without_the_expansion():
    """(25) has 720 terms: mu is delta at its delays, the start is searched on y."""
    theta = [-0.05, -0.3, -0.8, -2.0, 0.1]
    delays = [0.4, 0.8, 1.2, 1.6, 2.0, 2.4]
    log = cosim.run(identified(exponentials(*theta), delays))
    np.testing.assert_allclose(log["identifier.theta"][-1], theta, rtol=1e-5)
    mu = log["regressor.mu"]
    delta = log["regressor.delta"]
    assert mu.shape == (len(delta), 6)
    for j, delay in enumerate(delays):
        steps = round(delay / 0.02)
        np.testing.assert_array_equal(mu[200:, j], delta[200 - steps : len(delta) - steps])
    scenario = identified(exponentials(*theta), delays, method="rayleigh")
    with pytest.raises(CosimError, match=r'"rayleigh": .*128 .*720'):
        cosim.run(scenario)


def test_a_slow_sine_beside_a_constant_is_identified():
    """A sixth of a period is curved: exact data give its rate."""
    slow = {"family": "sine", "theta": 0.08, "phase": 0.4}
    terms = [slow, {"family": "constant", "level": 0.7}]
    run = cosim.run(identified(terms, [0.4, 0.8, 1.2, 1.6], bounds=[[0, 0.1]]))
    np.testing.assert_allclose(run["identifier.theta"][-1], 0.08, rtol=1e-3)


TWO = [
    {"alpha": "1 + 0.5*sin(1.7*t)", "family": "sine", "theta": 1.3, "phase": 0.4},
    {"element": 1, "alpha": "1 + 0.4*cos(2.3*t)", "family": "exponential", "theta": -0.05},
]


def test_two_disturbances_are_identified_together():
    """Each element of delta has terms of its own; theta is within 1e-3, the lag of delta or not."""
    log = cosim.run(identified(TWO, [0.5, 1.0, 1.5], PAIR))
    np.testing.assert_allclose(log["identifier.theta"][-1], [1.3, -0.05], rtol=0, atol=1e-3)
    told = recorded_identification(log)["identifier"]
    names = [one.name for one in told.amplitudes[0]]
    assert names == ["amplitude[0]", "phase[0]", "amplitude[1]"]
    # (25) of a sine alone, and behind it that of an exponential, which needs two of the delays
    delta = log["regressor.delta"]
    alpha = 1.0 + 0.4 * np.cos(2.3 * log.time("regressor.mu"))
    mu = log["regressor.mu"]
    assert mu.shape[1] == 3 + 2
    first = delta[75:-25, 1] * alpha[50:-50]
    assert np.isclose(np.abs(mu[100:, 3:]), np.abs(first)[:, np.newaxis]).any(axis=1).all()


PERIODIC = [
    {"alpha": "1.35 + 0.25*sin(2*pi*t)", "family": "exponential", "theta": -0.1},
    {"alpha": "1.1 + 0.2*cos(2*pi*t)", "family": "exponential", "theta": -0.3},
]
SCALED = [
    {"family": "sine", "theta": 1.3, "phase": 0.4},
    {"alpha": "exp(-0.1*t)", "family": "exponential", "theta": -0.2},
]


@pytest.mark.parametrize("terms", [PERIODIC, SCALED])
def test_output_error_needs_no_independent_products(terms):
    """Delays of whole periods of the alphas; an alpha that a delay scales. Without noise: exact.

    Methods on the regression need them and refuse what is periodic with the delays.
    """
    delays = [1.0, 2.0, 3.0, 4.0][: 3 + (terms is SCALED)]
    log = cosim.run(identified(terms, delays), set={"identifier.period": 1.0})
    expected = [term["theta"] for term in terms]
    np.testing.assert_allclose(log["identifier.theta"][-1], expected, rtol=0, atol=1e-6)
    told = recorded_identification(log)["identifier"]
    assert [one.verdict for one in told.parameters] == 2 * ["IDENTIFIABLE"]


CONSTANT = {"family": "constant", "level": 1.0}
SINE = {"family": "sine", "theta": 1.0}
FOUR = exponentials(-0.05, -0.3, -0.8, -2.0)
# exp(0.5 t) times the one is the other: (-0.1, -0.3) and (-0.8, 0.4) make the same signal
EXCHANGED = [{**PERIODIC[0], "alpha": "2"}, {**PERIODIC[1], "alpha": "-exp(-0.5*t)"}]
UNKNOWNS = r'l = 4 with different alphas makes 119 unknowns.*method = "output-error"'
INDISTINGUISHABLE = [
    ([CONSTANT, CONSTANT], {}, r"terms\[0\] \(constant\) and terms\[1\] \(constant\) sha"),
    ([SINE, CONSTANT], {"bounds": [[0, 1e-3]]}, r"is a straight line in the 12 s of the run"),
    (EXCHANGED, {}, r"regressor: .*'2' is a multiple of exp\(0\.5 t\) times alpha .* parameters"),
    # the linear route, from four alphas on; output error needs no independent products
    *((FOUR, {"method": method}, UNKNOWNS) for method in ("least-squares", "gradient", "drem")),
    (PERIODIC, {"method": "least-squares"}, r"identifier: .* have rank 1; .*\"output-error\""),
]


def test_terms_that_no_data_or_not_this_method_tells_apart_are_refused():
    """Before the run, by families, alphas and bounds."""

    def refuse(terms, more):
        count = 1 + sum(2 if term["family"] == "sine" else 1 for term in terms)
        spacing = 1.0 if terms in (PERIODIC, EXCHANGED) else 0.4
        delays = [round(spacing * (j + 1), 1) for j in range(count)]
        cosim.run(identified(terms, delays, **more))

    check_refused(INDISTINGUISHABLE, refuse, CosimError)


def test_elements_may_have_signals_as_alphas():
    """The bits of expressions; one element has the first signal, the other one both of them.

    Steps of 1/128 s: instants and delays are exact, so that alphas are read at the very same ones.
    """
    terms = [*TWO, {**TWO[1], "alpha": TWO[0]["alpha"], "theta": -0.4}]
    alphas = [term["alpha"] for term in TWO]
    schedule = {"components.schedule": {"kind": "expression", "y": alphas}}
    places = [{"from": f"schedule.y[{i}]"} for i in (0, 1, 0)]
    by_text = identified(terms, [0.5, 1.0, 1.5], PAIR)
    signals = [{**term, "alpha": place} for term, place in zip(terms, places, strict=True)]
    by_signal = identified(signals, [0.5, 1.0, 1.5], PAIR | schedule)
    short = {"scenario.step": 1.0 / 128.0, "scenario.stop": 4.0, "identifier.period": 1.0}
    expected = cosim.run(by_text, set=short)
    found = cosim.run(by_signal, set=short)
    for name in ("delta.y", "regressor.mu", "identifier.theta"):
        np.testing.assert_array_equal(found[name], expected[name])
    assert np.isfinite(found["identifier.theta"][-1]).all()
    told = recorded_identification(found)["identifier"]
    assert [one.verdict for one in told.parameters] == len(terms) * ["IDENTIFIABLE"]


WRONG_ELEMENTS = [
    (TWO, {"method": "least-squares"}, r'"least-squares": .*one element of delta, got 2'),
    ([{**TWO[1], "element": 2}, TWO[0]], {}, r"got none for element 1"),
    ([TWO[0]], {}, r"regressor|size 2|2 unknown disturbances"),
]


def test_elements_that_do_not_fit_are_refused():
    """Every element of delta has terms, and the method can do with several."""

    def refuse(terms, more):
        cosim.run(identified(terms, [0.5, 1.0, 1.5], PAIR, **more))

    check_refused(WRONG_ELEMENTS, refuse, CosimError)


def test_the_assumptions_of_every_element_are_told():
    """Each element has its own class, and the longest of them needs its delays."""
    scenario = identified(TWO, [0.5, 1.0, 1.5], PAIR)
    told = check_assumptions(scenario).of("regressor")
    assert all(told[name].fulfilled for name in (CLASS, DELAYS, OF_ALPHAS))
    assert "element 1: exponential: 1 basis functions" in told[CLASS].evidence
    assert told[CLASS].values == {"basis_functions": 3, "groups": 2, "terms": 5}
