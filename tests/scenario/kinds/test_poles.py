"""Poles of observers and state feedback in a scenario, complex ones as texts."""

import numpy as np

import cosim
from cosim.errors import CosimError
from cosim.scenario.record import component_record
from tests.scenario.kinds.compensated_loop import scenario
from tests.scenario.refusals import check_refused

DRIVE = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-5, 4, -1.8, 0.8], [4, -5, 0.8, -1.8]])
TEXTS = {
    "observer.poles": ["-6+2j", "-6-2j"],
    "compensator.poles": [-1, "(-2+1.5j)", "-2-1.5j", -3.0],
}
WITHOUT = {"scenario.stop": 0.01, "compensator.internal_model": False}


def loop(changes):
    """Return the loop of the compensator without its weights, with poles."""
    without_weights = scenario(replaced={"Q = [1.0, 10.0, 1.0, 1.0]\n": ""})
    return without_weights.edit(set={**WITHOUT, **changes})


def test_complex_poles_are_placed():
    """The eigenvalues of observer and state feedback are those of the file."""
    log = cosim.run(loop(TEXTS))
    eigenvalues = [complex(value) for value in component_record(log, "observer").eigenvalues]
    for pole in (-6 + 2j, -6 - 2j):
        # simple poles, placed with a condition of some 1e3
        assert min(abs(np.array(eigenvalues) - pole)) < 1e-10
    K = -log.plan.designs["compensator"]["before"][:, :4]
    closed = np.linalg.eigvals(DRIVE - np.array([[0], [0], [1], [0]]) @ K)
    expected = [-3, -2 - 1.5j, -2 + 1.5j, -1]
    np.testing.assert_allclose(np.sort_complex(closed), expected, rtol=0, atol=1e-9)


def test_complex_numbers_of_python_are_those_texts():
    """What a script sets, and an array of it, is what the file has."""
    given = {
        "observer.poles": np.array([-6 + 2j, -6 - 2j]),
        "compensator.poles": [-1, -2 + 1.5j, -2 - 1.5j, -3.0],
    }
    by_text = loop(TEXTS)
    by_number = loop(given)
    for name, key in (("observer", "poles"), ("compensator", "poles")):
        assert getattr(by_number.specs[name], key) == getattr(by_text.specs[name], key)


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
        cosim.run(loop({**TEXTS, f"{name}.poles": poles}))

    check_refused(IMPOSSIBLE_POLES, refuse, CosimError)
