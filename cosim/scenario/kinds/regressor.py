"""The regressor: known signals of the regression, from the reconstructed disturbance."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
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
from cosim.scenario.kinds.alphas import (
    ALPHA,
    KnownAlphas,
    TermAlpha,
    alpha_connections,
    alphas_of,
    known_alphas,
    unchecked,
)
from cosim.scenario.kinds.base import (
    BuildContext,
    ExportableKind,
    Kind,
    Wiring,
)
from cosim.scenario.kinds.terms import FamilyTerm, element_count, families_of
from cosim.scenario.kinds.values import ImpliedConnection, Spectrum
from cosim.theory.disturbances import regression
from cosim.theory.disturbances.distinguishable import check_distinguishable, check_exchangeable
from cosim.theory.disturbances.families import AlphaGroup, Family, group_by_alpha

if TYPE_CHECKING:
    from cosim.fmi.exporting.specifications import Exportable

ALPHA_WAY_OUT = (
    "expected a continuous alpha: the regression multiplies alphas of different instants, "
    "which must jump together with the reconstructed disturbance"
)

SAMPLES: Final = 512  # of an alpha, where it is checked


@dataclass(frozen=True, eq=False, kw_only=True)
class RegressorDesign:
    """The regression of a disturbance class, its alphas compiled.

    Parameters
    ----------
    families : sequence of Family
        Of the components of the disturbance.
    alphas : sequence of Alpha
        The known factor of each.
    known : KnownAlphas
        What is known of those of the groups before the run.
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
    elements : sequence of int
        Which element of delta each component belongs to.
    each : sequence of RegressorDesign
        Those of the elements, where there are several.
    """

    families: Sequence[Family]
    alphas: Sequence[Alpha]
    known: KnownAlphas
    groups: Sequence[AlphaGroup]
    terms: Sequence[regression.Term]
    steps: Sequence[int]
    delays: Sequence[float]
    lag: float
    elements: Sequence[int]
    each: Sequence[RegressorDesign] = ()

    @property
    def by_element(self) -> Sequence[RegressorDesign]:
        """The regression of each element of delta."""
        return self.each or [self]

    @property
    def is_expanded(self) -> bool:
        """Whether mu is that of (25); else it is delta at its delays."""
        return bool(self.terms[0].parts)

    @property
    def needs_independence(self) -> bool:
        """Whether the products of the alphas have to be independent: eta can be estimated."""
        return self.is_expanded and not regression.linear_route_problem(self.sizes)

    @property
    def sizes(self) -> list[int]:
        """The number of basis functions of each group."""
        return [group.size for group in self.groups]

    @property
    def constants(self) -> RegressorConstants:
        """The numbers of what makes mu; of several elements their alphas, and how many mu has."""
        if not self.each:
            return self._of_one().constants
        count = len(self.terms)
        first = self.each[0].constants
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

    @property
    def samples_of_signals(self) -> int:
        """How many samples of the signals among the alphas are before the first mu."""
        return self.constants.alphas.samples

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

    def check_alphas(self, clock: Clock) -> None:
        """Check, as far as it is known before the run, that the alphas are different ones.

        Raises
        ------
        AssumptionError
            If they are not.
        """
        if len(self.groups) > 1 and not self.known.unknown:
            self._check_different(self.known, self.times_before(clock))

    def check_independent(self, clock: Clock) -> None:
        """Check, as far as it is known before the run, that eta can be estimated.

        Raises
        ------
        AssumptionError
            If the products of the alphas are not independent.
        """
        for part in self.by_element:
            if part.needs_independence and len(part.groups) > 1 and not part.known.unknown:
                part._check_independent(part.known, part.times_before(clock))

    def _check_different(self, alphas: Callable[[Vector], Matrix], times: Matrix) -> None:
        """Check alphas ``(N, groups)`` at instants ``(N,)``, in a run at ``times (N, rows)``."""
        names, sampled = self._sampled(alphas, times)
        regression.check_proportional(sampled, names)
        families = [[self.families[i] for i in group.components] for group in self.groups]
        check_exchangeable(times.ravel(), sampled.reshape(-1, len(names)), families, names)

    def _check_independent(self, alphas: Callable[[Vector], Matrix], times: Matrix) -> None:
        names, sampled = self._sampled(alphas, times)
        regression.check_alpha_products(self.terms, sampled, names)

    def _sampled(
        self, alphas: Callable[[Vector], Matrix], times: Matrix
    ) -> tuple[list[str], NDArray[np.float64]]:
        """Return the names of the alphas, and their values, shape ``(N, rows, groups)``."""
        names = [alpha.text for alpha in self.group_alphas]
        return names, alphas(times.ravel()).reshape(*times.shape, len(names))

    def check_recorded(self, t: Vector, alpha: Matrix, *, estimates_eta: bool) -> None:
        """Check the alphas where only the run has computed them.

        Parameters
        ----------
        t : Vector, shape (N,)
            Instants of the run [s].
        alpha : Matrix, shape (N, terms)
            The known factor of every term.
        estimates_eta : bool
            Their products have to be independent.

        Raises
        ------
        AssumptionError
            If they are not different, or their products are not independent.
        """
        for element, part in enumerate(self.each):
            own = [i for i, of_term in enumerate(self.elements) if of_term == element]
            part.check_recorded(t, alpha[:, own], estimates_eta=estimates_eta)
        if self.known.unknown and len(self.groups) > 1 and not self.each:
            self._check_recorded(t, alpha, estimates_eta=estimates_eta)

    def _check_recorded(self, t: Vector, alpha: Matrix, *, estimates_eta: bool) -> None:
        """Check the alphas of one element, if the run is longer than its delays."""
        ages = np.array(self.delays)
        first = t[0] + ages.max()
        if not first < t[-1]:
            return
        columns = [alpha[:, group.components[0]] for group in self.groups]

        def recorded(times: Vector) -> Matrix:
            return np.array([np.interp(times, t, column) for column in columns]).T

        grid = np.linspace(first, t[-1], SAMPLES)
        times = grid[:, np.newaxis] - ages
        self._check_different(recorded, times)
        if estimates_eta and self.needs_independence:
            self._check_independent(recorded, times)

    def component(self) -> Regressor | ElementRegressors:
        """Return a component that makes the signals of the regression."""
        if not self.each:
            return self._of_one()
        signals = [signals_among(part.group_alphas) for part in self.each]
        return ElementRegressors([part._of_one() for part in self.each], signals)

    def _of_one(self) -> Regressor:
        """Return the regressor of one element of delta: its input alpha has its own signals."""
        own = {
            signal.element: place for place, signal in enumerate(signals_among(self.group_alphas))
        }
        alphas: list[Alpha] = []
        for alpha in self.group_alphas:
            if isinstance(alpha, AlphaSignal):
                alpha = replace(alpha, element=own[alpha.element])
            alphas.append(alpha)
        return Regressor(
            self.terms,
            alphas=alphas,
            steps=self.steps,
            delays=self.delays,
            lag=self.lag,
        )


class _Timing(NamedTuple):
    """The delays in communication steps and in seconds, and the lag of delta [s]."""

    steps: Sequence[int]
    delays: Sequence[float]
    lag: float


def _design_of_element(
    families: Sequence[Family], alphas: Sequence[Alpha], timing: _Timing, context: BuildContext
) -> RegressorDesign:
    """Return the regression of one element of delta: of the first delays."""
    groups = group_by_alpha([alpha.text for alpha in alphas], families)
    sizes = tuple(group.size for group in groups)
    needed = sum(sizes) + 1
    is_expanded = regression.count_terms(sizes) <= MOST_TERMS
    firsts = [alphas[group.components[0]] for group in groups]
    design = RegressorDesign(
        families=families,
        alphas=alphas,
        known=known_alphas(firsts, context),
        groups=groups,
        terms=regression.expand(sizes) if is_expanded else regression.delayed(needed),
        steps=timing.steps[:needed],
        delays=timing.delays[:needed],
        lag=timing.lag,
        elements=[0] * len(families),
    )
    design.check_alphas(context.clock)
    return design


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
        if design.each:
            raise UsageError(
                f"{name!r}: a regressor of {len(design.each)} elements of delta cannot be "
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
        names = sorted(distinct)
        known = known_alphas([distinct[text] for text in names], context)
        if known.unknown:
            return None
        amplitude, bandwidth = _together(known, context.clock)
        if not (math.isfinite(amplitude) and 0.0 < bandwidth < math.inf):
            return None
        return Spectrum(
            amplitude,
            bandwidth,
            source={"alpha": names, **_sources(known.known, context)},
            assumption="amplitude and bandwidth of delta are those of alpha: each exponential of "
            "size 1, and slower than alpha",
        )

    def design(self, name: str, context: BuildContext) -> RegressorDesign:
        """Return the regression of the given terms."""
        return context.designed(name, lambda: self._designed(name, context))

    def _designed(self, name: str, context: BuildContext) -> RegressorDesign:
        families = families_of(self.terms)
        steps = self.delay_steps(context)  # before what needs all times of the run
        alphas = alphas_of(name, self.alphas, context, ALPHA_WAY_OUT)
        self.check_distinguishable(context)
        count = element_count(self.terms)
        members: list[list[int]] = [[] for _ in range(count)]
        for i, term in enumerate(self.terms):
            members[term.element].append(i)
        self._check_elements(members, families)
        lag = context.lag(Port(name, "delta"))
        timing = _Timing(steps, self.delays, lag)
        each = []
        for own in members:
            own_families = [families[i] for i in own]
            own_alphas = [alphas[i] for i in own]
            each.append(_design_of_element(own_families, own_alphas, timing, context))
        if count == 1:
            return each[0]
        return self._of_all(members, each, alphas, timing, context)

    def _of_all(
        self,
        members: Sequence[Sequence[int]],
        each: Sequence[RegressorDesign],
        alphas: Sequence[Alpha],
        timing: _Timing,
        context: BuildContext,
    ) -> RegressorDesign:
        """Return the regressions of all elements side by side."""
        groups = []
        for own, part in zip(members, each, strict=True):
            for group in part.groups:
                components = tuple(own[i] for i in group.components)
                groups.append(replace(group, components=components))
        firsts = [alphas[group.components[0]] for group in groups]
        return RegressorDesign(
            families=families_of(self.terms),
            alphas=alphas,
            known=known_alphas(firsts, context),
            groups=groups,
            terms=regression.delayed(sum(len(one.terms) for one in each)),
            steps=timing.steps,
            delays=timing.delays,
            lag=timing.lag,
            elements=[term.element for term in self.terms],
            each=each,
        )

    def check_distinguishable(self, context: BuildContext) -> None:
        """Check that no two terms say the same, whatever theta is.

        Raises
        ------
        AssumptionError
            If two do.
        """
        clock = context.clock
        families = families_of(self.terms)
        alphas = unchecked(self.alphas)
        texts = [alpha.text for alpha in alphas]
        elements = [term.element for term in self.terms]
        check_distinguishable(
            families,
            list(zip(texts, elements, strict=True)),
            texts,
            bounds={},
            span=clock.steps * clock.h,
        )

    def _check_elements(
        self,
        members: Sequence[Sequence[int]],
        families: Sequence[Family],
    ) -> None:
        """Check that every element of delta has terms, and the longest of them its delays."""
        for element, own in enumerate(members):
            if not own:
                raise UsageError(
                    f"terms: expected at least one term for each of {len(members)} elements of "
                    f"delta, got none for element {element}"
                )
        longest = max(sum(families[i].v for i in own) for own in members)
        regression.check_delays(self.delays, longest + 1)

    def delay_steps(self, context: BuildContext) -> list[int]:
        """Return the delays in communication steps."""
        steps = []
        for j, delay in enumerate(self.delays):
            steps.append(whole_steps(delay, context.step_ns, f"delays[{j}]"))
        return steps


def _together(alphas: KnownAlphas, clock: Clock) -> tuple[float, float]:
    """Return the root mean square of all alphas together, and their highest rate [rad/s]."""
    measured = [_rms_and_rate(alpha, clock) for alpha in alphas.each]
    amplitude = math.sqrt(sum(rms**2 for rms, _ in measured))
    return amplitude, max(rate for _, rate in measured)


def _sources(alphas: Sequence[Alpha], context: BuildContext) -> dict[str, Any]:
    """Return the tables that signals among alphas follow from; none without them."""
    components = {Port.parse(signal.text).component for signal in signals_among(alphas)}
    tables = {}
    for name in sorted(components):
        tables[name] = context.spec(name).model_dump(mode="json", by_alias=True)
    return {"sources": tables} if tables else {}


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
