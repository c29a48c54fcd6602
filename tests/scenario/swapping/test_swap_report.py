"""Before a run: how a swapped component compares with the one that it replaces.

The report has what stops the run, too, and which ports may have been meant.
"""

import ast
import json
import textwrap

import pytest

import cosim
from cosim.errors import RunError, ScenarioError
from cosim.fmi.binary.loaded import LoadedInstance
from cosim.scenario.exporting import export_component
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


TWO_INPUTS = """
    scenario = { name = "two-inputs", stop = 2.0, step = 0.01 }
    [models.two]
    A = [[0.0, 1.0], [-4.0, -2.0]]
    B = [[0.0, 0.0], [1.0, 0.5]]
    C = [[1.0, 0.0], [0.0, 1.0]]
    disturbances = [1]
    [components]
    plant = { kind = "descriptor", model = "two", x0 = [0.0, 0.0] }
    u = { kind = "constant", value = 1.0 }
    delta = { kind = "sine", amplitude = 1.0, rate = 3.0 }
    sum = { kind = "gain", K = [[1.0, 1.0]] }
    [connections]
    "sum.u" = "plant.y"
    "plant.u" = "u.y"
    "plant.delta" = "delta.y"
    """


@pytest.fixture(scope="module")
def two_inputs(tmp_path_factory):
    """Write a plant of two inputs and two outputs, and its FMU; return the scenario."""
    folder = tmp_path_factory.mktemp("two")
    path = folder / "two.toml"
    path.write_text(textwrap.dedent(TWO_INPUTS))
    export_component(str(path), "plant", folder / "two.fmu")
    return path


@pytest.mark.parametrize(
    ("maps", "differences"),
    [
        ({}, {}),
        (
            {"plant.u": "delta", "plant.delta": "u"},
            {"y": {"u -> y[0]": (0.25, 0.125), "delta -> y[0]": (0.125, 0.25)}},
        ),
        (
            {"plant.y": "[y[1],y[0]]"},
            {
                "y": {
                    "u -> y[0]": (0.25, 0.0),
                    "delta -> y[0]": (0.125, 0.0),
                    "u -> y[1]": (0.0, 0.25),
                    "delta -> y[1]": (0.0, 0.125),
                }
            },
        ),
    ],
    ids=["as they are", "inputs exchanged", "outputs exchanged"],
)
def test_exchanged_ports_differ_element_by_element(two_inputs, maps, differences):
    """Their sizes, types and sorted gains are those of the ports that they stand in for."""
    scenario = cosim.load(two_inputs).edit(swap={"plant": two_inputs.with_suffix(".fmu")}, map=maps)
    (found,) = compare_swaps(scenario).reports.values()
    rows = {(row.port, row.aspect): row for row in found.rows}
    for port, entries in differences.items():
        row = rows[port, "static gain"]
        assert row.verdict == "differs"
        assert row.before == pytest.approx({name: old for name, (old, _) in entries.items()})
        assert row.after == pytest.approx({name: new for name, (_, new) in entries.items()})
    wrong = {row.port for row in found.rows if row.connected and row.verdict == "differs"}
    assert wrong == set(differences)


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
