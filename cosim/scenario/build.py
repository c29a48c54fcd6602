"""From a document to a graph and a clock, with every problem of the file in one report."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from pydantic import ValidationError

from cosim.blocks.replay import Replay
from cosim.core.clock import Clock, whole_steps
from cosim.core.connections import Connection, check_connections, layout_of
from cosim.core.contracts import Component, Level, Recording
from cosim.core.graph import Graph
from cosim.errors import CosimError, ScenarioError, UsageError, nearest
from cosim.scenario.document import FLAT, Document, Key, Problem, flatten
from cosim.scenario.kinds import KINDS, Kind, Site
from cosim.scenario.problems import problems_of
from cosim.scenario.schema import File, matrix
from cosim.theory.descriptor import DescriptorSystem

if TYPE_CHECKING:
    from cosim.fmi.linearise import Linearisation

Problems = list[Problem]


class Speaker(Protocol):
    """An opened FMU, as far as its messages go."""

    def drain(self) -> Sequence[tuple[Level, str, str]]:
        """Give what it said since the last call, as (level, category, text)."""
        ...


@dataclass(frozen=True)
class Scenario:
    """A validated scenario file."""

    document: Document
    file: File
    specs: Mapping[str, Kind]
    connections: Mapping[str, Connection]
    tree: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Name of the scenario."""
        return self.file.scenario.name

    def driver(self, to: str) -> str | None:
        """Give the component that drives an input, ``component.input``."""
        connection = self.connections.get(to)
        return connection.source.partition(".")[0] if connection is not None else None

    def edit(
        self,
        *,
        swap: Mapping[str, str | Path] | None = None,
        map: Mapping[str, str] | None = None,
        set: Mapping[str, Any] | None = None,
    ) -> Scenario:
        """Swap components, rename their ports, then set values; what is wrong with all of it is told together."""
        paths = {name: str(path) for name, path in (swap or {}).items()}
        return parse(self.document.with_swaps(paths, map).with_changes(set or {}))

    def swap(self, *, map: Mapping[str, str] | None = None, **paths: str | Path) -> Scenario:
        """Put an FMU (.fmu) or a recorded component (.mcap) in the place of a component.

        ``map`` gives the names that ports have there, such as ``{"observer.y": "out1"}``; see :mod:`cosim.scenario.swapping`.
        """
        return self.edit(swap=paths, map=map)

    def set(self, changes: Mapping[str, Any]) -> Scenario:
        """Set values by dotted key, such as ``{"observer.filter_rate": 500.0}``."""
        return self.edit(set=changes)


@dataclass(frozen=True)
class Experiment:
    """A scenario ready to run."""

    scenario: Scenario
    graph: Graph
    clock: Clock
    truth: Mapping[str, Any]  # what the report compares
    facts: Mapping[str, Mapping[str, Any]]
    warnings: tuple[tuple[str, str], ...]
    reads: Mapping[str, frozenset[str]]  # tables that were read to build each component, but for its own
    attachments: Mapping[str, str] = field(default_factory=dict)
    fmus: Mapping[str, Speaker] = field(default_factory=dict)  # what was opened for this run and may have something to say
    files: frozenset[Path] = frozenset()  # what is read besides the scenario


@dataclass(frozen=True)
class Draft:
    """What could be built of a scenario, and what is wrong with the rest."""

    scenario: Scenario
    site: _Site
    clock: Clock
    components: Mapping[str, Component]
    periods: Mapping[str, int]
    truth: Mapping[str, Any]
    problems: tuple[Problem, ...]


def parse(document: Document) -> Scenario:
    """Read and validate a document.

    Raises
    ------
    ScenarioError
        With every problem that can be seen without building the components.
    """
    scenario, problems = _parse(document)
    if problems:
        with ExitStack() as resources:  # what is wrong with the rest belongs into the same report
            build(document, resources)
    return scenario


def build(
    document: Document, resources: ExitStack, *, recording: Recording | None = None, block: int | None = None
) -> Experiment:
    """Build graph and clock.

    Parameters
    ----------
    document : Document
    resources : ExitStack
        Closes what was opened, FMUs above all, when the run is over.
    recording : Recording, optional
        Take from it every component that cannot be computed again from the log: plants, FMUs, files.
    block : int, optional
        Fixed number of communication steps in a block.

    Raises
    ------
    ScenarioError
        With every problem of the file.
    """
    return finish(draft(document, resources, recording=recording, block=block))


