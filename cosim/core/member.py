"""A component in its place: its columns, the wires that feed it, and its guarded calls.

Components are the users' own, so nothing is trusted here: what they are handed cannot be written
to, what they return is checked and copied, and what they raise is named.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Final, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.connections import Connection
from cosim.core.contracts import Component, Design, Native, Preparable, Rollback, Stopped, prepare
from cosim.core.overrides import Overrides
from cosim.core.ports import ConnectionEnd
from cosim.core.signals import Channel, element_names
from cosim.errors import (
    AssumptionError,
    CosimError,
    GraphError,
    LogError,
    NonFiniteError,
    RunError,
)
from cosim.native.step import NativeStep
from cosim.units import Conversion

Columns: TypeAlias = slice | NDArray[np.intp]

FLOAT: Final = np.dtype(np.float64)


@dataclass(frozen=True, slots=True)
class Wire:
    """Copies columns of outputs into columns of an input: gain and offset, then the conversion."""

    to: slice
    source: Columns
    gain: Matrix | None  # None: plain values
    offset: float
    conversion: Conversion

    @property
    def source_columns(self) -> list[int]:
        """The numbers of the columns that it copies from."""
        if isinstance(self.source, slice):
            return list(range(self.source.start, self.source.stop))
        numbers: list[int] = self.source.tolist()
        return numbers

    def copy(self, signals: Matrix, rows: slice) -> None:
        """Fill the input columns of some rows."""
        source = signals[rows, self.source]
        if self.gain is None:
            signals[rows, self.to] = self.conversion(source)
            return
        for i, gains in enumerate(self.gain):
            # Sums run in a fixed order, without BLAS, which gives other bits on other processors.
            total = np.full(len(source), self.offset)
            for j, gain in enumerate(gains):
                if gain != 0.0:
                    total += gain * source[:, j]
            signals[rows, self.to.start + i] = self.conversion(total)


def wires_of(
    to: slice,
    connection: Connection,
    sources: Sequence[ConnectionEnd],
    conversions: Sequence[Conversion],
) -> tuple[Wire, ...]:
    """Return the wires of a connection: one for each source, or one for all under a matrix."""
    gain = connection.matrix
    if gain.ndim == 2:
        # Every source reaches the same unit (checked), so one conversion is that of all of them.
        return (Wire(to, _joined(sources), gain, connection.offset, conversions[0]),)
    identity = gain == 1.0 and connection.offset == 0.0
    wires = []
    start = to.start
    for source, conversion in zip(sources, conversions, strict=True):
        stop = start + source.size
        scaled = None if identity else gain * np.eye(source.size)
        wire = Wire(slice(start, stop), source.columns, scaled, connection.offset, conversion)
        wires.append(wire)
        start = stop
    return tuple(wires)


def constant_wires(to: slice, values: Sequence[float]) -> tuple[Wire, ...]:
    """Return the wires of an input that nothing drives: sums of no sources, and an offset."""
    wires = []
    for column, value in zip(range(to.start, to.stop), values, strict=True):
        element = slice(column, column + 1)
        wires.append(Wire(element, slice(0, 0), np.zeros((1, 0)), value, Conversion()))
    return tuple(wires)


def _joined(sources: Sequence[ConnectionEnd]) -> Columns:
    if len(sources) == 1:
        return sources[0].columns
    ranges = [np.arange(source.columns.start, source.columns.stop) for source in sources]
    return np.concatenate(ranges)


@dataclass(frozen=True, slots=True)
class NonFinite:
    """A value that is infinite, or NaN where NaN does not mean "no value yet".

    ``label`` names it; ``column`` is its place in the row of the graph, ``row`` is counted from the
    first row searched.
    """

    label: str
    value: float
    column: int
    row: int = 0

    def error(self, t: float) -> NonFiniteError:
        """Return the error that names it, at time ``t`` [s]."""
        return NonFiniteError(
            f"{self.label!r} became {self.value} at t = {t} s; the log keeps everything before"
        )


class Member:
    """A component with its columns and the wires that feed its inputs.

    Every array that it hands to the component is a view that cannot be written to, or a copy.

    Parameters
    ----------
    channel : Channel
        Name, interface and columns.
    component : Component
    wires : tuple of Wire

    Attributes
    ----------
    name : str
    inputs, outputs, columns : slice
        In the row.
    n_u : int
        Number of input elements.
    optional : Mask, shape (n_u + n_y,)
        Which elements may have no value (NaN).
    overrides : Overrides
        Of its inputs.
    """

    def __init__(self, channel: Channel, component: Component, wires: tuple[Wire, ...]) -> None:
        self.channel = channel
        self.name = channel.name
        self.inputs = channel.inputs
        self.outputs = channel.outputs
        self.columns = channel.columns
        self.wires = wires
        self._component = component
        self.n_u = channel.interface.n_u
        self._n_y = channel.interface.n_y
        self.overrides = Overrides(self.n_u)
        optional: list[bool] = []
        for signal in channel.signals:
            optional += [signal.optional] * signal.size
        self.optional = np.array(optional, np.bool_)
        self._seconds: dict[str, float] | None = None
        self._native_seconds = np.zeros(1)

    def check_exchange(self, component: Component) -> None:
        """Check that a component can take the place of this one.

        Raises
        ------
        GraphError
            If its interface is another one.
        """
        if component.interface != self.channel.interface:
            raise GraphError(
                f"component {self.name!r}: another one has another interface; needed the same "
                "signals and declarations, so that wires and order stay"
            )

    def exchange(self, component: Component) -> None:
        """Go on with another component, which has the same interface."""
        self._component = component

    def measure(self, seconds: dict[str, float]) -> None:
        """Add the wall time of every call from now on to ``seconds``, under its name."""
        self._component = Timed(self._component, self.name, seconds)
        self._seconds = seconds

    @property
    def is_measured(self) -> bool:
        """Whether the wall time of its calls is measured."""
        return self._seconds is not None

    @property
    def native_seconds_address(self) -> int | None:
        """Where compiled code adds the wall time of its calls [s]; None: it is not measured."""
        return self._native_seconds.ctypes.data if self.is_measured else None

    def add_native_seconds(self) -> None:
        """Add the wall time of compiled calls since the last time that this was done."""
        if self._seconds is not None:
            self._seconds[self.name] += float(self._native_seconds[0])
            self._native_seconds[0] = 0.0

    def label(self, column: int) -> str:
        """Return the name of one of its elements, numbered from the first input."""
        return f"{self.name}.{element_names(self.channel.signals)[column]}"

    def non_finite(self, rows: Matrix) -> NDArray[np.bool_]:
        """Return where rows of its columns are infinite, or NaN that does not mean "no value"."""
        return ~np.isfinite(rows) & ~(np.isnan(rows) & self.optional)

    def first_non_finite_output(self, y: Vector) -> NonFinite | None:
        """Return the first of its outputs, if any, that is not finite."""
        values = np.concatenate([np.zeros(self.n_u), y])
        bad = self.non_finite(values)
        return self.non_finite_value(int(bad.argmax()), values) if bad.any() else None

    def non_finite_value(self, column: int, values: Vector, row: int = 0) -> NonFinite:
        """Describe one of its values, numbered from the first input, as not finite."""
        place = self.columns.start + column
        return NonFinite(self.label(column), float(values[column]), place, row)

    def gather(self, signals: Matrix, rows: slice) -> None:
        """Bring the inputs of some rows up to date."""
        for wire in self.wires:
            wire.copy(signals, rows)
        if self.overrides:
            self.overrides.copy(signals, rows)

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Prepare the component, if its interface declares it; return a copy of its design.

        Raises
        ------
        LogError
            If the recorded design does not fit it.
        AssumptionError
            If it cannot be designed.
        RunError
            If it raises what is no error of cosim, or its design is not finite float64 arrays.
        """
        if not self.channel.interface.prepares:
            return {}
        taken = {key: read_only(array) for key, array in recorded.items()}
        try:
            design = cast(Preparable, self._component).prepare(h, held, taken)
            arrays = dict(design)
        except LogError as error:  # of the recorded design, which has no name there
            raise LogError(f"{self.name!r}: {error}") from error
        except AssumptionError as error:  # of the method, which has no name there either
            evidence = f"{self.name!r}: {error.evidence}"
            raise AssumptionError(evidence, error.verdict, error.cure) from error
        except CosimError:
            raise
        except Exception as error:
            raise RunError(f"{self.name!r}: {_raised('prepare', error)}") from error
        return {key: self._design_array(key, array) for key, array in arrays.items()}

    def initialize(self, t: float, u: Vector) -> Vector:
        """Initialize the component with inputs ``u``, a copy of its own; return a copy of y.

        Raises
        ------
        RunError
            If it raises what is no error of cosim, or returns what its interface does not promise.
        """
        try:
            y = self._component.initialize(t, read_only(u))
        except CosimError:
            raise
        except Exception as error:
            text = f"{self.name!r} stopped at t = {t} s: {_raised('initialize', error)}"
            raise RunError(text) from error
        problem = result_problem(y, (self._n_y,))
        if problem:
            raise RunError(f"{self.name!r} stopped at t = {t} s: initialize {problem}")
        return y.copy()

    def initial_outputs(self, t: float, u: Vector) -> Vector:
        """Return a copy of the outputs that the component starts with, initialized with ``u``.

        Raises
        ------
        RunError
            As from :meth:`outputs_at`, with its name and the time.
        """
        try:
            return self.outputs_at(t, u).copy()
        except RunError as error:
            raise RunError(f"{self.name!r} stopped at t = {t} s: {error}") from error

    def outputs_at(self, t: float, u: Vector) -> Vector:
        """Return the outputs at ``t``.

        Raises
        ------
        RunError
            As from :meth:`advance`.
        """
        try:
            y = self._component.outputs(t, u)
        except RunError:
            raise
        except Exception as error:
            raise RunError(_raised("outputs", error)) from error
        problem = result_problem(y, (self._n_y,))
        if problem:
            raise RunError(f"outputs {problem}")
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Advance the component.

        Raises
        ------
        RunError
            Whatever it raises, or if it returns what its interface does not promise. The stage adds
            the component and the time.
        """
        steps = len(t) - 1
        try:
            y = self._component.advance(t, h, u)
        except Stopped as stop:
            self._check_stop(stop, steps)
            raise
        except RunError:
            raise
        except Exception as error:
            raise RunError(_raised("advance", error)) from error
        problem = result_problem(y, (steps, self._n_y))
        if problem:
            raise RunError(f"advance {problem}")
        return y

    def save(self) -> Any:
        """Copy the state of the component, whose interface declares ``rollback``.

        Raises
        ------
        RunError
            If it raises what is no error of cosim.
        """
        try:
            return cast(Rollback[Any], self._component).save()
        except CosimError:
            raise
        except Exception as error:
            raise RunError(f"{self.name!r}: {_raised('save', error)}") from error

    def restore(self, state: Any) -> None:
        """Go back to a saved state of the component.

        Raises
        ------
        RunError
            If it raises what is no error of cosim.
        """
        try:
            cast(Rollback[Any], self._component).restore(state)
        except CosimError:
            raise
        except Exception as error:
            raise RunError(f"{self.name!r}: {_raised('restore', error)}") from error

    def native(self) -> NativeStep | None:
        """Return the compiled step of the component, if it has one."""
        if not self.channel.interface.native:
            return None
        return cast(Native, self._component).native()

    def _check_stop(self, stop: Stopped, steps: int) -> None:
        """Check the rows that a component completed before it stopped; none are of any width."""
        rows = stop.outputs
        if type(rows) is np.ndarray and rows.ndim == 2 and not len(rows):
            return
        completed = min(np.shape(rows)[0], steps) if np.ndim(rows) else 0
        problem = result_problem(rows, (completed, self._n_y))
        if problem:
            raise RunError(f"advance stopped, {str(stop)!r}, and {problem}") from stop

    def _design_array(self, key: str, array: Any) -> NDArray[np.float64]:
        if type(array) is not np.ndarray or array.dtype != FLOAT or not np.isfinite(array).all():
            raise RunError(
                f"{self.name!r}: prepare returned {_description(array)} as {key!r}; "
                "needed a float64 array of finite numbers"
            )
        return read_only(array.copy())


def driving_groups(groups: Sequence[Sequence[Member]]) -> list[set[int]]:
    """Return for each group of components the numbers of the groups that drive it."""
    writer: dict[int, int] = {}
    for number, members in enumerate(groups):
        for member in members:
            for column in range(member.outputs.start, member.outputs.stop):
                writer[column] = number
    drivers = []
    for members in groups:
        driving: set[int] = set()
        for member in members:
            for wire in member.wires:
                driving.update(writer[column] for column in wire.source_columns if column in writer)
        drivers.append(driving)
    return drivers


def first_non_finite(members: Iterable[Member], rows: Matrix) -> NonFinite | None:
    """Return the first value of some components that is not finite, by row.

    Of one row it is where the value arose: an output of a component whose inputs are finite, where
    there is one; else the first by component and signal.
    """
    suspects: list[tuple[Member, NDArray[np.bool_]]] = []
    for member in members:
        values = rows[:, member.columns]
        finite = np.isfinite(values)
        if not finite.all():
            bad = member.non_finite(values)
            if bad.any():
                suspects.append((member, bad))
    if not suspects:
        return None
    row = min(int(np.argmax(bad.any(axis=1))) for _, bad in suspects)
    at_row = [(member, bad[row]) for member, bad in suspects if bad[row].any()]
    causes = [(member, bad) for member, bad in at_row if not bad[: member.n_u].any()]
    member, bad_columns = (causes or at_row)[0]
    column = int(np.argmax(bad_columns))
    return member.non_finite_value(column, rows[row, member.columns], row)


class Timed:
    """Passes every call on and adds its wall time to ``seconds[name]``."""

    def __init__(self, component: Component, name: str, seconds: dict[str, float]) -> None:
        self.interface = component.interface
        self._component = component
        self._name = name
        self._seconds = seconds
        seconds[name] = 0.0

    @contextmanager
    def _measured(self) -> Iterator[None]:
        """Add the wall time of the block, if nothing is raised in it."""
        began = perf_counter()
        yield
        self._seconds[self._name] += perf_counter() - began

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Pass on."""
        with self._measured():
            return prepare(self._component, h, held, recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Pass on."""
        with self._measured():
            return self._component.initialize(t, u)

    def native(self) -> NativeStep | None:
        """Pass on."""
        return cast(Native, self._component).native()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Pass on."""
        with self._measured():
            return self._component.outputs(t, u)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Pass on."""
        with self._measured():
            return self._component.advance(t, h, u)

    def save(self) -> Any:
        """Pass on."""
        return cast(Rollback[Any], self._component).save()

    def restore(self, state: Any) -> None:
        """Pass on."""
        cast(Rollback[Any], self._component).restore(state)


def read_only(array: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a view of an array that cannot be written to."""
    view = array.view()
    view.flags.writeable = False
    return view


def _raised(method: str, error: Exception) -> str:
    """Return in words what a method of a component raised, and where."""
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    if isinstance(error, CosimError):
        return f"{method}: {error}"
    last = traceback.extract_tb(error.__traceback__)[-1]
    text = f"{method} raised {text} ({last.filename}, line {last.lineno})"
    if isinstance(error, ValueError) and "read-only" in str(error):
        text += "; what a component is handed cannot be written to: copy it"
    return text


def result_problem(y: Any, needed: tuple[int, ...]) -> str:
    """Return what is wrong with the outputs of a component; empty: nothing."""
    if type(y) is np.ndarray and y.dtype == FLOAT and y.shape == needed:
        return ""
    return f"returned {_description(y)}; its interface needs a float64 array of shape {needed}"


def _description(value: Any) -> str:
    """Return the type of a value in words, and what counts of an array."""
    if type(value) is not np.ndarray:
        return f"{type(value).__module__}.{type(value).__qualname__}".removeprefix("builtins.")
    text = f"an array of {value.dtype}, shape {value.shape}"
    if value.dtype == FLOAT and not np.isfinite(value).all():
        text = f"{text}, with NaN or infinity"
    return text
