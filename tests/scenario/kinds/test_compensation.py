"""The compensator in a scenario: what it rejects, what it refuses, what it says."""

import re
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.errors import CosimError
from cosim.scenario.assumptions.method import ACTIVATION
from cosim.scenario.assumptions.report import check_assumptions
from cosim.scenario.building.build import Builder, parse
from cosim.scenario.document.document import Document, find
from cosim.scenario.record import component_record
from tests.scenario.general_plant import GENERAL, PARTITIONED
from tests.scenario.refusals import check_refused

NEW = """\
[components]
delta = { kind = "expression", y = "sin(1.6*t + 0.3)" }
theta = { kind = "constant", value = 1.6 }
exact = { kind = "constant", value = 0.0 }
[components.plant]"""


def exact_loop():
    """Return the shipped scenario with an exact theta, without sensor and identifier."""
    text, _, _ = find("compensation").text.partition("[truth]")
    gone = r"(?s)\[components\.(delta|sensor|regressor|identifier)\].*?(?=\[[a-z])"
    text = re.sub(gone, "", re.sub(r" *#.*", "", text))
    text = re.sub(r'(?m)^"(sensor|regressor|identifier)\..*\n', "", text)
    text = text.replace("sensor.y", "plant.y")
    text = text.replace("identifier.theta", "theta.y").replace(
        "identifier.standard_error", "exact.y"
    )
    text = text.replace("interval =", 'terms = [{ family = "sine" }]\ninterval =')
    return text.replace("[components.plant]", NEW)


LOOP = exact_loop()


def scenario(**changes):
    """Return the loop with some keys of the compensator changed, or text in place of other text."""
    text = LOOP
    for old, new in changes.pop("replaced", {}).items():
        assert old in text
        text = text.replace(old, new)
    loaded = parse(Document(text, "loop.toml", Path()))
    return loaded.edit(set={f"compensator.{key}": value for key, value in changes.items()})


def warnings(loop):
    """Return what is said of the compensator before a run."""
    with ExitStack() as resources:
        told = Builder(loop, resources).experiment().built.warnings
    return [text for name, text in told if name == "compensator"]


def rms(signal):
    return float(np.sqrt(np.mean(np.square(signal))))


def test_an_actuator_at_its_limit_recovers_faster_with_anti_windup():
    """A disturbance ten times too large for 15 s: without it u stays at its limits for good."""
    burst = "sin(1.6*t)*(1 + 9*min(1, max(0, t - 5)) - 9*min(1, max(0, t - 20)))"
    late = {}
    for anti_windup in (True, False):
        loop = scenario(anti_windup=anti_windup, lower=-3.0, upper=3.0)
        run = cosim.run(loop, set={"scenario.step": 0.02, "delta.y": burst})
        assert np.abs(run["compensator.u"]).max() == 3.0
        assert np.array_equal(run["plant.u"], run["observer.u"])
        late[anti_windup] = rms(run["plant.y"][1750:, 0])
    assert late[False] > 20.0 * late[True]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"compensator.feedforward": True, "delta.y": "sin(1.6*t) + 0.4"},
        {"scenario.input_interpolation": "zero-order"},
        {"scenario.coupling": "jacobi"},
        {"observer.filter": "consistent"},
    ],
)
def test_a_reference_and_an_unmodelled_constant_leave_no_error(changes):
    """The reference always; a constant beside the sine where delta is fed forward.

    The internal model of the sine leaves the steady state alone, whatever the loop is like.
    """
    r = {"components.r": {"kind": "constant", "value": 0.7}, "connections.compensator.r": "r.y"}
    times = {"scenario.stop": 30.0, "scenario.step": 0.02}
    run = cosim.run(scenario(), set={**r, **times, **changes})
    assert run["plant.y"][-300:, 0] == pytest.approx(0.7, abs=2e-3)


def test_a_general_model_has_the_same_controller():
    """In other coordinates, and with u that feeds through to y: the same u, to rounding."""
    runs = []
    forms = [(PARTITIONED, "x_a0 = [0.0, 0.0]", "x_a"), (GENERAL, "x0 = [0.0, 0.0, 0.0]", "x")]
    for model, initial, state in forms:
        begin = LOOP.index("n_a = 4")
        end = LOOP.index("[components]")
        text = LOOP[:begin] + model + LOOP[end:]
        replaced = {
            "x_a0 = [0.0, 0.0, 0.0, 0.0]": initial,
            "poles = [-6.0, -8.0]": "poles = [-4.0]",
            "Q = [1.0, 10.0, 1.0, 1.0]": "poles = [-2.0, -3.0]",
            '"compensator.x_a" = "observer.x_a"': f'"compensator.{state}" = "observer.{state}"',
        }
        for old, new in replaced.items():
            assert old in text
            text = text.replace(old, new)
        document = Document(text, "loop.toml", Path())
        runs.append(cosim.run(parse(document), set={"scenario.stop": 10.0}))
    first, second = runs
    scale = np.abs(first["compensator.u"]).max()
    assert np.allclose(first["compensator.u"], second["compensator.u"], rtol=0.0, atol=1e-9 * scale)
    assert rms(first["plant.y"][-200:]) < 1e-3 * rms(first["plant.y"][:400])


