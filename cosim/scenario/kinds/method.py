"""The method of the paper: observer, regressor, identifier."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from cosim.blocks.identifier import LeastSquaresIdentifier
from cosim.blocks.observer import observer_model
from cosim.blocks.regressor import Regressor
from cosim.blocks.sampled import Decimated
from cosim.core.clock import whole_steps
from cosim.core.linear import LinearModel
from cosim.errors import AssumptionError, UsageError
from cosim.fmi.exporting import kernels
from cosim.fmi.exporting.kernels import DiscreteModel
from cosim.native.expression import Program, compile_expression
from cosim.native.step import evaluate
from cosim.scenario.kinds.base import BuildContext, Exportable, Kind, Wiring
from cosim.scenario.kinds.plants import StartField
from cosim.scenario.linearizing import DesignModel, belief
from cosim.scenario.schema import Number, NumberRow, NumberRows, TomlTable, matrix
from cosim.theory import estimators, observer, regression
from cosim.theory.descriptor import reduce
from cosim.theory.disturbance import AlphaGroup, family_named, group_by_alpha

HELD_LIMIT = (
    0.05  # filter_rate x step from which held inputs spoil the derivative by more than 2.5 %
)


class FmuModel(TomlTable):
    """What an observer believes, linearized out of an FMU."""

    fmu: str = Field(description="path of an .fmu for model exchange")
    disturbance: str | tuple[str, ...] = Field(
        description="name or names of the inputs that are unknown"
    )
    inputs: tuple[str, ...] | None = Field(
        None, description="names of the inputs that make up u; left out: all others"
    )
    outputs: tuple[str, ...] = Field(("y",), description="names of the outputs that make up y")
    at: Number = Field(
        0.0, description="linearized where the FMU arrives at this time with constant inputs [s]"
    )
    start: dict[str, StartField] = Field(
        {}, description="start values by variable, inputs included"
    )

    @property
    def disturbances(self) -> tuple[str, ...]:
        """The names of the unknown inputs."""
        return (self.disturbance,) if isinstance(self.disturbance, str) else self.disturbance


class Designed(NamedTuple):
    """An observer, and what it believes."""

    belief: DesignModel
    observer: observer.ObserverDesign


class UnknownInputObserverKind(Kind):
    """Unknown-input observer with disturbance reconstruction (18)-(20)."""

    kind: Literal["unknown-input-observer"]
    model: str | FmuModel = Field(
        description='what the observer believes: name of a table in [models], or { fmu = "x.fmu", disturbance = "d" }'
    )
    L: NumberRow | NumberRows | None = Field(None, description="gain; or give poles")
    poles: NumberRow | None = Field(
        None, description="eigenvalues of M - L C3 that L can move [1/s]"
    )
    x_a0: NumberRow | None = Field(
        None, description="first estimate; left out: consistent with y(0)"
    )
    filter_rate: Number = Field(description="lambda_f of the derivative filter (19) [rad/s]")
    q0: NumberRow | None = Field(None, description="start of the filter; left out: at the signal")

    def linear_model(self, name: str, context: BuildContext) -> LinearModel:
        believed, design = self.design(name, context)
        context.note(
            name,
            eigenvalues=[str(complex(v)) if v.imag else float(v.real) for v in design.eigenvalues],
            fixed_modes=[str(complex(v)) if v.imag else float(v.real) for v in design.fixed_modes],
            lambda_obs=design.lambda_obs,
        )
        return believed.declare(
            observer_model(
                believed.reduced, design, x_a0=self.x_a0, q0=self.q0, constant=believed.constant
            )
        )

    def advice(self, held: Mapping[str, bool], h: float) -> list[str]:
        product = self.filter_rate * h
        names = [name for name, is_held in held.items() if is_held]
        if not names or product <= HELD_LIMIT:
            return []
        gain = product / -math.expm1(-product) - 1.0
        return [
            f"{' and '.join(names)} held over the step (discrete, late in a loop, or by hold), filter_rate x step = {product:g}: "
            f"the derivative filter reads a ramp {gain:.0%} too high and a jump filter_rate times; do not trust delta"
        ]

    def design(self, name: str, context: BuildContext) -> Designed:
        """Design the observer (14)-(18)."""
        believed = self._belief(name, context)
        rows = [row if isinstance(row, tuple) else (row,) for row in self.L or ()]
        L = None if self.L is None else matrix(tuple(rows), "L")
        return Designed(
            believed,
            observer.design(believed.reduced, L=L, poles=self.poles, filter_rate=self.filter_rate),
        )

    def _belief(self, name: str, context: BuildContext) -> DesignModel:
        if isinstance(self.model, str):
            return DesignModel(reduce(context.model(self.model)))
        model, inputs = self.model, self.model.inputs
        chosen = None if inputs is None else (*inputs, *model.disturbances)
        found = context.linearization(
            name, model.fmu, at=model.at, start=model.start, inputs=chosen, outputs=model.outputs
        )
        return belief(found, model.disturbances)


class RegressorTerm(TomlTable):
    """One component of the disturbance class (4), its parameter unknown."""

    alpha: str = Field("1", description="known function of t")
    family: str = Field(description="exponential or sine")


class RegressorKind(Kind):
    """From delta to the known signals mu of the regression (21)-(25)."""

    kind: Literal["regressor"]
    terms: tuple[RegressorTerm, ...] = Field(description="list of { alpha, family }")
    delays: NumberRow = Field(
        description="D_j [s], one more than basis functions, whole communication steps"
    )

    def build(self, name: str, context: BuildContext) -> Regressor:
        blocks, terms = self.regression()
        steps = [
            whole_steps(delay, context.step_ns, f"delays[{j}]")
            for j, delay in enumerate(self.delays)
        ]
        programs = [compile_expression(block.alpha) for block in blocks]
        if len(blocks) > 1:
            regression.check_alpha_products(terms, self._alphas(programs), [block.alpha for block in blocks])
        warning = regression.linear_route_warning([block.size for block in blocks])
        if warning:
            context.warn(name, warning)
        return Regressor(terms, alphas=programs, steps=steps, delays=self.delays)

    def exportable(self, name: str, context: BuildContext, place: Wiring) -> Exportable:
        component = self.build(name, context)
        reason = "the regressor multiplies samples of the past, so it lives at the communication points and has no derivatives"
        return DiscreteModel(
            component.interface, kernels.regressor(component.constants), context.step_ns, reason
        )

    def regression(self) -> tuple[tuple[AlphaGroup, ...], tuple[regression.Term, ...]]:
        """Expand the determinant for the terms given."""
        families = [family_named(term.family) for term in self.terms]
        blocks = group_by_alpha([term.alpha for term in self.terms], families)
        sizes = tuple(block.size for block in blocks)
        regression.check_delays(self.delays, sum(sizes) + 1)
        return blocks, regression.expand(sizes)

    def _alphas(self, programs: Sequence[Program]) -> Any:
        """Sample alpha_b(t - D_j) on a grid that no period of the alphas divides."""
        grid = np.arange(512) * math.sqrt(2.0) / 7.0
        return np.array(
            [[[evaluate(p, t - D) for p in programs] for D in self.delays] for t in grid]
        )


class StartTable(TomlTable):
    """Start of identification by (36)-(38)."""

    epsilon_observer: Number = Field(
        description="fraction of the first observer error that may remain, in (0, 1)"
    )
    epsilon_filter: Number = Field(
        description="fraction of the first filter transient that may remain, in (0, 1)"
    )


class IdentifierKind(Kind):
    """Identifier of theta by least squares (33)-(35)."""

    kind: Literal["identifier"]
    method: Literal["least-squares"] = Field(description='how theta is estimated: "least-squares"')
    P0: Number | None = Field(None, description="P(0) = P0 I (34); left out: no prior")
    start: Number | StartTable = Field(
        description="T_id [s], or { epsilon_observer, epsilon_filter } for (36)-(38)"
    )
    period: Number | None = Field(
        None, description="seconds between two answers; left out: every communication step"
    )

    @property
    def sample_period(self) -> float | None:
        """Its period [s]."""
        return self.period

    def build(self, name: str, context: BuildContext) -> LeastSquaresIdentifier:
        source_name = context.driver(f"{name}.regressor")
        spec = context.spec(source_name) if source_name is not None else None
        if not isinstance(spec, RegressorKind):
            raise UsageError(
                "'regressor' must be driven directly by a component of kind 'regressor', whose terms it identifies"
            )
        assert source_name is not None
        blocks, terms = spec.regression()
        recovery = estimators.plan(terms, blocks, spec.delays)
        start = self._start(name, source_name, spec, context)
        context.note(name, P0=self.P0, unknowns=recovery.n_eta, remarks=_remarks(recovery))
        return LeastSquaresIdentifier(recovery, start=start, P0=self.P0)

    def exportable(self, name: str, context: BuildContext, place: Wiring) -> Exportable:
        component = self.build(name, context)
        every = (
            1
            if self.period is None
            else whole_steps(self.period, context.step_ns, f"period of {name!r}")
        )
        return DiscreteModel(
            component.interface if every == 1 else Decimated(component, every).interface,
            kernels.least_squares(
                component.constants(component.start, held=bool(place.held.any()))
            ),
            context.step_ns,
            "the identifier takes one row at every communication point, so it has no derivatives",
            every=every,
        )

    def _start(
        self, name: str, regressor: str, spec: RegressorKind, context: BuildContext
    ) -> float:
        """Give the first communication point not before T_id."""
        longest = max(spec.delays)
        if isinstance(self.start, StartTable):
            observer_name = context.driver(f"{regressor}.delta")
            found = context.spec(observer_name) if observer_name is not None else None
            if observer_name is None or not isinstance(found, UnknownInputObserverKind):
                raise UsageError(
                    "start: (36)-(38) need an observer that drives the regressor; give start as a time in s instead"
                )
            design = found.design(observer_name, context).observer
            times = observer.identification_start_time(
                lambda_obs=design.lambda_obs,
                filter_rate=found.filter_rate,
                delays=spec.delays,
                epsilon_observer=self.start.epsilon_observer,
                epsilon_filter=self.start.epsilon_filter,
            )
            context.note(name, T_obs=times.T_obs, T_f=times.T_f, D_max=times.D_max, T_id=times.T_id)
            wanted = times.T_id
        else:
            wanted = float(self.start)
        if wanted < longest:
            raise AssumptionError(
                f"start: found {wanted} s, needed at least the longest delay, {longest} s: before it the regressor has no value"
            )
        first = math.ceil(round(wanted * 1e9, 3) / context.step_ns) * context.step_ns / 1e9
        context.note(name, start=first)
        return first


def _remarks(recovery: estimators.Recovery) -> list[str]:
    """Say what the recovery of theta cannot tell apart."""
    remarks = []
    for block in recovery.groups:
        at = ", ".join(f"theta[{i}]" for i in block.theta)
        if block.kind is estimators.RecoveryKind.SINE:
            remarks.append(
                f"{at}: a rate above {block.limit:.4g} rad/s is taken for a slower one (delays {block.spacing:g} s apart)"
            )
        if block.kind is estimators.RecoveryKind.EXPONENTIALS:
            remarks.append(f"{at}: two exponentials under one alpha come back the larger first")
    return remarks
