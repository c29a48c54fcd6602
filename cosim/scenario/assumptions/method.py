"""What the method asks of models, observers, regressors, identifiers and compensators."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.port import Port
from cosim.errors import AssumptionError, UsageError
from cosim.native.numerics.householder import triangle
from cosim.scenario.assumptions.beginning import (
    RESTS_ON_INVALID,
    Beginning,
    Evidence,
    attempted,
    noise_of,
)
from cosim.scenario.kinds.base import BuildContext
from cosim.scenario.kinds.build_record import DependsOnInvalid
from cosim.scenario.kinds.compensators import CompensatorDesign, CompensatorKind
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.identified_plant import IdentifiedPlant, IdentifierSource
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.kinds.regressor import RegressorDesign, RegressorKind
from cosim.scenario.kinds.variants import LINEAR_METHODS
from cosim.theory.assessment.accuracy import STEPS_CHECKED
from cosim.theory.compensation.activation import Activation
from cosim.theory.compensation.state_feedback import slowest_rate, unreached_modes
from cosim.theory.compensation.steady_input import KnownDisturbance, steady_input
from cosim.theory.compensation.transmission_zeros import check_zeros
from cosim.theory.disturbances import regression
from cosim.theory.disturbances.excitation import COMPARABLE, describe_excitation, information
from cosim.theory.disturbances.families import generators
from cosim.theory.disturbed_plant import DataSet
from cosim.theory.experiment_design.bound import accuracy_bound
from cosim.theory.experiment_design.effect_of_theta import effect_of_theta
from cosim.theory.experiment_design.minors import Minors
from cosim.theory.forced_response import simulate
from cosim.theory.observers.assumptions import (
    DECOUPLING,
    DETECTABILITY,
    DIRECT_PATH,
    HURWITZ,
    AssumptionVerdict,
    gain_evidence,
    observer_verdicts,
    outputs_verdict,
    plain_modes,
    plant_verdicts,
    refused,
    undecided,
)
from cosim.theory.observers.placement import modes

MATRICES: Final = "matrices"
CLASS: Final = "disturbance class (Assumption 3)"
DELAYS: Final = "delays (Assumption 3)"
ALPHAS: Final = "alphas (21)"
START: Final = "start time (36)"
STEP: Final = "communication step"
METHOD: Final = "method"
EXCITATION: Final = "persistent excitation"
FEEDBACK: Final = "A - B K Hurwitz"
ZEROS: Final = "no zero at a mode of the disturbance"
STABILITY: Final = "stability of the sampled loop"
ACTIVATION: Final = "use of the internal model"
LIMITS: Final = "limits of u"
OF_Y: Final = ("output-error", "augmented-kalman", "extended-kalman")  # the others: of mu
INSEPARABLE: Final = 1e-9  # of directions of chi or delta by theta, relative: as good as none


# --- models and components ---


def verdicts_of_model(name: str, beginning: Beginning) -> list[AssumptionVerdict]:
    """Return what a model of the file fulfills."""
    try:
        return list(plant_verdicts(beginning.context.model(name)))
    except UsageError:
        problems = beginning.builder.problems
        texts = [text for key, text in problems if key[:2] == ("models", name)]
        return [refused(MATRICES, AssumptionError(text)) for text in texts]


@dataclass(frozen=True, eq=False)
class _Checked(ABC):
    """A component whose assumptions are checked."""

    name: str
    kind: Any
    beginning: Beginning

    @property
    def context(self) -> BuildContext:
        """What it was built in."""
        return self.beginning.context

    @abstractmethod
    def table(self) -> dict[str, Callable[[], Evidence]]:
        """Return its assumptions, each with what checks it."""

    def verdicts(self) -> list[AssumptionVerdict]:
        """Return what is fulfilled."""
        return [attempted(name, check) for name, check in self.table().items()]


def _behind_failure(verdicts: Iterable[AssumptionVerdict]) -> Iterator[AssumptionVerdict]:
    """Yield verdicts of which each rests on those before it."""
    failing = ""
    for verdict in verdicts:
        yield undecided(verdict.name, f"{failing} is not fulfilled") if failing else verdict
        failing = failing or ("" if verdict.fulfilled else verdict.name)


class _Observer(_Checked):
    kind: UnknownInputObserverKind

    def table(self) -> dict[str, Callable[[], Evidence]]:
        return {HURWITZ: lambda: gain_evidence(self.kind.design(self.name, self.context).design)}

    def verdicts(self) -> list[AssumptionVerdict]:
        try:
            reduced = self.kind.design_model_of(self.name, self.context).reduced
        except UsageError as error:  # said of the model, or of the table
            reason = str(error) or RESTS_ON_INVALID
            assumptions = (DIRECT_PATH, DECOUPLING, DETECTABILITY, HURWITZ)
            open_ones = {assumption: undecided(assumption, reason) for assumption in assumptions}
            known = self.beginning.scenario.file.models
            if not isinstance(error, DependsOnInvalid) and self.kind.model in known:
                shape = self.context.model(self.kind.model).Dd.shape
                open_ones[DECOUPLING] = outputs_verdict(*shape)
            return list(open_ones.values())
        verdicts = list(observer_verdicts(reduced))
        failing = [verdict.name for verdict in verdicts if verdict.fulfilled is False]
        if failing:
            return [*verdicts, undecided(HURWITZ, f"{failing[0]} is not fulfilled")]
        verdicts += super().verdicts()
        if self.kind.relinearize:
            verdicts = list(map(_at_operating_point, verdicts))
        return verdicts


def _at_operating_point(verdict: AssumptionVerdict) -> AssumptionVerdict:
    """Return a verdict on a model that is linearized anew on the way, where the run checks it."""
    if not verdict.fulfilled:
        return verdict
    evidence = (
        f"not decided: fulfilled at the operating point ({verdict.evidence}); checked again during "
        "the run"
    )
    return replace(verdict, fulfilled=None, evidence=evidence)


class _Regressor(_Checked):
    """The class of the disturbance, the delays, the alphas; each rests on the one before."""

    kind: RegressorKind

    def table(self) -> dict[str, Callable[[], Evidence]]:
        return {CLASS: self._class, DELAYS: self._delays, ALPHAS: self._alphas}

    def verdicts(self) -> list[AssumptionVerdict]:
        return list(_behind_failure(super().verdicts()))

    def _class(self) -> Evidence:
        of_class = self.kind.disturbance_class()
        of_class.check_distinguishable(self.context.clock)
        sizes = [part.sizes for part in of_class.by_element]
        return _by_element(map(_class_text, of_class.by_element)), {
            "basis_functions": sum(map(sum, sizes)),
            "groups": sum(map(len, sizes)),
            "terms": sum(map(regression.count_terms, sizes)),
        }

    def _delays(self) -> Evidence:
        """Check the delays: rates that differ by a multiple of 2 pi / divisor look alike."""
        of_class = self.kind.disturbance_class()
        steps = self.kind.delay_steps(of_class, self.context)
        divisor = math.gcd(*(count - steps[0] for count in steps)) * self.context.h
        limit = math.pi / divisor
        delays = list(self.kind.delays)
        values: dict[str, Any] = {"delays": delays, "common_divisor": divisor}
        evidence = f"{len(delays)} distinct delays, whole multiples of {divisor:g} s apart"
        theta = self.beginning.theta(self.name)
        if theta is None:
            return f"{evidence}; a rate above {limit:.3g} rad/s would alias to a slower one", values
        each = generators(of_class.families).each
        matrices = [generator.matrix(theta[generator.theta]) for generator in each]
        rate = float(max(np.abs(np.linalg.eigvals(G).imag).max() for G in matrices))
        values["fastest_rate"] = rate
        if rate >= limit:
            raise AssumptionError(
                f"delays are whole multiples of {divisor:g} s apart, so that a rate of {rate:.3g} "
                f"rad/s, above {limit:.3g} rad/s, aliases to a slower one",
                cure=f"choose two delays less than {math.pi / rate:.3g} s apart",
            )
        if rate:
            evidence += f": no rate is above {limit:.3g} rad/s, the fastest is {rate:.3g}"
        return evidence, values

    def _alphas(self) -> Evidence:
        texts = []
        margins = []
        for part in self.kind.design(self.name, self.context).by_element:
            names = ", ".join(repr(alpha.text) for alpha in part.group_alphas)
            text = f"none of {names} is a multiple of another, as output error requires"
            if len(part.groups) < 2:
                text = f"one alpha for all terms: {names}"
            elif part.known.unknown:
                text = (
                    f"{names}: known only during the run, which checks them where it judges "
                    "estimates"
                )
            elif part.needs_independence:
                margin = part.independence(self.context.clock)
                margins.append(margin)
                text = f'the products of {names} are dependent; use method = "output-error"'
                if margin > regression.COLLINEAR:
                    text = (
                        f"the products of {names} are independent: smallest singular value "
                        f"{margin:.2g}, dependent below {regression.COLLINEAR:.0e}"
                    )
            texts.append(text)
        if not margins:
            return _by_element(texts), {}
        least = {"smallest_singular_value": min(margins), "least": regression.COLLINEAR}
        return _by_element(texts), least


def _by_element(texts: Iterable[str]) -> str:
    listed = list(texts)
    if len(listed) == 1:
        return listed[0]
    return "; ".join(f"element {element}: {text}" for element, text in enumerate(listed))


def _class_text(part: RegressorDesign) -> str:
    names = ", ".join(family.name for family in part.families)
    sizes = part.sizes
    problem = regression.linear_route_problem(sizes)
    remark = regression.linear_route_warning(sizes)
    if problem:
        remark = f'{problem}; use method = "output-error"'
    text = (
        f"{names}: {sum(sizes)} basis functions under {len(sizes)} alpha(s), "
        f"{regression.count_terms(sizes)} terms of the regression"
    )
    return f"{text}; {remark}" if remark else text


class _Identifier(_Checked):
    """A start within the run, a short step, a method, excitation."""

    kind: IdentifierKind

    def table(self) -> dict[str, Callable[[], Evidence]]:
        return {
            START: self._start,
            STEP: self._step,
            METHOD: self._method,
            EXCITATION: self._excitation,
        }

    @property
    def _source(self) -> IdentifierSource:
        return IdentifierSource(self.name, self.context)

    def _start(self) -> Evidence:
        T_id = self._source.start_time(self.kind.start)
        stop = self.context.clock.stop
        times = self.context.metadata.get(self.name, {})
        values: dict[str, Any] = {"start_time": T_id, "stop": stop}
        evidence = f"T_id = {T_id:.6g} s"
        if "T_id" in times:
            values |= {key: times[key] for key in ("T_obs", "T_f", "D_max", "T_id")}
            parts = [f"{key} {times[key]:.4g}" for key in ("T_obs", "T_f", "D_max")]
            evidence += f" = {' + '.join(parts)} s"
        evidence += f"; the run ends at {stop:g} s"
        if T_id >= stop:
            cure = "use a longer run, faster poles, a faster filter or shorter delays"
            raise AssumptionError(evidence, cure=cure)
        return evidence, values

    def _step(self) -> Evidence:
        source = self._source
        source.check_step()
        evidence = "the alphas are signals of the run, interpolated linearly between its points"
        known = source.regression.known.names
        if known:
            evidence = (
                f"over a step of {self.context.h:g} s linear interpolation of "
                f"{', '.join(map(repr, known))} is within 1 %"
            )
            if self.context.clock.steps > STEPS_CHECKED:
                evidence += f" in the first {STEPS_CHECKED} steps"
        return evidence, {"step": self.context.h}

    def _method(self) -> Evidence:
        builder = self.beginning.builder
        design = self._source.regression
        for key, text in builder.problems:
            if key[:2] == ("components", self.name):
                raise AssumptionError(text)
        if self.name not in builder.components:
            raise DependsOnInvalid
        method = self.kind.method
        values = {"theta": generators(design.families).parameters}
        if method in LINEAR_METHODS:
            values["eta"] = len(design.terms) - 1
            return f"{method}: {values['eta']} coefficients, theta by formula", values
        origin = "the model of y" if method in OF_Y else "the regression"
        return f"{method}: {values['theta']} parameters, from {origin}", values

    def _excitation(self) -> Evidence:
        theta = self.beginning.theta_behind(self.name)
        delta = self.beginning.delta
        if theta is None or delta is None:
            raise DependsOnInvalid("theta and amplitudes are not known before the run")
        if not len(theta):
            raise DependsOnInvalid("the terms have no parameter")
        design = self._source.regression
        method = self.kind.method
        if method not in OF_Y and not design.is_expanded:
            raise DependsOnInvalid(f"method {method!r} does not support these terms")
        if design.known.unknown:
            raise AssumptionError("the alphas are known only during the run")
        of_groups = design.known(self.beginning.clock.points)
        if method in OF_Y:
            return self._of_disturbance(design, theta, delta, of_groups)
        mu = self._regression(design, delta, of_groups)
        if method in LINEAR_METHODS:
            return self._linear(information(mu[:, 1:], self.beginning.clock.h))
        return _nonlinear(design, mu, theta)

    def _of_disturbance(
        self, design: RegressorDesign, theta: Vector, delta: Vector, of_groups: Matrix
    ) -> Evidence:
        """Return whether the disturbance determines theta, for what is fitted to y."""
        t = self.beginning.clock.points
        alpha = np.empty((len(t), len(design.families)))
        for b, group in enumerate(design.groups):
            alpha[:, list(group.components)] = of_groups[:, [b]]
        smallest = effect_of_theta(design.families, theta, t, alpha, delta)
        change = 1.0 / (t[-1] - t[0])
        evidence, values = _determined("disturbance", smallest)
        rest = f", for a change of theta by {change:.3g} and whatever its constants"
        return evidence + rest, {**values, "change": change}

    def _regression(self, design: RegressorDesign, delta: Vector, of_groups: Matrix) -> Matrix:
        """Return mu of the disturbance itself, from the start time on."""
        clock = self.beginning.clock
        T_id = self._source.start_time(self.kind.start)
        begin = round((T_id - clock.start_time) / clock.h)
        if len(delta) - begin < 2:
            raise AssumptionError(f"the run ends before T_id = {T_id:g} s")
        places = np.arange(begin, len(delta))[:, np.newaxis] - np.array(design.steps)
        return regression.mu(design.terms, delta[places], of_groups[places])

    def _linear(self, of_eta: Matrix) -> Evidence:
        """Return whether the information determines eta, beside its prior."""
        eigenvalues = np.asarray(np.linalg.eigvalsh(of_eta), np.float64)
        prior = None if self.kind.P0 is None else 1.0 / self.kind.P0
        text = describe_excitation(eigenvalues, prior)
        smallest = float(eigenvalues.min())
        largest = float(eigenvalues.max())
        rounding = len(eigenvalues) * float(np.finfo(np.float64).eps) * largest
        if smallest <= rounding:
            raise AssumptionError(text, cure="choose other delays, or fewer components")
        if prior is not None and prior >= COMPARABLE * smallest:
            evidence, _, cure = text.rpartition("; ")
            raise AssumptionError(evidence, cure=cure)
        return f"without noise {text}", {"smallest": smallest, "largest": largest}


def _nonlinear(design: RegressorDesign, mu: Matrix, theta: Vector) -> Evidence:
    """Return whether the regression determines theta near its true value."""
    R = triangle(mu)  # R'R = sum mu mu'
    minors = Minors(generators(design.families), design.groups, design.terms)
    chi, slopes = minors.chi(theta, np.array(design.delays))
    across = slopes - np.outer(slopes @ chi / (chi @ chi), chi)
    lengths = np.linalg.norm(across, axis=1)
    scaled = across / np.where(lengths > 0.0, lengths, 1.0)[:, np.newaxis]
    changes = np.linalg.svd(R @ scaled.T, compute_uv=False) / np.linalg.norm(R)
    return _determined("regression", float(changes.min()))


def _determined(what: str, smallest: float) -> Evidence:
    """Return whether something determines theta, by how it changes along directions of theta."""
    if smallest <= INSEPARABLE:
        cause = "a component is absent, or two are alike"
        cure = "use amplitudes that are not 0, and components that differ"
        if what == "regression":
            cause += ", or the alphas or delays differ too little"
            cure += ', other delays, or method = "output-error"'
        raise AssumptionError(
            f"the {what} does not determine theta: along one direction of theta it changes by "
            f"{smallest:.2g} of itself; {cause}",
            cure=cure,
        )
    return (
        f"without noise the {what} determines theta: along every direction of theta it changes by "
        f"at least {smallest:.2g} of itself"
    ), {"smallest": smallest, "least": INSEPARABLE}


class _Compensation(_Checked):
    """A stable loop, proven in an interval, and limits that suffice."""

    kind: CompensatorKind

    def table(self) -> dict[str, Callable[[], Evidence]]:
        table = {FEEDBACK: self._feedback, ZEROS: self._zeros, STABILITY: self._stability}
        if self.kind.internal_model:
            table[ACTIVATION] = self._activation
        return {**table, LIMITS: self._limits}

    def verdicts(self) -> list[AssumptionVerdict]:
        verdicts = super().verdicts()
        if any(verdict.name == STABILITY and verdict.fulfilled is False for verdict in verdicts):
            self.beginning.refused.append(self.name)
        return verdicts

    @cached_property
    def _design(self) -> CompensatorDesign:
        return self.kind.design(self.name, self.context)

    @cached_property
    def _identifier(self) -> str | None:
        """The identifier whose theta it takes, where it takes one directly."""
        with suppress(DependsOnInvalid):
            return self.context.driver(Port(self.name, "theta"))
        return None

    @cached_property
    def _theta(self) -> Vector | None:
        """Theta of the disturbance, in the order of the terms; None: it is not known."""
        if self._identifier is None or self.kind.terms is not None:
            return None
        return self.beginning.theta_behind(self._identifier)

    def _feedback(self) -> Evidence:
        plant, K = self._design.feedback
        eigenvalues = np.linalg.eigvals(plant.A - plant.B @ K).astype(np.complex128)
        fixed = unreached_modes(plant)
        n = len(plant.A)
        reached = f"{n - len(fixed)} of {n} modes are controllable from u"
        if len(fixed):
            reached += f", the others are stable: {modes(fixed)}"
        slowest = slowest_rate(K, plant)
        evidence = f"{reached}; eigenvalues {modes(eigenvalues)}, slowest rate {slowest:.3g} 1/s"
        return evidence, {
            "eigenvalues": plain_modes(eigenvalues),
            "unreached": plain_modes(fixed),
            "slowest_rate": slowest,
        }

    def _zeros(self) -> Evidence:
        gains = self._design.gains
        zeros = gains.plant.zeros
        values: dict[str, Any] = {"zeros": plain_modes(zeros)}
        evidence = f"transmission zeros from u to the regulated outputs: {modes(zeros)}"
        nearest = None
        if self.kind.internal_model:
            nearest = check_zeros(gains.plant, gains.model, gains.box)
        if nearest is not None:
            distance = abs(nearest.mode - nearest.zero)
            values["distance"] = distance
            evidence += (
                f"; the nearest mode of the disturbance, {modes([nearest.mode])}"
                f"{_where(nearest.theta)}, is {distance:.3g} 1/s away"
            )
        return evidence, values

    def _stability(self) -> Evidence:
        held = self.beginning.graph.held[self.name]
        h = self.beginning.clock.h
        certified = self._design.compensator.certified(h, held)
        self.beginning.designs[self.name] = self._design.compensator.design(certified, h)

        def margin(what: str, rate: float) -> str:
            return (
                f"{what} the loop decays at {rate:.3g} 1/s (spectral radius "
                f"{math.exp(-rate * h):.6g} for a step of {h:g} s)"
            )

        before = margin("without the internal model", certified.base_rate)
        values: dict[str, Any] = {"decay_rate_without": certified.base_rate}
        if not self.kind.internal_model:
            return before, values
        values |= {
            "decay_rate": certified.rate,
            "spectral_radius": math.exp(-certified.rate * h),
            "theta": list(certified.theta),
            "cells": certified.cells,
        }
        proven = "proven"
        if certified.theta:
            varies = "theta that varies" if certified.cells == 1 else "constant theta"
            box = self._design.gains.box
            proven += f" for every {varies} in {box.text}, in {certified.cells} cell(s)"
        slowest = margin("with it", certified.rate) + _where(certified.theta)
        return f"{proven}; {before}; {slowest}", values

    def _activation(self) -> Evidence:
        box = self._design.gains.box
        if not len(box.lower):
            return "the class has no parameter: the internal model is active from the start", {}
        largest_error = self.kind.largest_error
        values: dict[str, Any] = {"largest_error": largest_error}
        condition = f"active once the 95 % interval of theta is within {box.text}"
        theta = self._theta
        if theta is None:
            return f"{condition} and its standard error is at most {largest_error:g} of it", values
        never = "the internal model is never activated"
        activation = Activation(box.lower, box.upper, largest_error)
        allowed = activation.largest_standard_error(theta)
        values["largest_standard_error"] = allowed.tolist()
        if (allowed <= 0.0).any():
            at_end = f"theta = {_numbers(theta)} is on the boundary of the certified {box.text}"
            raise AssumptionError(
                f"{never}: {activation.reason(theta, np.zeros(len(theta))) or at_end}",
                cure="choose an interval that contains the theta of the disturbance",
            )
        needed = (
            f"at theta = {_numbers(theta)} of the disturbance the standard error must be at most "
            f"{_numbers(allowed)}"
        )
        reached = self._least_error(theta)
        if reached is None:
            return f"{condition}: {needed}", values
        values["least_standard_error"] = reached.tolist()
        least = f"at best y allows {_numbers(reached)} by the end of the run (Cramer-Rao bound)"
        if not (reached <= allowed).all():
            cure = "use a longer run, less noise of y, or a larger largest_error or interval"
            raise AssumptionError(f"{never}: {needed}, and {least}", cure=cure)
        return f"{condition}: {needed}; {least}", values

    def _least_error(self, theta: Vector) -> Vector | None:
        """Return the least standard error of theta from all y of the run; None: it is not known.

        What u does to y is known, so that the bound is that without u, also in this loop.
        """
        delta = self.beginning.delta
        identified: IdentifiedPlant | None = self.context.identified.get(self._identifier or "")
        if self._identifier is None or identified is None or delta is None or identified.extent:
            return None
        plant = identified.plant
        scenario = self.beginning.scenario
        t = self.context.clock.points
        try:
            noise, _ = noise_of(scenario, self._identifier, identified.observer, len(plant.C))
            alpha = identified.alpha(t)
        except UsageError:
            return None
        d = delta[:, np.newaxis]
        held = np.zeros(1, np.bool_)
        x = simulate(plant.A, plant.Bd[:, :1], t, d, np.zeros(len(plant.A)), held)
        y = x @ plant.C.T + d @ plant.Dd[:, :1].T
        data = DataSet(t, y, np.zeros((len(t), plant.B.shape[1])), alpha)
        offset = identified.offset
        bound = accuracy_bound(plant, identified.families, theta, data, noise=noise, offset=offset)
        return bound.standard_error

    def _limits(self) -> Evidence:
        lower = self._design.compensator.options.lower
        upper = self._design.compensator.options.upper
        needed = self._needed_input()
        values: dict[str, Any] = {}
        parts = []
        exceeds = False
        if needed is not None:
            ends = [needed.min(axis=0), needed.max(axis=0)]
            exceeds = bool(((ends[0] < lower) | (ends[1] > upper)).any())
            values = {"needed": [end.tolist() for end in ends]}
            parts = [f"rejecting the disturbance takes u {_range(*ends)}"]
        if not (np.isfinite(lower).any() or np.isfinite(upper).any()):
            return "; ".join(["u has no limits", *parts]), values
        limits = f"limits {_range(lower, upper)}"
        if exceeds:
            cure = "widen the limits, or reduce the disturbance"
            raise AssumptionError(f"{parts[0]}, but it has {limits}", cure=cure)
        windup = "at a limit the internal model tracks u (back-calculation) and decays"
        if not self.kind.internal_model:
            windup = "there is no internal model to wind up"
        elif not self.kind.anti_windup:
            windup = "anti_windup = false: at a limit the internal model winds up"
        return "; ".join([limits, *parts, windup]), values

    def _needed_input(self) -> Matrix | None:
        """Return the course of u that rejects the disturbance; None: it is not known."""
        theta = self._theta
        delta = self.beginning.delta
        if theta is None or delta is None or not self.kind.internal_model:
            return None
        families = self._design.families
        ends = np.cumsum([len(family.parameters) for family in families])
        known = KnownDisturbance(families, np.split(theta, ends[:-1]), delta, self.context.h)
        plant, _ = self._design.feedback
        return steady_input(plant, known)


def _where(theta: Iterable[float]) -> str:
    values = np.array(list(theta))
    return f", at theta = {_numbers(values)}" if len(values) else ""


def _range(lower: Vector, upper: Vector) -> str:
    return f"from {_numbers(lower)} to {_numbers(upper)}"


def _numbers(values: Vector) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


CHECKS: Final[Mapping[type, type[_Checked]]] = {
    UnknownInputObserverKind: _Observer,
    RegressorKind: _Regressor,
    IdentifierKind: _Identifier,
    CompensatorKind: _Compensation,
}