# --- the shipped scenario ---

SHORT = {"scenario.step": 0.02, "scenario.stop": 26.0}


@pytest.fixture(scope="module")
def runs():
    """Return the shipped loop with its internal model, without it, and with feedforward alone."""
    without = {"compensator.internal_model": False}
    forward = {**without, "compensator.feedforward": True}
    changes = {"model": {}, "feedback": without, "feedforward": forward}
    return {name: cosim.run("compensation", set=SHORT | own) for name, own in changes.items()}


@pytest.mark.slow
def test_the_internal_model_leaves_a_hundredth_of_the_error(runs):
    """Of that of the same loop without it, and of feedforward of delta alone, over two periods."""
    left = {name: rms(run["plant.y"][-400:, 0]) for name, run in runs.items()}
    assert 100.0 * left["model"] < left["feedback"]
    assert 100.0 * left["model"] < left["feedforward"] < left["feedback"]


@pytest.mark.slow
def test_the_check_says_what_standard_error_the_run_reaches(runs):
    """Output error reaches the Cramer-Rao bound, in this loop too.

    The run knows the deviation from 2600 samples: to 1.4 %.
    """
    row = check_assumptions("compensation", set=SHORT).of("compensator")[ACTIVATION]
    (bound,) = row.values["least_standard_error"]
    found = runs["model"]["identifier.standard_error"][-1]
    assert found == pytest.approx(bound, rel=4.0 * 0.014)


# --- what is refused ---


NO_COMPENSATORS = [
    ({}, {"regulated": [0, 1]}, "FEWER_INPUTS_THAN_REGULATED_OUTPUTS"),
    ({}, {"interval": []}, r"interval: expected 1 rows, \[lower, upper\] of rate, got 0"),
    ({}, {"interval": [[2.0, 1.0]]}, "lower <= upper"),
    ({}, {"Q": [[1.0]]}, "Q.*4 numbers"),
    ({}, {"lower": [0.0, 1.0]}, "lower: expected one number, or one for each of 1 elements, got 2"),
    ({'"compensator.theta" = "theta.y"': ""}, {}, "requires the input 'theta'"),
    ({'terms = [{ family = "sine" }]': ""}, {}, "internal_model: the disturbance is not described"),
    ({'"sine" }': '"sine", alpha = "1+t" }'}, {}, "expected constant alphas, got '1[+]t'"),
    ({'"sine" }': '"sine", alpha = "cos(20160*pi*t)" }'}, {}, "constant alphas, got 'cos.*'"),
    ({'"observer.x_a"': '"plant.x_a"'}, {}, "must be driven directly by a component of kind"),
    ({"filter_rate": 'filter = "consistent"\nfilter_rate'}, {"feedforward": True}, "delta .* lags"),
    ({}, {"interval": [[1.0, 7.0]]}, "'compensator': the loop .* 7 it grows .*NOT_STABLE_IN"),
]


def test_a_wrong_compensator_is_refused():
    """With what was found and what would do, before the run."""

    def refuse(replaced, changes):
        cosim.run(scenario(replaced=replaced, **changes), set={"scenario.step": 0.2})

    check_refused(NO_COMPENSATORS, refuse)


GAIN = {"kind": "gain", "K": 1.0}
LATE = {"kind": "sensor", "size": 2, "delay": 0.02}
BOTH = {"kind": "gain", "K": [[1, 0], [0, 1]]}


@pytest.mark.parametrize(
    ("part", "source", "to", "between"),
    [
        (GAIN, "compensator.u", "observer.u", "its u and the u of 'observer'"),
        (GAIN, "compensator.u", "plant.u", "its u and the u of 'plant'"),
        (LATE, "plant.y", "observer.y", "'part' delays or samples y"),
        (BOTH, "plant.y", "observer.y", "between the plant and the y of 'observer'"),
    ],
)
def test_other_parts_of_the_loop_are_warned_of(part, source, to, between):
    """Of what is in the loop beside plant, observer and compensator, the certificate knows none."""
    connections = {"connections.part.u": source, f"connections.{to}": "part.y"}
    loop = scenario().edit(set={"components.part": part, **connections})
    (text,) = warnings(loop)
    assert "the loop that was certified is one without" in text
    assert between in text


