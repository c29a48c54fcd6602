"""A variable of a model description, independent of the FMI version."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Literal, TypeAlias

from cosim.core.signals import SignalType
from cosim.units import BaseUnit

Initial: TypeAlias = Literal["exact", "approx", "calculated"]
VariableType: TypeAlias = Literal[
    "Float64",
    "Float32",
    "Int8",
    "UInt8",
    "Int16",
    "UInt16",
    "Int32",
    "UInt32",
    "Int64",
    "UInt64",
    "Boolean",
    "String",
    "Binary",
    "Clock",
]
IntervalVariability: TypeAlias = Literal[
    "constant", "fixed", "tunable", "changing", "countdown", "triggered"
]


@dataclass(frozen=True, slots=True)
class ClockTiming:
    """When a clock ticks (FMI 3.0 section 2.4.7.5, ClockType).

    Parameters
    ----------
    variability : IntervalVariability
        ``triggered``: whoever triggers it decides; any other: it is based on time.
    interval : Fraction or None
        From one tick to the next [s], as the file says it; None: the FMU says it when it runs.
    shift : Fraction
        From the start of the run to the first tick [s], where the file has an interval.
    supports_fraction : bool
        Whether the FMU gives intervals and shifts as fractions.
    """

    variability: IntervalVariability
    interval: Fraction | None = None
    shift: Fraction = Fraction(0)
    supports_fraction: bool = False


@dataclass(frozen=True, slots=True)
class Variable:
    """A variable of an FMU or of a generated model (FMI 2.0.4 section 2.2.7, FMI 3.0, 2.4.7).

    Parameters
    ----------
    name : str
    reference : int
        Value reference.
    causality : str
        ``input``, ``output``, ``parameter``, ``local``, ... as in the standard.
    type : VariableType
    variability, initial : str, str or None
    size : int
        Number of elements; 1 except for the arrays of FMI 3.
    unit : str or None
    base : BaseUnit or None
        What the unit is in SI, by its definition (offset 0 for a relative quantity).
    start : tuple of float or None
        The start value of numbers and Booleans.
    text : tuple of str or None
        The start value of a String; of a Binary in hexadecimal.
    minimum, maximum : float
    nominal : float or None
    derivative_of : str or None
        The state of which it is the derivative.
    dimensions : tuple of int or str
        Of an array (FMI 3): numbers, or names of structural parameters; ``size`` is their product.
    items : mapping of str to int
        Names and values of an enumeration.
    inside_steps : bool
        Whether an input may be set inside a step (FMI 3: intermediateUpdate; FMI 1 and 2: by its
        derivative).
    alias_of : str or None
        The variable whose other name it is (FMI 3; before, of inputs); it is no signal of its own.
    negated : bool
        Whether it is the opposite of what its value reference has (FMI 1: negatedAlias): of a
        number v it is -v, of a Boolean 1 - v.
    timing : ClockTiming or None
        Of a clock (FMI 3).
    clocks : tuple of str
        Names of the clocks that it belongs to (FMI 3): it may be set and read only in an event in
        which one of them is active, and in Initialization Mode. Empty: it belongs to none.
    doc : str
        What it is, for people.
    """

    name: str
    reference: int
    causality: str
    type: VariableType = "Float64"
    variability: str = "continuous"
    initial: Initial | None = None
    size: int = 1
    unit: str | None = None
    base: BaseUnit | None = None
    start: tuple[float, ...] | None = None
    text: tuple[str, ...] | None = None
    minimum: float = -math.inf
    maximum: float = math.inf
    nominal: float | None = None
    derivative_of: str | None = None
    dimensions: tuple[int | str, ...] = ()
    items: Mapping[str, int] = field(default_factory=dict)
    inside_steps: bool = True
    alias_of: str | None = None
    negated: bool = False
    timing: ClockTiming | None = None
    clocks: tuple[str, ...] = ()
    doc: str = ""

    @property
    def settable(self) -> bool:
        """Whether a start value may be set (FMI 2.0.4 section 2.2.7)."""
        has_start = self.causality == "input" or self.initial in ("exact", "approx")
        return has_start and self.variability != "constant"

    @property
    def is_signal(self) -> bool:
        """Whether its values are numbers."""
        return self.type not in ("String", "Binary", "Clock")

    @property
    def is_triggered(self) -> bool:
        """Whether it is a clock that others trigger, or that triggers others."""
        return self.timing is not None and self.timing.variability == "triggered"

    @property
    def is_time_based(self) -> bool:
        """Whether it is a clock that ticks at instants that the FMU announces."""
        return self.timing is not None and self.timing.variability != "triggered"

    @property
    def signal_type(self) -> SignalType:
        """What its signal carries."""
        if self.type in ("Float32", "Float64"):
            return "real"
        return "boolean" if self.type in ("Boolean", "Clock") else "integer"


def is_exact(number: int) -> bool:
    """Whether a float64, which carries it, is the same number: up to 2**53 each one is."""
    try:
        return float(number) == number
    except OverflowError:
        return False
