"""What is known of a run before its first step: problems, designs, initial values, theta, delta."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from itertools import chain
from typing import Any, Final, TypeAlias

import numpy as np

from cosim.arrays import Vector
from cosim.core.clock import Clock
from cosim.core.contracts import Design, prepare
from cosim.core.gain.loop_gain import LinearizedLoops
from cosim.core.gain.resolution import Resolution, resolution
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.errors import AssumptionError, RunError, UsageError
from cosim.native.step import LARGEST_MEMORY
from cosim.scenario.building.build import Builder
from cosim.scenario.building.coupling import CouplingReport, coupling_reports
from cosim.scenario.building.experiment import Experiment, warnings_among
from cosim.scenario.building.known_truth import disturbance_among, parameters_by_term
from cosim.scenario.document.places import Problem
from cosim.scenario.document.problems import out_of_range
from cosim.scenario.kinds.build_record import DependsOnInvalid
from cosim.scenario.kinds.initial_states import change_text, changed_states
from cosim.scenario.kinds.regressor import RegressorKind
from cosim.theory.observers.assumptions import AssumptionVerdict, checked, refused, undecided

RESTS_ON_INVALID: Final = "depends on something invalid"
Evidence: TypeAlias = tuple[str, Mapping[str, Any]]  # in a sentence, and its numbers


def attempted(name: str, check: Callable[[], Evidence]) -> AssumptionVerdict:
    """Return the verdict of a check, whatever error it ends with.

    Parameters
    ----------
    name : str
        Of the assumption.
    check : callable
        Returns evidence and numbers, or raises what stands against the assumption.
    """
    try:
        return checked(name, check)
    except DependsOnInvalid as error:
        return undecided(name, str(error) or RESTS_ON_INVALID)
    except (UsageError, ValueError) as error:
        return refused(name, AssumptionError(str(error)))
    except (ArithmeticError, MemoryError) as error:
        return refused(name, AssumptionError(out_of_range(error)))


class Beginning:
    """The beginning of the run of a scenario, as a run goes about it.

    Parameters
    ----------
    builder : Builder

    Attributes
    ----------
    builder : Builder
    scenario : Scenario
    context : BuildContext
        What the components were built in.
    designs : dict of component name to Design
        Those that were computed to be checked.
    refused : list of str
        The components that have no design.
    noted : list of (str, str)
        What the run warns of beside what its build does.
    said : list of (str, str)
        Warnings that verdicts say.
    """

    def __init__(self, builder: Builder) -> None:
        self.builder = builder
        self.scenario = builder.scenario
        self.context = builder.context
        self.designs: dict[str, Design] = {}
        self.refused: list[str] = []
        self._row: Vector | None = None
        self.noted: list[tuple[str, str]] = []
        self.said: list[tuple[str, str]] = []

    @cached_property
    def problems(self) -> list[Problem]:
        """Every problem of the file and of the graph."""
        return [*self.builder.problems, *self.builder.graph_problems()]

    @property
    def clock(self) -> Clock:
        """The communication points of the run."""
        return self.builder.clock

    @cached_property
    def _experiment(self) -> Experiment:
        if self.problems:
            raise DependsOnInvalid
        return self.builder.experiment()

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
    def warnings(self) -> list[tuple[str, str]]:
        """What the run warns of before its first step, by component, beside what is said."""
        warnings = dict.fromkeys([*self.context.warnings, *self.noted])
        return [warning for warning in warnings if warning not in self.said]

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
        clock = self.clock
        row = np.zeros(graph.layout.width)
        try:
            graph.prepare(clock.step_ns, self.designs)
            graph.initialize(clock.start_time, row)
        except RunError as error:
            raise AssumptionError(str(error)) from error
        finally:
            fmus = self._experiment.built.fmus
            self.noted += warnings_among({name: fmu.drain() for name, fmu in fmus.items()})
        self._row = row
        count = len(graph.components)
        evidence = (
            f"{count} component(s) are prepared for steps of {clock.h:g} s and have "
            "their initial values"
        )
        for name, changed in changed_states(graph, self.builder.given_states, row).items():
            evidence += f"; {name}: {change_text(changed)}"
        return evidence, {"components": count}

    @cached_property
    def _loops(self) -> LinearizedLoops:
        assert self._row is not None, "behind a check that is fulfilled"
        return LinearizedLoops.of(self.graph, self.clock, self._row)

    def loops(self) -> list[CouplingReport]:
        """Return what is known of the loops, after the check; nothing where no run would begin.

        As they begin, then behind actions.
        """
        if self._row is None:
            return []
        return coupling_reports(self._experiment, self._loops, self._row)

    def resolution(self) -> Resolution:
        """Return whether the step resolves the model, after a check that is fulfilled."""
        linearized = self._loops.linearized
        assert self._row is not None
        return resolution(self.graph, self.clock, self._row, linearized)

    # --- the disturbance ---

    @cached_property
    def _disturbance(self) -> str | None:
        return disturbance_among(self.scenario, self.scenario.specs)

    def theta(self, regressor: str | None) -> Vector | None:
        """Return theta of the disturbance in the order of a regressor; None: it is not known."""
        is_regressor = isinstance(self.scenario.specs.get(regressor or ""), RegressorKind)
        if regressor is None or self._disturbance is None or not is_regressor:
            return None
        try:
            own, _ = parameters_by_term(self.scenario, regressor, self._disturbance)
        except UsageError:
            return None
        return np.array(list(chain.from_iterable(own)))

    def theta_behind(self, identifier: str) -> Vector | None:
        """Return theta of the disturbance in the order of an identifier; None: it is not known."""
        return self.theta(self.context.driver(Port(identifier, "regressor")))

    @cached_property
    def delta(self) -> Vector | None:
        """The disturbance at the communication points, shape (N,); None: it is not known."""
        component = self.builder.components.get(self._disturbance or "")
        if component is None or component.interface.n_u or component.interface.n_y != 1:
            return None
        clock = self.clock
        if clock.steps > LARGEST_MEMORY:
            return None
        prepare(component, clock.h, np.zeros(0, np.bool_), {})
        t = clock.points
        nothing = np.zeros((len(t), 0))
        component.initialize(float(t[0]), nothing[0])
        first = component.outputs(float(t[0]), nothing[0])
        rows = component.advance(t, clock.h, nothing)
        return np.append(first, rows[:, 0])
