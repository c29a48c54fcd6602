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
    from cosim.scenario.user_kinds.installed_kinds import InstalledClass

INSTALLED_TITLE = "component kinds of installed packages, by entry points 'cosim.components'"
KINDS_TITLE = "component kinds ([optional] parameters; details: cosim list KIND)"


def print_catalog(*, as_json: bool) -> None:
    """Print the shipped scenarios and the component kinds with their parameters."""
    from cosim.scenario.document.document import find, shipped
    from cosim.scenario.document.schema import ActionTable, ModelTable, RecordTable, Settings
    from cosim.scenario.kinds import KINDS
    from cosim.scenario.kinds.parameters import parameters_of
    from cosim.scenario.user_kinds.installed_kinds import installed_classes

    scenarios = {}
    for name in shipped():
        tree, _ = find(name).tree()
        scenarios[name] = tree["scenario"].get("description", "")
    if as_json:
        kinds = {name: _plain(kind) for name, kind in KINDS.items()}
        settings = _plain_parameters(parameters_of(Settings))
        models = _plain_parameters(parameters_of(ModelTable))
        actions = _plain_parameters(parameters_of(ActionTable))
        entries = {
            "scenarios": scenarios,
            "settings": settings,
            "models": models,
            "actions": actions,
            "record": _plain_parameters(parameters_of(RecordTable)),
            "kinds": kinds,
            "installed": _plain_installed(),
        }
        print_json(entries)
        return
    table = new_table("shipped scenarios", ("name", "description"))
    for name, description in scenarios.items():
        table.add_row(name, description or name)
    print_table(table)
    print_table(_parameters_table("keys of [scenario]", parameters_of(Settings)))
    print_table(_parameters_table("keys of a model in [models]", parameters_of(ModelTable)))
    print_table(_parameters_table("keys of an action in [[actions]]", parameters_of(ActionTable)))
    print_table(_parameters_table("keys of [record]", parameters_of(RecordTable)))
    table = new_table(KINDS_TITLE, ("kind", "ports", "parameters", "description"))
    for name, kind in KINDS.items():
        table.add_row(name, kind.ports, _names(parameters_of(kind)), _description(kind))
    print_table(table)
    if installed_classes():
        print_table(_installed_table())


def print_kind(name: str, *, as_json: bool) -> None:
    """Print the ports of a component kind and its parameters, with defaults and meanings.

    Raises
    ------
    UsageError
        If there is no such kind.
    """
    from cosim.scenario.kinds import KINDS
    from cosim.scenario.kinds.parameters import parameters_of
    from cosim.scenario.user_kinds.installed_kinds import installed_class, installed_classes

    if name not in KINDS:
        names = dict.fromkeys([*KINDS, *installed_classes()])
        if name not in names:
            raise UsageError(f"unknown kind {name!r}; {nearest(name, names)}")
        _print_installed(installed_class(name), as_json=as_json)
        return
    kind = KINDS[name]
    if as_json:
        print_json(_plain(kind))
        return
    print_line(f"{name}: {_description(kind)}")
    print_line(f"ports: {kind.ports}")
    if kind.tunable_elsewhere:
        print_line(f"tunable: {kind.tunable_elsewhere}")
    print_table(_parameters_table("", parameters_of(kind), kind.tunable))


def _installed_table() -> Table:
    """Return a table of the kinds of installed packages, of which nothing is imported."""
    from cosim.scenario.kinds import KINDS
    from cosim.scenario.user_kinds.installed_kinds import installed_classes, refusal

    table = new_table(INSTALLED_TITLE, ("kind", "class", "package", ""))
    for classes in installed_classes().values():
        for entry in classes:
            reason = refusal(entry, KINDS)
            table.add_row(entry.kind, entry.class_name, entry.distribution, reason)
    return table


def _plain_installed() -> list[dict[str, Any]]:
    """Return the kinds of installed packages as JSON shows them."""
    from cosim.scenario.kinds import KINDS
    from cosim.scenario.user_kinds.installed_kinds import installed_classes, refusal

    entries = []
    for classes in installed_classes().values():
        for entry in classes:
            entries.append({**asdict(entry), "refused": refusal(entry, KINDS) or None})
    return entries


def _print_installed(entry: InstalledClass, *, as_json: bool) -> None:
    """Print what is known of the kind of an installed package, of which nothing is imported."""
    if as_json:
        print_json(asdict(entry))
        return
    print_line(f"{entry.kind}: {entry.class_name}, of {entry.distribution}")
    print_line("ports: those of the class")
    print_line("parameters: those of its constructor; nothing is imported here")


def _parameters_table(
    title: str, parameters: Iterable[Parameter], tunable: Collection[str] = ()
) -> Table:
    """Return a table of keys, with their defaults, what they mean, and those that are tunable."""
    headings = ("parameter", "default", "in a run", "meaning")
    table = new_table(title, headings if tunable else (*headings[:2], headings[-1]))
    for parameter in parameters:
        row = [parameter.name, _presence(parameter)]
        if tunable:
            row.append("tunable" if parameter.name in tunable else "")
        table.add_row(*row, parameter.description)
    return table


def _plain(kind: type[Kind]) -> dict[str, Any]:
    """Return a kind as JSON shows it."""
    from cosim.scenario.kinds.parameters import parameters_of

    parameters = _plain_parameters(parameters_of(kind))
    return {
        "description": _description(kind),
        "ports": kind.ports,
        "tunable": list(kind.tunable),
        "parameters": parameters,
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