# --- the loop that is certified is the one that runs ---


def decay_rate(courses, spacing):
    """Return the slowest rate in courses of shape (N, m) that are sums of exponentials.

    From one block of rows to the next they are multiplied by a matrix with these eigenvalues.
    """
    scaled = courses / np.abs(courses).max(axis=0)
    rows = len(scaled) - 6
    blocks = np.vstack([scaled[k : k + rows].T for k in range(6)])
    _, sizes, right = np.linalg.svd(blocks, full_matrices=False)
    modes = right[sizes > 1e-11 * sizes[0]]
    transition = np.linalg.lstsq(modes[:, :-1].T, modes[:, 1:].T, rcond=None)[0]
    return -np.log(np.abs(np.linalg.eigvals(transition)).max()) / spacing


@pytest.mark.parametrize(("internal_model", "row"), [(False, 0), (True, 1)])
def test_the_rate_of_the_certificate_is_that_of_the_run(internal_model, row):
    """What two runs from different states differ by decays as the certificate says.

    With an exact theta from the start on the loop is linear. At steps of 0.04 s a plant that holds
    u and an observer that holds y, which these do not, make rates of 3 to 10 % elsewhere.
    """
    changes = {
        "scenario.step": 0.04,
        "scenario.stop": 24.0,
        "compensator.interval": [[1.599, 1.601]],
        "compensator.internal_model": internal_model,
    }
    logs = []
    for x_a0 in ([0.0, 0.0, 0.0, 0.0], [1.0, -0.7, 0.4, 0.9]):
        logs.append(cosim.run(scenario().edit(set={**changes, "plant.x_a0": x_a0})))
    signals = ("plant.x_a", "observer.x_a", "compensator.u")
    columns = []
    for name in signals:
        difference = logs[1][name] - logs[0][name]
        columns.append(difference.reshape(len(difference), -1))
    courses = np.hstack(columns)[50::5]
    certified = logs[0].plan.designs["compensator"]["certificate"][row]
    assert decay_rate(courses, 0.2) == pytest.approx(certified, rel=2e-3)


@pytest.mark.parametrize("name", ["a", "z"])
def test_names_do_not_decide_how_an_identifier_in_a_loop_sees_u(name):
    """u is a line over a step for the plant, so it is for the model of y, whoever goes first."""
    text = find("compensation").text
    for what in ("components.compensator]", '"compensator.'):
        text = text.replace(what, what.replace("compensator", name))
    with ExitStack() as resources:
        graph = Builder(parse(Document(text, "named", None)), resources).experiment().graph
    assert not graph.held["plant"].any()
    assert not graph.held["identifier"].any()
    inputs = graph.components[name].interface.input_columns()
    assert not graph.held[name][inputs["x_a"]].any()
    assert not graph.held[name][inputs["y"]].any()


# --- poles, complex ones as texts ---


DRIVE = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-5, 4, -1.8, 0.8], [4, -5, 0.8, -1.8]])
TEXTS = {
    "observer.poles": ["-6+2j", "-6-2j"],
    "compensator.poles": [-1, "(-2+1.5j)", "-2-1.5j", -3.0],
}
WITHOUT = {"scenario.stop": 0.01, "compensator.internal_model": False}


def without_weights(changes):
    """Return the loop of the compensator without its weights, with poles."""
    bare = scenario(replaced={"Q = [1.0, 10.0, 1.0, 1.0]\n": ""})
    return bare.edit(set={**WITHOUT, **changes})


def test_complex_poles_are_placed():
    """The eigenvalues of observer and state feedback are those of the file, or of a script."""
    numbers = {"observer.poles": np.array([-6 + 2j, -6 - 2j])}
    numbers["compensator.poles"] = [-1, -2 + 1.5j, -2 - 1.5j, -3.0]
    scripted = without_weights(numbers).specs
    for name, spec in without_weights(TEXTS).specs.items():
        assert getattr(spec, "poles", None) == getattr(scripted[name], "poles", None)
    log = cosim.run(without_weights(TEXTS))
    eigenvalues = [complex(value) for value in component_record(log, "observer").eigenvalues]
    for pole in (-6 + 2j, -6 - 2j):
        # simple poles, placed with a condition of some 1e3
        assert min(abs(np.array(eigenvalues) - pole)) < 1e-10
    K = -log.plan.designs["compensator"]["before"][:, :4]
    closed = np.linalg.eigvals(DRIVE - np.array([[0], [0], [1], [0]]) @ K)
    expected = [-3, -2 - 1.5j, -2 + 1.5j, -1]
    np.testing.assert_allclose(np.sort_complex(closed), expected, rtol=0, atol=1e-9)


