"""What is recorded of components while they are built: what they read, metadata, warnings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, final

from cosim.scenario.kinds import Kind

Made = TypeVar("Made")


@dataclass(frozen=True, slots=True)
class KeptAnswer(Generic[Made]):
    """Something that is made once in a build, and what it was made of.

    Parameters
    ----------
    made : Made
    reads : frozenset of str
        Names of tables.
    looked_up : frozenset of str
        Names of components.
    """

    made: Made
    reads: frozenset[str]
    looked_up: frozenset[str]


class LookedUpKinds(Mapping[str, Kind]):
    """The tables of the components of a scenario, which records whose are looked up.

    Parameters
    ----------
    specs : mapping of component name to Kind
    records : BuildRecords
    """

    def __init__(self, specs: Mapping[str, Kind], records: BuildRecords) -> None:
        self._specs = specs
        self._records = records

    def __getitem__(self, name: str) -> Kind:
        self._records.look_up(name)
        return self._specs[name]

    def __contains__(self, name: object) -> bool:
        return name in self._specs

    def __iter__(self) -> Iterator[str]:
        return iter(self._specs)

    def __len__(self) -> int:
        return len(self._specs)


@final
class BuildRecords:
    """What is recorded of the components of a scenario while they are built.

    Attributes
    ----------
    current : str
        The component that is being built.
    metadata : dict of component name to plain values
    warned : list of (name, (component, text))
        Warnings, with the component that was being built.
    reads : dict of component name to names of tables
        That were read to build the component, and its design rests on.
    looked_up : dict of component name to set of names of components
        Whose tables were looked up to build the component, whatever was asked of them; all that it
        was made of, at least.
    attachments : dict of file name to text
        For the log.
    """

    def __init__(self) -> None:
        self.current = ""
        self.metadata: dict[str, dict[str, Any]] = {}
        self.warned: list[tuple[str, tuple[str, str]]] = []
        self.reads: dict[str, frozenset[str]] = {"": frozenset()}
        self.looked_up: dict[str, set[str]] = {"": set()}
        self.attachments: dict[str, str] = {}

    def begin(self, name: str) -> None:
        """Record what is read from now on for a component."""
        self.current = name
        self.reads[name] = frozenset()
        self.looked_up[name] = set()

    def read(self, *tables: str) -> None:
        """Record that tables are read."""
        self.reads[self.current] |= set(tables)

    def look_up(self, *components: str) -> None:
        """Record that tables of components are looked up."""
        self.looked_up[self.current].update(components)

    def made_by(self, make: Callable[[], Made]) -> KeptAnswer[Made]:
        """Make something; return it with the tables that were read and looked up for it."""
        current = self.current
        reads = self.reads[current]
        looked_up = self.looked_up[current]
        self.reads[current] = frozenset()
        self.looked_up[current] = set()
        try:
            made = make()
            return KeptAnswer(made, self.reads[current], frozenset(self.looked_up[current]))
        finally:
            self.reads[current] |= reads
            self.looked_up[current] |= looked_up

    def take(self, answer: KeptAnswer[Made]) -> Made:
        """Return what was made before, for which the same tables were read and looked up."""
        self.read(*answer.reads)
        self.look_up(*answer.looked_up)
        return answer.made

    def add_metadata(self, name: str, metadata: Mapping[str, Any]) -> None:
        """Record metadata of a component."""
        self.metadata.setdefault(name, {}).update(metadata)

    def warn(self, name: str, text: str) -> None:
        """Record a warning about a component."""
        self.warned.append((self.current, (name, text)))

    @property
    def warnings(self) -> list[tuple[str, str]]:
        """The warnings, each of a component and its text."""
        return [warning for _, warning in self.warned]
