"""What the commands print: tables for people, JSON for programs."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.table import Table

from cosim.errors import UsageError

if TYPE_CHECKING:
    from cosim.arrays import Matrix
    from cosim.core.contracts import Recording
    from cosim.fmi.linearizing.linearization import Linearization
    from cosim.log.diff import LogDifference
    from cosim.report.comparing import Comparison
    from cosim.report.summary import Identification, Summary
    from cosim.scenario.build import Scenario

WIDTH = 118  # where stdout is no terminal


def summary(
    recording: Recording,
    *,
    path: Path | None,
    wall: Mapping[str, float],
    profile: Mapping[str, float] | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Print what a run found."""
    from cosim.report.summary import summarize

    found = summarize(recording)
    if as_json:
        extra: dict[str, Any] = {"wall": dict(wall), "log": None if path is None else str(path)}
        _json(found.to_dict() | extra | ({} if profile is None else {"profile": dict(profile)}))
        return
    if quiet:
        return
    for name, text in _warnings(recording):
        typer.echo(f"warning: {name}: {text}", err=True)
    title = f"{found.scenario}: {found.end:g} s in {found.steps} steps"
    table = (
        _errors(title, found)
        if found.signals or found.values
        else _last_values(title, found, recording)
    )
    if found.reason:
        table.add_row("why it ended", "", "", found.reason)
    for identification in found.identifications:
        _identification(table, identification)
    for loop in found.loops:
        table.add_row(
            "loop",
            "",
            "",
            f"{loop}: step by step, so with an error of first order in the step; compare with --step",
        )
    table.add_section()
    total = sum(wall.values())
    parts = ", ".join(f"{part} {seconds:.2f} s" for part, seconds in wall.items())
    table.add_row(
        "wall time", f"{total:.2f} s", "", f"{parts}: {found.end / total:.3g} x real time"
    )
    if path is not None:
        table.add_row("log", "", "", str(path))
    console = _console()
    _show(console, table)
    if profile is not None:
        _profile(console, profile)


def _errors(title: str, found: Summary) -> Table:
    table = _table(title, ("", "estimate", "truth", "error"))
    for signal in found.signals:
        text = f"{signal.largest:.3g}  (largest for t >= {signal.since:g} s; at the end {signal.last:.3g})"
        table.add_row(signal.estimate, "", signal.truth, text)
    for value in found.values:
        shown = (
            ("no value", "")
            if value.value is None
            else (f"{value.value:+.6f}", f"{value.error:.3g}")
        )
        table.add_row(value.estimate, shown[0], f"{value.truth:+g}", shown[1])
    return table


def _last_values(title: str, found: Summary, recording: Recording) -> Table:
    """Where there is no truth to compare with, show what the outputs ended with."""
    from cosim.report.summary import signal_of

    table = _table(title, ("", "at the end", "", ""))
    for name, last in found.last.items():
        values = last if isinstance(last, list) else [last]
        table.add_row(
            name,
            " ".join(f"{value:.6g}" for value in values),
            "",
            signal_of(recording, name).unit or "",
        )
    return table


def _identification(table: Table, found: Identification) -> None:
    table.add_section()
    times = found.times
    made = "given"
    if "T_id" in times:
        made = f"T_obs {times['T_obs']:.4f} + T_f {times['T_f']:.4f} + D_max {times['D_max']:g} = {times['T_id']:.4f} s (36)"
    table.add_row(f"{found.component} starts", f"{found.start_time:g} s", "", made)
    if found.eigenvalues:
        table.add_row(
            "information in delta",
            "",
            "",
            "eigenvalues " + ", ".join(f"{value:.3g}" for value in found.eigenvalues),
        )
    for text in (found.verdict, *found.notes):
        table.add_row("", "", "", text)


def _profile(console: Console, profile: Mapping[str, float]) -> None:
    total = sum(profile.values())
    table = _table("where the time went", ("", "s", "%"))
    for name, seconds in sorted(profile.items(), key=lambda item: -item[1]):
        table.add_row(name, f"{seconds:.4f}", f"{100 * seconds / total:.1f}" if total else "")
    _show(console, table)


