"""What a compensator needs: a stable loop, proven in an interval, and limits that suffice."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.blocks.compensator import Compensator
from cosim.core.port import Port
from cosim.errors import AssumptionError, UsageError
from cosim.scenario.assumptions.attempts import Evidence, attempted
from cosim.scenario.assumptions.beginning import Beginning
from cosim.scenario.building.build import Builder
from cosim.scenario.building.known_truth import covariance_of, noise_of
from cosim.scenario.kinds.build_record import DependsOnInvalid
from cosim.scenario.kinds.compensators import CompensatorKind, observer_in_loop
from cosim.theory.compensation.activation import Activation
from cosim.theory.compensation.design import CompensatorGains
from cosim.theory.compensation.state_feedback import (
    RegulatedPlant,
    slowest_rate,
    unreached_modes,
)
from cosim.theory.compensation.steady_input import KnownDisturbance, steady_input
from cosim.theory.compensation.transmission_zeros import check_zeros
from cosim.theory.disturbed_plant import DataSet
from cosim.theory.experiment_design.bound import accuracy_bound
from cosim.theory.forced_response import simulate
from cosim.theory.observers.assumptions import AssumptionVerdict, plain_modes
from cosim.theory.observers.placement import modes

FEEDBACK: Final = "A - B K Hurwitz"
ZEROS: Final = "no zero at a mode of the disturbance"
STABILITY: Final = "stability of the sampled loop"
ACTIVATION: Final = "use of the internal model"
LIMITS: Final = "limits of u"


@dataclass(frozen=True, eq=False)
class CompensatorCheck:
    """A compensator whose assumptions are checked.

    Parameters
    ----------
    name : str
    kind : CompensatorKind
    builder : Builder
    beginning : Beginning
    theta : Vector or None
        Of the disturbance, in the order of the terms, where the scenario has it.
    delta : Vector, shape (N,), or None
        The disturbance at the communication points, where it is known before the run.
    """

    name: str
    kind: CompensatorKind
    builder: Builder
    beginning: Beginning
    theta: Vector | None
    delta: Vector | None

    def verdicts(self) -> list[AssumptionVerdict]:
        """Return what is fulfilled."""
        verdicts = [attempted(FEEDBACK, self._feedback), attempted(ZEROS, self._zeros)]
        stability = attempted(STABILITY, self._stability)
        if stability.fulfilled is False:
            self.beginning.refused.append(self.name)
        verdicts.append(stability)
        if self.kind.internal_model:
            verdicts.append(attempted(ACTIVATION, self._activation))
        verdicts.append(attempted(LIMITS, self._limits))
        return verdicts

    @cached_property
    def _plant_and_gain(self) -> tuple[RegulatedPlant, Matrix]:
        return self.kind.state_feedback(self.name, self.builder.context)

    @cached_property
    def _gains(self) -> CompensatorGains:
        return self.kind.gains(self.name, self.builder.context)

    @cached_property
    def _compensator(self) -> Compensator:
        context = self.builder.context
        observed = observer_in_loop(self.name, context)
        return self.kind.compensator(observed, context, self._gains)

    def _feedback(self) -> Evidence:
        plant, K = self._plant_and_gain
        eigenvalues = np.linalg.eigvals(plant.A - plant.B @ K).astype(np.complex128)
        fixed = unreached_modes(plant)
        n = len(plant.A)
        reached = f"{n - len(fixed)} of {n} modes are controllable from u"
        if len(fixed):
            reached += f", the others are stable: {modes(fixed)}"
        slowest = slowest_rate(K, plant)
        values = {
            "eigenvalues": plain_modes(eigenvalues),
            "unreached": plain_modes(fixed),
            "slowest_rate": slowest,
        }
        return (
            f"{reached}; eigenvalues {modes(eigenvalues)}, slowest rate {slowest:.3g} 1/s",
            values,
        )

    def _zeros(self) -> Evidence:
        gains = self._gains
        zeros = gains.plant.zeros
        values: dict[str, Any] = {"zeros": plain_modes(zeros)}
        evidence = f"transmission zeros from u to the regulated outputs: {modes(zeros)}"
        if not self.kind.internal_model:
            return evidence, values
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
        h = self.builder.clock.h
        certified = self._compensator.certified(h, held)
        self.beginning.designs[self.name] = self._compensator.design(certified, h)
        before = _margin("without the internal model", certified.base_rate, h)
        values: dict[str, Any] = {"decay_rate_without": certified.base_rate}
        if not self.kind.internal_model:
            return before, values
        slowest = _margin("with it", certified.rate, h) + _where(certified.theta)
        values |= {
            "decay_rate": certified.rate,
            "spectral_radius": math.exp(-certified.rate * h),
            "theta": list(certified.theta),
            "cells": certified.cells,
        }
        proven = "proven"
        if certified.theta:
            varies = "theta that varies" if certified.cells == 1 else "constant theta"
            proven = (
                f"proven for every {varies} in {self._gains.box.text}, in {certified.cells} cell(s)"
            )
        return f"{proven}; {before}; {slowest}", values

    def _activation(self) -> Evidence:
        gains = self._gains
        box = gains.box
        if not len(box.lower):
            return "the class has no parameter: the internal model is active from the start", {}
        activation = Activation(box.lower, box.upper, self.kind.largest_error)
        values: dict[str, Any] = {"largest_error": self.kind.largest_error}
        condition = f"active once the 95 % interval of theta is within {box.text}"
        if self.theta is None:
            return (
                f"{condition} and its standard error is at most {self.kind.largest_error:g} of it",
                values,
            )
        allowed = activation.largest_standard_error(self.theta)
        values["largest_standard_error"] = allowed.tolist()
        if (allowed <= 0.0).any():
            raise self._outside(activation, self.theta)
        needed = (
            f"at theta = {_numbers(self.theta)} of the disturbance the standard error must be at "
            f"most {_numbers(allowed)}"
        )
        reached = self._least_error()
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

    def _outside(self, activation: Activation, theta: Vector) -> AssumptionError:
        """Return the error of an interval that has not theta inside it."""
        exact = np.zeros(len(theta))
        at_end = (
            f"theta = {_numbers(theta)} is on the boundary of the certified {self._gains.box.text}"
        )
        return AssumptionError(
            f"the internal model is never activated: {activation.reason(theta, exact) or at_end}",
            cure="choose an interval that contains the theta of the disturbance",
        )

    def _least_error(self) -> Vector | None:
        """Return the least standard error of theta from all y of the run; None: it is not known.

        What u does to y is known, so that the bound is that without u, also in this loop.
        """
        builder = self.builder
        identifier = driven_by(self.name, builder)
        identified = builder.context.identified.get(identifier or "")
        if identifier is None or identified is None or self.delta is None or self.theta is None:
            return None
        try:
            noise, _ = noise_of(builder.scenario, identifier, identified.observer)
            t = builder.clock.points
            alpha = identified.alpha(t)
        except UsageError:
            return None
        plant = identified.plant
        covariance = covariance_of(noise, len(plant.C))
        if covariance is None or identified.extent:
            return None
        delta = self.delta[:, np.newaxis]
        held = np.zeros(1, np.bool_)
        x = simulate(plant.A, plant.Bd[:, :1], t, delta, np.zeros(len(plant.A)), held)
        y = x @ plant.C.T + delta @ plant.Dd[:, :1].T
        data = DataSet(t, y, np.zeros((len(t), plant.B.shape[1])), alpha)
        bound = accuracy_bound(
            plant,
            identified.families,
            self.theta,
            data,
            noise=covariance,
            offset=identified.offset,
        )
        return bound.standard_error

    def _limits(self) -> Evidence:
        options = self._compensator.options
        lower = options.lower
        upper = options.upper
        needed = self._needed_input()
        values: dict[str, Any] = {}
        effort = ""
        if needed is not None:
            lowest = needed.min(axis=0)
            highest = needed.max(axis=0)
            values = {"needed": [lowest.tolist(), highest.tolist()]}
            effort = (
                f"rejecting the disturbance takes u from {_numbers(lowest)} to {_numbers(highest)}"
            )
        if not (np.isfinite(lower).any() or np.isfinite(upper).any()):
            return f"u has no limits; {effort}".removesuffix("; "), values
        limits = f"limits from {_numbers(lower)} to {_numbers(upper)}"
        if needed is not None and ((lowest < lower) | (highest > upper)).any():
            raise AssumptionError(
                f"{effort}, but it has {limits}",
                cure="widen the limits, or reduce the disturbance",
            )
        return "; ".join(filter(None, (limits, effort, self._windup))), values

    @property
    def _windup(self) -> str:
        """What becomes of the internal model where u is at a limit."""
        if not self.kind.internal_model:
            return "there is no internal model to wind up"
        if not self.kind.anti_windup:
            return "anti_windup = false: at a limit the internal model winds up"
        return "at a limit the internal model tracks u (back-calculation) and decays"

    def _needed_input(self) -> Matrix | None:
        """Return the course of u that rejects the disturbance; None: it is not known."""
        if self.theta is None or self.delta is None or not self.kind.internal_model:
            return None
        families = self.kind.families(self.name, self.builder.context)
        ends = np.cumsum([len(family.parameters) for family in families])
        theta = np.split(self.theta, ends[:-1])
        plant, _ = self._plant_and_gain
        h = self.builder.clock.h
        return steady_input(plant, KnownDisturbance(families, theta, self.delta, h))


def driven_by(name: str, builder: Builder) -> str | None:
    """Return the identifier whose theta a compensator takes, where it takes one directly."""
    try:
        return builder.context.driver(Port(name, "theta"))
    except DependsOnInvalid:
        return None


def _margin(what: str, rate: float, h: float) -> str:
    """Return in words how fast a sampled loop decays."""
    return (
        f"{what} the loop decays at {rate:.3g} 1/s (spectral radius {math.exp(-rate * h):.6g} for "
        f"a step of {h:g} s)"
    )


def _where(theta: tuple[float, ...]) -> str:
    return f", at theta = {_numbers(np.array(theta))}" if theta else ""


def _numbers(values: Vector) -> str:
    return ", ".join(f"{value:.4g}" for value in values)
