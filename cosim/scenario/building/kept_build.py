"""A scenario that was built once, and of which runs with other tables are made.

Only the components that are made of tables that differ are built again. What has the state of a
binary or of a user's code is made anew for every run. The graph stays: its structure rests on the
interfaces, which have to be the same. What a run is refused for is checked as in any build, where
it may be another one with other tables::

    connections, actions, until, record, truth   the same tables, of the same interfaces
    swaps, and the maps of their ports           the same
    components, models                           by building them
    inputs that must not jump                    for every run
    the gain of loops                            for every run
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np

from cosim.blocks.declared import with_units
from cosim.core.connections import Connection
from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.signals import Interface
from cosim.errors import CosimError
from cosim.native.numerics.program_cache import ProgramCaches
from cosim.scenario.building.build import Builder, asks_for_means
from cosim.scenario.building.common_designs import CommonDesigns, setting_designs, with_settings
from cosim.scenario.building.coupling_check import with_loop_gains
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.building.graph_checks import jump_problems
from cosim.scenario.context.build_context import ScenarioBuildContext
from cosim.scenario.context.models import form_problems
from cosim.scenario.kinds import Kind
from cosim.scenario.parsing import Scenario

if TYPE_CHECKING:
    from cosim.fmi.unpacked import UnpackedFmus

BUILT_AGAIN: Final = ("components", "models")  # the tables whose entries may be other ones
NOT_BUILT: Final = (CosimError, ValueError, ArithmeticError, MemoryError)  # as a builder takes them


@final
class KeptBuild:
    """A scenario that was built and prepared once.

    Parameters
    ----------
    scenario : Scenario
    unpacked : UnpackedFmus
    replaced : mapping of component name to Interface
        Of the components that its swaps replaced.
    warnings : sequence of (component, text)
        Of the swaps.

    Attributes
    ----------
    built : Experiment
        As it was built; what it opened is closed.
    computed : mapping of component name to Design
        Its designs, computed on this machine; those of what actions set among them.

    Raises
    ------
    CosimError
        If it cannot be built and prepared.
    """

    def __init__(
        self,
        scenario: Scenario,
        unpacked: UnpackedFmus,
        replaced: Mapping[str, Interface],
        warnings: Sequence[tuple[str, str]] = (),
    ) -> None:
        self._scenario = scenario
        self._unpacked = unpacked
        with ExitStack() as resources:
            builder = Builder(scenario, resources, unpacked=unpacked, replaced=replaced)
            experiment = builder.experiment()
            graph = experiment.graph
            graph.program_caches = ProgramCaches()
            self._plan = graph.prepare(experiment.clock.step_ns)
            self.built = experiment
            self.computed = {**self._plan.designs, **setting_designs(with_settings(experiment))}
        self._common = CommonDesigns(self.computed, self.computed)
        actions = [timed.action for timed in experiment.actions]
        for reaction in experiment.reactions:
            actions += reaction.actions
        self._puts_others_in = any(action.variants for action in actions)
        self._builder = builder
        self._warnings = warnings
        self._context = builder.context
        self._periods = builder.periods
        self._port_maps = builder.port_maps
        self._components = dict(graph.components)
        self._notes = {name: member.note for name, member in graph.members.items()}
        self._exchanged: set[str] = set()
        opened = self._context.fmus.opened.keys() & self._components.keys()
        users = {name for name, spec in scenario.specs.items() if spec.code is not None}
        self._fresh = opened | users
        self._affected: dict[frozenset[str], frozenset[str]] = {}

    def take(self, common: CommonDesigns) -> None:
        """Take the designs that its runs have in common with others."""
        self._common = common
        step_ns = self.built.clock.step_ns
        designs = common.prepare(self.built.graph, step_ns, self._plan.designs)
        self._plan = replace(self._plan, designs=designs)

    def experiment(self, scenario: Scenario, resources: ExitStack) -> Experiment | None:
        """Return the experiment of a scenario with other tables, its graph prepared.

        There is one at a time. What it tells of a run beside its signals and warnings is not the
        member's own: metadata, and what estimates are judged by.

        Parameters
        ----------
        scenario : Scenario
        resources : ExitStack
            Closes what is opened, when the run is over.

        Returns
        -------
        Experiment or None
            None: it has to be built as a whole, be it to say why it cannot be.
        """
        tables = self._other_tables(scenario)
        if tables is None or self._puts_others_in:
            return None
        try:
            experiment = self._exchange(scenario, tables, resources)
            if experiment is None:
                return None

            def rebuild() -> Experiment:
                resources.close()
                again = self._exchange(scenario, tables, resources)
                assert again is not None, "it was built of the same tables before"
                return again

            return with_loop_gains(experiment, rebuild)
        except NOT_BUILT:  # a whole build says where and why
            return None

    def _other_tables(self, scenario: Scenario) -> frozenset[str] | None:
        """Return the names of the tables that are other ones; None: not only such tables are."""
        kept = self._scenario
        if kept.tree.keys() != scenario.tree.keys() or not self._has_same_wires(scenario):
            return None
        names: set[str] = set()
        for key, table in scenario.tree.items():
            before = kept.tree[key]
            if table == before:
                continue
            if key not in BUILT_AGAIN or table.keys() != before.keys():
                return None
            names |= {f"{key}.{name}" for name in table if table[name] != before[name]}
        return frozenset(names)

    def _has_same_wires(self, scenario: Scenario) -> bool:
        """Return whether connections are the same, also those that kinds imply."""
        kept = self._scenario
        if (kept.implied, kept.maps, kept.recorded_inputs) != (
            scenario.implied,
            scenario.maps,
            scenario.recorded_inputs,
        ):
            return False
        return are_equal(kept.connections, scenario.connections)

    def _resting_on(self, tables: frozenset[str]) -> frozenset[str]:
        """Return the components that are made of some tables."""
        if tables not in self._affected:
            self._affected[tables] = frozenset(self._context.records.rests_on(tables))
        return self._affected[tables]

    def _exchange(
        self, scenario: Scenario, tables: frozenset[str], resources: ExitStack
    ) -> Experiment | None:
        """Build components again, and put them into the graph; None: they do not fit there."""
        affected = self._resting_on(tables)
        compared = {name for name, _ in self._warnings}
        if compared & affected or (compared and any(t.startswith("models.") for t in tables)):
            return None  # the warnings of a swap have numbers of what is compared
        names = affected | self._fresh
        context = ScenarioBuildContext(scenario, resources, None, unpacked=self._unpacked)
        context.keep_from(self._context, {*tables, *(f"components.{name}" for name in affected)})
        if _has_model_problems(scenario, tables, context):
            return None
        components = {}
        for name in names:
            component = self._component(name, scenario.specs[name], context)
            if component is None:
                return None
            components[name] = component
        experiment = self.built
        graph = experiment.graph
        if jump_problems(scenario, graph):
            return None
        for name in self._exchanged - names:
            graph.put(name, self._components[name])
        self._exchanged = set(names)
        step_ns = experiment.clock.step_ns
        designs = graph.exchange(components, step_ns) if components else {}
        designs = self._common.prepare(graph, step_ns, designs)
        for name, note in self._notes.items():
            graph.members[name].note = note
        graph.watched = frozenset()
        return replace(
            experiment,
            scenario=scenario,
            plan=replace(self._plan, designs={**self._plan.designs, **designs}),
            fmus=context.fmus.opened,
            files=frozenset(context.files.paths),
            modules=frozenset(context.files.modules),
            identified={},
            warnings=(*self._builder.warnings_of(scenario, context, graph), *self._warnings),
        )

    def _component(self, name: str, spec: Kind, context: ScenarioBuildContext) -> Component | None:
        """Build a component again; None: it does not fit into the place of the one before."""
        context.records.begin(name)
        component = spec.build(name, context)
        if name in self._port_maps:
            renamed = self._renamed(name, spec, component)
            if renamed is None:
                return None
            component = renamed
        component = with_units(component, spec.units_of(component.interface))
        period = spec.period_steps(name, context.step_ns)
        component = spec.with_period(component, period)
        before = self._scenario.specs[name]
        is_same = spec.recorded_period(period) == self._periods[name]
        is_same = is_same and asks_for_means(spec) == asks_for_means(before)
        if is_same and component.interface == self._components[name].interface:
            return component
        return None

    def _renamed(self, name: str, spec: Kind, component: Component) -> Component | None:
        """Show a component under the scenario's names; None: these may be other ports of it."""
        from cosim.blocks.renamed import Renamed  # rarely needed

        ports = self._port_maps[name]
        given = [entry.renaming for entry in self._scenario.maps[name]]
        before = self._scenario.specs[name].renamings(ports.component, given)
        if component.interface != ports.component:
            return None
        if spec.renamings(component.interface, given) != before:
            return None
        return Renamed(component, ports)


def _has_model_problems(
    scenario: Scenario, tables: Collection[str], context: ScenarioBuildContext
) -> bool:
    """Return whether one of the models that are other ones is wrong by itself."""
    for name, table in scenario.file.models.items():
        if f"models.{name}" in tables:
            if any(form_problems(table)):
                return True
            context.model(name)
    return False


def are_equal(one: Mapping[Port, Connection], other: Mapping[Port, Connection]) -> bool:
    """Return whether connections are the same."""
    if one.keys() != other.keys():
        return False
    return all(one[to] is other[to] or _key(one[to]) == _key(other[to]) for to in one)


def _key(connection: Connection) -> tuple[Any, ...]:
    gain = np.asarray(connection.gain)
    return connection.sources, gain.shape, gain.tobytes(), connection.offset, connection.unit