def _warnings(recording: Recording) -> list[tuple[str, str]]:
    found = json.loads(recording.metadata.get("cosim.run", {}).get("warnings", "[]"))
    return [(name, text) for name, text in found]


def verification(
    source: Recording, again: Recording, *, path: Path, as_json: bool, quiet: bool
) -> None:
    """Say whether a replay equals its log bit for bit; exit 1 at the first difference."""
    from cosim.log.diff import diff
    from cosim.log.environment import environment_changes

    found = diff(source, again)
    if as_json:
        _json(found.to_dict())
    elif found.equal and not quiet:
        typer.echo(f"{path}: the replay equals the log bit for bit: {len(found.rows)} signals")
    if found.equal:
        return
    if not as_json:
        first = found.first
        where = "the logs do not have the same signals and times"
        if first is not None:
            where = f"{first.signal} at t = {first.time_ns / 1e9} s: log {first.a!r}, replay {first.b!r}"
        typer.echo(f"{path}: the replay differs from the log; first: {where}", err=True)
        for key, (then, now) in environment_changes(source).items():
            typer.echo(
                f"note: {key} was {then}, is {now}; sin, exp and log may differ in their last bit",
                err=True,
            )
    raise typer.Exit(1)


def difference(found: LogDifference, *, as_json: bool) -> None:
    """Print how far two logs are from each other."""
    if as_json:
        _json(found.to_dict())
        return
    table = _table("", ("signal", "", "largest |a - b|", "largest |a|", "ratio", "first outside"))
    for row in found.rows:
        first = (
            ""
            if row.first is None
            else f"{row.first.signal} at {row.first.time_ns / 1e9} s: {row.first.a!r}, {row.first.b!r}"
        )
        table.add_row(
            row.signal,
            row.status,
            f"{row.largest:.3g}",
            f"{row.scale:.3g}",
            f"{row.ratio:.3g}",
            first,
        )
    _show(_console(), table)
    if any(row.largest > 0.0 and row.signal.endswith(".delta") for row in found.rows):
        typer.echo(
            "note: a reconstructed disturbance multiplies the last bit of y by filter_rate; give it a tolerance of its own"
        )


def catalogue(*, as_json: bool) -> None:
    """List scenarios and component kinds."""
    from cosim.scenario.document import find, shipped
    from cosim.scenario.execution import load
    from cosim.scenario.kinds import KINDS

    scenarios = {name: load(name).file.scenario.description for name in shipped()}
    does = {kind: (cls.__doc__ or "").splitlines()[0] for kind, cls in KINDS.items()}
    parameters = {kind: _parameters(cls) for kind, cls in KINDS.items()}
    if as_json:
        kinds = {kind: {"does": does[kind], "parameters": parameters[kind]} for kind in KINDS}
        _json({"scenarios": scenarios, "kinds": kinds})
        return
    console = _console()
    table = _table("shipped scenarios", ("name", "what it is"))
    for name, text in scenarios.items():
        table.add_row(name, text or find(name).source)
    _show(console, table)
    table = _table("component kinds", ("kind", "parameters", "what it does"))
    for kind in KINDS:
        lines = [
            f"{key}{'' if default == 'required' else f' = {default}'}"
            for key, default in parameters[kind].items()
        ]
        table.add_row(kind, "\n".join(lines), does[kind])
        table.add_section()
    _show(console, table)


def _parameters(cls: Any) -> dict[str, str]:
    shown = {}
    for name, field in cls.model_fields.items():
        if name != "kind":
            default = (
                "required"
                if field.is_required()
                else repr(field.default).replace("None", "left out")
            )
            shown[name] = default
    return shown


def info(what: str, *, as_json: bool) -> None:
    """Show what a log, an FMU or a scenario contains."""
    from cosim.report import inspection

    suffix = Path(what).suffix.lower()
    describe = {".mcap": inspection.log, ".fmu": inspection.fmu}.get(suffix, inspection.scenario)
    found = describe(what)
    if as_json:
        _json(found)
        return
    console = _console()
    shown = inspection.shown_fmu(found) if suffix == ".fmu" else found
    for title, content in shown.items():
        _section(console, title, content)


