"""What a scenario can be made of: the shipped scenarios, the component kinds, their parameters."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from cosim.errors import UsageError, nearest
from cosim.report.tables.console import new_table, print_json, print_line, print_table

if TYPE_CHECKING:
    from rich.table import Table

    from cosim.scenario.kinds import Kind
    from cosim.scenario.kinds.parameters import Parameter

INSTALLED_TITLE = "component kinds of installed packages, by entry points 'cosim.components'"
KINDS_TITLE = "component kinds ([optional] parameters; details: cosim list KIND)"


def print_catalog(*, as_json: bool) -> None:
    """Print the shipped scenarios and the component kinds with their parameters."""
    from cosim.scenario.document.document import find, shipped
    from cosim.scenario.document.schema import (
        ActionTable,
        ModelTable,
        RecordTable,
        Settings,
    )
    from cosim.scenario.kinds import KINDS
    from cosim.scenario.kinds.installed_kinds import installed_classes, refusal
    from cosim.scenario.kinds.parameters import parameters_of

    scenarios = {}
    for name in shipped():
        tree, _ = find(name).tree()
        scenarios[name] = tree["scenario"].get("description", "")
    tables = {
        "settings": ("keys of [scenario]", parameters_of(Settings)),
        "models": ("keys of a model in [models]", parameters_of(ModelTable)),
        "actions": ("keys of an action in [[actions]]", parameters_of(ActionTable)),
        "record": ("keys of [record]", parameters_of(RecordTable)),
    }
    installed = []
    for entries in installed_classes().values():
        for entry in entries:
            installed.append({**asdict(entry), "refused": refusal(entry, KINDS) or None})
    if as_json:
        content: dict[str, Any] = {"scenarios": scenarios}
        content |= {key: _plain_parameters(parameters) for key, (_, parameters) in tables.items()}
        content["kinds"] = {name: _plain(kind) for name, kind in KINDS.items()}
        content["installed"] = installed
        print_json(content)
        return
    described = [(name, description or name) for name, description in scenarios.items()]
    print_table(new_table("shipped scenarios", ("name", "description"), described))
    for title, parameters in tables.values():
        print_table(_parameters_table(title, parameters))
    kinds = []
    for name, kind in KINDS.items():
        kinds.append((name, kind.ports, _names(parameters_of(kind)), _description(kind)))
    print_table(new_table(KINDS_TITLE, ("kind", "ports", "parameters", "description"), kinds))
    if installed:
        rows = [[value or "" for value in entry.values()] for entry in installed]
        print_table(new_table(INSTALLED_TITLE, ("kind", "class", "package", ""), rows))


def print_kind(name: str, *, as_json: bool) -> None:
    """Print the ports of a component kind and its parameters, with defaults and meanings.

    Of the kind of an installed package nothing is imported.

    Raises
    ------
    UsageError
        If there is no such kind.
    """
    from cosim.scenario.kinds import KINDS
    from cosim.scenario.kinds.installed_kinds import installed_class, installed_classes
    from cosim.scenario.kinds.parameters import parameters_of

    if name in KINDS:
        kind = KINDS[name]
        if as_json:
            print_json(_plain(kind))
            return
        print_line(f"{name}: {_description(kind)}")
        print_line(f"ports: {kind.ports}")
        if kind.tunable_elsewhere:
            print_line(f"tunable: {kind.tunable_elsewhere}")
        print_table(_parameters_table("", parameters_of(kind), kind.tunable))
        return
    names = dict.fromkeys([*KINDS, *installed_classes()])
    if name not in names:
        raise UsageError(f"unknown kind {name!r}; {nearest(name, names)}")
    entry = installed_class(name)
    if as_json:
        print_json(asdict(entry))
        return
    print_line(f"{entry.kind}: {entry.class_name}, of {entry.distribution}")
    print_line("ports: those of the class")
    print_line("parameters: those of its constructor; nothing is imported here")


def _plain(kind: type[Kind]) -> dict[str, Any]:
    """Return a kind as JSON shows it."""
    from cosim.scenario.kinds.parameters import parameters_of

    return {
        "description": _description(kind),
        "ports": kind.ports,
        "tunable": list(kind.tunable),
        "parameters": _plain_parameters(parameters_of(kind)),
    }


def _plain_parameters(parameters: Iterable[Parameter]) -> dict[str, Any]:
    """Return keys of a table as JSON shows them."""
    entries = {}
    for parameter in parameters:
        entry = asdict(parameter)
        entries[entry.pop("name")] = entry
    return entries


def _description(kind: type[Kind]) -> str:
    return (kind.__doc__ or "").splitlines()[0]


def _parameters_table(
    title: str, parameters: Iterable[Parameter], tunable: Collection[str] = ()
) -> Table:
    """Return a table of keys, with their defaults, what they mean, and those that are tunable."""
    headings = ["parameter", "default", *(["in a run"] if tunable else []), "meaning"]
    rows = []
    for parameter in parameters:
        default = json.dumps(parameter.default)
        if parameter.required:
            default = "required"
        elif parameter.default is None or parameter.default in ({}, ""):
            default = "optional"
        row = [parameter.name, default]
        if tunable:
            row.append("tunable" if parameter.name in tunable else "")
        rows.append([*row, parameter.description])
    return new_table(title, headings, rows)


def _names(parameters: Iterable[Parameter]) -> str:
    """Return the names of the keys of a table, the optional ones in brackets."""
    names = []
    for parameter in parameters:
        if "." not in parameter.name:
            names.append(parameter.name if parameter.required else f"[{parameter.name}]")
    return ", ".join(names)
