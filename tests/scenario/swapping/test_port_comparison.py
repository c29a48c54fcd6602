"""Two components side by side: each aspect with its verdict, and what may be the renamed port."""

import numpy as np
import pytest

from cosim.core.signals import Interface, Signal
from cosim.scenario.kinds.values import LinearSystem
from cosim.scenario.recordings.port_comparison import (
    CAPABILITIES,
    INITIAL,
    NOMINAL,
    START,
    compare,
    describe,
    rate_between,
    responses_at,
)

ABLE = {"kind": "model exchange", **dict.fromkeys(CAPABILITIES, True)}
BEFORE = Interface(
    (Signal("u", unit="N"), Signal("delta")),
    (
        Signal("y", unit="Hz"),
        Signal("x_a", 2),
        Signal("x_b"),
        Signal("s", unit="m"),
        Signal("n", type="integer"),
    ),
    {"y": ("u",)},
)
AFTER = Interface(
    (Signal("u", unit="kg.m/s2", variability="discrete"), Signal("x_b"), Signal("k")),
    (Signal("y", unit="1/s"), Signal("x_a", 3), Signal("s", unit="mm"), Signal("n", unit="V")),
    {"y": None},
)


def verdicts(before, after, **options):
    """Compare by name; return the verdicts by (port, aspect)."""
    rows = compare(before, after, **options)
    return {(row.port, row.aspect): row.verdict for row in rows}


def test_every_aspect_has_a_verdict():
    """The verdict is an error only where a connection is refused.

    Units that convert differ, units of one meaning do not.
    """
    before = describe(
        BEFORE, ABLE, {START: {"u": np.array([1.0])}, INITIAL: {"s": np.array([2.0])}}
    )
    able = {**ABLE, "kind": "co-simulation", "rollback": False, "variable step": None}
    after = describe(AFTER, able, {START: {"u": np.array([2.0])}, INITIAL: {"s": np.array([2e3])}})
    found = verdicts(before, after, refused={"delta", "x_a"})
    assert {key: verdict for key, verdict in found.items() if verdict != "ok"} == {
        ("u", "variability"): "differs",
        ("u", "start value"): "differs",
        ("delta", "causality"): "error",
        ("y", "feedthrough"): "differs",
        ("x_a", "size"): "error",
        ("x_b", "causality"): "differs",
        ("s", "unit"): "differs",
        ("n", "type"): "differs",
        ("n", "unit"): "unknown",
        ("k", "causality"): "differs",
        ("", "interface type"): "differs",
        ("", "rollback"): "differs",
        ("", "variable step"): "unknown",
    }
    assert set(verdicts(before, before).values()) <= {"ok"}


def alone(aspect, unit, values):
    """Return a component of one port: an input where it has start values, else an output."""
    nominal = tuple(values) if aspect == NOMINAL else ()
    signal = Signal("p", len(values), unit=unit, nominal=nominal)
    interface = Interface((signal,)) if aspect == START else Interface((), (signal,))
    return describe(interface, ABLE, {} if nominal else {aspect: {"p": np.array(values)}})


@pytest.mark.parametrize(
    ("aspect", "before", "after", "verdict"),
    [
        # 2 m are 2000 mm; 2 mm are not 2 m
        (INITIAL, ("m", [2.0]), ("mm", [2e3]), "ok"),
        (INITIAL, ("m", [2.0]), ("mm", [2.0]), "differs"),
        # each element in its unit
        (INITIAL, (("m", "s"), [2.0, 1.0]), (("mm", "s"), [2e3, 1.0]), "ok"),
        (INITIAL, (("m", "s"), [2.0, 1.0]), (("m", "ms"), [2.0, 1.0]), "differs"),
        # capacitances in F are no rounding; what that leaves of 0 is no difference
        (START, ("F", [1e-10]), ("F", [5e-10]), "differs"),
        (START, ("F", [1e-10]), ("F", [1e-10 * (1 + 1e-12)]), "ok"),
        (START, ("F", [0.0]), ("F", [1e-17]), "ok"),
        # a factor of ten is the limit of sizes
        (NOMINAL, ("m", [2.0]), ("mm", [2e4]), "ok"),
        (NOMINAL, ("m", [2.0]), ("mm", [2.1e4]), "differs"),
        (NOMINAL, ("m", [2.0]), ("mm", [1.9e2]), "differs"),
    ],
)
def test_numbers_are_compared_in_one_unit(aspect, before, after, verdict):
    """In that of the component before."""
    assert verdicts(alone(aspect, *before), alone(aspect, *after))["p", aspect] == verdict


