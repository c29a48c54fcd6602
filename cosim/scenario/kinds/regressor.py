"""The regressor: known signals of the regression, from the reconstructed disturbance."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal

import numpy as np
from pydantic import Field

from cosim.arrays import Matrix, Vector
from cosim.blocks.regressor import ElementRegressors, Regressor
from cosim.core.clock import Clock, whole_steps
from cosim.core.connections import Connection
from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.errors import UsageError
from cosim.native.estimation.alphas import Alpha, AlphaSignal, PastAlphas, signals_among
from cosim.native.estimation.rayleigh import MOST_TERMS
from cosim.native.estimation.regression import RegressorConstants
from cosim.scenario.document.schema import NumberRow
from cosim.scenario.kinds.base import BuildContext, ExportableKind, Kind, Wiring
from cosim.scenario.kinds.terms import (
    ALPHA,
    FamilyTerm,
    KnownAlphas,
    TermAlpha,
    alpha_connections,
    alphas_of,
    element_count,
    families_of,
    known_functions,
    signals_of,
    unchecked,
)
from cosim.scenario.kinds.values import ImpliedConnection, KnownSignal, Spectrum
from cosim.theory.disturbances import regression
from cosim.theory.disturbances.distinguishable import check_distinguishable, check_exchangeable
from cosim.theory.disturbances.families import AlphaGroup, Family, group_by_alpha
from cosim.theory.estimators.output_error import NO_BOUNDS

if TYPE_CHECKING:
    from cosim.fmi.exporting.specifications import Exportable

ALPHA_WAY_OUT = (
    "expected a continuous alpha: the regression multiplies alphas of different instants, "
    "which must jump together with the reconstructed disturbance"
)

SAMPLES: Final = 512  # of an alpha, where it is checked


@dataclass(frozen=True, eq=False, kw_only=True)
class RegressorDesign:
    """The regression of a disturbance class, its alphas compiled; without delays the class alone.

    Parameters
    ----------
    families : sequence of Family
        Of the components of the disturbance.
    alphas : sequence of Alpha
        The known factor of each.
    elements : sequence of int
        Which element of delta each component belongs to.
    functions : mapping of text to KnownSignal
        The alphas that are known before the run.
    steps : sequence of int
        The delays in communication steps.
    delays : sequence of float
        The delays [s].
    lag : float
        How far delta lags behind the disturbance [s].
    """

    families: Sequence[Family]
    alphas: Sequence[Alpha]
    elements: Sequence[int]
    functions: Mapping[str, KnownSignal] = field(default_factory=dict)
    steps: Sequence[int] = ()
    delays: Sequence[float] = ()
    lag: float = 0.0

    @cached_property
    def members(self) -> list[list[int]]:
        """The components of each element of delta."""
        members: list[list[int]] = [[] for _ in range(1 + max(self.elements))]
        for component, element in enumerate(self.elements):
            members[element].append(component)
        return members

    @property
    def has_several(self) -> bool:
        """Whether delta has several elements."""
        return len(self.members) > 1

    @cached_property
    def by_element(self) -> Sequence[RegressorDesign]:
        """The regression of each element of delta, of the first delays."""
        if not self.has_several:
            return [self]
        designs = []
        for own in self.members:
            families = [self.families[i] for i in own]
            needed = sum(family.v for family in families) + 1
            design = replace(
                self,
                families=families,
                alphas=[self.alphas[i] for i in own],
                elements=[0] * len(own),
                steps=self.steps[:needed],
                delays=self.delays[:needed],
            )
            designs.append(design)
        return designs

    @cached_property
    def groups(self) -> list[AlphaGroup]:
        """The components of an element that share an alpha."""
        groups = []
        for own in self.members:
            texts = [self.alphas[i].text for i in own]
            for group in group_by_alpha(texts, [self.families[i] for i in own]):
                components = tuple(own[i] for i in group.components)
                groups.append(replace(group, components=components))
        return groups

    @property
    def sizes(self) -> tuple[int, ...]:
        """The number of basis functions of each group."""
        return tuple(group.size for group in self.groups)

    @property
    def delays_needed(self) -> int:
        """One more than the basis functions of the element of delta that has most."""
        return 1 + max(sum(part.sizes) for part in self.by_element)

    @cached_property
    def is_expanded(self) -> bool:
        """Whether mu is that of (25); else it is delta at its delays."""
        return not self.has_several and regression.count_terms(self.sizes) <= MOST_TERMS

    @cached_property
    def terms(self) -> Sequence[regression.Term]:
        """The expansion of the determinant."""
        if self.is_expanded:
            return regression.expand(self.sizes)
        count = len(self.delays)
        if self.has_several:
            count = sum(len(part.terms) for part in self.by_element)
        return regression.delayed(count)

    @property
    def needs_independence(self) -> bool:
        """Whether the products of the alphas have to be independent: eta can be estimated."""
        return self.is_expanded and not regression.linear_route_problem(self.sizes)

    @cached_property
    def constants(self) -> RegressorConstants:
        """The numbers of what makes mu; of several elements their alphas, and how many mu has."""
        if not self.has_several:
            return self._of_one().constants
        count = len(self.terms)
        first = self.by_element[0].constants
        ages = [self.lag + delay for delay in self.delays]
        return replace(
            first,
            alphas=PastAlphas(alphas=self.group_alphas, ages=ages, h=first.alphas.h),
            row=np.zeros(count, np.int64),
            factor=np.zeros((count, 0), np.int64),
            sign=np.ones(count),
        )

    @property
    def group_alphas(self) -> list[Alpha]:
        """The alpha of each group."""
        return [self.alphas[group.components[0]] for group in self.groups]

    @cached_property
    def known(self) -> KnownAlphas:
        """What is known of the alphas of the groups before the run."""
        return KnownAlphas(self.group_alphas, self.functions)

    def times_before(self, clock: Clock) -> Matrix:
        """Return the instants that the alphas are needed at, shape ``(N, rows)`` [s].

        Of expressions on a grid that no period of them divides; of signals in the run.
        """
        ages = self.lag + np.array(self.delays)
        grid = np.arange(SAMPLES) * math.sqrt(2.0) / 7.0
        if not self.known.are_expressions:
            first = clock.start_time + ages.max()
            grid = np.linspace(min(first, clock.stop), clock.stop, SAMPLES)
        return grid[:, np.newaxis] - ages

    def check_distinguishable(
        self, clock: Clock, bounds: Mapping[int, tuple[float, float]] = NO_BOUNDS
    ) -> None:
        """Check that no two terms say the same, whatever theta within the bounds is.

        Raises
        ------
        AssumptionError
            If two do.
        """
        texts = [alpha.text for alpha in self.alphas]
        factors = list(zip(texts, self.elements, strict=True))
        span = clock.steps * clock.h
        check_distinguishable(self.families, factors, texts, bounds=bounds, span=span)

    def check_known(self, clock: Clock, *, estimates_eta: bool) -> None:
        """Check the alphas as far as they are known before the run.

        Parameters
        ----------
        clock : Clock
        estimates_eta : bool
            Their products have to be independent.

        Raises
        ------
        AssumptionError
            If they are not different, or their products are not independent.
        """
        for part in self.by_element:
            if not part.known.unknown:
                part._check(part.known, part.times_before(clock), estimates_eta)

    def independence(self, clock: Clock) -> float:
        """Return by how much the products of the alphas are independent, all of them known."""
        times = self.times_before(clock)
        sampled = self.known(times.ravel()).reshape(*times.shape, len(self.groups))
        return regression.independence(self.terms, sampled)

    def check_recorded(self, t: Vector, alpha: Matrix, *, estimates_eta: bool) -> None:
        """Check the alphas where only the run has computed them, if it is longer than the delays.

        Parameters
        ----------
        t : Vector, shape (N,)
            Instants of the run [s].
        alpha : Matrix, shape (N, terms)
            The known factor of every term.
        estimates_eta : bool
            As above, and the same errors.
        """
        for own, part in zip(self.members, self.by_element, strict=True):
            ages = np.array(part.delays)
            first = t[0] + ages.max()
            if part.known.unknown and first < t[-1]:
                columns = [alpha[:, own[group.components[0]]] for group in part.groups]
                times = np.linspace(first, t[-1], SAMPLES)[:, np.newaxis] - ages
                part._check(partial(_interpolated, t, columns), times, estimates_eta)

    def _check(
        self, alphas: Callable[[Vector], Matrix], times: Matrix, estimates_eta: bool
    ) -> None:
        """Check alphas ``(N, groups)`` at instants ``(N,)``, in a run at ``times (N, rows)``."""
        if len(self.groups) < 2:
            return
        names = [alpha.text for alpha in self.group_alphas]
        sampled = alphas(times.ravel()).reshape(*times.shape, len(names))
        regression.check_proportional(sampled, names)
        families = [[self.families[i] for i in group.components] for group in self.groups]
        check_exchangeable(times.ravel(), sampled.reshape(-1, len(names)), families, names)
        if estimates_eta and self.needs_independence:
            regression.check_alpha_products(self.terms, sampled, names)

    def component(self) -> Regressor | ElementRegressors:
        """Return a component that makes the signals of the regression."""
        if not self.has_several:
            return self._of_one()
        signals = [signals_among(part.alphas) for part in self.by_element]
        return ElementRegressors([part._of_one() for part in self.by_element], signals)

    def _of_one(self) -> Regressor:
        """Return the regressor of one element of delta: its input alpha has its own signals."""
        own = [signal.element for signal in signals_among(self.alphas)]
        alphas: list[Alpha] = []
        for alpha in self.group_alphas:
            if isinstance(alpha, AlphaSignal):
                alpha = replace(alpha, element=own.index(alpha.element))
            alphas.append(alpha)
        return Regressor(
            self.terms, alphas=alphas, steps=self.steps, delays=self.delays, lag=self.lag
        )


def _interpolated(t: Vector, columns: Sequence[Vector], times: Vector) -> Matrix:
    return np.array([np.interp(times, t, column) for column in columns]).T


class RegressorKind(ExportableKind):
    """Regressor: the known signals mu of the regression, from delta."""

    ports: ClassVar[str] = "delta, [alpha] -> mu"
    continuous_inputs: ClassVar[Mapping[str, str]] = {ALPHA: ALPHA_WAY_OUT}
    kind: Literal["regressor"]
    terms: tuple[FamilyTerm, ...] = Field(
        min_length=1, description="list of { alpha, family } with the settings of the family"
    )
    delays: NumberRow = Field(
        description="delays D_j [s], one more than basis functions, multiples of the "
        "communication step",
    )

    def implied_connections(
        self, name: str, connections: Mapping[Port, Connection], specs: Mapping[str, Kind]
    ) -> Mapping[Port, ImpliedConnection]:
        """Return the connections of the alphas that are signals."""
        return alpha_connections(name, self.alphas)

    @property
    def alphas(self) -> list[TermAlpha]:
        """The known factors of its terms."""
        return [term.alpha for term in self.terms]

    def build(self, name: str, context: BuildContext) -> Component:
        design = self.design(name, context)
        for part in design.by_element:
            warning = regression.linear_route_warning(part.sizes)
            if warning:
                context.warn(name, warning)
        if design.lag:
            context.add_metadata(name, {"lag": design.lag})
        return design.component()

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        from cosim.fmi.exporting import kernels  # a run needs none of it

        component = self.build(name, context)
        design = self.design(name, context)
        if design.has_several:
            raise UsageError(
                f"{name!r}: a regressor of {len(design.members)} elements of delta cannot be "
                "exported; expected one regressor per element"
            )
        kernel = kernels.regressor(design.constants)
        reason = "the regressor is a discrete-time component"
        return kernels.DiscreteModel(component.interface, kernel, context.step_ns, reason)

    def spectrum(self, name: str, context: BuildContext) -> Spectrum | None:
        """Return amplitude and bandwidth of alpha, for exponentials, whose rates are real.

        None: they are others, or an alpha is not known before the run.
        """
        if any(term.family != "exponential" for term in self.terms):
            return None
        distinct = {alpha.text: alpha for alpha in unchecked(self.alphas)}
        alphas = [distinct[text] for text in sorted(distinct)]
        known = KnownAlphas(alphas, known_functions(alphas, context))
        if known.unknown:
            return None
        measured = []
        for alpha in alphas:
            of_one = KnownAlphas([alpha], known.functions)
            measured.append(_rms_and_rate(of_one, context.clock))
        amplitude = math.sqrt(sum(rms**2 for rms, _ in measured))
        bandwidth = max(rate for _, rate in measured)
        if not (math.isfinite(amplitude) and 0.0 < bandwidth < math.inf):
            return None
        source: dict[str, Any] = {"alpha": known.names}
        # the tables that signals follow from
        for component in sorted({port.component for port in signals_of(self.alphas)}):
            table = context.spec(component).model_dump(mode="json", by_alias=True)
            source.setdefault("sources", {})[component] = table
        return Spectrum(
            amplitude,
            bandwidth,
            source,
            assumption="amplitude and bandwidth of delta are those of alpha: each exponential of "
            "size 1, and slower than alpha",
        )

    def design(self, name: str, context: BuildContext) -> RegressorDesign:
        """Return the regression of the given terms."""
        return context.designed(name, lambda: self._designed(name, context))

    def disturbance_class(self) -> RegressorDesign:
        """Return the class of the disturbance alone, with the alphas as they are written.

        Raises
        ------
        UsageError
            If a term is none, or an element of delta has no term.
        """
        families = families_of(self.terms)
        elements = [term.element for term in self.terms]
        count = element_count(self.terms)
        missing = set(range(count)).difference(elements)
        if missing:
            raise UsageError(
                f"terms: expected at least one term for each of {count} elements of delta, got "
                f"none for element {min(missing)}"
            )
        return RegressorDesign(families=families, alphas=unchecked(self.alphas), elements=elements)

    def _designed(self, name: str, context: BuildContext) -> RegressorDesign:
        of_class = self.disturbance_class()
        steps = self.delay_steps(of_class, context)  # before what needs all times of the run
        alphas = alphas_of(name, self.alphas, context, ALPHA_WAY_OUT)
        of_class.check_distinguishable(context.clock)
        design = replace(
            of_class,
            alphas=alphas,
            functions=known_functions(alphas, context),
            steps=steps,
            delays=self.delays,
            lag=context.lag(Port(name, "delta")),
        )
        design.check_known(context.clock, estimates_eta=False)
        return design

    def delay_steps(self, of_class: RegressorDesign, context: BuildContext) -> list[int]:
        """Return the delays in communication steps.

        Raises
        ------
        UsageError, AssumptionError
            If they are no whole steps, not as many as the class needs, or not different.
        """
        steps = []
        for j, delay in enumerate(self.delays):
            steps.append(whole_steps(delay, context.step_ns, f"delays[{j}]"))
        regression.check_delays(self.delays, of_class.delays_needed)
        return steps


def _rms_and_rate(alpha: KnownAlphas, clock: Clock) -> tuple[float, float]:
    """Return the root mean square of alpha, and the rate of a sine with its derivatives [rad/s].

    That is the ratio of its second derivative to its first, from differences.
    """
    times: Vector = np.arange(512.0) * (math.sqrt(2.0) / 7.0)  # no period divides them
    h = 1e-4
    if not alpha.are_expressions:
        h = clock.h
        times = np.linspace(clock.start_time + h, clock.stop - h, SAMPLES)
    before = alpha(times - h)[:, 0]
    now = alpha(times)[:, 0]
    after = alpha(times + h)[:, 0]
    first = (after - before) / (2.0 * h)
    second = (after - 2.0 * now + before) / h**2
    rms = float(np.sqrt(np.mean(now**2)))
    slope = float(np.mean(first**2))
    curvature = float(np.mean(second**2))
    rate = math.sqrt(curvature / slope) if slope > 0.0 else 0.0
    return rms, rate
