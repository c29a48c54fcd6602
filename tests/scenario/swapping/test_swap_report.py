"""Before a run: how a swapped component compares with the one that it replaces."""

import ast
import json
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.core.signals import Interface, Signal
from cosim.errors import RunError, ScenarioError
from cosim.fmi.binary.loaded import LoadedInstance
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document
from cosim.scenario.exporting import export_component
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
from cosim.scenario.recordings.swap_comparison import compare_swaps

SHORT = {"scenario.stop": 0.1}


def report(folder, name, maps=None, **changes):
    swap = {"plant": folder / name}
    return compare_swaps(cosim.load("academic").edit(swap=swap, map=maps, set={**SHORT, **changes}))


def verdicts(reports, *kept):
    return {
        (row.port, row.aspect): row.verdict
        for row in reports.reports["plant"].rows
        if row.verdict in kept
    }


def test_an_exported_plant_differs_in_nothing(folder):
    """Poles and static gain too: the FMU's are those of the matrices."""
    found = report(folder, "plant.fmu")
    assert not verdicts(found, "differs", "error", "unknown")
    assert (found.problems, found.failure, found.hints, found.warnings) == ((), "", [], [])
    rows = {(row.port, row.aspect): row.after for row in found.reports["plant"].rows}
    assert rows["y", "initial output"] == [1.0]  # x1(0) - u(0)
    assert rows["", "poles"] == [
        pytest.approx([-1.5, -(3**0.5) / 2]),
        pytest.approx([-1.5, 3**0.5 / 2]),
    ]
    # D - C A^-1 B of (28)
    assert rows["y", "static gain"] == pytest.approx({"u -> y": -4 / 3, "delta -> y": 2 / 3})


SMALL = """
[scenario]
name = "small"
stop = 0.1
step = 0.001
[components]
s = { kind = "constant", value = 1.0 }
plant = { kind = "lag", time_constant = 0.5 }
[connections]
"plant.u" = "s.y"
"""


def test_an_input_that_nothing_drives_stops_the_run(folder):
    """Also where it is one of the new component alone."""
    scenario = parse(Document(SMALL, "small.toml", Path()))
    found = compare_swaps(scenario.edit(swap={"plant": folder / "log.mcap"}))
    assert verdicts(found, "error") == {("delta", "causality"): "error"}
    assert "'plant.delta' is not connected" in found.problems[0]


def test_poles_near_zero_are_compared_as_such():
    """Slow modes of other rates are no rounding of each other."""
    rows = []
    for rate in (1e-9, 5e-10):
        one = np.ones((1, 1))
        system = LinearSystem(-rate * one, one, one, 0.0 * one, 0.0)
        rows.append(
            describe(Interface((Signal("u"),), (Signal("y"),)), {"kind": "x"}, system=system)
        )
    (row,) = [row for row in compare(*rows) if row.aspect == "poles"]
    assert row.verdict == "differs"


TWO_OUTPUTS = {
    "models.academic.C": [[2, 0, 1], [0, 1, 0]],
    "components.observer.L": [[4.0, 0.0], [0.0, 4.0]],
}
# D - C A^-1 B of x1 - u and x2
GAINS = {("u", 0): -4 / 3, ("delta", 0): 2 / 3, ("u", 1): 2 / 3, ("delta", 1): -1 / 3}
INPUTS = {"u": "delta", "delta": "u"}


@pytest.fixture(scope="module")
def two_outputs(tmp_path_factory):
    """Return the example with two outputs, and the FMU of its plant."""
    scenario = cosim.load("academic").set({**TWO_OUTPUTS, **SHORT})
    path = tmp_path_factory.mktemp("two") / "two.fmu"
    export_component(scenario, "plant", path)
    return scenario, path


