"""The command that checks an FMU, or the assumptions of a scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim import completion
from cosim.cli.options import JsonOption, prints_to_stderr, read_edits, run_in_child
from cosim.errors import UsageError


def check(
    subject: Annotated[
        Path,
        typer.Argument(
            metavar="FMU|SCENARIO",
            help="An FMU (.fmu), or a scenario by name or as .toml.",
            autocompletion=completion.complete_checked,
        ),
    ],
    strict: Annotated[
        bool,
        typer.Option(
            "--strict",
            help="FMU: exit 1 also for warnings (violations of the standard that run here).",
        ),
    ] = False,
    values: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="FMU: start value for the trial runs. Scenario: a value, such as "
            "observer.filter_rate=500. Repeatable.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Report problems of an FMU, or the assumptions of a scenario.

    FMU: archive, schema, structure, binaries and trial runs. Scenario: each assumption with the
    number that decides it. The scenario is not run, but FMUs are loaded and Python classes
    imported, which runs their code, in a separate process. Exit 1 if there is an error or an
    assumption fails.
    """
    from cosim.arguments import fmu_argument, is_scenario

    if is_scenario(subject):
        if strict:
            raise UsageError("--strict is for FMUs; omit it")
        run_in_child(["check", str(subject)], {"--set": values}, as_json=as_json)
        _check_scenario(str(subject), values, as_json=as_json)
        return
    from cosim.fmi.checking.check import check as check_fmu
    from cosim.report.fmu import print_check

    findings = check_fmu(fmu_argument(subject), start=read_edits(values))
    print_check(str(subject), findings, as_json=as_json)
    refused = {"error", "warning"} if strict else {"error"}
    if any(finding.level in refused for finding in findings):
        raise typer.Exit(1)


def _check_scenario(scenario: str, values: list[str] | None, *, as_json: bool) -> None:
    from cosim.report.tables.preparation import print_assumptions
    from cosim.scenario.assumptions.report import check_assumptions

    with prints_to_stderr():
        report = check_assumptions(scenario, set=read_edits(values))
    print_assumptions(report, as_json=as_json)
    if not report.fulfilled:
        raise typer.Exit(1)
