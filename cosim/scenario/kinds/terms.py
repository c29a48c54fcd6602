"""The terms of a disturbance: an alpha, a family with its settings, parameters, constants.

The known factor alpha is an expression in t, or a signal of the scenario. A signal reaches what has
the term by an input of its own, ``alpha``, that has an element for each signal that the terms name;
its connections follow from the terms.

Expressions in t are checked here, too, also those of sources. A continuous signal is interpolated
linearly between two communication points, so a jump in it would become a ramp of a whole step. A
discrete one holds its value from a communication point on, so it can jump there, to the value that
it has after the jump.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Annotated, Any, Final, TypeAlias

import numpy as np
from pydantic import AfterValidator, Field

from cosim.arrays import Matrix, Vector
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.port import Port
from cosim.errors import CosimError, UsageError
from cosim.native.estimation.alphas import Alpha, AlphaSignal
from cosim.native.numerics.expression import Program, compile_expression
from cosim.native.numerics.jumps import Jump, jumps
from cosim.native.numerics.programs import evaluate, evaluate_at
from cosim.scenario.document.schema import Number, NumberRow, NumberRows, TomlTable, Whole, matrix
from cosim.scenario.kinds.base import BuildContext
from cosim.scenario.kinds.values import ImpliedConnection, KnownSignal
from cosim.theory.disturbances.families import FAMILIES, SETTINGS, Family, Polynomial, family_named
from cosim.theory.disturbances.linear_family import LinearFamily, Rows

MOST_POINTS: Final = 1_000_000  # that are looked at; a run stops where it reaches what comes later
ALPHA: Final = "alpha"  # the input
LINEAR: Final = "linear"
LARGEST_DEGREE: Final = 8  # data hardly distinguish higher powers of t
MOST_ELEMENTS: Final = 64
ONE_BY_ONE: Final = ("amplitude", "phase", "level", "slope")  # constants with keys of their own
DEFAULTS: Final = MappingProxyType({"amplitude": 1.0, "phase": 0.0})  # the others are needed
NEEDED: Final = ("degree", "G0", "c")  # of the settings of a family
IN_A_LIST: Final = ("polynomial", LINEAR)  # families with as many constants as are said

# --- expressions in t ---


def check_continuous(text: str, clock: Clock, way_out: str) -> None:
    """Check that an expression does not jump during a run.

    Raises
    ------
    UsageError
        If it may; ``way_out`` says what can be done.
    """
    for jump in _jumps_in_run(text, clock):
        at = "" if jump.instant is None else f" at {jump.instant!r} s"
        raise UsageError(
            f"expression {text!r}: {jump.text} jumps{at}; linear interpolation would turn the "
            f"jump into a ramp over one step; {way_out}"
        )


def check_sampled(text: str, clock: Clock) -> list[str]:
    """Check the jumps of an expression that is evaluated at the communication points and held.

    Returns
    -------
    list of str
        What is to be known of those whose instants are not known.

    Raises
    ------
    UsageError
        If a jump is known to be between two communication points, or the value at the jump is not
        the one after it, which has to hold from there.
    """
    notes = []
    for jump in _jumps_in_run(text, clock):
        if jump.instant is None:
            notes.append(
                f"{jump.text} jumps where its argument passes 0; between two communication points "
                "that shows at the second: an error of first order in the step"
            )
            continue
        times = np.array([jump.instant])
        if not clock.is_point(times)[0]:
            before, after = clock.points_around(jump.instant)
            raise UsageError(
                f"expression {text!r}: {jump.text} jumps at {jump.instant!r} s, between two "
                f"communication points; expected {before!r} s or {after!r} s"
            )
        point = float(clock.nearest_points(times)[0])
        if point < clock.stop and not _holds_value_after(jump, point):
            raise UsageError(
                f"expression {text!r}: {jump.text} still has the value before its jump at the "
                f"communication point {point!r} s and would hold it for a step; write {jump.remedy}"
            )
    return notes


def _jumps_in_run(text: str, clock: Clock) -> Iterator[Jump]:
    """Yield the jumps that may change a value of a run."""
    for jump in jumps(text):
        instant = jump.instant
        if instant == clock.start_time:  # only the value after it counts, if that is there
            if not _holds_value_after(jump, clock.start_time):
                yield jump
        elif instant is None or clock.start_time < instant <= clock.stop:
            yield jump


def _holds_value_after(jump: Jump, point: float) -> bool:
    """Return whether the value at a jump is the one after it, as it is computed."""
    value = evaluate(compile_expression(jump.text), point)
    return value == evaluate(compile_expression(jump.remedy), point + 1.0)


def seen_late(what: str, discrete: bool, way_out: str) -> str:
    """Return what is to be known of an output that jumps with what is interpolated linearly.

    ``discrete`` says that it holds its value over a step, ``way_out`` what can be done if not.
    """
    shown = "that shows at the second, an error of first order in the step"
    if not discrete:
        ramp = "the jump becomes a ramp over that step, an error of first order in the step"
        shown = f"{ramp}; {way_out}"
    return f"{what}: between two communication points {shown}"


def check_finite_values(text: str, values: Callable[[Vector], Vector], clock: Clock) -> None:
    """Check that a signal that is known before the run is finite at its communication points.

    Parameters
    ----------
    text : str
        Its name.
    values : callable
        Of the signal at instants of the run ``(N,)`` [s].
    clock : Clock

    Raises
    ------
    UsageError
        If it is not; names the first.
    """
    times = clock.grid.time(np.arange(min(clock.steps + 1, MOST_POINTS)))
    found = values(times)
    wrong = np.flatnonzero(~np.isfinite(found))
    if wrong.size:
        first = int(wrong[0])
        raise UsageError(
            f"alpha {text!r}: expected a finite value at every communication point of the run, "
            f"got {found[first]:g} at t = {times[first]:g} s"
        )


# --- alphas ---


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
            known = _known_function(alpha, context)
            if known is not None:
                check_finite_values(alpha.text, known, context.clock)
        if isinstance(alpha, AlphaSignal):
            to = Port(name, ALPHA, None if is_alone else alpha.element)
            result[number] = replace(alpha, lag=context.lag(to))
    return result


def known_functions(alphas: Iterable[Alpha], context: BuildContext) -> dict[str, KnownSignal]:
    """Return alphas as functions of time by text, as far as they are known before the run."""
    functions = {alpha.text: _known_function(alpha, context) for alpha in alphas}
    return {text: known for text, known in functions.items() if known is not None}


def _known_function(alpha: Alpha, context: BuildContext) -> KnownSignal | None:
    if isinstance(alpha, Program):
        return partial(_values, alpha)
    return context.known(Port.parse(alpha.text))


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


# --- terms ---


class FamilyTerm(TomlTable):
    """alpha(t) f(theta, t), one term of (4), by alpha and the family of f."""

    alpha: TermAlpha = Field(
        "1", description='known function of t, or a signal: { from = "component.signal" }'
    )
    element: Whole = Field(
        0, ge=0, lt=MOST_ELEMENTS, description="index of the element of delta, from 0"
    )
    family: str = Field(description=", ".join([*FAMILIES, *SETTINGS]))
    degree: Whole | None = Field(
        None, ge=0, le=LARGEST_DEGREE, description=f"polynomial: degree, at most {LARGEST_DEGREE}"
    )
    G0: NumberRows | None = Field(
        None, description="linear: beta' = (G0 + sum theta_j G[j]) beta, f = c beta [1/s]"
    )
    G: tuple[NumberRows, ...] | None = Field(
        None, description="linear: one matrix per parameter; default: none"
    )
    c: NumberRow | None = Field(None, description="linear: output row, f = c beta")
    parameters: tuple[str, ...] | None = Field(
        None, description="linear: names of the parameters; default: theta_1, theta_2, ..."
    )
    search: tuple[tuple[Number, Number], ...] | None = Field(
        None,
        description="linear: [lower, upper] per parameter, the range of the search for initial "
        "values; default: from the eigenvalues of the generator",
    )

    def generator(self) -> Family:
        """Return the family with its settings.

        Raises
        ------
        AssumptionError
            If there is no such family, or its settings make none.
        UsageError
            If a setting is missing, or belongs to another family.
        """
        for family, keys in SETTINGS.items():
            for key in keys:
                is_given = key in self.model_fields_set
                if is_given and family != self.family:
                    raise UsageError(
                        f"{key}: expected with family {family!r} only, got family {self.family!r}"
                    )
                if family == self.family and key in NEEDED and not is_given:
                    raise UsageError(f"{key} is missing; family {family!r} requires it")
        if self.degree is not None:
            return Polynomial(self.degree)
        if self.G0 is not None and self.c is not None:
            slopes = tuple(_rows(rows, f"G[{j}]") for j, rows in enumerate(self.G or ()))
            names = self.parameters
            if names is None:
                names = tuple(f"theta_{j}" for j in range(1, len(slopes) + 1))
            return LinearFamily(_rows(self.G0, "G0"), slopes, self.c, names, self.search)
        return family_named(self.family)


class ValuedTerm(FamilyTerm):
    """A term whose parameters and constants are known: of what makes a disturbance."""

    theta: Number | NumberRow | None = Field(
        None,
        description="parameters: exponent [1/s] of exponential and t-exponential; rate [rad/s] of "
        "sine; [decay [1/s], rate [rad/s]] of damped-sine; one per matrix of G of linear; none "
        "of the others",
    )
    amplitude: Number | None = Field(
        None, description="exponential, sine, damped-sine: amplitude; default: 1"
    )
    phase: Number | None = Field(
        None, description="sine, damped-sine: phase at t = 0 [rad]; default: 0"
    )
    level: Number | None = Field(
        None, description="constant, ramp, t-exponential: coefficient of t^0"
    )
    slope: Number | None = Field(None, description="ramp, t-exponential: coefficient of t [1/s]")
    constants: NumberRow | None = Field(
        None,
        description="polynomial: coefficients of t^0, t, t^2, ...; linear: states beta at t = 0",
    )

    def values(self, family: Family) -> tuple[float, ...]:
        """Return theta; raise UsageError if the family has not as many parameters."""
        given = () if self.theta is None else self.theta
        values = given if isinstance(given, tuple) else (given,)
        return _as_many("theta", family, values, family.parameters)

    def constant_values(self, family: Family) -> tuple[float, ...]:
        """Return the constants in the order of the family.

        Raises
        ------
        UsageError
            If they are not as many as the family has, or there is a key that it has not.
        """
        in_a_list = family.name in IN_A_LIST
        own = ("constants",) if in_a_list else family.constants
        for key in (*ONE_BY_ONE, "constants"):
            if getattr(self, key) is not None and key not in own:
                raise UsageError(
                    f"{key}: not a constant of family {family.name!r}; available: {', '.join(own)}"
                )
        if in_a_list:
            return _as_many("constants", family, self.constants or (), family.constants)
        values = []
        for key in own:
            given = getattr(self, key)
            value = DEFAULTS.get(key) if given is None else given
            if value is None:
                raise UsageError(f"{key} is missing; family {family.name!r} requires it")
            values.append(float(value))
        return tuple(values)


def _as_many(
    key: str, family: Family, values: Sequence[float], names: Sequence[str]
) -> tuple[float, ...]:
    if len(values) != len(names):
        expected = f"{len(names)} ({', '.join(names)})" if names else "none"
        listed = ", ".join(f"{value:g}" for value in values[:8])
        found = f"{len(values)} number{'s' * (len(values) != 1)}{': ' * bool(listed)}{listed}"
        raise UsageError(f"{key} of family {family.name!r}: expected {expected}, got {found}")
    return tuple(map(float, values))


def element_count(terms: Sequence[FamilyTerm]) -> int:
    """Return the number of elements of a disturbance of these terms."""
    return 1 + max(term.element for term in terms)


def families_of(terms: Sequence[FamilyTerm]) -> list[Family]:
    """Return the families of terms.

    Raises
    ------
    AssumptionError, UsageError
        If one has none, naming the term.
    """
    families = []
    for number, term in enumerate(terms):
        with naming(number):
            families.append(term.generator())
    return families


def function_text(family: Family, theta: Sequence[float], constants: Sequence[float]) -> str:
    """Return f as an expression in t, with a factor before it where it has an amplitude.

    Not of a linear family, which is none.
    """
    match family.name:
        case "exponential":
            return f"{constants[0]!r}*exp({theta[0]!r}*t)"
        case "sine":
            return f"{constants[0]!r}*sin({theta[0]!r}*t + {constants[1]!r})"
        case "damped-sine":
            decaying = f"{constants[0]!r}*exp({-theta[0]!r}*t)"
            return f"{decaying}*sin({theta[1]!r}*t + {constants[1]!r})"
    text = f"{constants[-1]!r}"
    for coefficient in reversed(constants[:-1]):
        text = f"({coefficient!r} + t*{text})"
    return f"{text}*exp({theta[0]!r}*t)" if family.name == "t-exponential" else text


def _rows(rows: NumberRows, name: str) -> Rows:
    values: Any = matrix(rows, name).tolist()
    return tuple(tuple(row) for row in values)
