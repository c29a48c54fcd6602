"""The largest communication step with which signals keep tolerances.

A step is possible where the scenario can be built with it: where it divides stop, periods, delays,
and all other times that are given, and is not too large for a component. The search begins with the
largest one that leaves a certificate enough points, and goes on to the largest one of at most half
of the last, until the certificate says of every signal that its error is within the tolerance.
Between the last step that failed and the first that did not, the observed orders tell which
possible steps to try. Each is tried with a certificate of its own: a step is never taken because
another one was fine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from typing import Final

from cosim.core.clock import nanoseconds
from cosim.core.graph import Graph
from cosim.core.recorded.signals import find_signal
from cosim.errors import CosimError, Interrupted, RunError, UnknownSignalError, UsageError, option
from cosim.instants import NANOSECONDS, step_value
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.record import StepSearch, StepTrial
from cosim.scenario.recordings.recording import Progress, build_experiment
from cosim.scenario.running.certificate import FINER, QUARTERS, Certification
from cosim.theory.documents import StepError
from cosim.theory.richardson import FEWEST

MOST_STEPS: Final = 10**7  # of the finest run
MOST_FINER: Final = 16  # times as fine as its own step a scenario may be run all the same
FIND_STEP: Final = "find_step"  # the name of the argument


def find_step(
    scenario: Scenario, tolerances: Mapping[str, float], progress: Progress | None
) -> Certification:
    """Find the largest step with which the error of the step is within tolerances.

    Parameters
    ----------
    scenario : Scenario
    tolerances : mapping of signal to float
        In the unit of each signal.
    progress : callable or None

    Returns
    -------
    Certification
        Of a run with that step; it has the scenario.

    Raises
    ------
    UsageError
        If there is no such signal, a tolerance is no positive number, a step was set beside it, or
        a smaller step would be another run.
    RunError
        If no step keeps the tolerances.
    Interrupted
        If the user ends it.
    """
    if not tolerances:
        raise UsageError(
            f"{option(FIND_STEP)}: expected at least one signal with its tolerance, got none"
        )
    if "scenario.step" in scenario.document.changes:
        raise UsageError(
            f"expected {option(FIND_STEP)} or {option('set', 'scenario.step')}, got both: the "
            "search chooses the step"
        )
    search = _StepSearch(scenario, tolerances, progress)
    try:
        best = search.best()
    except Interrupted as error:
        error.add_note("no step was found yet, so nothing is recorded")
        raise
    trials = tuple(trial.document for trial in search.trials)
    best.certification.search = StepSearch(dict(tolerances), trials)
    return best.certification


class _TriedStep:
    """A step that was tried.

    Parameters
    ----------
    step_ns : int
        [ns].
    certification : Certification
        Of its run.
    tolerances : mapping of label to float

    Attributes
    ----------
    errors : dict of label to StepError
        Of the elements of signals that have a tolerance; none where a run ended early.
    exceeding : dict of label to StepError
        Those that are unknown or too large; one that is lost in rounding by its bound.
    failure : str
        Why it is not fine, in words; of an error that is too large, how large it is.
    follows_condition : bool
        Whether there is no estimate of an error, nor with another step.
    """

    def __init__(
        self, step_ns: int, certification: Certification, tolerances: Mapping[str, float]
    ) -> None:
        self.step_ns = step_ns
        self.certification = certification
        self._tolerances = tolerances
        errors = {} if certification.problem else certification.errors()
        self.errors = {label: errors[label] for label in tolerances if errors}
        self.exceeding: dict[str, StepError] = {}
        for label, error in self.errors.items():
            known = error.bound if error.is_rounding else error.largest
            if known is None or known > tolerances[label]:
                self.exceeding[label] = error
        self.failure = certification.problem or _excess_text(self.exceeding)
        components = {label.partition(".")[0] for label in self.errors}
        self.follows_condition = not components.isdisjoint(certification.of_conditions)

    @property
    def expected_step_ns(self) -> float:
        """The step [ns] with which the errors would be the tolerances, by the orders."""
        factor = math.inf
        for label, error in self.errors.items():
            if error.largest and error.order:
                ratio = self._tolerances[label] / error.largest
                factor = min(factor, ratio ** (1.0 / error.order))
        return self.step_ns * factor

    @property
    def grows(self) -> bool:
        """Whether an error grows as the step is made smaller."""
        return any(error.grows for error in self.errors.values())

    @property
    def document(self) -> StepTrial:
        """What the log says of it."""
        largest = {label: error.largest for label, error in self.errors.items()}
        return StepTrial(self.step_ns / NANOSECONDS, largest, self.failure)


def _excess_text(exceeding: Mapping[str, StepError]) -> str:
    """Return how large errors are, or why they are not known."""
    texts = []
    unknown: dict[str, list[str]] = {}
    for label, error in exceeding.items():
        if error.largest is None:
            unknown.setdefault(error.reason, []).append(label)
        else:
            texts.append(f"the error of {label} is {error.largest:.3g}")
    for reason, labels in unknown.items():
        texts.append(f"no estimate of {', '.join(labels)}: {reason}")
    return "; ".join(texts)


class _StepSearch:
    """Tries steps.

    Parameters
    ----------
    scenario : Scenario
    tolerances : mapping of signal to float
    progress : callable or None

    Attributes
    ----------
    trials : list of _TriedStep
        In their order.
    """

    def __init__(
        self, scenario: Scenario, tolerances: Mapping[str, float], progress: Progress | None
    ) -> None:
        self._scenario = scenario
        self._progress = progress
        self.trials: list[_TriedStep] = []
        with ExitStack() as resources:
            experiment = build_experiment(scenario, resources)
            clock = experiment.clock
            self._tolerances = _tolerances(experiment.graph, tolerances)
        if not isinstance(clock.step_ns, int):
            raise UsageError(
                f"{option(FIND_STEP)}: expected a scenario with a step of whole nanoseconds, which "
                f"the steps that are tried have, too; got {step_value(clock.step_ns)} s"
            )
        self._own_step_ns = clock.step_ns
        times = [time for spec in scenario.specs.values() for time in spec.step_dependence.times]
        self._steps = [
            step_ns
            for step_ns in _dividing_steps(clock.step_ns, clock.steps)
            if not any(nanoseconds(time) % step_ns for time in times)
        ]
        self._possible: dict[int, bool] = {clock.step_ns: True}

    def best(self) -> _TriedStep:
        """Halve the step until one is fine; then try larger ones, up to the last that was not.

        Raises
        ------
        RunError
            If none is.
        """
        best: _TriedStep | None = None
        upper = math.inf  # the last step that was not fine
        while (step_ns := self._next(best, upper)) is not None:
            trial = self._try(step_ns)
            if not trial.failure:
                best = trial
                continue
            upper = step_ns
            # With larger steps than the scenario's own a condition may come true by mistake.
            follows_condition = trial.follows_condition and step_ns <= self._own_step_ns
            is_rounding = any(error.is_rounding for error in trial.exceeding.values())
            if best is None and (follows_condition or is_rounding):
                break  # smaller steps show no more
        if best is None:
            raise RunError(self._none_found())
        return best

    def _next(self, best: _TriedStep | None, upper: float) -> int | None:
        """Return the step to try between the best one, if there is one, and one that is not fine.

        None: there is none between them.
        """
        if best is None:
            smaller = (step for step in self._steps if 2 * step <= upper)
            return next(filter(self._is_possible, smaller), None)
        larger = [step for step in self._steps if best.step_ns < step < upper]
        larger = list(filter(self._is_possible, larger))
        expected = best.expected_step_ns
        return next((step for step in larger if step <= expected), larger[-1] if larger else None)

    def _none_found(self) -> str:
        wanted = ", ".join(f"{label} {value:g}" for label, value in self._tolerances.items())
        if not self.trials:
            return (
                f"{option(FIND_STEP)}: no step divides all given times, has a quarter that is a "
                f"whole number of nanoseconds, and leaves {FEWEST} communication points"
            )
        last = self.trials[-1]
        text = (
            f"{option(FIND_STEP)}: none of {len(self.trials)} steps tried, down to "
            f"{last.step_ns / NANOSECONDS:g} s, achieves {wanted}: {last.failure}"
        )
        if last.follows_condition:
            text += ", whatever the step; use an action at a fixed time, or another signal"
        grown = [trial for trial in self.trials if trial.grows]
        if grown and (last.grows or last.certification.problem):
            step = grown[-1].step_ns / NANOSECONDS
            text += (
                f"; below {step:g} s the error grows as the step is halved, as with an unstable "
                "coupling"
            )
        return text

    def _at(self, step_ns: int) -> Scenario:
        return self._scenario.edit(set={"scenario.step": step_ns / NANOSECONDS})

    def _is_possible(self, step_ns: int) -> bool:
        """Return whether the scenario can be built with a step."""
        if step_ns not in self._possible:
            self._possible[step_ns] = False
            with ExitStack() as resources, suppress(CosimError):
                build_experiment(self._at(step_ns), resources)
                self._possible[step_ns] = True
        return self._possible[step_ns]

    def _try(self, step_ns: int) -> _TriedStep:
        certification = Certification(self._at(step_ns), self._progress)
        certification.run(1, *FINER)
        self.trials.append(_TriedStep(step_ns, certification, self._tolerances))
        return self.trials[-1]


def _tolerances(graph: Graph, tolerances: Mapping[str, float]) -> dict[str, float]:
    """Return the tolerance of every element by its label.

    Raises
    ------
    UsageError
        If there is no such signal, or a tolerance is no positive number.
    """
    labels = graph.labels()
    channels = {channel.name: channel for channel in graph.layout.channels}
    wanted: dict[str, float] = {}
    for name, tolerance in tolerances.items():
        is_number = isinstance(tolerance, int | float) and not isinstance(tolerance, bool)
        if not (is_number and 0.0 < tolerance < math.inf):
            raise UsageError(
                f"{option(FIND_STEP, name)}: expected a positive number in the unit of the "
                f"signal, got {tolerance!r}"
            )
        try:
            port = find_signal(channels, name, source="the scenario")
        except UnknownSignalError as error:
            raise UsageError(f"{option(FIND_STEP, name)}: {error}") from error
        begin = port.channel.start
        elements = labels[begin + port.columns.start : begin + port.columns.stop]
        wanted |= dict.fromkeys(elements, float(tolerance))
    return wanted


def _dividing_steps(step_ns: int, steps: int) -> list[int]:
    """Return the steps [ns] that divide the run, with whole quarters, the largest first.

    Those that leave fewer points than a certificate needs are left out, and those that make more
    than ``MOST_STEPS`` steps of the finest run and are less than ``step_ns / MOST_FINER``.

    Parameters
    ----------
    step_ns, steps : int
        One of them, and the number of steps of the run with it.
    """
    duration = step_ns * steps
    most = max(MOST_FINER * steps, MOST_STEPS // QUARTERS)
    counts = {a * b for a in _divisors(step_ns) for b in _divisors(steps)}
    dividing = [duration // count for count in counts if FEWEST <= count <= most]
    return sorted((own for own in dividing if not own % QUARTERS), reverse=True)


def _divisors(number: int) -> list[int]:
    small = [factor for factor in range(1, math.isqrt(number) + 1) if not number % factor]
    return [*small, *(number // factor for factor in small)]