def draft(document: Document, resources: ExitStack, *, recording: Recording | None = None, block: int | None = None) -> Draft:
    """Build what can be built, and say what is wrong with the rest; parameters as of ``build``.

    Raises
    ------
    ScenarioError
        If nothing can be built.
    """
    scenario, problems = _parse(document)
    site = _Site(scenario, resources, recording)
    clock = _clock(scenario, block, problems)
    site.step_ns = clock.step_ns
    components, periods, missing = site.build_all(problems)
    found = check_connections(layout_of(components), scenario.connections, missing) if components else {}
    problems += [(("connections", to), text) for to, text in found.items()]
    truth, wrong = _judge_truth(scenario, components, missing, site)
    return Draft(scenario, site, clock, components, periods=periods, truth=truth, problems=(*problems, *wrong))


def finish(made: Draft) -> Experiment:
    """Put a draft together.

    Raises
    ------
    ScenarioError
        With every problem of the file.
    """
    scenario, site, clock, components = made.scenario, made.site, made.clock, made.components
    settings = scenario.file.scenario
    if made.problems:
        raise _report(scenario.document, made.problems)
    try:
        graph = Graph(components, scenario.connections, coupling=settings.coupling, hold=settings.hold, periods=made.periods)
    except CosimError as error:
        raise _report(scenario.document, [(("connections",), str(error))]) from error
    for name, spec in scenario.specs.items():
        columns = components[name].interface.input_columns()
        held = {signal: bool(graph.held[name][at].any()) for signal, at in columns.items()}
        for text in spec.advice(held, clock.step_ns / 1e9):
            site.warn(name, text)
    for name, text in graph.warnings:
        site.warn(name, text)
    return Experiment(
        scenario,
        graph,
        clock,
        truth=made.truth,
        facts=site.facts,
        warnings=tuple(site.warnings),
        reads=site.reads,
        attachments=site.attachments,
        fmus=site.fmus,
        files=frozenset(site.files),
    )


def _clock(scenario: Scenario, block: int | None, problems: Problems) -> Clock:
    """Make the clock; without one nothing else can be judged, so what is wrong with it is told with what is known already."""
    settings = scenario.file.scenario
    for key, attempt in (("step", (settings.step, settings.step)), ("stop", (settings.stop, settings.step))):
        try:
            Clock(*attempt)
        except CosimError as error:
            raise _report(scenario.document, [*problems, (("scenario", key), str(error))]) from error
    return Clock(settings.stop, settings.step, block)


def build_site(scenario: Scenario, resources: ExitStack) -> Site:
    """Give what a single kind needs to build its component, outside a run."""
    site = _Site(scenario, resources, None)
    site.step_ns = Clock(scenario.file.scenario.stop, scenario.file.scenario.step).step_ns
    return site


# --- reading ---


def _parse(document: Document) -> tuple[Scenario, Problems]:
    tree, problems = document.tree()
    for table in FLAT:  # once more, for what was set
        if isinstance(tree.get(table), dict):
            tree[table], more = flatten(tree[table], (table,))
            problems += more
    try:
        file = File.model_validate(tree)
    except ValidationError as error:
        problems += problems_of(error, File, tree, ())
        specs, more = _specs(tree.get("components", {}))
        raise _report(document, [*problems, *more]) from error
    specs, more = _specs(file.components)
    wires = {}
    for to, given in file.connections.items():
        parts = (given,) if isinstance(given, str) else (given.source, given.gain, given.offset, given.unit)
        try:
            wires[to] = Connection(*parts)
        except CosimError as error:
            more.append((("connections", to), str(error)))
            wires[to] = Connection(parts[0])
    return Scenario(document, file, specs, wires, tree), [*problems, *more]


def _specs(tables: Any) -> tuple[dict[str, Kind], Problems]:
    specs: dict[str, Kind] = {}
    problems: Problems = []
    for name, table in tables.items() if isinstance(tables, dict) else ():
        key: Key = ("components", name)
        if not isinstance(table, dict):
            continue
        kind = str(table.get("kind"))
        if kind not in KINDS:
            said = f"unknown kind {kind!r}" if "kind" in table else "'kind' is missing"
            problems.append(((*key, "kind") if "kind" in table else key, f"{said}; {nearest(kind, KINDS)}"))
            continue
        try:
            specs[name] = KINDS[kind].model_validate(table)
        except ValidationError as error:
            problems += problems_of(error, KINDS[kind], table, key)
    return specs, problems


