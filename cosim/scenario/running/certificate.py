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
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain
from typing import Any, Final, final

import numpy as np

from cosim.arrays import Mask, Matrix, Nanoseconds, Vector
from cosim.core.clock import nanoseconds
from cosim.core.contracts import Block
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.core.recorders import Nothing, Watched, close, end_of_run, error_text
from cosim.core.recording import Recorder, SignalEvent
from cosim.core.structure.cycles import reached_from
from cosim.documents import plain
from cosim.errors import CosimError, FmuError, Interrupted, RunError, UsageError, option
from cosim.instants import NANOSECONDS, step_part, step_seconds, step_value
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.document.document import short
from cosim.scenario.document.schema import ActionTable
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.kinds.capabilities import DecidedByStep
from cosim.scenario.record import CERTIFICATE, RecordedCertificate, StepSearch
from cosim.scenario.recordings.recording import Progress, build_experiment, run_into
from cosim.theory.documents import StepError
from cosim.theory.richardson import step_error

JUMP: Final = 4.0  # times as much as the steps before and after it: what changes at once
SIGNIFICANT_JUMP: Final = 1e-6  # of the range of a signal
SEVERAL: Final = 8  # jumps in the last quarter of a step by chance: one in 65536
ABOUT: Final = 0.1  # of the largest one
QUARTERS: Final = 4  # steps of the finest run in one of the run that is certified
MOST_VALUES: Final = 2**24  # that are kept of a run: 128 MB
FINER: Final = (2, QUARTERS)  # steps of the other runs in one of this