@pytest.mark.parametrize(
    ("maps", "exchanged", "ports"),
    [
        ({}, None, set()),
        ({"plant.u": "delta", "plant.delta": "u"}, lambda u, y: (INPUTS[u], y), {"x_a", "y"}),
        ({"plant.y": "[y[1],y[0]]"}, lambda u, y: (u, 1 - y), {"y"}),
    ],
    ids=["as they are", "inputs exchanged", "outputs exchanged"],
)
def test_exchanged_ports_differ_element_by_element(two_outputs, maps, exchanged, ports):
    """Their sizes, types and sorted gains are those of the ports that they stand in for."""
    scenario, fmu = two_outputs
    (found,) = compare_swaps(scenario.edit(swap={"plant": fmu}, map=maps)).reports.values()
    wrong = {row.port for row in found.rows if row.connected and row.verdict == "differs"}
    assert wrong == ports
    if exchanged:
        (row,) = [row for row in found.rows if (row.port, row.aspect) == ("y", "static gain")]
        names = {f"{u} -> y[{y}]": (u, y) for u, y in GAINS}
        assert row.before == pytest.approx({name: GAINS[names[name]] for name in names})
        after = {name: GAINS[exchanged(*names[name])] for name in names}
        assert row.after == pytest.approx(after)


def test_another_interface_type_and_start_are_listed_and_warned_of(folder, tmp_path):
    """Only what is connected; the run goes on, and its log keeps the whole report."""
    changes = {"plant.start": {"x_a[0]": 1.5}}
    found = report(folder, "plant.fmu#cs", **changes)
    initial = {(port, "initial output") for port in ("y", "x_a", "x_b")}
    assert set(verdicts(found, "differs", "error")) == {*initial, ("", "interface type")}
    swap = {"plant": str(folder / "plant.fmu#cs")}
    log = cosim.run("academic", swap=swap, set={**SHORT, **changes}, out=tmp_path / "a.mcap")
    (text,) = (warning.text for warning in log.warnings if warning.source == "plant")
    assert "y initial output 1.5 (was 1); x_a initial output 1.5 -1 (was 1 -1)" in text
    assert "interface type co-simulation (was model exchange)" in text
    kept = json.loads(log.metadata["cosim.component.plant"]["metadata"])["swap_report"]
    assert kept == json.loads(json.dumps(found.reports["plant"].to_dict()))


def test_renamed_ports_are_proposed_and_never_applied(folder):
    """Each by its option, with the reason; taken at their word, the proposals make the run."""
    with pytest.raises(ScenarioError) as caught:
        cosim.run("academic", swap={"plant": folder / "other.fmu"}, set=SHORT)
    message = str(caught.value)
    assert message.count("\nmap={") == 4
    assert "plant.out1 may be plant.y (output of size 1, real; direct feedthrough from" in message
    maps = {}
    for line in message.splitlines():
        if line.startswith("map={"):
            maps |= ast.literal_eval(line.partition(": plant.")[0].removeprefix("map="))
    assert not report(folder, "other.fmu", maps).problems


def test_what_stops_the_run_is_an_error_of_its_ports(folder):
    """Inputs that are driven and an output that drives; not x_a, which only the report needs."""
    found = verdicts(report(folder, "other.fmu"), "error")
    assert set(found) == {("u", "causality"), ("delta", "causality"), ("y", "causality")}


def test_a_recording_says_what_it_does_not_know(folder):
    """Ports and first values are there; start values, capabilities and poles are not."""
    found = report(folder, "log.mcap")
    assert not found.problems
    (warning,) = found.reports["plant"].warnings
    assert warning.endswith("kind recording (was model exchange), which does not react to inputs")
    assert set(verdicts(found, "differs", "error")) == {("", "kind")}
    unknown = {aspect for _, aspect in verdicts(found, "unknown")}
    assert {"start value", "static gain", "poles", "rollback"} <= unknown
    assert verdicts(found, "ok")["y", "initial output"] == "ok"


@pytest.fixture(scope="module")
def milli(folder):
    """Write the plant with its output in mm."""
    matrix = {"models.academic.C": [[2000, 0, 1000]], "plant.unit": {"y": "mm"}}
    export_component(cosim.load("academic").set(matrix), "plant", folder / "milli.fmu")
    return folder


