"""All assumptions of a scenario: of its models, its components, and the beginning of its run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arguments import mapping_argument
from cosim.arrays import Vector
from cosim.core.contracts import prepare
from cosim.core.port import Port
from cosim.errors import AssumptionError, UsageError, listing
from cosim.native.step import LARGEST_MEMORY
from cosim.scenario.assumptions.attempts import RESTS_ON_INVALID, attempted
from cosim.scenario.assumptions.beginning import BEGINNING, Beginning
from cosim.scenario.assumptions.compensation import CompensatorCheck, driven_by
from cosim.scenario.assumptions.identification import IdentifierCheck
from cosim.scenario.assumptions.regression import RegressorCheck
from cosim.scenario.building.build import Builder
from cosim.scenario.building.coupling import (
    COUPLING,
    CouplingReport,
    gain_text,
    gain_values,
)
from cosim.scenario.building.known_truth import disturbance_among, parameters_by_term
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.kinds.base import Kind
from cosim.scenario.kinds.build_record import DependsOnInvalid
from cosim.scenario.kinds.compensators import CompensatorKind
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.kinds.regressor import RegressorKind
from cosim.scenario.running.execution import load
from cosim.theory.observers.assumptions import (
    DECOUPLING,
    DETECTABILITY,
    DIRECT_PATH,
    HURWITZ,
    AssumptionVerdict,
    gain_evidence,
    observer_verdicts,
    outputs_verdict,
    plant_verdicts,
    refused,
    undecided,
)

OF_OBSERVER: Final = (DIRECT_PATH, DECOUPLING, DETECTABILITY, HURWITZ)
MATRICES: Final = "matrices"
FILTER: Final = "the filter follows its inputs"
RESOLUTION: Final = "the step resolves the model"
FILE: Final = "the scenario"


@dataclass(frozen=True, eq=False)
class AssumptionReport:
    """Verdicts on the assumptions of a scenario.

    Parameters
    ----------
    scenario : str
    verdicts : tuple of (str, AssumptionVerdict)
        Each with the model or component that it is about.
    warnings : tuple of (str, str)
        Warnings that a run would give, each with its component.
    """

    scenario: str
    verdicts: tuple[tuple[str, AssumptionVerdict], ...]
    warnings: tuple[tuple[str, str], ...]

    @property
    def fulfilled(self) -> bool:
        """Whether no assumption is known to fail."""
        return not any(verdict.fulfilled is False for _, verdict in self.verdicts)

    def of(self, subject: str) -> dict[str, AssumptionVerdict]:
        """Return the verdicts on a model or a component, by their names."""
        return {verdict.name: verdict for name, verdict in self.verdicts if name == subject}

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        verdicts = [{"of": name, **verdict.to_dict()} for name, verdict in self.verdicts]
        return {
            "scenario": self.scenario,
            "fulfilled": self.fulfilled,
            "assumptions": verdicts,
            "warnings": [{"of": name, "text": text} for name, text in self.warnings],
        }


def check_assumptions(
    scenario: str | Path | Scenario, *, set: Mapping[str, Any] | None = None
) -> AssumptionReport:
    """Check all assumptions of a scenario, also after one fails.

    Everything that a run does before its first step is done; no step is taken.

    Parameters
    ----------
    scenario : str, Path or Scenario
        A shipped name, a path, or what :func:`load` returned.
    set : mapping of dotted key to value, optional
        As for :func:`run`.

    Raises
    ------
    ScenarioError
        With every problem of the file other than its assumptions.
    """
    loaded = scenario if isinstance(scenario, Scenario) else load(scenario)
    edited = loaded.edit(set=mapping_argument("set", set))
    with ExitStack() as resources:
        builder = Builder(edited, resources)
        check = _Check(builder)
        verdicts = tuple(check.verdicts())
        return AssumptionReport(edited.name, verdicts, check.warnings)


class _Check:
    """The checks of a scenario as far as it could be built."""

    def __init__(self, builder: Builder) -> None:
        self._builder = builder
        self._scenario = builder.scenario
        self._context = builder.context
        self._beginning = Beginning(builder)
        self._of_coupling: list[tuple[str, str]] = []
        self._refused: list[tuple[str, str]] = []

    @property
    def warnings(self) -> tuple[tuple[str, str], ...]:
        """What a run would warn of beside what is refused, after the checks."""
        warnings = (*self._beginning.warnings, *self._of_coupling)
        return tuple(warning for warning in warnings if warning not in self._refused)

    def verdicts(self) -> list[tuple[str, AssumptionVerdict]]:
        """Return all verdicts, with what each is of."""
        verdicts: list[tuple[str, AssumptionVerdict]] = []
        for name in self._scenario.file.models:
            verdicts += [(f"models.{name}", verdict) for verdict in self._of_model(name)]
        checks = (
            self._of_observer,
            self._of_regressor,
            self._of_identifier,
            self._of_compensator,
        )
        for check in checks:  # what rests on another comes behind it
            for name, kind in self._scenario.specs.items():
                self._context.begin(name)
                for verdict in check(name, kind):
                    verdicts.append((name, _resting_on(verdicts, verdict)))
        others = self._others(verdicts)
        if not others:
            others = [_resting_on(verdicts, attempted(BEGINNING, self._beginning.check))]
            others += self._of_loops()
            if others[0].fulfilled:
                others.append(self._resolution())
                verdicts += self._of_filters()
        return verdicts + [(FILE, verdict) for verdict in others]

    def _of_model(self, name: str) -> list[AssumptionVerdict]:
        try:
            return list(plant_verdicts(self._context.model(name)))
        except UsageError:
            problems = [text for key, text in self._builder.problems if key[:2] == ("models", name)]
            return [refused(MATRICES, AssumptionError(text)) for text in problems]

    def _of_observer(self, name: str, kind: Kind) -> list[AssumptionVerdict]:
        if not isinstance(kind, UnknownInputObserverKind):
            return []
        context = self._context
        try:
            reduced = kind.design_model_of(name, context).reduced
        except DependsOnInvalid as error:
            reason = str(error) or RESTS_ON_INVALID
            return [undecided(assumption, reason) for assumption in OF_OBSERVER]
        except UsageError as error:
            return self._without_reduced(kind, error)
        verdicts_of_plant = list(observer_verdicts(reduced))
        failing = [verdict.name for verdict in verdicts_of_plant if verdict.fulfilled is False]
        if failing:
            return [*verdicts_of_plant, undecided(HURWITZ, f"{failing[0]} is not fulfilled")]
        gain = attempted(HURWITZ, lambda: gain_evidence(kind.design(name, context).design))
        verdicts_of_all = [*verdicts_of_plant, gain]
        if kind.relinearize:
            return list(map(_at_operating_point, verdicts_of_all))
        return verdicts_of_all

    def _without_reduced(
        self, kind: UnknownInputObserverKind, error: UsageError
    ) -> list[AssumptionVerdict]:
        """Return what can be said of an observer whose model cannot be reduced."""
        reason = "there is no reduced system"
        verdicts = {assumption: undecided(assumption, reason) for assumption in OF_OBSERVER}
        if kind.model in self._scenario.file.models:
            system = self._context.model(str(kind.model))
            verdicts[DECOUPLING] = outputs_verdict(*system.Dd.shape)
        else:
            verdicts[DIRECT_PATH] = refused(DIRECT_PATH, AssumptionError(str(error)))
        return list(verdicts.values())

    def _of_regressor(self, name: str, kind: Kind) -> list[AssumptionVerdict]:
        if not isinstance(kind, RegressorKind):
            return []
        return RegressorCheck(name, kind, self._context, self._theta(name)).verdicts()

    def _of_identifier(self, name: str, kind: Kind) -> list[AssumptionVerdict]:
        if not isinstance(kind, IdentifierKind):
            return []
        theta = self._theta_behind(name)
        return IdentifierCheck(name, kind, self._builder, theta, self._delta).verdicts()

    def _of_compensator(self, name: str, kind: Kind) -> list[AssumptionVerdict]:
        if not isinstance(kind, CompensatorKind):
            return []
        theta = None
        identifier = driven_by(name, self._builder)
        if identifier is not None and kind.terms is None:
            theta = self._theta_behind(identifier)
        check = CompensatorCheck(name, kind, self._builder, self._beginning, theta, self._delta)
        return check.verdicts()

    def _theta_behind(self, identifier: str) -> Vector | None:
        """Return theta of the disturbance in the order of an identifier; None: it is not known."""
        regressor = self._context.driver(Port(identifier, "regressor"))
        return None if regressor is None else self._theta(regressor)

    def _theta(self, regressor: str) -> Vector | None:
        """Return theta of the disturbance in the order of a regressor; None: it is not known."""
        disturbance = disturbance_among(self._scenario, self._scenario.specs)
        is_regressor = isinstance(self._scenario.specs.get(regressor), RegressorKind)
        if disturbance is None or not is_regressor:
            return None
        try:
            own, _ = parameters_by_term(self._scenario, regressor, disturbance)
        except UsageError:
            return None
        return np.array(list(chain.from_iterable(own)))

    @cached_property
    def _delta(self) -> Vector | None:
        """The disturbance at the communication points; None: it is not known."""
        name = disturbance_among(self._scenario, self._scenario.specs)
        component = None if name is None else self._builder.components.get(name)
        if component is None or component.interface.n_u or component.interface.n_y != 1:
            return None
        clock = self._builder.clock
        if clock.steps > LARGEST_MEMORY:
            return None
        prepare(component, clock.h, np.zeros(0, np.bool_), {})
        t = clock.points
        nothing = np.zeros((len(t), 0))
        component.initialize(float(t[0]), nothing[0])
        first = component.outputs(float(t[0]), nothing[0])
        rows = component.advance(t, clock.h, nothing)
        return np.append(first, rows[:, 0])

    def _of_loops(self) -> list[AssumptionVerdict]:
        """Return whether the coupling of each loop leaves its results what they are."""
        verdicts = []
        for report in self._beginning.loops():
            verdicts += self._of_coupled(report)
        return verdicts

    def _of_filters(self) -> list[tuple[str, AssumptionVerdict]]:
        """Return the observers whose filters do not follow their inputs over a step."""
        verdicts = []
        for name, kind in self._scenario.specs.items():
            if isinstance(kind, UnknownInputObserverKind):
                for text in self._builder.advice(name, kind, self._beginning.graph):
                    self._refused.append((name, text))
                    verdicts.append((name, refused(FILTER, AssumptionError(text))))
        return verdicts

    def _resolution(self) -> AssumptionVerdict:
        """Return whether a run with this step follows the exact solution of the model."""
        found = self._beginning.resolution()
        values = {"step": found.h, "fastest_rate": found.rate, "error": found.missed.error}
        if not found.is_resolved:
            return refused(RESOLUTION, AssumptionError(found.text, cure=found.cure), values)
        fulfilled = None if found.unknown else True
        return AssumptionVerdict(
            name=RESOLUTION, fulfilled=fulfilled, evidence=found.text, values=values
        )

    def _of_coupled(self, report: CouplingReport) -> list[AssumptionVerdict]:
        self._of_coupling += [(COUPLING, text) for text in report.warnings]
        may_refuse = self._scenario.file.scenario.coupling_check == "refuse"
        verdicts = []
        refusals = iter(report.refusals)
        for gain in report.gains:
            name = f"coupling of {listing(gain.components)}"
            if gain.action:
                name += f" {gain.action}"
            numbers = gain_values(gain)
            text = next(refusals, None) if gain.verdict == "refused" else None
            if text is not None:
                if may_refuse:
                    verdicts.append(refused(name, AssumptionError(text), numbers))
                    continue
                self._of_coupling.append((COUPLING, text))
            decided = None if gain.verdict in ("unknown", "refused") else True
            text = f"gain {gain_text(gain)}"
            verdict = AssumptionVerdict(name=name, fulfilled=decided, evidence=text, values=numbers)
            verdicts.append(verdict)
        return verdicts

    def _others(self, verdicts: list[tuple[str, AssumptionVerdict]]) -> list[AssumptionVerdict]:
        """Return what else stands against a run, beside the assumptions."""
        refusals = [verdict.evidence for _, verdict in verdicts if verdict.fulfilled is False]
        others = []
        for key, text in self._beginning.problems:
            if not any(evidence in text for evidence in refusals):
                place = ".".join(map(str, key))
                others.append(refused(place, AssumptionError(text)))
        return others


def _at_operating_point(verdict: AssumptionVerdict) -> AssumptionVerdict:
    """Return a verdict on a model that is linearized anew on the way, where the run checks it."""
    if not verdict.fulfilled:
        return verdict
    evidence = (
        f"not decided: fulfilled at the operating point ({verdict.evidence}); checked again during "
        "the run"
    )
    return replace(verdict, fulfilled=None, evidence=evidence)


def _resting_on(
    verdicts: Sequence[tuple[str, AssumptionVerdict]], verdict: AssumptionVerdict
) -> AssumptionVerdict:
    """Return a verdict that repeats another as one that rests on it."""
    if verdict.fulfilled:
        return verdict
    for name, other in verdicts:
        if other.fulfilled is False and other.evidence in verdict.evidence:
            return undecided(verdict.name, f"{name}: {other.name} is not fulfilled")
    return verdict
