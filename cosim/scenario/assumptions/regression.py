"""Assumption 3 of a regressor: the class of the disturbance, the delays, the alphas."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import chain
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import AssumptionError, UsageError
from cosim.scenario.assumptions.attempts import Evidence, attempted
from cosim.scenario.kinds.alphas import unchecked
from cosim.scenario.kinds.base import BuildContext
from cosim.scenario.kinds.regressor import RegressorDesign, RegressorKind
from cosim.scenario.kinds.terms import element_count, families_of
from cosim.theory.disturbances import regression
from cosim.theory.disturbances.families import Family, generators, group_by_alpha
from cosim.theory.observers.assumptions import AssumptionVerdict, undecided

CLASS: Final = "disturbance class (Assumption 3)"
DELAYS: Final = "delays (Assumption 3)"
ALPHAS: Final = "alphas (21)"


@dataclass(frozen=True, eq=False)
class RegressorCheck:
    """A regressor whose assumptions are checked.

    Parameters
    ----------
    name : str
    kind : RegressorKind
    context : BuildContext
    theta : Vector or None
        Of the disturbance, where the scenario has it.
    """

    name: str
    kind: RegressorKind
    context: BuildContext
    theta: Vector | None

    def verdicts(self) -> list[AssumptionVerdict]:
        """Return what is fulfilled."""
        of_class = attempted(CLASS, self._class)
        if not of_class.fulfilled:
            reason = "the disturbance class is invalid"
            return [of_class, undecided(DELAYS, reason), undecided(ALPHAS, reason)]
        delays = attempted(DELAYS, self._delays)
        if not delays.fulfilled:
            return [of_class, delays, undecided(ALPHAS, "the delays are invalid")]
        return [of_class, delays, attempted(ALPHAS, self._alphas)]

    def _elements(self) -> list[tuple[list[Family], tuple[int, ...]]]:
        """Return the families, and the sizes of their groups, for each element of delta."""
        families = families_of(self.kind.terms)
        texts = [alpha.text for alpha in unchecked(self.kind.alphas)]
        elements = []
        for element in range(element_count(self.kind.terms)):
            own = [i for i, term in enumerate(self.kind.terms) if term.element == element]
            of_element = [families[i] for i in own]
            groups = group_by_alpha([texts[i] for i in own], of_element)
            elements.append((of_element, tuple(group.size for group in groups)))
        return elements

    def _class(self) -> Evidence:
        self.kind.check_distinguishable(self.context)
        elements = self._elements()
        texts = [_class_text(families, sizes) for families, sizes in elements]
        if len(texts) > 1:
            texts = [f"element {element}: {text}" for element, text in enumerate(texts)]
        all_sizes = list(chain.from_iterable(sizes for _, sizes in elements))
        values = {
            "basis_functions": sum(all_sizes),
            "groups": len(all_sizes),
            "terms": sum(regression.count_terms(sizes) for _, sizes in elements if sizes),
        }
        return "; ".join(texts), values

    def _delays(self) -> Evidence:
        """Check the delays: rates that differ by a multiple of 2 pi / divisor look alike."""
        elements = self._elements()
        families = families_of(self.kind.terms)
        delays = self.kind.delays
        longest = max(sum(sizes) for _, sizes in elements)
        regression.check_delays(delays, longest + 1)
        steps = self.kind.delay_steps(self.context)
        common_steps = math.gcd(*(count - steps[0] for count in steps))
        divisor = common_steps * self.context.h
        values: dict[str, Any] = {"delays": list(delays), "common_divisor": divisor}
        evidence = f"{len(delays)} distinct delays, whole multiples of {divisor:g} s apart"
        limit = math.pi / divisor
        if self.theta is None:
            unique = f"; a rate above {limit:.3g} rad/s would alias to a slower one"
            return evidence + unique, values
        rate = _fastest(families, self.theta)
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
        design = self.kind.design(self.name, self.context)
        evidence = [self._alphas_of(part) for part in design.by_element]
        texts = [text for text, _ in evidence]
        if design.each:
            texts = [f"element {element}: {text}" for element, text in enumerate(texts)]
        margins = [margin for _, margin in evidence if margin is not None]
        values: dict[str, Any] = {}
        if margins:
            values = {"smallest_singular_value": min(margins), "least": regression.COLLINEAR}
        return "; ".join(texts), values

    def _alphas_of(self, design: RegressorDesign) -> tuple[str, float | None]:
        """Return what is known of the alphas of one element, and the margin where there is one."""
        names = ", ".join(repr(alpha.text) for alpha in design.group_alphas)
        if len(design.groups) < 2:
            return f"one alpha for all terms: {names}", None
        if design.known.unknown:
            return f"{names}: known only during the run, which checks them at its end", None
        if not design.needs_independence:
            return f"none of {names} is a multiple of another, as output error requires", None
        times = design.times_before(self.context.clock)
        sampled = design.known(times.ravel()).reshape(*times.shape, len(design.groups))
        margin = regression.independence(design.terms, sampled)
        if margin <= regression.COLLINEAR:
            dependent = f"the products of {names} are dependent"
            return f'{dependent}; use method = "output-error"', margin
        return (
            f"the products of {names} are independent: smallest singular value {margin:.2g}, "
            f"dependent below {regression.COLLINEAR:.0e}"
        ), margin


def _class_text(families: list[Family], sizes: tuple[int, ...]) -> str:
    """Return the class of one element of delta as text.

    Raises
    ------
    UsageError
        If it has no terms.
    """
    if not families:
        raise UsageError("expected at least one term for each element of delta, got none")
    names = ", ".join(family.name for family in families)
    text = (
        f"{names}: {sum(sizes)} basis functions under {len(sizes)} alpha(s), "
        f"{regression.count_terms(sizes)} terms of the regression"
    )
    problem = regression.linear_route_problem(sizes)
    remark = regression.linear_route_warning(sizes)
    if problem:
        remark = f'{problem}; use method = "output-error"'
    return f"{text}; {remark}" if remark else text


def _fastest(families: list[Family], theta: Vector) -> float:
    """Return the fastest rate of the components [rad/s]."""
    rates = [0.0]
    for component in generators(families).each:
        G = component.matrix(theta[component.theta])
        rates.append(float(np.abs(np.linalg.eigvals(G).imag).max()))
    return max(rates)
