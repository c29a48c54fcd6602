"""What a log, an FMU or a scenario contains, as tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from cosim.arguments import path_argument
from cosim.errors import LogError, UsageError
from cosim.files import file_type
from cosim.report.tables.console import print_json, print_sections


def print_contents(source: str, *, as_json: bool) -> None:
    """Print what a log, an FMU, a table of samples or a scenario contains.

    Raises
    ------
    UsageError
        If it is a folder; LogError: if not all of a log can be understood.
    """
    from cosim.log.foreign.topics import is_foreign
    from cosim.report import inspection
    from cosim.report.fmu import describe_fmu, print_fmu

    path = path_argument("source", source)
    if path.is_dir():
        raise UsageError(
            f"{source}: expected a log (.mcap), an FMU (.fmu), samples (.csv, .xlsx, ...) or a "
            "scenario, got a folder"
        )
    source_type = file_type(path)
    match source_type:
        case "log" if is_foreign(path):
            content = inspection.describe_recording(source)
        case "log":
            content = inspection.describe_log(source)
        case "FMU":
            content = describe_fmu(source)
        case "table":
            content = inspection.describe_samples(source)
        case _:
            content = inspection.describe_scenario(source)
    problems = content.get("problems", [])
    if as_json:
        print_json(content)
    elif source_type == "FMU":
        print_fmu(content)
    else:
        print_sections(_sections(content))
    if problems:
        raise LogError("\n".join(problems))


def _sections(content: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the sections; differences between swapped and replaced components by component."""
    from cosim.scenario.recordings.swap_report import row_texts

    for title, section in content.items():
        if title == "problems":  # printed as an error
            continue
        if title != "differences":
            yield title, section
            continue
        for component, rows in section.items():
            texts = [row_texts(row, whole=row["port"] == component) for row in rows]
            yield f"{component}: differences from the replaced component", texts
