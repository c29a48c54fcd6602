"""Names that load their modules when they are first used: an import costs nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from typing import Any, TypeVar, final

T = TypeVar("T")


def lazy_names(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package whose public names stand in other modules.

    Parameters
    ----------
    package : str
        Name of the package.
    homes : mapping of public name to module
    """

    def __getattr__(name: str) -> Any:  # noqa: N807
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(homes[name]), name)

    return __getattr__


@final
class LazyMapping(Mapping[str, T]):
    """Objects by name, of which each stands in a module of a package.

    Parameters
    ----------
    package : str
        Name of the package.
    homes : mapping of name to str
        Module and name there, such as ``"sources.SineKind"``.
    """

    def __init__(self, package: str, homes: Mapping[str, str]) -> None:
        self._package = package
        self.homes = dict(homes)

    def __getitem__(self, key: str) -> T:
        module, _, name = self.homes[key].rpartition(".")
        value: T = getattr(import_module(f"{self._package}.{module}"), name)
        return value

    def __contains__(self, key: object) -> bool:
        return key in self.homes

    def __iter__(self) -> Iterator[str]:
        return iter(self.homes)

    def __len__(self) -> int:
        return len(self.homes)
