"""Before a run: how a swapped component compares with the one that it replaces.

The report has what stops the run, too, and which ports may have been meant.
"""

import ast
import json
import math
import textwrap
from collections import Counter
from dataclasses import replace

import pytest

import cosim
from cosim.errors import RunError, ScenarioError
from cosim.fmi.binary.loaded import LoadedInstance
from cosim.fmi.reading import model_description
from cosim.report.tables.console import print_shown
from cosim.report.tables.preparation import show_dry_run
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import find
from cosim.scenario.exporting import export_component
from cosim.scenario.record import ComparedAspect
from cosim.scenario.recordings.swap_comparison import compare_swaps
from cosim.scenario.recordings.swap_report import SwapReport, row_texts
from tests.scenario.fmu_edits import rewritten
from tests.scenario.swapping.renamed import MAP, packed, renamed

SHORT = {"scenario.stop": 0.1}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write the plant as it is, and as a log."""
    folder = tmp_path_factory.mktemp("plants")
    export_component("academic", "plant", folder / "plant.fmu")
    cosim.run("academic", set=SHORT, out=folder / "log.mcap")
    return folder


@pytest.fixture(scope="module")
def with_other(folder):
    """Write the plant with other port names beside it."""
    renamed(folder / "other.fmu")


@pytest.fixture(scope="module")
def with_packed(folder):
    """Write the plant with a vector of outputs beside it."""
    packed(folder / "packed.fmu")


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
    warnings = " ".join(found.warnings)
    for entries in differences.values():
        for name, (old, new) in entries.items():
            assert f"{name} {new:g} (was {old:g})" in warnings
        # of an output that nothing reads, too, as the log has it
        is_of_inputs = "plant.u" in maps
        assert ("x static gain u -> x[0] 0.125 (was 0.25)" in warnings) == is_of_inputs


def test_exchanged_dynamics_differ_at_a_rate_where_static_gains_do_not(tmp_path):
    """Two lags of gain 1, in 1 s and 0.1 s: at a rate between them only one of them answers."""
    text = """
        scenario = { name = "lags", stop = 1.0, step = 0.01 }
        [models.lags]
        A = [[-1.0, 0.0], [0.0, -10.0]]
        B = [[1.0, 0.0], [0.0, 10.0]]
        C = [[1.0, 0.0], [0.0, 1.0]]
        disturbances = [1]
        [components]
        plant = { kind = "descriptor", model = "lags", x0 = [0.0, 0.0] }
        """
    path = tmp_path / "lags.toml"
    path.write_text(textwrap.dedent(text))
    export_component(str(path), "plant", tmp_path / "lags.fmu")
    maps = {"plant.y": "[y[1],y[0]]", "plant.u": "delta", "plant.delta": "u"}
    scenario = cosim.load(path).edit(swap={"plant": tmp_path / "lags.fmu"}, map=maps)
    (found,) = compare_swaps(scenario).reports.values()
    rows = {row.aspect: row for row in found.rows if row.port == "y"}
    assert rows["static gain"].verdict == "ok"
    rate = math.sqrt(2.0 * 10.0)
    row = rows[f"response at {rate:.3g} rad/s"]
    assert row.verdict == "differs"
    slow, fast = (1.0 / (1.0 + 1j * rate * time_constant) for time_constant in (1.0, 0.1))
    assert complex(*row.before["u -> y[0]"]) == pytest.approx(slow)
    assert complex(*row.after["u -> y[0]"]) == pytest.approx(fast)
    assert row.before.keys() == {"u -> y[0]", "delta -> y[1]"}


def test_another_interface_type_and_start_are_listed_and_warned_of_in_one_line(folder, tmp_path):
    """Only what is connected; the run goes on, and its log keeps the whole report."""
    changes = {"plant.start": {"x_a[0]": 1.5}}
    found = report(folder, "plant.fmu#cs", **changes)
    assert set(verdicts(found, "differs", "error")) == {
        ("y", "initial output"),
        ("x_a", "initial output"),
        ("x_b", "initial output"),
        ("", "interface type"),
    }
    text = (
        "differs from what it replaces: y initial output 1.5 (was 1); x_a initial output 1.5 -1 "
        "(was 1 -1); interface type co-simulation (was model exchange)"
    )
    log = cosim.run(
        "academic",
        swap={"plant": str(folder / "plant.fmu#cs")},
        set={**SHORT, **changes},
        out=tmp_path / "a.mcap",
    )
    assert ["plant", text] in json.loads(log.metadata["cosim.run"]["warnings"])
    kept = json.loads(log.metadata["cosim.component.plant"]["metadata"])["swap_report"]
    assert kept == json.loads(json.dumps(found.reports["plant"].to_dict()))


@pytest.mark.usefixtures("with_other")
def test_renamed_ports_are_proposed_and_never_applied(folder):
    """Each by its option, with the reason; taken at their word, the proposals make the run."""
    with pytest.raises(ScenarioError) as caught:
        cosim.run("academic", swap={"plant": folder / "other.fmu"}, set=SHORT)
    message = str(caught.value)
    for option in (
        "map={'plant.u': 'force'}",
        "map={'plant.delta': 'push'}",
        "map={'plant.y': 'out1'}",
        "map={'plant.x_a': 's'}",
    ):
        assert f"\n{option}: plant." in message, message
    assert message.count("\nmap={") == 4
    assert (
        "map={'plant.y': 'out1'}: plant.out1 may be plant.y (output of size 1, real; direct "
        "feedthrough from force; initial output 1;" in message
    )
    maps = {}
    for line in message.splitlines():
        if line.startswith("map={"):
            maps |= ast.literal_eval(line.partition(": plant.")[0].removeprefix("map="))
    assert not report(folder, "other.fmu", maps).problems


@pytest.mark.usefixtures("with_other")
def test_what_stops_the_run_is_an_error_of_its_ports(folder):
    """Inputs that are driven and an output that drives; not x_a, which only the report needs."""
    found = verdicts(report(folder, "other.fmu"), "error")
    assert set(found) == {("u", "causality"), ("delta", "causality"), ("y", "causality")}


@pytest.mark.usefixtures("with_packed")
def test_an_element_of_a_vector_is_proposed(folder):
    """Of out = (x_b, x_b, y) only the last begins at 1 and has the static gains of y."""
    found = report(
        folder, "packed.fmu", {"plant.u": "force", "plant.delta": "push", "plant.x_a": "s"}
    )
    assert [(one.port, one.name) for one in found.reports["plant"].proposals] == [("y", "out[2]")]


@pytest.mark.usefixtures("with_other")
def test_a_mapped_port_is_compared_with_the_one_it_replaces(folder):
    """Under both names; it is shown with the scenario's."""
    found = report(folder, "other.fmu", MAP)
    assert not found.problems
    rows = {(row.port, row.aspect): row for row in found.reports["plant"].rows}
    initial = rows["y", "initial output"]
    assert (initial.before, initial.verdict) == ([1.0], "ok")
    labels = {row.label for row in found.reports["plant"].rows}
    assert {"u -> force", "delta -> push", "y -> out1", "x_a -> s"} <= labels
    recorded = {(row["port"], row["source"]) for row in found.reports["plant"].to_dict()["ports"]}
    assert {("plant.y", "out1"), ("plant.x_b", None), ("plant", None)} <= recorded
    assert set(verdicts(found, "differs", "error")) == {
        ("x_b", "causality"),
        ("aux", "causality"),
    }, "which nothing needs"


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


