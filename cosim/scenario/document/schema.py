"""The schema of a scenario file: its tables, their keys and the types of the values."""

from __future__ import annotations

import cmath
import math
import re
import unicodedata
from collections.abc import Iterator
from contextlib import suppress
from fractions import Fraction
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    InstanceOf,
    PlainValidator,
    model_validator,
)

from cosim.core.clock import Clock
from cosim.core.recorded.partial import RecordSelection
from cosim.errors import quoted
from cosim.scenario.document.places import PORTS, Problem
from cosim.scenario.document.problems import TableProblems

Number = Annotated[float, Field(allow_inf_nan=False, strict=True)]


_FRACTION: Final = re.compile(r"\s*(?P<numerator>\d{1,15})\s*/\s*(?P<denominator>\d{1,15})\s*")


def _check_bits(number: int) -> int:
    if not -(2**63) <= number < 2**63:  # what TOML promises
        raise ValueError(f"expected an integer of at most 64 bits, got {quoted(number)}")
    return number


Whole = Annotated[int, Field(strict=True), AfterValidator(_check_bits)]
LARGEST_SEED: Final = 2**53  # of an action: a log has it as a float
Size = Annotated[Whole, Field(ge=1, le=100_000)]  # of a signal
Flag = Annotated[bool, Field(strict=True)]
NumberRow = tuple[Number, ...]
NumberRows = tuple[NumberRow, ...]


def _check_rows(rows: NumberRows) -> NumberRows:
    matrix(rows)
    return rows


MatrixRows = Annotated[NumberRows, AfterValidator(_check_rows)]  # where nothing else may stand
Limit = Annotated[float, Field(strict=True)]  # inf: there is none


def _interval(value: object) -> object:
    """Return a text that is a fraction as one, and all else as it is.

    Raises
    ------
    ValueError
        If it is another text.
    """
    if not isinstance(value, str):
        return value
    numbers = _FRACTION.fullmatch(value)
    if numbers is None or not int(numbers["denominator"]):
        raise ValueError(
            f'expected a number, or a fraction as a string such as "1/60", got {quoted(value)}'
        )
    return Fraction(int(numbers["numerator"]), int(numbers["denominator"]))


StepTime = Annotated[Number | InstanceOf[Fraction], BeforeValidator(_interval)]


def _pole(value: object) -> complex:
    """Return a number, or a text that is a complex literal of Python: TOML has no such numbers.

    Raises
    ------
    ValueError
        If it is neither, or not finite.
    """
    pole = complex(math.nan)
    if isinstance(value, int | float | str) and not isinstance(value, bool):
        with suppress(ValueError, OverflowError):
            pole = complex(value)
    if not cmath.isfinite(pole):
        expected = 'a finite number, or a complex one as a string such as "-3+2j"'
        raise ValueError(f"expected {expected}, got {quoted(value)}")
    return pole


Pole = Annotated[complex, PlainValidator(_pole)]
PoleRow = tuple[Pole, ...]


def _any_unit(name: str) -> str:
    if not name.strip():
        raise ValueError(f"expected a unit, such as mm, or none, got {name!r}")
    return name


AnyUnit = Annotated[str, AfterValidator(_any_unit)]  # also one that is not known

MOST_NAME_BYTES = 100  # in UTF-8: file names with it have at most 255


def _check_name(name: str) -> str:
    """Check that a text is a name: a word of any language.

    Raises
    ------
    ValueError
        If it is none.
    """
    composed = unicodedata.normalize("NFC", name)
    expected = ""
    if name != composed:
        expected = f"{composed!r}, composed as Unicode NFC"
    elif len(name.encode(errors="replace")) > MOST_NAME_BYTES:
        expected = f"a name of at most {MOST_NAME_BYTES} bytes"
    elif name.startswith(("_", "-")) or not name.replace("-", "_").isidentifier():
        expected = "a name of letters, digits, '_' and '-' that begins with a letter"
    if expected:
        raise ValueError(f"expected {expected}, got {quoted(name)}")
    return name


