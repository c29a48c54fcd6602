"""Run the members of a study one after the other in this process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from typing import Final, final

from cosim.scenario.building.common_designs import setting_designs, without
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.parsing import Scenario
from cosim.scenario.recordings.recording import run_rows
from cosim.studies.contracts import (
    MemberOutcome,
    MemberRunner,
    MetricValue,
    StudyMember,
    StudySubject,
)
from cosim.studies.measuring import MetricRecorder
from cosim.studies.members.designs import encode_designs, own_designs
from cosim.studies.members.measuring import MemberRecorder, MetricSink
from cosim.studies.members.member_builder import MemberBuilder
from cosim.studies.members.member_run import measure, outcome_of
from cosim.studies.members.sources import member_texts
from cosim.studies.metrics import parse_metrics

BLOCK_BYTES: Final = 2**19  # of the rows of a block, which stay in the cache


def open_runner(
    subject: StudySubject,
    *,
    sink_of: Callable[[], MetricSink] | None = None,
) -> SubjectRunner:
    """Return what runs the members of a study in this process; a context manager.

    Parameters
    ----------
    subject : StudySubject
    sink_of : callable, optional
        Returns what keeps the metrics of a run; left out: those of the subject.

    Raises
    ------
    ScenarioError
        If there is no such scenario, or it has problems of its own.
    UsageError
        If a metric or the designs cannot be understood.
    """
    metrics = parse_metrics(subject.metrics)
    if sink_of is not None:
        return SubjectRunner(subject, sink_of)
    recorder = MetricRecorder(metrics)  # of one run after the other
    return SubjectRunner(subject, lambda: recorder)


@final
class SubjectRunner(MemberRunner):
    """Runs members of one study: each with the bits that it has alone, in a process of its own.

    Parameters
    ----------
    subject : StudySubject
    sink_of : callable
        Returns what keeps the metrics of a run.
    """

    def __init__(self, subject: StudySubject, sink_of: Callable[[], MetricSink]) -> None:
        self._subject = subject
        self._sink_of = sink_of
        self._builder = MemberBuilder(subject)

    def close(self) -> None:
        """Free what is kept of its members."""
        self._builder.close()

    def run(self, member: StudyMember) -> MemberOutcome:
        """Run a member.

        Raises
        ------
        Interrupted
            If the user interrupts it.
        ChangedFileError
            If a file that it reads is another one than when the study was planned. All else that
            fails is an outcome.
        """
        measured = MemberRecorder(self._sink_of())
        outcome = outcome_of(
            member.number,
            lambda: self._run(member, measured),
            measured,
            metrics=self._subject.metrics,
        )
        designs = self._own_designs(member, measured)
        self._builder.sources.check(member)  # it may have read a file that changed meanwhile
        return replace(outcome, designs=designs)

    def _own_designs(self, member: StudyMember, measured: MemberRecorder) -> str:
        """Return what was designed for a member alone."""
        if measured.plan is None:
            return ""
        computed = without(measured.plan.designs, measured.recorded)
        designs = {**computed, **measured.setting_designs}
        return encode_designs(own_designs(designs, self._builder.common_of(member).given))

    def _run(self, member: StudyMember, measured: MemberRecorder) -> Mapping[str, MetricValue]:
        """Run a member; return its metrics, and its results where they are asked for."""
        self._builder.sources.check(member)
        is_as_before = bool(member.designs)  # which a whole build takes
        if not (member.recording or self._subject.with_results or is_as_before):
            swaps = self._builder.swaps(member)
            scenario = self._builder.scenario(swaps, member.set)
            if self._run_kept(scenario, member, measured):
                return measured.sink.values()
        with ExitStack() as resources:
            experiment = self._builder.experiment(member, resources)
            measured.setting_designs = setting_designs(experiment)
            measured.recorded = experiment.designs or {}
            with_results = self._subject.with_results
            return measure(experiment, measured, with_results=with_results)

    def _run_kept(self, scenario: Scenario, member: StudyMember, measured: MemberRecorder) -> bool:
        """Run a member in a graph that is kept; return False where it does not fit there."""
        kept = self._builder.kept(self._builder.swaps(member))
        if kept is None:
            return False
        with ExitStack() as resources:
            experiment = kept.experiment(scenario, resources)
            if experiment is None:
                return False
            self._builder.sources.note(experiment, member_texts(member))
            run_rows(measured, _in_short_blocks(experiment))
            return True


def _in_short_blocks(experiment: Experiment) -> Experiment:
    """Return an experiment whose rows stay in the cache until they are reduced."""
    if experiment.until is not None:  # how far a run looks ahead for its end is its own affair
        return experiment
    steps = max(1, BLOCK_BYTES // (8 * experiment.graph.layout.row_width))
    return replace(experiment, clock=replace(experiment.clock, block=steps))
