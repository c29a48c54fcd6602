"""What the method asks of models, observers, regressors, identifiers and compensators."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
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
)
from cosim.scenario.building.known_truth import covariance_of, noise_of
from cosim.scenario.kinds.build_record import DependsOnInvalid
from cosim.scenario.kinds.compensators import CompensatorDesign, CompensatorKind
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.identification_source import IdentifierSource, start_time
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.kinds.regressor import RegressorDesign, RegressorKind
from cosim.scenario.kinds.terms import element_count, families_of, unchecked
from cosim.scenario.kinds.variants import LINEAR_METHODS
from cosim.theory.assessment.accuracy import STEPS_CHECKED
from cosim.theory.compensation.activation import Activation
from cosim.theory.compensation.state_feedback import slowest_rate, unreached_modes
from cosim.theory.compensation.steady_input import KnownDisturbance, steady_input
from cosim.theory.compensation.transmission_zeros import check_zeros
from cosim.theory.disturbances import regression
from cosim.theory.disturbances.excitation import COMPARABLE, describe_excitation, information
from cosim.theory.disturbances.families import Family, generators, group_by_alpha
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


# --- models and observers ---


def verdicts_of_model(name: str, beginning: Beginning) -> list[AssumptionVerdict]:
    """Return what a model of the file fulfills."""
    try:
        return list(plant_verdicts(beginning.context.model(name)))
    except UsageError:
        problems = beginning.builder.problems
        texts = [text for key, text in problems if key[:2] == ("models", name)]
        return [refused(MATRICES, AssumptionError(text)) for text in texts]


def _of_observer(
    name: str, kind: UnknownInputObserverKind, beginning: Beginning
) -> list[AssumptionVerdict]:
    context = beginning.context

    def all_open(reason: str) -> dict[str, AssumptionVerdict]:
        assumptions = (DIRECT_PATH, DECOUPLING, DETECTABILITY, HURWITZ)
        return {assumption: undecided(assumption, reason) for assumption in assumptions}

    try:
        reduced = kind.design_model_of(name, context).reduced
    except DependsOnInvalid as error:
        return list(all_open(str(error) or RESTS_ON_INVALID).values())
    except UsageError as error:
        verdicts = all_open("there is no reduced system")
        if kind.model in beginning.scenario.file.models:
            verdicts[DECOUPLING] = outputs_verdict(*context.model(str(kind.model)).Dd.shape)
        else:
            verdicts[DIRECT_PATH] = refused(DIRECT_PATH, AssumptionError(str(error)))
        return list(verdicts.values())
    of_plant = list(observer_verdicts(reduced))
    failing = [verdict.name for verdict in of_plant if verdict.fulfilled is False]
    if failing:
        return [*of_plant, undecided(HURWITZ, f"{failing[0]} is not fulfilled")]
    gain = attempted(HURWITZ, lambda: gain_evidence(kind.design(name, context).design))
    if kind.relinearize:
        return [_at_operating_point(verdict) for verdict in (*of_plant, gain)]
    return [*of_plant, gain]


def _at_operating_point(verdict: AssumptionVerdict) -> AssumptionVerdict:
    """Return a verdict on a model that is linearized anew on the way, where the run checks it."""
    if not verdict.fulfilled:
        return verdict
    evidence = (
        f"not decided: fulfilled at the operating point ({verdict.evidence}); checked again during "
        "the run"
    )
    return replace(verdict, fulfilled=None, evidence=evidence)


# --- regressors: the class of the disturbance, the delays, the alphas ---


def _of_regressor(name: str, kind: RegressorKind, beginning: Beginning) -> list[AssumptionVerdict]:
    of_class = attempted(CLASS, lambda: _class(kind, beginning))
    if not of_class.fulfilled:
        reason = "the disturbance class is invalid"
        return [of_class, undecided(DELAYS, reason), undecided(ALPHAS, reason)]
    delays = attempted(DELAYS, lambda: _delays(kind, beginning, beginning.theta(name)))
    if not delays.fulfilled:
        return [of_class, delays, undecided(ALPHAS, "the delays are invalid")]
    return [of_class, delays, attempted(ALPHAS, lambda: _alphas(name, kind, beginning))]


def _elements(kind: RegressorKind) -> list[tuple[list[Family], tuple[int, ...]]]:
    """Return the families, and the sizes of their groups, for each element of delta."""
    families = families_of(kind.terms)
    texts = [alpha.text for alpha in unchecked(kind.alphas)]
    elements = []
    for element in range(element_count(kind.terms)):
        own = [i for i, term in enumerate(kind.terms) if term.element == element]
        of_element = [families[i] for i in own]
        groups = group_by_alpha([texts[i] for i in own], of_element)
        elements.append((of_element, tuple(group.size for group in groups)))
    return elements


def _by_element(texts: Sequence[str]) -> str:
    if len(texts) == 1:
        return texts[0]
    return "; ".join(f"element {element}: {text}" for element, text in enumerate(texts))


def _class(kind: RegressorKind, beginning: Beginning) -> Evidence:
    kind.check_distinguishable(beginning.context)
    elements = _elements(kind)
    evidence = _by_element([_class_text(families, sizes) for families, sizes in elements])
    all_sizes = list(chain.from_iterable(sizes for _, sizes in elements))
    return evidence, {
        "basis_functions": sum(all_sizes),
        "groups": len(all_sizes),
        "terms": sum(regression.count_terms(sizes) for _, sizes in elements if sizes),
    }


def _class_text(families: Sequence[Family], sizes: tuple[int, ...]) -> str:
    if not families:
        raise UsageError("expected at least one term for each element of delta, got none")
    names = ", ".join(family.name for family in families)
    problem = regression.linear_route_problem(sizes)
    remark = regression.linear_route_warning(sizes)
    if problem:
        remark = f'{problem}; use method = "output-error"'
    text = (
        f"{names}: {sum(sizes)} basis functions under {len(sizes)} alpha(s), "
        f"{regression.count_terms(sizes)} terms of the regression"
    )
    return f"{text}; {remark}" if remark else text


def _delays(kind: RegressorKind, beginning: Beginning, theta: Vector | None) -> Evidence:
    """Check the delays: rates that differ by a multiple of 2 pi / divisor look alike."""
    context = beginning.context
    longest = max(sum(sizes) for _, sizes in _elements(kind))
    regression.check_delays(kind.delays, longest + 1)
    steps = kind.delay_steps(context)
    divisor = math.gcd(*(count - steps[0] for count in steps)) * context.h
    limit = math.pi / divisor
    values: dict[str, Any] = {"delays": list(kind.delays), "common_divisor": divisor}
    evidence = f"{len(kind.delays)} distinct delays, whole multiples of {divisor:g} s apart"
    if theta is None:
        return f"{evidence}; a rate above {limit:.3g} rad/s would alias to a slower one", values
    matrices = [each.matrix(theta[each.theta]) for each in generators(families_of(kind.terms)).each]
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


def _alphas(name: str, kind: RegressorKind, beginning: Beginning) -> Evidence:
    context = beginning.context
    texts = []
    margins = []
    for part in kind.design(name, context).by_element:
        names = ", ".join(repr(alpha.text) for alpha in part.group_alphas)
        text = f"none of {names} is a multiple of another, as output error requires"
        if len(part.groups) < 2:
            text = f"one alpha for all terms: {names}"
        elif part.known.unknown:
            text = (
                f"{names}: known only during the run, which checks them where it judges estimates"
            )
        elif part.needs_independence:
            times = part.times_before(context.clock)
            sampled = part.known(times.ravel()).reshape(*times.shape, len(part.groups))
            margin = regression.independence(part.terms, sampled)
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


# --- identifiers: a start within the run, a short step, a method, excitation ---


def _of_identifier(
    name: str, kind: IdentifierKind, beginning: Beginning
) -> list[AssumptionVerdict]:
    return [
        attempted(START, lambda: _start(name, kind, beginning)),
        attempted(STEP, lambda: _step(name, beginning)),
        attempted(METHOD, lambda: _method(name, kind, beginning)),
        _excitation(name, kind, beginning),
    ]


def _start(name: str, kind: IdentifierKind, beginning: Beginning) -> Evidence:
    context = beginning.context
    T_id = start_time(kind.start, IdentifierSource(name, context), context)
    stop = context.clock.stop
    times = context.metadata.get(name, {})
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


def _step(name: str, beginning: Beginning) -> Evidence:
    context = beginning.context
    source = IdentifierSource(name, context)
    source.check_step()
    evidence = "the alphas are signals of the run, interpolated linearly between its points"
    known = source.regression.known.names
    if known:
        evidence = (
            f"over a step of {context.h:g} s linear interpolation of "
            f"{', '.join(map(repr, known))} is within 1 %"
        )
        if context.clock.steps > STEPS_CHECKED:
            evidence += f" in the first {STEPS_CHECKED} steps"
    return evidence, {"step": context.h}


def _method(name: str, kind: IdentifierKind, beginning: Beginning) -> Evidence:
    builder = beginning.builder
    design = IdentifierSource(name, builder.context).regression
    for key, text in builder.problems:
        if key[:2] == ("components", name):
            raise AssumptionError(text)
    if name not in builder.components:
        raise DependsOnInvalid
    parameters = generators(design.families).parameters
    if kind.method in LINEAR_METHODS:
        n_eta = len(design.terms) - 1
        evidence = f"{kind.method}: {n_eta} coefficients, theta by formula"
        return evidence, {"theta": parameters, "eta": n_eta}
    origin = "the model of y" if kind.method in OF_Y else "the regression"
    return f"{kind.method}: {parameters} parameters, from {origin}", {"theta": parameters}


def _excitation(name: str, kind: IdentifierKind, beginning: Beginning) -> AssumptionVerdict:
    theta = beginning.theta_behind(name)
    delta = beginning.delta
    if theta is None or delta is None:
        return undecided(EXCITATION, "theta and amplitudes are not known before the run")
    if not len(theta):
        return undecided(EXCITATION, "the terms have no parameter")

    def excited() -> Evidence:
        source = IdentifierSource(name, beginning.context)
        if kind.method in OF_Y:
            return _of_disturbance(source.regression, theta, delta, beginning)
        if not source.regression.is_expanded:
            raise DependsOnInvalid(f"method {kind.method!r} does not support these terms")
        mu = _regression(kind, source, delta, beginning)
        if kind.method in LINEAR_METHODS:
            return _linear(kind, information(mu[:, 1:], beginning.clock.h))
        return _nonlinear(source.regression, mu, theta)

    return attempted(EXCITATION, excited)


def _known_alphas(design: RegressorDesign, beginning: Beginning) -> Matrix:
    """Return the alphas of the groups at the communication points."""
    if design.known.unknown:
        raise AssumptionError("the alphas are known only during the run")
    return design.known(beginning.clock.points)


def _of_disturbance(
    design: RegressorDesign, theta: Vector, delta: Vector, beginning: Beginning
) -> Evidence:
    """Return whether the disturbance determines theta, for what is fitted to y."""
    of_groups = _known_alphas(design, beginning)
    t = beginning.clock.points
    alpha = np.empty((len(t), len(design.families)))
    for b, group in enumerate(design.groups):
        alpha[:, list(group.components)] = of_groups[:, [b]]
    smallest = effect_of_theta(design.families, theta, t, alpha, delta)
    change = 1.0 / (t[-1] - t[0])
    evidence, values = _determined("disturbance", smallest)
    rest = f", for a change of theta by {change:.3g} and whatever its constants"
    return evidence + rest, {**values, "change": change}


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


def _regression(
    kind: IdentifierKind, source: IdentifierSource, delta: Vector, beginning: Beginning
) -> Matrix:
    """Return mu of the disturbance itself, from the start time on."""
    design = source.regression
    alpha = _known_alphas(design, beginning)
    clock = beginning.clock
    T_id = start_time(kind.start, source, beginning.context)
    begin = round((T_id - clock.start_time) / clock.h)
    if len(delta) - begin < 2:
        raise AssumptionError(f"the run ends before T_id = {T_id:g} s")
    places = np.arange(begin, len(delta))[:, np.newaxis] - np.array(design.steps)
    return regression.mu(design.terms, delta[places], alpha[places])


def _linear(kind: IdentifierKind, of_eta: Matrix) -> Evidence:
    """Return whether the information determines eta, beside its prior."""
    eigenvalues = np.asarray(np.linalg.eigvalsh(of_eta), np.float64)
    prior = None if kind.P0 is None else 1.0 / kind.P0
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


# --- compensators: a stable loop, proven in an interval, and limits that suffice ---


@dataclass(frozen=True, eq=False)
class _Compensation:
    """A compensator whose assumptions are checked."""

    name: str
    kind: CompensatorKind
    beginning: Beginning

    def verdicts(self) -> list[AssumptionVerdict]:
        """Return what is fulfilled."""
        verdicts = [attempted(FEEDBACK, self._feedback), attempted(ZEROS, self._zeros)]
        stability = attempted(STABILITY, self._stability)
        if stability.fulfilled is False:
            self.beginning.refused.append(self.name)
        verdicts.append(stability)
        if self.kind.internal_model:
            verdicts.append(attempted(ACTIVATION, self._activation))
        return [*verdicts, attempted(LIMITS, self._limits)]

    @cached_property
    def _design(self) -> CompensatorDesign:
        return self.kind.design(self.name, self.beginning.context)

    @cached_property
    def _identifier(self) -> str | None:
        """The identifier whose theta it takes, where it takes one directly."""
        try:
            return self.beginning.context.driver(Port(self.name, "theta"))
        except DependsOnInvalid:
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
            rest = f"its standard error is at most {largest_error:g} of it"
            return f"{condition} and {rest}", values
        activation = Activation(box.lower, box.upper, largest_error)
        allowed = activation.largest_standard_error(theta)
        values["largest_standard_error"] = allowed.tolist()
        if (allowed <= 0.0).any():
            reason = activation.reason(theta, np.zeros(len(theta)))
            at_end = f"theta = {_numbers(theta)} is on the boundary of the certified {box.text}"
            raise AssumptionError(
                f"the internal model is never activated: {reason or at_end}",
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
            raise AssumptionError(
                f"the internal model is never activated: {needed}, and {least}",
                cure="use a longer run, less noise of y, or a larger largest_error or interval",
            )
        return f"{condition}: {needed}; {least}", values

    def _least_error(self, theta: Vector) -> Vector | None:
        """Return the least standard error of theta from all y of the run; None: it is not known.

        What u does to y is known, so that the bound is that without u, also in this loop.
        """
        builder = self.beginning.builder
        delta = self.beginning.delta
        identified = builder.context.identified.get(self._identifier or "")
        if self._identifier is None or identified is None or delta is None or identified.extent:
            return None
        plant = identified.plant
        t = builder.clock.points
        try:
            noise, _ = noise_of(builder.scenario, self._identifier, identified.observer)
            alpha = identified.alpha(t)
        except UsageError:
            return None
        covariance = covariance_of(noise, len(plant.C))
        if covariance is None:
            return None
        d = delta[:, np.newaxis]
        held = np.zeros(1, np.bool_)
        x = simulate(plant.A, plant.Bd[:, :1], t, d, np.zeros(len(plant.A)), held)
        y = x @ plant.C.T + d @ plant.Dd[:, :1].T
        data = DataSet(t, y, np.zeros((len(t), plant.B.shape[1])), alpha)
        families = identified.families
        offset = identified.offset
        bound = accuracy_bound(plant, families, theta, data, noise=covariance, offset=offset)
        return bound.standard_error

    def _limits(self) -> Evidence:
        lower = self._design.compensator.options.lower
        upper = self._design.compensator.options.upper
        needed = self._needed_input()
        values: dict[str, Any] = {}
        effort = ""
        exceeds = False
        if needed is not None:
            lowest = needed.min(axis=0)
            highest = needed.max(axis=0)
            exceeds = bool(((lowest < lower) | (highest > upper)).any())
            values = {"needed": [lowest.tolist(), highest.tolist()]}
            effort = (
                f"rejecting the disturbance takes u from {_numbers(lowest)} to {_numbers(highest)}"
            )
        if not (np.isfinite(lower).any() or np.isfinite(upper).any()):
            return "; ".join(filter(None, ("u has no limits", effort))), values
        limits = f"limits from {_numbers(lower)} to {_numbers(upper)}"
        if exceeds:
            raise AssumptionError(
                f"{effort}, but it has {limits}",
                cure="widen the limits, or reduce the disturbance",
            )
        windup = "at a limit the internal model tracks u (back-calculation) and decays"
        if not self.kind.internal_model:
            windup = "there is no internal model to wind up"
        elif not self.kind.anti_windup:
            windup = "anti_windup = false: at a limit the internal model winds up"
        return "; ".join(filter(None, (limits, effort, windup))), values

    def _needed_input(self) -> Matrix | None:
        """Return the course of u that rejects the disturbance; None: it is not known."""
        theta = self._theta
        delta = self.beginning.delta
        if theta is None or delta is None or not self.kind.internal_model:
            return None
        families = self._design.families
        ends = np.cumsum([len(family.parameters) for family in families])
        of_families = np.split(theta, ends[:-1])
        known = KnownDisturbance(families, of_families, delta, self.beginning.context.h)
        plant, _ = self._design.feedback
        return steady_input(plant, known)


def _where(theta: Iterable[float]) -> str:
    values = np.array(list(theta))
    return f", at theta = {_numbers(values)}" if len(values) else ""


def _numbers(values: Vector) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


CHECKS: Final[Mapping[type, Callable[[str, Any, Beginning], list[AssumptionVerdict]]]] = {
    UnknownInputObserverKind: _of_observer,
    RegressorKind: _of_regressor,
    IdentifierKind: _of_identifier,
    CompensatorKind: lambda *of: _Compensation(*of).verdicts(),
}