IMPOSSIBLE_POLES = [
    ("observer", ["-6+2j", -7.0], r"come in conjugate pairs, and -6-2j is missing"),
    ("compensator", ["-6+2j", "-6+2j", "-6-2j", -1], r"in conjugate pairs, and -6-2j is miss"),
    ("observer", ["-6+2i", -1.0], r"poles\[0\]: expected a finite number, .*got '-6\+2i'"),
    ("compensator", ["nan", -1.0], r"poles\[0\]: expected a finite number, .*got 'nan'"),
    ("compensator", [True, -1.0], r"poles\[0\]: expected a finite number, .*got True"),
    ("observer", "-6+2j", r"poles'?\]?: expected a list, .*got '-6\+2j'"),
]


def test_impossible_poles_are_refused():
    """With the partner that is missing, or how a complex pole is written."""

    def refuse(name, poles):
        cosim.run(without_weights({**TEXTS, f"{name}.poles": poles}))

    check_refused(IMPOSSIBLE_POLES, refuse, CosimError)


# --- its terms beside those of the identifier that it takes theta from ---


IDENTIFIED = """
[components.regressor]
kind = "regressor"
terms = [{terms}]
delays = [0.5, 1.0, 1.5, 2.0]
[components.identifier]
kind = "identifier"
[connections]
"regressor.delta" = "observer.delta"
"identifier.regressor" = "regressor.mu"
"""
SINE = '{ family = "sine" }'
DAMPED = '{ family = "damped-sine" }'
CONSTANT = '{ family = "constant" }'
LARGER = '{ family = "sine", alpha = "2.5" }, { family = "constant", alpha = "2.5" }'
VARYING = f'{{ family = "sine", alpha = "1 + 0.5*cos(t)" }}, {CONSTANT}'
ROTATING = '{ family = "linear", G0 = [[0, 0], [0, 0]], G = [[[0, 1], [-1, 0]]], c = [1, 0] }'


def identified_loop(identified, own, theta=""):
    """Return the loop with an identifier of some terms, and a compensator of others."""
    text = LOOP.replace("[connections]\n", IDENTIFIED.format(terms=identified))
    own = f"{own}interval"
    text = text.replace('terms = [{ family = "sine" }]\ninterval', own)
    names = ("theta", "standard_error")
    taken = {f"connections.compensator.{one}": f"identifier.{one}{theta}" for one in names}
    return parse(Document(text, "loop.toml", Path())).edit(set=taken)


@pytest.mark.parametrize(
    ("identified", "own", "theta"),
    [
        (f"{SINE}, {CONSTANT}", "", ""),
        (f"{CONSTANT}, {SINE}", f'terms = [{SINE}, {{ family = "ramp" }}]\n', ""),
        (LARGER, f"terms = [{SINE}, {CONSTANT}]\n", ""),
    ],
)
def test_a_theta_of_the_same_parameters_is_taken(identified, own, theta):
    """In any order, more polynomials, a constant alpha of another size."""
    assert warnings(identified_loop(identified, own, theta)) == []


EXPONENTIAL = '{ family = "exponential" }, { family = "ramp" }'
OWN = f"terms = [{SINE}]\n"
OF_SOMETHING_ELSE = [
    (EXPONENTIAL, OWN, "", r"theta\[0\] is 'theta' .*'identifier', .* 'rate' .*'compensator'"),
    (f"{DAMPED}, {CONSTANT}", OWN, "[0]", "is 'decay' of .* taken as 'rate'"),
    (VARYING, OWN, "", "whose alpha = .* varies, .* a constant alpha; expected .* a term"),
]


def test_a_theta_of_something_else_is_refused():
    """Another parameter, or an alpha that the internal model cannot have."""

    def refuse(identified, own, theta):
        warnings(identified_loop(identified, own, theta))

    check_refused(OF_SOMETHING_ELSE, refuse)


@pytest.mark.parametrize(
    ("identified", "own", "theta", "message"),
    [
        (f"{DAMPED}, {CONSTANT}", f"terms = [{SINE}, {CONSTANT}]\n", "[1]", "is taken as 'rate'"),
        (f"{SINE}, {CONSTANT}", f"terms = [{ROTATING}, {CONSTANT}]\n", "", "taken as 'theta_1'"),
        (f"{SINE}, {CONSTANT}", OWN, "", r"terms\[1\] .*'identifier' is not in the internal model"),
    ],
)
def test_a_doubtful_theta_is_warned_of(identified, own, theta, message):
    """The rate of a damped sine as that of a sine, another form of a term, a term left out."""
    (told,) = warnings(identified_loop(identified, own, theta))
    assert re.search(message, told)
