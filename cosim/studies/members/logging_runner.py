"""Run members again, with a log of each: the same bits, so the same metrics."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import final

from cosim.scenario.recordings.recording import Target
from cosim.studies.contracts import (
    MemberOutcome,
    MemberRunner,
    MetricValue,
    StudyMember,
    StudySubject,
)
from cosim.studies.dataset.log_files import unfinished_name
from cosim.studies.measuring import MetricRecorder
from cosim.studies.members.measuring import MemberRecorder
from cosim.studies.members.member_builder import MemberBuilder
from cosim.studies.members.member_run import measure_beside, outcome_of
from cosim.studies.metrics import parse_metrics


def open_logging_runner(subject: StudySubject) -> LoggingRunner:
    """Return what runs members with a log; parameters and errors as of ``open_runner``."""
    return LoggingRunner(subject)


@final
class LoggingRunner(MemberRunner):
    """Runs members of a study and writes their logs to a folder.

    A run that fails leaves its log up to there; so does one that crashes, without its last second.
    Who takes the outcome gives the log its name: without one it was left by a study that was
    killed.

    Parameters
    ----------
    subject : StudySubject
    """

    def __init__(self, subject: StudySubject) -> None:
        self._recorder = MetricRecorder(parse_metrics(subject.metrics))
        self._builder = MemberBuilder(subject)
        self._subject = subject
        self._folder = Path(subject.logs)

    def close(self) -> None:
        """Free what its members were built from."""
        self._builder.close()

    def run(self, member: StudyMember) -> MemberOutcome:
        """Run a member with a log; what it came to is as of :class:`SubjectRunner`."""
        measured = MemberRecorder(self._recorder)
        outcome = outcome_of(
            member.number,
            lambda: self._run(member, measured),
            measured,
            metrics=self._subject.metrics,
        )
        self._builder.sources.check(member)  # it may have read a file that changed meanwhile
        return outcome

    def _run(self, member: StudyMember, measured: MemberRecorder) -> Mapping[str, MetricValue]:
        self._builder.sources.check(member)
        target = Target(self._folder / unfinished_name(member.number), force=True)
        with ExitStack() as resources:
            experiment = self._builder.experiment(member, resources)
            with_results = self._subject.with_results
            return measure_beside(target, experiment, measured, with_results=with_results)
