"""The table of terms: every family as a source and in a regressor, and wrong numbers refused."""

import math

import numpy as np
import pytest

import cosim
from cosim.errors import CosimError
from cosim.scenario.build import parse
from cosim.scenario.document import Document

SOURCE = """
[scenario]
name = "source"
stop = 3.0
step = 0.01

[components.delta]
kind = "disturbance"
terms = [
{terms}
]
"""

# a term, and what it is
TERMS = {
    '{ family = "exponential", theta = -0.4, amplitude = 1.7 }': (
        lambda t: 1.7 * math.exp(-0.4 * t)
    ),
    '{ family = "sine", theta = [2.0], phase = 0.3 }': lambda t: math.sin(2.0 * t + 0.3),
    '{ family = "damped-sine", theta = [0.2, 2.0], amplitude = -1.5, phase = 0.3 }': (
        lambda t: -1.5 * math.exp(-0.2 * t) * math.sin(2.0 * t + 0.3)
    ),
    '{ family = "damped-sine", theta = [-0.2, 2.0], constants = [1.5, 0.3] }': (
        lambda t: 1.5 * math.exp(0.2 * t) * math.sin(2.0 * t + 0.3)
    ),
    '{ alpha = "1 + t", family = "constant", constants = [-0.5] }': lambda t: -0.5 * (1.0 + t),
    '{ family = "ramp", constants = [1.0, -2.0] }': lambda t: 1.0 - 2.0 * t,
    '{ family = "polynomial", degree = 3, constants = [1.0, -2.0, 0.0, 0.5] }': (
        lambda t: 1.0 - 2.0 * t + 0.5 * t**3
    ),
    '{ family = "t-exponential", theta = -0.7, constants = [1.0, 2.0] }': (
        lambda t: (1.0 + 2.0 * t) * math.exp(-0.7 * t)
    ),
    '{ alpha = "2", family = "linear", G0 = [[0, 1], [-4, 0]], c = [1, 0], constants = [1, 2] }': (
        lambda t: 2.0 * (math.cos(2.0 * t) + math.sin(2.0 * t))
    ),
    '{ family = "linear", G0 = [[0, 1], [0, 0]], G = [[[0, 0], [-1, 0]]], c = [1, 0], '
    "parameters = ['stiffness'], theta = 4.0, constants = [1, 2] }": (
        lambda t: math.cos(2.0 * t) + math.sin(2.0 * t)
    ),
}


def source(folder, terms):
    return parse(Document(SOURCE.format(terms=",\n".join(terms)), "source", folder))


@pytest.mark.parametrize("term", list(TERMS))
def test_a_term_is_its_family(term, tmp_path):
    """y = alpha(t) f(theta, t), by the closed form of each family."""
    log = cosim.run(source(tmp_path, [term]))
    t = log.time("delta.y")
    expected = [TERMS[term](float(instant)) for instant in t]
    # elementary functions to the last bit; a matrix exponential of norm 15 to 1e-14
    np.testing.assert_allclose(log["delta.y"], expected, rtol=0, atol=1e-12)


def test_terms_are_added_in_their_elements(tmp_path):
    """Of a disturbance of two elements each is the sum of its own terms, in any order."""
    terms = list(TERMS)
    at_second = [term.replace("{ ", "{ element = 1, ", 1) for term in terms[::2]]
    log = cosim.run(source(tmp_path, [*at_second, *terms[1::2]]))
    t = log.time("delta.y")
    first = [sum(TERMS[term](float(x)) for term in terms[1::2]) for x in t]
    second = [sum(TERMS[term](float(x)) for term in terms[::2]) for x in t]
    np.testing.assert_allclose(log["delta.y"], np.array([first, second]).T, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("term", "message"),
    [
        ('family = "sinus", theta = 1.0', r"did you mean 'sine'"),
        ('family = "chirp", theta = 1.0', r"'chirp': .* is outside \(5\)"),
        ('family = "exponential"', r"theta of family 'exponential': found 0 numbers; needed 1"),
        ('family = "sine", theta = [1.0, 2.0]', r"found 2 numbers: 1, 2; needed 1: rate"),
        ('family = "damped-sine", theta = 1.0', r"found 1 number: 1; needed 2: decay, rate"),
        ('family = "constant", theta = 1.0, constants = [1.0]', r"needed none: leave it out"),
        ('family = "constant"', r"constants of family 'constant': found 0 .* needed 1: level"),
        ('family = "ramp", constants = [1.0]', r"found 1 number: 1; needed 2: level, slope"),
        ('family = "ramp", amplitude = 1.0', r"amplitude: family 'ramp' has none; it has level"),
        ('family = "exponential", theta = 1.0, phase = 1.0', r"phase: family 'exponential' has no"),
        (
            'family = "sine", theta = 1.0, phase = 1.0, constants = [1.0, 1.0]',
            r"found constants beside amplitude or phase",
        ),
        ('family = "polynomial", constants = [1.0]', r"family 'polynomial': needed degree"),
        ('family = "polynomial", degree = 9, constants = [1.0]', r"degree: found 9; needed 0 to 8"),
        ('family = "ramp", degree = 1, constants = [1.0, 1.0]', r"degree: is of family 'polyn"),
        ('family = "linear", c = [1.0], constants = [1.0]', r"family 'linear': needed G0"),
        (
            'family = "linear", G0 = [[0, 1], [0]], c = [1, 0], constants = [1, 1]',
            r"G0: found rows of lengths \[2, 1\]",
        ),
        (
            'family = "linear", G0 = [[0, 0], [0, -1]], c = [1, 0], constants = [1, 1]',
            r"terms\[0\]: family 'linear': c = \[1.0, 0.0\] does not observe",
        ),
        ('family = "constant", constants = [1.0], element = -1', r"element"),
    ],
)
def test_wrong_numbers_of_a_term_are_refused(term, message, tmp_path):
    """Every message names the term, what was found and what was needed."""
    with pytest.raises(CosimError, match=message):
        cosim.run(source(tmp_path, [f"{{ {term} }}"]))


def test_a_disturbance_without_terms_is_refused(tmp_path):
    """It has no value."""
    with pytest.raises(CosimError, match=r"terms"):
        cosim.run(source(tmp_path, []))
