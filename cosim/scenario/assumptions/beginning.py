"""What a run does before its first step: the graph, the designs, the initial values."""

from __future__ import annotations

from functools import cached_property
from typing import Final

import numpy as np

from cosim.arrays import Vector
from cosim.core.contracts import Design
from cosim.core.gain.loop_gain import LinearizedLoops
from cosim.core.gain.resolution import Resolution, resolution
from cosim.core.graph import Graph
from cosim.errors import AssumptionError, RunError
from cosim.scenario.assumptions.attempts import Evidence
from cosim.scenario.building.build import Builder
from cosim.scenario.building.coupling import CouplingReport, coupling_reports
from cosim.scenario.building.experiment import Experiment, warnings_among
from cosim.scenario.document.places import Problem
from cosim.scenario.kinds.build_record import DependsOnInvalid
from cosim.scenario.kinds.initial_states import change_text, changed_states

BEGINNING: Final = "beginning of the run"


class Beginning:
    """The beginning of the run of a scenario, as a run goes about it.

    Parameters
    ----------
    builder : Builder

    Attributes
    ----------
    designs : dict of component name to Design
        Those that were computed to be checked.
    refused : list of str
        The components that have no design.
    """

    def __init__(self, builder: Builder) -> None:
        self._builder = builder
        self.designs: dict[str, Design] = {}
        self.refused: list[str] = []
        self._row: Vector | None = None
        self._of_fmus: list[tuple[str, str]] = []

    @cached_property
    def problems(self) -> list[Problem]:
        """Every problem of the file and of the graph."""
        return [*self._builder.problems, *self._builder.graph_problems()]

    @cached_property
    def _experiment(self) -> Experiment:
        """What would run.

        Raises
        ------
        DependsOnInvalid
            If there is a problem.
        """
        if self.problems:
            raise DependsOnInvalid
        return self._builder.experiment()

    @property
    def graph(self) -> Graph:
        """The graph.

        Raises
        ------
        DependsOnInvalid
            If there is a problem.
        """
        return self._experiment.graph

    @property
    def warnings(self) -> tuple[tuple[str, str], ...]:
        """What the run warns of before its first step, by component, each once."""
        warnings = [*self._builder.context.warnings, *self._of_fmus]
        return tuple(dict.fromkeys(warnings))

    def check(self) -> Evidence:
        """Prepare and initialize every component.

        Raises
        ------
        DependsOnInvalid
            If a component, or its design, is not valid.
        UsageError
            As the run would.
        """
        graph = self.graph
        if self.refused:
            raise DependsOnInvalid(f"no gains of {', '.join(map(repr, self.refused))}")
        clock = self._builder.clock
        row = np.zeros(graph.layout.width)
        try:
            graph.prepare(clock.step_ns, self.designs)
            graph.initialize(clock.start_time, row)
        except RunError as error:
            raise AssumptionError(str(error)) from error
        finally:
            fmus = self._experiment.fmus
            self._of_fmus = warnings_among({name: fmu.drain() for name, fmu in fmus.items()})
        self._row = row
        count = len(graph.components)
        evidence = (
            f"{count} component(s) are prepared for steps of {clock.h:g} s and have "
            "their initial values"
        )
        changes = changed_states(graph, self._builder.given_states, row)
        for name, changed in changes.items():
            evidence += f"; {name}: {change_text(changed)}"
        return evidence, {"components": count}

    @cached_property
    def _linearized(self) -> LinearizedLoops | None:
        """The components, linearized behind the check; None: no run would begin."""
        if self._row is None:
            return None
        return LinearizedLoops.of(self.graph, self._builder.clock, self._row)

    def loops(self) -> list[CouplingReport]:
        """Return what is known of the loops, after the check; nothing where no run would begin.

        As they begin, then behind actions.
        """
        loops = self._linearized
        if loops is None or self._row is None:
            return []
        return coupling_reports(self._experiment, loops, self._row)

    def resolution(self) -> Resolution:
        """Return whether the step resolves the model, after a check that is fulfilled."""
        loops = self._linearized
        assert loops is not None
        assert self._row is not None
        return resolution(self.graph, self._builder.clock, self._row, loops.linearized)
