"""The component kinds of installed packages, by their entry points ``cosim.components``.

An entry point ``relay = "relay_package.parts:Relay"`` of that group makes ``kind = "relay"``
available: a component of the class, with the parameters of its constructor. Nothing is imported to
know of it. The names of the kinds that come with cosim stand for these, whatever is installed.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Final

from cosim.errors import UsageError

GROUP: Final = "cosim.components"


@dataclass(frozen=True, slots=True)
class InstalledClass:
    """An entry point.

    Parameters
    ----------
    kind : str
    class_name : str
        ``package.module:Class``.
    distribution : str
        Name and version of the package that declares it.
    """

    kind: str
    class_name: str
    distribution: str


def installed_classes() -> Mapping[str, list[InstalledClass]]:
    """Return all entry points by kind; more than one where packages declare the same."""
    classes: dict[str, list[InstalledClass]] = {}
    for point in entry_points(group=GROUP):
        about = "an unknown package"
        if point.dist is not None:
            about = f"{point.dist.name} {point.dist.version}"
        class_name = f"{point.module}:{point.attr}" if point.attr else point.value
        installed = InstalledClass(point.name, class_name, about)
        classes.setdefault(point.name, []).append(installed)
    return dict(sorted(classes.items()))


def installed_class(kind: str) -> InstalledClass:
    """Return the class of a kind.

    Raises
    ------
    UsageError
        If no installed package declares it, or several do.
    """
    classes = installed_classes().get(kind, [])
    if not classes:
        raise UsageError(
            f"no installed package declares the kind {kind!r}; expected one with an entry point "
            f"{kind!r} in the group {GROUP!r}"
        )
    if len(classes) > 1:
        packages = ", ".join(entry.distribution for entry in classes)
        raise UsageError(
            f"the kind {kind!r} is declared {len(classes)} times, by {packages}; expected one; "
            'kind = "python" with class = "package.module:Class" selects a class'
        )
    return classes[0]


def refusal(entry: InstalledClass, shipped: Collection[str]) -> str:
    """Return why an entry point makes no kind; empty: it does."""
    if entry.kind in shipped:
        return f"refused: {entry.kind!r} is a kind of cosim itself; rename it"
    if ":" not in entry.class_name:
        return f"refused: expected 'package.module:Class', got {entry.class_name!r}"
    if len(installed_classes()[entry.kind]) > 1:
        return f"refused: {entry.kind!r} is declared more than once"
    return ""
