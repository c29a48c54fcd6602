"""What a user may choose, ranked by the error of theta that is to be expected."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

import numpy as np

from cosim.arguments import mapping_argument, truth_argument
from cosim.arrays import Vector
from cosim.errors import AssumptionError, CosimError, UsageError
from cosim.scenario.document.document import plain, short
from cosim.scenario.experiment_design.trial import DesignSubject, Trial
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.identified_plant import OUTPUT_ERROR
from cosim.scenario.kinds.observer_design import DEFAULT_ORDER, FILTERS
from cosim.scenario.running.execution import load
from cosim.theory.experiment_design.delay_search import search_delays
from cosim.theory.experiment_design.predictions import PredictedEstimate, RegressionExperiment

RegressionMethod: TypeAlias = Literal["rayleigh", "least-squares"]
_Steps: TypeAlias = tuple[int, ...]  # delays in samples
_Settings: TypeAlias = Mapping[str, Any]
REGRESSION_METHODS: Final[tuple[RegressionMethod, ...]] = ("rayleigh", "least-squares")

_CHOICES: Final = ("scenario", "delays", "filter", "step", "window", "together", "input")
_METHODS: Final = (OUTPUT_ERROR, *REGRESSION_METHODS)
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


class _DesignRow:
    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        content: dict[str, Any] = plain(vars(self))
        return content


@dataclass(frozen=True, eq=False, kw_only=True)
class RankedDesign(_DesignRow):
    """A choice, and the error of theta that is to be expected with it.

    Parameters
    ----------
    choice : str
        What is chosen: ``scenario`` for all as it is, ``delays``, ``filter``, ``step``, ``window``,
        ``input``, or ``together``.
    settings : mapping of dotted key to value
        What the choice sets.
    method : str
        Of the estimator.
    bias, standard_error, error : Vector, shape (P,)
        Mean of the estimates less theta, their deviation, and both together as root mean square;
        infinite where the estimator finds no theta.
    ratio : float
        The largest error over the Cramer-Rao bound of y with the scenario as it is.
    """

    choice: str
    settings: Mapping[str, Any]
    method: str
    bias: Vector
    standard_error: Vector
    error: Vector
    ratio: float


@dataclass(frozen=True, eq=False, kw_only=True)
class OmittedDesigns(_DesignRow):
    """Choices that have no error to be expected, all for one reason.

    Parameters
    ----------
    choice : str
        As of a :class:`RankedDesign`.
    method : str
        Of the estimator; empty: all of them.
    settings : tuple of mapping of dotted key to value
        What each choice sets.
    reason : str
    """

    choice: str
    method: str
    settings: tuple[Mapping[str, Any], ...]
    reason: str


@dataclass(frozen=True, eq=False, kw_only=True)
class ExperimentDesign:
    """Choices for a scenario, ranked by the error of theta that is to be expected.

    Parameters
    ----------
    scenario : str
    identifier : str
    theta : Vector, shape (P,)
    deviations : Vector, shape (n_y,)
        Of the noise of y.
    noise_source : str
    bound : Vector, shape (P,)
        The least standard errors of theta from y, by output error, with the scenario as it is.
    designs : tuple of RankedDesign
        By choice; within a choice and a method the best first. Those of the scenario as it is may
        have an infinite error, no others.
    omitted : tuple of OmittedDesigns
        What was not tried, is refused, or finds no theta.
    notes : tuple of str
    """

    scenario: str
    identifier: str
    theta: Vector
    deviations: Vector
    noise_source: str
    bound: Vector
    designs: tuple[RankedDesign, ...]
    omitted: tuple[OmittedDesigns, ...]
    notes: tuple[str, ...]

    def of(self, choice: str, method: str) -> tuple[RankedDesign, ...]:
        """Return the designs of a choice and a method, the best first."""
        return tuple(
            design for design in self.designs if design.choice == choice and design.method == method
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        content = dict(vars(self))
        for name in ("designs", "omitted"):
            content[name] = [row.to_dict() for row in content[name]]
        renamed = {"noise_source": "noise"}
        return {renamed.get(name, name): plain(value) for name, value in content.items()}


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
    subject = DesignSubject(edited, noise=noise, theta=theta)
    trial = subject.trial()
    if longest is None:
        longest = max(_LONGEST * trial.span, *trial.delays)
    if not trial.step <= longest < math.inf:
        raise UsageError(f"longest: expected at least one communication step, got {longest:g} s")
    return _Ranking(subject, trial, longest).design(with_input=input)


@dataclass(frozen=True, eq=False)
class _Prediction:
    """What a choice lets expect: its ratio is infinite where there is no estimate, and why."""

    estimate: PredictedEstimate
    ratio: float
    reason: str


class _Ranking:
    """The variants of a scenario, as far as they were tried.

    Parameters
    ----------
    subject : DesignSubject
    trial : Trial
        The scenario as it is.
    longest : float
        The longest delay to try [s].

    Raises
    ------
    AssumptionError
        If there is no theta, or none is identifiable.
    """

    def __init__(self, subject: DesignSubject, trial: Trial, longest: float) -> None:
        self._subject = subject
        self._trial = trial
        self._longest = longest
        accuracy = trial.bound()
        self._bound = accuracy.standard_error
        self._residual = accuracy.residual
        if not len(self._bound):
            raise AssumptionError(
                f"{subject.regressor}: the terms have no parameter, so there is no theta to "
                "design for"
            )
        if not np.isfinite(self._bound).any():
            raise AssumptionError(
                f"{subject.scenario.name}: no choice makes theta identifiable from y: the "
                "disturbance has no amplitude, or the run is too short"
            )
        self._designs: list[RankedDesign] = []
        self._omissions: dict[tuple[str, str, str], list[_Settings]] = {}
        self._on_regression = cache(self._predicted_on_regression)

    def design(self, *, with_input: bool) -> ExperimentDesign:
        """Return the designs of every choice."""
        trial = self._trial
        filters = list(self._filters())
        self._add_all("scenario", trial)
        known = {method: [trial.steps] for method in REGRESSION_METHODS}
        for method in REGRESSION_METHODS:
            steps = self._best_delays(trial, method, [trial.steps])
            if steps is not None:
                known[method].append(steps)
                self._add_delays("delays", trial, steps, method)
        for variant in filters:
            self._add_methods("filter", variant.settings, variant.regression, variant.steps)
        for variant in self._steps():
            self._add_all("step", variant)
        for part in _WINDOWS:
            self._add_output_error("window", trial, round(part * trial.span, 9))
        for method in REGRESSION_METHODS:
            best, steps = self._together(method, [trial, *filters], known[method])
            self._add_delays("together", best, steps, method)
        for factor in _INPUTS if with_input and trial.data.u.size else ():
            self._add_methods(
                "input", {"input": f"{factor:g} u"}, trial.with_input(factor), trial.steps
            )
        self._designs.sort(key=_place)
        omitted = [
            OmittedDesigns(choice=choice, method=by, settings=tuple(settings), reason=reason)
            for (choice, by, reason), settings in self._omissions.items()
        ]
        return ExperimentDesign(
            scenario=self._subject.scenario.name,
            identifier=self._subject.identifier,
            theta=trial.regression.theta,
            deviations=np.sqrt(np.diag(trial.covariance)),
            noise_source=trial.noise_source,
            bound=self._bound,
            designs=tuple(self._designs),
            omitted=tuple(omitted),
            notes=tuple(self._notes(with_input=with_input)),
        )

    # --- choices ---

    def _filters(self) -> Iterator[Trial]:
        """Yield variants of the filter of delta: with a rate, then with a window."""
        trial = self._trial
        name = self._subject.observer
        variants: list[dict[str, Any]] = []
        rate = _FASTEST / trial.step
        while rate * trial.span >= _SLOWEST:
            for filter_name in ("first-order", "consistent"):
                variants.append({"filter": filter_name, "filter_rate": float(f"{rate:.3g}")})
            rate /= math.sqrt(10.0)
        slowest = {f"{name}.filter_rate": float(f"{rate:.3g}")}
        reason = f"the run is shorter than {_SLOWEST:g} time constants"
        self._omit("filter", slowest, f"not tried, nor slower ones: {reason}")
        for samples in _HALF_WIDTHS:
            width = round(samples * trial.step, 9)
            if samples * trial.step <= _WIDEST * trial.span:
                window = {"filter": "savitzky-golay", "half_width": width, "order": DEFAULT_ORDER}
                variants.append(window)
            else:
                reason = f"not tried: the window exceeds {100.0 * 2.0 * _WIDEST:g} % of the run"
                self._omit("filter", {f"{name}.half_width": width}, reason)
        table = self._subject.scenario.tree["components"][name]
        kept = {key: value for key, value in table.items() if key not in _FILTER_KEYS}
        for keys in variants:
            settings = {short(f"components.{name}.{key}"): value for key, value in keys.items()}
            yield from self._tried("filter", settings, {name: {**kept, **keys}})

    def _steps(self) -> Iterator[Trial]:
        """Yield variants of the communication step."""
        for factor in _FACTORS:
            h = float(f"{factor * self._trial.step:.12g}")
            settings = {"scenario.step": h}
            if _FEWEST_SAMPLES <= self._trial.span / h <= _MOST_SAMPLES:
                yield from self._tried("step", settings, settings)
            else:
                samples = f"{_FEWEST_SAMPLES} to {_MOST_SAMPLES}"
                self._omit("step", settings, f"not tried: expected {samples} steps in the run")

    def _tried(self, choice: str, settings: _Settings, edits: _Settings) -> Iterator[Trial]:
        """Yield a variant; none where the scenario refuses it."""
        try:
            yield self._subject.trial(settings, edits)
        except CosimError as error:
            reason = "; ".join(line.strip() for line in str(error).splitlines())
            self._omit(choice, settings, reason)

    def _together(
        self, method: RegressionMethod, variants: Sequence[Trial], known: list[_Steps]
    ) -> tuple[Trial, _Steps]:
        """Choose a filter, delays for it, and a filter for these."""

        def ratio(pair: tuple[Trial, _Steps]) -> float:
            return self._on_regression(pair[0].regression, pair[1], method).ratio

        best, _ = min(product(variants, known), key=ratio)
        other = self._best_delays(best, method, known)
        if other is not None:
            known.append(other)
        return min(product(variants, known), key=ratio)

    def _best_delays(
        self, trial: Trial, method: RegressionMethod, starts: Sequence[_Steps]
    ) -> _Steps | None:
        try:
            search = search_delays(
                lambda steps: self._on_regression(trial.regression, steps, method).ratio,
                count=trial.regression.delays_needed,
                longest=math.floor(self._longest / trial.step + 1e-9),
                starts=starts,
            )
        except AssumptionError as error:
            self._omit("delays", {}, str(error), method)
            return None
        return search.steps

    # --- what is to be expected of them ---

    def _predicted(self, predict: Callable[[], PredictedEstimate]) -> _Prediction:
        """Return what is to be found, or why nothing is."""
        reason = _UNDETERMINED
        try:
            estimate = predict()
        except AssumptionError as error:
            reason = str(error)
            count = len(self._bound)
            estimate = PredictedEstimate(np.full(count, np.inf), np.zeros((count, count)))
        is_known = np.isfinite(self._bound)
        ratio = float(np.max(estimate.error[is_known] / self._bound[is_known]))
        return _Prediction(estimate, ratio if math.isfinite(ratio) else math.inf, reason)

    def _predicted_on_regression(
        self, regression: RegressionExperiment, steps: _Steps, method: RegressionMethod
    ) -> _Prediction:
        """Return what a method is to find."""
        identifier = self._subject.scenario.specs[self._subject.identifier]
        assert isinstance(identifier, IdentifierKind)
        if method == "rayleigh":
            return self._predicted(lambda: regression.rayleigh(steps))
        return self._predicted(lambda: regression.least_squares(steps, P0=identifier.P0))

    def _add(self, choice: str, settings: _Settings, method: str, predicted: _Prediction) -> None:
        """Keep a design if it has an error to be expected; that of the scenario in any case."""
        if predicted.ratio == math.inf:
            self._omit(choice, settings, predicted.reason, method)
            if choice != "scenario":
                return
        estimate = predicted.estimate
        ranked = RankedDesign(
            choice=choice,
            settings=settings,
            method=method,
            bias=estimate.bias,
            standard_error=estimate.standard_error,
            error=estimate.error,
            ratio=predicted.ratio,
        )
        self._designs.append(ranked)

    def _omit(self, choice: str, settings: _Settings, reason: str, method: str = "") -> None:
        """Keep what a choice sets and why it has no error to be expected."""
        same = self._omissions.setdefault((choice, method, reason), [])
        if settings not in same:
            same.append(settings)

    def _add_all(self, choice: str, trial: Trial) -> None:
        self._add_output_error(choice, trial)
        self._add_methods(choice, trial.settings, trial.regression, trial.steps)

    def _add_methods(
        self, choice: str, settings: _Settings, regression: RegressionExperiment, steps: _Steps
    ) -> None:
        for method in REGRESSION_METHODS:
            self._add(choice, settings, method, self._on_regression(regression, steps, method))

    def _add_delays(
        self, choice: str, trial: Trial, steps: _Steps, method: RegressionMethod
    ) -> None:
        delays = [round(count * trial.step, 9) for count in steps]
        settings = {**trial.settings, f"{self._subject.regressor}.delays": delays}
        self._add(choice, settings, method, self._on_regression(trial.regression, steps, method))

    def _add_output_error(self, choice: str, trial: Trial, window: float = math.inf) -> None:
        """Add output error, which reaches the bound, from the last seconds of y."""

        def predict() -> PredictedEstimate:
            covariance = trial.bound(window).covariance
            return PredictedEstimate(np.zeros(len(covariance)), covariance)

        settings = dict(trial.settings)
        if math.isfinite(window):
            settings[f"{self._subject.identifier}.window"] = window
        self._add(choice, settings, OUTPUT_ERROR, self._predicted(predict))

    # --- words ---

    def _notes(self, *, with_input: bool) -> Iterator[str]:
        yield (
            "output error needs neither delays nor filter: the estimators on the regression "
            "use them, and only initialize it"
        )
        for method in REGRESSION_METHODS:
            own = [design for design in self._designs if design.method == method]
            first = {design.choice: design for design in reversed(own)}
            if "delays" in first:
                best = min(design.ratio for design in own)
                before, after = first["scenario"].ratio, first["delays"].ratio
                yield f"{method}: {self._note_on_delays(before, after, best)}"
        if self._residual > _MODEL_ERROR:
            yield (
                f"the design model leaves {self._residual:.2g} of noise-free y unexplained: the "
                "predictions hold for a plant that matches it"
            )
        for j in np.flatnonzero(~np.isfinite(self._bound)):
            yield f"theta[{j}] is not identifiable from y, and is left out of the ratio"
        if with_input and not self._trial.data.u.size:
            yield "input: the design model has no input"
        elif with_input:
            yield (
                "input: no input changes the bound, since the response of a linear plant to a "
                "known u is known and subtracted; through the filter a fraction of u "
                f"({self._trial.leakage:.2g} here) leaks into delta hat, which biases the "
                "estimators on the regression"
            )

    def _note_on_delays(self, before: float, after: float, best: float) -> str:
        listed = ", ".join(f"{delay:g}" for delay in self._trial.delays)
        reached = f"the best choice stays at {best:.3g} times the bound, which output error reaches"
        if not math.isfinite(before):
            return f"no estimate with the delays ({listed}); {reached}"
        if not after < before:
            return f"none of the delays tried is better than ({listed})"
        return (
            f"the delays ({listed}) are not the best; others have {before / after:.3g} times less "
            f"error, and {reached}"
        )


def _place(design: RankedDesign) -> tuple[int, int, float]:
    """Return where a design stands: the best of a choice and a method first."""
    return _CHOICES.index(design.choice), _METHODS.index(design.method), design.ratio
