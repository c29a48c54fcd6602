"""The disturbance class of an internal model, and what the theta that drives it is of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.core.port import Port
from cosim.errors import UsageError
from cosim.native.alphas import Alpha, AlphaSignal
from cosim.native.step import evaluate_at
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
    """A parameter of a term: an element of theta."""

    term: ClassTerm
    name: str


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


def check_constant(terms: Sequence[ClassTerm], context: BuildContext) -> None:
    """Refuse alphas that vary: the internal model is a system with constant coefficients.

    Raises
    ------
    UsageError
        If one does.
    """
    for term in terms:
        if _varies(term.alpha, context):
            raise UsageError(
                f"internal_model: alpha = {term.alpha.text!r} varies, and the internal model is of "
                "disturbances with constant alphas; needed these, or internal_model = false "
                "with feedforward = true"
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
    driving: dict[str, list[ClassTerm]] = {}
    taken: list[_TermParameter | None] = []
    origins: list[str] = []
    for source in context.sources(Port(name, "theta")):
        identifier = source.component
        if not isinstance(context.spec(identifier), IdentifierKind) or source.signal != "theta":
            return
        if identifier not in driving:
            driving[identifier] = _identified_terms(identifier, context)
        elements = _elements(driving[identifier], source)
        taken += elements
        origins += [identifier] * len(elements)
    own = _parameters(terms)
    if len(own) != len(taken):
        return  # sizes that differ are refused with the connections
    for j, (target, parameter, origin) in enumerate(zip(own, taken, origins, strict=True)):
        if parameter is not None:
            _check_parameter(name, f"theta[{j}]", target, parameter, origin, context)
    used = {parameter.term for parameter in taken if parameter is not None}
    for identifier, identified in driving.items():
        for term in identified:
            if term not in used and not _is_covered(term, terms, context):
                context.warn(
                    name,
                    f"{term.label} of {identifier!r} is not in the internal model, which does not "
                    "reject what that term makes",
                )


def _parameters(terms: Sequence[ClassTerm]) -> list[_TermParameter]:
    parameters = []
    for term in terms:
        parameters += [_TermParameter(term, name) for name in term.family.parameters]
    return parameters


def _elements(terms: Sequence[ClassTerm], source: Port) -> list[_TermParameter | None]:
    """Return the parameters that an output theta, or elements of it, are; None: there is none."""
    parameters = _parameters(terms)
    match source.element:
        case None:
            return list(parameters)
        case int():
            wanted = range(source.element, source.element + 1)
        case range():
            wanted = source.element
    return [parameters[i] if i < len(parameters) else None for i in wanted]


def _check_parameter(
    name: str,
    element: str,
    target: _TermParameter,
    source: _TermParameter,
    origin: str,
    context: BuildContext,
) -> None:
    """Check that a parameter is taken as what it is."""
    found = f"{element} is {source.name!r} of {source.term.label} of {origin!r}"
    as_other = f"{found}, and is taken as {target.name!r} of {target.term.label} of {name!r}"
    is_any = isinstance(target.term.family, LinearFamily)
    if _varies(source.term.alpha, context):
        told = f"{found}, whose alpha = {source.term.alpha.text!r} varies"
        if not is_any:
            raise UsageError(
                f"terms: {told}, and the internal model is of a constant alpha; needed a term "
                'of family = "linear" that makes both together, or internal_model = false with '
                "feedforward = true"
            )
        context.warn(name, f"{told}; {target.term.label} has to make both together")
    elif target.term.family == source.term.family and target.name == source.name:
        return
    elif is_any or target.name == source.name:
        context.warn(name, f"{as_other}; the internal model rejects what that term makes")
    else:
        raise UsageError(
            f"terms: {as_other}; needed the terms of {origin!r}, which are the default: leave "
            "terms out"
        )


def _is_covered(term: ClassTerm, own: Sequence[ClassTerm], context: BuildContext) -> bool:
    """Return whether one of the terms makes all that a term makes."""
    if _varies(term.alpha, context):
        return False
    return any(_includes(other.family, term.family) for other in own)


def _includes(family: Family, other: Family) -> bool:
    """Return whether a family has all signals of another one, for the same theta."""
    if isinstance(family, Polynomial) and isinstance(other, Polynomial):
        return family.degree >= other.degree
    return family == other


def _varies(alpha: Alpha, context: BuildContext) -> bool:
    if isinstance(alpha, AlphaSignal):
        return True
    clock = context.clock
    parts = np.arange(SAMPLES) * math.sqrt(2.0) % 1.0  # no period divides them
    times = clock.start_time + (clock.stop - clock.start_time) * parts
    values = evaluate_at([alpha], np.asarray(times, np.float64))
    return bool(np.ptp(values) > 0.0)
