"""The identifier: parameters of the disturbance, by one of many methods.

What is a method's own, other than output error's, is imported where the method is chosen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from cosim.arrays import Vector
from cosim.blocks.declared import with_units
from cosim.blocks.estimator import Estimator
from cosim.blocks.identification_problem import IdentificationProblem, IdentificationSchedule
from cosim.blocks.output_error_identifier import OutputErrorIdentifier
from cosim.blocks.sampled import Decimated
from cosim.core.clock import whole_steps
from cosim.core.connections import Connection, component_driving
from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.signals import PortUnit
from cosim.errors import AssumptionError, UsageError
from cosim.instants import StepNs
from cosim.native.estimation.rayleigh import MOST_TERMS
from cosim.scenario.document.schema import Flag, Limit, Number, NumberRow, NumberRows, StepTime
from cosim.scenario.kinds.base import BuildContext, ExportableKind, Kind, PeriodicKind, Wiring
from cosim.scenario.kinds.capabilities import DecidedByStep
from cosim.scenario.kinds.identified_plant import (
    IdentifiedPlant,
    IdentifierSource,
    ObserverSource,
    StartTable,
    bounds_of,
    sample_connections,
    sampled_behind,
    stated_covariance,
)
from cosim.scenario.kinds.observer_design import delta_transient
from cosim.scenario.kinds.regressor import RegressorDesign, RegressorKind
from cosim.scenario.kinds.terms import alpha_connections
from cosim.scenario.kinds.values import ImpliedConnection, shared_connections
from cosim.scenario.kinds.variants import (
    LINEAR_METHODS,
    METHODS,
    IdentificationMethod,
    foreign_keys,
)
from cosim.theory.disturbances import regression
from cosim.theory.disturbed_plant import disturbed_plant
from cosim.theory.estimators import defaults
from cosim.theory.estimators.output_error import limits_of
from cosim.theory.estimators.rayleigh import rayleigh_constants

if TYPE_CHECKING:
    from cosim.fmi.exporting.specifications import Exportable
    from cosim.theory.estimators.least_squares import Recovery


class IdentifierKind(PeriodicKind, ExportableKind, DecidedByStep):
    """Identification of theta by output error, least squares, or other methods."""

    ports: ClassVar[str] = (
        "regressor, [alpha], delta, y, u -> theta, standard_error, deviation, amplitude"
    )
    kind: Literal["identifier"]
    method: IdentificationMethod = Field(
        "output-error",
        description='"output-error": fit of y, reaches the Cramer-Rao bound in white noise; '
        '"least-squares": the regression of the paper (regressor -> theta, eta), biased by noise; '
        'for comparison: "rayleigh" (regressor -> theta), "projection" (regressor, delta -> '
        'theta, amplitude), the Kalman filters "augmented-kalman" (y, u -> theta) and '
        '"extended-kalman" (y, u -> theta, standard_error), the adaptive laws "gradient" and '
        '"drem" (regressor -> theta, eta)',
    )
    P0: Number | None = Field(
        None, description="least-squares: initial covariance P(0) = P0 I; default: no prior"
    )
    start: Number | StartTable | None = Field(
        None,
        description="identification start time T_id [s], or { epsilon_observer, epsilon_filter } "
        "to compute it (default: 1e-3 each); output-error takes its initial values from mu from "
        "T_id on, but uses y from the first sample on",
    )
    period: StepTime | None = Field(
        None,
        description="period of the estimates of theta [s], a multiple of the communication step; "
        "all samples count; default: one step",
    )
    offset: Flag = Field(
        False, description="output-error: estimate a constant offset of each output"
    )
    window: Number | None = Field(
        None,
        gt=0.0,
        description="output-error, projection: length of a moving window [s]; default: all samples",
    )
    forgetting: Number | None = Field(
        None,
        gt=0.0,
        description="output-error, drem: time constant of exponential forgetting [s]; default: "
        f"none; drem: {defaults.DREM_FORGETTING:g}",
    )
    gain: Number | None = Field(
        None,
        description="gradient, drem: adaptation rate of eta [1/s]; default: "
        f"{defaults.GRADIENT_GAIN:g}; drem: {defaults.DREM_GAIN:g}",
    )
    deviation: Number | NumberRow | None = Field(
        None,
        description="output-error, Kalman filters: standard deviation of the noise of y, one "
        "number or one per output; default: output-error: that of the residual; "
        f"augmented-kalman: {defaults.AUGMENTED_DEVIATION:g}; extended-kalman: "
        f"{defaults.EXTENDED_DEVIATION:g} (includes the linearization error; weaker "
        "components of y are not identified)",
    )
    covariance: NumberRows | None = Field(
        None,
        description="output-error, Kalman filters: covariance matrix of the noise of y, in place "
        "of deviation",
    )
    size: Number | None = Field(
        None,
        description="Kalman filters: initial standard deviation of x and of the disturbance; "
        f"default: {defaults.KALMAN_SIZE:g}",
    )
    intensity: Number | None = Field(
        None,
        description="augmented-kalman: spectral density of the second derivative of delta; "
        f"default: {defaults.AUGMENTED_INTENSITY:g}",
    )
    bounds: tuple[tuple[Limit, ...], ...] | None = Field(
        None,
        description="output-error, projection: [lower, upper] for each theta; inf: no bound; "
        "equal bounds fix theta",
    )

    irregular: Number | None = Field(
        None,
        gt=0.0,
        description="bound of an unmodeled part of the disturbance, |delta_0|: the verdict at the "
        "end of the run gives the interval of each theta that is guaranteed for it; takes about a "
        "second, with large bounds up to minutes (linear programs)",
    )

    closed_loop: bool = Field(
        False,
        description="u was computed from the noisy y by a controller outside the scenario, as in "
        "recorded data; loops of the scenario itself are detected",
    )

    def decided(
        self, table: Mapping[str, Any], metadata: Mapping[str, Any], step_ns: StepNs
    ) -> Mapping[str, Any]:
        """Return the table with T_id, which was computed and put on a communication point."""
        return {**table, "start": metadata["start_time"]}

    def with_period(self, component: Component, n: int) -> Component:
        return component if n == 1 else Decimated(component, n)

    def implied_connections(
        self, name: str, connections: Mapping[Port, Connection], specs: Mapping[str, Kind]
    ) -> Mapping[Port, ImpliedConnection]:
        """Return what drives the observer and the alphas: a method takes the same signals.

        Where y has samples at times of their own, these too.
        """
        implied: dict[Port, ImpliedConnection] = {}
        inputs = METHODS[self.method].inputs
        regressor = component_driving(connections, Port(name, "regressor"))
        if regressor is not None:
            kind = specs.get(regressor)
            if "alpha" in inputs and isinstance(kind, RegressorKind):
                implied |= alpha_connections(name, kind.alphas, regressor)
            origins = {"delta": Port(regressor, "delta")}
            observer = component_driving(connections, origins["delta"])
            if observer is not None:
                origins |= {"y": Port(observer, "y"), "u": Port(observer, "u")}
            for signal, origin in origins.items():
                if signal in inputs:
                    implied |= shared_connections(Port(name, signal), origin, connections)
        if self.method == "output-error":
            implied |= sample_connections(name, connections, implied, specs)
        return implied

    def build(self, name: str, context: BuildContext) -> Component:
        return with_units(*self._built(name, context))

    def _built(self, name: str, context: BuildContext) -> tuple[Component, Mapping[str, PortUnit]]:
        """Return the identifier, and the units that its inputs have from the observer."""
        self._check_options()
        source = IdentifierSource(name, context)
        source.check_step()
        self._check_terms(source.regression)
        if self._needs_regression:
            source.regression.check_known(context.clock, estimates_eta=True)
        begin = source.start_time(self.start)
        problem = source.missing_model()
        self._warn_of_unknown_alphas(source, is_judged=not problem)
        if source.observer is not None and not problem:
            context.identified[name] = self._identified(source, source.observer)
        if self.method in LINEAR_METHODS:
            return self._on_regression(source, begin), {}
        context.add_metadata(name, {"method": self.method})
        if source.observer is None or problem:
            raise UsageError(f'method = "{self.method}": {problem}')
        identifier = self._of_model(source, source.observer, begin)
        return identifier, source.observer.units(identifier.interface)

    def _warn_of_unknown_alphas(self, source: IdentifierSource, *, is_judged: bool) -> None:
        unknown = ", ".join(repr(alpha.text) for alpha in source.regression.known.unknown)
        if not unknown or len(source.regression.groups) < 2:
            return
        when = "where estimates are judged"
        if not is_judged:
            when = "nowhere, as no model of y is there to judge by"
        source.context.warn(
            source.identifier,
            f"alpha {unknown}: only the run computes it, so that the products of the alphas are "
            f"checked for independence {when}",
        )

    def _identified(self, source: IdentifierSource, observer: ObserverSource) -> IdentifiedPlant:
        """Return the model of y, which the estimates are judged by at the end of the run."""
        context = source.context
        design = source.regression
        is_output_error = self.method == "output-error"
        sampled_by = sampled_behind(Port(observer.name, "y"), context)
        problem = ""
        if not is_output_error and sampled_by is not None:
            problem = (
                f"y has values between the samples of {sampled_by!r}; only method = "
                '"output-error" takes the samples, and only its estimates are judged'
            )
            context.warn(source.identifier, problem)
        plant = disturbed_plant(observer.design.model.reduced, design.elements)
        stated = None
        if is_output_error:
            stated = stated_covariance(self.deviation, self.covariance, len(plant.C))
        bounds = {}
        if self.bounds is not None:
            parameters = sum(len(family.parameters) for family in design.families)
            bounds = bounds_of([list(row) for row in self.bounds], parameters)
        design.check_distinguishable(context.clock, bounds)
        return IdentifiedPlant(
            problem=problem,
            observer=observer.name,
            plant=plant,
            families=design.families,
            alphas=design.alphas,
            regressor=source.regressor,
            check_alphas=partial(design.check_recorded, estimates_eta=self._needs_regression),
            offset=self.offset,
            bounds=bounds,
            stated=stated,
            has_offset_key=is_output_error,
            irregular=self.irregular,
            closed_loop=self.closed_loop,
            window=math.inf if self.window is None else self.window,
            forgetting=math.inf if self.forgetting is None else self.forgetting,
        )

    # --- methods on the regression ---

    def _on_regression(self, source: IdentifierSource, begin: float) -> Component:
        from cosim.theory.estimators import least_squares

        design = source.regression
        recovery = least_squares.plan(design.terms, design.groups, design.delays)
        if self.method == "least-squares":
            from cosim.blocks.identifier import LeastSquaresIdentifier

            notes = _recovery_notes(recovery)
            metadata = {"P0": self.P0, "unknowns": recovery.n_eta, "notes": notes}
            source.context.add_metadata(source.identifier, metadata)
            return LeastSquaresIdentifier(recovery, start_time=begin, P0=self.P0)
        from cosim.blocks.adaptive_identifier import AdaptiveIdentifier

        source.context.add_metadata(source.identifier, {"method": self.method})
        is_gradient = self.method == "gradient"
        law = AdaptiveIdentifier(
            law="gradient" if is_gradient else "drem",
            recovery=recovery,
            start_time=begin,
            gain=self._number("gain"),
            forgetting=math.inf if is_gradient else self._number("forgetting"),
        )
        return Estimator(law)

    # --- methods on the design model ---

    def _of_model(
        self, source: IdentifierSource, observer: ObserverSource, begin: float
    ) -> Component:
        design = source.regression
        identified: IdentifiedPlant = source.context.identified[source.identifier]
        model, designed = observer.design
        modes, row = delta_transient(model.reduced, designed, observer.reconstruction)
        problem = IdentificationProblem(
            plant=identified.plant,
            modes=modes,
            row=row,
            rayleigh=rayleigh_constants(
                design.families, design.groups, design.terms, design.delays
            ),
            products=design.constants,
            alphas=design.alphas,
            families=design.families,
            stated=identified.stated,
            disturbances=len(design.members),
        )
        schedule = self._schedule(source, begin)
        limits = limits_of(identified.bounds, identified.parameters)
        match self.method:
            case "output-error":
                return self._by_output_error(source, problem.within(*limits), schedule, limits)
            case "projection":
                from cosim.blocks.projection_identifier import ProjectionIdentifier

                within = problem.within(*limits)
                return Estimator(ProjectionIdentifier(within, schedule, *limits))
            case "rayleigh":
                from cosim.blocks.projection_identifier import RayleighIdentifier

                return Estimator(RayleighIdentifier(problem, schedule))
        return self._kalman(problem, schedule)

    def _by_output_error(
        self,
        source: IdentifierSource,
        problem: IdentificationProblem,
        schedule: IdentificationSchedule,
        limits: tuple[Vector, Vector],
    ) -> Component:
        samplers = source.samplers.values()
        lower, upper = limits
        identifier = OutputErrorIdentifier(
            problem,
            schedule,
            offset=self.offset,
            lower=lower,
            upper=upper,
            most=source.most_samples(),
            at_points=all(kind.samples_at_points for kind in samplers),
        )
        late = max((kind.late_steps(source.context) for kind in samplers), default=0)
        if not late:
            return Estimator(identifier)
        from cosim.blocks.late_samples import LateSamples

        return LateSamples(Estimator(identifier), steps=late)

    def _kalman(
        self, problem: IdentificationProblem, schedule: IdentificationSchedule
    ) -> Component:
        from cosim.blocks.kalman_identifier import (
            AugmentedKalmanIdentifier,
            ExtendedKalmanIdentifier,
        )

        deviation = 1.0
        if self.covariance is None and not isinstance(self.deviation, tuple):
            deviation = self._number("deviation")
        else:
            outputs = len(problem.plant.C)
            stated = stated_covariance(self.deviation, self.covariance, outputs)
            problem = replace(problem, stated=stated)
        size = self._number("size")
        if self.method == "extended-kalman":
            extended = ExtendedKalmanIdentifier(problem=problem, deviation=deviation, size=size)
            return Estimator(extended)
        augmented = AugmentedKalmanIdentifier(
            problem=problem,
            schedule=schedule,
            deviation=deviation,
            size=size,
            intensity=self._number("intensity"),
        )
        return Estimator(augmented)

    def _schedule(self, source: IdentifierSource, begin: float) -> IdentificationSchedule:
        clock = source.context.clock
        step = clock.h
        gaps = np.diff(np.sort(np.array(source.regression.delays, np.float64)))
        window = 0
        if self.window is not None:
            window = whole_steps(self.window, clock.step_ns, f"window of {source.identifier!r}")
        lag = source.regression.lag
        if "delta" in METHODS[self.method].inputs:
            lag = source.context.lag(Port(source.identifier, "delta"))
        return IdentificationSchedule(
            period=self.period_steps(source.identifier, clock.step_ns),
            steps=clock.steps,
            average=max(1, round(0.5 * float(gaps.min()) / step)),
            window=window,
            forgetting=1.0 if self.forgetting is None else math.exp(-step / self.forgetting),
            start=begin,
            settled=clock.start_time + source.window,
            lag=lag,
        )

    # --- keys ---

    def _number(self, key: str) -> float:
        """Return a number of the method: the one given, or its default."""
        given = getattr(self, key)
        value = METHODS[self.method].own[key] if given is None else given
        return float(value)

    @property
    def _needs_regression(self) -> bool:
        """Whether theta rests on the regression, which else only gives a start, or nothing."""
        return self.method not in ("output-error", "extended-kalman")

    def _check_terms(self, design: RegressorDesign) -> None:
        """Check that the method can do with these terms, and with their regression."""
        of_method = f'method = "{self.method}"'
        has_parameters = any(family.parameters for family in design.families)
        if not has_parameters and self.method not in ("output-error", "projection"):
            names = ", ".join(sorted({family.name for family in design.families}))
            raise UsageError(
                f"{of_method}: the terms ({names}) have no parameter to estimate; for "
                'their amplitudes use method = "output-error" or "projection"'
            )
        problem = ""
        if design.has_several and self.method != "output-error":
            problem = f"expected terms of one element of delta, got {len(design.members)}"
        elif self.method in LINEAR_METHODS:
            problem = regression.linear_route_problem(design.sizes)
        elif self.method in ("rayleigh", "projection") and not design.is_expanded:
            terms = regression.count_terms(design.sizes)
            problem = f"expected at most {MOST_TERMS} terms of the regression, got {terms}"
        if problem:
            raise AssumptionError(
                f'{of_method}: {problem}; method = "output-error" needs no regression'
            )

    def _check_options(self) -> None:
        for key in foreign_keys(METHODS, self.method):
            if key in self.model_fields_set:
                own = ", ".join(METHODS[self.method].own)
                listed = f"; available: {own}" if own else ""
                raise UsageError(f"{key}: not an option of method {self.method!r}{listed}")
        if self.window is not None and self.forgetting is not None:
            raise UsageError("expected at most one of window and forgetting, got both")

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        from cosim.blocks.identifier import LeastSquaresMethod
        from cosim.blocks.late_samples import LateSamples
        from cosim.fmi.exporting import kernels
        from cosim.fmi.exporting.identifier import output_error

        component, units = self._built(name, context)
        if isinstance(component, LateSamples):
            raise UsageError(
                f"{name!r}: samples with time stamps arrive late, which an exported identifier "
                "does not support; expected a sensor without time_stamps"
            )
        assert isinstance(component, Estimator)
        method = component.method
        every = self.period_steps(name, context.step_ns)
        h = context.h
        if isinstance(method, LeastSquaresMethod):
            design = method.design(h, wiring.held)
            kernel = kernels.least_squares(method.constants(wiring.held, design))
        elif isinstance(method, OutputErrorIdentifier):
            design = method.design(h, wiring.held)
            kernel = output_error(method.constants(h, wiring.held, design))
        else:
            raise UsageError(
                f'{name!r}: an identifier with method = "{self.method}" cannot be exported; '
                'available: "output-error", "least-squares"'
            )
        reason = "the identifier is a discrete-time component"
        return kernels.DiscreteModel(
            self.with_period(with_units(component, units), every).interface,
            kernel,
            context.step_ns,
            reason,
            steps_per_sample=every,
        )


def _recovery_notes(recovery: Recovery) -> list[str]:
    """Return what the recovery of theta cannot distinguish."""
    from cosim.theory.estimators.least_squares import RecoveryKind

    notes = []
    for group in recovery.groups:
        names = ", ".join(f"theta[{i}]" for i in group.theta)
        if math.isfinite(group.limit):
            notes.append(
                f"{names}: a rate above {group.limit:.4g} rad/s is taken for a slower one "
                f"(delays {group.spacing:g} s apart)"
            )
        if group.kind is RecoveryKind.EXPONENTIALS:
            notes.append(f"{names}: two exponentials under one alpha come back the larger first")
    return notes