@pytest.mark.usefixtures("without_verdicts")
def test_units_that_convert_leave_no_warning_but_that_of_the_unit(milli):
    """The old plant in m, the new one in mm, an observer that takes m: all is converted.

    An observer without a unit would take one for the other, which is said.
    """
    text = cosim.load("academic").document.text
    file = milli / "metres.toml"
    file.write_text(text.replace('kind = "descriptor"', 'kind = "descriptor"\nunit = "m"'))
    original = cosim.load(file)
    swap = {"plant": milli / "milli.fmu"}
    unconverted = compare_swaps(original.edit(swap=swap)).warnings
    assert [text.partition(":")[0] for _, text in unconverted] == [
        "differs from what it replaces",
        "units that cannot be compared with what is connected",
    ]
    converted = original.set({"observer.unit": {"y": "m"}}).edit(swap=swap)
    assert [text for _, text in compare_swaps(converted).warnings] == [
        "differs from what it replaces: y unit mm (was m)"
    ]
    metres = cosim.run(original.set(SHORT))
    millimetres = cosim.run(converted.set(SHORT))
    worst = abs(metres["observer.delta"] - millimetres["observer.delta"]).max()
    # y is rounded twice more, and delta_hat multiplies that by the filter rate of 1000
    assert worst <= 1e3 * 8 * 2.3e-16 * abs(metres["plant.y"]).max()


@pytest.mark.usefixtures("without_verdicts")
def test_an_fmu_that_cannot_be_reset_is_loaded_again(folder, monkeypatch):
    """The run begins with what was loaded for it, and has the same bits."""
    swap = {"plant": folder / "plant.fmu"}
    reference = cosim.run("academic", swap=swap, set=SHORT)

    def refuse(self):
        raise RunError("fmi2Reset: error")

    monkeypatch.setattr(LoadedInstance, "reset", refuse)
    assert cosim.diff(reference, cosim.run("academic", swap=swap, set=SHORT)).equal


# --- two components side by side ---

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


def compared(before, after, **options):
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
    found = compared(before, after, refused={"delta", "x_a"})
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
    assert set(compared(before, before).values()) <= {"ok"}


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
    assert compared(alone(aspect, *before), alone(aspect, *after))["p", aspect] == verdict


@pytest.mark.parametrize(
    ("units", "verdict"),
    [(("m", "s"), "ok"), (("mm", "s"), "differs"), (("m", "V"), "error"), (None, "unknown")],
)
def test_the_worst_unit_of_an_element_is_that_of_the_port(units, verdict):
    """An element of another kind cannot be connected."""
    before, after = alone(INITIAL, ("m", "s"), [2.0, 1.0]), alone(INITIAL, units, [2.0, 1.0])
    assert compared(before, after, refused={"p"})["p", "unit"] == verdict


def test_what_neither_component_says_is_no_agreement():
    """There is no row of that; where one of both says it, it is unknown."""
    silent = describe(Interface((Signal("u"),), (Signal("y"),), {"y": None}), {"kind": "lag"})
    telling = describe(
        Interface((Signal("u"),), (Signal("y", unit="m", nominal=(2.0,)),)),
        {"kind": "lag", "rollback": True},
        {START: {"u": np.zeros(1)}, INITIAL: {"y": np.zeros(1)}},
        first_order(-1.0, gain=1.0),
    )
    found = compared(silent, telling)
    unknown = {key for key, verdict in found.items() if verdict == "unknown"}
    assert unknown >= {("y", "unit"), ("y", NOMINAL), ("u", START), ("", "rollback"), ("", "poles")}
    assert found["y", "feedthrough"] == "differs"  # it decides the order of execution
    said = compared(silent, silent)
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
            found = compared(exact, close)
            assert found["y", "static gain"] == found["", "poles"] == verdict
            # at another rate only where static gains tell nothing
            response = "ok" if verdict == "ok" else None
            assert found.get(("y", f"response at {rate:.3g} rad/s")) == response
    # y is no element of a vector y: nothing can be said of its gains
    two = Interface((Signal("u"),), (Signal("y", 2),))
    ones = np.ones((2, 1))
    twice = LinearSystem(-np.eye(1), np.eye(1), ones, 0.0 * ones, 0.0)
    found = compared(exact, describe(two, ABLE, system=twice))
    assert ("y", "static gain") not in found
    assert found["y", "size"] == "differs"
    system = first_order(0.0, gain=1.0)
    integrator = component(system)
    assert responses_at(0.0, integrator, units_of=integrator) is None
    assert rate_between(system) == 1.0