def _report(document: Document, problems: Iterable[Problem]) -> ScenarioError:
    first: dict[str, Key] = {}
    for key, text in problems:  # one cause that several components run into is told once
        first.setdefault(text, key)
    lines = []
    for text, key in first.items():
        lines += [f"{document.label(key)}: {line}" for line in text.splitlines()]
    return ScenarioError("\n".join(lines))


def _judge_truth(
    scenario: Scenario, components: Mapping[str, Component], missing: Collection[str], site: _Site
) -> tuple[dict[str, Any], Problems]:
    """Give the truths that can be compared; a swapped component need not have the signals that only the report asks for.

    ``missing`` names components that could not be built: what touches them is not judged.
    """
    kept: dict[str, Any] = {}
    problems: Problems = []
    signals = {f"{n}.{s.name}": s for n, c in components.items() for s in (*c.interface.inputs, *c.interface.outputs)}
    sizes = {port: signal.size for port, signal in signals.items()}
    for true in filter(lambda true: isinstance(true, str) and true not in sizes, scenario.file.truth.values()):
        element = re.fullmatch(r"(.*)\[(\d+)\]", str(true))
        if element and int(element[2]) < sizes.get(element[1], 0):
            sizes[str(true)] = 1
    for estimate, truth in scenario.file.truth.items():
        ports = {port: port.partition(".")[0] for port in ([estimate, truth] if isinstance(truth, str) else [estimate])}
        unknown = [port for port in ports if port not in sizes]
        mapped = {f"{name}.{port}" for name, swap in scenario.file.swap.items() for port in swap.map.values()}
        swapped = [port for port in unknown if ports[port] in scenario.file.swap and port not in mapped]
        size = sizes.get(truth) if isinstance(truth, str) else len(np.atleast_1d(truth))
        if set(ports.values()) & set(missing):
            continue
        if swapped:
            site.warn(ports[swapped[0]], f"has no {swapped[0]!r}: the report leaves out {estimate!r}")
        elif unknown:
            problems += [(("truth", estimate), f"there is no signal {port!r}; {nearest(port, signals)}") for port in unknown]
        elif sizes[estimate] != size:
            text = f"{estimate!r} has size {sizes[estimate]}, its truth {truth!r} has size {size}"
            problems.append((("truth", estimate), text))
        else:
            kept[estimate] = truth
    return kept, problems


# --- building ---


class _RestsOnAnother(UsageError):
    """A component cannot be judged because one that it reads is wrong; that one is told."""


