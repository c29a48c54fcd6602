"""Terms: every family as a source and in a regressor, alphas that are signals, what is refused."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

import cosim
from cosim.blocks.regressor import Regressor
from cosim.errors import CosimError, ScenarioError, UsageError
from cosim.native.estimation.alphas import AlphaSignal
from cosim.native.numerics.expression import compile_expression
from cosim.native.numerics.programs import evaluate_at
from cosim.scenario.assumptions.method import ALPHAS as OF_ALPHAS
from cosim.scenario.assumptions.method import CLASS, DELAYS
from cosim.scenario.assumptions.report import check_assumptions
from cosim.scenario.building.build import Builder, parse
from cosim.scenario.document.document import Document, find
from cosim.scenario.exporting import export_component
from cosim.scenario.record import recorded_identification, recorded_warnings
from cosim.theory.disturbances.regression import expand
from tests.scenario.refusals import check_refused
from tests.scenario.signals import signals

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


# --- alphas of terms that are signals of the scenario ---

OF_TIME = ("1.35 + 0.25*sin(1.7*t)", "1.10 + 0.20*cos(2.3*t)")
CURVATURE = 0.25 * 1.7**2  # the largest |alpha''| of the first one; 0.2 2.3^2 of the second
THETA = (-0.1, -0.3)
H = 1.0 / 128.0  # instants and delays are exact, so that alphas are read at the very same ones
GRID = {"scenario.step": H, "scenario.stop": 8.0, "observer.filter_rate": 100.0}
RUN = {
    **GRID,
    "regressor.delays": [0.5, 1.0, 1.5],
    "identifier.start": 2.0,
    "identifier.period": 0.25,
}
SCHEDULE = {"kind": "expression", "y": list(OF_TIME)}
BOTH = ("schedule.y[0]", "schedule.y[1]")


def scenario(source=SCHEDULE, names=BOTH, more=MappingProxyType({})):
    """Return the example with alphas that are signals, of a component ``schedule``."""
    terms = [{"alpha": {"from": name}, "family": "exponential"} for name in names]
    source_terms = [{**term, "theta": theta} for term, theta in zip(terms, THETA, strict=True)]
    changes = {"delta.terms": source_terms, "regressor.terms": terms, **more}
    if source:
        changes["components.schedule"] = source
    return cosim.load("academic").set({**RUN, **changes})


def in_text():
    """Return the same as a text of its own, whose components may be swapped."""
    schedule = f'[components.schedule]\nkind = "expression"\ny = {list(OF_TIME)}\n[connections]'
    text = find("academic").text.replace("[connections]", schedule)
    for alpha, name in zip(OF_TIME, BOTH, strict=True):
        text = text.replace(f'"{alpha}"', f'{{ from = "{name}" }}')
    text = text.replace("delays = [1.0, 2.0, 3.0]", "delays = [0.5, 1.0, 1.5]")
    text = text.replace("period = 0.1 ", "start = 2.0\nperiod = 0.25 ")
    return parse(Document(text, "own", Path()))


def values(t):
    """Return both alphas at instants."""
    return evaluate_at([compile_expression(alpha) for alpha in OF_TIME], np.asarray(t))


def table(folder):
    """Write both alphas at the communication points as a CSV file; return a source of it."""
    t = np.arange(round(8.0 / H) + 1) * H
    rows = np.column_stack([t, values(t)])
    lines = ["t,first,second", *(",".join(map(repr, row)) for row in rows.tolist())]
    (folder / "schedule.csv").write_text("\n".join(lines), encoding="utf-8")
    return {"kind": "table", "file": str(folder / "schedule.csv")}


@pytest.mark.parametrize("method", ["output-error", "least-squares", "augmented-kalman"])
def test_a_signal_gives_the_bits_of_the_text(method):
    """At instants that are communication points exactly an alpha is the same number either way."""
    changes = {**RUN, "identifier.method": method}
    by_signal = signals(scenario(), set=changes)
    by_text = signals("academic", set=changes)
    for name in ("delta.y", "regressor.mu", "identifier.theta"):
        np.testing.assert_array_equal(by_signal[name], by_text[name])
    assert np.isfinite(by_signal["identifier.theta"][-1]).any()


@pytest.mark.slow
def test_any_source_will_do(tmp_path):
    """A replay takes a file and a recording from the log; a swap keeps what follows from terms."""
    log = cosim.run(scenario(table(tmp_path)), out=tmp_path / "table.mcap")
    np.testing.assert_allclose(log["identifier.theta"][-1], THETA, atol=1e-6)
    np.testing.assert_array_equal(log["regressor.alpha"], values(log.time("regressor.alpha")))
    assert cosim.diff(log, cosim.replay(log)).equal
    keys = {"kind": "recording", "log": str(log.path), "component": "schedule"}
    recorded = signals(scenario(keys))
    np.testing.assert_array_equal(recorded["identifier.theta"], log["identifier.theta"])
    columns = {"schedule.y": ["first", "second"]}
    swap = {"schedule": tmp_path / "schedule.csv"}
    swapped = signals(in_text(), set=GRID, swap=swap, map=columns)
    np.testing.assert_allclose(swapped["identifier.theta"][-1], THETA, atol=1e-6)


def test_what_only_the_run_computes_is_checked_at_its_end():
    """That is said before; alphas that prove proportional are named."""
    twice = {"components.twice": {"kind": "gain", "K": 2.0}, "connections.twice.u": "u.y"}
    changes = {**twice, "scenario.stop": 4.0, "identifier.method": "least-squares"}
    run = cosim.run(scenario({}, ("u.y", "twice.y"), changes))
    said = [text for name, text in recorded_warnings(run) if name == "identifier"]
    assert any("'twice.y': only the run computes it" in text for text in said)
    problem = recorded_identification(run)["identifier"].problem
    assert "'u.y' and alpha 'twice.y' are proportional" in problem


def test_delayed_signals_are_straight_lines_between_samples():
    """At t - lag - D the error is at most h^2/8 max |alpha''|; earlier there is no value."""
    h = 0.01
    lag = 0.1234
    own_lag = 0.05
    terms = expand((1,))
    alpha = AlphaSignal("speed.y", 0, own_lag)
    regressor = Regressor(terms, alphas=[alpha], steps=(0, 30), delays=(0.0, 0.3), lag=lag)
    t = np.arange(201) * h
    u = np.hstack([np.ones((201, 1)), values(t - own_lag)[:, :1]])
    mu = np.vstack([regressor.initialize(0.0, u[0]), regressor.advance(t, h, u)])
    for column, term in enumerate(terms):
        ((other,),) = term.parts
        age = lag + (0.0, 0.3)[other]
        exact = term.sign * values(t - age)[:, 0]
        first = max(math.ceil((age - own_lag) / h), 30)
        assert np.isnan(mu[:first, column]).all()
        np.testing.assert_allclose(mu[first:, column], exact[first:], atol=CURVATURE * h**2 / 8)
    with pytest.raises(UsageError, match=r"'speed\.y': .*0\.01 s, got 0\.05 s"):
        Regressor(terms, alphas=[alpha], steps=(0, 30), delays=(0.0, 0.3), lag=0.01)


SAMPLED = {
    "components.sensor": {
        "kind": "sensor",
        "period": 0.0625,
        "delay": 0.03125,
        "jitter": 0.001,
        "seed": 3,
        "time_stamps": True,
    },
    "connections.sensor.u": "plant.y",
    "connections.observer.y": "sensor.y",
}


def test_samples_between_communication_points_have_their_alphas(tmp_path):
    """At the times of samples a signal is on its straight lines; a log has it as the run had."""
    log = cosim.run(scenario(more=SAMPLED), out=tmp_path / "log.mcap")
    (record,) = cosim.identify(log).records
    t = record.data.t
    assert len(t) > len(log.time("plant.y")) + 100
    largest = max(CURVATURE, 0.2 * 2.3**2)
    np.testing.assert_allclose(record.data.alpha, values(t), atol=largest * H**2 / 8)
    np.testing.assert_allclose(log["identifier.theta"][-1], THETA, atol=1e-4)


def test_a_filter_is_chosen_by_a_signal_that_is_known_before_the_run():
    """The spectrum of an expression is known, that of what the run computes is not."""
    observer = {"filter": "auto", "noise": 1e-3, "kind": "unknown-input-observer", "L": [4.0, 0.0]}
    changes = {"components.observer": observer | {"model": "academic"}, "identifier.start": 5.0}
    run = scenario(more=changes)
    with ExitStack() as resources:
        chosen = Builder(run, resources).experiment().built.metadata["observer"]["choice"]
    request = chosen["request"]["delta"]
    assert request["alpha"] == list(BOTH)
    # another table of the source is another request, so that a replay with it chooses anew
    assert request["sources"]["schedule"]["y"] == list(OF_TIME)
    with pytest.raises(ScenarioError, match="'auto' requires amplitude and bandwidth"):
        cosim.run(scenario(SCHEDULE, ("plant.y", "schedule.y[1]"), changes))


def test_an_alpha_that_lags_is_for_least_squares_alone():
    """y does not lag, so that it does not fit an alpha that does."""
    case = (SCHEDULE, ("observer.delta", "schedule.y[1]"))
    changes = {"observer.filter": "consistent"}
    with pytest.raises(ScenarioError, match=r"'observer\.delta' with a lag of 0\.01\d+ s"):
        cosim.run(scenario(*case, changes))
    changes |= {"identifier.method": "least-squares", "scenario.stop": 2.5}
    assert np.isfinite(signals(scenario(*case, changes))["regressor.mu"][-1]).all()


def test_an_identifier_starts_where_its_signals_have_values():
    """They are read as late as the longest delay, and the lag of delta, before."""
    changes = {"observer.filter": "consistent", "identifier.start": 1.5}
    with pytest.raises(ScenarioError, match=r"start: .*at least 1\.5\d+ s, .*'schedule\.y\[0"):
        cosim.run(scenario(more=changes))


FEEDBACK = """
scenario = { name = "feedback", stop = 4.0, step = 0.02 }
[models.spring]
A = [[0.0, 1.0], [-4.0, -0.4]]
B = [[0.0, 0.0], [0.0, 1.0]]
C = [[1.0, 0.0]]
disturbances = [1]
[components]
u = { kind = "constant", value = 0.0 }
plant = { kind = "descriptor", model = "spring", x0 = [1.0, 0.0] }
[components.delta]
kind = "disturbance"
terms = [{ alpha = { from = "plant.y" }, family = "constant", level = 1.5 }]
[connections]
"plant.u" = "u.y"
"plant.delta" = "delta.y"
"""


def test_a_disturbance_out_of_its_plant_is_half_a_step_late(tmp_path):
    """With 1.5 y(t - h/2) = 1.5 (y - h/2 y') the spring moves as here, but for the order h^2."""
    path = tmp_path / "feedback.toml"
    path.write_text(FEEDBACK)
    run = cosim.run(path)
    t = run.time("plant.y")

    def course(delay):
        A = np.array([[0.0, 1.0], [1.5 - 4.0, -1.5 * delay - 0.4]])
        values, vectors = np.linalg.eig(A)
        weights = np.linalg.solve(vectors, [1.0, 0.0])
        return ((vectors[0] * weights) * np.exp(np.outer(t, values))).sum(axis=1).real

    late = np.abs(run["plant.y"] - course(0.01)).max()
    assert late < 0.05 * np.abs(run["plant.y"] - course(0.0)).max()
    said = dict(recorded_warnings(run))["delta"]
    assert "delta.y depends on what it drives, so that 'plant.delta' takes it with" in said
    assert "on the mean 0.01 s late" in said


def test_terms_that_name_one_signal_share_their_alpha():
    """Two exponentials under one alpha make three products, under two alphas six."""
    run = signals(scenario({**SCHEDULE, "y": OF_TIME[0]}, ("schedule.y", "schedule.y[0]")))
    assert run["regressor.alpha"].ndim == 1
    assert run["regressor.mu"].shape[1] == 3


GEAR = {
    "components.gear": {"kind": "step", "time": 1.0},
    "components.speed": {"kind": "sum", "signs": [1.0, 1.0]},
    "connections.speed.u1": "gear.y",
    "connections.speed.u2": "u.y",
}
SECOND = "schedule.y[1]"


def expressions(first, second=OF_TIME[1], **keys):
    """Return a source of two expressions."""
    return {"kind": "expression", "y": [first, second], **keys}


DISCRETE = expressions(*OF_TIME, discrete=True)
PROPORTIONAL = expressions(OF_TIME[0], "2.7 + 0.5*sin(1.7*t)")
TAKEN = {"connections.regressor.alpha": "schedule.y"}
INFINITE = expressions(OF_TIME[0], "1/(t - 5)")
FAST = expressions(OF_TIME[0].replace("1.7", "170"))
WRONG_SIGNALS = [
    (SCHEDULE, ("schedul.y", SECOND), {}, "component 'schedul'; did you mean"),
    (SCHEDULE, ("schedule.y", SECOND), {}, "size 2 "),
    (SCHEDULE, ("schedule.y[2]", SECOND), {}, "schedule.y.* 2"),
    (SCHEDULE, ("schedule.y[0:2]", SECOND), {}, "expected one element of the output"),
    (DISCRETE, BOTH, {}, r"(?s)components.delta: .*jumps.*components.regressor: .* is discrete"),
    (PROPORTIONAL, BOTH, {}, "components.regressor: .*proportional"),
    (INFINITE, BOTH, {}, r"'schedule.y\[1\]': .*t = 5 s"),
    (FAST, BOTH, {}, r"components.*0\.\d+ of .*'schedule.y\[0\]'"),
    # a sum with a step in it jumps; the terms alone connect the input
    (SCHEDULE, ("speed.y", SECOND), GEAR, r"'speed\.y' jumps with gear\.y"),
    (SCHEDULE, BOTH, TAKEN, r"'regressor\.alpha' .*of 'regressor'"),
]


def test_a_wrong_signal_is_refused_before_the_run():
    """The error names the table whose term it is."""
    check_refused(WRONG_SIGNALS, lambda *case: cosim.run(scenario(*case)), ScenarioError)


@pytest.mark.slow
def test_exported_regressor_and_identifier_give_the_same(tmp_path):
    """In their places the FMUs get the same signals by their input alpha."""
    short = {**GRID, "scenario.stop": 4.0}
    swap = {}
    for name in ("regressor", "identifier"):
        swap[name] = tmp_path / f"{name}.fmu"
        export_component(in_text().edit(set=short), name, swap[name], fmi="3")
    run = signals(in_text(), set=short)
    swapped = signals(in_text(), set=short, swap=swap)
    np.testing.assert_array_equal(swapped["regressor.mu"], run["regressor.mu"])
    np.testing.assert_array_equal(swapped["identifier.theta"][::32], run["identifier.theta"])
    assert np.isfinite(run["identifier.theta"][-1]).all()
