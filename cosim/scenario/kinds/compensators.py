"""The compensator: a controller that uses the estimates of observer and identifier."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import ClassVar, Final, Literal, TypeAlias

import numpy as np
from pydantic import Field

from cosim.arrays import Matrix, Vector
from cosim.blocks.compensator import Compensator, CompensatorOptions
from cosim.blocks.measurement import per_element
from cosim.core.clock import Clock
from cosim.core.contracts import Component
from cosim.core.port import ElementIndex, Port
from cosim.documents import plain
from cosim.errors import UsageError
from cosim.native.estimation.alphas import Alpha, AlphaSignal
from cosim.native.numerics.programs import evaluate_at
from cosim.scenario.document.schema import (
    Flag,
    Number,
    NumberRow,
    NumberRows,
    PoleRow,
    Whole,
    array_of,
    matrix,
)
from cosim.scenario.kinds.base import BuildContext, Kind, PortUnits, unit_of
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.identified_plant import IdentifierSource, ObserverSource
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.kinds.parts import SensorKind
from cosim.scenario.kinds.plants import PlantKind
from cosim.scenario.kinds.terms import FamilyTerm, unchecked
from cosim.scenario.record import Compensation
from cosim.theory.compensation.design import CompensatorGains, decay_rate_of, stabilize
from cosim.theory.compensation.internal_model import InternalModel, ParameterBox, internal_model
from cosim.theory.compensation.state_feedback import (
    RegulatedPlant,
    feedforward,
    no_gain,
    reference_gain,
    regulated_plant,
    state_feedback,
    weight_matrix,
)
from cosim.theory.compensation.transmission_zeros import check_zeros
from cosim.theory.disturbances.families import Family, Polynomial
from cosim.theory.disturbances.linear_family import LinearFamily
from cosim.theory.observers.observer import StateSpace, delta_rows, realize, realize_averages
from cosim.theory.plants.descriptor import ReducedSystem, UserCoordinates, state_maps
from cosim.theory.plants.geometry import without_rounding

LARGEST_ERROR: Final = 0.05
SAMPLES: Final = 1009  # of an alpha that must not vary


class CompensatorKind(Kind):
    """State feedback with feedforward of delta and an internal model of the disturbance."""

    ports: ClassVar[str] = "x_a, delta, y, theta, standard_error, r -> u, w, active, model_theta"
    kind: Literal["compensator"]
    K: NumberRows | None = Field(
        None,
        description="state feedback gain, one row per input: u = -K x_a, or -K x with a model in "
        "the general form; alternatives: poles, Q",
    )
    poles: PoleRow | None = Field(
        None,
        description="eigenvalues of A - B K [1/s], one per controllable state; complex pairs as "
        'strings: ["-3+2j", "-3-2j"]',
    )
    Q: NumberRow | NumberRows | None = Field(
        None, description="LQR weight of x_a, or of x: diagonal, or matrix"
    )
    R: NumberRow | NumberRows | None = Field(
        None, description="LQR weight of u: diagonal, or matrix; default: identity"
    )
    regulated: tuple[Whole, ...] | None = Field(
        None,
        description="indices of the regulated elements of y, from 0; at most as many as inputs; "
        "default: all",
    )
    feedforward: Flag = Field(
        False,
        description="feed the reconstructed delta forward: rejects a constant delta in steady "
        "state, and any matched delta; passes on the noise of delta",
    )
    internal_model: Flag = Field(
        True,
        description="reject the disturbance by an internal model, active while the 95 % interval "
        "of theta is inside 'interval' and its standard error below 'largest_error'",
    )
    interval: tuple[tuple[Number, Number], ...] | None = Field(
        None,
        description="[lower, upper] for each theta: the closed loop must be provably stable in all "
        "of it; the internal model is active only inside",
    )
    terms: tuple[FamilyTerm, ...] | None = Field(
        None,
        description="disturbance terms, a list of { family }; default: those of the identifier "
        "that drives theta",
    )
    decay_rate: Number | None = Field(
        None,
        description="slowest decay of the modes of the internal model [1/s]; default: half the "
        "slowest rate of the state feedback",
    )
    largest_error: Number = Field(
        LARGEST_ERROR,
        description="largest standard error of theta with an active internal model, relative to "
        "theta or to half its interval, whichever is larger",
    )
    lower: Number | NumberRow | None = Field(
        None, description="lower limit of u, one number or one per input; default: none"
    )
    upper: Number | NumberRow | None = Field(
        None, description="upper limit of u, one number or one per input; default: none"
    )
    anti_windup: Flag = Field(
        True, description="feed the limited u back into the internal model (back-calculation)"
    )
    unit: PortUnits = Field(None, description=unit_of("u"))
    unit_port: ClassVar[str] = "u"

    def build(self, name: str, context: BuildContext) -> Component:
        design = self.design(name, context)
        gains = design.gains
        if self.internal_model:
            design.check_theta()
        component = design.compensator
        for problem in design.other_parts():
            context.warn(name, f"{problem}: the loop that was certified is one without it")
        ends = zip(gains.box.lower.tolist(), gains.box.upper.tolist(), strict=True)
        record = Compensation(
            design.regulated,
            self.internal_model,
            tuple(ends),
            self.largest_error,
            feedforward=self.feedforward,
        )
        context.add_metadata(name, {"compensation": plain(record)})
        return component

    def design(self, name: str, context: BuildContext) -> CompensatorDesign:
        """Return the design of the compensator of that name."""
        return CompensatorDesign(name, self, context)


class CompensatorDesign:
    """The steps of the design of a compensator, each done when it is first asked for.

    Every step raises UsageError or AssumptionError if no controller does what the table says.

    Parameters
    ----------
    name : str
    kind : CompensatorKind
    context : BuildContext
    """

    def __init__(self, name: str, kind: CompensatorKind, context: BuildContext) -> None:
        self._name = name
        self._kind = kind
        self._context = context

    @cached_property
    def observer(self) -> ObserverSource:
        """The observer that it is designed on, one that a loop can be proven stable with."""
        drivers = [self._driver(signal) for signal in ("x_a", "x")]
        for name in filter(None, drivers):
            kind = self._context.spec(name)
            if not isinstance(kind, UnknownInputObserverKind):
                continue
            if kind.relinearize:
                raise UsageError(
                    f"{name!r} is relinearized during the run; stability is proven for a fixed "
                    "observer only; expected relinearize = false"
                )
            observer = ObserverSource(name, kind, self._context)
            if observer.design.model.constant:
                raise UsageError(
                    f"expected the design model of {name!r} linearized at an equilibrium, got one "
                    "with a constant input"
                )
            return observer
        raise UsageError(
            "'x_a', or 'x' of a model in the general form, must be driven directly by a component "
            "of kind 'unknown-input-observer': the controller is designed on its design model"
        )

    @property
    def _reduced(self) -> ReducedSystem:
        return self.observer.design.model.reduced

    @property
    def regulated(self) -> tuple[int, ...]:
        """The regulated elements of y."""
        given = self._kind.regulated
        return tuple(range(len(self._reduced.C3))) if given is None else given

    @cached_property
    def feedback(self) -> tuple[RegulatedPlant, Matrix]:
        """The plant with its regulated outputs, and K of ``u = -K x_a``."""
        kind = self._kind
        plant = regulated_plant(self._reduced, self.regulated)
        K = None if kind.K is None else matrix(kind.K, "K")
        Q = _weight("Q", kind.Q)
        coordinates = self._reduced.coordinates
        if coordinates is not None:
            K = None if K is None else _gain_of_x_a(K, coordinates)
            if Q is not None:
                weight = weight_matrix("Q", Q, len(coordinates.X))
                Q = coordinates.X.T @ weight @ coordinates.X
        R = _weight("R", kind.R)
        return plant, state_feedback(plant.A, plant.B, K=K, poles=kind.poles, Q=Q, R=R)

    @cached_property
    def gains(self) -> CompensatorGains:
        """The gains, and the internal model."""
        plant, K = self.feedback
        outputs = len(plant.C)
        F = no_gain(plant, 0)
        if self._kind.feedforward:
            self._need_driver("delta", "feedforward = true")
            F = feedforward(plant, K)
        N = no_gain(plant, outputs)
        if self._context.drivers(Port(self._name, "r")):
            N = reference_gain(plant, K)
        model = InternalModel(np.zeros((0, 0)), (), np.zeros((0, outputs)))
        box = ParameterBox(np.zeros(0), np.zeros(0))
        parameters = [name for family in self.families for name in family.parameters]
        if self.families:
            model = internal_model(self.families, outputs)
            box = self._box(parameters)
        decay_rate = None
        if self._kind.internal_model:
            if not self.families:
                raise UsageError(
                    "internal_model: the disturbance is not described; connect an identifier to "
                    "theta, give terms, or set internal_model = false"
                )
            for signal in ("theta", "standard_error") if parameters else ():
                self._need_driver(signal, "internal_model = true")
            decay_rate = decay_rate_of(plant, K, self._kind.decay_rate)
            check_zeros(plant, model, box)
            stabilize(plant, K, model, box.center, decay_rate)
        return CompensatorGains(
            plant=plant, K=K, F=F, N=N, model=model, box=box, decay_rate=decay_rate
        )

    def _box(self, parameters: Sequence[str]) -> ParameterBox:
        rows = self._kind.interval
        if rows is None and not self._kind.internal_model:
            rows = tuple((0.0, 0.0) for _ in parameters)
        ends: Matrix = np.array(rows or (), np.float64).reshape(-1, 2)
        if len(ends) != len(parameters):
            raise UsageError(
                f"interval: expected {len(parameters)} rows, [lower, upper] of "
                f"{', '.join(parameters)}, got {len(ends)}"
            )
        return ParameterBox(ends[:, 0], ends[:, 1])

    @cached_property
    def compensator(self) -> Compensator:
        """The compensator itself."""
        kind = self._kind
        reduced = self._reduced
        state, *_ = state_maps(reduced)
        if self.observer.kind.lag(self.observer.name, state.name, self._context):
            raise UsageError(
                f"{state.name} of {self.observer.name!r} depends on delta and lags with it; "
                'expected filter = "first-order"'
            )
        coordinates = reduced.coordinates
        n_u = len(self.gains.K)
        options = CompensatorOptions(
            state=state.name,
            R=np.eye(len(reduced.A_a)) if coordinates is None else coordinates.R,
            largest_error=kind.largest_error,
            lower=_limits("lower", kind.lower, -math.inf, n_u),
            upper=_limits("upper", kind.upper, math.inf, n_u),
            anti_windup=kind.anti_windup,
            regulated=self.regulated,
            n_y=len(reduced.C3),
        )
        plant = StateSpace(reduced.A_a, reduced.B_1a, reduced.C3, reduced.C4)
        return Compensator(self.gains, plant, self._estimates(options.R), options)

    def _estimates(self, R: Matrix) -> StateSpace:
        """Return the observer from (u, y) to x_a, and to delta where it is fed forward."""
        model, design = self.observer.design
        used = self.observer.kind.filter
        if used == "first-order":
            system = realize(model.reduced, design)
        elif self._kind.feedforward:
            raise UsageError(
                f"feedforward: delta of {self.observer.name!r} lags with filter = {used!r}; "
                'expected filter = "first-order", or feedforward = false'
            )
        else:
            system = realize_averages(model.reduced, design).system
        n_x = R.shape[1]
        C = [R @ system.C[:n_x]]
        D = [R @ system.D[:n_x]]
        if self._kind.feedforward:
            delta = delta_rows(model.reduced)
            C.append(system.C[delta])
            D.append(system.D[delta])
        return StateSpace(system.A, system.B, np.vstack(C), np.vstack(D))

    # --- what drives it ---

    def _driver(self, signal: str) -> str | None:
        return self._context.driver(Port(self._name, signal))

    def _need_driver(self, signal: str, key: str) -> None:
        if not self._context.drivers(Port(self._name, signal)):
            raise UsageError(f"{key} requires the input {signal!r}, which is not connected")

    def other_parts(self) -> list[str]:
        """Return what the loop has beside plant, observer and compensator."""
        context = self._context
        observer = self.observer.name
        problems = []
        if context.driver(Port(observer, "u")) != self._name:
            problems.append(f"something is between its u and the u of {observer!r}")
        measured = context.driver(Port(observer, "y"))
        if measured is None:
            return [*problems, f"several components drive the y of {observer!r}"]
        kind: Kind | None = context.spec(measured)
        if isinstance(kind, SensorKind):
            if kind.delay or kind.jitter or kind.most_in_a_step(measured, context):
                problems.append(f"{measured!r} delays or samples y")
            measured = context.driver(Port(measured, "u"))
            kind = None if measured is None else context.spec(measured)
        if measured is None or not isinstance(kind, PlantKind):
            problems.append(f"something is between the plant and the y of {observer!r}")
        elif kind.follows_inputs and context.driver(Port(measured, "u")) != self._name:
            problems.append(f"something is between its u and the u of {measured!r}")
        return problems

    # --- the disturbance class, and what the theta that drives it is of ---

    @property
    def families(self) -> list[Family]:
        """The families given, or those of the identifier that drives theta."""
        return [term.family for term in self._terms]

    @cached_property
    def _terms(self) -> list[ClassTerm]:
        """The terms given, or those of the identifier that drives theta; else none."""
        driver = self._driver("theta")
        terms = []
        if self._kind.terms is not None:
            families = [term.generator() for term in self._kind.terms]
            alphas = unchecked([term.alpha for term in self._kind.terms])
            terms = _class_terms(self._name, families, alphas)
        elif driver is not None and isinstance(self._context.spec(driver), IdentifierKind):
            terms = self._identified_terms(driver)
        for term in terms if self._kind.internal_model else ():
            if _varies(term.alpha, self._context.clock):
                raise UsageError(
                    f"internal_model: expected constant alphas, got {term.alpha.text!r}; for a "
                    "time-varying alpha use internal_model = false with feedforward = true"
                )
        return terms

    def _identified_terms(self, identifier: str) -> list[ClassTerm]:
        regression = IdentifierSource(identifier, self._context).regression
        return _class_terms(identifier, regression.families, regression.alphas)

    def check_theta(self) -> None:
        """Check that identifiers estimate the theta that is taken from them, of constant alphas.

        A linear family may be a term of any other in another form, its alpha included, and a
        parameter may be that of a family which differs in the others: both may be meant, and are
        warned of. So is a term of the identifier that the internal model has not.
        """
        taken: list[_Parameter] = []
        identified: dict[str, list[ClassTerm]] = {}
        for source in self._context.sources(Port(self._name, "theta")):
            name = source.component
            if source.signal != "theta" or not isinstance(self._context.spec(name), IdentifierKind):
                return
            terms = identified[name] = identified.get(name) or self._identified_terms(name)
            taken += _parameters(terms, source.element)
        own = _parameters(self._terms)
        if len(own) != len(taken):
            return  # sizes that differ are refused with the connections
        for j, ((target, name), (origin, estimated)) in enumerate(zip(own, taken, strict=True)):
            varies = _varies(origin.alpha, self._context.clock)
            if (target.family, name) == (origin.family, estimated) and not varies:
                continue
            alpha = f", whose alpha = {origin.alpha.text!r} varies" if varies else ""
            what = (
                f"theta[{j}] is {estimated!r} of {origin.text}{alpha}, and is taken as {name!r} of"
            )
            if not isinstance(target.family, LinearFamily) and (name != estimated or varies):
                raise UsageError(
                    f"terms: {what} {target.text}, of a constant alpha; expected the terms of the "
                    'identifier (the default), or a term of family = "linear" that describes a '
                    "family with its alpha, or internal_model = false with feedforward = true"
                )
            self._context.warn(
                self._name, f"{what} {target.text}; the internal model has to make the same signals"
            )
        used = {term for term, _ in taken}
        for term in chain.from_iterable(identified.values()):
            is_made = any(_includes(own.family, term.family) for own in self._terms)
            if term not in used and not (is_made and not _varies(term.alpha, self._context.clock)):
                self._context.warn(
                    self._name,
                    f"{term.text} is not in the internal model, which does not reject what that "
                    "term makes",
                )


def _gain_of_x_a(K: Matrix, coordinates: UserCoordinates) -> Matrix:
    """Return a gain of the user's x as one of x_a.

    Raises
    ------
    UsageError
        If it has not a column a state, or weighs states that follow u or delta at once.
    """
    n = len(coordinates.X)
    if K.shape[1] != n:
        raise UsageError(f"K: expected {n} columns, one per state, got {K.shape[1]}")
    of_inputs = np.hstack([coordinates.Xu, coordinates.Xd])
    size = np.abs(K) @ np.abs(of_inputs)
    if without_rounding(K @ of_inputs, size, 1e3).any():
        raise UsageError(
            "K: feeds back algebraic states, which follow u or delta at once (algebraic loop); "
            "expected a K of the dynamic part of x, or poles, or Q"
        )
    return np.asarray(K @ coordinates.X, np.float64)


def _limits(key: str, given: float | NumberRow | None, none: float, n_u: int) -> Vector:
    return np.full(n_u, none) if given is None else per_element(key, given, n_u)


def _weight(name: str, given: NumberRow | NumberRows | None) -> Matrix | Vector | None:
    return None if given is None else array_of(given, name)


@dataclass(frozen=True, eq=False)
class ClassTerm:
    """A term of a disturbance class; ``text`` is such as ``terms[0] (sine) of 'identifier'``."""

    text: str
    family: Family
    alpha: Alpha


_Parameter: TypeAlias = tuple[ClassTerm, str]  # of a term, by its name


def _class_terms(
    component: str, families: Sequence[Family], alphas: Sequence[Alpha]
) -> list[ClassTerm]:
    terms = []
    for i, (family, alpha) in enumerate(zip(families, alphas, strict=True)):
        text = f"terms[{i}] ({family.name}) of {component!r}"
        terms.append(ClassTerm(text, family, alpha))
    return terms


def _parameters(terms: Sequence[ClassTerm], element: ElementIndex = None) -> list[_Parameter]:
    """Return terms and names of the parameters in a theta, or in elements of it."""
    parameters = [(term, name) for term in terms for name in term.family.parameters]
    if isinstance(element, int):
        return parameters[element : element + 1]
    return parameters if element is None else parameters[element.start : element.stop]


def _includes(family: Family, other: Family) -> bool:
    """Return whether a family has all signals of another one, for the same theta."""
    if isinstance(family, Polynomial) and isinstance(other, Polynomial):
        return family.degree >= other.degree
    return family == other


def _varies(alpha: Alpha, clock: Clock) -> bool:
    if isinstance(alpha, AlphaSignal):
        return True
    parts = np.arange(SAMPLES) * math.sqrt(2.0) % 1.0  # no period divides them
    times = clock.start_time + (clock.stop - clock.start_time) * parts
    values = evaluate_at([alpha], np.asarray(times, np.float64))
    return bool(np.ptp(values) > 0.0)
