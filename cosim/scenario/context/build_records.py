"""What is recorded of components while they are built: what they read, metadata, warnings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar, final

Made = TypeVar("Made")


@final
class BuildRecords:
    """What is recorded of the components of a scenario while they are built.

    Attributes
    ----------
    current : str
        The component that is being built.
    metadata : dict of component name to plain values
    warnings : list of (component, text)
    reads : dict of component name to names of tables
        That were read to build the component.
    attachments : dict of file name to text
        For the log.
    """

    def __init__(self) -> None:
        self.current = ""
        self.metadata: dict[str, dict[str, Any]] = {}
        self.warnings: list[tuple[str, str]] = []
        self.reads: dict[str, frozenset[str]] = {"": frozenset()}
        self.attachments: dict[str, str] = {}

    def begin(self, name: str) -> None:
        """Record what is read from now on for a component."""
        self.current = name
        self.reads[name] = frozenset()

    def read(self, *tables: str) -> None:
        """Record that tables are read."""
        self.reads[self.current] |= set(tables)

    def read_by(self, make: Callable[[], Made]) -> tuple[Made, frozenset[str]]:
        """Make something; return it, and the tables that were read for it."""
        before = self.reads[self.current]
        self.reads[self.current] = frozenset()
        try:
            made = make()
            return made, self.reads[self.current]
        finally:
            self.reads[self.current] |= before

    def add_metadata(self, name: str, metadata: Mapping[str, Any]) -> None:
        """Record metadata of a component."""
        self.metadata.setdefault(name, {}).update(metadata)

    def warn(self, name: str, text: str) -> None:
        """Record a warning about a component."""
        self.warnings.append((name, text))
