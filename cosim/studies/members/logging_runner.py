"""Run members again, with a log of each: the same bits, so the same metrics."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from types import TracebackType
from typing import Self, final

from cosim.core.passing_recorders import TwoRecorders
from cosim.core.recording import Recorder, Recording
from cosim.errors import ChangedFileError, Interrupted
from cosim.report.summary import summarize
from cosim.report.sweep import results_of
from cosim.scenario.recordings.recording import Target, record
from cosim.studies.contracts import (
    COMPLETE,
    FAILED,
    MemberOutcome,
    MetricValue,
    StudyMember,
    StudySubject,
)
from cosim.studies.dataset.log_files import unfinished_name
from cosim.studies.members.measuring import MemberRecorder, reason_of
from cosim.studies.members.member_builder import MemberBuilder
from cosim.studies.metrics.metrics import parse_metrics
from cosim.studies.metrics.recorder import MetricRecorder


def open_logging_runner(subject: StudySubject) -> LoggingRunner:
    """Return what runs members with a log; parameters and errors as of ``open_runner``."""
    return LoggingRunner(subject)


@final
class LoggingRunner:
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
        self._with_results = subject.with_results
        self._folder = Path(subject.logs)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._builder.close()

    def run(self, member: StudyMember) -> MemberOutcome:
        """Run a member with a log; what it came to is as of :class:`SubjectRunner`."""
        began = perf_counter()
        measured = MemberRecorder(self._recorder)
        outcome = MemberOutcome(member.number, COMPLETE)
        results: Mapping[str, MetricValue] = {}
        try:
            self._builder.sources.check(member)
            with ExitStack() as resources:
                recording = self._record(member, measured, resources)
                if self._with_results:
                    results = results_of(summarize(recording))
            self._builder.sources.check(member)
        except (Interrupted, ChangedFileError):
            raise
        except Exception as error:  # of a user's code, too: it costs this member, and no other
            self._builder.sources.check(member)
            return replace(outcome, status=FAILED, reason=reason_of(error), steps=measured.steps)
        return replace(
            outcome,
            reason=measured.end.reason,
            steps=measured.steps,
            metrics={**results, **self._recorder.values()},
            wall_time=perf_counter() - began,
        )

    def _record(
        self, member: StudyMember, measured: MemberRecorder, resources: ExitStack
    ) -> Recording:
        def beside(log: Recorder) -> Recorder:
            return TwoRecorders(log, measured)

        experiment = self._builder.experiment(member, resources)
        target = Target(self._folder / unfinished_name(member.number), force=True)
        return record(experiment, target, progress=None, beside=beside)