Name = Annotated[str, AfterValidator(_check_name)]

ACTIONS: Final = "actions"  # a list of tables
COMPONENTS: Final = "components"
# what a dotted key may begin with, beside a component
TABLES: Final = ("scenario", "models", *PORTS, ACTIONS, "record")
# what a short key of an edit begins with is one of these tables, or else a component
RESERVED: Final = (*TABLES, "swap", COMPONENTS)


class TomlTable(BaseModel):
    """A table of the file: frozen, no unknown keys, no conversions between types.

    Its validator is built when it is first used: a file uses few of the tables that there are.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=False, validate_default=False, defer_build=True
    )


class SubstepTable(TomlTable):
    """The table [scenario.substeps]."""

    rtol: Annotated[Number, Field(ge=0.0)] = Field(
        1e-6, description="relative tolerance of the outputs per substep"
    )
    atol: Annotated[Number, Field(ge=0.0)] = Field(
        1e-9,
        description="absolute tolerance, in the unit of the output, times the nominal value of "
        "an FMU output; added to the relative one",
    )
    min: Annotated[Number, Field(gt=0.0)] = Field(1e-6, description="shortest substep [s]")


class Settings(TomlTable):
    """The table [scenario]."""

    name: Name = Field(description="name of the scenario and of its logs")
    start_time: Number = Field(0.0, description="start of the run [s], >= 0")
    stop: Number = Field(description="end of the run [s]")
    step: StepTime = Field(description='communication step [s], or a fraction such as "1/60"')
    coupling: Literal["gauss-seidel", "jacobi", "newton"] = Field(
        "gauss-seidel",
        description='coupling of loops: "gauss-seidel", "jacobi", or "newton" (solves for the '
        "inputs at the end of each step, second order)",
    )
    coupling_check: Literal["refuse", "warn"] = Field(
        "refuse",
        description='if the coupling amplifies an error by more than 10 over the run: "refuse" to '
        'run, or "warn"',
    )
    iterations: Annotated[Whole, Field(ge=1)] = Field(
        1,
        description='iterations per step with "gauss-seidel" or "jacobi"',
    )
    input_interpolation: Literal["linear", "zero-order", "latest"] | None = Field(
        None,
        description='inputs within a step: "linear" interpolation, "zero-order" hold from its '
        'start, or hold of the "latest" values (classic Gauss-Seidel); default: "linear", and the '
        "latest where a co-simulation FMU takes one value from a source that may jump",
    )
    substeps: SubstepTable | None = Field(
        None,
        description="error-controlled substeps of loops; default: none",
    )
    threads: Annotated[Whole, Field(ge=1, le=2)] | None = Field(
        None,
        description="threads for independent branches, used where faster: 1, or 2 (FMUs "
        "included); default: 2 for cosim's own components",
    )
    until: str | None = Field(
        None,
        description="condition that ends the run early, at a communication point, such as "
        '"abs(observer.delta - delta.y) < 1e-3 for 1 s"',
    )
    verdicts: bool = Field(
        True,
        description="judge estimates by a fit at the end of the run, which may take as long as a "
        "short run",
    )
    description: str = Field("", description="one line of text for 'cosim list' and reports")

    @property
    def clock(self) -> Clock:
        """The clock of the run, with blocks of any size.

        Raises
        ------
        ClockError
            If one of its times is off the grid.
        """
        return Clock(self.stop, self.step, start_time=self.start_time)


class ModelTable(TomlTable):
    """A table of [models], in one of two forms.

    General: E x' = A x + B (u, delta), y = C x + D (u, delta). Partitioned: E = diag(I, 0), D = 0.
    """

    n_a: Whole | None = Field(
        None, ge=1, description="number of dynamic states of a partitioned model A, Bu, Bd, C"
    )
    E: MatrixRows | None = Field(None, description="square matrix of E x'; default: identity")
    A: MatrixRows | None = Field(None, description="square matrix; required without file")
    B: MatrixRows | None = Field(None, description="one column per input; or give Bu and Bd")
    Bu: MatrixRows | None = Field(None, description="columns of the known inputs u")
    Bd: MatrixRows | None = Field(None, description="columns of the disturbances delta")
    C: MatrixRows | None = Field(None, description="one row per output; required without file")
    D: MatrixRows | None = Field(None, description="direct feedthrough, columns as B; default: 0")
    Du: MatrixRows | None = Field(None, description="direct feedthrough, columns as Bu; default: 0")
    Dd: MatrixRows | None = Field(None, description="direct feedthrough, columns as Bd; default: 0")
    disturbances: tuple[Whole, ...] | None = Field(
        None, description="indices of the columns of B that are unknown, from 0; default: none"
    )
    file: str | None = Field(
        None,
        description="path of a MAT-file (.mat) with the matrices of the general form",
    )


class ConnectionTable(TomlTable):
    """A connection with a linear map, which leads to ``unit``.

    From there it is converted to the unit of the input.
    """

    source: str | list[str] = Field(alias="from")
    gain: Number | NumberRows = 1.0
    offset: Number = 0.0
    unit: str | list[str] | None = None


class SwapTable(TomlTable):
    """An entry of [swap].

    ``plant = { path = "x.fmu", map = { "observer.y" = "out1" } }``, or short ``plant = "x.fmu"``:
    an FMU or a recorded component replaces a component, whose table stays in the file for
    comparison.
    """

    path: str = Field(
        description="path of an .fmu (x.fmu#me or x.fmu#cs selects the interface type) "
        "or of a recorded log (.mcap)"
    )
    map: dict[str, str | list[str]] = Field(
        {},
        description="port in the scenario = port of the new component, or a list of ports",
    )


class ActionTable(TomlTable):
    """An entry of [[actions]]: what happens to signals or parameters at an instant.

    Values are in the unit of the input. One for all elements, or one for each.
    """

    at: Number | None = Field(None, description="time [s], a communication point of the run")
    when: str | None = Field(
        None,
        description='condition in place of a time, such as "plant.y > 2 for 0.5 s"; the '
        "action is taken when it is first met",
    )
    signal: str | list[str] | None = Field(
        None, description="input, element of an input, or list of them; all get the same action"
    )
    override: Flag | Number | NumberRow | None = Field(
        None, description="value that replaces the source"
    )
    freeze: Flag | None = Field(None, description="true: hold the present value")
    offset: Number | NumberRow | None = Field(None, description="offset added to the source")
    gain: Number | NumberRow | None = Field(None, description="factor applied to the source")
    drift: Number | NumberRow | None = Field(
        None, description="slope of a ramp added to the source [1/s]"
    )
    noise: Number | NumberRow | None = Field(
        None,
        description="standard deviation of Gaussian noise added at every communication point",
    )
    drop: Flag | Number | None = Field(
        None,
        description="probability of losing a sample, or true: all are lost; the input has no value "
        "then if it is optional, else it keeps the last one",
    )
    delay: Number | None = Field(
        None, description="delay of the source [s], a multiple of the communication step"
    )
    seed: Whole | None = Field(
        None, ge=0, le=LARGEST_SEED, description="seed of noise or drop; default: 0"
    )
    release: Flag | None = Field(None, description="true: end all faults of the input")
    set: dict[str, Any] | None = Field(
        None,
        description='tunable parameters and their new values: { "observer.filter_rate" = 500.0 }; '
        "the state is kept; 'cosim list KIND' shows which are tunable",
    )
    swap: dict[str, str] | None = Field(
        None,
        description='components and the .fmu that replaces them: { plant = "other.fmu" }; the '
        "continuous states are kept",
    )

    @property
    def effects(self) -> list[str]:
        """The keys of what happens: one, of an action that is right."""
        return [name for name in EFFECTS if getattr(self, name) is not None]

    @property
    def signals(self) -> list[str]:
        """The names of the signals that it is about; none where it sets parameters."""
        if self.signal is None:
            return []
        return [self.signal] if isinstance(self.signal, str) else self.signal

    @model_validator(mode="after")
    def _is_one_action(self) -> Self:
        problems = list(self._problems())
        if problems:
            raise TableProblems(problems)
        return self

    def _problems(self) -> Iterator[Problem]:
        """Yield what is wrong with it by itself."""
        if (self.at is None) == (self.when is None):
            found = "neither" if self.at is None else "both"
            yield (), f"expected either 'at' (a time [s]) or 'when' (a condition), got {found}"
        of_components = [name for name in ("set", "swap") if getattr(self, name) is not None]
        if of_components and self.signal is not None:
            yield ("signal",), f"not allowed with '{of_components[0]}'; write a separate action"
        if not of_components and not self.signals:
            yield (), "'signal' is missing; expected an input, such as plant.u"
        if len(self.effects) != 1:
            found = " and ".join(self.effects) or "none"
            yield (), f"expected exactly one of {', '.join(EFFECTS)}, got {found}"
        contents = {"set": "a parameter and its value", "swap": "a component and its .fmu"}
        for name, content in contents.items():
            if getattr(self, name) == {}:
                yield (name,), f"expected {content}, got an empty table"
        for name in ("freeze", "drop", "release"):
            if getattr(self, name) is False:
                yield (name,), "expected true, got False"
        is_random = self.noise is not None or (
            self.drop is not None and not isinstance(self.drop, bool)
        )
        if self.seed is not None and not is_random:
            yield ("seed",), "allowed only with random numbers (noise, drop)"


EFFECTS: Final = tuple(
    name for name in ActionTable.model_fields if name not in ("at", "when", "signal", "seed")
)  # keys of what happens; an action has one of them


class RecordTable(TomlTable):
    """The table [record]: which signals are recorded, and how often."""

    signals: Annotated[tuple[str, ...], Field(min_length=1)] | None = Field(
        None,
        description='signals and patterns to record, such as ["plant.*", "observer.delta"]; '
        "default: all",
    )
    every: Annotated[Whole, Field(ge=1)] = Field(
        1,
        description="communication steps between rows; a component with a longer period has rows "
        "at the common multiples",
    )

    @property
    def selection(self) -> RecordSelection:
        """The same for a recorder."""
        return RecordSelection(self.signals, self.every)


class File(TomlTable):
    """The content of a scenario file; components and actions are validated each on its own."""

    scenario: Settings = Field(description="the table [scenario] with name, stop and step")
    models: dict[str, ModelTable] = {}
    components: dict[Name, dict[str, Any]] = Field(
        description="a table [components.NAME] for each, with its kind"
    )
    connections: dict[str, str | list[str] | ConnectionTable] = {}
    truth: dict[str, str | tuple[str, ...] | Number | NumberRow] = {}
    swap: dict[str, SwapTable] = {}
    actions: tuple[dict[str, Any], ...] = ()
    record: RecordTable = RecordTable(signals=None, every=1)
    study: dict[str, Any] = {}  # of many runs of the scenario; validated where these are planned


def matrix(rows: NumberRows, name: str = "") -> np.ndarray[Any, np.dtype[np.float64]]:
    """Convert rows to a matrix.

    Raises
    ------
    ValueError
        If the rows have different lengths.
    """
    lengths = [len(row) for row in rows]
    if not rows or len(set(lengths)) != 1 or lengths[0] == 0:
        where = f"{name}: " if name else ""
        raise ValueError(
            f"{where}expected rows of equal length, such as [[0, 1], [2, 3]], got lengths {lengths}"
        )
    return np.array(rows, dtype=np.float64)


def array_of(rows: NumberRow | NumberRows, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Convert a row to a vector, or rows to a matrix; ValueError as of :func:`matrix`."""
    if rows and isinstance(rows[0], tuple):
        return matrix(tuple(row for row in rows if isinstance(row, tuple)), name)
    return np.array(rows, np.float64)
