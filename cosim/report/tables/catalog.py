"""What a scenario can be made of: the shipped scenarios, the component kinds, their parameters."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

from rich.table import Table

from cosim.errors import UsageError, nearest
from cosim.report.tables.console import Shown, new_table

if TYPE_CHECKING:
    from cosim.scenario.kinds import Kind

INSTALLED_TITLE = "component kinds of installed packages, by entry points 'cosim.components'"
KINDS_TITLE = "component kinds ([optional] parameters; details: cosim list KIND)"
_TITLES: Final = {
    "settings": "keys of [scenario]",
    "models": "keys of a model in [models]",
    "actions": "keys of an action in [[actions]]",
    "record": "keys of [record]",
}


def show_catalog() -> Shown:
    """Show the shipped scenarios and the component kinds with their parameters."""
    from cosim.scenario.document.document import find, shipped
    from cosim.scenario.document.schema import ActionTable, ModelTable, RecordTable, Settings
    from cosim.scenario.kinds import KINDS
    from cosim.scenario.kinds.user_component import installed_classes, refusal

    scenarios = {}
    for name in shipped():
        tree = find(name).tables().tree
        scenarios[name] = tree["scenario"].get("description", "")
    installed = []
    for entries in installed_classes().values():
        installed += [{**asdict(one), "refused": refusal(one, KINDS) or None} for one in entries]
    content: dict[str, Any] = {
        "scenarios": scenarios,
        "settings": _parameters(Settings),
        "models": _parameters(ModelTable),
        "actions": _parameters(ActionTable),
        "record": _parameters(RecordTable),
        "kinds": {name: _plain(kind) for name, kind in KINDS.items()},
        "installed": installed,
    }
    yield content
    described = [(name, description or name) for name, description in scenarios.items()]
    yield new_table("shipped scenarios", ("name", "description"), described)
    for key, title in _TITLES.items():
        yield _parameter_table(title, content[key])
    kinds = []
    for name, kind in content["kinds"].items():
        names = []
        for key, parameter in kind["parameters"].items():
            if "." not in key:
                names.append(key if parameter["required"] else f"[{key}]")
        kinds.append((name, kind["ports"], ", ".join(names), kind["description"]))
    yield new_table(KINDS_TITLE, ("kind", "ports", "parameters", "description"), kinds)
    if installed:
        rows = [[value or "" for value in entry.values()] for entry in installed]
        yield new_table(INSTALLED_TITLE, ("kind", "class", "package", ""), rows)


def show_kind(name: str) -> Shown:
    """Show the ports of a component kind and its parameters, with defaults and meanings.

    Of the kind of an installed package nothing is imported.

    Raises
    ------
    UsageError
        If there is no such kind.
    """
    from cosim.scenario.kinds import KINDS
    from cosim.scenario.kinds.user_component import installed_class, installed_classes

    names = dict.fromkeys([*KINDS, *installed_classes()])
    if name not in names:
        raise UsageError(f"unknown kind {name!r}; {nearest(name, names)}")
    content = _plain(KINDS[name]) if name in KINDS else asdict(installed_class(name))
    yield content
    if name in KINDS:
        yield f"{name}: {content['description']}"
        yield f"ports: {content['ports']}"
        if KINDS[name].tunable_elsewhere:
            yield f"tunable: {KINDS[name].tunable_elsewhere}"
        yield _parameter_table("", content["parameters"], content["tunable"])
    else:
        yield f"{name}: {content['class_name']}, of {content['distribution']}"
        yield "ports: those of the class"
        yield "parameters: those of its constructor; nothing is imported here"


def _plain(kind: type[Kind]) -> dict[str, Any]:
    """Return a kind as JSON shows it."""
    return {
        "description": (kind.__doc__ or "").splitlines()[0],
        "ports": kind.ports,
        "tunable": list(kind.tunable),
        "parameters": _parameters(kind),
    }


def _parameters(table: type[Any]) -> dict[str, Any]:
    """Return the keys of a table as JSON shows them."""
    from cosim.scenario.kinds import parameters_of

    entries = [asdict(parameter) for parameter in parameters_of(table)]
    return {entry.pop("name"): entry for entry in entries}


def _parameter_table(
    title: str, parameters: Mapping[str, Any], tunable: Collection[str] = ()
) -> Table:
    """Return keys with their defaults, what they mean, and which are tunable, where any is."""
    rows = []
    for name, parameter in parameters.items():
        default = json.dumps(parameter["default"])
        if parameter["required"]:
            default = "required"
        elif parameter["default"] in (None, {}, ""):
            default = "optional"
        in_a_run = ["tunable" if name in tunable else ""] if tunable else []
        rows.append([name, default, *in_a_run, parameter["description"]])
    in_a_run = ["in a run"] if tunable else []
    return new_table(title, ("parameter", "default", *in_a_run, "meaning"), rows)