def check(path: str, *, as_json: bool) -> None:
    """Print everything that is wrong with an FMU; exit 1 where there is an error."""
    from cosim.report import inspection

    found = inspection.check(path)
    errors, warnings = (
        sum(finding["level"] == level for finding in found) for level in ("error", "warning")
    )
    if as_json:
        _json({"path": path, "errors": errors, "warnings": warnings, "findings": found})
    else:
        for finding in found:
            typer.echo(f"{finding['level']}: {finding['where']}: {finding['text']}")
        counts = ", ".join(
            f"{n} {what}{'s' * (n > 1)}"
            for n, what in ((errors, "error"), (warnings, "warning"))
            if n
        )
        typer.echo(f"{path}: {counts or 'nothing is wrong with it'}")
    if errors:
        raise typer.Exit(1)


def _section(console: Console, title: str, content: Any) -> None:
    if not content:
        return
    if isinstance(content, list):
        columns = list(content[0]) if content else []
        table = _table(title, columns)
        for row in content:
            table.add_row(*(_text(row.get(column)) for column in columns))
        _show(console, table)
    elif isinstance(content, Mapping):
        table = _table(title, ("", ""))
        for key, value in content.items():
            table.add_row(key, _text(value))
        _show(console, table)


def linearization(found: Linearization, *, as_json: bool) -> None:
    """Print a linearization: matrices with names, poles, static gain, where it comes from."""
    gain = found.static_gain
    if as_json:
        poles = [[pole.real, pole.imag] for pole in found.poles.tolist()]
        _json(
            found.to_dict()
            | {"poles": poles, "static_gain": None if gain is None else gain.tolist()}
        )
        return
    console = _console()
    point = _table(f"{found.name} at t = {found.t:g} s", ("", "value", "derivative"))
    for name, x, dx in zip(found.states, found.x, found.dx, strict=True):
        point.add_row(name, f"{x:.6g}", f"{dx:.6g}")
    for name, value in (
        *zip(found.inputs, found.u, strict=True),
        *zip(found.outputs, found.y, strict=True),
    ):
        point.add_row(name, f"{value:.6g}", "")
    _show(console, point)
    derivatives = [f"der({name})" for name in found.states]
    blocks = {
        "A": (found.A, derivatives, found.states),
        "B": (found.B, derivatives, found.inputs),
        "C": (found.C, found.outputs, found.states),
        "D": (found.D, found.outputs, found.inputs),
    }
    for letter, (matrix, rows, columns) in blocks.items():
        error = found.errors[letter]
        _matrix(
            console,
            letter if error is None else f"{letter}, error up to {error:.1g}",
            matrix,
            rows=rows,
            columns=columns,
        )
    if gain is not None:
        _matrix(console, "static gain D - C A^-1 B", gain, rows=found.outputs, columns=found.inputs)
    about = _table("", ("", ""))
    about.add_row(
        "poles",
        ", ".join(f"{p.real:.6g}" if p.imag == 0.0 else f"{p:.6g}" for p in found.poles.tolist())
        or "none",
    )
    if gain is None:
        about.add_row("static gain", "none, as A is singular")
    about.add_row("columns by", ", ".join(dict.fromkeys(found.made.values())))
    for note in found.notes:
        about.add_row("note", note)
    _show(console, about)


def _matrix(
    console: Console, title: str, matrix: Matrix, *, rows: Sequence[str], columns: Sequence[str]
) -> None:
    if matrix.size:
        table = _table(title, ("", *columns))
        for name, row in zip(rows, matrix.tolist(), strict=True):
            table.add_row(name, *(f"{value:.6g}" for value in row))
        _show(console, table)


