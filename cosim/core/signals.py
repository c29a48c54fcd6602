"""Signals, the interface of a component, and where each signal stands in a row."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, Final, Literal, TypeAlias, get_args

from cosim.errors import GraphError, nearest, quoted
from cosim.units import BaseUnit, Unit

Variability = Literal["continuous", "discrete", "inherited"]
SignalType = Literal["real", "integer", "boolean"]
Role = Literal["input", "output", "state", "estimate"]
Causality = Literal["input", "output"]
Need = Literal["required", "optional", "forbidden"]
FaultKind = Literal["freeze", "offset", "gain", "drift", "noise", "drop", "delay"]
Dependencies: TypeAlias = Mapping[str, tuple[str, ...] | None]  # input names by output name

PortUnit: TypeAlias = str | Sequence[str]  # of all elements of a port, or one for each

SAMPLE_TIMES: Final = "sample_times"  # the output with the instants of samples
LARGEST_WHOLE: Final = 2.0**53  # up to here every integer is a float64

_CHOICES: Final[Mapping[str, tuple[str, ...]]] = {
    "variability": get_args(Variability),
    "type": get_args(SignalType),
    "role": get_args(Role),
    "connection": get_args(Need),
}


@dataclass(frozen=True, slots=True)
class Signal:
    """A named vector of real numbers, input or output of a component.

    Parameters
    ----------
    name : str
        Unique among the signals of the component.
    size : int
        Number of elements.
    unit : str, tuple of str, or None
        SI unit, ``"1"`` for dimensionless; a tuple has that of each element, and where all are the
        same it is kept as one text. None: not declared, and so never compared.
    variability : {"continuous", "discrete", "inherited"}
        Between two communication points a continuous signal is interpolated linearly, a discrete
        one holds its value from the start of the step (zero-order hold). An inherited one is
        discrete where all inputs of its component are.
    optional : bool
        NaN means "no value yet"; everywhere else it stops the run.
    type : {"real", "integer", "boolean"}
        Carried as float64 all the same.
    role : {"input", "output", "state", "estimate"}
        What it is to a reader of the log.
    base : BaseUnit, tuple of BaseUnit or None, or None
        What the unit, or that of each element, is in SI, where a definition says so; None: what
        its name says.
    start : tuple of float
        Of an input: its initial elements as long as its source has no value; empty: zeros (FMI:
        start).
    connection : {"required", "optional", "forbidden"}
        Of an input: whether something must drive it. Without a connection it keeps ``start``;
        "forbidden": that was set for it, so that a connection would overwrite it.
    nominal : tuple of float
        What size its elements usually have, which absolute tolerances are multiplied by (FMI:
        nominal); empty: 1.
    first : int
        Number of its first element where it comes from, such as 1 for the vector that the variables
        ``x[1]``, ``x[2]`` of an FMU are. Here elements are numbered from 0.
    description : str
        What it is, for people (FMI: description); signals that differ in it alone are equal.

    Raises
    ------
    GraphError
        If a field has another type or value than these.
    """

    name: str
    size: int = 1
    unit: str | tuple[str, ...] | None = None
    variability: Variability = "continuous"
    optional: bool = False
    type: SignalType = "real"
    role: Role = "output"
    base: BaseUnit | tuple[BaseUnit | None, ...] | None = None
    start: tuple[float, ...] = ()
    connection: Need = "required"
    nominal: tuple[float, ...] = ()
    first: int = 0
    description: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise GraphError(f"signal name: expected a non-empty string, got {self.name!r}")
        if type(self.size) is not int or self.size < 1:
            raise GraphError(f"signal {self.name!r}: size: expected at least 1, got {self.size!r}")
        self._check_choices()
        self._check_types()
        self._check_units()
        if self.start and len(self.start) != self.size:
            count = len(self.start)
            raise GraphError(
                f"signal {self.name!r}: expected {self.size} start values, or none, got {count}"
            )

    def _check_choices(self) -> None:
        for key, choices in _CHOICES.items():
            value = getattr(self, key)
            if value not in choices:
                suggestion = nearest(str(value), choices)
                raise GraphError(f"signal {self.name!r}: {key} {value!r}; {suggestion}")

    def _check_types(self) -> None:
        self._need("description", "a string", isinstance(self.description, str))
        self._need("optional", "True or False", isinstance(self.optional, bool))
        self._need("start", "a tuple of numbers, none of them NaN", _are_numbers(self.start))
        is_nominal = _are_numbers(self.nominal) and all(value > 0.0 for value in self.nominal)
        fits = len(self.nominal) in (0, self.size)
        self._need("nominal", "one positive number per element, or none", is_nominal and fits)
        is_whole = type(self.first) is int and self.first >= 0
        self._need("first", "an integer >= 0", is_whole)

    def _check_units(self) -> None:
        """Check the units, and keep one text, or one for each element where they differ."""
        units = self.unit if isinstance(self.unit, tuple) else (self.unit,)
        is_named = all(isinstance(unit, str) for unit in units)
        is_named |= all(unit is None for unit in units)
        needed = "a string, a tuple with one for each element, or None"
        fits = not isinstance(self.unit, tuple) or len(units) == self.size
        self._need("unit", needed, is_named and fits)
        bases = self.base if isinstance(self.base, tuple) else (self.base,)
        is_base = all(isinstance(base, BaseUnit | None) for base in bases)
        needed = "a BaseUnit, a tuple with one or None for each element, or None"
        fits = not isinstance(self.base, tuple) or len(bases) == self.size
        self._need("base", needed, is_base and fits)
        if len({*units}) == len({*bases}) == 1:
            object.__setattr__(self, "unit", units[0])
            object.__setattr__(self, "base", bases[0])
        else:
            object.__setattr__(self, "unit", units * (self.size // len(units)))
            object.__setattr__(self, "base", bases * (self.size // len(bases)))

    def _need(self, key: str, needed: str, is_right: bool) -> None:
        if not is_right:
            value = quoted(getattr(self, key))
            raise GraphError(f"signal {self.name!r}: {key}: expected {needed}, got {value}")

    @property
    def initial_values(self) -> tuple[float, ...]:
        """``start``, in full."""
        return self.start or (0.0,) * self.size

    @property
    def nominal_values(self) -> tuple[float, ...]:
        """``nominal``, in full."""
        return self.nominal or (1.0,) * self.size

    def measure(self, index: int) -> Unit:
        """Return the unit of an element, by name and definition."""
        unit = self.unit[index] if isinstance(self.unit, tuple) else self.unit
        base = self.base[index] if isinstance(self.base, tuple) else self.base
        return Unit(unit, base)

    def measures_of(self, elements: slice) -> tuple[Unit, ...]:
        """Return the units of some elements."""
        numbers = range(elements.start, elements.stop)
        if isinstance(self.unit, tuple):
            return tuple(self.measure(i) for i in numbers)
        return (self.measure(0),) * len(numbers)

    @property
    def measures(self) -> tuple[Unit, ...]:
        """The units of all elements."""
        return self.measures_of(slice(0, self.size))

    @property
    def unit_text(self) -> str:
        """Its units as people read them: ``mm``, or ``mm, m/s``; empty: none is declared."""
        return ", ".join(self.unit) if isinstance(self.unit, tuple) else self.unit or ""

    def in_units(self, units: Sequence[Unit]) -> Signal:
        """Return this signal in other units, one for each element.

        Raises
        ------
        GraphError
            If some of them are declared and others are not.
        """
        names: Any = tuple(unit.name for unit in units)
        return replace(self, unit=names, base=tuple(unit.base for unit in units))

    @property
    def origin(self) -> str:
        """Which elements they are where it comes from: ``x[1] to x[3]``; "" where the same."""
        if not self.first:
            return ""
        return f"{self.name}[{self.first}] to {self.name}[{self.first + self.size - 1}]"

    @property
    def elements(self) -> list[str]:
        """Names of the elements: ``y`` for size 1, else ``y[0]``, ``y[1]``, ..."""
        return [self.element(i) for i in range(self.size)]

    def element(self, index: int) -> str:
        """Return the name of an element."""
        return self.name if self.size == 1 else f"{self.name}[{index}]"


def _are_numbers(values: object) -> bool:
    if not isinstance(values, tuple):
        return False
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float):
            return False
        if isinstance(value, float) and math.isnan(value):
            return False
    return True


def samples_of(output: str) -> str:
    """Return the name of the output that has the samples of another output."""
    return f"{output}_samples"


def element_names(signals: Iterable[Signal]) -> list[str]:
    """Return the names of the elements of all signals, in their order."""
    names: list[str] = []
    for signal in signals:
        names += signal.elements
    return names


@dataclass(frozen=True)
class Interface:
    """What a component shows to the outside.

    Parameters
    ----------
    inputs, outputs : tuple of Signal
    feedthrough : mapping of output name to input names or None
        On which inputs at the same instant an output depends directly (FMI:
        ModelStructure/Outputs); on none where not named. None: unknown, so possibly on any of them.
    initial : mapping of output name to input names or None
        The same at initialization, where the state may depend on inputs too (FMI:
        ModelStructure/InitialUnknowns); as feedthrough where not named.
    delayed : tuple of input names
        Inputs of which the state takes only the value at the start of a step, whatever drives them:
        those of a delay of at least one step, of a sampled controller. Their value at the end
        reaches outputs there by feedthrough alone. All others are *reactive*: the state may follow
        them through the step, so that even an output without feedthrough needs them at its end.
        (C. Gomes et al., Verification of co-simulation algorithms subject to algebraic loops and
        adaptive steps, FMICS 2021.)
    prepares : bool
        Whether the component has ``prepare`` (:class:`cosim.core.contracts.Preparable`).
    rollback : bool
        Whether the component has ``save`` and ``restore`` (:class:`cosim.core.contracts.Rollback`).
    native : bool
        Whether the component has ``native`` (:class:`cosim.core.contracts.Native`).
    lagging : tuple of output names
        Outputs that follow inputs directly, or may, but not those at the end of a step: they belong
        to what the inputs have inside it, so that a loop through them is of first order at best.
    jumping : tuple of output names
        Outputs that jump while inputs that they follow directly change as little as one likes, as
        those of a switch do: a loop that meets a jump may have no solution there, whatever its step
        is.
    linearizable : bool
        Whether the component has ``linearized`` (:class:`cosim.core.contracts.Linearizable`).
    restarts : bool
        Whether ``save`` starts the component anew where it is, as a solver whose memory cannot be
        copied does: what follows has other bits than without it.
    left_limits : tuple of output names
        Outputs that may jump at communication points by themselves, whatever the inputs are: the
        component has ``left_limits`` (:class:`cosim.core.contracts.Jumping`).
    keeps_events : bool
        Whether an event that is due may happen as soon as outputs are evaluated, for good: of an
        FMU that cannot go back. Where a loop evaluates them again for inputs that come later, it
        has happened with the earlier ones.
    locates_events : bool
        Whether the component has ``first_event`` (:class:`cosim.core.contracts.Eventful`).
    substeps : bool
        Whether it may be advanced over parts of a communication step
        (:class:`cosim.core.contracts.PreparableSubsteps`).
    continuous : bool
        Whether its continuous outputs are so by construction, as those of an integrated system: no
        jump hides between two communication points, so that the mean of both is one of the signal,
        unless it feeds through.
    one_value : tuple of input names
        Continuous inputs that have one value over a whole step: the component has ``take_wiring``
        (:class:`cosim.core.contracts.Wired`).
    samples : bool
        Whether it takes its inputs at communication points alone, as a sensor does, also where they
        feed through: a graph of ``input_interpolation = "latest"`` gives them as they are there.

    Raises
    ------
    GraphError
        If a name is declared twice, or an output or input is named that is not there.
    """

    inputs: tuple[Signal, ...] = ()
    outputs: tuple[Signal, ...] = ()
    feedthrough: Dependencies = field(default_factory=dict)
    initial: Dependencies = field(default_factory=dict)
    delayed: tuple[str, ...] = ()
    prepares: bool = False
    rollback: bool = False
    native: bool = False
    linearizable: bool = False
    restarts: bool = False
    lagging: tuple[str, ...] = ()
    jumping: tuple[str, ...] = ()
    left_limits: tuple[str, ...] = ()
    substeps: bool = False
    keeps_events: bool = False
    locates_events: bool = False
    continuous: bool = False
    one_value: tuple[str, ...] = ()
    samples: bool = False

    def __post_init__(self) -> None:
        # What is declared must not change later: copies, and nothing that can be written to.
        object.__setattr__(self, "inputs", _signals("inputs", self.inputs))
        object.__setattr__(self, "outputs", _signals("outputs", self.outputs))
        counts = Counter(signal.name for signal in self.signals)
        repeated = sorted(name for name, count in counts.items() if count > 1)
        if repeated:
            raise GraphError(f"signal {repeated[0]!r} is declared twice in one interface")
        for key in ("feedthrough", "initial"):
            frozen = self._dependencies(key, getattr(self, key))
            object.__setattr__(self, key, MappingProxyType(frozen))
        object.__setattr__(self, "delayed", self._input_names("delayed", self.delayed))

    def __reduce__(self) -> tuple[Any, ...]:
        # A mapping proxy can be neither pickled nor copied; the dictionary in it can.
        values = (getattr(self, field.name) for field in fields(self))
        return Interface, tuple(
            dict(value) if isinstance(value, Mapping) else value for value in values
        )

    def _dependencies(self, key: str, declared: Dependencies) -> dict[str, tuple[str, ...] | None]:
        """Return a copy of declared dependencies, after a check of the names."""
        if not isinstance(declared, Mapping):
            raise GraphError(
                f"{key}: expected a mapping of output names to input names, got {declared!r}"
            )
        outputs = {signal.name for signal in self.outputs}
        checked = {}
        for output, names in declared.items():
            if output not in outputs:
                suggestion = nearest(str(output), sorted(outputs))
                raise GraphError(f"{key}: there is no output {output!r}; {suggestion}")
            label = f"{key} of {output!r}"
            checked[output] = None if names is None else self._input_names(label, names)
        return checked

    def _input_names(self, label: str, names: Iterable[str]) -> tuple[str, ...]:
        """Return names of inputs, after a check that they are there."""
        if isinstance(names, str) or not isinstance(names, Iterable):
            raise GraphError(f"{label}: expected a tuple of input names, got {names!r}")
        checked = tuple(names)
        for name in checked:
            if name not in self.input_names:
                suggestion = nearest(str(name), sorted(self.input_names))
                raise GraphError(f"{label}: there is no input {name!r}; {suggestion}")
        return checked

    @cached_property
    def input_names(self) -> frozenset[str]:
        """Names of the inputs."""
        return frozenset(signal.name for signal in self.inputs)

    @cached_property
    def signals(self) -> tuple[Signal, ...]:
        """Inputs, then outputs."""
        return self.inputs + self.outputs

    @cached_property
    def by_name(self) -> Mapping[str, Signal]:
        """The signals by their names."""
        return {signal.name: signal for signal in self.signals}

    @cached_property
    def n_u(self) -> int:
        """Number of input elements."""
        return sum(signal.size for signal in self.inputs)

    @cached_property
    def n_y(self) -> int:
        """Number of output elements."""
        return sum(signal.size for signal in self.outputs)

    def feeds(self, output: str) -> tuple[str, ...]:
        """Return the inputs on which ``output`` depends directly, or may depend."""
        return self._all_if_unknown(self.feedthrough.get(output, ()))

    def feeds_initially(self, output: str) -> tuple[str, ...]:
        """Return the inputs on which ``output`` depends at initialization, or may depend."""
        direct = self.feedthrough.get(output, ())
        return self._all_if_unknown(self.initial.get(output, direct))

    def knows(self, output: str) -> bool:
        """Return whether it is known on which inputs ``output`` depends directly."""
        return self.feedthrough.get(output, ()) is not None

    def _all_if_unknown(self, names: tuple[str, ...] | None) -> tuple[str, ...]:
        if names is None:
            return tuple(signal.name for signal in self.inputs)
        return names

    def input_columns(self) -> dict[str, slice]:
        """Return the columns of each input in the input vector."""
        return _columns(self.inputs)

    def output_columns(self) -> dict[str, slice]:
        """Return the columns of each output in the output vector."""
        return _columns(self.outputs)


def _signals(key: str, signals: Iterable[Signal]) -> tuple[Signal, ...]:
    """Return declared signals as a tuple."""
    if not isinstance(signals, Iterable):
        raise GraphError(f"{key}: expected a tuple of Signal, got {signals!r}")
    checked = tuple(signals)
    for signal in checked:
        if not isinstance(signal, Signal):
            raise GraphError(f"{key}: expected a Signal, got {signal!r}")
    return checked


def _columns(signals: tuple[Signal, ...], start: int = 0) -> dict[str, slice]:
    columns = {}
    for signal in signals:
        columns[signal.name] = slice(start, start + signal.size)
        start += signal.size
    return columns


@dataclass(frozen=True)
class Channel:
    """One component's contiguous part of a row: its applied inputs, then its outputs."""

    name: str
    interface: Interface
    start: int
    period: int = 1  # communication steps between the rows that the log keeps

    @cached_property
    def inputs(self) -> slice:
        """Columns of the applied inputs."""
        return slice(self.start, self.start + self.interface.n_u)

    @cached_property
    def outputs(self) -> slice:
        """Columns of the outputs."""
        return slice(self.inputs.stop, self.inputs.stop + self.interface.n_y)

    @cached_property
    def columns(self) -> slice:
        """All columns of the component."""
        return slice(self.start, self.outputs.stop)

    @property
    def signals(self) -> tuple[Signal, ...]:
        """Inputs, then outputs."""
        return self.interface.signals

    @property
    def by_name(self) -> Mapping[str, Signal]:
        """The signals by their names."""
        return self.interface.by_name

    def described(self, name: str) -> Signal:
        """Return a signal with the role that it has for a reader: an input need not declare its."""
        signal = self.by_name[name]
        is_input = signal.role == "output" and signal in self.interface.inputs
        return replace(signal, role="input") if is_input else signal

    @cached_property
    def signal_columns(self) -> Mapping[str, slice]:
        """Columns of every signal in the row, by its name."""
        return _columns(self.signals, self.start)


