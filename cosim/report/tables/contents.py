"""What a log, an FMU or a scenario contains; the shipped scenarios and the component kinds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.report.tables.console import new_table, print_json, print_section, print_table

if TYPE_CHECKING:
    from cosim.scenario.kinds import Kind

REQUIRED = "required"
OPTIONAL = "optional"


def print_contents(source: str, *, as_json: bool) -> None:
    """Print what a log, an FMU or a scenario contains."""
    from cosim.report import inspection
    from cosim.report.tables.fmu import print_fmu

    suffix = Path(source).suffix.lower()
    match suffix:
        case ".mcap":
            content = inspection.describe_log(source)
        case ".fmu":
            content = inspection.describe_fmu(source)
        case _:
            content = inspection.describe_scenario(source)
    if as_json:
        print_json(content)
    elif suffix == ".fmu":
        print_fmu(content)
    else:
        for title, section in content.items():
            print_section(title, section)


def print_catalogue(*, as_json: bool) -> None:
    """Print the shipped scenarios and the component kinds with their parameters."""
    from cosim.scenario.document import shipped
    from cosim.scenario.execution import load
    from cosim.scenario.kinds import KINDS

    scenarios = {name: load(name).file.scenario.description for name in shipped()}
    descriptions = {name: (kind.__doc__ or "").splitlines()[0] for name, kind in KINDS.items()}
    parameters = {name: _parameters(kind) for name, kind in KINDS.items()}
    if as_json:
        kinds = {}
        for name, description in descriptions.items():
            kinds[name] = {"description": description, "parameters": parameters[name]}
        print_json({"scenarios": scenarios, "kinds": kinds})
        return
    table = new_table("shipped scenarios", ("name", "description"))
    for name, description in scenarios.items():
        table.add_row(name, description or name)
    print_table(table)
    table = new_table("component kinds", ("kind", "parameters", "description"))
    for name, description in descriptions.items():
        table.add_row(name, _parameter_lines(parameters[name]), description)
        table.add_section()
    print_table(table)


def _parameters(kind: type[Kind]) -> dict[str, str]:
    """Return ``required``, ``optional`` or the default of each parameter, the required first."""
    required: dict[str, str] = {}
    others: dict[str, str] = {}
    for name, field in kind.model_fields.items():
        if name == "kind":
            continue
        if field.is_required():
            required[name] = REQUIRED
        else:
            others[name] = OPTIONAL if field.default is None else repr(field.default)
    return required | others


def _parameter_lines(parameters: Mapping[str, str]) -> str:
    lines = []
    for name, default in parameters.items():
        match default:
            case "required":
                lines.append(name)
            case "optional":
                lines.append(f"{name} (optional)")
            case _:
                lines.append(f"{name} = {default}")
    return "\n".join(lines)
