"""All assumptions of a scenario: of its models, its components, and the beginning of its run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

from cosim.arguments import mapping_argument
from cosim.errors import AssumptionError, listing
from cosim.scenario.assumptions.beginning import Beginning, attempted
from cosim.scenario.assumptions.method import CHECKS, verdicts_of_model
from cosim.scenario.building.build import Builder
from cosim.scenario.building.coupling import COUPLING, gain_text, gain_values
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.running.execution import load
from cosim.theory.observers.assumptions import AssumptionVerdict, refused, undecided

BEGINNING: Final = "beginning of the run"
FILTER: Final = "the filter follows its inputs"
RESOLUTION: Final = "the step resolves the model"
FILE: Final = "the scenario"
NamedVerdict: TypeAlias = tuple[str, AssumptionVerdict]  # on a model, or a component


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
    verdicts: tuple[NamedVerdict, ...]
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
        beginning = Beginning(Builder(edited, resources))
        verdicts = _of_tables(beginning)
        verdicts += _of_run(beginning, verdicts)
        return AssumptionReport(edited.name, tuple(verdicts), tuple(beginning.warnings))


def _of_tables(beginning: Beginning) -> list[NamedVerdict]:
    """Check the models and the components; what rests on another comes behind it."""
    verdicts: list[NamedVerdict] = []
    for name in beginning.scenario.file.models:
        for verdict in verdicts_of_model(name, beginning):
            verdicts.append((f"models.{name}", verdict))
    for kind, check in CHECKS.items():
        for name, spec in beginning.scenario.specs.items():
            if isinstance(spec, kind):
                beginning.context.begin(name)
                for verdict in check(name, spec, beginning).verdicts():
                    verdicts.append((name, _resting(verdict, verdicts)))
    return verdicts


def _resting(verdict: AssumptionVerdict, on: Sequence[NamedVerdict]) -> AssumptionVerdict:
    """Return a verdict that repeats another as one that rests on it."""
    if not verdict.fulfilled:
        for name, other in on:
            if other.fulfilled is False and other.evidence in verdict.evidence:
                return undecided(verdict.name, f"{name}: {other.name} is not fulfilled")
    return verdict


def _of_run(beginning: Beginning, verdicts: Sequence[NamedVerdict]) -> list[NamedVerdict]:
    """Check that a run can begin, its loops and its step, and what else stands against it."""
    refusals = [verdict.evidence for _, verdict in verdicts if verdict.fulfilled is False]
    others = []
    for key, text in beginning.problems:
        if not any(evidence in text for evidence in refusals):
            others.append(refused(".".join(map(str, key)), AssumptionError(text)))
    if others:
        return [(FILE, verdict) for verdict in others]
    begun = _resting(attempted(BEGINNING, beginning.check), verdicts)
    of_run = [begun, *_coupling(beginning)]
    of_filters: list[NamedVerdict] = []
    if begun.fulfilled:
        of_run.append(_resolution(beginning))
        for name, spec in beginning.scenario.specs.items():
            if isinstance(spec, UnknownInputObserverKind):
                for text in beginning.builder.advice(name, spec, beginning.graph):
                    beginning.said.append((name, text))
                    of_filters.append((name, refused(FILTER, AssumptionError(text))))
    return of_filters + [(FILE, verdict) for verdict in of_run]


def _coupling(beginning: Beginning) -> list[AssumptionVerdict]:
    """Return whether the coupling of each loop leaves its results what they are."""
    may_refuse = beginning.scenario.file.scenario.coupling_check == "refuse"
    verdicts = []
    for report in beginning.loops():
        beginning.noted += [(COUPLING, text) for text in report.warnings]
        refusals = list(report.refusals)
        for gain in report.gains:
            name = f"coupling of {listing(gain.components)} {gain.action}".rstrip()
            text = refusals.pop(0) if refusals and gain.verdict == "refused" else ""
            if text and may_refuse:
                verdicts.append(refused(name, AssumptionError(text), gain_values(gain)))
                continue
            if text:
                beginning.noted.append((COUPLING, text))
            verdict = AssumptionVerdict(
                name=name,
                fulfilled=None if gain.verdict in ("unknown", "refused") else True,
                evidence=f"gain {gain_text(gain)}",
                values=gain_values(gain),
            )
            verdicts.append(verdict)
    return verdicts


def _resolution(beginning: Beginning) -> AssumptionVerdict:
    """Return whether a run with this step follows the exact solution of the model."""
    found = beginning.resolution()
    values = {"step": found.h, "fastest_rate": found.rate, "error": found.missed.error}
    if not found.is_resolved:
        return refused(RESOLUTION, AssumptionError(found.text, cure=found.cure), values)
    fulfilled = None if found.unknown else True
    return AssumptionVerdict(
        name=RESOLUTION, fulfilled=fulfilled, evidence=found.text, values=values
    )
