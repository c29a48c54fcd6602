"""From the text of a scenario to its validated tables."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from pydantic import ValidationError

from cosim.arguments import mapping_argument, swap_argument
from cosim.core.connections import ONE_SOURCE, Connection, components_driving
from cosim.core.port import Port
from cosim.errors import CosimError, GraphError, nearest, quoted
from cosim.scenario.document.document import Document
from cosim.scenario.document.places import Key, Problem
from cosim.scenario.document.problems import TableProblems, problems_of
from cosim.scenario.document.schema import ActionTable, ConnectionTable, File
from cosim.scenario.document.swaps import (
    MapEntry,
    PortNames,
    RecordedInput,
    ports_in,
    resolve_maps,
    swapped_components,
    with_recorded_inputs,
)
from cosim.scenario.kinds import KINDS, Kind

if TYPE_CHECKING:
    from cosim.scenario.session import Session

STAND_INS = {"name": "unnamed", "stop": 1.0, "step": 1.0}  # for settings without a right value


class Starter(Protocol):
    """Starts a scenario."""

    def __call__(
        self, scenario: Scenario, out: str | Path | None, *, force: bool, numbered: bool
    ) -> Session:
        """Start it; parameters as of :meth:`Scenario.start`."""
        ...


@dataclass(frozen=True, repr=False)
class Scenario:
    """A validated scenario.

    Parameters
    ----------
    document : Document
    file : File
    specs : mapping of component name to Kind
    connections : mapping of Port to Connection
        By input, or elements of it; those that kinds imply among them.
    implied : mapping of Port to Port or None
        Inputs that [connections] leaves open, and the ones that they share their sources with;
        None: they follow from the component's own table.
    maps : mapping of component name to list of MapEntry
        Of the swapped components.
    tree : mapping
        The tables as they stand in the file, edits applied.
    parse : callable
        Makes a scenario of an edited document (:func:`cosim.scenario.building.build.parse`).
    invalid : frozenset of Key
        The tables and their entries that are wrong, so that they are missing in ``file`` or have
        values that stand for others; what rests on them cannot be checked.
    actions : mapping of number to ActionTable
        Those of [[actions]] whose tables are right.
    recorded_inputs : tuple of RecordedInput
        Inputs of recorded components that their maps name.
    starter : callable or None
        Starts the scenario (:mod:`cosim.scenario.running.starting`); None: it is only read here.
    """

    document: Document
    file: File
    specs: Mapping[str, Kind]
    connections: Mapping[Port, Connection]
    implied: Mapping[Port, Port | None]
    maps: Mapping[str, list[MapEntry]]
    tree: Mapping[str, Any]
    parse: Callable[[Document], Scenario] = field(repr=False, compare=False)
    invalid: frozenset[Key] = frozenset()
    actions: Mapping[int, ActionTable] = field(default_factory=dict)
    recorded_inputs: tuple[RecordedInput, ...] = ()
    starter: Starter | None = field(default=None, repr=False, compare=False)

    def __repr__(self) -> str:
        return f"<the scenario {self.name!r}: {len(self.specs)} components>"

    @property
    def name(self) -> str:
        """Name of the scenario."""
        return self.file.scenario.name

    def driver(self, to: Port) -> str | None:
        """Return the component that drives an input alone, as a whole or by its elements.

        None: nothing drives it, or sources of several components do.
        """
        drivers = list(self.sources(to))
        return drivers[0] if len(drivers) == 1 else None

    def sources(self, to: Port) -> frozenset[str]:
        """Return the components that drive an input, as a whole or by its elements."""
        return components_driving(self.connections, to)

    def sources_of(self, component: str) -> frozenset[str]:
        """Return the components that drive any input of a component."""
        drivers: set[str] = set()
        for to, connection in self.connections.items():
            if to.component == component:
                drivers.update(source.component for source in connection.sources)
        return frozenset(drivers)

    @property
    def unfollowed(self) -> dict[str, list[str]]:
        """Inputs that the file connects, by component, of those that follow none."""
        inputs: dict[str, list[str]] = {}
        recorded = [recorded.port for recorded in self.recorded_inputs]
        for to in ports_in(self.file.connections):
            spec = self.specs.get(to.component)
            if to in recorded:
                continue
            if spec is not None and not spec.follows_inputs:
                inputs.setdefault(to.component, []).append(to.name)
        return inputs

    def upstream(self, component: str) -> Scenario:
        """Return the scenario of a component and of all that it depends on, without the others."""
        inputs: dict[str, list[Port]] = {}
        for to in self.connections:
            inputs.setdefault(to.component, []).append(to)
        connections: dict[Port, Connection] = {}
        needed: set[str] = set()
        waiting = {component}
        while waiting:
            name = waiting.pop()
            needed.add(name)
            for to in inputs.get(name, ()):
                connections[to] = self.connections[to]
                waiting |= {port.component for port in connections[to].sources} - needed
        specs = {name: spec for name, spec in self.specs.items() if name in needed}
        return replace(self, specs=specs, connections=connections)

    def edit(
        self,
        *,
        swap: Mapping[str, str | Path] | None = None,
        map: Mapping[str, PortNames] | None = None,
        set: Mapping[str, Any] | None = None,
    ) -> Scenario:
        """Return the scenario with components swapped, their ports mapped, then values set.

        Raises
        ------
        UsageError
            If one of these is no mapping, or has values of other types.
        ScenarioError
            With every problem of the file and of these edits.
        """
        paths = swap_argument(swap)
        names = mapping_argument("map", map)
        changes = mapping_argument("set", set)
        if not (paths or names or changes):
            return self
        document = self.document
        if paths or names:
            document = document.with_swaps(paths, names)
        if changes:
            document = document.with_changes(changes)
        return self.parse(document)

    def swap(self, *, map: Mapping[str, PortNames] | None = None, **paths: str | Path) -> Scenario:
        """Replace components: by an FMU (.fmu), a recorded one (.mcap), samples (.csv, ...).

        ``map`` gives the names that ports have there, such as ``{"observer.y": "out1"}``; see
        :mod:`cosim.scenario.document.swaps`.
        """
        return self.edit(swap=paths, map=map)

    def start(
        self,
        *,
        out: str | Path | None = None,
        force: bool = False,
        numbered: bool = False,
    ) -> Session:
        """Start the scenario, to advance it step by step: a context manager.

        Parameters
        ----------
        out : str or Path, optional
            Log file to write; without it nothing is recorded.
        force : bool
            Replace a log at ``out``.
        numbered : bool
            Where there is a log at ``out``, write to the next free one of ``x-2.mcap``, ...

        Raises
        ------
        CosimError
            UsageError if the scenario cannot be built or the log not be written, RunError if an
            initial value is not finite.
        """
        assert self.starter is not None, "what users load can be started"
        return self.starter(self, out, force=force, numbered=numbered)

    def set(self, changes: Mapping[str, Any]) -> Scenario:
        """Set values by dotted key, such as ``{"observer.filter_rate": 500.0}``."""
        return self.edit(set=changes)


def read(
    document: Document, parse: Callable[[Document], Scenario]
) -> tuple[Scenario, list[Problem]]:
    """Read and validate a document; return what is right in it, and its problems.

    Parameters
    ----------
    document : Document
    parse : callable
        For edits of the scenario.

    Raises
    ------
    ScenarioError
        If the text is no TOML.
    """
    tree, problems = document.tree()
    file, file_problems, invalid = _validate_tables(tree)
    valid_tree = without(tree, invalid)
    maps, map_problems = resolve_maps(valid_tree, document.maps)
    foreign = document.foreign_kinds
    specs, component_problems = _validate_components(file.components, foreign)
    written, connection_problems = _connections(file)
    followed = _followed(specs, written)
    replaced = _replaced(document, specs, swapped_components(tree) if document.swapped else ())
    connections, implied, given_twice = _with_implied(replaced, followed)
    without_inputs = [name for name, spec in specs.items() if not spec.follows_inputs]
    maps, connections, recorded_inputs, input_problems = with_recorded_inputs(
        without_inputs, maps, connections, written
    )
    map_problems += input_problems
    connection_problems += given_twice
    for key, _ in connection_problems:
        invalid.add(key)
    actions, action_problems = _validate_actions(file.actions)
    problems += file_problems + map_problems + component_problems + connection_problems
    problems += action_problems
    scenario = Scenario(
        document,
        file,
        specs,
        connections,
        implied,
        maps,
        valid_tree,
        parse,
        frozenset(invalid),
        actions,
        recorded_inputs=tuple(recorded_inputs),
    )
    return scenario, problems


def _validate_actions(
    tables: Sequence[Mapping[str, Any]],
) -> tuple[dict[int, ActionTable], list[Problem]]:
    """Return the actions that are right by themselves, by their numbers, and the problems."""
    actions: dict[int, ActionTable] = {}
    problems: list[Problem] = []
    for number, table in enumerate(tables):
        key: Key = ("actions", number)
        try:
            action = ActionTable.model_validate(table)
        except ValidationError as error:
            problems += problems_of(error, ActionTable, table, key)
            continue
        own = [((*key, *inner), text) for inner, text in action.problems()]
        problems += own
        if not own:
            actions[number] = action
    return actions, problems


def _validate_tables(tree: Mapping[str, Any]) -> tuple[File, list[Problem], set[Key]]:
    """Return the file without what is wrong in it, the problems, and the keys that are wrong."""
    try:
        return File.model_validate(tree), [], set()
    except ValidationError as error:
        problems = problems_of(error, File, tree, ())
        invalid = _invalid_keys(error, tree)
    valid = without(tree, invalid)
    valid["scenario"] = {**STAND_INS, **valid.get("scenario", {})}
    valid.setdefault("components", {})
    return File.model_validate(valid), problems, invalid


def _invalid_keys(error: ValidationError, tree: Mapping[str, Any]) -> set[Key]:
    """Return the tables that are wrong, and the entries of the others that are."""
    invalid: set[Key] = set()
    for details in error.errors(include_url=False, include_input=False):
        location = details["loc"]
        if len(location) > 1 and isinstance(tree.get(str(location[0])), dict):
            invalid.add(location[:2])
        elif details["type"] == "extra_forbidden":
            # probably a table under another name, so that nothing is known of that one
            meant = get_close_matches(str(location[0]), File.model_fields, n=1, cutoff=0.5)
            invalid |= {(location[0],), *((name,) for name in meant if name not in tree)}
        else:
            invalid.add(location[:1])
    return invalid


def without(tree: Mapping[str, Any], invalid: Collection[Key]) -> dict[str, Any]:
    """Return tables without some of them, and without entries of others."""
    valid: dict[str, Any] = {}
    for name, table in tree.items():
        if (name,) in invalid:
            continue
        valid[name] = table
        if isinstance(table, dict):
            valid[name] = {key: table[key] for key in table if (name, key) not in invalid}
    return valid


def _validate_components(
    tables: Mapping[str, Any], foreign: Collection[str]
) -> tuple[dict[str, Kind], list[Problem]]:
    """Return the components' tables by name, and the problems of the others.

    ``foreign`` are kinds beside the shipped ones that are known to be those of packages.
    """
    specs: dict[str, Kind] = {}
    problems: list[Problem] = []
    for name, table in tables.items():
        key: Key = ("components", name)
        try:
            kind = _kind(table, foreign)
            specs[name] = kind.model_validate(table)
        except TableProblems as error:
            problems += [((*key, *inner), text) for inner, text in error.problems]
        except ValidationError as error:
            problems += problems_of(error, kind, table, key)
            with suppress(ValidationError, TableProblems):
                # what is connected to it is then checked, too
                specs[name] = kind.model_validate(_with_meant_keys(error, kind, table))
    return specs, problems


def _with_meant_keys(
    error: ValidationError, kind: type[Kind], table: Mapping[str, Any]
) -> Mapping[str, Any]:
    """Return a component's table with the keys that were probably meant for unknown ones."""
    meant = dict(table)
    for details in error.errors(include_url=False, include_input=False):
        name, *inner = details["loc"]
        if details["type"] == "extra_forbidden" and not inner:
            known = [field.alias or key for key, field in kind.model_fields.items()]
            close = get_close_matches(str(name), [key for key in known if key not in table], n=1)
            if close:
                meant[close[0]] = meant.pop(str(name))
    return meant