@final
class Certification:
    """The certificate of a run, by others with half of its step, and a quarter.

    Of a run that is recorded it is computed behind it, and recorded before its recording ends.

    Parameters
    ----------
    scenario : Scenario
    progress : callable or None

    Attributes
    ----------
    scenario : Scenario
    search : StepSearch or None
        How its step was found; None: the scenario gives it.
    problem : str
        Why one of the runs ended early; empty where none did.

    Raises
    ------
    UsageError
        If a smaller step would be another run: with other noise, or off the nanoseconds.
    """

    def __init__(self, scenario: Scenario, progress: Progress | None) -> None:
        self.scenario = scenario
        self.search: StepSearch | None = None
        self.problem = ""
        self._progress = progress
        self._recorder: Recorder | None = None
        self._error: BaseException | None = None  # with which a complete run ended
        with ExitStack() as resources:
            experiment = build_experiment(scenario, resources)
            _check(experiment)
            graph = experiment.graph
            self._clock = experiment.clock
            self._labels = graph.labels()
            self._fmus = tuple(experiment.built.fmus)
            self._decided = _decided(experiment)
            self._outputs = _outputs(scenario, graph)
            self._driven = _driven(graph)
        self._every = max(1, math.ceil((self._clock.steps + 1) * len(self._labels) / MOST_VALUES))
        self._runs: dict[int, ThinnedRows] = {}  # by their steps in one of the scenario
        self._jumps = JumpWatch(*self._outputs)  # of the run with the smallest step

    # --- the runs ---

    def check(self) -> None:
        """Check that the scenario can be built with the smaller steps.

        Raises
        ------
        UsageError
            If it cannot.
        """
        for finer in FINER:
            with ExitStack() as resources:
                self._built(finer, resources)

    def run(self, *parts: int) -> None:
        """Run the scenario with these parts of its step, unless it was, and keep the rows.

        Raises
        ------
        UsageError
            If the scenario cannot be built with one of them.
        Interrupted
            If the user ends it.
        """
        for finer in parts:
            if finer not in self._runs:
                self._runs[finer] = self._run(finer)

    def _rows(self, finer: int) -> ThinnedRows:
        return ThinnedRows(self._every * finer, self._clock.steps * finer)

    def _run(self, finer: int) -> ThinnedRows:
        rows = self._rows(finer)
        self._jumps = JumpWatch(*self._outputs)

        def take(block: Block, signals: Matrix) -> None:
            self._jumps.take(block, signals)
            rows.take(block, signals)

        watched = Watched(Nothing(), take, jumped=self._jumps.expect)
        with ExitStack() as resources:
            experiment = replace(self._built(finer, resources), identified={})
            try:
                run_into(watched, experiment, progress=self._progress, profile=None)
            except Interrupted:
                raise
            except (RunError, FmuError) as error:  # of an FMU that does not take this step
                text = f"no complete run with steps of {self._step(finer)} s: {error}"
                self.problem = self.problem or text
        return rows

    def _built(self, finer: int, resources: ExitStack) -> Experiment:
        step = self._step(finer)
        try:
            changes = {} if finer == 1 else {**self._decided, "scenario.step": step}
            return build_experiment(self.scenario.edit(set=changes), resources)
        except CosimError as error:
            raise UsageError(
                f"step error: the scenario must also run with {step} s, and cannot:\n{error}"
            ) from error

    def _step(self, finer: int) -> float | str:
        return step_value(step_part(self._clock.step_ns, finer))

    # --- what they show ---

    def errors(self) -> dict[str, StepError]:
        """Return the error of every element of every signal, by its label.

        Where a condition ends the runs, which it may do at different instants, they are compared up
        to the first of these.
        """
        runs = [self._runs[finer] for finer in (1, *FINER)]
        count = min(len(run.time_ns) for run in runs)
        tables = [run.rows[:count] for run in runs]
        t = runs[0].time_ns[:count] / NANOSECONDS
        reasons = self._following(self._conditions(), self._parts(), self._unexpected())
        errors = {}
        for column, label in enumerate(self._labels):
            reason = reasons.get(label.partition(".")[0])
            if reason is not None:
                errors[label] = StepError(reason=reason)
            else:
                coarse, half, quarter = (table[:, column] for table in tables)
                errors[label] = step_error(t, coarse, half, quarter)
        return errors

    @property
    def of_conditions(self) -> set[str]:
        """The components that have no estimate with any step, as they follow a condition."""
        return set(self._following(self._conditions()))

    def _following(self, *causes: Mapping[str, str]) -> dict[str, str]:
        """Return why components have no estimate, by their names: what they follow has none."""
        reasons: dict[str, str] = {}
        for origin, text in chain.from_iterable(own.items() for own in causes):
            for name in reached_from(self._driven.get(origin, ()), self._driven):
                reasons.setdefault(name, text)
        return reasons

    def _conditions(self) -> dict[str, str]:
        """Return the components that actions on conditions are about, if one was performed."""
        actions = self.scenario.actions.values()
        timed = {nanoseconds(action.at) for action in actions if action.at is not None}
        texts: dict[str, str] = {}
        for action in actions:
            if action.when is None or self._jumps.expected_ns <= timed:
                continue
            text = f"the action {_when(action)} takes effect at a point that depends on the step"
            names = [Port.parse(signal).component for signal in action.signals]
            names += [key.partition(".")[0] for key in action.set or {}]
            for name in [*names, *(action.swap or {})]:
                texts.setdefault(name, text)
        return texts

    def _parts(self) -> dict[str, str]:
        """Return the components with times that leave another part of a step over in each run.

        Straight lines err by r (1 - r) h^2 y''/2 there, with r the part of a step h: a power of h
        where r (1 - r) is the same in all runs, as 0 is where h divides the time.
        """
        texts = {}
        step_ns = self._clock.step_ns
        for name, spec in self.scenario.specs.items():
            for time in spec.step_dependence.times:
                parts_ns = [nanoseconds(time) * finer % step_ns for finer in (1, *FINER)]
                if len({part_ns * (step_ns - part_ns) for part_ns in parts_ns}) > 1:
                    texts[name] = (
                        f"{time:g} s of {name} is not a whole number of steps, and leaves a "
                        "different fraction of a step in each of the runs"
                    )
        return texts

    def _unexpected(self) -> dict[str, str]:
        """Return the components with outputs that jump elsewhere than they may, and where."""
        texts: dict[str, str] = {}
        for column, (time_ns, is_within) in self._jumps.unexpected().items():
            label = self._labels[column]
            where = "between communication points" if is_within else "at an unknown instant"
            text = (
                f"{label} jumps {where}, or is not resolved by a quarter of the step, at "
                f"t = {time_ns / NANOSECONDS:g} s"
            )
            texts.setdefault(label.partition(".")[0], text)
        return texts

    # --- the recording ---

    def beside(self, recorder: Recorder) -> Recorder:
        """Return a recorder that keeps what is compared, and leaves another one open behind.

        A run that ends early has no certificate, and its recording ends with it.
        """
        self._recorder = recorder
        self._runs[1] = self._rows(1)
        return Watched(recorder, self._runs[1].take, ended=self._end)

    def _end(self, recorder: Recorder, error: BaseException | None) -> None:
        """Leave the recorder of a complete run open; record why another has none."""
        ended = end_of_run(error)
        if ended.status == "complete":
            self._error = error
            return
        try:
            self._record(recorder, (1,), f"the run ended early: {ended.reason}")
        finally:
            close(recorder, error)

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
            self.run(*FINER)
            signals = {} if self.problem else self.errors()
            self._record(recorder, (1, *FINER), self.problem, signals)
        except BaseException as error:
            reason = error_text(error) or "interrupted by the user"
            problem = f"a run with a smaller step did not complete: {reason}"
            self._record(recorder, (1,), problem)
            error.add_note("no error estimate: a run with a smaller step did not complete")
            raise
        finally:
            close(recorder, self._error)

    def _record(
        self,
        recorder: Recorder,
        parts: Sequence[int],
        problem: str,
        signals: Mapping[str, StepError] | None = None,
    ) -> None:
        """Record what is known of runs, or why nothing is."""
        step = step_seconds(self._clock.step_ns)
        certificate = RecordedCertificate(
            step,
            tuple(step / finer for finer in FINER),
            tuple(self._runs[finer].end_ns / NANOSECONDS for finer in parts),
            problem,
            self._fmus,
            signals or {},
            self.search,
            every=self._every,
        )
        recorder.result({CERTIFICATE: plain(certificate)})


