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
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Final

from cosim.core.clock import nanoseconds
from cosim.core.passing_recorders import Watched
from cosim.core.recorded.signals import find_signal
from cosim.core.recorders import Nothing
from cosim.errors import CosimError, Interrupted, RunError, UnknownSignalError, UsageError, option
from cosim.instants import NANOSECONDS, step_value
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.record import StepSearch, StepTrial
from cosim.scenario.recordings.preparing import build_experiment
from cosim.scenario.recordings.recording import Progress, run_into
from cosim.scenario.running.certificate import Certifier, certifier_of
from cosim.scenario.running.thinned_rows import QUARTERS
from cosim.theory.documents import StepError
from cosim.theory.richardson import FEWEST

MOST_STEPS: Final = 10**7  # of the finest run
MOST_FINER: Final = 16  # times as fine as its own step a scenario may be run all the same
FIND_STEP: Final = "find_step"  # the name of the argument


@dataclass(frozen=True, slots=True)
class TriedStep:
    """A step that was tried.

    Parameters
    ----------
    step_ns : int
        [ns].
    errors : mapping of label to StepError
        Of the elements of signals that have a tolerance.
    tolerances : mapping of label to float
    problem : str
        Why there are no errors; empty where there are.
    certifier : Certifier
        Of its run.
    """

    step_ns: int
    errors: Mapping[str, StepError]
    tolerances: Mapping[str, float]
    problem: str
    certifier: Certifier

    @property
    def is_fine(self) -> bool:
        """Whether every error is known, and within its tolerance."""
        return not self.problem and all(
            _is_within(error, self.tolerances[label]) for label, error in self.errors.items()
        )

    @property
    def expected_step_ns(self) -> float:
        """The step [ns] with which the errors would be the tolerances, by the orders."""
        factor = math.inf
        for label, error in self.errors.items():
            if error.largest and error.order:
                ratio = self.tolerances[label] / error.largest
                factor = min(factor, ratio ** (1.0 / error.order))
        return self.step_ns * factor

    @property
    def failure(self) -> str:
        """Why it is not fine, in words; of an error that is too large, how large it is."""
        if self.problem:
            return self.problem
        texts = []
        unknown: dict[str, list[str]] = {}
        for label, error in self.errors.items():
            if _is_within(error, self.tolerances[label]):
                continue
            if error.largest is None:
                unknown.setdefault(error.reason, []).append(label)
            else:
                texts.append(f"the error of {label} is {error.largest:.3g}")
        for reason, labels in unknown.items():
            texts.append(f"no estimate of {', '.join(labels)}: {reason}")
        return "; ".join(texts)

    @property
    def grows(self) -> bool:
        """Whether an error grows as the step is made smaller."""
        return any(error.grows for error in self.errors.values())

    @property
    def is_rounding(self) -> bool:
        """Whether an error that is too large is lost in rounding: smaller steps show no more."""
        return any(
            error.is_rounding and not _is_within(error, self.tolerances[label])
            for label, error in self.errors.items()
        )

    @property
    def follows_condition(self) -> bool:
        """Whether there is no estimate of an error, nor with another step."""
        components = self.certifier.of_conditions
        return any(label.partition(".")[0] in components for label in self.errors)

    @property
    def document(self) -> StepTrial:
        """What the log says of it."""
        largest = {label: error.largest for label, error in self.errors.items()}
        return StepTrial(self.step_ns / NANOSECONDS, largest, self.failure)


@dataclass(frozen=True, slots=True)
class FoundStep:
    """A step that keeps the tolerances [s], and what certifies the run with it."""

    step: float
    certifier: Certifier