class _Site:
    """What kinds may know while they are built; keeps note of what each one read."""

    step_ns: int
    stop: float

    def __init__(self, scenario: Scenario, resources: ExitStack, recording: Recording | None) -> None:
        self._scenario, self._resources, self._recording = scenario, resources, recording
        self._current = ""
        self.stop = scenario.file.scenario.stop
        self.facts: dict[str, dict[str, Any]] = {}
        self.warnings: list[tuple[str, str]] = []
        self.reads: dict[str, frozenset[str]] = {"": frozenset()}
        self.attachments: dict[str, str] = {}
        self.fmus: dict[str, Speaker] = {}
        self._linearised: dict[str, Linearisation] = {}
        self.files: set[Path] = set()

    def build_all(self, problems: Problems) -> tuple[dict[str, Component], dict[str, int], set[str]]:
        """Build every component that can be built; add what is wrong with the others to ``problems``."""
        components: dict[str, Component] = {}
        periods: dict[str, int] = {}
        for name in self._scenario.file.models:
            try:
                self.model(name)
            except (CosimError, ValueError) as error:
                problems.append((("models", name), str(error)))
        for name, spec in self._scenario.specs.items():
            self._current, self.reads[name] = name, frozenset()
            try:
                component = self._build(name, spec)
                periods[name] = self._period(name, spec)
                components[name] = component if periods[name] == 1 else spec.slowed(component, periods[name])
            except _RestsOnAnother:
                pass
            except (CosimError, ValueError) as error:
                problems.append((("components", name), str(error)))
        return components, periods, set(self._scenario.file.components) - set(components)

    def _build(self, name: str, spec: Kind) -> Component:
        if self._recording is not None and not spec.computable:
            return Replay(self._recording, name)
        return spec.build(name, self)

    def _period(self, name: str, spec: Kind) -> int:
        return 1 if spec.own_step is None else whole_steps(spec.own_step, self.step_ns, f"period of {name!r}")

    # --- what a kind may ask for ---

    def model(self, name: str) -> DescriptorSystem:
        models = self._scenario.file.models
        if name not in models:
            raise UsageError(f"there is no model {name!r} in [models]; {nearest(name, models)}")
        self._read(f"models.{name}")
        table = models[name]
        arrays = {letter: matrix(getattr(table, letter), f"models.{name}.{letter}") for letter in ("A", "Bu", "Bd", "C")}
        return DescriptorSystem(n_a=table.n_a, **arrays)

    def spec(self, name: str) -> Kind:
        self._read(f"components.{name}")
        if name not in self._scenario.specs:
            raise _RestsOnAnother
        return self._scenario.specs[name]

    def driver(self, to: str) -> str | None:
        return self._scenario.driver(to)

    def file(self, path: str) -> Path:
        found = self._scenario.document.folder / path
        self.files.add(found.resolve())
        return found

    def recording(self, path: str) -> Recording:
        from cosim.log import open_log

        log = open_log(self.file(path))
        if log.step_ns != self.step_ns:
            raise UsageError(
                f"log {path!r} has steps of {log.step_ns / 1e9} s, the scenario of {self.step_ns / 1e9} s; needed the same"
            )
        return log

    def fmu(
        self,
        name: str,
        path: str,
        *,
        mode: Literal["me", "cs"] | None,
        solver: str | None,
        dae: Literal["ode", "residual"],
        start: Mapping[str, Any],
    ) -> Component:
        from cosim.fmi.component import load

        loaded = self._resources.enter_context(
            load(self.file(path), mode=mode, solver=solver, dae=dae, start=start, instance_name=name)
        )
        facts = loaded.metadata
        self.attachments[f"{name}/modelDescription.xml"] = facts.pop("model_description")
        self.note(name, **facts)
        for text in loaded.notes:
            self.warn(name, text)
        self.fmus[name] = loaded
        return loaded.component

    def linearisation(
        self,
        name: str,
        path: str,
        *,
        at: float,
        start: Mapping[str, Any],
        inputs: Sequence[str] | None,
        outputs: Sequence[str],
    ) -> Linearisation:
        if name not in self._linearised:
            chosen = {"inputs": None if inputs is None else list(inputs), "outputs": list(outputs)}
            asked = {"fmu": path, "at": at, "start": dict(start), **chosen}
            recorded = self._recorded_facts(name).get("linearisation", {})
            if recorded.get("asked") != asked:
                recorded = {"asked": asked, **self._linearise(path, at=at, start=start, inputs=inputs, outputs=outputs)}
            self._take(name, recorded)
        return self._linearised[name]

    def _linearise(self, path: str, **wanted: Any) -> dict[str, Any]:
        from cosim.fmi.linearise import linearize
        from cosim.fmi.reading.model_description import read

        file = self.file(path)
        return {"sha256": read(file).sha256, "result": linearize(file, **wanted).to_dict()}

    def _take(self, name: str, linearisation: dict[str, Any]) -> None:
        from cosim.fmi.linearise import Linearisation

        found = self._linearised[name] = Linearisation.of(linearisation["result"])
        self.note(name, linearisation=linearisation)
        for text in found.notes:
            self.warn(name, text)

    def _recorded_facts(self, name: str) -> dict[str, Any]:
        if self._recording is None:
            return {}
        found: dict[str, Any] = json.loads(self._recording.metadata.get(f"cosim.component.{name}", {}).get("facts", "{}"))
        return found

    def note(self, name: str, **facts: Any) -> None:
        self.facts.setdefault(name, {}).update(facts)

    def warn(self, name: str, text: str) -> None:
        self.warnings.append((name, text))

    def _read(self, table: str) -> None:
        self.reads[self._current] |= {table}


def fingerprint(scenario: Scenario, name: str, reads: frozenset[str]) -> str:
    """Hash everything that the design of a component rests on: its table, the tables it read, step and hold."""
    settings = scenario.file.scenario
    tables = {table: _lookup(scenario.tree, table) for table in sorted({f"components.{name}", *reads})}
    text = json.dumps([tables, settings.step, settings.hold, settings.coupling], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _lookup(tree: Mapping[str, Any], dotted: str) -> Any:
    table, _, name = dotted.partition(".")
    return tree.get(table, {}).get(name)