def test_the_replaced_component_need_not_work(folder, capsys):
    """The scenario's own plant is broken: nothing to compare with, which is said."""
    document = find("academic")
    text = document.text.replace("x_a0 = [1.0, -1.0]", "x_a0 = [1.0]")
    swapped = replace(document, text=text).with_swaps({"plant": str(folder / "plant.fmu")})
    found = compare_swaps(parse(swapped))
    assert (found.reports, found.problems) == ({}, ())
    ((component, text),) = found.warnings
    assert component == "plant"
    assert "cannot be compared with what it replaces, which cannot be built: x_a0" in text
    print_shown(show_dry_run(found), as_json=True)
    assert {"of": "plant", "text": text} in json.loads(capsys.readouterr().out)["warnings"]


@pytest.mark.usefixtures("with_other")
def test_a_dry_run_has_rows_proposals_and_problems_for_programs(folder, capsys):
    """What stops the run is a problem; the rest are differences, in words or as JSON."""
    reports = report(folder, "other.fmu")
    print_shown(show_dry_run(reports), as_json=True)
    found = json.loads(capsys.readouterr().out)
    assert set(found) == {"swaps", "problems", "imported", "warnings"}
    assert set(found["swaps"]["plant"]) == {"ports", "proposals"}
    rows = found["swaps"]["plant"]["ports"]
    keys = ["port", "aspect", "before", "after", "verdict", "connected", "ratio", "source"]
    assert {tuple(row) for row in rows} == {tuple(keys)}
    errors = {row["port"] for row in rows if row["verdict"] == "error"}
    assert errors == {"plant.u", "plant.delta", "plant.y"}
    options = {one["option"] for one in found["swaps"]["plant"]["proposals"]}
    assert "map={'plant.y': 'out1'}" in options
    assert found["problems"] == reports.refusals != []
    reports = report(folder, "other.fmu", MAP)
    print_shown(show_dry_run(reports), as_json=False)
    out = capsys.readouterr().out
    assert f"the scenario can run; rows that differ: {reports.different}" in out


