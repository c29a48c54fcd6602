"""What a scenario can be made of: the shipped scenarios, the component kinds, their parameters."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from cosim.errors import UsageError, nearest
from cosim.report.tables.console import new_table, print_json, print_line, print_table

if TYPE_CHECKING:
    from rich.table import Table

    from cosim.scenario.kinds import Kind
    from cosim.scenario.kinds.parameters import Parameter

KINDS_TITLE = "component kinds; [optional parameters]; 'cosim list KIND' explains the parameters"


def print_catalog(*, as_json: bool) -> None:
    """Print the shipped scenarios and the component kinds with their parameters."""
    from cosim.scenario.document import find, shipped
    from cosim.scenario.kinds import KINDS
    from cosim.scenario.kinds.parameters import parameters_of
    from cosim.scenario.schema import ModelTable, Settings

    scenarios = {}
    for name in shipped():
        tree, _ = find(name).tree()
        scenarios[name] = tree["scenario"].get("description", "")
    if as_json:
        kinds = {name: _plain(kind) for name, kind in KINDS.items()}
        settings = _plain_parameters(parameters_of(Settings))
        models = _plain_parameters(parameters_of(ModelTable))
        entries = {"scenarios": scenarios, "settings": settings, "models": models, "kinds": kinds}
        print_json(entries)
        return
    table = new_table("shipped scenarios", ("name", "description"))
    for name, description in scenarios.items():
        table.add_row(name, description or name)
    print_table(table)
    print_table(_parameters_table("keys of [scenario]", parameters_of(Settings)))
    print_table(_parameters_table("keys of a table of [models]", parameters_of(ModelTable)))
    table = new_table(KINDS_TITLE, ("kind", "ports", "parameters", "description"))
    for name, kind in KINDS.items():
        table.add_row(name, kind.ports, _names(parameters_of(kind)), _description(kind))
    print_table(table)


def print_kind(name: str, *, as_json: bool) -> None:
    """Print the ports of a component kind and its parameters, with defaults and meanings.

    Raises
    ------
    UsageError
        If there is no such kind.
    """
    from cosim.scenario.kinds import KINDS
    from cosim.scenario.kinds.parameters import parameters_of

    if name not in KINDS:
        raise UsageError(f"unknown kind {name!r}; {nearest(name, KINDS)}")
    kind = KINDS[name]
    if as_json:
        print_json(_plain(kind))
        return
    print_line(f"{name}: {_description(kind)}")
    print_line(f"ports: {kind.ports}")
    print_table(_parameters_table("", parameters_of(kind)))


def _parameters_table(title: str, parameters: Iterable[Parameter]) -> Table:
    """Return a table of keys, with their defaults and what they mean."""
    table = new_table(title, ("parameter", "default", "meaning"))
    for parameter in parameters:
        table.add_row(parameter.name, _presence(parameter), parameter.description)
    return table


def _plain(kind: type[Kind]) -> dict[str, Any]:
    """Return a kind as JSON shows it."""
    from cosim.scenario.kinds.parameters import parameters_of

    parameters = _plain_parameters(parameters_of(kind))
    return {"description": _description(kind), "ports": kind.ports, "parameters": parameters}


def _plain_parameters(parameters: Iterable[Parameter]) -> dict[str, Any]:
    """Return keys of a table as JSON shows them."""
    entries = {}
    for parameter in parameters:
        entry = asdict(parameter)
        entries[entry.pop("name")] = entry
    return entries


def _description(kind: type[Kind]) -> str:
    return (kind.__doc__ or "").splitlines()[0]


def _presence(parameter: Parameter) -> str:
    """Return ``required``, ``optional``, or the default as TOML writes it."""
    if parameter.required:
        return "required"
    if parameter.default is None or parameter.default in ({}, ""):
        return "optional"
    return json.dumps(parameter.default)


def _names(parameters: Iterable[Parameter]) -> str:
    """Return the names of the keys of a table, the optional ones in brackets."""
    names = []
    for parameter in parameters:
        if "." not in parameter.name:
            names.append(parameter.name if parameter.required else f"[{parameter.name}]")
    return ", ".join(names)
