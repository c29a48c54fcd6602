"""The commands on FMUs: check, cache, compile, export and linearize."""

from __future__ import annotations

import typer

import cosim
from cosim.cli.command import Given, command
from cosim.cli.options import prints_to_stderr, run_in_child, shared
from cosim.errors import UsageError
from cosim.options import Rule
from cosim.report.printable import print_notice, print_text, printable


@command(
    {
        "subject FMU|SCENARIO : checked": "An FMU (.fmu), or a scenario by name or as .toml.",
        "--strict": "FMU: exit 1 also for warnings (violations of the standard that run here).",
        "--set NAME=VALUE : values": "FMU: start value for the trial runs. Scenario: a value, "
        "such as observer.filter_rate=500. Repeatable.",
        **shared("json"),
    }
)
def check(given: Given) -> bool:
    """Report problems of an FMU, or the assumptions of a scenario.

    FMU: archive, schema, structure, binaries and trial runs. Scenario: each assumption with the
    number that decides it. The scenario is not run, but FMUs are loaded and Python classes
    imported, which runs their code, in a separate process. Exit 1 if there is an error or an
    assumption fails.
    """
    from cosim.arguments import fmu_argument, is_scenario

    if is_scenario(given.subject):
        if given.strict:
            raise UsageError("--strict is for FMUs; omit it")
        run_in_child(given.arguments)
        from cosim.report.tables.preparation import show_assumptions

        with prints_to_stderr():
            report = cosim.check_assumptions(str(given.subject), set=given.set)
        given.print_shown(show_assumptions(report))
        return not report.fulfilled
    from cosim.fmi.checking.check import check as check_fmu
    from cosim.report.fmu import show_check

    findings = check_fmu(fmu_argument(given.subject), start=given.set)
    given.print_shown(show_check(str(given.subject), findings))
    refused = ("error", "warning") if given.strict else ("error",)
    return any(finding.level in refused for finding in findings)


@command({"--clear": "Remove all entries.", **shared("json")})
def cache(given: Given) -> None:
    """Show or clear the cache of FMU trials and compiled files.

    Entries are identified by content.

    The cache is in the user's cache folder, or in the folder named by the environment variable
    COSIM_CACHE (empty: no cache).
    """
    from cosim.report.fmu import show_cache

    given.print_shown(show_cache(clear=given.clear))


@command(
    {
        "fmu FMU : Path": "An FMU with sources (.fmu).",
        "--out -o FILE : Path": "FMU to write; default: fmus/<name>-<platform>.fmu",
        **shared("force-file"),
    }
)
def compile_(given: Given) -> None:
    """Compile an FMU's own sources for this machine, with CMake.

    Write a copy with the binary. Nothing else compiles them: they are a stranger's code.
    """
    from cosim.arguments import check_fmu_to_write, fmu_argument
    from cosim.fmi.building import compile_fmu, compiled_path

    path = fmu_argument(given.fmu)
    out = given.out or compiled_path(path)
    check_fmu_to_write(out, force=given.force)
    print_text(f"{out}: binary for {compile_fmu(path, out)}")


@command(
    {
        **shared("scenario"),
        "--component NAME : component = ...": "The component to export.",
        "--out -o PATH : Path": "FMU to write; default: fmus/<scenario>-<component>.fmu",
        "--fmi 2|3 : str = '2'": "FMI version: 2 (2.0) or 3 (3.0).",
        "--platform NAME,... : str": "Cross-compile: x86_64-linux, aarch64-linux, x86_64-windows, "
        "x86_64-darwin, aarch64-darwin.",
        **shared("force-file"),
        "--dae": "Include the algebraic equations of a descriptor plant (FMI 3, draft FMI-LS-DAE).",
        **shared("set"),
    }
)
def export(given: Given) -> None:
    """Export a component as an FMU, C source and binary.

    The FMU has both interface types; that of a discrete component is for co-simulation only.
    """
    from cosim.scenario.exporting import export_component
    from cosim.scenario.running.execution import load

    options = given.only("component out fmi force dae")
    platforms = [] if given.platform is None else given.platform.split(",")
    options["platforms"] = [name.strip() for name in platforms]
    for line in export_component(load(given.scenario).set(given.set), **options):
        print_text(line)


@command(
    {
        "fmu FMU : Path": "An FMU for model exchange (.fmu).",
        "--at T : float = 0.0": "Time of the operating point [s], reached with constant inputs.",
        "--set NAME=VALUE : values": "Start value of an input, a parameter or a state. Repeatable.",
        "--input NAME : list[str]": "Use these inputs only, in this order. Repeatable.",
        "--output NAME : list[str]": "Use these outputs only, in this order. Repeatable.",
        "--disturbance NAME : list[str]": "With --toml: an unknown input. Repeatable.",
        "--differences": "Use central differences even where the FMU has directional derivatives.",
        "--toml": "Print a table for [models] of a scenario.",
        **shared("json"),
    },
    Rule("toml", "prints a table for a scenario", excludes="json"),
    Rule("disturbance", "separates an unknown input in a table of [models]", needs="toml"),
)
def linearize(given: Given) -> None:
    """Linearize an FMU at an operating point.

    Print A, B, C and D, the poles and the static gain.
    """
    from cosim.fmi.linearizing.linearize import linearize_file
    from cosim.fmi.linearizing.request import LinearizationRequest
    from cosim.report.fmu import show_linearization
    from cosim.scenario.kinds.observer_design import model_toml

    request = LinearizationRequest(
        at=given.at,
        start=given.set,
        inputs=given.input,
        outputs=given.output,
        method="central differences" if given.differences else None,
    )
    linearization = linearize_file(given.fmu, request)
    if not given.toml:
        given.print_shown(show_linearization(linearization))
        return
    for note in linearization.notes:
        print_notice(f"note: {note}")
    typer.echo(printable(model_toml(linearization, given.disturbance or [])), nl=False)
