"""Before a run: how a swapped component compares with the one it replaces, what stops the run, what may have been renamed."""

import json
from contextlib import ExitStack
from dataclasses import replace

import pytest

import cosim
from cosim.cli import main
from cosim.errors import ScenarioError, UsageError
from cosim.scenario.build import build_context
from cosim.scenario.exporting import export_component
from cosim.scenario.kinds.plants import FmuKind
from cosim.scenario.swap_report import examine
from tests.scenario.renamed import MAP, packed, renamed
from tests.scenario.test_swap import rewritten

SHORT = {"scenario.stop": 0.1}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write the plant as it is, renamed, packed into a vector, and as a log."""
    folder = tmp_path_factory.mktemp("plants")
    export_component("academic", "plant", folder / "plant.fmu")
    renamed(folder / "other.fmu")
    packed(folder / "packed.fmu")
    cosim.run("academic", set=SHORT, out=folder / "log.mcap")
    return folder


def report(folder, name, maps=None, **changes):
    document = (
        cosim.load("academic")
        .document.with_swaps({"plant": str(folder / name)}, maps)
        .with_changes({**SHORT, **changes})
    )
    return examine(document)


def verdicts(contract, *kept):
    return {
        (row.port, row.aspect): row.verdict
        for row in contract.reports["plant"].rows
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
    assert rows["y", "static gain"] == pytest.approx([-4 / 3, 2 / 3])  # D - C A^-1 B of (28)


def test_another_mode_and_start_are_listed_and_warned_of_in_one_line(folder, tmp_path):
    """Only what is connected; the run goes on, and its log keeps the whole report."""
    changes = {"plant.start": {"x_a[0]": 1.5}}
    found = report(folder, "plant.fmu#cs", **changes)
    assert set(verdicts(found, "differs", "error")) == {
        ("y", "initial output"), ("x_a", "initial output"), ("x_b", "initial output"), ("", "kind"),
    }  # fmt: skip
    text = (
        "differs from what it replaces: y initial output 1.5 (was 1); x_a initial output 1.5 -1 (was 1 -1); "
        "kind co-simulation (was model exchange)"
    )
    log = cosim.run(
        "academic",
        swap={"plant": str(folder / "plant.fmu#cs")},
        set={**SHORT, **changes},
        out=tmp_path / "a.mcap",
    )
    assert ["plant", text] in json.loads(log.metadata["cosim.run"]["warnings"])
    kept = json.loads(log.metadata["cosim.component.plant"]["metadata"])["contract"]
    assert kept == json.loads(json.dumps(found.reports["plant"].to_dict()))


def test_renamed_ports_are_proposed_and_never_applied(folder):
    """Each by its option, with the reason; taken at their word, the proposals make the run."""
    with pytest.raises(ScenarioError) as caught:
        cosim.run("academic", swap={"plant": folder / "other.fmu"}, set=SHORT)
    said = str(caught.value)
    for option in (
        "--map plant.u=force",
        "--map plant.delta=push",
        "--map plant.y=out1",
        "--map plant.x_a=s",
    ):
        assert f"\n{option}: plant." in said, said
    assert said.count("--map") == 4
    assert (
        "--map plant.y=out1: plant.out1 may be plant.y (output of size 1, real; feeds through from force; initial output 1;"
        in said
    )
    options = [
        line.partition(": ")[0].removeprefix("--map ")
        for line in said.splitlines()
        if line.startswith("--map")
    ]
    assert not report(folder, "other.fmu", dict(option.split("=") for option in options)).problems


def test_an_element_of_a_vector_is_proposed(folder):
    """Of out = (x_b, x_b, y) only the last begins at 1 and has the static gains of y."""
    found = report(
        folder, "packed.fmu", {"plant.u": "force", "plant.delta": "push", "plant.x_a": "s"}
    )
    assert [(one.port, one.name) for one in found.reports["plant"].proposals] == [("y", "out[2]")]


def test_a_mapped_port_is_compared_with_the_one_it_replaces(folder):
    """Under both names; feedthrough is compared in the names before."""
    found = report(folder, "other.fmu", MAP)
    assert not found.problems
    ports = {row.port: row for row in found.reports["plant"].rows}
    assert {"u -> force", "delta -> push", "y -> out1", "x_a -> s"} <= set(ports)
    assert set(verdicts(found, "differs", "error")) == {
        ("x_b", "causality"),
        ("aux", "causality"),
    }, "which nothing needs"


def test_a_recording_says_what_it_does_not_know(folder):
    """Ports and first values are there; start values, capabilities and poles are not."""
    found = report(folder, "log.mcap")
    assert not found.problems
    assert set(verdicts(found, "differs", "error")) == {("", "kind")}
    unknown = {aspect for _, aspect in verdicts(found, "unknown")}
    assert {"start value", "static gain", "poles", "rollback"} <= unknown
    assert verdicts(found, "ok")["y", "initial output"] == "ok"


def test_what_is_replaced_need_not_work(folder):
    """The scenario's own plant is broken: nothing to compare with, nothing in the way."""
    text = cosim.load("academic").document.text.replace("x_a0 = [1.0, -1.0]", "x_a0 = [1.0]")
    found = examine(
        replace(cosim.load("academic").document, text=text).with_swaps(
            {"plant": str(folder / "plant.fmu")}
        )
    )
    assert (found.reports, found.problems) == ({}, ())


