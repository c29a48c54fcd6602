"""The commands on FMUs: cache, export and linearize."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim import completion
from cosim.cli.options import JsonOption, ScenarioArgument, SetOption, read_edits
from cosim.errors import UsageError
from cosim.report.printable import printable


def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all entries.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show or clear the cache of FMU trials and compiled files.

    Entries are identified by content.

    The cache is in the user's cache folder, or in the folder named by the environment variable
    COSIM_CACHE (empty: no cache).
    """
    from cosim.report.fmu import print_cache

    print_cache(clear=clear, as_json=as_json)


def compile_(
    fmu: Annotated[Path, typer.Argument(metavar="FMU", help="An FMU with sources (.fmu).")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE", help="FMU to write; default: fmus/<name>-<platform>.fmu"
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Compile an FMU's own sources for this machine, with CMake.

    Write a copy with the binary. Nothing else compiles them: they are a stranger's code.
    """
    from cosim.arguments import check_fmu_to_write, fmu_argument
    from cosim.fmi.building import compile_fmu, compiled_path

    path = fmu_argument(fmu)
    out = out or compiled_path(path)
    check_fmu_to_write(out, force=force)
    platform = compile_fmu(path, out)
    typer.echo(printable(f"{out}: binary for {platform}"))


def export(
    scenario: ScenarioArgument,
    component: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="The component to export.",
            autocompletion=completion.complete_component,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="PATH",
            help="FMU to write; default: fmus/<scenario>-<component>.fmu",
        ),
    ] = None,
    fmi: Annotated[str, typer.Option(metavar="2|3", help="FMI version: 2 (2.0) or 3 (3.0).")] = "2",
    platform: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...",
            help="Cross-compile: x86_64-linux, aarch64-linux, x86_64-windows, x86_64-darwin, "
            "aarch64-darwin.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    dae: Annotated[
        bool,
        typer.Option(
            "--dae",
            help="Include the algebraic equations of a descriptor plant (FMI 3, draft FMI-LS-DAE).",
        ),
    ] = False,
    changes: SetOption = None,
) -> None:
    """Export a component as an FMU, C source and binary.

    The FMU has both interface types; that of a discrete component is for co-simulation only.
    """
    from cosim.scenario.exporting import export_component
    from cosim.scenario.running.execution import load

    platforms = [] if platform is None else [name.strip() for name in platform.split(",")]
    edited = load(scenario).set(read_edits(changes))
    for line in export_component(
        edited, component, out, fmi=fmi, platforms=platforms, force=force, dae=dae
    ):
        typer.echo(printable(line))


TimeOption = Annotated[
    float,
    typer.Option(
        metavar="T", help="Time of the operating point [s], reached with constant inputs."
    ),
]

StartOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Start value of an input, a parameter or a state. Repeatable.",
    ),
]

InputsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--input", metavar="NAME", help="Use these inputs only, in this order. Repeatable."
    ),
]

OutputsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--output", metavar="NAME", help="Use these outputs only, in this order. Repeatable."
    ),
]

DisturbancesOption = Annotated[
    list[str] | None,
    typer.Option(
        "--disturbance", metavar="NAME", help="With --toml: an unknown input. Repeatable."
    ),
]

DifferencesOption = Annotated[
    bool,
    typer.Option(
        "--differences",
        help="Use central differences even where the FMU has directional derivatives.",
    ),
]

TomlOption = Annotated[
    bool, typer.Option("--toml", help="Print a table for [models] of a scenario.")
]


def linearize(
    fmu: Annotated[Path, typer.Argument(metavar="FMU", help="An FMU for model exchange (.fmu).")],
    at: TimeOption = 0.0,
    values: StartOption = None,
    inputs: InputsOption = None,
    outputs: OutputsOption = None,
    disturbances: DisturbancesOption = None,
    differences: DifferencesOption = False,
    as_toml: TomlOption = False,
    as_json: JsonOption = False,
) -> None:
    """Linearize an FMU at an operating point.

    Print A, B, C and D, the poles and the static gain.
    """
    from cosim.fmi.linearizing.linearize import linearize_file
    from cosim.fmi.linearizing.request import LinearizationRequest
    from cosim.report.fmu import print_linearization
    from cosim.scenario.kinds.linearizing import model_toml

    if as_toml and as_json:
        raise UsageError("--toml and --json: give one of them")
    if disturbances and not as_toml:
        raise UsageError(
            "--disturbance NAME goes with --toml: "
            "a table of [models] separates known inputs from unknown ones"
        )
    request = LinearizationRequest(
        at=at,
        start=read_edits(values),
        inputs=inputs,
        outputs=outputs,
        method="central differences" if differences else None,
    )
    linearization = linearize_file(fmu, request)
    if as_toml:
        for note in linearization.notes:
            typer.echo(printable(f"note: {note}"), err=True)
        typer.echo(printable(model_toml(linearization, disturbances or [])), nl=False)
    else:
        print_linearization(linearization, as_json=as_json)