@pytest.mark.usefixtures("without_verdicts")
def test_a_run_with_a_swap_says_what_differs_on_stderr(folder, call):
    """One warning; exit 0. The log's info shows the rows."""
    swap = f"plant={folder / 'plant.fmu#cs'}"
    code, _, err = call("run", "academic", "--swap", swap, "--stop", "0.1", "--out", "a.mcap")
    text = "differs from what it replaces: interface type co-simulation (was model exchange)"
    assert (code, err) == (0, f"warning: plant: {text}\n")
    _, shown, _ = call("info", "a.mcap")
    assert "plant: differences from the replaced component" in shown
    row = next(line for line in shown.splitlines() if "model exchange" in line)
    aspect = "plant interface type"
    assert " ".join(row.split()) == f"{aspect} model exchange co-simulation differs"
    (found,) = json.loads(call("info", "a.mcap", "--json")[1])["differences"]["plant"]
    assert (found["port"], found["aspect"]) == ("plant", "interface type")


def test_no_direct_feedthrough_is_said_so():
    """In rows and warnings; the values stay plain for programs."""
    row = ComparedAspect("y", "feedthrough", [], "unknown", "differs", True)
    report = SwapReport("plant", (row,), ())
    assert report.lines[0]["before"] == "no direct feedthrough"
    assert report.warnings == [
        "differs from what it replaces: y feedthrough unknown (was no direct feedthrough)"
    ]
    assert report.to_dict()["ports"][0]["before"] == []
    assert row_texts(report.to_dict()["ports"][0], whole=False) == report.lines[0]


def test_a_port_may_have_any_name():
    """Blanks too, which FMI allows: its unit is warned of like that of any other."""
    row = ComparedAspect("my port", "unit", "m", "mm", "differs", True, source="its -> port")
    report = SwapReport("plant", (row,), (), frozenset({"my port"}))
    assert report.warnings == [
        "differs from what it replaces: my port -> its -> port unit mm (was m)",
        "units that cannot be compared with what is connected: my port -> its -> port unit mm "
        "(was m); values are taken as they are",
    ]


@pytest.fixture(scope="module")
def milli(folder):
    """Write the plant with its output in mm."""
    matrix = {"models.academic.C": [[2000, 0, 1000]], "plant.unit": {"y": "mm"}}
    export_component(cosim.load("academic").set(matrix), "plant", folder / "milli.fmu")
    return folder


def swap_warnings(folder, **changes):
    return [text for _, text in report(folder, "milli.fmu", **changes).warnings]


