"""The certificate of a run: the error of its communication step, signal by signal.

The scenario runs with the steps h, h/2 and h/4, and :mod:`cosim.theory.richardson` compares the
three at the communication points of h. What is given in seconds stays: start, stop, periods,
delays. So does what the step h has decided: where an identifier starts, the window that an observer
chose. Noise must not change either, so a source of it needs a period of its own.

What jumps elsewhere than at a communication point has an error that is no power of the step, though
it may look like one: a jump in the first quarter of a step shows the differences of first order,
and an error up to twice the true one. So the run at h/4 is watched for jumps, and what follows one
gets no estimate. One in the last quarter looks like one at the end of the step, where it does no
harm. It counts all the same, unless it is known to be there, by a period or an instant in a table,
or is one of several of about one size that are all there. What bends between communication points
errs by terms of the order of its smooth part, of which an estimate may be a third too large.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, Final, final

import numpy as np

from cosim.arrays import Mask, Matrix
from cosim.core.clock import nanoseconds
from cosim.core.contracts import Block
from cosim.core.graph import Graph
from cosim.core.passing_recorders import Watched
from cosim.core.port import Port
from cosim.core.recorders import Nothing, close, end_of_run, error_text
from cosim.core.recording import Recorder
from cosim.core.signals import Layout
from cosim.documents import plain
from cosim.errors import CosimError, FmuError, Interrupted, RunError, UsageError, option
from cosim.instants import NANOSECONDS, StepNs, step_part, step_seconds, step_value
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.document.document import short
from cosim.scenario.document.schema import ActionTable
from cosim.scenario.kinds.capabilities import DecidedByStep
from cosim.scenario.record import CERTIFICATE, RecordedCertificate, StepSearch
from cosim.scenario.recordings.preparing import build_experiment
from cosim.scenario.recordings.recording import Progress, run_into
from cosim.scenario.running.thinned_rows import QUARTERS, JumpWatch, ThinnedRows
from cosim.theory.documents import StepError
from cosim.theory.richardson import step_error

MOST_VALUES: Final = 2**24  # that are kept of a run: 128 MB
FINER: Final = (2, QUARTERS)  # steps of the other runs in one of this
SIGNIFICANT_JUMP: Final = 1e-6  # of the range of a signal


@dataclass(frozen=True, slots=True)
class Subject:
    """What is known of a run before it is certified.

    Parameters
    ----------
    step_ns : int
        Communication step [ns].
    steps : int
        Of the whole run.
    layout : Layout
    labels : tuple of str
        By column.
    may_jump : Mask, shape (width,)
        Columns that jump with something discrete, as far as that is known.
    followers : mapping of component name to frozenset of str
        The components that follow it, itself among them where it has inputs.
    solvers : tuple of str
        The components that have solvers of their own: FMUs.
    changes : mapping of dotted key to value
        What keeps in the other runs what this step has decided.
    conditional : mapping of component name to ActionTable
        Components that actions on conditions are about.
    known_ns : frozenset of int
        The instants of all other actions [ns].
    uneven : mapping of component name to float
        A time [s] of its table that leaves another part of a step over in each of the runs.
    """

    step_ns: StepNs
    steps: int
    layout: Layout
    labels: tuple[str, ...]
    may_jump: Mask
    followers: Mapping[str, frozenset[str]]
    solvers: tuple[str, ...]
    changes: Mapping[str, Any]
    conditional: Mapping[str, ActionTable]
    known_ns: frozenset[int]
    uneven: Mapping[str, float]

    @property
    def every(self) -> int:
        """Communication steps between two rows that are compared: memory is bounded."""
        return max(1, math.ceil((self.steps + 1) * self.layout.width / MOST_VALUES))

    def own_rows(self) -> ThinnedRows:
        """Return what keeps the rows of the run."""
        return ThinnedRows(self.every, self.steps)

    def certificate(self, runs: Sequence[ThinnedRows], problem: str) -> RecordedCertificate:
        """Return what a certificate says of the runs, and of no signal yet.

        Parameters
        ----------
        runs : sequence of ThinnedRows
            The run itself, and those behind it, if there are any.
        problem : str
            Why nothing is compared; empty where something is.
        """
        step = step_seconds(self.step_ns)
        return RecordedCertificate(
            step,
            tuple(step / finer for finer in FINER),
            tuple(run.end_ns / NANOSECONDS for run in runs),
            problem,
            tuple(self.solvers),
            every=self.every,
        )


@dataclass(frozen=True, slots=True)
class FinerRun:
    """A run with a smaller step, and why it ended early; empty where it did not."""

    rows: ThinnedRows
    jumps: JumpWatch
    problem: str


def subject_of(scenario: Scenario) -> Subject:
    """Build a scenario, and return what its certificate needs.

    Raises
    ------
    UsageError
        If a smaller step would be another run: with other noise, or off the nanoseconds.
    """
    with ExitStack() as resources:
        experiment = build_experiment(scenario, resources, None)
        return _subject(experiment)


def _subject(experiment: Experiment) -> Subject:
    scenario = experiment.scenario
    graph = experiment.graph
    step_ns = experiment.clock.step_ns
    if isinstance(step_ns, int) and step_ns % QUARTERS:
        raise UsageError(
            f"step error: a quarter of the step {step_ns / NANOSECONDS} s is not a whole number "
            "of nanoseconds; choose a step of which it is"
        )
    _check_noise(scenario, step_ns)
    _check_substeps(graph)
    changes: dict[str, Any] = {}
    for name, spec in scenario.specs.items():
        table = scenario.tree["components"][name]
        metadata = experiment.metadata.get(name, {})
        if isinstance(spec, DecidedByStep):
            decided = spec.decided(table, metadata, step_ns)
            if decided != table:
                changes[f"components.{name}"] = decided
    return Subject(
        step_ns,
        experiment.clock.steps,
        graph.layout,
        tuple(graph.labels()),
        _may_jump(scenario, graph),
        _followers(graph),
        tuple(experiment.fmus),
        changes,
        _conditional(scenario),
        frozenset(nanoseconds(a.at) for a in scenario.actions.values() if a.at is not None),
        _uneven(scenario, step_ns),
    )


def _check_noise(scenario: Scenario, step_ns: StepNs) -> None:
    """Check that no random number belongs to a communication step.

    Raises
    ------
    UsageError
        If one does; names the components.
    """
    for action in scenario.actions.values():
        is_random = action.noise is not None or type(action.drop) in (int, float)
        if is_random:
            raise UsageError(
                f"step error: the action {_when(action)} draws random numbers at every "
                "communication step, so that a run with a smaller step has other noise; use a "
                "scenario without it, or a sensor with noise and a period"
            )
    names = [name for name, spec in scenario.specs.items() if spec.step_dependence.draws]
    if not names:
        return
    keys = [short(f"components.{name}.period") for name in names]
    settings = [option("set", key, f"{step_seconds(step_ns)}") for key in keys]
    each = "draw" if len(names) > 1 else "draws"
    raise UsageError(
        f"step error: {', '.join(names)} {each} random numbers at every communication step, so "
        "that a run with a smaller step has other noise; set a period, such as "
        f"{' '.join(settings)}"
    )


def _check_substeps(graph: Graph) -> None:
    """Check that no loop chooses its steps.

    Raises
    ------
    UsageError
        If one does: the error of its steps is that of the tolerance, whatever their length is.
    """
    if graph.substep_controls:
        raise UsageError(
            "step error: loops choose their steps by scenario.substeps, so that a smaller "
            "communication step does not show their error; use a scenario without substeps, or "
            f"compare with a run with a smaller {option('set', 'scenario.substeps.rtol')}"
        )


def _when(action: ActionTable) -> str:
    return f"at {action.at} s" if action.when is None else f"when {action.when!r}"


def _conditional(scenario: Scenario) -> dict[str, ActionTable]:
    """Return the components that actions on conditions are about, and these actions."""
    conditional: dict[str, ActionTable] = {}
    for action in scenario.actions.values():
        if action.when is None:
            continue
        names = [Port.parse(signal).component for signal in action.signals]
        names += [key.partition(".")[0] for key in action.set or {}]
        names += action.swap or {}
        for name in names:
            conditional.setdefault(name, action)
    return conditional


def _uneven(scenario: Scenario, step_ns: StepNs) -> dict[str, float]:
    """Return a time [s] of each component that leaves another part of a step over in each run.

    Straight lines err by r (1 - r) h^2 y''/2 there, with r the part of a step h: a power of h where
    r (1 - r) is the same in all runs, as 0 is where h divides the time.
    """
    times: dict[str, float] = {}
    for name, spec in scenario.specs.items():
        for time in spec.step_dependence.times:
            factors = set()
            for finer in (1, *FINER):
                part_ns = nanoseconds(time) * finer % step_ns  # of a step of step_ns
                factors.add(part_ns * (step_ns - part_ns))
            if len(factors) > 1:
                times[name] = time
    return times


def _may_jump(scenario: Scenario, graph: Graph) -> Mask:
    """Return the columns that are known to jump, with something that does so at points alone."""
    mask = np.zeros(graph.layout.width, np.bool_)
    for channel in graph.layout.channels:
        for signal in channel.interface.outputs:
            origins = graph.jumps(Port(channel.name, signal.name))
            kinds = [scenario.specs[origin.component] for origin in origins]
            is_known = bool(kinds) and all(kind.step_dependence.jumps_at_points for kind in kinds)
            mask[channel.signal_columns[signal.name]] = is_known
    return mask


def _followers(graph: Graph) -> dict[str, frozenset[str]]:
    """Return for every component those that follow it; itself where it has inputs."""
    driven: dict[str, set[str]] = {name: set() for name in graph.components}
    for to, connection in graph.connections.items():
        for source in connection.sources:
            driven[source.component].add(to.component)
    followers = {}
    for name in graph.components:
        reached = set(driven[name])
        waiting = list(reached)
        while waiting:
            more = driven[waiting.pop()] - reached
            reached |= more
            waiting += more
        if graph.layout[name].interface.n_u:
            reached.add(name)
        followers[name] = frozenset(reached)
    return followers


# --- the runs ---


def finer_run(
    scenario: Scenario, subject: Subject, finer: int, progress: Progress | None
) -> FinerRun:
    """Run a scenario with a step that is smaller by a whole factor; keep its rows.

    Raises
    ------
    UsageError
        If the scenario cannot be built with that step.
    Interrupted
        If the user ends it.
    """
    step = step_value(step_part(subject.step_ns, finer))
    jumps = JumpWatch(subject.layout.width)
    rows = ThinnedRows(subject.every * finer, subject.steps * finer)

    def take(block: Block, signals: Matrix) -> None:
        jumps.take(block, signals)
        rows.take(block, signals)

    watched = Watched(Nothing(), take, jumped=jumps.expect)
    problem = ""
    with ExitStack() as resources:
        experiment = _finer_experiment(scenario, subject, finer, resources)
        experiment = replace(experiment, identified={})
        try:
            run_into(watched, experiment, progress=progress, profile=None)
        except Interrupted:
            raise
        except FmuError as error:  # which does not take this step
            problem = f"no run with steps of {step} s: {error}"
        except RunError as error:
            problem = f"the run with steps of {step} s ended early: {error}"
    return FinerRun(rows, jumps, problem)


def _finer_experiment(
    scenario: Scenario, subject: Subject, finer: int, resources: ExitStack
) -> Experiment:
    step = step_value(step_part(subject.step_ns, finer))
    try:
        changed = scenario.edit(set={**subject.changes, "scenario.step": step})
        return build_experiment(changed, resources, None)
    except CosimError as error:
        raise UsageError(
            f"step error: the scenario must also run with {step} s, and cannot:\n{error}"
        ) from error


class Certifier:
    """Certifies a run by others with smaller steps.

    Parameters
    ----------
    subject : Subject
    half, quarter : FinerRun
        With half of its step, and a quarter.
    search : mapping, optional
        How its step was found.
    """

    def __init__(
        self,
        subject: Subject,
        half: FinerRun,
        quarter: FinerRun,
        search: StepSearch | None = None,
    ) -> None:
        self._subject = subject
        self._half = half
        self._quarter = quarter
        self._search = search

    def with_search(self, search: StepSearch) -> Certifier:
        """Return the same that tells how its step was found."""
        return Certifier(self._subject, self._half, self._quarter, search)

    @property
    def problem(self) -> str:
        """Why a run with a smaller step ended early; empty where none did."""
        return self._half.problem or self._quarter.problem

    def rows(self) -> ThinnedRows:
        """Return what keeps the rows of the run."""
        return self._subject.own_rows()

    def certification(self) -> Certification:
        """Return the certificate that it gives a run."""
        return Certification(self._subject, lambda: self)

    def certificate(self, own: ThinnedRows) -> RecordedCertificate:
        """Return the certificate; ``own`` are the rows of the run."""
        of_runs = self._subject.certificate(self._runs(own), self.problem)
        signals = {} if self.problem else self.errors(own)
        return replace(of_runs, signals=signals, search=self._search)

    def errors(self, own: ThinnedRows) -> dict[str, StepError]:
        """Return the error of every element of every signal, by its label.

        Where a condition ends the runs, which it may do at different instants, they are compared up
        to the first of these.
        """
        runs = self._runs(own)
        times = [run.time_ns for run in runs]
        count = min(map(len, times))
        tables: list[Matrix] = [run.rows[:count] for run in runs]
        t = times[0][:count] / NANOSECONDS
        reasons = self._reasons()
        errors = {}
        for channel in self._subject.layout.channels:
            for column in range(channel.columns.start, channel.columns.stop):
                if channel.name in reasons:
                    error = StepError(reason=reasons[channel.name])
                else:
                    coarse, half, quarter = (table[:, column] for table in tables)
                    error = step_error(t, coarse, half, quarter)
                errors[self._subject.labels[column]] = error
        return errors

    @property
    def of_conditions(self) -> frozenset[str]:
        """The components that have no estimate with any step, as they follow a condition."""
        names: set[str] = set()
        for origin, _ in self._of_actions():
            names.update(self._subject.followers.get(origin, ()))
        return frozenset(names)

    def _runs(self, own: ThinnedRows) -> list[ThinnedRows]:
        return [own, self._half.rows, self._quarter.rows]

    def _reasons(self) -> dict[str, str]:
        """Return why components have no estimate, by their names: what they follow has none."""
        reasons: dict[str, str] = {}
        for origin, text in (*self._of_actions(), *self._of_parts(), *self._of_jumps()):
            for name in self._subject.followers.get(origin, ()):
                reasons.setdefault(name, text)
        return reasons

    def _of_actions(self) -> Iterator[tuple[str, str]]:
        """Yield components that actions on conditions are about, and why they have no estimate."""
        subject = self._subject
        are_performed = not self._quarter.jumps.expected_ns <= subject.known_ns
        for component, action in subject.conditional.items():
            if are_performed:
                text = (
                    f"the action {_when(action)} takes effect at a point that depends on the step"
                )
                yield component, text

    def _of_parts(self) -> Iterator[tuple[str, str]]:
        """Yield components with times that leave parts of a step over, and what they are."""
        for component, time in self._subject.uneven.items():
            yield (
                component,
                f"{time:g} s of {component} is not a whole number of steps, and leaves a "
                "different fraction of a step in each of the runs",
            )

    def _of_jumps(self) -> Iterator[tuple[str, str]]:
        """Yield components with outputs that jump elsewhere than they may, and where they do."""
        subject = self._subject
        jumps = self._quarter.jumps
        needed = SIGNIFICANT_JUMP * jumps.ranges
        within = jumps.within > needed
        at_ends = (jumps.at_ends > needed) & ~(subject.may_jump | jumps.are_regular)
        for channel in subject.layout.channels:
            for column in range(channel.outputs.start, channel.outputs.stop):
                if not (within[column] or at_ends[column]):
                    continue
                instant = jumps.within_ns if within[column] else jumps.at_ends_ns
                where = "between communication points"
                if not within[column]:
                    where = "at an unknown instant"
                yield (
                    channel.name,
                    f"{subject.labels[column]} jumps {where}, or is not resolved by a quarter "
                    f"of the step, at t = {instant[column] / NANOSECONDS:g} s",
                )


def certifier_of(scenario: Scenario, progress: Progress | None) -> Certifier:
    """Run a scenario with half its step, and with a quarter; return what certifies its run.

    Raises
    ------
    UsageError
        If a smaller step would be another run, or the scenario cannot run with one.
    """
    return _certifier(scenario, subject_of(scenario), progress)


def _certifier(scenario: Scenario, subject: Subject, progress: Progress | None) -> Certifier:
    half, quarter = (finer_run(scenario, subject, finer, progress) for finer in FINER)
    return Certifier(subject, half, quarter)


def certification_of(scenario: Scenario, progress: Progress | None) -> Certification:
    """Return what certifies a run of a scenario, by others that follow it.

    Raises
    ------
    UsageError
        If a smaller step would be another run, or the scenario cannot run with one.
    """
    subject = subject_of(scenario)
    for finer in FINER:
        with ExitStack() as resources:
            _finer_experiment(scenario, subject, finer, resources)
    return Certification(subject, lambda: _certifier(scenario, subject, progress))


@final
class Certification:
    """The certificate of a run: computed behind it, and recorded before its recording ends.

    Parameters
    ----------
    subject : Subject
    certifier : callable
        Returns what certifies the run, and makes the runs that it needs.
    """

    def __init__(self, subject: Subject, certifier: Callable[[], Certifier]) -> None:
        self._subject = subject
        self._certifier = certifier
        self._rows = subject.own_rows()
        self._recorder: Recorder | None = None
        self._error: BaseException | None = None  # with which a complete run ended

    def beside(self, recorder: Recorder) -> Recorder:
        """Return a recorder that keeps what is compared, and leaves another one open behind.

        A run that ends early has no certificate, and its recording ends with it.
        """
        self._recorder = recorder
        return Watched(recorder, self._rows.take, ended=self._end)

    def _end(self, recorder: Recorder, error: BaseException | None) -> None:
        """Leave the recorder of a complete run open; record why another has none."""
        ended = end_of_run(error)
        if ended.status == "complete":
            self._error = error
            return
        try:
            self._record_problem(recorder, f"the run ended early: {ended.reason}")
        finally:
            close(recorder, error)

    def _record_problem(self, recorder: Recorder, problem: str) -> None:
        """Record why there is no certificate."""
        certificate = self._subject.certificate([self._rows], problem)
        recorder.result({CERTIFICATE: plain(certificate)})

    def complete(self, resources: ExitStack) -> None:
        """Compute the certificate, record it, and end the recording.

        Parameters
        ----------
        resources : ExitStack
            Of the run, closed before: there are FMUs of which a process has one instance only.

        Raises
        ------
        CosimError
            If the runs behind do not come to their end; the recording is whole, and says so.
        """
        recorder = self._recorder
        assert recorder is not None, "beside a recorder"
        try:
            resources.close()
            certificate = self._certifier().certificate(self._rows)
            recorder.result({CERTIFICATE: plain(certificate)})
        except BaseException as error:
            reason = error_text(error) or "interrupted by the user"
            problem = f"a run with a smaller step did not complete: {reason}"
            self._record_problem(recorder, problem)
            error.add_note("no error estimate: a run with a smaller step did not complete")
            raise
        finally:
            close(recorder, self._error)
