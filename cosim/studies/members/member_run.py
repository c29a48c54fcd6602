"""The run of a member that is built: what it came to, whatever fails in it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from time import perf_counter

from cosim.core.passing_recorders import TwoRecorders
from cosim.core.recording import Recorder
from cosim.errors import ChangedFileError, Interrupted
from cosim.report.summary import summarize
from cosim.report.sweep import results_of
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.recordings.recording import Target, record, run_rows
from cosim.studies.contracts import COMPLETE, FAILED, MemberOutcome, MemberStatus, MetricValue
from cosim.studies.members.measuring import MemberRecorder, reason_of


def outcome_of(
    number: int,
    run: Callable[[], Mapping[str, MetricValue]],
    measured: MemberRecorder,
    *,
    metrics: Iterable[str],
) -> MemberOutcome:
    """Run a member; return its outcome.

    Parameters
    ----------
    number : int
    run : callable
        Returns the metrics of the run, and its results where they are asked for.
    measured : MemberRecorder
        Of the run.
    metrics : iterable of str
        Those that have no value where it fails.

    Raises
    ------
    Interrupted
        If the user interrupts it.
    ChangedFileError
        If a file that it reads is another one than when the study was planned. All else that
        fails is an outcome.
    """
    began = perf_counter()
    try:
        values = run()
    except (Interrupted, ChangedFileError):
        raise
    except Exception as error:  # of a user's code, too: it costs this member, and no other
        status: MemberStatus = FAILED
        reason = reason_of(error)
        values = dict.fromkeys(metrics)
    else:
        status = COMPLETE
        reason = measured.end.reason
    return MemberOutcome(
        number,
        status,
        reason=reason,
        steps=measured.steps,
        metrics=values,
        wall_time=perf_counter() - began,
        warnings=measured.warnings,
    )


def measure(
    experiment: Experiment, measured: MemberRecorder, *, with_results: bool
) -> Mapping[str, MetricValue]:
    """Run an experiment; return its metrics, and its results where they are asked for."""
    if with_results:
        return measure_beside(Target(None), experiment, measured, with_results=True)
    run_rows(measured, experiment)  # verdicts are of a log
    return measured.sink.values()


def measure_beside(
    target: Target, experiment: Experiment, measured: MemberRecorder, *, with_results: bool
) -> Mapping[str, MetricValue]:
    """Return the same, of a run that is kept in memory or in a log, too."""

    def beside(kept: Recorder) -> Recorder:
        return TwoRecorders(kept, measured)

    recording = record(experiment, target, progress=None, beside=beside)
    results = results_of(summarize(recording)) if with_results else {}
    return {**results, **measured.sink.values()}