def test_a_unit_on_one_side_only_is_said_and_its_size_warned_of(milli):
    """1 m and 1000 mm: without a unit before, only the sizes show that they are not the same."""
    differences, units, sizes = swap_warnings(milli)
    assert differences.startswith("differs from what it replaces: y initial output 1000 (was 1)")
    assert "units that cannot be compared" in units
    assert "y unit mm (was -)" in units
    assert "y initial output 1e+03 times as large; y static gain 1e+03 times as large" in sizes


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


def test_an_fmu_that_there_may_be_once_is_linearized(folder, tmp_path):
    """For model exchange it is the one that runs."""
    once = 'canBeInstantiatedOnlyOncePerProcess="{}"'
    rewritten(
        folder / "plant.fmu", tmp_path / "once.fmu", (once.format("false"), once.format("true"))
    )
    assert verdicts(report(tmp_path, "once.fmu#cs"), "ok")["", "poles"] == "ok"
    assert verdicts(report(tmp_path, "once.fmu"), "ok")["", "poles"] == "ok"


PAIR = """
[scenario]
name = "pair"
stop = 0.1
step = 0.01
[components]
source = { kind = "sine", rate = 2.0, unit = "N" }
part = { kind = "transfer-function", numerator = [NUMBER], denominator = [0.5, 1.0], unit = UNITS }
after = { kind = "lag", time_constant = 0.3, unit = "m" }
[connections]
"part.u" = "source.y"
"after.u" = "part.y"
"""


def pair(folder, number, units):
    path = folder / f"{number}.toml"
    path.write_text(PAIR.replace("NUMBER", number).replace("UNITS", units))
    return path


@pytest.mark.parametrize(
    ("units", "verdict", "ratio"), [('{ u = "kN", y = "mm" }', "ok", 1.0), ("{}", "differs", 1e6)]
)
def test_the_static_gain_of_an_fmu_with_local_states_is_known(tmp_path, units, verdict, ratio):
    """Its states are recorded behind its outputs: the gain has rows for them too.

    2 m/N are 2e6 mm/kN; without units the gain alone says that they are others, as all begins at 0.
    """
    original = cosim.load(pair(tmp_path, "2.0", '{ u = "N", y = "m" }'))
    milli = pair(tmp_path, "2e6", units)
    path = tmp_path / "part.fmu"
    export_component(milli, "part", path)
    rows = compare_swaps(original.edit(swap={"part": path})).reports["part"].rows
    gain = next(row for row in rows if (row.port, row.aspect) == ("y", "static gain"))
    assert gain.verdict == verdict
    assert gain.ratio == pytest.approx(ratio, rel=1e-9)


@pytest.fixture
def counted(monkeypatch):
    """Return what is counted: FMUs that are read, instances."""
    counts = Counter()
    read_fmu = model_description.open_archive
    instantiate = LoadedInstance.__init__

    def counted_read(path, *arguments):
        counts["description"] += 1
        return read_fmu(path, *arguments)

    def counted_instance(self, *arguments, **options):
        counts["instance"] += 1
        instantiate(self, *arguments, **options)

    monkeypatch.setattr(model_description, "open_archive", counted_read)
    monkeypatch.setattr(LoadedInstance, "__init__", counted_instance)
    return counts


@pytest.mark.usefixtures("without_verdicts")
def test_an_fmu_that_cannot_be_reset_is_loaded_again(folder, counted, monkeypatch):
    """Else one instance is compared, linearized and run; then the run has one of its own."""
    reference = cosim.run("academic", swap={"plant": folder / "plant.fmu"}, set=SHORT)
    assert counted == {"description": 1, "instance": 1}

    def refuse(self):
        raise RunError("fmi2Reset: error")

    monkeypatch.setattr(LoadedInstance, "reset", refuse)
    run = cosim.run("academic", swap={"plant": folder / "plant.fmu"}, set=SHORT)
    # for the report, to look how the run begins, and for the run
    assert counted["instance"] == 1 + 3
    assert cosim.diff(reference, run).equal