# --- what is kept of a run ---


class ThinnedRows:
    """Keeps every n-th row of a run, and the last one that its clock has.

    Parameters
    ----------
    every : int
        Communication steps between two rows that are kept.
    steps : int
        Communication steps of the run.

    Attributes
    ----------
    end_ns : int
        The last instant of the run [ns], kept or not.
    """

    def __init__(self, every: int, steps: int) -> None:
        self._every = every
        self._steps = steps
        self._rows: list[Matrix] = []
        self._times: list[Nanoseconds] = []
        self.end_ns = 0

    def take(self, block: Block, signals: Matrix) -> None:
        """Keep the rows that are due."""
        self.end_ns = int(block.time_ns[-1])
        first = 0 if block.index == 0 and not self._rows else 1
        rows = np.arange(first, block.steps + 1)
        numbers = block.index + rows
        due = rows[(numbers % self._every == 0) | (numbers == self._steps)]
        self._rows.append(signals[due])
        self._times.append(block.time_ns[due])

    @property
    def rows(self) -> Matrix:
        """The rows that were kept, shape (N, width)."""
        return np.concatenate(self._rows)

    @property
    def time_ns(self) -> Nanoseconds:
        """Their instants [ns], shape (N,)."""
        return np.concatenate(self._times)


class JumpWatch:
    """Finds what changes within one step of a run as it does in none beside it.

    A signal whose steps are small enough changes in each about as much as in those before and after
    it. Where it changes more than ``JUMP`` times as much as in any of the ``QUARTERS`` steps before
    and after, it jumps, or the step does not resolve what happens. So many, as a change of noise,
    which comes with every step of the run that is certified, may be small once.

    Parameters
    ----------
    watched : Mask, shape (width,)
        Columns of a row.
    may_jump : Mask, shape (width,)
        Which of them may jump at ends of steps of the run that is certified.

    Attributes
    ----------
    expected_ns : set of int
        Instants [ns] at which signals jump by actions. The row there has the values before, so that
        the jump is in the step that follows; at a communication point of the run that is certified
        it is none that such a run could miss.
    """

    def __init__(self, watched: Mask, may_jump: Mask) -> None:
        self.expected_ns: set[int] = set()
        self._columns = np.flatnonzero(watched)
        self._may_jump = may_jump[watched]
        width = len(self._columns)
        # The largest jumps, and when: within a step of the run that is certified, and in the last
        # quarter of one, as a jump at its end is; of the latter several, the smallest first.
        self._within = np.zeros(width)
        self._within_ns = np.zeros(width, np.int64)
        self._at_ends = np.zeros((SEVERAL, width))
        self._at_ends_ns = np.zeros(width, np.int64)
        self._smallest = np.full(width, np.inf)
        self._largest = np.full(width, -np.inf)
        # of the steps before the next block
        self._changes = np.zeros((2 * QUARTERS, width))
        self._times = np.zeros(2 * QUARTERS, np.int64)
        self._numbers = np.ones(2 * QUARTERS, np.int64)

    def unexpected(self) -> dict[int, tuple[int, bool]]:
        """Return by column when it jumps elsewhere than it may [ns], and whether within a step.

        Of several jumps at ends of about one size all are there: were their instants any, a part of
        them would be within.
        """
        with np.errstate(over="ignore"):
            significant = SIGNIFICANT_JUMP * np.maximum(self._largest - self._smallest, 0.0)
        are_regular = self._at_ends[0] > ABOUT * self._at_ends[-1]
        within = self._within > significant
        at_ends = (self._at_ends[-1] > significant) & ~(self._may_jump | are_regular)
        times_ns = np.where(within, self._within_ns, self._at_ends_ns)
        found = np.flatnonzero(within | at_ends)
        return {int(self._columns[i]): (int(times_ns[i]), bool(within[i])) for i in found}

    def expect(self, event: SignalEvent) -> None:
        """Note the instant of an event: signals jump there as they should, behind the row."""
        if event.cause != "jump":
            self.expected_ns.add(event.time_ns)

    def take(self, block: Block, signals: Matrix) -> None:
        """Look at the next rows."""
        signals = signals[:, self._columns]
        self._smallest = np.fmin(self._smallest, np.fmin.reduce(signals))
        self._largest = np.fmax(self._largest, np.fmax.reduce(signals))
        with np.errstate(over="ignore", invalid="ignore"):  # of a run that leaves all bounds
            changes = np.nan_to_num(np.abs(np.diff(signals, axis=0)))
        changes = np.vstack([self._changes, changes])
        times = np.concatenate([self._times, block.time_ns[1:]])
        numbers = np.concatenate([self._numbers, block.index + np.arange(1, block.steps + 1)])
        self._changes = changes[-2 * QUARTERS :]
        self._times = times[-2 * QUARTERS :]
        self._numbers = numbers[-2 * QUARTERS :]
        inner = slice(QUARTERS, -QUARTERS)
        jumps = _isolated(changes)
        if self.expected_ns:
            starts = times[QUARTERS - 1 : -QUARTERS - 1]
            is_expected = np.isin(starts, list(self.expected_ns))
            jumps[is_expected & (numbers[inner] % QUARTERS == 1)] = 0.0
        is_end = numbers[inner] % QUARTERS == 0
        _keep(jumps[~is_end], times[inner][~is_end], self._within, self._within_ns)
        _keep(jumps[is_end], times[inner][is_end], self._at_ends[-1].copy(), self._at_ends_ns)
        self._at_ends = np.sort(np.vstack([self._at_ends, jumps[is_end]]), axis=0)[-SEVERAL:]


