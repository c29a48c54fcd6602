"""Designs that runs have in common: computed once, maybe on another machine, and taken here.

Linear algebra gives other bits on other machines. So a run takes each array of its designs that
does not depend on what it has of its own. Which these are shows where they were computed for both
on one machine: there they have the same bits.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from cosim.core.contracts import Design
from cosim.core.graph import Graph
from cosim.errors import CosimError
from cosim.instants import StepNs
from cosim.log.contents.metadata import decode_design
from cosim.scenario.building.experiment import Experiment


@dataclass(frozen=True)
class CommonDesigns:
    """The designs of what runs have in common.

    Parameters
    ----------
    computed : mapping of component name to Design
        On this machine.
    given : mapping of component name to Design
        Where they were computed first; the same object: here.
    own : mapping of component name to Design
        Arrays of one run alone, as it had them before; they come before all others.
    """

    computed: Mapping[str, Design]
    given: Mapping[str, Design]
    own: Mapping[str, Design] = field(default_factory=dict)

    def taken(self, designs: Mapping[str, Design]) -> dict[str, Design]:
        """Return those designs that have other bits here, with the bits that they should have.

        Parameters
        ----------
        designs : mapping of component name to Design
            Of a run, computed on this machine.
        """
        if self.given is self.computed and not self.own:
            return {}
        changed: dict[str, Design] = {}
        for name, design in designs.items():
            taken = {key: self._array(name, key, array) for key, array in design.items()}
            if any(taken[key] is not array for key, array in design.items()):
                changed[name] = taken
        return changed

    def prepare(
        self, graph: Graph, step_ns: StepNs, designs: Mapping[str, Design]
    ) -> dict[str, Design]:
        """Prepare components of a graph again whose designs have other bits here.

        Parameters
        ----------
        graph : Graph
        step_ns : int
            Communication step [ns].
        designs : mapping of component name to Design
            Of its components, as they are prepared.

        Returns
        -------
        dict of component name to Design
            All of them.
        """
        prepared = dict(designs)
        for name, design in self.taken(designs).items():
            prepared[name] = graph.prepare_one(name, step_ns, design)
        return prepared

    def prepared(self, experiment: Experiment) -> Experiment:
        """Return an experiment whose graph is prepared; one that cannot be is left to its run.

        What a replay takes from its log stays.
        """
        graph = experiment.graph
        step_ns = experiment.clock.step_ns
        recorded = experiment.designs or {}
        with suppress(CosimError):
            plan = experiment.plan or graph.prepare(step_ns, recorded)
            computed = without(plan.designs, recorded)
            designs = {**plan.designs, **self.prepare(graph, step_ns, computed)}
            return replace(experiment, plan=replace(plan, designs=designs))
        return experiment

    def with_settings(self, experiment: Experiment) -> Experiment:
        """Return an experiment with these designs of what actions set, too."""
        computed = setting_designs(experiment)
        taken = self.taken(computed)
        if not taken:
            return experiment
        from cosim.scenario.actions.settings import prepare_settings  # rarely needed

        step_ns = experiment.clock.step_ns
        known = {name: decode_design(text) for name, text in experiment.setting_designs.items()}
        recorded = {**known, **taken}
        texts = prepare_settings(experiment.graph, step_ns, experiment.settings, recorded)
        return replace(experiment, setting_designs=texts)

    def _array(self, name: str, key: str, array: NDArray[np.float64]) -> NDArray[np.float64]:
        own = self.own.get(name, {}).get(key)
        if own is not None and own.shape == array.shape:
            return array if same_bits(own, array) else own
        given = self.given.get(name, {}).get(key)
        computed = self.computed.get(name, {}).get(key)
        if given is None or computed is None or not same_bits(array, computed):
            return array
        return array if same_bits(given, array) else given


def without(designs: Mapping[str, Design], others: Collection[str]) -> dict[str, Design]:
    """Return the designs of all components but some, in their order."""
    return {name: design for name, design in designs.items() if name not in others}


def setting_designs(experiment: Experiment) -> dict[str, Design]:
    """Return the designs of what actions set in a run, by time and component.

    Those that a replay takes from its log are none of them.
    """
    recorded = experiment.designs or {}
    designs: dict[str, Design] = {}
    for name, text in experiment.setting_designs.items():
        if name.partition(" ")[2] not in recorded:
            designs[name] = decode_design(text)
    return designs


def with_settings(experiment: Experiment) -> Experiment:
    """Prepare the components that take the places of others in the run."""
    if not experiment.settings:
        return experiment
    from cosim.scenario.actions.settings import prepare_settings  # rarely needed

    step_ns = experiment.clock.step_ns
    designs = prepare_settings(experiment.graph, step_ns, experiment.settings, {})
    return replace(experiment, setting_designs=designs)


def same_bits(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Return whether two arrays are the same in shape and bits."""
    return one is other or (one.shape == other.shape and one.tobytes() == other.tobytes())
