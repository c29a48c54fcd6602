"""Regressor and identifier: from the reconstructed disturbance to its parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from cosim.blocks.identifier import LeastSquaresIdentifier
from cosim.blocks.regressor import Regressor
from cosim.blocks.sampled import Decimated
from cosim.core.clock import LARGEST_NS, whole_steps
from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.errors import AssumptionError, UsageError
from cosim.fmi.exporting import kernels
from cosim.fmi.exporting.kernels import DiscreteModel
from cosim.fmi.exporting.specifications import Exportable
from cosim.native.expression import Program, compile_expression
from cosim.native.step import evaluate_at
from cosim.scenario.kinds.base import (
    BuildContext,
    ExportableKind,
    PeriodicKind,
    Wiring,
)
from cosim.scenario.kinds.jumps import check_continuous
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.schema import Number, NumberRow, TomlTable
from cosim.theory import observer, regression
from cosim.theory.disturbance import AlphaGroup, family_named, group_by_alpha
from cosim.theory.estimators import least_squares

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
        return Regressor(terms, alphas=programs, steps=steps, delays=self.delays)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        component = self.build(name, context)
        kernel = kernels.regressor(component.constants)
        reason = (
            "the regressor multiplies samples of the past, so it lives at the communication points "
            "and has no derivatives"
        )
        return DiscreteModel(component.interface, kernel, context.step_ns, reason)

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


class IdentifierKind(PeriodicKind, ExportableKind):
    """Identifier of theta by least squares (33)-(35)."""

    ports: ClassVar[str] = "regressor -> theta, eta"
    kind: Literal["identifier"]
    method: Literal["least-squares"] = Field(description='how theta is estimated: "least-squares"')
    P0: Number | None = Field(None, description="P(0) = P0 I (34); default: no prior")
    start: Number | StartTable = Field(
        description="T_id [s], or { epsilon_observer, epsilon_filter } for (36)-(38)"
    )

    def with_period(self, component: Component, n: int) -> Component:
        return component if n == 1 else Decimated(component, n)

    def build(self, name: str, context: BuildContext) -> LeastSquaresIdentifier:
        source_name = context.driver(Port(name, "regressor"))
        spec = None if source_name is None else context.spec(source_name)
        if source_name is None or not isinstance(spec, RegressorKind):
            raise UsageError(
                "'regressor' must be driven directly by a component of kind 'regressor', "
                "whose terms it identifies"
            )
        groups, terms = spec.regression()
        spec.steps(context)
        recovery = least_squares.plan(terms, groups, spec.delays)
        start_time = self._start_time(name, source_name, spec, context)
        metadata = {
            "P0": self.P0,
            "unknowns": recovery.n_eta,
            "notes": _recovery_notes(recovery),
        }
        context.add_metadata(name, metadata)
        return LeastSquaresIdentifier(recovery, start_time=start_time, P0=self.P0)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        component = self.build(name, context)
        every = self.period_steps(name, context.step_ns)
        held = bool(wiring.held.any())
        kernel = kernels.least_squares(component.constants(component.start_time, held=held))
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
        if isinstance(self.start, StartTable):
            T_id = self._computed_start_time(self.start, name, regressor_name, regressor, context)
            elapsed_ns = T_id * 1e9
        else:
            T_id = float(self.start)
            elapsed_ns = T_id * 1e9 - clock.start_ns
        # Rounded to 1e-3 ns: a T_id on a communication point must not become the next one.
        elapsed_ns = round(elapsed_ns, 3)
        longest = max(regressor.delays)
        if elapsed_ns < round(longest * 1e9, 3):
            since = f" after start_time, {clock.start_time} s" if clock.start_ns else ""
            raise AssumptionError(
                f"start: found {T_id} s, needed at least the longest delay, {longest} s{since}: "
                "before it the regressor has no value"
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

    def _computed_start_time(
        self,
        start: StartTable,
        name: str,
        regressor_name: str,
        regressor: RegressorKind,
        context: BuildContext,
    ) -> float:
        """Compute T_id (36)-(38) from the observer that drives the regressor."""
        observer_name = context.driver(Port(regressor_name, "delta"))
        spec = None if observer_name is None else context.spec(observer_name)
        if observer_name is None or not isinstance(spec, UnknownInputObserverKind):
            raise UsageError(
                "start: (36)-(38) need one observer that drives the regressor alone; "
                "give start as a time in s instead"
            )
        designed = spec.design(observer_name, context)
        times = observer.identification_start_time(
            lambda_obs=designed.design.lambda_obs,
            filter_rate=spec.filter_rate,
            delays=regressor.delays,
            epsilon_observer=start.epsilon_observer,
            epsilon_filter=start.epsilon_filter,
        )
        context.add_metadata(name, asdict(times))
        return times.T_id


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
