"""Run members as ``cosim run`` and ``cosim replay`` do: nothing is shared with another member.

The scenario is read anew for each, built as a whole, and its designs are computed: what a study
keeps for speed, and what it has sent along, has no part in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack, closing
from dataclasses import replace
from typing import final

from cosim.scenario.building.experiment import Experiment
from cosim.scenario.preparing import build_experiment
from cosim.studies.contracts import (
    MemberOutcome,
    MemberRunner,
    MetricValue,
    StudyMember,
    StudySubject,
)
from cosim.studies.document.scenario_of_study import load_scenario
from cosim.studies.measuring import MetricRecorder
from cosim.studies.members.measuring import MemberRecorder
from cosim.studies.members.member_builder import MemberBuilder
from cosim.studies.members.member_run import measure, outcome_of
from cosim.studies.metrics import parse_metrics


def open_lone_runner(subject: StudySubject) -> LoneRunner:
    """Return what runs members alone; parameters and errors as of ``open_runner``."""
    return LoneRunner(subject)


@final
class LoneRunner(MemberRunner):
    """Runs members of a study, each built afresh.

    Parameters
    ----------
    subject : StudySubject
        Its designs are not taken.
    """

    def __init__(self, subject: StudySubject) -> None:
        self._subject = replace(subject, designs="", replay_designs=())
        self._metrics = parse_metrics(subject.metrics)

    def close(self) -> None:
        """Do nothing: each member frees what it holds."""

    def run(self, member: StudyMember) -> MemberOutcome:
        """Run a member; what fails is an outcome."""
        measured = MemberRecorder(MetricRecorder(self._metrics))
        return outcome_of(
            member.number,
            lambda: self._run(member, measured),
            measured,
            metrics=self._subject.metrics,
        )

    def _run(self, member: StudyMember, measured: MemberRecorder) -> Mapping[str, MetricValue]:
        with ExitStack() as resources:
            experiment = self._experiment(member, resources)
            return measure(experiment, measured, with_results=self._subject.with_results)

    def _experiment(self, member: StudyMember, resources: ExitStack) -> Experiment:
        subject = self._subject
        if member.recording is not None:
            builder = resources.enter_context(closing(MemberBuilder(subject)))
            return builder.experiment(replace(member, designs=""), resources)
        swaps = {**subject.swap, **member.swap}
        values = {**subject.set, **member.set}
        scenario = load_scenario(subject.scenario).edit(swap=swaps, map=subject.map, set=values)
        return build_experiment(scenario, resources, None)
