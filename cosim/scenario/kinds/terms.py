"""The terms of a disturbance in a scenario: a family with its settings, parameters, constants."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import Any, Final

from pydantic import Field

from cosim.errors import UsageError
from cosim.scenario.document.schema import Number, NumberRow, NumberRows, TomlTable, Whole, matrix
from cosim.scenario.kinds.alphas import ALPHA_KEY, TermAlpha, naming
from cosim.theory.disturbances.families import FAMILIES, SETTINGS, Family, Polynomial, family_named
from cosim.theory.disturbances.linear_family import LinearFamily, Rows

LINEAR: Final = "linear"
LARGEST_DEGREE: Final = 8
MOST_ELEMENTS: Final = 64
ONE_BY_ONE: Final = ("amplitude", "phase", "level", "slope")  # constants with keys of their own
DEFAULTS: Final = MappingProxyType({"amplitude": 1.0, "phase": 0.0})  # the others are needed
NEEDED: Final = ("degree", "G0", "c")  # of the settings of a family
IN_A_LIST: Final = ("polynomial", LINEAR)  # families with as many constants as are said


class FamilyTerm(TomlTable):
    """alpha(t) f(theta, t), one term of (4), by alpha and the family of f."""

    alpha: TermAlpha = Field("1", description=ALPHA_KEY)
    element: Whole = Field(
        0, ge=0, lt=MOST_ELEMENTS, description="index of the element of delta, from 0"
    )
    family: str = Field(description=", ".join([*FAMILIES, *SETTINGS]))
    degree: Whole | None = Field(None, description="polynomial: degree")
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
    search: NumberRows | None = Field(
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
        given = self.model_fields_set
        own = SETTINGS.get(self.family, ())
        for owner, keys in SETTINGS.items():
            foreign = [key for key in keys if key in given and key not in own]
            if foreign:
                raise UsageError(
                    f"{foreign[0]}: expected with family {owner!r} only, got family {self.family!r}"
                )
        for key in own:
            if key in NEEDED and key not in given:
                raise UsageError(f"{key} is missing; family {self.family!r} requires it")
        if self.degree is not None:
            if not 0 <= self.degree <= LARGEST_DEGREE:
                raise UsageError(
                    f"degree: expected 0 to {LARGEST_DEGREE}, got {self.degree}; data hardly "
                    "distinguish higher powers of t"
                )
            return Polynomial(self.degree)
        if self.G0 is not None and self.c is not None:
            return self._linear(self.G0, self.c)
        return family_named(self.family)

    def _linear(self, G0: NumberRows, c: NumberRow) -> Family:
        slopes = [_rows(rows, f"G[{j}]") for j, rows in enumerate(self.G or ())]
        names = self.parameters
        if names is None:
            names = tuple(f"theta_{j}" for j in range(1, len(slopes) + 1))
        ranges = None if self.search is None else tuple(map(_range, self.search))
        return LinearFamily(_rows(G0, "G0"), tuple(slopes), c, names, ranges)


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
        raise UsageError(
            f"{key} of family {family.name!r}: expected {expected}, got {_numbers(values)}"
        )
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


def _range(row: NumberRow) -> tuple[float, float]:
    if len(row) != 2:
        raise UsageError(f"search: expected [lower, upper], got {_numbers(row)}")
    return row[0], row[1]


def _numbers(values: Sequence[float]) -> str:
    count = len(values)
    listed = ", ".join(f"{value:g}" for value in values[:8])
    return f"{count} number{'s' if count != 1 else ''}{': ' if listed else ''}{listed}"