def comparison(scenario: Scenario, *, as_json: bool) -> None:
    """Compare swapped components with those they replace; exit 2 where the scenario cannot run with them."""
    from cosim.scenario.swap_report import examine

    found = examine(scenario.document)
    problems = [*found.problems, *filter(None, [found.failure])]
    if as_json:
        _json(
            {
                "swaps": {name: report.to_dict() for name, report in found.reports.items()},
                "problems": problems,
            }
        )
    else:
        console = _console()
        for report in found.reports.values():
            _section(console, report.component, report.lines)
        if not problems:
            typer.echo("dry run: the scenario can run")
    if problems:
        raise UsageError("\n".join([*problems, *found.hints]))


def plants(found: Comparison, *, as_json: bool) -> None:
    """Print what a scenario estimates on several plants, and how far the estimates are from those of the first."""
    if as_json:
        _json(found.to_dict())
        return
    first = next(iter(found.recordings), "")
    table = _table(
        f"{found.scenario}: {found.component}",
        ("estimate", "truth", "plant", "value", "error", f"from {first}"),
    )
    apart = {(one.estimate, one.label): one.largest for one in found.differences}
    rows = [
        row
        for label, summary in found.summaries.items()
        for row in _plant_rows(label, summary, apart)
    ]
    for estimate in dict.fromkeys(row[0] for row in rows):
        for row in [row for row in rows if row[0] == estimate]:
            table.add_row(*row)
        table.add_section()
    for outcome in found.outcomes:
        if outcome.error:
            table.add_row("", "", outcome.label, "failed", outcome.error.splitlines()[0], "")
    _show(_console(), table)
    for outcome in found.outcomes:
        if outcome.error:
            typer.echo(
                "\n".join(
                    f"{outcome.label}: failed: {line}" for line in outcome.error.splitlines()
                ),
                err=True,
            )


def _plant_rows(
    label: str, found: Summary, apart: Mapping[tuple[str, str], Sequence[float | None]]
) -> Iterator[tuple[str, str, str, str, str, str]]:
    """Give (estimate, truth, plant, value, error, difference)."""
    for signal in found.signals:
        largest = [one for one in apart.get((signal.estimate, label), ()) if one is not None]
        error = f"{signal.largest:.3g} for t >= {signal.since:g} s"
        yield (
            signal.estimate,
            signal.truth,
            label,
            "",
            error,
            f"{max(largest):.3g}" if largest else "",
        )
    for value in found.values:
        name, element = re.fullmatch(r"(.*?)(?:\[(\d+)\])?", value.estimate).groups()  # type: ignore[union-attr]
        differences = apart.get((name, label), ())
        difference = differences[int(element or 0)] if differences else None
        shown = (
            ("no value", "")
            if value.value is None
            else (f"{value.value:+.6f}", f"{value.error:.3g}")
        )
        yield (
            value.estimate,
            f"{value.truth:+g}",
            label,
            *shown,
            "" if difference is None else f"{difference:.3g}",
        )


def _text(value: Any) -> str:
    return (
        ""
        if value is None
        else value
        if isinstance(value, str)
        else json.dumps(value)
        if isinstance(value, (list, dict))
        else str(value)
    )


def _table(title: str, columns: Sequence[str]) -> Table:
    table = Table(title=title, header_style="", box=None, padding=(0, 2, 0, 0))
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _show(console: Console, table: Table) -> None:
    """Print the title on a line of its own, which a narrow table would break."""
    if table.title:
        console.print(table.title, style="bold", soft_wrap=True)
        table.title = None
    console.print(table)


def _console() -> Console:
    console = Console(highlight=False, markup=False, emoji=False)
    return (
        console
        if console.is_terminal
        else Console(highlight=False, markup=False, emoji=False, width=WIDTH, soft_wrap=False)
    )


def _json(content: Any) -> None:
    typer.echo(json.dumps(_strict(content), indent=2, allow_nan=False, default=str))


def _strict(content: Any) -> Any:
    """Write what JSON has no numbers for as the strings "nan", "inf" and "-inf"."""
    if isinstance(content, float):
        return content if math.isfinite(content) else str(content)
    if isinstance(content, Mapping):
        return {key: _strict(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_strict(value) for value in content]
    return content
