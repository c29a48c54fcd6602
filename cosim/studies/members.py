"""Run a member of a study: the one way, for workers, clusters, kept logs and verification."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Final, final

from cosim.arrays import Matrix
from cosim.core.contracts import Block
from cosim.core.recorded.signals import DistinctWarnings, warning_texts
from cosim.core.recorders import EndOfRun, Tee, end_of_run, error_text
from cosim.core.recorders import close as close_recorder
from cosim.core.recording import Recorder
from cosim.digests import FileDigests, digest_of
from cosim.errors import ChangedFileError, Interrupted, LogWriteError, UsageError
from cosim.files import file_type
from cosim.fmi.unpacked import UnpackedFmus
from cosim.log.files import part_paths
from cosim.log.foreign.topics import is_foreign
from cosim.log.spans import open_joined
from cosim.report.summary import results_of, summarize
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.kinds.build_record import Resources
from cosim.scenario.recordings.recording import Target, build_experiment, record, run_rows
from cosim.scenario.recordings.replay_request import ReplayRequest
from cosim.scenario.running.replay import replays_of
from cosim.studies.contracts import (
    COMPLETE,
    FAILED,
    MemberOutcome,
    MemberStatus,
    MetricValue,
    StudyMember,
    StudySubject,
)
from cosim.studies.measuring import MetricRecorder
from cosim.studies.metrics import parse_metrics
from cosim.studies.study_file import load_scenario
from cosim.temporary import without_folders

if TYPE_CHECKING:
    from cosim.scenario.recordings.swap_report import SwapReports

CODE: Final = "code of "  # before the name of a class of users
_OPEN_LOGS: Final = 4  # whose rows may be in memory
BLOCK_BYTES: Final = 2**19  # of the rows of a block, which stay in the cache
_SWAPS: Final = 16  # whose comparison is kept
_SHOWN: Final = 12  # characters of a SHA-256


def run_member(
    subject: StudySubject, member: StudyMember, out: Path | None = None
) -> MemberOutcome:
    """Run a member of a study, and return what it came to; what it raises is its outcome.

    Parameters
    ----------
    subject : StudySubject
    member : StudyMember
    out : Path, optional
        Its log, too; one that is there is replaced.

    Raises
    ------
    UsageError
        If no member of the study can be run.
    ChangedFileError
        If a file is not the one that the study began with.
    LogWriteError
        If the log cannot be written, as on a full disk.
    """
    return opened(subject).run(member, out)


@dataclass(frozen=True)
class MemberSources:
    """What a member is made of: SHA-256 of files and modules by path, of code by class.

    ``refused`` says why it cannot be built, or why a metric has no signal; empty: it can.
    """

    refused: str = ""
    files: Mapping[str, str] = field(default_factory=dict)
    modules: Mapping[str, str] = field(default_factory=dict)
    codes: Mapping[str, str] = field(default_factory=dict)


def inspect_member(subject: StudySubject, member: StudyMember) -> MemberSources:
    """Build a member without running it; FMUs are loaded for that, and classes imported."""
    return opened(subject).inspect(member)


@final
class OpenedSubject:
    """What the members of a study are built from in this process, opened once.

    Parameters
    ----------
    subject : StudySubject
    """

    def __init__(self, subject: StudySubject) -> None:
        self.subject = subject
        self._metrics = parse_metrics(subject.metrics)
        self._recorder = MetricRecorder(self._metrics)
        self._digests = FileDigests()
        self._expected = dict(subject.digests)
        try:
            self._scenario = load_scenario(subject.scenario)
        finally:  # also where it cannot be read any more
            self._check([subject.scenario] if subject.scenario in self._expected else [])
        self._fmus = UnpackedFmus(self._digests)
        self._log = lru_cache(_OPEN_LOGS)(open_joined)
        self._compared = lru_cache(_SWAPS)(self._compare)

    def close(self) -> None:
        """Close logs, unload FMUs."""
        self._log.cache_clear()
        self._fmus.close()

    def run(
        self, member: StudyMember, out: Path | None = None, sink: Recorder | None = None
    ) -> MemberOutcome:
        """Run a member; ``sink`` takes its rows instead of what keeps the metrics."""
        measured = _Measured()
        began = perf_counter()
        status: MemberStatus = COMPLETE
        try:
            values = self._run(member, out, measured, self._recorder if sink is None else sink)
            reason = measured.end.reason
            if sink is None:
                values |= self._recorder.values()
        except (Interrupted, ChangedFileError, LogWriteError):
            raise
        except Exception as error:  # of a user's code, too: it costs this member, and no other
            self._check_all(member)  # a file that was changed may be the cause
            status = FAILED
            reason = without_folders(error_text(error), "fmu")
            values = dict.fromkeys(self.subject.metrics)
        return MemberOutcome(
            member.number,
            status,
            reason,
            measured.steps,
            values,
            wall_time=perf_counter() - began,
            worker=f"{platform.node()}:{os.getpid()}",
            warnings=measured.warnings,
        )

    def _run(
        self, member: StudyMember, out: Path | None, measured: _Measured, sink: Recorder
    ) -> dict[str, MetricValue]:
        """Run a member; return its results, where they are wanted."""
        with Resources(self._fmus) as resources:
            experiment = self._experiment(member, resources)
            read = self._read(experiment, member)
            self._check(read)
            results: dict[str, MetricValue] = {}
            if out is None and not self.subject.with_results:  # verdicts are of a log
                run_rows(measured.beside(sink), _in_short_blocks(experiment))
            else:
                recording = record(
                    experiment,
                    Target(out, force=out is not None),
                    progress=None,
                    beside=lambda recorder: measured.beside(recorder, sink),
                )
                if self.subject.with_results:
                    results |= results_of(summarize(recording))
            self._check(read)  # one may have changed meanwhile
        return results

    def inspect(self, member: StudyMember) -> MemberSources:
        """Build a member; return what it is made of."""
        try:
            with Resources(self._fmus) as resources:
                experiment = self._experiment(member, resources)
                self._metrics.check({c.name: c for c in experiment.graph.layout.channels})
                if experiment.plan is None:
                    experiment.graph.prepare(experiment.clock.step_ns, experiment.designs)
                files, modules = (
                    {path: self._digests.of(path) for path in sorted(map(str, paths))}
                    for paths in (experiment.built.files, experiment.built.modules)
                )
                return MemberSources("", files, modules, _codes(experiment))
        except UsageError as error:
            return MemberSources(str(error))

    def _experiment(self, member: StudyMember, resources: ExitStack) -> Experiment:
        subject = self.subject
        swaps = {**subject.swap, **member.swap}
        values = {**subject.set, **member.set}
        if member.recording is None:
            scenario = self._scenario.edit(swap=swaps, map=subject.map, set=values)
            reports = self._compared(tuple(swaps.items())) if scenario.file.swap else None
            return build_experiment(scenario, resources, reports)
        is_own = not is_foreign(Path(member.recording))
        request = ReplayRequest(
            swap=swaps,
            map=subject.map,
            allow_code=subject.allow_code,
            scenario=None if is_own else self._scenario,
        )
        replays = replays_of(self._log(member.recording) if is_own else member.recording, request)
        return replays.experiment(values, resources)

    def _compare(self, swaps: tuple[tuple[str, str], ...]) -> SwapReports | None:
        """Compare swaps without what is varied beside them; None: they are refused without it."""
        from cosim.scenario.recordings.swap_comparison import compare_swaps

        subject = self.subject
        try:
            scenario = self._scenario.edit(swap=dict(swaps), map=subject.map, set=subject.set)
            reports = compare_swaps(scenario, self._fmus)
        except UsageError:
            return None
        return None if reports.refusals else reports

    def _read(self, experiment: Experiment, member: StudyMember) -> list[str]:
        """Return what a member reads; what was not known has to stay as it is now."""
        if not self._expected:
            return []
        for name, digest in _codes(experiment).items():
            if self._expected.setdefault(name, digest) != digest:
                raise ChangedFileError(f"the {name} has changed since this study began")
        read = [*map(str, experiment.built.files | experiment.built.modules), *_parts(member)]
        for path in read:
            if path not in self._expected:
                self._expected[path] = self._digests.of(path)
        return read

    def _check_all(self, member: StudyMember) -> None:
        """Check all files, but for the logs of other members: they are many, and large."""
        own = _parts(member)
        files = [path for path in self._expected if not path.startswith(CODE)]
        self._check(path for path in files if file_type(path) != "log" or path in own)

    def _check(self, paths: Iterable[str]) -> None:
        for path in paths:
            expected = self._expected[path]
            try:
                found = self._digests.of(path)
                problem = f"expected the SHA-256 {expected[:_SHOWN]}..., got {found[:_SHOWN]}..."
            except OSError as error:
                found = ""
                problem = f"it cannot be read ({error.strerror or error})"
            if found != expected:
                raise ChangedFileError(f"{path} has changed since this study began: {problem}")


@final
class _Measured:
    """Knows of a run how far it came, how it ended and what it warned of."""

    def __init__(self) -> None:
        self.steps = 0
        self.end = EndOfRun()
        self._warnings = DistinctWarnings()

    def beside(self, *recorders: Recorder) -> Recorder:
        """Return what passes the run on to recorders."""
        return Tee(*recorders, said=self._warnings.add, reached=self._reach, ended=self._finish)

    def _reach(self, block: Block, signals: Matrix) -> None:
        self.steps = block.index + block.steps

    def _finish(self, recorder: Recorder, error: BaseException | None) -> None:
        self.end = end_of_run(error)
        close_recorder(recorder, error)

    @property
    def warnings(self) -> list[str]:
        return sorted(without_folders(text, "fmu") for text in warning_texts(self._warnings))


_opened: OpenedSubject | None = None


def opened(subject: StudySubject) -> OpenedSubject:
    """Return a subject as it is opened in this process, which keeps the last one."""
    global _opened
    if _opened is None or (_opened.subject is not subject and _opened.subject != subject):
        close()
        _opened = OpenedSubject(subject)
    return _opened


def close() -> None:
    """Close the subject that this process has open."""
    global _opened
    if _opened is not None:
        _opened.close()
    _opened = None


def _parts(member: StudyMember) -> list[str]:
    """Return the files of the log that a member replays."""
    path = member.recording
    return [] if path is None else [str(part) for part in part_paths(Path(path))]


def _codes(experiment: Experiment) -> dict[str, str]:
    """Return the SHA-256 of the classes of users, by name."""
    tables = [table["code"] for table in experiment.built.metadata.values() if "code" in table]
    return {f"{CODE}{code['class']}": digest_of(code) for code in tables}


def _in_short_blocks(experiment: Experiment) -> Experiment:
    if experiment.until is not None:  # how far a run looks ahead for its end is its own affair
        return experiment
    steps = max(1, BLOCK_BYTES // (8 * experiment.graph.layout.row_width))
    return replace(experiment, clock=replace(experiment.clock, block=steps))
