"""The known factor alpha of a term: an expression in t, or a signal of the scenario.

A signal reaches what has the term by an input of its own, ``alpha``, that has an element for each
signal that the terms name; its connections follow from the terms.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Final, TypeAlias

import numpy as np
from pydantic import AfterValidator, Field

from cosim.arrays import Matrix, Vector
from cosim.core.connections import Connection
from cosim.core.port import Port
from cosim.errors import CosimError, UsageError
from cosim.native.estimation.alphas import Alpha, AlphaSignal
from cosim.native.numerics.expression import Program, compile_expression
from cosim.native.numerics.programs import evaluate_at
from cosim.scenario.document.schema import TomlTable
from cosim.scenario.kinds.base import BuildContext
from cosim.scenario.kinds.jumps import check_continuous, check_finite_values
from cosim.scenario.kinds.values import ImpliedConnection, KnownSignal

ALPHA: Final = "alpha"  # the input
ALPHA_KEY: Final = 'known function of t, or a signal: { from = "component.signal" }'


def _check_signal(text: str) -> str:
    """Check that a text names an output, or one element of it.

    Raises
    ------
    ValueError
        If it does not.
    """
    try:
        port = Port.parse(text)
    except CosimError as error:
        raise ValueError(str(error)) from error
    if isinstance(port.element, range):
        raise ValueError(f"expected one element of the output, such as [0], got {text!r}")
    return text


class SignalTable(TomlTable):
    """A signal of the scenario, such as ``{ from = "schedule.y" }``."""

    source: Annotated[str, AfterValidator(_check_signal)] = Field(
        alias="from", description="output, or an element of it"
    )

    @property
    def port(self) -> Port:
        """The output, or the element of it."""
        return Port.parse(self.source)

    @property
    def element(self) -> Port:
        """The element that it is."""
        return replace(self.port, element=self.port.element or 0)


TermAlpha: TypeAlias = str | SignalTable


def signals_of(alphas: Iterable[TermAlpha]) -> dict[Port, Port]:
    """Return the distinct signals among alphas, in their order, by the element that they are.

    An output that is named as a whole has one element.
    """
    distinct: dict[Port, Port] = {}
    for alpha in alphas:
        if isinstance(alpha, SignalTable):
            distinct.setdefault(alpha.element, alpha.port)
    return distinct


def alpha_connections(
    to: str, alphas: Sequence[TermAlpha], origin: str | None = None
) -> dict[Port, ImpliedConnection]:
    """Return the connections of the input ``alpha`` that follow from terms.

    Parameters
    ----------
    to : str
        The component.
    alphas : sequence of TermAlpha
    origin : str, optional
        The component whose terms they are; by default ``to``.
    """
    signals = signals_of(alphas)
    connections = {}
    for i, source in enumerate(signals.values()):
        element = i if len(signals) > 1 else None
        follows = None if origin is None else Port(origin, ALPHA, element)
        connection = Connection([source])
        connections[Port(to, ALPHA, element)] = ImpliedConnection(connection, follows)
    return connections


def unchecked(alphas: Sequence[TermAlpha]) -> list[Alpha]:
    """Return the known factors of terms, of signals without their lags.

    Raises
    ------
    UsageError
        If a text is no expression.
    """
    signals = signals_of(alphas)
    places = list(signals)
    result: list[Alpha] = []
    for number, alpha in enumerate(alphas):
        if isinstance(alpha, SignalTable):
            text = str(signals[alpha.element])
            result.append(AlphaSignal(text, places.index(alpha.element)))
        else:
            with naming(number):
                result.append(compile_expression(alpha))
    return result


def alphas_of(
    name: str, alphas: Sequence[TermAlpha], context: BuildContext, way_out: str
) -> list[Alpha]:
    """Return the known factors of the terms of a component.

    Parameters
    ----------
    name : str
        The component.
    alphas : sequence of TermAlpha
        Of its terms.
    context : BuildContext
    way_out : str
        What can be done about one that jumps.

    Raises
    ------
    UsageError
        If one jumps, or is not finite at a communication point, as far as that is known.
    """
    result = unchecked(alphas)
    is_alone = len(signals_of(alphas)) == 1
    for number, alpha in enumerate(result):
        with naming(number):
            if isinstance(alpha, Program):
                check_continuous(alpha.text, context.clock, way_out)
                check_finite_values(alpha.text, partial(_values, alpha), context.clock)
                continue
            known = context.known(Port.parse(alpha.text))
            if known is not None:
                check_finite_values(alpha.text, known, context.clock)
        to = Port(name, ALPHA, None if is_alone else alpha.element)
        result[number] = replace(alpha, lag=context.lag(to))
    return result


def known_functions(alphas: Iterable[Alpha], context: BuildContext) -> dict[str, KnownSignal]:
    """Return alphas as functions of time by text, as far as they are known before the run."""
    functions: dict[str, KnownSignal] = {}
    for alpha in alphas:
        if isinstance(alpha, Program):
            functions[alpha.text] = partial(_values, alpha)
            continue
        known = context.known(Port.parse(alpha.text))
        if known is not None:
            functions[alpha.text] = known
    return functions


def _values(alpha: Program, t: Vector) -> Vector:
    values: Vector = evaluate_at([alpha], t)[:, 0]
    return values


@dataclass(frozen=True, eq=False)
class KnownAlphas:
    """Alphas as functions of time, as far as they are known before the run.

    Parameters
    ----------
    alphas : sequence of Alpha
    functions : mapping of text to KnownSignal
        Those that are known.
    """

    alphas: Sequence[Alpha]
    functions: Mapping[str, KnownSignal]

    @property
    def unknown(self) -> list[Alpha]:
        """Those that only the run computes."""
        return [alpha for alpha in self.alphas if alpha.text not in self.functions]

    @property
    def names(self) -> list[str]:
        """Those that are known, as they are written."""
        return [alpha.text for alpha in self.alphas if alpha.text in self.functions]

    @property
    def are_expressions(self) -> bool:
        """Whether those are, so that there are values before the run and after it."""
        signals = [alpha.text for alpha in self.alphas if isinstance(alpha, AlphaSignal)]
        return self.functions.keys().isdisjoint(signals)

    def __call__(self, t: Vector) -> Matrix:
        """Return the values of those that are known at instants of the run ``(N,)`` [s]."""
        columns = [self.functions[name](t) for name in self.names]
        return np.array(columns, np.float64).reshape(len(columns), len(t)).T


@contextmanager
def naming(number: int) -> Iterator[None]:
    """Name the term that an error is about."""
    try:
        yield
    except UsageError as error:
        raise type(error)(f"terms[{number}]: {error}") from error