@pytest.mark.parametrize(
    ("units", "verdict"),
    [(("m", "s"), "ok"), (("mm", "s"), "differs"), (("m", "V"), "error"), (None, "unknown")],
)
def test_the_worst_unit_of_an_element_is_that_of_the_port(units, verdict):
    """An element of another kind cannot be connected."""
    before, after = alone(INITIAL, ("m", "s"), [2.0, 1.0]), alone(INITIAL, units, [2.0, 1.0])
    assert verdicts(before, after, refused={"p"})["p", "unit"] == verdict


def test_what_neither_component_says_is_no_agreement():
    """There is no row of that; where one of both says it, it is unknown."""
    silent = describe(Interface((Signal("u"),), (Signal("y"),), {"y": None}), {"kind": "lag"})
    telling = describe(
        Interface((Signal("u"),), (Signal("y", unit="m", nominal=(2.0,)),)),
        {"kind": "lag", "rollback": True},
        {START: {"u": np.zeros(1)}, INITIAL: {"y": np.zeros(1)}},
        first_order(-1.0, gain=1.0),
    )
    found = verdicts(silent, telling)
    unknown = {key for key, verdict in found.items() if verdict == "unknown"}
    assert unknown >= {("y", "unit"), ("y", NOMINAL), ("u", START), ("", "rollback"), ("", "poles")}
    assert found["y", "feedthrough"] == "differs"  # it decides the order of execution
    said = verdicts(silent, silent)
    assert {*unknown, ("y", "feedthrough")}.isdisjoint(said)
    assert set(said.values()) == {"ok"}


def first_order(a, *, gain, error=0.0):
    """x' = a x + u, y = gain x."""
    matrices = [np.array([[value]]) for value in (a, 1.0, gain, 0.0)]
    return LinearSystem(*matrices, error)


def test_responses_and_poles_are_compared_within_their_error():
    """x' = -2 x + u, y = 4 x: gain 2, pole -2.

    A difference of 1e-7 is seen, of small gains too, unless the numbers are wrong by that.
    """
    interface = Interface((Signal("u"),), (Signal("y"),))
    rate = 2.0 * 2.0**0.5

    def component(system):
        return describe(interface, ABLE, system=system)

    for gain in (4.0, 4e-12):
        system = first_order(-2.0, gain=gain)
        exact = component(system)
        assert rate_between(system) == pytest.approx(rate)
        for frequency in (0.0, rate):
            ((found, _),) = responses_at(frequency, exact, units_of=exact).values()
            assert found == pytest.approx(gain / (2.0 + 1j * frequency), rel=1e-14)
        for error, verdict in ((0.0, "differs"), (1e-7, "ok")):
            close = component(first_order(-2.0 - 1e-7, gain=gain, error=error))
            found = verdicts(exact, close)
            assert found["y", "static gain"] == found["", "poles"] == verdict
            # at another rate only where static gains tell nothing
            response = "ok" if verdict == "ok" else None
            assert found.get(("y", f"response at {rate:.3g} rad/s")) == response
    # y is no element of a vector y: nothing can be said of its gains
    two = Interface((Signal("u"),), (Signal("y", 2),))
    ones = np.ones((2, 1))
    twice = LinearSystem(-np.eye(1), np.eye(1), ones, 0.0 * ones, 0.0)
    found = verdicts(exact, describe(two, ABLE, system=twice))
    assert ("y", "static gain") not in found
    assert found["y", "size"] == "differs"
    system = first_order(0.0, gain=1.0)
    integrator = component(system)
    assert responses_at(0.0, integrator, units_of=integrator) is None
    assert rate_between(system) == 1.0