def find_step(
    scenario: Scenario, tolerances: Mapping[str, float], progress: Progress | None
) -> FoundStep:
    """Find the largest step with which the error of the step is within tolerances.

    Parameters
    ----------
    scenario : Scenario
    tolerances : mapping of signal to float
        In the unit of each signal.
    progress : callable or None

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
    wanted = _tolerances(scenario, tolerances)
    search = _StepSearch(scenario, wanted, progress)
    try:
        best = search.first_fine()
        best = search.largest_above(best)
    except Interrupted as error:
        error.add_note("no step was found yet, so nothing is recorded")
        raise
    step = best.step_ns / NANOSECONDS
    found = StepSearch(dict(tolerances), tuple(trial.document for trial in search.trials))
    return FoundStep(step, best.certifier.with_search(found))


def _tolerances(scenario: Scenario, tolerances: Mapping[str, float]) -> dict[str, float]:
    """Return the tolerance of every element by its label.

    Raises
    ------
    UsageError
        If there is no such signal, or a tolerance is no positive number.
    """
    with ExitStack() as resources:
        graph = build_experiment(scenario, resources, None).graph
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
        for column in range(begin + port.columns.start, begin + port.columns.stop):
            wanted[labels[column]] = float(tolerance)
    return wanted


class _StepSearch:
    """Tries steps.

    Parameters
    ----------
    scenario : Scenario
    tolerances : mapping of label to float
    progress : callable or None

    Attributes
    ----------
    trials : list of TriedStep
        In their order.
    """

    def __init__(
        self, scenario: Scenario, tolerances: Mapping[str, float], progress: Progress | None
    ) -> None:
        self._scenario = scenario
        self._tolerances = tolerances
        self._progress = progress
        self.trials: list[TriedStep] = []
        with ExitStack() as resources:
            clock = build_experiment(scenario, resources, None).clock
        if not isinstance(clock.step_ns, int):
            raise UsageError(
                f"{option(FIND_STEP)}: expected a scenario with a step of whole nanoseconds, which "
                f"the steps that are tried have, too; got {step_value(clock.step_ns)} s"
            )
        self._own_step_ns = clock.step_ns
        self._steps = _dividing_steps(clock.step_ns, clock.steps)
        self._possible: dict[int, bool] = {clock.step_ns: True}
        self._times_ns: list[int] = []
        for spec in scenario.specs.values():
            self._times_ns += map(nanoseconds, spec.step_dependence.times)

    def first_fine(self) -> TriedStep:
        """Halve the step until one is fine.

        Raises
        ------
        RunError
            If none is.
        """
        trial: TriedStep | None = None
        for step_ns in self._steps:
            is_next = trial is None or 2 * step_ns <= trial.step_ns
            if is_next and self._is_possible(step_ns):
                trial = self._try(step_ns)
                if trial.is_fine:
                    return trial
                # With larger steps than the scenario's own a condition may come true by mistake.
                is_hopeless = trial.follows_condition and step_ns <= self._own_step_ns
                if trial.is_rounding or is_hopeless:
                    break
        raise RunError(self._none_found())

    def largest_above(self, best: TriedStep) -> TriedStep:
        """Return the largest fine step between the one before, which was not, and a fine one."""
        failed = [trial.step_ns for trial in self.trials if not trial.is_fine]
        upper = failed[-1] if failed else math.inf
        between = [step for step in self._steps if best.step_ns < step < upper]
        between = [step for step in between if self._is_possible(step)]
        while between:
            expected = best.expected_step_ns
            step_ns = next((step for step in between if step <= expected), between[-1])
            trial = self._try(step_ns)
            if trial.is_fine:
                best = trial
                between = [step for step in between if step > step_ns]
            else:
                between = [step for step in between if step < step_ns]
        return best

    def _none_found(self) -> str:
        wanted = ", ".join(f"{label} {value:g}" for label, value in self._tolerances.items())
        if not self.trials:
            return (
                f"{option(FIND_STEP)}: no step divides all given times, has a quarter that is a "
                f"whole number of nanoseconds, and leaves {FEWEST} communication points"
            )
        last = self.trials[-1]
        text = (
            f"{option(FIND_STEP)}: no step achieves {wanted}; tried {len(self.trials)}, down to "
            f"{last.step_ns / NANOSECONDS:g} s: {last.failure}"
        )
        if last.follows_condition:
            text += ", whatever the step; use an action at a fixed time, or another signal"
        grown = [trial for trial in self.trials if trial.grows]
        if grown and (last.grows or last.problem):
            step = grown[-1].step_ns / NANOSECONDS
            text += (
                f"; below {step:g} s the error grows as the step is halved: the coupling is "
                "unstable"
            )
        return text

    def _at(self, step_ns: int) -> Scenario:
        return self._scenario.edit(set={"scenario.step": step_ns / NANOSECONDS})

    def _is_possible(self, step_ns: int) -> bool:
        """Return whether a step divides all times, and the scenario can be built with it."""
        if any(time_ns % step_ns for time_ns in self._times_ns):
            return False
        if step_ns not in self._possible:
            with ExitStack() as resources:
                try:
                    build_experiment(self._at(step_ns), resources, None)
                    self._possible[step_ns] = True
                except CosimError:
                    self._possible[step_ns] = False
        return self._possible[step_ns]

    def _try(self, step_ns: int) -> TriedStep:
        scenario = self._at(step_ns)
        certifier = certifier_of(scenario, self._progress)
        own = certifier.rows()
        watched = Watched(Nothing(), own.take)
        problem = certifier.problem
        with ExitStack() as resources:
            experiment = replace(build_experiment(scenario, resources, None), identified={})
            try:
                run_into(watched, experiment, progress=self._progress, profile=None)
            except Interrupted:
                raise
            except RunError as error:
                problem = str(error)
        errors: dict[str, StepError] = {}
        if not problem:
            all_errors = certifier.errors(own)
            errors = {label: all_errors[label] for label in self._tolerances}
        trial = TriedStep(step_ns, errors, self._tolerances, problem, certifier)
        self.trials.append(trial)
        return trial


def _is_within(error: StepError, tolerance: float) -> bool:
    """Return whether an error is within a tolerance; one that is lost in rounding by its bound."""
    known = error.bound if error.is_rounding else error.largest
    return known is not None and known <= tolerance


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
    divisors = {1}
    for prime, power in [*_primes(step_ns), *_primes(steps)]:
        with_prime: set[int] = set()
        for k in range(power + 1):
            with_prime.update(divisor * prime**k for divisor in divisors)
        divisors = with_prime
    largest = duration / FEWEST
    smallest = min(step_ns / MOST_FINER, QUARTERS * duration / MOST_STEPS)
    dividing = [d for d in divisors if d % QUARTERS == 0 and smallest <= d <= largest]
    return sorted(dividing, reverse=True)


def _primes(number: int) -> list[tuple[int, int]]:
    """Return the primes of a number, and how often each divides it."""
    primes = []
    factor = 2
    while factor * factor <= number:
        power = 0
        while number % factor == 0:
            number //= factor
            power += 1
        if power:
            primes.append((factor, power))
        factor += 1
    if number > 1:
        primes.append((number, 1))
    return primes
