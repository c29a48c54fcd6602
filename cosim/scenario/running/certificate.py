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
from copy import copy
from dataclasses import replace
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
from cosim.core.structure.cycles import reached_from
from cosim.documents import plain
from cosim.errors import CosimError, FmuError, Interrupted, RunError, UsageError, option
from cosim.instants import NANOSECONDS, step_part, step_seconds, step_value
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.document.document import short
from cosim.scenario.document.schema import ActionTable
from cosim.scenario.kinds.base import DecidedByStep, Scenario
from cosim.scenario.record import CERTIFICATE, RecordedCertificate, StepSearch
from cosim.scenario.recordings.recording import Progress, build_experiment, run_into
from cosim.scenario.running.thinned_rows import QUARTERS, JumpWatch, ThinnedRows
from cosim.theory.documents import StepError
from cosim.theory.richardson import step_error

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
    rows : ThinnedRows
        What keeps the rows of the run.
    problem : str
        Why one of the runs ended early; empty where none did.

    Raises
    ------
    UsageError
        If a smaller step would be another run: with other noise, or off the nanoseconds.
    """

    def __init__(self, scenario: Scenario, progress: Progress | None) -> None:
        self.scenario = scenario
        self.problem = ""
        self._progress = progress
        self._search: StepSearch | None = None
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
        self.rows = ThinnedRows(self._every, self._clock.steps)
        self._finer: list[ThinnedRows] = []
        self._jumps = JumpWatch(*self._outputs)  # of the run with the smallest step

    def again(self, search: StepSearch) -> Certification:
        """Return that of another run of the scenario, by the same runs with smaller steps.

        Parameters
        ----------
        search : StepSearch
            How its step was found.
        """
        other = copy(self)
        other._search = search
        other.rows = ThinnedRows(self._every, self._clock.steps)
        return other

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

    def run_finer(self) -> None:
        """Run the scenario with half of the step, and with a quarter.

        Raises
        ------
        UsageError
            If the scenario cannot be built with one of them.
        Interrupted
            If the user ends it.
        """
        self._finer = [self._run(finer) for finer in FINER]

    def run_all(self) -> None:
        """Run the scenario itself, too; see :meth:`run_finer`."""
        self.rows = self._run(1)
        self.run_finer()

    def _run(self, finer: int) -> ThinnedRows:
        """Run with a step that is smaller by a factor, and return its rows."""
        rows = ThinnedRows(self._every * finer, self._clock.steps * finer)
        self._jumps = JumpWatch(*self._outputs)

        def take(block: Block, signals: Matrix) -> None:
            self._jumps.take(block, signals)
            rows.take(block, signals)

        watched = Watched(Nothing(), take, jumped=self._jumps.expect)
        step = self._step(finer)
        with ExitStack() as resources:
            experiment = replace(self._built(finer, resources), identified={})
            try:
                run_into(watched, experiment, progress=self._progress, profile=None)
            except Interrupted:
                raise
            except (RunError, FmuError) as error:  # of an FMU that does not take this step
                text = f"no complete run with steps of {step} s: {error}"
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
        runs = [self.rows, *self._finer]
        count = min(len(run.time_ns) for run in runs)
        tables = [run.rows[:count] for run in runs]
        t = self.rows.time_ns[:count] / NANOSECONDS
        reasons = self._reasons()
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
        return {
            name
            for origin in self._conditions()
            for name in reached_from(self._driven.get(origin, ()), self._driven)
        }

    def _reasons(self) -> dict[str, str]:
        """Return why components have no estimate, by their names: what they follow has none."""
        reasons: dict[str, str] = {}
        for origins in (self._conditions(), self._parts(), self._unexpected()):
            for origin, text in origins.items():
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
        return Watched(recorder, self.rows.take, ended=self._end)

    def _end(self, recorder: Recorder, error: BaseException | None) -> None:
        """Leave the recorder of a complete run open; record why another has none."""
        ended = end_of_run(error)
        if ended.status == "complete":
            self._error = error
            return
        try:
            self._record(recorder, [self.rows], f"the run ended early: {ended.reason}")
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
            if not self._finer:
                self.run_finer()
            signals = {} if self.problem else self.errors()
            self._record(recorder, [self.rows, *self._finer], self.problem, signals)
        except BaseException as error:
            reason = error_text(error) or "interrupted by the user"
            problem = f"a run with a smaller step did not complete: {reason}"
            self._record(recorder, [self.rows], problem)
            error.add_note("no error estimate: a run with a smaller step did not complete")
            raise
        finally:
            close(recorder, self._error)

    def _record(
        self,
        recorder: Recorder,
        runs: Sequence[ThinnedRows],
        problem: str,
        signals: Mapping[str, StepError] | None = None,
    ) -> None:
        """Record what is known of runs, or why nothing is."""
        step = step_seconds(self._clock.step_ns)
        certificate = RecordedCertificate(
            step,
            tuple(step / finer for finer in FINER),
            tuple(run.end_ns / NANOSECONDS for run in runs),
            problem,
            self._fmus,
            signals or {},
            self._search,
            every=self._every,
        )
        recorder.result({CERTIFICATE: plain(certificate)})


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
