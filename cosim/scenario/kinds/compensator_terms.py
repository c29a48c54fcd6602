"""The disturbance class of an internal model, and what the theta that drives it is of."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cosim.core.clock import Clock
from cosim.core.port import ElementIndex, Port
from cosim.errors import UsageError
from cosim.native.estimation.alphas import Alpha, AlphaSignal
from cosim.native.numerics.programs import evaluate_at
from cosim.scenario.kinds.alphas import unchecked
from cosim.scenario.kinds.base import BuildContext
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.identification_source import IdentifierSource
from cosim.scenario.kinds.terms import FamilyTerm
from cosim.theory.disturbances.families import Family, Polynomial
from cosim.theory.disturbances.linear_family import LinearFamily

SAMPLES = 1009  # of an alpha that must not vary


@dataclass(frozen=True, eq=False)
class ClassTerm:
    """A term of a disturbance class.

    Parameters
    ----------
    label : str
        For messages, such as ``terms[0] (sine)``.
    family : Family
    alpha : Alpha
    """

    label: str
    family: Family
    alpha: Alpha


@dataclass(frozen=True, eq=False)
class _TermParameter:
    """A parameter of a term of a component: an element of theta."""

    component: str
    term: ClassTerm
    name: str

    def __str__(self) -> str:
        return f"{self.name!r} of {self.term.label} of {self.component!r}"


def class_terms(families: Sequence[Family], alphas: Sequence[Alpha]) -> list[ClassTerm]:
    """Return the terms of families and their known factors."""
    pairs = zip(families, alphas, strict=True)
    terms = []
    for i, (family, alpha) in enumerate(pairs):
        terms.append(ClassTerm(f"terms[{i}] ({family.name})", family, alpha))
    return terms


def internal_model_terms(
    name: str, given: Sequence[FamilyTerm] | None, context: BuildContext
) -> list[ClassTerm]:
    """Return the terms given, or those of the identifier that drives theta; none without them."""
    if given is not None:
        families = [term.generator() for term in given]
        return class_terms(families, unchecked([term.alpha for term in given]))
    driver = context.driver(Port(name, "theta"))
    if driver is None or not isinstance(context.spec(driver), IdentifierKind):
        return []
    return _identified_terms(driver, context)


def _identified_terms(identifier: str, context: BuildContext) -> list[ClassTerm]:
    regression = IdentifierSource(identifier, context).regression
    return class_terms(regression.families, regression.alphas)


def check_constant(terms: Sequence[ClassTerm], clock: Clock) -> None:
    """Refuse alphas that vary: the internal model is a system with constant coefficients.

    Raises
    ------
    UsageError
        If one does.
    """
    for term in terms:
        if _varies(term.alpha, clock):
            raise UsageError(
                f"internal_model: expected constant alphas, got {term.alpha.text!r}; for a "
                "time-varying alpha use internal_model = false with feedforward = true"
            )


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
    if not all(_is_identified(source, context) for source in sources):
        return
    identified = _identified(sources, context)
    taken = _taken(sources, identified)
    own = _parameters(name, terms)
    if len(own) != len(taken):
        return  # sizes that differ are refused with the connections
    for j, (target, source) in enumerate(zip(own, taken, strict=True)):
        if source is not None:
            _check_parameter(f"theta[{j}]", target, source, context)
    used = {parameter.term for parameter in taken if parameter is not None}
    for identifier, others in identified.items():
        unused = [term for term in others if term not in used]
        for term in _uncovered(unused, terms, context.clock):
            text = f"{term.label} of {identifier!r} is not in the internal model"
            context.warn(name, f"{text}, which does not reject what that term makes")


def _identified(sources: Iterable[Port], context: BuildContext) -> dict[str, list[ClassTerm]]:
    """Return the terms of the identifiers among sources, by their names."""
    identifiers = dict.fromkeys(source.component for source in sources)
    return {identifier: _identified_terms(identifier, context) for identifier in identifiers}


def _is_identified(source: Port, context: BuildContext) -> bool:
    """Return whether an output is the theta, or elements of it, of an identifier."""
    return source.signal == "theta" and isinstance(context.spec(source.component), IdentifierKind)


def _taken(
    sources: Sequence[Port], identified: Mapping[str, Sequence[ClassTerm]]
) -> list[_TermParameter | None]:
    """Return the parameters that an input theta takes, in its order; None: there is none."""
    taken: list[_TermParameter | None] = []
    for source in sources:
        parameters = _parameters(source.component, identified[source.component])
        taken += _elements(parameters, source.element)
    return taken


def _parameters(component: str, terms: Sequence[ClassTerm]) -> list[_TermParameter]:
    parameters = []
    for term in terms:
        parameters += [_TermParameter(component, term, name) for name in term.family.parameters]
    return parameters


def _elements(
    parameters: Sequence[_TermParameter], element: ElementIndex
) -> list[_TermParameter | None]:
    """Return the parameters that elements of an output theta are; None: there is none."""
    match element:
        case None:
            return list(parameters)
        case int():
            wanted = range(element, element + 1)
        case range():
            wanted = element
    return [parameters[i] if i < len(parameters) else None for i in wanted]


def _check_parameter(
    element: str, target: _TermParameter, source: _TermParameter, context: BuildContext
) -> None:
    """Check that an element of theta is taken as the parameter that it is.

    Raises
    ------
    UsageError
        If it is taken as another one, or its alpha varies.
    """
    origin = f"{element} is {source}"
    is_any = isinstance(target.term.family, LinearFamily)
    if _varies(source.term.alpha, context.clock):
        varying = f"{origin}, whose alpha = {source.term.alpha.text!r} varies"
        if not is_any:
            raise UsageError(
                f"terms: {varying}; the internal model requires a constant alpha; expected a "
                'term of family = "linear" that describes both together, or internal_model = '
                "false with feedforward = true"
            )
        context.warn(target.component, f"{varying}; {target.term.label} has to make both together")
        return
    if target.term.family == source.term.family and target.name == source.name:
        return
    as_other = f"{origin}, and is taken as {target}"
    if not is_any and target.name != source.name:
        raise UsageError(
            f"terms: {as_other}; expected the terms of {source.component!r} (the default)"
        )
    context.warn(target.component, f"{as_other}; the internal model rejects what that term makes")


def _uncovered(
    others: Iterable[ClassTerm], own: Sequence[ClassTerm], clock: Clock
) -> Iterator[ClassTerm]:
    """Yield the terms of others whose signals no term makes."""
    for other in others:
        is_included = any(_includes(term.family, other.family) for term in own)
        if not is_included or _varies(other.alpha, clock):
            yield other


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
