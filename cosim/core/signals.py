"""Signals, the interface of a component, and where each signal stands in a row."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

from cosim.errors import GraphError
from cosim.units import BaseUnit, Unit

Variability = Literal["continuous", "discrete", "inherited"]
SignalType = Literal["real", "integer", "boolean"]
Role = Literal["input", "output", "state", "estimate"]
Need = Literal["required", "optional", "forbidden"]


@dataclass(frozen=True, slots=True)
class Signal:
    """A named vector of real numbers, input or output of a component.

    Parameters
    ----------
    name : str
        Unique among the signals of the component.
    size : int
        Number of elements.
    unit : str or None
        SI unit, ``"1"`` for dimensionless; None: not declared, and so never compared.
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
    base : BaseUnit or None
        What the unit is in SI, where a definition says so; None: what its name says.
    start : tuple of float
        Of an input: its initial elements as long as its source has no value; empty: zeros (FMI:
        start).
    connection : {"required", "optional", "forbidden"}
        Of an input: whether something must drive it. Without a connection it keeps ``start``;
        "forbidden": that was set for it, so that a connection would overwrite it.
    """

    name: str
    size: int = 1
    unit: str | None = None
    variability: Variability = "continuous"
    optional: bool = False
    type: SignalType = "real"
    role: Role = "output"
    base: BaseUnit | None = None
    start: tuple[float, ...] = ()
    connection: Need = "required"

    def __post_init__(self) -> None:
        if self.size < 1:
            raise GraphError(f"signal {self.name!r}: size {self.size}, needed at least 1")
        if self.start and len(self.start) != self.size:
            count = len(self.start)
            raise GraphError(
                f"signal {self.name!r}: {count} start values, needed {self.size} or none"
            )

    @property
    def initial_values(self) -> tuple[float, ...]:
        """``start``, in full."""
        return self.start or (0.0,) * self.size

    @property
    def measure(self) -> Unit:
        """Its unit, by name and definition."""
        return Unit(self.unit, self.base)

    @property
    def si(self) -> BaseUnit | None:
        """What its unit is in SI; None: no unit, or not known."""
        return self.measure.si

    @property
    def elements(self) -> list[str]:
        """Names of the elements: ``y`` for size 1, else ``y[0]``, ``y[1]``, ..."""
        if self.size == 1:
            return [self.name]
        return [f"{self.name}[{i}]" for i in range(self.size)]


@dataclass(frozen=True, slots=True)
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
    prepares : bool
        Whether the component has ``prepare`` (:class:`cosim.core.contracts.Preparable`).
    rollback : bool
        Whether the component has ``save`` and ``restore`` (:class:`cosim.core.contracts.Rollback`).
    """

    inputs: tuple[Signal, ...] = ()
    outputs: tuple[Signal, ...] = ()
    feedthrough: Mapping[str, tuple[str, ...] | None] = field(default_factory=dict)
    initial: Mapping[str, tuple[str, ...] | None] = field(default_factory=dict)
    prepares: bool = False
    rollback: bool = False

    def __post_init__(self) -> None:
        names = [signal.name for signal in self.signals]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise GraphError(
                f"signal {repeated[0]!r} is declared twice in one interface; "
                "every signal needs its own name"
            )

    @property
    def signals(self) -> tuple[Signal, ...]:
        """Inputs, then outputs."""
        return self.inputs + self.outputs

    @property
    def n_u(self) -> int:
        """Number of input elements."""
        return sum(signal.size for signal in self.inputs)

    @property
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


def _columns(signals: tuple[Signal, ...]) -> dict[str, slice]:
    columns = {}
    start = 0
    for signal in signals:
        columns[signal.name] = slice(start, start + signal.size)
        start += signal.size
    return columns


@dataclass(frozen=True, slots=True)
class Channel:
    """One component's contiguous part of a row: its applied inputs, then its outputs."""

    name: str
    interface: Interface
    start: int
    period: int = 1  # communication steps between the rows that the log keeps

    @property
    def inputs(self) -> slice:
        """Columns of the applied inputs."""
        return slice(self.start, self.start + self.interface.n_u)

    @property
    def outputs(self) -> slice:
        """Columns of the outputs."""
        return slice(self.inputs.stop, self.inputs.stop + self.interface.n_y)

    @property
    def columns(self) -> slice:
        """All columns of the component."""
        return slice(self.start, self.outputs.stop)

    @property
    def signals(self) -> tuple[Signal, ...]:
        """Inputs, then outputs."""
        return self.interface.signals

    def signal_columns(self) -> Iterator[tuple[Signal, slice]]:
        """Yield every signal with its columns in the row."""
        start = self.start
        for signal in self.signals:
            yield signal, slice(start, start + signal.size)
            start += signal.size


@dataclass(frozen=True, slots=True)
class Layout:
    """Where every signal of a graph stands in a row of ``width`` columns."""

    channels: tuple[Channel, ...]

    @property
    def width(self) -> int:
        """Number of columns of a row."""
        return self.channels[-1].columns.stop if self.channels else 0

    def __getitem__(self, component: str) -> Channel:
        """Return the channel of a component."""
        return next(channel for channel in self.channels if channel.name == component)
