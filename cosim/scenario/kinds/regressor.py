"""The regressor: known signals of the regression, from the reconstructed disturbance."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cosim.arrays import Vector
from cosim.blocks.regressor import Regressor
from cosim.core.clock import whole_steps
from cosim.core.port import Port
from cosim.errors import UsageError
from cosim.fmi.exporting import kernels
from cosim.fmi.exporting.kernels import DiscreteModel
from cosim.fmi.exporting.specifications import Exportable
from cosim.native.expression import Program, compile_expression
from cosim.native.step import evaluate_at
from cosim.scenario.kinds.base import BuildContext, ExportableKind, Spectrum, Wiring
from cosim.scenario.kinds.finite_values import check_finite
from cosim.scenario.kinds.jumps import check_continuous
from cosim.scenario.kinds.terms import FamilyTerm, element_count, families_of
from cosim.scenario.schema import NumberRow
from cosim.theory import regression
from cosim.theory.disturbance import AlphaGroup, Family, group_by_alpha

ALPHA_WAY_OUT = (
    "needed a continuous alpha: the regression multiplies alphas of different instants, "
    "which must jump together with the reconstructed disturbance"
)


@dataclass(frozen=True, eq=False, kw_only=True)
class RegressorDesign:
    """The regression of a disturbance class, its alphas compiled.

    Parameters
    ----------
    families : sequence of Family
        Of the components of the disturbance.
    alphas : sequence of Program
        The known factor of each.
    groups : sequence of AlphaGroup
        The components that share an alpha.
    terms : sequence of Term
        The expansion of the determinant.
    steps : sequence of int
        The delays in communication steps.
    delays : sequence of float
        The delays [s].
    lag : float
        How far delta lags behind the disturbance [s].
    """

    families: Sequence[Family]
    alphas: Sequence[Program]
    groups: Sequence[AlphaGroup]
    terms: Sequence[regression.Term]
    steps: Sequence[int]
    delays: Sequence[float]
    lag: float

    @property
    def group_alphas(self) -> list[Program]:
        """The alpha of each group."""
        return [self.alphas[group.components[0]] for group in self.groups]

    def component(self) -> Regressor:
        """Return a component that makes the signals of the regression."""
        return Regressor(
            self.terms,
            alphas=self.group_alphas,
            steps=self.steps,
            delays=self.delays,
            lag=self.lag,
        )


class RegressorKind(ExportableKind):
    """From delta to the known signals mu of the regression (21)-(25)."""

    ports: ClassVar[str] = "delta -> mu"
    kind: Literal["regressor"]
    terms: tuple[FamilyTerm, ...] = Field(
        min_length=1, description="list of { alpha, family } and settings of the family"
    )
    delays: NumberRow = Field(
        description="D_j [s], one more than basis functions, whole communication steps"
    )

    def build(self, name: str, context: BuildContext) -> Regressor:
        design = self.design(name, context)
        sizes = [group.size for group in design.groups]
        warning = regression.linear_route_warning(sizes)
        if warning:
            context.warn(name, warning)
        if design.lag:
            context.add_metadata(name, {"lag": design.lag})
        return design.component()

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

    def design(self, name: str, context: BuildContext) -> RegressorDesign:
        """Return the regression of the given terms."""
        return context.designed(name, lambda: self._designed(name, context))

    def _designed(self, name: str, context: BuildContext) -> RegressorDesign:
        families = families_of(self.terms)
        if element_count(self.terms) > 1:
            raise UsageError(
                "terms: found some of element 1 or more; needed all of element 0, as a regression "
                "of several elements is not possible yet"
            )
        groups = group_by_alpha([term.alpha for term in self.terms], families)
        sizes = tuple(group.size for group in groups)
        regression.check_delays(self.delays, sum(sizes) + 1)
        terms = regression.expand(sizes)
        steps = self._steps(context)
        for group in groups:
            check_continuous(group.alpha, context.clock, ALPHA_WAY_OUT)
            check_finite(group.alpha, context.clock)
        programs = {group.alpha: compile_expression(group.alpha) for group in groups}
        if len(groups) > 1:
            self._check_alpha_products(terms, programs.values())
        return RegressorDesign(
            families=families,
            alphas=[programs[term.alpha] for term in self.terms],
            groups=groups,
            terms=terms,
            steps=steps,
            delays=self.delays,
            lag=context.lag(Port(name, "delta")),
        )

    def _steps(self, context: BuildContext) -> list[int]:
        """Return the delays in communication steps."""
        steps = []
        for j, delay in enumerate(self.delays):
            steps.append(whole_steps(delay, context.step_ns, f"delays[{j}]"))
        return steps

    def _check_alpha_products(
        self, terms: Sequence[regression.Term], alphas: Collection[Program]
    ) -> None:
        """Check the alphas at t - D_j, on a grid that no period of them divides."""
        grid = np.arange(512) * math.sqrt(2.0) / 7.0
        delays = np.array(self.delays)
        times = grid[:, np.newaxis] - delays
        values = evaluate_at(list(alphas), times.ravel())
        sampled = values.reshape(*times.shape, len(alphas))
        names = [alpha.text for alpha in alphas]
        regression.check_alpha_products(terms, sampled, names)


def _rms_and_rate(alpha: Program, times: Vector) -> tuple[float, float]:
    """Return the root mean square of alpha, and the rate of a sine with its derivatives [rad/s].

    That is the ratio of its second derivative to its first, from differences.
    """
    h = 1e-4
    before = evaluate_at([alpha], times - h)[:, 0]
    now = evaluate_at([alpha], times)[:, 0]
    after = evaluate_at([alpha], times + h)[:, 0]
    first = (after - before) / (2.0 * h)
    second = (after - 2.0 * now + before) / h**2
    rms = float(np.sqrt(np.mean(now**2)))
    slope = float(np.mean(first**2))
    curvature = float(np.mean(second**2))
    rate = math.sqrt(curvature / slope) if slope > 0.0 else 0.0
    return rms, rate