def _kind(table: Mapping[str, Any], foreign: Collection[str]) -> type[Kind]:
    """Return the kind of a component's table.

    Raises
    ------
    TableProblems
        If it has none, or there is no such kind.
    """
    kind = table.get("kind")
    if isinstance(kind, str) and kind in KINDS:
        return KINDS[kind]
    from cosim.scenario.kinds.user_component import InstalledKind, installed_classes

    if isinstance(kind, str) and kind in foreign:
        return InstalledKind
    installed = installed_classes()
    if isinstance(kind, str) and kind in installed:
        return InstalledKind
    names = [*KINDS, *(name for name in installed if name not in KINDS)]
    if "kind" not in table:
        raise TableProblems([((), f"'kind' is missing; available: {', '.join(names)}")])
    if not isinstance(kind, str):
        raise TableProblems([(("kind",), f"expected a string, got {quoted(kind)}")])
    text = f"unknown kind {quoted(kind)}; {nearest(kind, names)}"
    raise TableProblems([(("kind",), text)])


def _replaced(
    document: Document, specs: Mapping[str, Kind], swapped: Iterable[str]
) -> Mapping[str, Kind]:
    """Return the specs with those that swaps replaced: what takes their place has their inputs."""
    names = [name for name in swapped if name in specs]
    names = [name for name in names if specs[name].follows_inputs]
    if not names:
        return specs
    tree, _ = document.unswapped().tree()
    tables = {name: tree["components"][name] for name in names}
    originals, _ = _validate_components(tables, document.foreign_kinds)
    return {**specs, **originals}


