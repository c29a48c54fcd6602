"""The terms of a compensator beside those of the identifier that it takes theta from."""

from contextlib import ExitStack
from pathlib import Path

import pytest

from cosim.scenario.building.build import Builder, parse
from cosim.scenario.document.document import Document
from tests.scenario.kinds.compensated_loop import LOOP
from tests.scenario.refusals import check_refused

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


def loop(identified, own, theta=""):
    """Return the loop with an identifier of some terms, and a compensator of others."""
    text = LOOP.replace("[connections]\n", IDENTIFIED.format(terms=identified))
    own = f"{own}interval"
    text = text.replace('terms = [{ family = "sine" }]\ninterval', own)
    names = ("theta", "standard_error")
    taken = {f"connections.compensator.{one}": f"identifier.{one}{theta}" for one in names}
    return parse(Document(text, "loop.toml", Path())).edit(set=taken)


def warnings(scenario):
    """Return what is said of the compensator before a run."""
    with ExitStack() as resources:
        told = Builder(scenario, resources).experiment().built.warnings
    return [text for name, text in told if name == "compensator"]


@pytest.mark.parametrize(
    ("identified", "own", "theta"),
    [
        (f"{SINE}, {CONSTANT}", "", ""),
        (f"{SINE}, {CONSTANT}", f"terms = [{SINE}]\n", "[0]"),
        (f"{CONSTANT}, {SINE}", f'terms = [{SINE}, {{ family = "ramp" }}]\n', ""),
        (LARGER, f"terms = [{SINE}, {CONSTANT}]\n", ""),
        (f"{DAMPED}, {CONSTANT}", f"terms = [{SINE}, {CONSTANT}]\n", "[1]"),
        (f"{SINE}, {CONSTANT}", f"terms = [{ROTATING}, {CONSTANT}]\n", ""),
        (VARYING, f"terms = [{ROTATING}]\n", ""),
    ],
)
def test_a_theta_of_the_same_parameters_is_taken(identified, own, theta):
    """In any order, of a part, an alpha of another size; as another form of a term where it can."""
    assert warnings(loop(identified, own, theta)) == []


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
        warnings(loop(identified, own, theta))

    check_refused(OF_SOMETHING_ELSE, refuse)
