"""What a user may choose, ranked by the error of theta that is to be expected."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

import numpy as np

from cosim.arguments import mapping_argument, truth_argument
from cosim.arrays import Vector
from cosim.errors import AssumptionError, CosimError, UsageError
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.document.document import short
from cosim.scenario.experiment_design.designs import (
    ExperimentDesign,
    OmittedDesigns,
    RankedDesign,
)
from cosim.scenario.experiment_design.subject import DesignSubject, subject_of
from cosim.scenario.experiment_design.trial import Trial, trial_of
from cosim.scenario.kinds.reconstruction import DEFAULT_ORDER, FILTERS
from cosim.scenario.running.execution import load
from cosim.theory.experiment_design.delay_search import search_delays
from cosim.theory.experiment_design.predictions import PredictedEstimate, RegressionExperiment

RegressionMethod: TypeAlias = Literal["rayleigh", "least-squares"]
_Variant: TypeAlias = tuple[RegressionExperiment, tuple[int, ...], RegressionMethod]
_Omission: TypeAlias = tuple[str, str, str]  # choice, method, reason
REGRESSION_METHODS: Final[tuple[RegressionMethod, ...]] = ("rayleigh", "least-squares")
OUTPUT_ERROR: Final = "output-error"

_LONGEST: Final = 0.25  # of the run: the longest delay that is tried
_FILTER_KEYS: Final = {"filter", "q0"}.union(
    *(variant.needed for variant in FILTERS.values()),
    *(variant.own for variant in FILTERS.values()),
)
_FACTORS: Final = (0.1, 0.2, 0.5, 2.0, 5.0, 10.0)  # of the step
_MOST_SAMPLES: Final = 100_000  # of a variant with another step
_FEWEST_SAMPLES: Final = 200
_HALF_WIDTHS: Final = (5, 10, 20, 50, 100, 200, 500)  # of windows, in samples
_WIDEST: Final = 0.05  # of the run: half of the longest window
_FASTEST: Final = 1.0  # filter_rate times step, of the fastest filter
_SLOWEST: Final = 100.0  # filter_rate times the run, of the slowest filter
_WINDOWS: Final = (0.5, 0.25, 0.125)  # of the run: of output error
_INPUTS: Final = (0.0, 10.0)  # times the input of the scenario
_UNDETERMINED: Final = "no estimate: the data do not determine theta"
_MODEL_ERROR: Final = 1e-3  # of y, above which a model is not that of the plant


def design(
    scenario: str | Path | Scenario,
    *,
    noise: float | Sequence[float] | None = None,
    theta: Sequence[float] | None = None,
    longest: float | None = None,
    input: bool = False,
    set: Mapping[str, Any] | None = None,
) -> ExperimentDesign:
    """Rank choices for a scenario by the expected error of theta.

    Parameters
    ----------
    scenario : str, Path or Scenario
        A shipped name, a path, or what :func:`load` returned; it has one identifier.
    noise : float or sequence of float, optional
        Standard deviation of the white noise of y, one number or one per output; default: that of
        the sensors.
    theta : sequence of float, optional
        The true theta, in the order of the regressor's terms; default: that of the disturbance.
    longest : float, optional
        The longest delay to try [s]; default: a quarter of the run, or that of the scenario.
    input : bool
        Rank other input amplitudes too.
    set : mapping of dotted key to value, optional
        As for :func:`run`.

    Raises
    ------
    UsageError
        If there is not one identifier behind one observer, the plant has no model, or noise or
        theta is unknown.
    ScenarioError
        With every problem of the file.
    """
    input = truth_argument("input", input)
    loaded = scenario if isinstance(scenario, Scenario) else load(scenario)
    edited = loaded.edit(set=mapping_argument("set", set))
    subject = subject_of(edited, noise=noise, theta=theta)
    trial = trial_of(subject, {})
    if longest is None:
        longest = max(_LONGEST * trial.span, *subject.regressor_kind.delays)
    ranking = _Ranking(subject, trial, longest)
    if not trial.step <= longest < math.inf:
        raise UsageError(f"longest: expected at least one communication step, got {longest:g} s")
    return ranking.all_of(with_input=input)


@dataclass(eq=False)
class _Ranking:
    """The variants of a scenario.

    Parameters
    ----------
    subject : DesignSubject
    trial : Trial
        The scenario as it is.
    longest : float
        The longest delay to try [s].
    """

    subject: DesignSubject
    trial: Trial
    longest: float
    bound: Vector = field(init=False)
    predictions: dict[_Variant, PredictedEstimate | str] = field(default_factory=dict, init=False)
    omissions: dict[_Omission, list[Mapping[str, Any]]] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        accuracy = self.trial.bound()
        self.bound = accuracy.standard_error
        self.residual = accuracy.residual
        if not len(self.bound):
            raise AssumptionError(
                f"{self.subject.regressor}: the terms have no parameter, so there is no theta to "
                "design for"
            )
        if not np.isfinite(self.bound).any():
            raise AssumptionError(
                f"{self.subject.scenario.name}: no choice makes theta identifiable from y: the "
                "disturbance has no amplitude, or the run is too short"
            )

    def all_of(self, *, with_input: bool) -> ExperimentDesign:
        """Return the designs of every choice."""
        trial = self.trial
        filters = self._filters()
        designs = self._output_error("scenario", trial, (math.inf,))
        designs += self._of_methods("scenario", trial.regression, trial.steps, {})
        for method in REGRESSION_METHODS:
            designs += self._delays(method)
        designs += _best_first(self._as_they_are("filter", filters))
        designs += _best_first(self._steps())
        designs += self._output_error("window", trial, _WINDOWS)
        for method in REGRESSION_METHODS:
            designs += self._together(method, filters)
        if with_input:
            designs += _best_first(self._inputs())
        covariance = trial.covariance
        return ExperimentDesign(
            scenario=self.subject.scenario.name,
            identifier=self.subject.identifier,
            theta=trial.regression.theta,
            deviations=np.sqrt(np.diag(covariance)),
            noise_source=self.subject.noise_source,
            bound=self.bound,
            designs=tuple(designs),
            omitted=self._omitted(),
            notes=tuple(self._notes(designs, with_input=with_input)),
        )

    # --- choices ---

    def _delays(self, method: RegressionMethod) -> list[RankedDesign]:
        steps = self._best_delays(self.trial, method, [self.trial.steps])
        if steps is None:
            return []
        return self._ranked("delays", self.trial.regression, steps, method, {})

    def _filters(self) -> list[Trial]:
        """Return variants of the filter of delta."""
        name = self.subject.observer
        table = self.subject.scenario.tree["components"][name]
        kept = {key: value for key, value in table.items() if key not in _FILTER_KEYS}
        trials = []
        for variant in (*self._rate_variants(), *self._window_variants()):
            settings = {short(f"components.{name}.{key}"): value for key, value in variant.items()}
            trials += self._tried("filter", settings, {name: {**kept, **variant}})
        return trials

    def _rate_variants(self) -> list[dict[str, Any]]:
        """Return the keys of filters with a rate, from the fastest to the slowest."""
        variants: list[dict[str, Any]] = []
        rate = _FASTEST / self.trial.step
        while rate * self.trial.span >= _SLOWEST:
            for filter_name in ("first-order", "consistent"):
                variants.append({"filter": filter_name, "filter_rate": float(f"{rate:.3g}")})
            rate /= math.sqrt(10.0)
        self._omit(
            "filter",
            {f"{self.subject.observer}.filter_rate": float(f"{rate:.3g}")},
            f"not tried, nor slower ones: the run is shorter than {_SLOWEST:g} time constants",
        )
        return variants

    def _window_variants(self) -> list[dict[str, Any]]:
        """Return the keys of filters with a window, from the shortest to the longest."""
        variants: list[dict[str, Any]] = []
        for samples in _HALF_WIDTHS:
            exact = samples * self.trial.step
            half_width = round(exact, 9)
            if exact > _WIDEST * self.trial.span:
                self._omit(
                    "filter",
                    {f"{self.subject.observer}.half_width": half_width},
                    f"not tried: the window exceeds {100.0 * 2.0 * _WIDEST:g} % of the run",
                )
                continue
            variants.append(
                {"filter": "savitzky-golay", "half_width": half_width, "order": DEFAULT_ORDER}
            )
        return variants

    def _steps(self) -> list[RankedDesign]:
        designs = []
        for factor in _FACTORS:
            h = float(f"{factor * self.trial.step:.12g}")
            edits = {"scenario.step": h}
            samples = self.trial.span / h
            if not _FEWEST_SAMPLES <= samples <= _MOST_SAMPLES:
                self._omit(
                    "step",
                    edits,
                    f"not tried: expected {_FEWEST_SAMPLES} to {_MOST_SAMPLES} steps in the run",
                )
                continue
            for trial in self._tried("step", edits):
                designs += self._output_error("step", trial, (math.inf,))
                designs += self._of_methods("step", trial.regression, trial.steps, edits)
        return designs

    def _together(self, method: RegressionMethod, filters: Iterable[Trial]) -> list[RankedDesign]:
        """Choose a filter, delays for it, and a filter for these."""
        known = [self.trial.steps]
        for design in self._delays(method):
            delays = design.settings[f"{self.subject.regressor}.delays"]
            known.append(tuple(round(delay / self.trial.step) for delay in delays))
        variants = [self.trial, *filters]

        def error(pair: tuple[Trial, tuple[int, ...]]) -> float:
            trial, steps = pair
            return self._error_of(trial.regression, steps, method)

        best, _ = min(product(variants, known), key=error)
        other = self._best_delays(best, method, known)
        if other is not None:
            known.append(other)
        best, steps = min(product(variants, known), key=error)
        return self._ranked("together", best.regression, steps, method, best.settings)

    def _inputs(self) -> list[RankedDesign]:
        designs = []
        if not self.trial.data.u.size:
            return []
        for factor in _INPUTS:
            regression = self.trial.with_input(factor)
            settings = {"input": f"{factor:g} u"}
            designs += self._of_methods("input", regression, self.trial.steps, settings)
        return designs

    # --- predictions ---

    def _tried(
        self, choice: str, settings: Mapping[str, Any], edits: Mapping[str, Any] | None = None
    ) -> list[Trial]:
        """Return a variant; none where the scenario refuses it."""
        try:
            return [trial_of(self.subject, settings, edits)]
        except CosimError as error:
            reason = "; ".join(line.strip() for line in str(error).splitlines())
            self._omit(choice, settings, reason)
            return []

    def _omit(
        self, choice: str, settings: Mapping[str, Any], reason: str, method: str = ""
    ) -> None:
        """Keep what a choice sets and why it has no error to be expected."""
        same = self.omissions.setdefault((choice, method, reason), [])
        if settings not in same:
            same.append(settings)

    def _omitted(self) -> tuple[OmittedDesigns, ...]:
        return tuple(
            OmittedDesigns(choice=choice, method=method, settings=tuple(settings), reason=reason)
            for (choice, method, reason), settings in self.omissions.items()
        )

    def _as_they_are(self, choice: str, trials: Iterable[Trial]) -> list[RankedDesign]:
        designs = []
        for trial in trials:
            designs += self._of_methods(choice, trial.regression, trial.steps, trial.settings)
        return designs

    def _of_methods(
        self,
        choice: str,
        regression: RegressionExperiment,
        steps: tuple[int, ...],
        settings: Mapping[str, Any],
    ) -> list[RankedDesign]:
        designs = []
        for method in REGRESSION_METHODS:
            predicted = self._predicted(regression, steps, method)
            designs += self._designed(choice, settings, method, predicted)
        return designs

    def _designed(
        self,
        choice: str,
        settings: Mapping[str, Any],
        method: str,
        predicted: PredictedEstimate | str,
    ) -> list[RankedDesign]:
        """Return a design where it has an error to be expected; of the scenario in any case."""
        reason = predicted if isinstance(predicted, str) else _UNDETERMINED
        if isinstance(predicted, str):
            predicted = _no_estimate(len(self.bound))
        designed = RankedDesign(
            choice=choice,
            settings=settings,
            method=method,
            bias=predicted.bias,
            standard_error=predicted.standard_error,
            error=predicted.error,
            ratio=self._ratio(predicted),
        )
        if math.isfinite(designed.ratio):
            return [designed]
        self._omit(choice, settings, reason, method)
        return [designed] if choice == "scenario" else []

    def _ranked(
        self,
        choice: str,
        regression: RegressionExperiment,
        steps: tuple[int, ...],
        method: RegressionMethod,
        settings: Mapping[str, Any],
    ) -> list[RankedDesign]:
        predicted = self._predicted(regression, steps, method)
        delays = [round(count * regression.step, 9) for count in steps]
        chosen = {**settings, f"{self.subject.regressor}.delays": delays}
        return self._designed(choice, chosen, method, predicted)

    def _output_error(
        self, choice: str, trial: Trial, windows: Iterable[float]
    ) -> list[RankedDesign]:
        """Return the designs of output error, which reaches the bound."""
        designs = []
        for part in windows:
            window = round(part * trial.span, 9)
            settings = dict(trial.settings)
            if math.isfinite(window):
                settings[f"{self.subject.identifier}.window"] = window
            predicted = _of_bound(trial, window)
            designs += self._designed(choice, settings, OUTPUT_ERROR, predicted)
        return designs

    def _predicted(
        self, regression: RegressionExperiment, steps: tuple[int, ...], method: RegressionMethod
    ) -> PredictedEstimate | str:
        """Return what a method is to find, or why it finds nothing."""
        key = (regression, steps, method)
        if key not in self.predictions:
            self.predictions[key] = self._computed(*key)
        return self.predictions[key]

    def _computed(
        self, regression: RegressionExperiment, steps: tuple[int, ...], method: RegressionMethod
    ) -> PredictedEstimate | str:
        try:
            if method == "rayleigh":
                return regression.rayleigh(steps)
            return regression.least_squares(steps, P0=self.subject.identifier_kind.P0)
        except AssumptionError as error:
            return str(error)

    def _ratio(self, predicted: PredictedEstimate) -> float:
        is_known = np.isfinite(self.bound)
        return float(np.max(predicted.error[is_known] / self.bound[is_known]))

    def _error_of(
        self, regression: RegressionExperiment, steps: tuple[int, ...], method: RegressionMethod
    ) -> float:
        predicted = self._predicted(regression, steps, method)
        if isinstance(predicted, str):
            return math.inf
        ratio = self._ratio(predicted)
        return ratio if math.isfinite(ratio) else math.inf

    def _best_delays(
        self,
        trial: Trial,
        method: RegressionMethod,
        starts: Sequence[tuple[int, ...]],
    ) -> tuple[int, ...] | None:
        try:
            search = search_delays(
                lambda steps: self._error_of(trial.regression, steps, method),
                count=trial.regression.delays_needed,
                longest=math.floor(self.longest / trial.step + 1e-9),
                starts=starts,
            )
        except AssumptionError as error:
            self._omit("delays", {}, str(error), method)
            return None
        return search.steps

    # --- words ---

    def _notes(self, designs: Sequence[RankedDesign], *, with_input: bool) -> list[str]:
        notes = [
            "output error needs neither delays nor filter: the estimators on the regression "
            "use them, and only initialize it"
        ]
        for method in REGRESSION_METHODS:
            notes += self._note_on_delays(designs, method)
        if self.residual > _MODEL_ERROR:
            notes.append(
                f"the design model leaves {self.residual:.2g} of noise-free y unexplained: the "
                "predictions hold for a plant that matches it"
            )
        for j in np.flatnonzero(~np.isfinite(self.bound)):
            notes.append(f"theta[{j}] is not identifiable from y, and is left out of the ratio")
        if with_input:
            notes.append(self._note_on_input())
        return notes

    def _note_on_delays(
        self, designs: Sequence[RankedDesign], method: RegressionMethod
    ) -> list[str]:
        by_choice = {
            design.choice: design for design in reversed(designs) if design.method == method
        }
        if not {"scenario", "delays"} <= by_choice.keys():
            return []
        before = by_choice["scenario"]
        after = by_choice["delays"]
        listed = ", ".join(f"{delay:g}" for delay in self.subject.regressor_kind.delays)
        best = min(design.ratio for design in designs if design.method == method)
        if not math.isfinite(before.ratio):
            return [
                f"{method}: no estimate with the delays ({listed}); the best choice stays at "
                f"{best:.3g} times the bound, which output error reaches"
            ]
        if not after.ratio < before.ratio:
            return [f"{method}: no delays are better than ({listed})"]
        return [
            f"{method}: the delays ({listed}) are not the best; others have "
            f"{before.ratio / after.ratio:.3g} times less error, and the best choice stays at "
            f"{best:.3g} times the bound, which output error reaches"
        ]

    def _note_on_input(self) -> str:
        if not self.trial.data.u.size:
            return "input: the design model has no input"
        return (
            "input: no input changes the bound, since the response of a linear plant to a known "
            "u is known and subtracted; through the filter a fraction of u "
            f"({self.trial.leakage:.2g} here) leaks into delta hat, which biases the estimators "
            "on the regression"
        )


def _of_bound(trial: Trial, window: float) -> PredictedEstimate | str:
    """Return what output error is to find from the last seconds of y, or why it finds nothing."""
    try:
        covariance = trial.bound(window).covariance
    except AssumptionError as error:
        return str(error)
    return PredictedEstimate(np.zeros(len(covariance)), covariance)


def _no_estimate(parameters: int) -> PredictedEstimate:
    """Return what is predicted of an estimator that finds no theta."""
    return PredictedEstimate(np.full(parameters, np.inf), np.zeros((parameters, parameters)))


def _best_first(designs: Sequence[RankedDesign]) -> list[RankedDesign]:
    """Return the best designs of every method, the best first."""
    methods = (OUTPUT_ERROR, *REGRESSION_METHODS)
    ordered = []
    for method in methods:
        own = [design for design in designs if design.method == method]
        ordered += sorted(own, key=lambda design: design.ratio)
    return ordered