def _isolated(changes: Matrix) -> Matrix:
    """Return those changes that are larger than all around them, 0 for the others.

    Of the first and the last, around which not all are known, there is nothing.
    """
    inner = changes[QUARTERS:-QUARTERS]
    largest = np.zeros_like(inner)
    for shift in range(2 * QUARTERS + 1):
        if shift != QUARTERS:
            np.maximum(largest, changes[shift : shift + len(inner)], out=largest)
    isolated: Matrix = np.where(inner / JUMP > largest, inner, 0.0)
    return isolated


def _keep(jumps: Matrix, times: Nanoseconds, largest: Vector, instants: Nanoseconds) -> None:
    """Keep the largest jump of each column, and its instant."""
    if len(jumps):
        rows = jumps.argmax(axis=0)
        candidates = jumps.max(axis=0)
        larger = candidates > largest
        largest[larger] = candidates[larger]
        instants[larger] = times[rows][larger]


# --- before the runs ---


def _check(experiment: Experiment) -> None:
    """Check that a smaller step shows the error of this one.

    Raises
    ------
    UsageError
        If its quarter is no whole number of nanoseconds; if random numbers belong to communication
        steps; if loops choose their steps, whose error is that of the tolerance, whatever their
        length is.
    """
    step_ns = experiment.clock.step_ns
    scenario = experiment.scenario
    if isinstance(step_ns, int) and step_ns % QUARTERS:
        raise UsageError(
            f"step error: a quarter of the step {step_ns / NANOSECONDS} s is not a whole number "
            "of nanoseconds; choose a step of which it is"
        )
    other_noise = (
        "random numbers at every communication step, so that a run with a smaller step has other "
        "noise"
    )
    for action in scenario.actions.values():
        if action.noise is not None or type(action.drop) in (int, float):
            raise UsageError(
                f"step error: the action {_when(action)} draws {other_noise}; use a scenario "
                "without it, or a sensor with noise and a period"
            )
    names = [name for name, spec in scenario.specs.items() if spec.step_dependence.draws]
    if names:
        step = f"{step_seconds(step_ns)}"
        settings = [option("set", short(f"components.{name}.period"), step) for name in names]
        raise UsageError(
            f"step error: {', '.join(names)} {'draw' if len(names) > 1 else 'draws'} "
            f"{other_noise}; set a period, such as {' '.join(settings)}"
        )
    if experiment.graph.substep_controls:
        raise UsageError(
            "step error: loops choose their steps by scenario.substeps, so that a smaller "
            "communication step does not show their error; use a scenario without substeps, or "
            f"compare with a run with a smaller {option('set', 'scenario.substeps.rtol')}"
        )


