"""Assumption 3 of a regressor: the class of the disturbance, the delays, the alphas."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.core.clock import NANOSECONDS, whole_steps
from cosim.errors import AssumptionError
from cosim.scenario.assumptions.attempts import Evidence, attempted
from cosim.scenario.kinds.alphas import unchecked
from cosim.scenario.kinds.base import BuildContext
from cosim.scenario.kinds.regressor import RegressorKind
from cosim.scenario.kinds.terms import families_of
from cosim.theory import regression
from cosim.theory.assumptions import AssumptionVerdict, undecided
from cosim.theory.disturbance import Family, generators, group_by_alpha

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
            reason = "the disturbance class is not valid"
            return [of_class, undecided(DELAYS, reason), undecided(ALPHAS, reason)]
        delays = attempted(DELAYS, self._delays)
        if not delays.fulfilled:
            return [of_class, delays, undecided(ALPHAS, "the delays are not valid")]
        return [of_class, delays, attempted(ALPHAS, self._alphas)]

    def _families(self) -> tuple[list[Family], tuple[int, ...]]:
        """Return the families, and the sizes of their groups."""
        families = families_of(self.kind.terms)
        texts = [alpha.text for alpha in unchecked(self.kind.alphas)]
        groups = group_by_alpha(texts, families)
        return families, tuple(group.size for group in groups)

    def _class(self) -> Evidence:
        families, sizes = self._families()
        count = regression.count_terms(sizes)
        values = {"basis_functions": sum(sizes), "groups": len(sizes), "terms": count}
        names = ", ".join(family.name for family in families)
        evidence = (
            f"{names}: l = {sum(sizes)} basis functions under {len(sizes)} alpha(s), {count} terms "
            "of (25)"
        )
        warning = regression.linear_route_warning(sizes)
        return f"{evidence}; {warning}" if warning else evidence, values

    def _delays(self) -> Evidence:
        """Check the delays: rates that differ by a multiple of 2 pi / divisor look alike."""
        families, sizes = self._families()
        delays = self.kind.delays
        regression.check_delays(delays, sum(sizes) + 1)
        step_ns = self.context.step_ns
        steps = [whole_steps(delay, step_ns, f"delays[{j}]") for j, delay in enumerate(delays)]
        divisor = math.gcd(*(count - steps[0] for count in steps)) * step_ns / NANOSECONDS
        values: dict[str, Any] = {"delays": list(delays), "common_divisor": divisor}
        evidence = f"{len(delays)} distinct delays, whole multiples of {divisor:g} s apart"
        limit = math.pi / divisor
        if self.theta is None:
            unique = f"; a rate above {limit:.3g} rad/s would be taken for a slower one"
            return evidence + unique, values
        rate = _fastest(families, self.theta)
        values["fastest_rate"] = rate
        if rate >= limit:
            raise AssumptionError(
                f"Assumption 3 (5): delays whole multiples of {divisor:g} s apart, and a rate of "
                f"{rate:.3g} rad/s: above {limit:.3g} rad/s it is taken for a slower one",
                cure=f"choose two delays less than {math.pi / rate:.3g} s apart",
            )
        if rate:
            evidence += f": no rate is above {limit:.3g} rad/s, the fastest is {rate:.3g}"
        return evidence, values

    def _alphas(self) -> Evidence:
        design = self.kind.design(self.name, self.context)
        names = ", ".join(repr(alpha.text) for alpha in design.group_alphas)
        if len(design.groups) < 2:
            return f"one alpha for all terms: {names}", {}
        if design.known.unknown:
            return f"{names}: known of the run alone, which checks them at its end", {}
        times = design.times_before(self.context.clock)
        sampled = design.known(times.ravel()).reshape(*times.shape, len(design.groups))
        margin = regression.independence(design.terms, sampled)
        evidence = (
            f"the products of {names} are independent: smallest singular value {margin:.2g}, "
            f"dependent below {regression.COLLINEAR:.0e}"
        )
        return evidence, {"smallest_singular_value": margin, "least": regression.COLLINEAR}


def _fastest(families: list[Family], theta: Vector) -> float:
    """Return the fastest rate of the components [rad/s]."""
    rates = [0.0]
    for component in generators(families).each:
        G = component.matrix(theta[component.theta])
        rates.append(float(np.abs(np.linalg.eigvals(G).imag).max()))
    return max(rates)
