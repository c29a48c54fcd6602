"""What may be said about amplitudes and phases: the verdict on their component's parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from cosim.theory.assessment.amplitudes import ComponentConstants, component_constants
from cosim.theory.assessment.consistency import MARGIN
from cosim.theory.assessment.verdicts import Assessment
from cosim.theory.documents import ParameterVerdict, Verdict

# from the best verdict to the worst, for what rests on several
_ORDER: Final = {verdict: place for place, verdict in enumerate(Verdict)}
_MEANINGS: Final = {"phase": "in rad at t = 0"}


def amplitude_verdicts(
    assessment: Assessment,
) -> tuple[tuple[ParameterVerdict, ...], ...]:
    """Return what may be said about amplitudes and phases, those of each data set."""
    return tuple(_of_data_set(assessment, index) for index in range(len(assessment.problem.data)))


def constants_of(assessment: Assessment, index: int) -> tuple[ComponentConstants, ...]:
    """Compute amplitudes and phases of all components in data set number ``index``."""
    families = assessment.problem.families
    t_1 = float(assessment.problem.data[index].t[0])
    consistency = assessment.consistency
    moved = np.concatenate([consistency.bias, consistency.amplitude_bias[index]])
    return component_constants(assessment.fit, index, families, t_1=t_1, moved=moved)


def _of_data_set(assessment: Assessment, index: int) -> tuple[ParameterVerdict, ...]:
    verdicts = []
    first = 0
    for i, constants in enumerate(constants_of(assessment, index)):
        count = len(constants.family.parameters)
        parameters = assessment.parameters[first : first + count]
        own = parameters or (assessment.terms[i],)
        worst = max(own, key=lambda parameter: _ORDER[parameter.verdict])
        names = [parameter.name for parameter in parameters]
        verdicts += _of_component(i, constants, names, worst, assessment.fitted.quantile)
        first += count
    return tuple(verdicts)


def _of_component(
    i: int,
    constants: ComponentConstants,
    parameters: Sequence[str],
    worst: ParameterVerdict,
    quantile: float,
) -> list[ParameterVerdict]:
    """Return the verdicts on the constants of component i.

    Parameters
    ----------
    i : int
    constants : ComponentConstants
    parameters : sequence of str
        Names of its parameters.
    worst : ParameterVerdict
        Of all that its constants rest on.
    quantile : float
        Half a 95 % interval over the standard error.
    """
    family = constants.family
    names = {name: f"{name}[{i}]" for name in family.constants}
    names |= dict(zip(family.parameters, parameters, strict=True))
    meaning = f"in {family.formula.format(**names)}"
    verdict = worst.verdict
    problem = _problem(constants, worst)
    if problem and verdict.has_value:
        verdict = Verdict.NOT_IDENTIFIABLE
    verdicts = []
    for k, name in enumerate(family.constants):
        value = float(constants.values[k])
        error = float(constants.standard_error[k])
        reach = quantile * error + MARGIN * float(constants.bias[k])
        known = not problem
        has_interval = known and verdict.has_interval
        verdicts.append(
            ParameterVerdict(
                name=names[name],
                verdict=verdict,
                value=value if known else None,
                standard_error=error if has_interval else None,
                lower=value - reach if has_interval else None,
                upper=value + reach if has_interval else None,
                reason=problem or _MEANINGS.get(name, meaning),
            )
        )
    return verdicts


def _problem(constants: ComponentConstants, worst: ParameterVerdict) -> str:
    """Return why there are no numbers; empty: there are."""
    if not worst.verdict.has_value:
        return worst.reason
    if constants.family.v > 1 and not constants.is_present:
        return "its component is not larger here than the largest that noise alone fits"
    if not np.isfinite(constants.values).all():
        return "another unknown has the same effect on the output, or t = 0 is too far off"
    return ""
