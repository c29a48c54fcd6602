"""What the shell may complete: scenarios, components, their parameters and ports.

The functions are called by the shell, with what was typed so far: they return candidates and never
fail, as a message would end up in the line that is being typed.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import typer

from cosim.errors import CosimError
from cosim.files import FileType, expanded, file_type

if TYPE_CHECKING:
    from cosim.scenario.kinds.base import Scenario

_READABLE: Final[tuple[FileType, ...]] = ("FMU", "log", "table")
FAILURES: Final = ("inconsistent", "no-estimate", "warning")  # that --fail-on takes
SETTINGS = "scenario"  # the table whose keys --set reaches like those of a component


def complete_scenario(incomplete: str) -> list[str]:
    """Return the shipped scenarios and the scenario files that begin so."""
    from cosim.scenario.document.document import shipped

    names = [name for name in shipped() if name.startswith(incomplete)]
    return names + list(_files(incomplete, "scenario"))


def complete_source(incomplete: str) -> list[str]:
    """Return what ``cosim info`` reads: scenarios, FMUs, logs, samples that begin so."""
    return complete_scenario(incomplete) + _readable(incomplete)


def complete_checked(incomplete: str) -> list[str]:
    """Return what ``cosim check`` checks: scenarios and FMUs that begin so."""
    return complete_scenario(incomplete) + list(_files(incomplete, "FMU"))


def complete_kind(incomplete: str) -> list[str]:
    """Return the component kinds that begin so."""
    from cosim.scenario.kinds import KINDS
    from cosim.scenario.kinds.user_component import installed_classes

    names = dict.fromkeys([*KINDS, *installed_classes()])
    return [name for name in names if name.startswith(incomplete)]


def complete_component(context: typer.Context, incomplete: str) -> list[str]:
    """Return the components of the scenario on the line that begin so."""
    return [name for name in _components(context) if name.startswith(incomplete)]


def complete_swap(context: typer.Context, incomplete: str) -> list[str]:
    """Return ``component=``, then files of FMUs, logs and samples."""
    component, equals, path = incomplete.partition("=")
    if not equals:
        return [f"{name}=" for name in complete_component(context, incomplete)]
    return [f"{component}={file}" for file in _readable(path)]


def complete_setting(context: typer.Context, incomplete: str) -> list[str]:
    """Return ``component.parameter=`` for what begins so."""
    scenario = _scenario(context)
    if scenario is None:
        return []
    candidates = list(_settings(scenario))
    return [text for text in candidates if text.startswith(incomplete)]


def complete_map(context: typer.Context, incomplete: str) -> list[str]:
    """Return ``port=`` for the ports of the scenario's connections that begin so."""
    scenario = _scenario(context)
    if scenario is None:
        return []
    ports = []
    for to, connection in scenario.connections.items():
        ports += [str(to), *map(str, connection.sources)]
    return [f"{port}=" for port in dict.fromkeys(ports) if port.startswith(incomplete)]


def complete_failures(incomplete: str) -> list[str]:
    """Return what ``--fail-on`` takes that begins so, after a comma too."""
    before, comma, begin = incomplete.rpartition(",")
    return [f"{before}{comma}{name}" for name in FAILURES if name.startswith(begin)]


def complete_estimators(incomplete: str) -> list[str]:
    """Return ``all`` and the methods of an identifier that begin so, after a comma too."""
    from cosim.scenario.kinds.variants import METHODS

    before, comma, begin = incomplete.rpartition(",")
    names = [*METHODS] if comma else ["all", *METHODS]
    return [f"{before}{comma}{name}" for name in names if name.startswith(begin)]


def _settings(scenario: Scenario) -> Iterator[str]:
    from cosim.scenario.document.document import short
    from cosim.scenario.document.schema import Settings
    from cosim.scenario.kinds import parameters_of

    for name, kind in scenario.specs.items():
        for parameter in parameters_of(type(kind)):
            yield f"{short(f'components.{name}.{parameter.name}')}="
    for key in Settings.model_fields:
        yield f"{SETTINGS}.{key}="


def _components(context: typer.Context) -> list[str]:
    scenario = _scenario(context)
    return [] if scenario is None else list(scenario.specs)


def _scenario(context: typer.Context) -> Scenario | None:
    """Return the scenario that stands on the line; None: there is none, or it has problems.

    Nothing of it is built, as that may run code of its user.
    """
    from cosim.scenario.building.build import read
    from cosim.scenario.document.document import find

    # an option that still lacks its value leaves the arguments before it unread
    candidates = [context.params.get("scenario"), *context.args]
    for name in candidates:
        if isinstance(name, str):
            with suppress(CosimError, OSError):
                scenario, problems = read(find(name))
                return None if problems else scenario
    return None


def _readable(incomplete: str) -> list[str]:
    """Return paths of FMUs, logs and tables that begin so, and folders."""
    paths: list[str] = []
    for kind in _READABLE:
        paths += _files(incomplete, kind)
    return list(dict.fromkeys(paths))


def _files(incomplete: str, wanted: FileType) -> Iterator[str]:
    """Yield paths that begin so: files of a type, and folders."""
    folder, slash, begin = incomplete.rpartition("/")
    with suppress(OSError):
        for path in sorted(expanded(folder + slash or ".").iterdir()):
            if path.name.startswith(begin) and not path.name.startswith("."):
                if path.is_dir():
                    yield f"{folder}{slash}{path.name}/"
                elif file_type(path) == wanted:
                    yield f"{folder}{slash}{path.name}"