@dataclass(frozen=True, slots=True)
class Layout:
    """Where every signal of a graph stands in a row of ``width`` columns.

    While a graph advances there are ``row_width``: behind the channels stand left limits, of those
    columns that may jump at a communication point, where the channels have the right limits.

    Parameters
    ----------
    channels : tuple of Channel
    jumping : tuple of int
        The columns that may jump, and are followed through a step.
    """

    channels: tuple[Channel, ...]
    jumping: tuple[int, ...] = ()
    _by_name: dict[str, Channel] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        by_name = {channel.name: channel for channel in self.channels}
        object.__setattr__(self, "_by_name", by_name)

    @property
    def width(self) -> int:
        """Number of columns of a row."""
        return self.channels[-1].columns.stop if self.channels else 0

    @property
    def row_width(self) -> int:
        """Number of columns of a row while the graph advances."""
        return self.width + len(self.jumping)

    @property
    def left_limits(self) -> dict[int, int]:
        """The columns of left limits, by those that may jump."""
        return {column: self.width + place for place, column in enumerate(self.jumping)}

    def with_left_limits(self, jumping: Iterable[int]) -> Layout:
        """Return this layout with the columns that may jump."""
        return Layout(self.channels, tuple(jumping))

    def __getitem__(self, component: str) -> Channel:
        """Return the channel of a component."""
        return self._by_name[component]


def column_names(layout: Layout) -> list[str]:
    """Return the name of every column: ``component.signal`` or ``component.signal[i]``."""
    names = []
    for channel in layout.channels:
        names += [f"{channel.name}.{element}" for element in element_names(channel.signals)]
    return names
