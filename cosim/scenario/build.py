"""From a document to a graph and a clock, with every problem of the file in one report."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.core.clock import Clock
from cosim.core.connections import Connection, check_connections, layout_of
from cosim.core.contracts import Component, Recording
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.errors import CosimError
from cosim.scenario.context import MessageSource, ScenarioBuildContext
from cosim.scenario.document import Document, Problem
from cosim.scenario.kinds import BuildContext
from cosim.scenario.parsing import Parsed, Problems, read, report
from cosim.scenario.truth import check_truth


@dataclass(frozen=True)
class Scenario(Parsed):
    """A validated scenario file."""

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

        ``map`` gives the names that ports have there, such as ``{"observer.y": "out1"}``; see :mod:`cosim.scenario.swap`.
        """
        return self.edit(swap=paths, map=map)

    def set(self, changes: Mapping[str, Any]) -> Scenario:
        """Set values by dotted key, such as ``{"observer.filter_rate": 500.0}``."""
        return self.edit(set=changes)


@dataclass(frozen=True)
class Experiment:
    """A scenario ready to run."""

    scenario: Parsed
    graph: Graph
    clock: Clock
    truth: Mapping[str, Any]  # what the report compares
    metadata: Mapping[str, Mapping[str, Any]]
    warnings: tuple[tuple[str, str], ...]
    reads: Mapping[
        str, frozenset[str]
    ]  # tables that were read to build each component, but for its own
    attachments: Mapping[str, str] = field(default_factory=dict)
    fmus: Mapping[str, MessageSource] = field(
        default_factory=dict
    )  # what was opened for this run and may have something to say
    files: frozenset[Path] = frozenset()  # what is read besides the scenario


@dataclass(frozen=True)
class Draft:
    """What could be built of a scenario, and what is wrong with the rest."""

    scenario: Parsed
    context: ScenarioBuildContext
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
    parsed, problems = read(document)
    if problems:
        with ExitStack() as resources:  # what is wrong with the rest belongs into the same report
            build(document, resources)
    return Scenario(parsed.document, parsed.file, parsed.specs, parsed.connections, parsed.tree)


def build(
    document: Document,
    resources: ExitStack,
    *,
    recording: Recording | None = None,
    block: int | None = None,
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


def draft(
    document: Document,
    resources: ExitStack,
    *,
    recording: Recording | None = None,
    block: int | None = None,
) -> Draft:
    """Build what can be built, and say what is wrong with the rest; parameters as of ``build``.

    Raises
    ------
    ScenarioError
        If nothing can be built.
    """
    scenario, problems = read(document)
    context = ScenarioBuildContext(scenario, resources, recording)
    clock = _clock(scenario, block, problems)
    context.step_ns = clock.step_ns
    components, periods, missing = context.build_all(problems)
    found = (
        check_connections(
            layout_of(components),
            {Port.parse(to): wire for to, wire in scenario.connections.items()},
            missing,
        )
        if components
        else {}
    )
    reported = {key for key, _ in problems}
    problems += [
        (("connections", str(to)), text)
        for to, text in found.items()
        if ("connections", str(to)) not in reported
    ]
    truth, wrong = check_truth(scenario.file, components, missing, context.warn)
    return Draft(
        scenario,
        context,
        clock,
        components,
        periods=periods,
        truth=truth,
        problems=(*problems, *wrong),
    )


def finish(made: Draft) -> Experiment:
    """Put a draft together.

    Raises
    ------
    ScenarioError
        With every problem of the file.
    """
    scenario, context, clock, components = made.scenario, made.context, made.clock, made.components
    if made.problems:
        raise report(scenario.document, made.problems)
    graph = _graph(scenario, components, scenario.connections, made.periods)
    for name, spec in scenario.specs.items():
        columns = components[name].interface.input_columns()
        held = {signal: bool(graph.held[name][at].any()) for signal, at in columns.items()}
        for text in spec.advice(held, clock.step_ns / 1e9):
            context.warn(name, text)
    for name, text in graph.warnings:
        context.warn(name, text)
    return Experiment(
        scenario,
        graph,
        clock,
        truth=made.truth,
        metadata=context.metadata,
        warnings=tuple(context.warnings),
        reads=context.reads,
        attachments=context.attachments,
        fmus=context.fmus,
        files=frozenset(context.files),
    )


def upstream(made: Draft, component: str) -> Graph:
    """Give the graph of a component and of all that it depends on; what is wrong with other components does not matter.

    Raises
    ------
    ScenarioError
        With every problem of the file, if one of these cannot be built or connected.
    """
    scenario, needed, waiting = made.scenario, set[str](), [component]
    while waiting:
        name = waiting.pop()
        needed.add(name)
        for to, wire in scenario.connections.items():
            if to.partition(".")[0] == name:
                waiting += {port.component for port in wire.sources} - needed
    components = {name: found for name, found in made.components.items() if name in needed}
    connections = {
        to: wire for to, wire in scenario.connections.items() if to.partition(".")[0] in needed
    }
    if len(components) < len(needed):
        raise report(scenario.document, made.problems)
    return _graph(
        scenario, components, connections, {name: made.periods[name] for name in components}
    )


def _graph(
    scenario: Parsed,
    components: Mapping[str, Component],
    connections: Mapping[str, Connection],
    periods: Mapping[str, int],
) -> Graph:
    settings = scenario.file.scenario
    try:
        return Graph(
            components,
            connections,
            coupling=settings.coupling,
            input_interpolation=settings.input_interpolation,
            periods=periods,
        )
    except CosimError as error:
        raise report(scenario.document, [(("connections",), str(error))]) from error


def _clock(scenario: Parsed, block: int | None, problems: Problems) -> Clock:
    """Make the clock; without one nothing else can be judged, so what is wrong with it is told with what is known already."""
    settings = scenario.file.scenario
    for key, attempt in (
        ("step", (settings.step, settings.step)),
        ("stop", (settings.stop, settings.step)),
    ):
        try:
            Clock(*attempt)
        except CosimError as error:
            raise report(scenario.document, [*problems, (("scenario", key), str(error))]) from error
    return Clock(settings.stop, settings.step, block)


def build_context(scenario: Scenario, resources: ExitStack) -> BuildContext:
    """Give what a single kind needs to build its component, outside a run."""
    context = ScenarioBuildContext(scenario, resources, None)
    context.step_ns = Clock(scenario.file.scenario.stop, scenario.file.scenario.step).step_ns
    return context


def fingerprint(scenario: Parsed, name: str, reads: frozenset[str]) -> str:
    """Hash everything that the design of a component rests on: its table, the tables it read, step and hold."""
    settings = scenario.file.scenario
    tables = {
        table: _lookup(scenario.tree, table) for table in sorted({f"components.{name}", *reads})
    }
    text = json.dumps(
        [tables, settings.step, settings.input_interpolation, settings.coupling], sort_keys=True
    )
    return hashlib.sha256(text.encode()).hexdigest()


def _lookup(tree: Mapping[str, Any], dotted: str) -> Any:
    table, _, name = dotted.partition(".")
    return tree.get(table, {}).get(name)
