"""The assumptions of the method one by one: fulfilled or not, with the number that decides it.

What is not fulfilled has the evidence and the cure of the error that refuses it, so that a report
and an error say the same. All that can be said is said: one that rests on another which fails is
not decided, the others are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from cosim.errors import AssumptionError
from cosim.theory.observers import observer
from cosim.theory.observers.conditions import check_detectable, check_outputs
from cosim.theory.observers.placement import modes
from cosim.theory.plants.descriptor import (
    ComplexVector,
    DescriptorSystem,
    ReducedSystem,
    in_units,
    invariant_zeros,
    pencil_index,
    reduce,
    reduced_scales,
)
from cosim.theory.plants.pencil import decompose, regularity, rounding_of
from cosim.theory.plants.scaling import within_range

NO_VALUES: Final[Mapping[str, Any]] = MappingProxyType({})


@dataclass(frozen=True, eq=False, kw_only=True)
class AssumptionVerdict:
    """Whether an assumption is fulfilled.

    Parameters
    ----------
    name : str
    fulfilled : bool or None
        None: not decided, as it rests on one that is not fulfilled.
    evidence : str
        The number that decides it, in a sentence.
    values : mapping of name to plain value
        The numbers.
    verdict : str
        The name of what is wrong, such as ``INDEX_2``; empty: it has none.
    cure : str
        What can be done.
    """

    name: str
    fulfilled: bool | None
    evidence: str
    values: Mapping[str, Any] = field(default_factory=dict)
    verdict: str = ""
    cure: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "name": self.name,
            "fulfilled": self.fulfilled,
            "evidence": self.evidence,
            "values": dict(self.values),
            "verdict": self.verdict,
            "cure": self.cure,
        }


def refused(
    name: str, error: AssumptionError, values: Mapping[str, Any] = NO_VALUES
) -> AssumptionVerdict:
    """Return the verdict of an error."""
    return AssumptionVerdict(
        name=name,
        fulfilled=False,
        evidence=error.evidence,
        values=values,
        verdict=error.verdict,
        cure=error.cure,
    )


def undecided(name: str, reason: str) -> AssumptionVerdict:
    """Return the verdict of an assumption that rests on another."""
    return AssumptionVerdict(name=name, fulfilled=None, evidence=f"not decided: {reason}")


def checked(name: str, check: Callable[[], tuple[str, Mapping[str, Any]]]) -> AssumptionVerdict:
    """Return the verdict of a check, which returns evidence and numbers, or raises."""
    try:
        evidence, values = check()
    except AssumptionError as error:
        return refused(name, error)
    return AssumptionVerdict(name=name, fulfilled=True, evidence=evidence, values=values)


# --- the plant ---

PENCIL: Final = "regular pencil (Assumption 1)"
INDEX: Final = "index at most 1 (Assumption 2)"
DIRECT_PATH: Final = "path from delta to y (Assumption 4)"
DECOUPLING: Final = "decoupling (Assumption 5)"
DETECTABILITY: Final = "detectability"
HURWITZ: Final = "M - L C Hurwitz (17)"


def plant_verdicts(system: DescriptorSystem) -> tuple[AssumptionVerdict, AssumptionVerdict]:
    """Return whether the equations determine the states: the pencil, and its index."""
    try:
        with within_range():
            return _plant_verdicts(system)
    except AssumptionError as error:
        return refused(PENCIL, error), undecided(INDEX, "nothing is known of the pencil")


def _plant_verdicts(system: DescriptorSystem) -> tuple[AssumptionVerdict, AssumptionVerdict]:
    scales = system.scales
    E = scales.scaled_E(system.E)
    A = scales.scaled_E(system.A)
    least = rounding_of(len(A))
    sizes = np.linalg.svd(E, compute_uv=False)
    of_E = float(sizes[-1] / sizes[0]) if sizes[0] > 0.0 else 0.0
    margin = max(regularity(E, A), of_E)
    values = {"reciprocal_condition": margin, "rounding": least}
    if margin <= least:
        return _singular_pencil(system, values), undecided(INDEX, "the pencil is singular")
    pencil = AssumptionVerdict(
        name=PENCIL,
        fulfilled=True,
        evidence=f"s E - A has the reciprocal condition {margin:.2g} at some s; rounding may leave "
        f"{least:.1g}",
        values=values,
    )
    return pencil, checked(INDEX, lambda: _index(system))


def _singular_pencil(system: DescriptorSystem, values: Mapping[str, Any]) -> AssumptionVerdict:
    try:
        pencil_index(system)
    except AssumptionError as error:
        return refused(PENCIL, error, values)
    raise AssertionError("a singular pencil has an index")


def _index(system: DescriptorSystem) -> tuple[str, dict[str, Any]]:
    reduced = reduce(system)
    known = f"; {reduced.inaccuracy}" if reduced.inaccuracy else ""
    scales = system.scales
    decomposition = decompose(scales.scaled_E(system.E), system.n_a)
    index = pencil_index(system)
    n = len(system.A)
    dynamic = len(reduced.A_a)
    values: dict[str, Any] = {"index": index, "states": n}
    values["rank_of_E"] = len(decomposition.values)
    values["accuracy"] = reduced.accuracy
    states = f"{dynamic} dynamic and {n - dynamic} algebraic states{known}"
    if index == 0:
        return f"index 0: E is regular, {n} dynamic states{known}", values
    if index > 1:
        return f"index {index}: differentiated, as no input acts on constraints; {states}", values
    A22 = decomposition.U2.T @ scales.scaled_E(system.A) @ decomposition.V2
    values["condition_of_A22"] = float(np.linalg.cond(A22))
    evidence = (
        "index 1: the algebraic equations determine the algebraic states, condition "
        f"{values['condition_of_A22']:.3g}; {states}"
    )
    return evidence, values


# --- the observer ---


def observer_verdicts(reduced: ReducedSystem) -> tuple[AssumptionVerdict, ...]:
    """Return whether there is an observer: direct path, decoupling, detectability."""
    try:
        with within_range():
            return _observer_verdicts(reduced)
    except AssumptionError as error:
        reason = "the matrices leave the range of numbers"
        return (
            undecided(DIRECT_PATH, reason),
            refused(DECOUPLING, error),
            undecided(DETECTABILITY, reason),
        )


def _observer_verdicts(reduced: ReducedSystem) -> tuple[AssumptionVerdict, ...]:
    n_y, n_d = reduced.C5.shape
    if not n_d:
        none = AssumptionError(
            "the model has no disturbance, and the observer is for an unknown one (Assumption 5)",
            cure="give a model with Bd, or with B and disturbances",
        )
        reason = "there is no disturbance"
        return (
            undecided(DIRECT_PATH, reason),
            refused(DECOUPLING, none),
            undecided(DETECTABILITY, reason),
        )
    try:
        error_dynamics = observer.error_dynamics(reduced)
    except AssumptionError as error:
        ranks = {"outputs": n_y, "disturbances": n_d}
        return (
            _direct_path(reduced),
            refused(DECOUPLING, error, ranks),
            _zeros_alone(reduced),
        )
    return _direct_path(reduced), _decoupled(reduced, error_dynamics), _detectable(error_dynamics)


def outputs_verdict(n_y: int, n_d: int) -> AssumptionVerdict:
    """Return what the number of outputs says where there is no reduced system."""
    try:
        check_outputs(n_y, n_d)
    except AssumptionError as error:
        return refused(DECOUPLING, error)
    return undecided(DECOUPLING, "there is no reduced system")


def _direct_path(reduced: ReducedSystem) -> AssumptionVerdict:
    scales = reduced_scales(reduced)
    C5 = in_units(reduced, scales).C5
    sizes = np.linalg.svd(C5, compute_uv=False)
    largest = float(sizes.max(initial=0.0))
    rank = int((sizes > max(reduced.accuracy, rounding_of(len(reduced.A_a)))).sum())
    evidence = "none: delta reaches y through the states alone"
    if rank:
        evidence = f"{rank} of {C5.shape[1]} disturbance(s) follow from y without a derivative"
    return AssumptionVerdict(
        name=DIRECT_PATH,
        fulfilled=True,
        evidence=evidence,
        values={"rank_of_C5": rank, "largest_of_C5": largest},
    )


def _decoupled(reduced: ReducedSystem, error: observer.ErrorDynamics) -> AssumptionVerdict:
    n_y, n_d = reduced.C5.shape
    sizes = error.decoupling.values
    values: dict[str, Any] = {"outputs": n_y, "disturbances": n_d, "rank_of_C3_B_2a": len(sizes)}
    if not len(sizes):
        evidence = f"all {n_d} disturbance(s) reach {n_y} output(s) directly"
    else:
        values["smallest_singular_value"] = float(sizes.min())
        evidence = (
            f"an integrator leads from {len(sizes)} disturbance(s) to {n_y} output(s): smallest "
            f"singular value {sizes.min():.2g} where all is of size one"
        )
    return AssumptionVerdict(name=DECOUPLING, fulfilled=True, evidence=evidence, values=values)


def _detectable(error: observer.ErrorDynamics) -> AssumptionVerdict:
    def check() -> tuple[str, Mapping[str, Any]]:
        check_detectable(error.fixed_modes, error.magnitudes)
        return _stable_zeros("fixed modes", error.fixed_modes)

    verdict = checked(DETECTABILITY, check)
    return _with_zeros(verdict, error.fixed_modes)


def _zeros_alone(reduced: ReducedSystem) -> AssumptionVerdict:
    """Return what the invariant zeros say where the disturbance is not decoupled."""
    scaled = in_units(reduced, reduced_scales(reduced))
    n_y, n_d = reduced.C5.shape
    if n_d > n_y:
        return undecided(DETECTABILITY, "there are fewer outputs than disturbances")
    try:
        zeros = invariant_zeros(scaled)
    except AssumptionError as error:
        return undecided(DETECTABILITY, error.evidence)

    def check() -> tuple[str, Mapping[str, Any]]:
        check_detectable(zeros, np.abs(scaled.A_a))
        return _stable_zeros("invariant zeros", zeros)

    return _with_zeros(checked(DETECTABILITY, check), zeros)


def _stable_zeros(what: str, zeros: ComplexVector) -> tuple[str, Mapping[str, Any]]:
    if not len(zeros):
        return f"{what}: none, so that L places every mode of the error", {}
    slowest = float(np.abs(zeros.real).min())
    return f"{what}: {modes(zeros)}, all stable; the slowest has the rate {slowest:.3g} 1/s", {}


def _with_zeros(verdict: AssumptionVerdict, zeros: ComplexVector) -> AssumptionVerdict:
    return AssumptionVerdict(
        name=verdict.name,
        fulfilled=verdict.fulfilled,
        evidence=verdict.evidence,
        values={"zeros": plain_modes(zeros)},
        verdict=verdict.verdict,
        cure=verdict.cure,
    )


def gain_evidence(design: observer.ObserverDesign) -> tuple[str, Mapping[str, Any]]:
    """Return what the eigenvalues of a design say."""
    slowest = design.lambda_obs
    values = {"eigenvalues": plain_modes(design.eigenvalues), "lambda_obs": slowest}
    return f"eigenvalues {modes(design.eigenvalues)}; the slowest rate is {slowest:.3g} 1/s", values


def plain_modes(eigenvalues: ComplexVector) -> list[float | str]:
    """Return eigenvalues as JSON can write them: complex values as text."""
    plain: list[float | str] = []
    for value in eigenvalues:
        plain.append(str(complex(value)) if value.imag else float(value.real))
    return plain
