"""What a run records beside its signals as it goes on: messages, and what is known at its end."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from math import ceil
from types import TracebackType
from typing import TYPE_CHECKING, Final, final

from cosim.arrays import Matrix, Vector
from cosim.core.conditions import until_text
from cosim.core.contracts import Block, Stopped
from cosim.core.recorded.signals import WARNINGS, DistinctWarnings, RunMessage
from cosim.core.recorders import Tee, close, end_of_run, error_text
from cosim.core.recording import INNER_STEP, SHARED_INNER_STEP, MessageLevel, Plan, Recorder
from cosim.core.stages.substep_control import SUBSTEP_COUNTS, SubstepCounts
from cosim.documents import plain
from cosim.errors import Interrupted, RunError, listing
from cosim.interrupts import uninterrupted
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.kinds.capabilities import change_text, changed_states
from cosim.scenario.record import IDENTIFICATION, INITIAL_STATES, UNTIL
from cosim.scenario.recordings.verdicts import Assessor

if TYPE_CHECKING:
    from cosim.fmi.binary.messages import Message

_MEANS: Final = (
    "every step sets {} to the mean of both of its ends, which are what the log has (no input "
    "derivatives)"
)
_ENDED: Final = (Interrupted, KeyboardInterrupt, SystemExit, GeneratorExit)  # from outside


@final
class MessageRecorder(Tee):
    """Records the messages of a run and of its FMUs beside its signals, with any recorder.

    Parameters
    ----------
    recorder : Recorder
    experiment : Experiment
    began, reached : callable, optional
        As of :class:`.Tee`; what ``reached`` raises ends the run, cleanly.
    """

    def __init__(
        self,
        recorder: Recorder,
        experiment: Experiment,
        *,
        began: Callable[[], None] | None = None,
        reached: Callable[[Block, Matrix], None] | None = None,
    ) -> None:
        super().__init__(recorder, began=began, reached=reached)
        self._recorder = recorder
        self._experiment = experiment
        self._reached_ns = experiment.clock.start_ns
        self._ahead: dict[str, list[Message]] = {}  # by FMU, of instants that are not reached yet
        self._inner_steps: list[str] = []  # components that seem to keep one
        self._warnings = DistinctWarnings()
        self._last: Vector | None = None
        is_judged = experiment.scenario.file.scenario.verdicts
        self._identified = experiment.identified if is_judged else {}
        self._assessor = Assessor(experiment.graph, self._identified)

    @property
    def warnings(self) -> list[RunMessage]:
        """The warnings so far: each text of a component once."""
        return list(self._warnings)

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Record a message, and note it where it is a new warning."""
        self._warnings.add(RunMessage(time_ns, level, source, text))
        self._recorder.message(time_ns, level, source, text)

    def _say(self, level: MessageLevel, source: str, text: str) -> None:
        """Record a message at the time reached."""
        self.message(self._reached_ns, level, source, text)

    # --- before the run ---

    def begin(self, plan: Plan) -> None:
        """Pass on, then record what is known before the run.

        The warnings, the inputs that nothing drives, the messages of FMUs when they were loaded.
        """
        super().begin(plan)
        graph = self._experiment.graph
        kept: dict[str, list[str]] = {}
        for port, values in graph.unconnected.items():
            value = ", ".join(map(repr, values))
            kept.setdefault(port.component, []).append(f"{port.name} = {value}")
        for name, inputs in kept.items():
            text = f"not connected, so at their start values: {'; '.join(inputs)}"
            self._say("info", name, text)
        for name, means in graph.mean_inputs.items():
            self._say("info", name, _MEANS.format(", ".join(means)))
        for name, text in self._experiment.built.warnings:
            self._say("warning", name, text)
        for name, messages in self._experiment.messages.items():
            self._record(name, messages, self._reached_ns)

    # --- the run ---

    def write(self, block: Block, signals: Matrix) -> None:
        """Record the messages of the block, pass it on, then report."""
        if self._last is None:
            self._record_initial_states(signals[0])
        self._check_inputs(block, signals)
        end_ns = int(block.time_ns[-1])
        self._record_messages(end_ns)
        self._reached_ns = end_ns
        self._recorder.write(block, signals)
        self._last = signals[-1].copy()
        self._assessor.take(block, signals)
        if self._reached is not None:
            self._reached(block, signals)

    def _record_initial_states(self, row: Vector) -> None:
        """Record which initial states are others than those that the scenario gives."""
        experiment = self._experiment
        changed = changed_states(experiment.graph, experiment.given_states, row)
        for name, changes in changed.items():
            self._say("warning", name, change_text(changes))
        if changed:
            documents = {name: list(map(plain, changes)) for name, changes in changed.items()}
            self._recorder.result({INITIAL_STATES: documents})

    def _check_inputs(self, block: Block, signals: Matrix) -> None:
        """Have FMUs warn of values of inputs that they do not allow."""
        for name, fmu in self._experiment.built.fmus.items():
            if fmu.input_limits.are_there:
                inputs = signals[:, self._experiment.graph.layout[name].inputs]
                ports = self._experiment.port_maps.get(name)
                own = inputs if ports is None else ports.component_inputs(inputs)
                fmu.input_limits.check(block.time, own)

    def _record_messages(self, until_ns: int) -> None:
        """Record the new messages of all FMUs, and those that have waited for their instants."""
        messages = {}
        for name, fmu in self._experiment.built.fmus.items():
            messages[name] = [*self._ahead.pop(name, []), *fmu.drain()]
        # In the order of inner steps, of which the first one of a loop is said, in blocks of any
        # length.
        for name in sorted(messages, key=lambda name: _first_inner_step(messages[name])):
            self._record(name, messages[name], until_ns)

    def _record(self, name: str, messages: Sequence[Message], until_ns: int) -> None:
        """Record messages at their own time; where there is none, at the time reached before.

        Those after ``until_ns`` wait.
        """
        ahead = []
        for message in messages:
            time, level, category, text = message
            time_ns = self._reached_ns if time is None else round(time * 1e9)
            if time_ns > until_ns:
                ahead.append(message)
                continue
            if category == SHARED_INNER_STEP:
                loop = self._loop_of(name)
                is_said = not loop.isdisjoint(self._inner_steps)
                self._inner_steps.append(name)
                if is_said:  # of one of them, which may be the one
                    continue
                text += f"; its loop: {', '.join(sorted(loop))}"
            elif category == INNER_STEP:
                self._inner_steps.append(name)
            elif category:
                text = f"{category}: {text}"
            self.message(time_ns, level, name, text)
        if ahead:
            self._ahead[name] = ahead

    def _loop_of(self, name: str) -> frozenset[str]:
        """Return the components of the loop that a component is in."""
        for stage in self._experiment.graph.stages:
            members = frozenset(member.name for member in stage.members)
            if name in members:
                return members
        return frozenset()

    # --- its end ---

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        ended = self._terminate(error)
        try:
            with uninterrupted():
                self._conclude(ended)
        finally:
            close(self._recorder, ended)
        if ended is not None and ended is not error:
            raise ended

    def _terminate(self, error: BaseException | None) -> BaseException | None:
        """End the run of every FMU; return what the run as a whole ended with."""
        failures = []
        try:
            for name, fmu in self._experiment.built.fmus.items():
                try:
                    fmu.terminate()
                except RunError as failure:
                    text = f"{name!r} failed at the end of the run: {failure}"
                    if end_of_run(error).status == "complete":
                        error = RunError(text)
                    else:
                        failures.append((name, text))
        except KeyboardInterrupt as interruption:  # an FMU may take long
            error = interruption
        for name, text in failures:
            self._say("error", name, text)
        return error

    def _conclude(self, error: BaseException | None) -> None:
        """Record what is known at the end: last messages, the error, the last row.

        Where the run ended early, FMUs may be ahead of its end: of them there are the messages up
        to the end of the step that was not completed.
        """
        self._record_messages(self._reached_ns + ceil(self._experiment.clock.step_ns))
        if error is not None:
            level: MessageLevel = "warning" if isinstance(error, _ENDED) else "error"
            if isinstance(error, Stopped) and not error.failed:
                level = "info"
            # past the warnings: the status says how it ended
            self._recorder.message(self._reached_ns, level, "run", error_text(error))
        came_true = self._record_until(error)
        self._record_substeps()
        if self._inner_steps:
            self._recorder.result({INNER_STEP: self._inner_steps})
        if self._last is not None:
            labels = self._experiment.graph.labels()
            pairs = zip(labels, self._last.tolist(), strict=True)
            last = {label: value if math.isfinite(value) else None for label, value in pairs}
            warnings = [list(warning) for warning in self._warnings]
            self._recorder.result({"last": last, WARNINGS: warnings})
            if self._identified and (error is None or came_true):
                self._recorder.result({IDENTIFICATION: self._assessor.results()})

    def _record_until(self, error: BaseException | None) -> bool:
        """Record whether the condition came true that ends the run, where it looked for one."""
        until = self._experiment.until
        if until is None:
            return False
        came_true = end_of_run(error).reason.startswith(until_text(until))
        self._recorder.result({UNTIL: came_true})
        if error is None:
            self._say("info", "run", f"{until_text(until)}: never met")
        return came_true

    def _record_substeps(self) -> None:
        """Record how many substeps loops took, and whether some miss the tolerance."""
        counts = [control.counts for control in self._experiment.graph.substep_controls]
        if counts:
            self._recorder.result({SUBSTEP_COUNTS: [asdict(count) for count in counts]})
        for count in counts:
            if count.missed:
                self._say("warning", count.components[0], _missed_text(count))


def _first_inner_step(messages: Sequence[Message]) -> float:
    """Return when an inner step showed that may be of another FMU [s]; infinity: none did."""
    times = [time for time, _, category, _ in messages if category == SHARED_INNER_STEP]
    return min((time for time in times if time is not None), default=math.inf)


def _missed_text(counts: SubstepCounts) -> str:
    """Return how far some substeps of a loop miss the tolerance."""
    return (
        f"the loop of {listing(counts.components)}: {counts.missed} of {counts.accepted} substeps "
        f"miss the tolerance and cannot be shorter, at worst by a factor of "
        f"{counts.worst_error:.3g} at t = {counts.worst_time} s; needed a smaller "
        "scenario.substeps.min, larger tolerances, or coupling = 'newton'"
    )
