"""Two components side by side: each aspect with its verdict, and what may be the renamed port."""

import numpy as np
import pytest

from cosim.core.signals import Interface, Signal
from cosim.scenario.kinds.values import LinearSystem
from cosim.scenario.recordings.port_comparison import (
    CAPABILITIES,
    INITIAL,
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


def test_values_are_compared_in_one_unit():
    """2 m are 2000 mm; 2 mm are not 2 m."""
    before = describe(BEFORE, ABLE, {INITIAL: {"s": np.array([2.0])}})
    for millimetres, verdict in ((2e3, "ok"), (2.0, "differs")):
        after = describe(AFTER, ABLE, {INITIAL: {"s": np.array([millimetres])}})
        assert verdicts(before, after)["s", "initial output"] == verdict


@pytest.mark.parametrize(
    ("before", "after", "verdict"),
    [(1e-10, 5e-10, "differs"), (1e-10, 1e-10 * (1 + 1e-12), "ok"), (0.0, 1e-17, "ok")],
)
def test_small_values_are_compared_by_their_size(before, after, verdict):
    """Capacitances in F are no rounding; what that leaves of 0 is no difference."""
    old, new = (describe(BEFORE, ABLE, {START: {"u": np.array([u])}}) for u in (before, after))
    assert verdicts(old, new)["u", "start value"] == verdict


def test_each_element_is_compared_in_its_unit():
    """2 m and 1 s are 2000 mm and 1 s; an element of another kind is an error or differs."""

    def initial(units, values):
        interface = Interface((), (Signal("y", 2, unit=units),))
        return describe(interface, ABLE, {INITIAL: {"y": np.array(values)}})

    before = initial(("m", "s"), [2.0, 1.0])
    found = verdicts(before, initial(("mm", "s"), [2e3, 1.0]))
    assert (found["y", "unit"], found["y", "initial output"]) == ("differs", "ok")
    found = verdicts(before, initial(("m", "ms"), [2.0, 1.0]))
    assert (found["y", "unit"], found["y", "initial output"]) == ("differs", "differs")
    assert verdicts(before, initial(("m", "V"), [2.0, 1.0]), refused={"y"})["y", "unit"] == "error"
    assert verdicts(before, initial(None, [2.0, 1.0]))["y", "unit"] == "unknown"


def test_sizes_are_compared_in_one_unit():
    """A factor of ten is the limit; what is not known has no size."""

    def nominal(unit, *sizes):
        return describe(Interface((), (Signal("s", unit=unit, nominal=sizes),)), ABLE)

    before = nominal("m", 2.0)
    for millimetres, another in ((2e3, False), (2e4, False), (2.1e4, True), (1.9e2, True)):
        (row,) = [row for row in compare(before, nominal("mm", millimetres)) if row.ratio]
        assert (row.aspect, row.of_another_size) == ("nominal", another)
        assert row.verdict == ("differs" if another else "ok")
    assert verdicts(before, nominal("m"))["s", "nominal"] == "unknown"


def test_what_neither_component_says_is_no_agreement():
    """Units, numbers, feedthrough and capabilities: no row, where one of both says it "unknown"."""
    silent = describe(Interface((Signal("u"),), (Signal("y"),), {"y": None}), {"kind": "lag"})
    aspects = {("y", "unit"), ("y", "feedthrough"), ("u", START), ("", "rollback"), ("", "poles")}
    assert aspects.isdisjoint(verdicts(silent, silent))
    telling = describe(
        Interface((Signal("u"),), (Signal("y", unit="m"),)),
        {"kind": "lag", "rollback": True},
        {START: {"u": np.zeros(1)}},
        first_order(-1.0, gain=1.0),
    )
    found = verdicts(silent, telling)
    assert {found[key] for key in aspects - {("y", "feedthrough")}} == {"unknown"}
    assert found["y", "feedthrough"] == "differs"  # what may follow at once decides the order


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
    system = first_order(0.0, gain=1.0)
    integrator = component(system)
    assert responses_at(0.0, integrator, units_of=integrator) is None
    assert rate_between(system) == 1.0
