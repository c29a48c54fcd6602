"""The compensator: a controller that uses the estimates of observer and identifier."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import ClassVar, Final, Literal, NamedTuple, TypeAlias

import numpy as np
from pydantic import Field

from cosim.arrays import Matrix, Vector
from cosim.blocks.compensator import Compensator, CompensatorOptions
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
    matrix,
)
from cosim.scenario.kinds.alphas import unchecked
from cosim.scenario.kinds.base import BuildContext, Kind, PortUnits, unit_of
from cosim.scenario.kinds.control import SensorKind
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.identified_plant import IdentifierSource
from cosim.scenario.kinds.observers import DesignedObserver, UnknownInputObserverKind
from cosim.scenario.kinds.plants import PlantKind
from cosim.scenario.kinds.terms import FamilyTerm
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
        gains = self.gains(name, context)
        if self.internal_model:
            check_meaning(name, self._class_terms(name, context), context)
        observed = observer_in_loop(name, context)
        component = self.compensator(observed, context, gains)
        for problem in _other_parts(name, observed.name, context):
            context.warn(name, f"{problem}: the loop that was certified is one without it")
        ends = zip(gains.box.lower.tolist(), gains.box.upper.tolist(), strict=True)
        record = Compensation(
            self._regulated(observed.reduced),
            self.internal_model,
            tuple(ends),
            self.largest_error,
            feedforward=self.feedforward,
        )
        context.add_metadata(name, {"compensation": plain(record)})
        return component

    def compensator(
        self, observed: ObserverInLoop, context: BuildContext, gains: CompensatorGains
    ) -> Compensator:
        """Return the compensator itself, with its gains.

        Raises
        ------
        UsageError, AssumptionError
            If its options do not fit the plant and the observer.
        """
        reduced = observed.reduced
        state, *_ = state_maps(reduced)
        if observed.kind.lag(observed.name, state.name, context):
            raise UsageError(
                f"{state.name} of {observed.name!r} depends on delta and lags with it; expected "
                'filter = "first-order"'
            )
        coordinates = reduced.coordinates
        options = CompensatorOptions(
            state=state.name,
            R=np.eye(len(reduced.A_a)) if coordinates is None else coordinates.R,
            largest_error=self.largest_error,
            lower=_limits("lower", self.lower, -math.inf, len(gains.K)),
            upper=_limits("upper", self.upper, math.inf, len(gains.K)),
            anti_windup=self.anti_windup,
            regulated=self._regulated(reduced),
            n_y=len(reduced.C3),
        )
        plant = StateSpace(reduced.A_a, reduced.B_1a, reduced.C3, reduced.C4)
        return Compensator(gains, plant, self._estimates(observed, options.R), options)

    def _regulated(self, reduced: ReducedSystem) -> tuple[int, ...]:
        return tuple(range(len(reduced.C3))) if self.regulated is None else self.regulated

    def state_feedback(self, name: str, context: BuildContext) -> tuple[RegulatedPlant, Matrix]:
        """Return the plant with its regulated outputs, and K of ``u = -K x_a``.

        Raises
        ------
        UsageError, AssumptionError
            If there is no observer to design on, or no such gain.
        """
        reduced = observer_in_loop(name, context).reduced
        plant = regulated_plant(reduced, self._regulated(reduced))
        K = _array("K", self.K)
        Q = _array("Q", self.Q)
        R = _array("R", self.R)
        coordinates = reduced.coordinates
        if coordinates is not None:
            K = None if K is None else _gain_of_x_a(np.atleast_2d(K), coordinates)
            if Q is not None:
                weight = weight_matrix("Q", Q, len(coordinates.X))
                Q = coordinates.X.T @ weight @ coordinates.X
        return plant, state_feedback(plant.A, plant.B, K=K, poles=self.poles, Q=Q, R=R)

    def gains(self, name: str, context: BuildContext) -> CompensatorGains:
        """Return the gains, and the internal model.

        Raises
        ------
        UsageError, AssumptionError
            If no controller rejects the disturbance, or follows r.
        """
        plant, K = self.state_feedback(name, context)
        F = no_gain(plant, 0)
        if self.feedforward:
            _need_driver(name, "delta", "feedforward = true", context)
            F = feedforward(plant, K)
        N = no_gain(plant, len(plant.C))
        if context.drivers(Port(name, "r")):
            N = reference_gain(plant, K)
        families = self.families(name, context)
        parameters = list(chain.from_iterable(family.parameters for family in families))
        if families:
            model = internal_model(families, len(plant.C))
            box = self._box(parameters)
        else:
            model = InternalModel(np.zeros((0, 0)), (), np.zeros((0, len(plant.C))))
            box = ParameterBox(np.zeros(0), np.zeros(0))
        decay_rate = None
        if self.internal_model:
            if not families:
                raise UsageError(
                    "internal_model: the disturbance is not described; connect an identifier to "
                    "theta, give terms, or set internal_model = false"
                )
            for signal in ("theta", "standard_error") if parameters else ():
                _need_driver(name, signal, "internal_model = true", context)
            decay_rate = decay_rate_of(plant, K, self.decay_rate)
            check_zeros(plant, model, box)
            stabilize(plant, K, model, box.center, decay_rate)
        return CompensatorGains(
            plant=plant, K=K, F=F, N=N, model=model, box=box, decay_rate=decay_rate
        )

    def families(self, name: str, context: BuildContext) -> list[Family]:
        """Return the families given, or those of the identifier that drives theta."""
        return [term.family for term in self._class_terms(name, context)]

    def _class_terms(self, name: str, context: BuildContext) -> list[ClassTerm]:
        """Return the terms given, or those of the identifier that drives theta; else none.

        Raises
        ------
        UsageError
            If an alpha varies: the internal model is a system with constant coefficients.
        """
        driver = context.driver(Port(name, "theta"))
        terms = []
        if self.terms is not None:
            families = [term.generator() for term in self.terms]
            alphas = unchecked([term.alpha for term in self.terms])
            terms = _class_terms(name, families, alphas)
        elif driver is not None and isinstance(context.spec(driver), IdentifierKind):
            terms = _identified_terms(driver, context)
        for term in terms if self.internal_model else ():
            if _varies(term.alpha, context.clock):
                raise UsageError(
                    f"internal_model: expected constant alphas, got {term.alpha.text!r}; for a "
                    "time-varying alpha use internal_model = false with feedforward = true"
                )
        return terms

    def _box(self, parameters: Sequence[str]) -> ParameterBox:
        rows = self.interval or ()
        if not self.internal_model and self.interval is None:
            rows = tuple((0.0, 0.0) for _ in parameters)
        if len(rows) != len(parameters):
            raise UsageError(
                f"interval: expected {len(parameters)} rows, [lower, upper] of "
                f"{', '.join(parameters)}, got {len(rows)}"
            )
        ends: Matrix = np.array(rows, np.float64).reshape(-1, 2)
        return ParameterBox(ends[:, 0], ends[:, 1])

    def _estimates(self, observed: ObserverInLoop, R: Matrix) -> StateSpace:
        """Return the observer from (u, y) to x_a, and to delta where it is fed forward."""
        model, design = observed.designed
        if observed.kind.filter == "first-order":
            system = realize(model.reduced, design)
        elif self.feedforward:
            raise UsageError(
                f"feedforward: delta of {observed.name!r} lags with filter = "
                f'{observed.kind.filter!r}; expected filter = "first-order", or feedforward = false'
            )
        else:
            system = realize_averages(model.reduced, design).system
        n_x = R.shape[1]
        C = [R @ system.C[:n_x]]
        D = [R @ system.D[:n_x]]
        if self.feedforward:
            delta = delta_rows(model.reduced)
            C.append(system.C[delta])
            D.append(system.D[delta])
        return StateSpace(system.A, system.B, np.vstack(C), np.vstack(D))


# --- the loop ---


class ObserverInLoop(NamedTuple):
    """The observer that a controller is designed on."""

    name: str
    kind: UnknownInputObserverKind
    designed: DesignedObserver

    @property
    def reduced(self) -> ReducedSystem:
        """Its design model."""
        return self.designed.model.reduced


def observer_in_loop(name: str, context: BuildContext) -> ObserverInLoop:
    """Return the observer that a compensator is designed on.

    Raises
    ------
    UsageError
        If there is none, or it is not one that a loop can be proven stable with.
    """
    drivers = [context.driver(Port(name, signal)) for signal in ("x_a", "x")]
    for observer in filter(None, drivers):
        kind = context.spec(observer)
        if not isinstance(kind, UnknownInputObserverKind):
            continue
        if kind.relinearize:
            raise UsageError(
                f"{observer!r} is relinearized during the run; stability is proven for a fixed "
                "observer only; expected relinearize = false"
            )
        designed = kind.design(observer, context)
        if designed.model.constant:
            raise UsageError(
                f"expected the design model of {observer!r} linearized at an equilibrium, got one "
                "with a constant input"
            )
        return ObserverInLoop(observer, kind, designed)
    raise UsageError(
        "'x_a', or 'x' of a model in the general form, must be driven directly by a component of "
        "kind 'unknown-input-observer': the controller is designed on its design model"
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


def _need_driver(name: str, signal: str, key: str, context: BuildContext) -> None:
    if not context.drivers(Port(name, signal)):
        raise UsageError(f"{key} requires the input {signal!r}, which is not connected")


def _other_parts(name: str, observer: str, context: BuildContext) -> list[str]:
    """Return what the loop has beside plant, observer and compensator."""
    problems = []
    if context.driver(Port(observer, "u")) != name:
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
    elif kind.follows_inputs and context.driver(Port(measured, "u")) != name:
        problems.append(f"something is between its u and the u of {measured!r}")
    return problems


def _limits(key: str, given: float | NumberRow | None, none: float, n_u: int) -> Vector:
    limits = np.array(none if given is None else given, np.float64)
    if limits.ndim == 0:
        return np.full(n_u, float(limits))
    if len(limits) != n_u:
        raise UsageError(f"{key}: expected one number, or one per input ({n_u}), got {len(limits)}")
    return limits


def _array(name: str, given: NumberRow | NumberRows | None) -> Matrix | Vector | None:
    """Return the rows of a matrix, or one row, as an array."""
    rows = tuple(row for row in given or () if isinstance(row, tuple))
    if rows:
        return matrix(rows, name)
    return None if given is None else np.array(given, np.float64)


# --- the disturbance class, and what the theta that drives it is of ---


@dataclass(frozen=True, eq=False)
class ClassTerm:
    """A term of a disturbance class, of a component; ``label`` is such as ``terms[0] (sine)``."""

    component: str
    label: str
    family: Family
    alpha: Alpha

    def __str__(self) -> str:
        return f"{self.label} of {self.component!r}"


_Parameter: TypeAlias = tuple[ClassTerm, str]  # of a term, by its name


def _class_terms(
    component: str, families: Sequence[Family], alphas: Sequence[Alpha]
) -> list[ClassTerm]:
    terms = []
    for i, (family, alpha) in enumerate(zip(families, alphas, strict=True)):
        terms.append(ClassTerm(component, f"terms[{i}] ({family.name})", family, alpha))
    return terms


def _identified_terms(identifier: str, context: BuildContext) -> list[ClassTerm]:
    regression = IdentifierSource(identifier, context).regression
    return _class_terms(identifier, regression.families, regression.alphas)


def _parameters(terms: Sequence[ClassTerm], element: ElementIndex = None) -> list[_Parameter]:
    """Return terms and names of the parameters in a theta, or in elements of it."""
    parameters = []
    for term in terms:
        parameters += [(term, name) for name in term.family.parameters]
    if isinstance(element, int):
        return parameters[element : element + 1]
    return parameters if element is None else parameters[element.start : element.stop]


def check_meaning(name: str, terms: Sequence[ClassTerm], context: BuildContext) -> None:
    """Check what the theta of an internal model is of, where identifiers drive it.

    A linear family may be a term of any other in another form, its alpha included, and a parameter
    may be that of a family which differs in the others: both may be meant, and are said. So may
    be a term of the identifier that the internal model has not, and does not reject.

    Raises
    ------
    UsageError
        If a parameter is taken as another one, or is of a term whose alpha varies.
    """
    sources = context.sources(Port(name, "theta"))
    identified: dict[str, list[ClassTerm]] = {}
    taken: list[_Parameter] = []
    for source in sources:
        identifier = source.component
        if source.signal != "theta" or not isinstance(context.spec(identifier), IdentifierKind):
            return
        if identifier not in identified:
            identified[identifier] = _identified_terms(identifier, context)
        taken += _parameters(identified[identifier], source.element)
    own = _parameters(terms)
    if len(own) != len(taken):
        return  # sizes that differ are refused with the connections
    for j, (target, source_parameter) in enumerate(zip(own, taken, strict=True)):
        _check_parameter(f"theta[{j}]", target, source_parameter, context)
    used = {term for term, _ in taken}
    for others in identified.values():
        for other in others:
            is_made = any(_includes(term.family, other.family) for term in terms)
            if other in used or (is_made and not _varies(other.alpha, context.clock)):
                continue
            context.warn(
                name,
                f"{other} is not in the internal model, which does not reject what that term makes",
            )


def _check_parameter(
    element: str,
    target: tuple[ClassTerm, str],
    source: tuple[ClassTerm, str],
    context: BuildContext,
) -> None:
    """Check that an element of theta is taken as the parameter that it is.

    Raises
    ------
    UsageError
        If it is taken as another one, or its alpha varies.
    """
    own, own_name = target
    term, name = source
    origin = f"{element} is {name!r} of {term}"
    is_any = isinstance(own.family, LinearFamily)
    if _varies(term.alpha, context.clock):
        varying = f"{origin}, whose alpha = {term.alpha.text!r} varies"
        if not is_any:
            raise UsageError(
                f"terms: {varying}; the internal model requires a constant alpha; expected a "
                'term of family = "linear" that describes both together, or internal_model = '
                "false with feedforward = true"
            )
        context.warn(own.component, f"{varying}; {own.label} has to make both together")
    elif (own.family, own_name) != (term.family, name):
        as_other = f"{origin}, and is taken as {own_name!r} of {own}"
        if not is_any and own_name != name:
            raise UsageError(
                f"terms: {as_other}; expected the terms of {term.component!r} (the default)"
            )
        text = f"{as_other}; the internal model rejects what that term makes"
        context.warn(own.component, text)


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