def _when(action: ActionTable) -> str:
    return f"at {action.at} s" if action.when is None else f"when {action.when!r}"


def _decided(experiment: Experiment) -> dict[str, Any]:
    """Return what keeps in the other runs what this step has decided, by the keys to set."""
    changes: dict[str, Any] = {}
    for name, spec in experiment.scenario.specs.items():
        table = experiment.scenario.tree["components"][name]
        metadata = experiment.built.metadata.get(name, {})
        if isinstance(spec, DecidedByStep):
            decided = spec.decided(table, metadata, experiment.clock.step_ns)
            if decided != table:
                changes[f"components.{name}"] = decided
    return changes


def _outputs(scenario: Scenario, graph: Graph) -> tuple[Mask, Mask]:
    """Return which columns are outputs, and which of them are known to jump at points alone."""
    are_outputs = np.zeros(graph.layout.width, np.bool_)
    may_jump = are_outputs.copy()
    for channel in graph.layout.channels:
        are_outputs[channel.outputs] = True
        for signal in channel.interface.outputs:
            origins = graph.jumps(Port(channel.name, signal.name))
            kinds = [scenario.specs[origin.component] for origin in origins]
            is_known = bool(kinds) and all(kind.step_dependence.jumps_at_points for kind in kinds)
            may_jump[channel.signal_columns[signal.name]] = is_known
    return are_outputs, may_jump


def _driven(graph: Graph) -> dict[str, set[str]]:
    """Return the components that each one drives, itself where it has inputs."""
    driven = {}
    for name in graph.components:
        driven[name] = {name} if graph.layout[name].interface.n_u else set()
    for to, connection in graph.connections.items():
        for source in connection.sources:
            driven[source.component].add(to.component)
    return driven
