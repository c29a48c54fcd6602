"""What is known of a run before its first step: problems, designs, initial values, theta, delta."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property
from itertools import chain
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core.clock import Clock
from cosim.core.contracts import Design, prepare
from cosim.core.gain.loop_gain import LinearizedLoops
from cosim.core.gain.resolution import Resolution, resolution
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.errors import AssumptionError, RunError, UsageError, option
from cosim.native.step import LARGEST_MEMORY
from cosim.scenario.building.build import Builder
from cosim.scenario.building.coupling import CouplingReport, coupling_reports
from cosim.scenario.building.experiment import Experiment, warnings_among
from cosim.scenario.document.places import Problem
from cosim.scenario.document.problems import out_of_range
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.kinds.build_record import DependsOnInvalid
from cosim.scenario.kinds.capabilities import change_text, changed_states
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.identified_plant import diagonal_covariance, stated_covariance
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.kinds.parts import SensorKind
from cosim.scenario.kinds.regressor import RegressorKind
from cosim.scenario.kinds.sources import DisturbanceKind
from cosim.scenario.kinds.terms import FamilyTerm
from cosim.theory.observers.assumptions import AssumptionVerdict, checked, refused, undecided

RESTS_ON_INVALID: Final = "depends on something invalid"
NOISE_NEEDED: Final = (
    "the noise of y is unknown; expected a sensor with noise that drives the observer directly, "
    "the deviation of the identifier, or"
)
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


# --- what the tables say of the noise of y, and of theta ---


def noise_of(
    scenario: Scenario,
    identifier: str,
    observer: str,
    outputs: int,
    given: float | Sequence[float] | None = None,
) -> tuple[Matrix, str]:
    """Return the covariance of the noise of y, and where it is from.

    Parameters
    ----------
    scenario : Scenario
    identifier, observer : str
    outputs : int
        The number of elements of y.
    given : float or sequence of float, optional
        Deviations, in place of what the tables say.

    Raises
    ------
    UsageError
        If nothing says what it is, or deviations are not positive, or not as many.
    """
    kind = scenario.specs[identifier]
    designed = scenario.specs[observer]
    assert isinstance(kind, IdentifierKind)
    assert isinstance(designed, UnknownInputObserverKind)
    if given is None and kind.deviation is None and kind.covariance is not None:
        covariance = stated_covariance(None, kind.covariance, outputs)
        assert covariance is not None
        return covariance, f"{identifier}.covariance"
    if isinstance(given, Sequence) and len(given) == 1:
        given = given[0]  # of all outputs
    stated = {
        option("noise"): given,
        f"{identifier}.deviation": kind.deviation,
        f"{observer}.noise": designed.noise,
    }
    for source, values in stated.items():
        if values is not None:
            return diagonal_covariance(source, values, outputs), source
    source, deviations = _noise_of_sensor(scenario, observer)
    return diagonal_covariance(source, deviations, outputs), source


def _noise_of_sensor(scenario: Scenario, observer: str) -> tuple[str, NDArray[np.float64]]:
    """Return the noise of the sensor that drives y directly."""
    to = Port(observer, "y")
    connection = scenario.connections.get(to)
    name = scenario.driver(to)
    kind = None if name is None else scenario.specs.get(name)
    if connection is None or not isinstance(kind, SensorKind):
        raise UsageError(f"{NOISE_NEEDED} {option('noise')}")
    if connection.matrix.ndim:
        raise UsageError(
            f"'{to}' mixes the outputs of {name!r} by a matrix; give the noise of y by "
            f"{option('noise')}"
        )
    deviations = abs(float(connection.matrix)) * np.array(kind.noise, np.float64)
    if not deviations.all():
        raise UsageError(f"{NOISE_NEEDED} {option('noise')}")
    return f"{name}.noise", np.asarray(deviations)


def disturbance_among(scenario: Scenario, components: Collection[str]) -> str | None:
    """Return the only component that makes a disturbance of the class; None: there is not one."""
    names = [name for name in components if isinstance(scenario.specs[name], DisturbanceKind)]
    return names[0] if len(names) == 1 else None


def parameters_by_term(
    scenario: Scenario, regressor: str, disturbance: str
) -> tuple[list[list[float]], list[int]]:
    """Return the parameters of every term of a regressor, and which of the disturbance it is.

    Raises
    ------
    UsageError
        If their terms differ.
    """
    kind = scenario.specs[regressor]
    makes = scenario.specs[disturbance]
    assert isinstance(kind, RegressorKind)
    assert isinstance(makes, DisturbanceKind)
    left: list[dict[str, Any] | None] = list(map(_shape, makes.terms))
    places = []
    for term in kind.terms:
        if _shape(term) in left:
            places.append(left.index(_shape(term)))
            left[places[-1]] = None
    if not len(places) == len(kind.terms) == len(left):
        raise UsageError(
            f"expected the same alphas and families in {regressor!r} and in {disturbance!r}, the "
            "source of the disturbance, got different terms"
        )
    parameters = []
    for place in places:
        theta = makes.terms[place].theta
        values = () if theta is None else theta
        parameters.append(np.atleast_1d(np.asarray(values, np.float64)).tolist())
    return parameters, places


def _shape(term: FamilyTerm) -> dict[str, Any]:
    """Return what a term has without its parameters and constants."""
    return {key: getattr(term, key) for key in FamilyTerm.model_fields}
