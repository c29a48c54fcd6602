"""Regressor and identifier: from the reconstructed disturbance to its parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from cosim.arrays import Vector
from cosim.blocks.adaptive_identifier import AdaptiveIdentifier
from cosim.blocks.declared import with_units
from cosim.blocks.estimator import Estimator
from cosim.blocks.field_data import SAMPLE_TIMES
from cosim.blocks.identifier import LeastSquaresIdentifier
from cosim.blocks.kalman_identifier import AugmentedKalmanIdentifier, ExtendedKalmanIdentifier
from cosim.blocks.output_error_identifier import (
    IdentificationProblem,
    IdentificationSchedule,
    OutputErrorIdentifier,
)
from cosim.blocks.projection_identifier import ProjectionIdentifier, RayleighIdentifier
from cosim.blocks.regressor import Regressor
from cosim.blocks.sampled import Decimated
from cosim.core.clock import LARGEST_NS, whole_steps
from cosim.core.connections import Connection
from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.signals import Interface
from cosim.errors import AssumptionError, UsageError
from cosim.fmi.exporting import kernels
from cosim.fmi.exporting.identifier import output_error
from cosim.fmi.exporting.kernels import DiscreteModel
from cosim.fmi.exporting.specifications import Exportable
from cosim.native.expression import Program, compile_expression
from cosim.native.step import evaluate_at
from cosim.scenario.identified import IdentifiedPlant
from cosim.scenario.kinds.base import (
    BuildContext,
    ExportableKind,
    Kind,
    PeriodicKind,
    Spectrum,
    Wiring,
)
from cosim.scenario.kinds.field_data import FieldDataKind
from cosim.scenario.kinds.jumps import check_continuous
from cosim.scenario.kinds.methods import INPUTS, OPTIONS, IdentificationMethod, all_options
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.schema import Flag, Number, NumberRow, NumberRows, TomlTable
from cosim.theory import observer, regression
from cosim.theory.accuracy import check_step
from cosim.theory.disturbance import AlphaGroup, family_named, group_by_alpha
from cosim.theory.disturbed_plant import disturbed_plant, white_noise
from cosim.theory.estimators import augmented_kalman, drem, extended_kalman, gradient, least_squares
from cosim.theory.estimators.rayleigh import rayleigh_box, rayleigh_constants

ALPHA_WAY_OUT = (
    "needed a continuous alpha: the regression multiplies alphas of different instants, "
    "which must jump together with the reconstructed disturbance"
)


class RegressorTerm(TomlTable):
    """One term of the disturbance class (4), its parameter unknown."""

    alpha: str = Field("1", description="known function of t")
    family: str = Field(description="exponential or sine")


class RegressorKind(ExportableKind):
    """From delta to the known signals mu of the regression (21)-(25)."""

    ports: ClassVar[str] = "delta -> mu"
    kind: Literal["regressor"]
    terms: tuple[RegressorTerm, ...] = Field(description="list of { alpha, family }")
    delays: NumberRow = Field(
        description="D_j [s], one more than basis functions, whole communication steps"
    )

    def build(self, name: str, context: BuildContext) -> Regressor:
        groups, terms = self.regression()
        steps = self.steps(context)
        alphas = [group.alpha for group in groups]
        for alpha in alphas:
            check_continuous(alpha, context.clock, ALPHA_WAY_OUT)
        programs = [compile_expression(alpha) for alpha in alphas]
        if len(groups) > 1:
            regression.check_alpha_products(terms, self._alphas(programs), alphas)
        warning = regression.linear_route_warning([group.size for group in groups])
        if warning:
            context.warn(name, warning)
        lag = context.lag(Port(name, "delta"))
        if lag:
            context.add_metadata(name, {"lag": lag})
        return Regressor(terms, alphas=programs, steps=steps, delays=self.delays, lag=lag)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        component = self.build(name, context)
        kernel = kernels.regressor(component.constants)
        reason = (
            "the regressor multiplies samples of the past, so it lives at the communication points "
            "and has no derivatives"
        )
        return DiscreteModel(component.interface, kernel, context.step_ns, reason)

    def spectrum(self) -> Spectrum | None:
        """Return amplitude and bandwidth of alpha, for exponentials, whose rates are real."""
        if any(term.family != "exponential" for term in self.terms):
            return None
        alphas = sorted({term.alpha for term in self.terms})
        times: Vector = np.arange(512.0) * (math.sqrt(2.0) / 7.0)  # no period divides them
        measured = [_rms_and_rate(compile_expression(alpha), times) for alpha in alphas]
        amplitude = math.sqrt(sum(rms**2 for rms, _ in measured))
        bandwidth = max(rate for _, rate in measured)
        if not (math.isfinite(amplitude) and 0.0 < bandwidth < math.inf):
            return None
        return Spectrum(
            amplitude,
            bandwidth,
            source={"alpha": alphas},
            assumption="amplitude and bandwidth of delta are those of alpha: each exponential of "
            "size 1, and slower than alpha",
        )

    def steps(self, context: BuildContext) -> list[int]:
        """Return the delays in communication steps."""
        steps = []
        for j, delay in enumerate(self.delays):
            steps.append(whole_steps(delay, context.step_ns, f"delays[{j}]"))
        return steps

    def regression(self) -> tuple[tuple[AlphaGroup, ...], tuple[regression.Term, ...]]:
        """Expand the determinant for the given terms."""
        families = [family_named(term.family) for term in self.terms]
        groups = group_by_alpha([term.alpha for term in self.terms], families)
        sizes = tuple(group.size for group in groups)
        regression.check_delays(self.delays, sum(sizes) + 1)
        return groups, regression.expand(sizes)

    def _alphas(self, programs: Sequence[Program]) -> NDArray[np.float64]:
        """Sample alpha_b(t - D_j) on a grid that no period of the alphas divides."""
        grid = np.arange(512) * math.sqrt(2.0) / 7.0
        times = grid[:, np.newaxis] - np.array(self.delays)
        values = evaluate_at(programs, times.ravel())
        return values.reshape(*times.shape, len(programs))


class StartTable(TomlTable):
    """Identification start time T_id by (36)-(38)."""

    epsilon_observer: Number = Field(
        description="fraction of the initial observer error that may remain, in (0, 1)"
    )
    epsilon_filter: Number = Field(
        description="fraction of the initial filter transient that may remain, in (0, 1)"
    )


DEFAULT_START = StartTable(epsilon_observer=1e-3, epsilon_filter=1e-3)


class IdentifierKind(PeriodicKind, ExportableKind):
    """Identifier of theta, by output error, least squares (33)-(35), or another method."""

    ports: ClassVar[str] = "regressor, delta, y, u -> theta, standard_error, deviation, amplitude"
    kind: Literal["identifier"]
    method: IdentificationMethod = Field(
        "output-error",
        description='how theta is estimated: "output-error" from y, at the Cramer-Rao bound where '
        'the noise is white, or "least-squares" from the regression, as in the paper '
        "(regressor -> theta, eta), which noise makes wrong; for comparison on the same data its "
        'first stages, "rayleigh" (regressor -> theta) and "projection" (regressor, delta -> '
        'theta, amplitude), the Kalman filters "augmented-kalman" of x and delta, smoothed (y, u '
        '-> theta), and "extended-kalman" of x, disturbance and theta (y, u -> theta, '
        'standard_error), and the adaptive laws "gradient" and "drem" (regressor -> theta, '
        "eta)",
    )
    P0: Number | None = Field(
        None, description="of least-squares: P(0) = P0 I (34); default: no prior"
    )
    start: Number | StartTable | None = Field(
        None,
        description="T_id [s], or { epsilon_observer, epsilon_filter } for (36)-(38); "
        "default: 1e-3 each",
    )
    offset: Flag = Field(
        False, description="of output-error: an unknown constant is on every output"
    )
    window: Number | None = Field(
        None,
        description="of output-error and projection: length of a moving window [s]; default: all "
        "samples",
    )
    forgetting: Number | None = Field(
        None,
        description="of output-error and drem: time constant in which samples lose their weight "
        f"[s]; default: they keep it, of drem {drem.FORGETTING:g}",
    )
    gain: Number | None = Field(
        None,
        description="of gradient and drem: rate at which eta follows [1/s]; default: "
        f"{gradient.GAIN:g}, of drem {drem.GAIN:g}",
    )
    deviation: Number | None = Field(
        None,
        description="of the Kalman filters: standard deviation of the noise of y; default: "
        f"{augmented_kalman.DEVIATION:g}, of extended-kalman {extended_kalman.DEVIATION:g}, more "
        "than the noise, for what its linearization errs",
    )
    size: Number | None = Field(
        None,
        description="of the Kalman filters: how large x and the disturbance may be at first; "
        f"default: {extended_kalman.SIZE:g}",
    )
    intensity: Number | None = Field(
        None,
        description="of augmented-kalman: spectral density of the second derivative of delta; "
        f"default: {augmented_kalman.INTENSITY:g}",
    )
    bounds: NumberRows | None = Field(
        None,
        description="of output-error and projection: [lower, upper] for every theta, inf where "
        "there is none; "
        "equal ones fix it",
    )

    def with_period(self, component: Component, n: int) -> Component:
        return component if n == 1 else Decimated(component, n)

    def implied_connections(
        self, name: str, connections: Mapping[Port, Connection], specs: Mapping[str, Kind]
    ) -> Mapping[Port, Connection]:
        """Return what drives the observer: a method takes the same signals.

        Where y has samples at times of their own, these too.
        """
        inputs = INPUTS[self.method]
        if not inputs:
            return {}
        regressor = _driver(connections, Port(name, "regressor"))
        if regressor is None:
            return {}
        observer_name = _driver(connections, Port(regressor, "delta"))
        taken = {(regressor, "delta"), (observer_name, "y"), (observer_name, "u")}
        implied = {}
        for to, connection in connections.items():
            if to.signal in inputs and (to.component, to.signal) in taken:
                implied[replace(to, component=name)] = connection
        y = Port(name, "y")
        if self.method == "output-error":
            implied |= _samples(name, connections.get(y) or implied.get(y), specs)
        return implied

    def build(self, name: str, context: BuildContext) -> Component:
        self._check_options()
        source_name = context.driver(Port(name, "regressor"))
        spec = None if source_name is None else context.spec(source_name)
        if source_name is None or not isinstance(spec, RegressorKind):
            raise UsageError(
                "'regressor' must be driven directly by a component of kind 'regressor', "
                "whose terms it identifies"
            )
        spec.steps(context)
        self._check_step(spec, context)
        start_time = self._start_time(name, source_name, spec, context)
        self._add_identified(name, source_name, spec, context)
        if self.method == "least-squares":
            return self._least_squares(name, spec, start_time, context)
        context.add_metadata(name, {"method": self.method})
        if self.method in ("gradient", "drem"):
            return self._adaptive(spec, start_time)
        problem = self._problem(source_name, spec, context)
        schedule = self._schedule(name, source_name, spec, start_time, context)
        if self.method == "output-error":
            most = self._most_samples(name, context)
            identifier: Component = self._output_error(problem, schedule, most)
        else:
            identifier = self._baseline(problem, schedule)
        units = self._units_of_observer(source_name, identifier.interface, context)
        return with_units(identifier, units)

    def _output_error(
        self, problem: IdentificationProblem, schedule: IdentificationSchedule, most: int
    ) -> OutputErrorIdentifier:
        lower, upper = self._bounds(problem.rayleigh.generators.parameters)
        return OutputErrorIdentifier(
            problem.within(lower, upper),
            schedule,
            offset=self.offset,
            lower=lower,
            upper=upper,
            most=most,
        )

    def _baseline(
        self, problem: IdentificationProblem, schedule: IdentificationSchedule
    ) -> Component:
        """Return a method that needs the design model, for comparison with output error."""
        if self.method == "rayleigh":
            return Estimator(RayleighIdentifier(problem, schedule))
        if self.method == "projection":
            lower, upper = self._bounds(problem.rayleigh.generators.parameters)
            within = problem.within(lower, upper)
            return Estimator(ProjectionIdentifier(within, schedule, lower, upper))
        if self.method == "extended-kalman":
            extended = ExtendedKalmanIdentifier(
                problem=problem, deviation=self._number("deviation"), size=self._number("size")
            )
            return Estimator(extended)
        augmented = AugmentedKalmanIdentifier(
            problem=problem,
            schedule=schedule,
            deviation=self._number("deviation"),
            size=self._number("size"),
            intensity=self._number("intensity"),
        )
        return Estimator(augmented)

    def _least_squares(
        self, name: str, spec: RegressorKind, start_time: float, context: BuildContext
    ) -> LeastSquaresIdentifier:
        groups, terms = spec.regression()
        recovery = least_squares.plan(terms, groups, spec.delays)
        metadata = {
            "P0": self.P0,
            "unknowns": recovery.n_eta,
            "notes": _recovery_notes(recovery),
        }
        context.add_metadata(name, metadata)
        return LeastSquaresIdentifier(recovery, start_time=start_time, P0=self.P0)

    def _adaptive(self, spec: RegressorKind, start_time: float) -> Estimator[Vector]:
        groups, terms = spec.regression()
        recovery = least_squares.plan(terms, groups, spec.delays)
        is_gradient = self.method == "gradient"
        law = AdaptiveIdentifier(
            law="gradient" if is_gradient else "drem",
            recovery=recovery,
            start_time=start_time,
            gain=self._number("gain"),
            forgetting=math.inf if is_gradient else self._number("forgetting"),
        )
        return Estimator(law)

    def _number(self, key: str) -> float:
        """Return a number of the method: the one given, or its default."""
        given = getattr(self, key)
        value = OPTIONS[self.method][key] if given is None else given
        return float(value)

    def _schedule(
        self,
        name: str,
        regressor_name: str,
        spec: RegressorKind,
        start_time: float,
        context: BuildContext,
    ) -> IdentificationSchedule:
        clock = context.clock
        step = clock.step_ns / 1e9
        gaps = np.diff(np.sort(np.array(spec.delays, np.float64)))
        half_gap = 0.5 * float(gaps.min())
        return IdentificationSchedule(
            period=self.period_steps(name, context.step_ns),
            steps=clock.steps,
            average=max(1, round(half_gap / step)),
            window=self._window_steps(name, context.step_ns),
            forgetting=1.0 if self.forgetting is None else math.exp(-step / self.forgetting),
            start=start_time,
            settled=clock.start_time + self._window(regressor_name, context),
            lag=context.lag(Port(name, "delta")),
        )

    def _units_of_observer(
        self, regressor_name: str, interface: Interface, context: BuildContext
    ) -> dict[str, str]:
        """Return the units of the signals that are taken where the observer takes them."""
        found = _observer_of(regressor_name, context)
        assert found is not None
        observer_name, spec = found
        designed = spec.design(observer_name, context).model.units
        named = {signal: unit.name for signal, unit in designed.items() if unit.name is not None}
        named |= spec.units
        units = {}
        for signal in interface.inputs:
            of_observer = "y" if signal.name == "samples" else signal.name
            if of_observer in named:
                units[signal.name] = named[of_observer]
        return units

    def _most_samples(self, name: str, context: BuildContext) -> int:
        """Return how many samples of y are taken in a step; 0: y at the communication points.

        Raises
        ------
        UsageError
            If y is interpolated between samples of a file that do not reach the identifier.
        """
        sampled_by = context.driver(Port(name, "samples"))
        if sampled_by is not None:
            spec = context.spec(sampled_by)
            if isinstance(spec, FieldDataKind):
                return spec.most_in_a_step(sampled_by, context)
        interpolated = _field_data_behind(Port(name, "y"), context)
        if interpolated is not None:
            raise UsageError(
                f"y is interpolated between the samples of {interpolated!r}; needed it from whole "
                "outputs of one such component, directly, with one number as gain or none: then "
                "the samples are taken at their own times"
            )
        return 0

    def _problem(
        self, regressor_name: str, spec: RegressorKind, context: BuildContext
    ) -> IdentificationProblem:
        found = _observer_of(regressor_name, context)
        if found is None:
            raise UsageError(
                f'method = "{self.method}" needs one observer that drives the regressor alone: its '
                "design model is that of y"
            )
        observer_name, designed_by = found
        designed = designed_by.design(observer_name, context)
        reduced = designed.model.reduced
        n_d = reduced.C5.shape[1]
        if n_d != 1 or designed.model.constant:
            what = f"{n_d} unknown disturbances" if n_d != 1 else "a constant input"
            raise UsageError(
                f'method = "{self.method}": the design model of {observer_name!r} has {what}; '
                'needed one disturbance and no constant input; or method = "least-squares"'
            )
        groups, terms = spec.regression()
        families = [family_named(term.family) for term in spec.terms]
        clock = context.clock
        span = clock.steps * clock.step_ns / 1e9
        constants = rayleigh_constants(families, groups, terms, spec.delays, span=span)
        transient = designed_by.transient(observer_name, context)
        component = spec.build(regressor_name, context)
        return IdentificationProblem(
            plant=disturbed_plant(reduced, len(families)),
            modes=transient.A,
            row=transient.C[0],
            rayleigh=constants,
            products=component.constants,
            alphas=[compile_expression(term.alpha) for term in spec.terms],
            box=rayleigh_box(families, spec.delays, span=span),
            noise=white_noise(len(reduced.C3)),
        )

    def _check_step(self, spec: RegressorKind, context: BuildContext) -> None:
        """Refuse a communication step between whose ends an alpha is no straight line."""
        clock = context.clock
        alphas = [term.alpha for term in spec.terms]
        programs = [compile_expression(alpha) for alpha in alphas]
        check_step(
            lambda t: evaluate_at(programs, t),
            alphas,
            start=clock.start_time,
            stop=clock.stop,
            h=clock.step_ns / 1e9,
        )

    def _add_identified(
        self, name: str, regressor_name: str, spec: RegressorKind, context: BuildContext
    ) -> None:
        """Have the estimates judged, where the design model is one that output error can fit."""
        found = _observer_of(regressor_name, context)
        if found is None:
            return
        observer_name, designed_by = found
        designed = designed_by.design(observer_name, context)
        reduced = designed.model.reduced
        if reduced.C5.shape[1] != 1 or designed.model.constant:
            return
        families = [family_named(term.family) for term in spec.terms]
        bounds = {}
        for j, row in enumerate(self.bounds or ()):
            bounds[j] = (float(row[0]), float(row[1]))
        problem = ""
        interpolated = _field_data_behind(Port(observer_name, "y"), context)
        if self.method != "output-error" and interpolated is not None:
            problem = (
                f"y is interpolated between the samples of {interpolated!r}; only method = "
                '"output-error" takes the samples, and only its estimates are judged'
            )
            context.warn(name, problem)
        identified = IdentifiedPlant(
            problem=problem,
            observer=observer_name,
            plant=disturbed_plant(reduced, len(families)),
            families=families,
            alphas=[compile_expression(term.alpha) for term in spec.terms],
            offset=self.offset,
            bounds=bounds,
        )
        context.add_identified(name, identified)

    def _check_options(self) -> None:
        own = OPTIONS[self.method]
        for key in all_options():
            if key in self.model_fields_set and key not in own:
                listed = f"; its own: {', '.join(own)}" if own else ""
                raise UsageError(f"{key}: not of method {self.method!r}; leave it out{listed}")
        if self.window is not None and self.forgetting is not None:
            raise UsageError("found both window and forgetting; needed one of them, or none")
        for key in ("window", "forgetting"):
            value = getattr(self, key)
            if value is not None and not 0.0 < value < math.inf:
                raise UsageError(f"{key}: found {value} s, needed a positive finite time")

    def _window_steps(self, name: str, step_ns: int) -> int:
        if self.window is None:
            return 0
        return whole_steps(self.window, step_ns, f"window of {name!r}")

    def _bounds(self, parameters: int) -> tuple[Vector, Vector]:
        if self.bounds is None:
            return np.full(parameters, -np.inf), np.full(parameters, np.inf)
        rows = [row for row in self.bounds if len(row) == 2 and row[0] <= row[1]]
        if len(rows) != parameters or len(self.bounds) != parameters:
            raise UsageError(
                f"bounds: found {[list(row) for row in self.bounds]}; needed [lower, upper] for "
                f"each of the {parameters} parameters"
            )
        pairs = np.array(rows, np.float64)
        return pairs[:, 0].copy(), pairs[:, 1].copy()

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        component = self.build(name, context)
        every = self.period_steps(name, context.step_ns)
        if isinstance(component, LeastSquaresIdentifier):
            held = bool(wiring.held.any())
            kernel = kernels.least_squares(component.constants(component.start_time, held=held))
        elif isinstance(component, OutputErrorIdentifier):
            kernel = output_error(component.constants(context.step_ns / 1e9, wiring.held))
        else:
            raise UsageError(
                f'{name!r}: an identifier with method = "{self.method}" cannot be exported yet; '
                'possible: method = "output-error" or "least-squares"'
            )
        reason = (
            "the identifier takes one row at every communication point, so it has no derivatives"
        )
        return DiscreteModel(
            self.with_period(component, every).interface,
            kernel,
            context.step_ns,
            reason,
            steps_per_sample=every,
        )

    def _start_time(
        self, name: str, regressor_name: str, regressor: RegressorKind, context: BuildContext
    ) -> float:
        """Return the first communication point not before T_id.

        A computed T_id is counted from the start of the run.
        """
        clock = context.clock
        start = DEFAULT_START if self.start is None else self.start
        if isinstance(start, StartTable):
            T_id = self._computed_start_time(start, name, regressor_name, regressor, context)
            elapsed_ns = T_id * 1e9
        else:
            T_id = float(start)
            elapsed_ns = T_id * 1e9 - clock.start_ns
        # Rounded to 1e-3 ns: a T_id on a communication point must not become the next one.
        elapsed_ns = round(elapsed_ns, 3)
        longest = max(regressor.delays)
        window = self._window(regressor_name, context)
        if elapsed_ns < round((longest + window) * 1e9, 3):
            since = f" after start_time, {clock.start_time} s" if clock.start_ns else ""
            plus = f" and the observer's window, {window} s," if window else ""
            raise AssumptionError(
                f"start: found {T_id} s, needed at least the longest delay, {longest} s{plus}"
                f"{since}: before it the regressor has no value"
            )
        if not T_id <= LARGEST_NS / 1e9:
            raise AssumptionError(
                f"start: T_id is {T_id:g} s; needed a time in a run: with computed times, a larger "
                "filter_rate, eigenvalues of the observer farther left, or larger fractions"
            )
        steps = math.ceil(elapsed_ns / clock.step_ns)
        start_time = (clock.start_ns + steps * clock.step_ns) / 1e9
        context.add_metadata(name, {"start_time": start_time})
        return start_time

    def _window(self, regressor_name: str, context: BuildContext) -> float:
        """Return how long the observer that drives the regressor has no delta [s]."""
        found = _observer_of(regressor_name, context)
        if found is None:
            return 0.0
        observer_name, spec = found
        return spec.reconstruction(observer_name, context).window

    def _computed_start_time(
        self,
        start: StartTable,
        name: str,
        regressor_name: str,
        regressor: RegressorKind,
        context: BuildContext,
    ) -> float:
        """Compute T_id (36)-(38) from the observer that drives the regressor."""
        found = _observer_of(regressor_name, context)
        if found is None:
            raise UsageError(
                "start: (36)-(38) need one observer that drives the regressor alone; "
                "give start as a time in s instead"
            )
        observer_name, spec = found
        designed = spec.design(observer_name, context)
        window = spec.reconstruction(observer_name, context).window
        times = observer.identification_start_time(
            lambda_obs=designed.design.lambda_obs,
            filter_rate=None if window else spec.filter_rate,
            window=window or None,
            delays=regressor.delays,
            epsilon_observer=start.epsilon_observer,
            epsilon_filter=start.epsilon_filter,
        )
        context.add_metadata(name, asdict(times))
        return times.T_id


def _rms_and_rate(alpha: Program, times: Vector) -> tuple[float, float]:
    """Return the root mean square of alpha, and the rate of a sine with its derivatives [rad/s].

    That is the ratio of its second derivative to its first, from differences.
    """
    h = 1e-4
    rows = [evaluate_at([alpha], times + shift)[:, 0] for shift in (-h, 0.0, h)]
    before, now, after = rows
    first = (after - before) / (2.0 * h)
    second = (after - 2.0 * now + before) / h**2
    rms = float(np.sqrt(np.mean(now**2)))
    slope = float(np.mean(first**2))
    curvature = float(np.mean(second**2))
    rate = math.sqrt(curvature / slope) if slope > 0.0 else 0.0
    return rms, rate


def _recovery_notes(recovery: least_squares.Recovery) -> list[str]:
    """Return what the recovery of theta cannot distinguish."""
    notes = []
    for group in recovery.groups:
        names = ", ".join(f"theta[{i}]" for i in group.theta)
        if group.kind is least_squares.RecoveryKind.SINE:
            notes.append(
                f"{names}: a rate above {group.limit:.4g} rad/s is taken for a slower one "
                f"(delays {group.spacing:g} s apart)"
            )
        if group.kind is least_squares.RecoveryKind.EXPONENTIALS:
            notes.append(f"{names}: two exponentials under one alpha come back the larger first")
    return notes


def _samples(name: str, y: Connection | None, specs: Mapping[str, Kind]) -> dict[Port, Connection]:
    """Return the connections to the samples of what drives y, where it has any.

    Those of several elements stand one element behind the other, as the elements do in y.
    """
    if y is None or y.matrix.ndim:
        return {}
    components = {source.component for source in y.sources}
    sampled = []
    for source in y.sources:
        spec = specs.get(source.component)
        signal = None if spec is None else spec.samples_of(source.signal)
        if signal is not None and source.element is None:
            sampled.append(Port(source.component, signal))
    if len(sampled) < len(y.sources) or len(components) != 1:
        return {}
    return {
        Port(name, "samples"): Connection(sampled, y.gain, y.offset, y.unit),
        Port(name, SAMPLE_TIMES): Connection(Port(components.pop(), SAMPLE_TIMES)),
    }


def _field_data_behind(to: Port, context: BuildContext) -> str | None:
    """Return the component of field data that an input follows; None: there is none."""
    for name, spec in context.behind(to).items():
        if isinstance(spec, FieldDataKind):
            return name
    return None


def _observer_of(
    regressor_name: str, context: BuildContext
) -> tuple[str, UnknownInputObserverKind] | None:
    """Return the observer that drives a regressor alone; None: there is no such component."""
    name = context.driver(Port(regressor_name, "delta"))
    spec = None if name is None else context.spec(name)
    if name is None or not isinstance(spec, UnknownInputObserverKind):
        return None
    return name, spec


def _driver(connections: Mapping[Port, Connection], to: Port) -> str | None:
    """Return the component that drives an input alone; None: there is no such component."""
    drivers: set[str] = set()
    for port, connection in connections.items():
        if port.whole == to:
            drivers.update(source.component for source in connection.sources)
    return drivers.pop() if len(drivers) == 1 else None