def test_a_dry_run_has_rows_proposals_and_problems_for_programs(folder, capsys):
    """Exit 2 where the run would stop, 0 where it would not."""
    with pytest.raises(SystemExit) as left:
        main(["run", "academic", "--swap", f"plant={folder / 'other.fmu'}", "--dry-run", "--json"])
    assert left.value.code == 2
    found = json.loads(capsys.readouterr().out)
    assert set(found) == {"swaps", "problems"}
    assert set(found["swaps"]["plant"]) == {"ports", "proposals"}
    assert {frozenset(row) for row in found["swaps"]["plant"]["ports"]} == {
        frozenset({"port", "aspect", "before", "after", "verdict", "connected"})
    }
    assert {row["port"]: row["verdict"] for row in found["swaps"]["plant"]["ports"] if row["verdict"] == "error"} == {
        "plant.u": "error", "plant.delta": "error", "plant.y": "error", "plant.force": "error", "plant.push": "error",
    }  # fmt: skip
    assert {one["option"] for one in found["swaps"]["plant"]["proposals"]} >= {"--map plant.y=out1"}
    options = [option for port, name in MAP.items() for option in ("--map", f"{port}={name}")]
    with pytest.raises(SystemExit) as left:
        main(
            [
                "run",
                "academic",
                "--swap",
                f"plant={folder / 'other.fmu'}",
                *options,
                "--dry-run",
                "--json",
            ]
        )
    assert not left.value.code
    assert json.loads(capsys.readouterr().out)["problems"] == []


def test_a_run_with_a_swap_says_what_differs_on_stderr(folder, tmp_path, capsys):
    """One warning; exit 0. The log's info shows the rows."""
    with pytest.raises(SystemExit) as left:
        main(
            [
                "run",
                "academic",
                "--swap",
                f"plant={folder / 'plant.fmu#cs'}",
                "--stop",
                "0.1",
                "--out",
                str(tmp_path / "a.mcap"),
            ]
        )
    assert not left.value.code
    warned = (
        "warning: plant: differs from what it replaces: kind co-simulation (was model exchange)\n"
    )
    assert capsys.readouterr().err == warned
    with pytest.raises(SystemExit):
        main(["info", str(tmp_path / "a.mcap")])
    assert "plant: differences from the replaced component" in capsys.readouterr().out


def test_what_cannot_be_linearized_is_unknown(folder, tmp_path):
    """An FMU of which there can be one instance is not opened again for its poles; start values must be numbers."""
    once = (
        'canBeInstantiatedOnlyOncePerProcess="false"',
        'canBeInstantiatedOnlyOncePerProcess="true"',
    )
    rewritten(folder / "plant.fmu", tmp_path / "once.fmu", once)
    assert verdicts(report(tmp_path, "once.fmu"), "unknown")["", "poles"] == "unknown"
    with ExitStack() as resources:
        context = build_context(cosim.load("academic"), resources)
        for name, start, text in (
            ("once", {}, "one instance only"),
            ("plant", {"x": [1.0]}, "numbers as start values only"),
        ):
            path = (tmp_path if name == "once" else folder) / f"{name}.fmu"
            with pytest.raises(UsageError, match=text):
                FmuKind(kind="fmu", path=str(path), start=start).linear_system("plant", context)