def _followed(
    specs: Mapping[str, Kind], connections: Mapping[Port, Connection]
) -> dict[Port, Connection]:
    """Return the connections without those to components that follow no inputs."""
    followed = {}
    for to, connection in connections.items():
        spec = specs.get(to.component)
        if spec is None or spec.follows_inputs:
            followed[to] = connection
    return followed


def _with_implied(
    specs: Mapping[str, Kind], connections: Mapping[Port, Connection]
) -> tuple[dict[Port, Connection], dict[Port, Port | None], list[Problem]]:
    """Add the connections that kinds imply for inputs that [connections] leaves open.

    Returns
    -------
    connections : dict of Port to Connection
    origins : dict of Port to Port or None
        Of each such input, also where the one that it follows has no connection either.
    problems : list of Problem
        Of inputs that are connected although their component's table says what drives them.
    """
    given = {port.whole: port for port in connections}
    result = dict(connections)
    origins: dict[Port, Port | None] = {}
    problems: dict[Key, str] = {}
    for name, spec in specs.items():
        for to, implied in spec.implied_connections(name, connections, specs).items():
            if to.whole not in given:
                origins[to] = implied.origin
                if implied.connection is not None:
                    result[to] = implied.connection
            elif implied.origin is None:
                key = ("connections", str(given[to.whole]))
                problems[key] = (
                    f"'{to.whole}' has its source from the table of {name!r}; remove this "
                    "connection"
                )
    return result, origins, list(problems.items())


def _connections(file: File) -> tuple[dict[Port, Connection], list[Problem]]:
    """Return the connections by input, and their problems; a wrong gain leaves the sources."""
    connections: dict[Port, Connection] = {}
    problems: list[Problem] = []
    for to, value in file.connections.items():
        try:
            port = Port.parse(to)
            if port in connections:
                raise GraphError(f"'{port}' is given twice; {ONE_SOURCE}")
            if isinstance(value, ConnectionTable):
                connections[port] = Connection(value.source)
                connections[port] = Connection(value.source, value.gain, value.offset, value.unit)
            else:
                connections[port] = Connection(value)
        except CosimError as error:
            problems.append((("connections", to), str(error)))
    return connections, problems
