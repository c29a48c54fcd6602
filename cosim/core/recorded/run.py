"""A finished run, wherever it lies: its signals by name and time, what they rest on, windows of it.

A window reads like a run of its own: it has the same signals, but only the rows, messages and jumps
of a span of time. Its rows are read when they are first used.
"""

from __future__ import annotations

import json
import math
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from decimal import Decimal
from functools import cached_property
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np
from numpy.typing import NDArray

from cosim.arguments import number_argument
from cosim.arrays import Mask, Matrix, Nanoseconds, Vector, as_columns, is_absent, read_only
from cosim.core.port import Port
from cosim.core.recorded.joined_rows import to_pandas, to_polars, to_xarray
from cosim.core.recorded.partial import PartialRecord, declared_channels, partial_of
from cosim.core.recorded.signals import (
    WARNINGS,
    DistinctWarnings,
    RecordedPort,
    RunMessage,
    find_channel,
    find_signal,
    html_table,
)
from cosim.core.recording import (
    MessageLevel,
    Recording,
    SignalEvent,
    SignalNames,
    Substep,
    TimedRows,
    joined,
)
from cosim.core.signals import Channel, Signal
from cosim.errors import LogError, UnknownSignalError, UsageError, quoted
from cosim.instants import (
    NANOSECONDS,
    Grid,
    Seconds,
    StepNs,
    first_nanosecond,
    last_nanosecond,
)

if TYPE_CHECKING:
    import pandas
    import polars
    import xarray

SCENARIO_FILE: Final = "scenario.toml"

_LATEST: Final = 9e9  # s; every recorded instant is before it


class RecordedRun(Mapping[str, NDArray[np.float64]], Recording):
    """The signals of a finished run by name, ``component.signal``; arrays are read-only.

    Iteration, length, ``keys``, ``values`` and ``items`` are of whole signals; elements of one, or
    several side by side, can be asked for too: ``run["plant.x_a[1]"]``, ``run[["u.y", "y.y"]]``.

    A class of runs has ``_timed_rows``, or, where rows are read in parts, ``blocks_of``.
    """

    # --- signals by name ---

    def __getitem__(self, signal: SignalNames) -> NDArray[np.float64]:
        """Return a signal at every recorded row: shape (N,) for one element, else (N, size).

        Several signals of the same instants are stacked: shape (N, sum of their sizes).

        Raises
        ------
        UnknownSignalError
            If there is no such component, signal or element; names the nearest.
        """
        if not isinstance(signal, str | Port):
            return self._stacked(signal)
        port = find_signal(self.channels, signal, source=self.label)
        values = self.columns(port.channel.name, port.columns)
        is_there = self._is_there(port)
        if is_there is not None:
            values = read_only(values[is_there])
        return values[:, 0] if port.size == 1 else values

    def _is_there(self, port: RecordedPort) -> Mask | None:
        """Return which rows of its component a signal has, too; None: all."""
        if not port.signal.optional:
            return None
        is_empty: Mask = np.all(is_absent(self.columns(port.channel.name, port.columns)), axis=1)
        return ~is_empty if is_empty.any() else None

    def _stacked(self, signals: Sequence[str | Port]) -> Matrix:
        """Return several signals of the same instants side by side.

        Raises
        ------
        LogError
            If there is none, if one is unknown, or if they have different instants.
        """
        is_list = isinstance(signals, Sequence) and len(signals) > 0
        if not is_list or not all(isinstance(signal, str | Port) for signal in signals):
            raise LogError(
                f"{self.label}: expected a signal name, or a list of names, got {signals!r}"
            )
        ports = [find_signal(self.channels, signal, source=self.label) for signal in signals]
        times, *others = map(self._times_of, ports)
        for signal, other_times in zip(signals[1:], others, strict=True):
            if not np.array_equal(times, other_times):
                raise LogError(
                    f"{self.label}: expected signals with the same instants, got '{signals[0]}' "
                    f"with {len(times)} rows and '{signal}' with {len(other_times)}; read each "
                    "with its own time()"
                )
        return read_only(np.hstack([as_columns(self[signal]) for signal in signals]))

    def __iter__(self) -> Iterator[str]:
        return iter(self.signals)

    def __len__(self) -> int:
        return sum(len(channel.signals) for channel in self.channels.values())

    def __contains__(self, signal: object) -> bool:
        if not isinstance(signal, str | Port):
            return False
        try:
            find_signal(self.channels, signal, source=self.label)
        except UnknownSignalError:
            return False
        return True

    # as for arrays, equality of all values is asked for by name: cosim.diff
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    @property
    def signals(self) -> Mapping[str, Signal]:
        """What is known of every signal, by its name ``component.signal``: size, unit, role, ..."""
        declared = {}
        for component, channel in self.channels.items():
            for signal in channel.signals:
                declared[f"{component}.{signal.name}"] = channel.described(signal.name)
        return MappingProxyType(declared)

    # --- rows of components ---

    @abstractmethod
    def _timed_rows(self, channel: Channel) -> TimedRows:
        """Return the instants of a component's rows [ns], and the rows; both read-only."""

    def rows(self, component: str) -> Matrix:
        """Return all rows of a component: applied inputs, then outputs; shape (N, width).

        They are read-only.

        Raises
        ------
        UnknownSignalError
            If there is no such component; names the nearest.
        LogError
            If a file is damaged.
        """
        return self._timed_rows(find_channel(self.channels, component, source=self.label))[1]

    def columns(self, component: str, columns: slice) -> Matrix:
        """Return some columns of :meth:`rows`."""
        return self.rows(component)[:, columns]

    def _instants(self, channel: Channel) -> Nanoseconds:
        """Return the instants of a component's rows [ns], read-only."""
        return self._timed_rows(channel)[0]

    def time_ns(self, component: str) -> Nanoseconds:
        """Return the instants of a component's or signal's rows, shape (N,) [ns]; read-only.

        Raises
        ------
        UnknownSignalError
            If there is no such component, signal or element; names the nearest.
        LogError
            If a file is damaged.
        """
        if isinstance(component, str) and component not in self.channels and "." in component:
            return self._times_of(find_signal(self.channels, component, source=self.label))
        return self._instants(find_channel(self.channels, component, source=self.label))

    def _times_of(self, port: RecordedPort) -> Nanoseconds:
        times = self._instants(port.channel)
        is_there = self._is_there(port)
        return times if is_there is None else read_only(times[is_there])

    def time(self, name: str) -> Vector:
        """Return the instants of a signal's or component's rows, shape (N,) [s].

        Raises
        ------
        UnknownSignalError
            If there is no such component, signal or element; names the nearest.
        """
        return self.time_ns(name) / 1e9

    @property
    def t(self) -> Vector:
        """Instants of the rows of the fastest component, shape (N,) [s].

        Of components that have rows at every communication point these are the points; of slower
        ones, :meth:`time` returns the instants of each.
        """
        if not self.channels:  # in memory, before the run has begun
            return np.empty(0)
        fastest = min(self.channels.values(), key=lambda channel: channel.period)
        return self.time(fastest.name)

    def blocks(
        self, component: str, *, first_ns: int | None = None, last_ns: int | None = None
    ) -> Iterator[TimedRows]:
        """Yield times and rows of a component in order of time; of a long log some at a time.

        Nothing is kept: the memory that this takes does not grow with a log.

        Parameters
        ----------
        component : str
        first_ns, last_ns : int, optional
            Only rows in ``first_ns <= time <= last_ns`` [ns].

        Raises
        ------
        UnknownSignalError
            If there is no such component; names the nearest.
        LogError
            If a file is damaged.
        """
        for _, times, rows in self.blocks_of([component], first_ns=first_ns, last_ns=last_ns):
            yield times, rows

    def blocks_of(
        self,
        components: Sequence[str],
        *,
        first_ns: int | None = None,
        last_ns: int | None = None,
    ) -> Iterator[tuple[str, Nanoseconds, Matrix]]:
        """Yield names, times and rows of components as they come, each in order of time.

        Of each there is a block at least, which may have no rows.

        Raises
        ------
        UnknownSignalError
            If there is no such component; names the nearest.
        LogError
            If a file is damaged.
        """
        for name in components:
            channel = find_channel(self.channels, name, source=self.label)
            yield name, *rows_within(*self._timed_rows(channel), first_ns, last_ns)

    def load(self, *components: str) -> None:
        """Read several components at once, where they are not in memory yet."""

    # --- what the run was, and how it ended ---

    @property
    def partial(self) -> PartialRecord | None:
        """What was recorded of what the run computed; None: all signals at all of their steps.

        Rows of a span of time may be missing all the same: that says ``status``.
        """
        return partial_of(self.channels)

    @property
    def left_out(self) -> Mapping[str, str] | None:
        """What cannot be read of a file of another tool, and why; None: it is a run of cosim."""
        return None

    @property
    def grid(self) -> Grid:
        """The communication points: number 0 is that at which the run began."""
        return Grid(Grid(self.end_ns, self.step_ns).stamp(-self.steps), self.step_ns)

    @property
    def reason(self) -> str:
        """The stop reason; empty where the run came to its end."""
        return ""

    @property
    def results(self) -> Mapping[str, Any]:
        """What was recorded of the end of the run."""
        return {}

    @property
    def metadata(self) -> Mapping[str, Any]:
        """What was recorded beside the signals."""
        return {}

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        return ()

    @abstractmethod
    def attachment(self, name: str) -> bytes:
        """Return the content of an attachment."""

    def messages(self) -> list[RunMessage]:
        """Return the messages of the run and its components, in the order of time."""
        return []

    def events(self) -> list[SignalEvent]:
        """Return the jumps of signals, in the order of time."""
        return []

    def substeps(self) -> list[Substep]:
        """Return the substeps of loops, in the order of where they begin."""
        return []

    @property
    def warnings(self) -> list[RunMessage]:
        """What the run warned of, in the order of time: each text of a component once.

        >>> import cosim
        >>> for warning in cosim.run("pair").warnings:
        ...     print(warning.time_ns, warning.source, warning.text)

        They are messages of level ``warning``, and of components also ``error``; at most 1000,
        :meth:`messages` has all of them.

        Raises
        ------
        LogError
            If they cannot be read.
        """
        entries = self.results.get(WARNINGS)
        if entries is None:  # the run has not come to its end, or an earlier version recorded it
            return list(DistinctWarnings(self.messages()))
        try:
            return [_read_warning(*entry) for entry in entries]
        except TypeError as error:
            raise LogError(
                f"{self.label}: {WARNINGS} of the results cannot be read: expected a list of "
                f"[time_ns, level, source, text], got {quoted(entries)}"
            ) from error

    @property
    def parameters(self) -> Mapping[str, Mapping[str, Any]]:
        """The parameters of every component, as the scenario gave them at the start of the run.

        What it left out is not in them; a component without a scenario has none. Those of a
        component that is not recorded are there, too.

        Raises
        ------
        LogError
            If they are no JSON object.
        """
        parameters: dict[str, Mapping[str, Any]] = {}
        for name in declared_channels(self.channels):
            items = self.metadata.get(f"cosim.component.{name}", {})
            table = _read_table(f"{self.label}: parameters of {name!r}", items.get("table", "{}"))
            table.pop("kind", None)  # it says what the parameters are of
            parameters[name] = MappingProxyType(table)
        return MappingProxyType(parameters)

    @property
    def scenario(self) -> str:
        """The text of the scenario that the run was of.

        Raises
        ------
        LogError
            If the run was of none, or the text is damaged.
        """
        try:
            return self.attachment(SCENARIO_FILE).decode()
        except UnicodeDecodeError as error:
            raise LogError(f"{self.label}: {SCENARIO_FILE} cannot be read: {error}") from error

    def summary(self) -> Any:
        """Return the report of the run: a :class:`cosim.report.summary.Summary`.

        Its attributes are errors against the truth, verdicts on estimates, final values, what ended
        the run, warnings; ``to_dict()`` has what ``cosim run --json`` prints of them.

        >>> import cosim
        >>> summary = cosim.run("academic").summary()
        >>> [parameter.verdict for parameter in summary.identifications[0].parameters]
        ['IDENTIFIABLE']

        Raises
        ------
        LogError
            If the run was of no scenario, or what it recorded cannot be understood.
        """
        # of a layer above this one, which knows scenarios
        return import_module("cosim.report.summary").summarize(self)

    def window(self, t0: float | None = None, t1: float | None = None) -> RecordedWindow:
        """Return the part of the run in ``t0 <= t <= t1``; rows are read when asked for.

        Parameters
        ----------
        t0, t1 : float, optional
            [s]. None: from the first row on, up to the last one.

        Raises
        ------
        UsageError
            If one is no finite number, or t1 is before t0.
        """
        return RecordedWindow(self, *span_ns(t0, t1))

    def to_pandas(self, signals: Iterable[str] | str | None = None) -> pandas.DataFrame:
        """Return signals as a frame of pandas: a column an element, the index is the time [s].

        Of components with several rates it has a row at every instant at which one of them has
        one, and NaN where another has none there; of signals of one rate it has their rows.

        Parameters
        ----------
        signals : iterable of str, or str, optional
            Names and patterns, such as ``plant.*``; None: all.

        Raises
        ------
        UsageError
            If there is no pandas.
        LogError
            If a signal is unknown, or the file is damaged.
        """
        return to_pandas(self, signals)

    def to_polars(self, signals: Iterable[str] | str | None = None) -> polars.DataFrame:
        """Return signals as a frame of polars: a column an element, after the time ``t`` [s].

        As :meth:`to_pandas`, but null where a component has no row.

        Raises
        ------
        UsageError
            If there is no polars.
        LogError
            If a signal is unknown, or the file is damaged.
        """
        return to_polars(self, signals)

    def to_xarray(self, signals: Iterable[str] | str | None = None) -> xarray.Dataset:
        """Return signals as variables over the time ``t`` [s], with units as attributes.

        Signals of several elements have a second dimension; rows as in :meth:`to_pandas`.

        Raises
        ------
        UsageError
            If there is no xarray.
        LogError
            If a signal is unknown, or the file is damaged.
        """
        return to_xarray(self, signals)

    def __repr__(self) -> str:
        return f"<{self.label}: {self._overview()}>"

    def _repr_html_(self) -> str:
        """Return tables for notebooks: the signals; of a scenario's run, what is shown after it."""
        names = ("signal", "size", "unit", "role", "variability", "description")
        rows = []
        for name, signal in self.signals.items():
            about = (signal.unit_text, signal.role, signal.variability, signal.description)
            rows.append((name, str(signal.size), *about))
        page = html_table(f"{self.label}: {self._overview()}", names, rows)
        if "scenario" in self.metadata.get("cosim.run", {}):
            page += import_module("cosim.report.tables.run").html_summary(self)
        return page

    def _overview(self) -> str:
        end = self.end_ns / 1e9
        overview = f"{self.status}, {self.steps} steps to {end:g} s"
        try:
            count = len(self.warnings)
            warned = f", {count} warning{'' if count == 1 else 's'}" if count else ""
        except LogError:  # a debugger shows the run all the same
            warned = ", warnings that cannot be read"
        partial = self.partial
        if partial is not None:
            return f"{overview}, partial: {partial.text(self.channels)}{warned}"
        return f"{overview}, {len(self)} signals of {len(self.channels)} components{warned}"


def _read_warning(time_ns: int, level: MessageLevel, source: str, text: str) -> RunMessage:
    """Return a warning as it was recorded; raise TypeError if it is none."""
    if not isinstance(time_ns, int) or not all(isinstance(t, str) for t in (level, source, text)):
        raise TypeError
    return RunMessage(time_ns, level, source, text)


def _read_table(label: str, text: str) -> dict[str, Any]:
    """Read a JSON object.

    Raises
    ------
    LogError
        If it is none.
    """
    try:
        table = json.loads(text)
    except (ValueError, TypeError, RecursionError):
        table = None
    if not isinstance(table, dict):
        raise LogError(f"{label} cannot be read: expected a JSON object, got {quoted(text)}")
    return table


def span_ns(
    t0: Seconds | None, t1: Seconds | None, names: tuple[str, str] = ("t0", "t1")
) -> tuple[int | None, int | None]:
    """Return the first and the last nanosecond in ``t0 <= t <= t1``; None stays None.

    Parameters
    ----------
    t0, t1 : float, Decimal or None
        [s].
    names : tuple of str
        What they are called in messages.

    Raises
    ------
    UsageError
        If one is no finite number, or t1 is before t0.
    """
    for name, value in zip(names, (t0, t1), strict=True):
        if value is None:
            continue
        number = float(value) if isinstance(value, Decimal) else number_argument(name, value)
        if not math.isfinite(number):
            raise UsageError(f"{name}: expected a finite number of seconds, got {number!r}")
    if t0 is not None and t1 is not None and t1 < t0:
        found = [f"{name} = {_seconds_text(t)} s" for name, t in zip(names, (t0, t1), strict=True)]
        raise UsageError(f"expected {names[0]} <= {names[1]}, got {' and '.join(found)}")
    first_ns = None if t0 is None else first_nanosecond(_within_range(t0))
    last_ns = None if t1 is None else last_nanosecond(_within_range(t1))
    return first_ns, last_ns


def _seconds_text(t: Seconds) -> str:
    """Return a time as the double is written, if that is what it is."""
    text = f"{float(t)}"
    return text if Decimal(text) == t else f"{t}"


def _within_range(t: Seconds) -> Seconds:
    """Return a time that fits into 64 bits of nanoseconds, on the same side of all rows."""
    return min(max(t if isinstance(t, Decimal) else float(t), -_LATEST), _LATEST)


def rows_within(
    time_ns: Nanoseconds, rows: Matrix, first_ns: int | None, last_ns: int | None
) -> TimedRows:
    """Return the rows in ``first_ns <= time <= last_ns``; None: without that bound."""
    begin = 0 if first_ns is None else int(np.searchsorted(time_ns, first_ns))
    end = len(time_ns) if last_ns is None else int(np.searchsorted(time_ns, last_ns, side="right"))
    return time_ns[begin:end], rows[begin:end]


@final
class RecordedWindow(RecordedRun):
    """The part of a run in some time; see :meth:`RecordedRun.window`.

    Its methods raise what those of the run raise.

    Parameters
    ----------
    run : RecordedRun
    first_ns, last_ns : int or None
        Of the rows [ns], both included; None: without that bound.
    """

    def __init__(self, run: RecordedRun, first_ns: int | None, last_ns: int | None) -> None:
        self._run = run
        self._first_ns = first_ns
        self._last_ns = last_ns
        self._rows: dict[str, TimedRows] = {}

    @property
    def label(self) -> str:
        """What was recorded to, and which part of it this is."""
        bounds = ""
        if self._first_ns is not None:
            bounds += f" from {self._first_ns / NANOSECONDS:g} s"
        if self._last_ns is not None:
            bounds += f" to {self._last_ns / NANOSECONDS:g} s"
        return f"{self._run.label}{bounds}"

    @property
    def channels(self) -> Mapping[str, Channel]:
        """The recorded components by name, in the order of the row."""
        return self._run.channels

    @property
    def left_out(self) -> Mapping[str, str] | None:
        """What cannot be read of a file of another tool; None: it is a run of cosim."""
        return self._run.left_out

    @property
    def metadata(self) -> Mapping[str, Any]:
        """What was recorded beside the signals, of the whole run."""
        return self._run.metadata

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        return self._run.attachments

    def attachment(self, name: str) -> bytes:
        """Return the content of an attachment."""
        return self._run.attachment(name)

    @property
    def held(self) -> Mapping[str, Mask]:
        """Which input elements of every component had a zero-order hold."""
        return self._run.held

    @property
    def step_ns(self) -> StepNs:
        """Communication step [ns]."""
        return self._run.step_ns

    @property
    def status(self) -> str:
        """How the whole run ended."""
        return self._run.status

    @property
    def reason(self) -> str:
        """The stop reason of the whole run; empty where it came to its end."""
        return self._run.reason

    @property
    def results(self) -> Mapping[str, Any]:
        """What was recorded of the end of the whole run."""
        return self._run.results

    @cached_property
    def _steps_left_out(self) -> int:
        """Number of communication steps between the last point here and that of the run."""
        if self._last_ns is None:
            return 0
        last = Grid(self._run.end_ns, self.step_ns).number(self._last_ns)
        return min(max(-last, 0), self._run.steps)

    @property
    def steps(self) -> int:
        """Number of the last communication step here, counted from the start of the run."""
        return self._run.steps - self._steps_left_out

    @property
    def end_ns(self) -> int:
        """The last communication point here [ns]."""
        return Grid(self._run.end_ns, self.step_ns).stamp(-self._steps_left_out)

    def _timed_rows(self, channel: Channel) -> TimedRows:
        if channel.name not in self._rows:
            time_ns, rows = joined(self.blocks(channel.name))
            self._rows[channel.name] = read_only(time_ns), read_only(rows)
        return self._rows[channel.name]

    def blocks_of(
        self,
        components: Sequence[str],
        *,
        first_ns: int | None = None,
        last_ns: int | None = None,
    ) -> Iterator[tuple[str, Nanoseconds, Matrix]]:
        """Yield names, times and rows of components here as they come, each in order of time."""
        firsts = [bound for bound in (self._first_ns, first_ns) if bound is not None]
        lasts = [bound for bound in (self._last_ns, last_ns) if bound is not None]
        return self._run.blocks_of(
            components, first_ns=max(firsts, default=None), last_ns=min(lasts, default=None)
        )

    def load(self, *components: str) -> None:
        """Read the rows of several components here; none named: all."""
        for name in components or tuple(self.channels):
            self.rows(name)

    def messages(self) -> list[RunMessage]:
        """Return the messages here, in the order of time."""
        return [message for message in self._run.messages() if self._has(message.time_ns)]

    def events(self) -> list[SignalEvent]:
        """Return the jumps of signals here, in the order of time."""
        return [event for event in self._run.events() if self._has(event.time_ns)]

    def substeps(self) -> list[Substep]:
        """Return the substeps that begin here, in the order of where they begin."""
        return [substep for substep in self._run.substeps() if self._has(substep.begin_ns)]

    def _overview(self) -> str:
        """Return what the whole run is, and whether there is nothing of it here."""
        rows = "" if self._has(self.end_ns) else "no rows "
        return f"{rows}of a run: {self._run._overview()}"

    def _has(self, time_ns: int) -> bool:
        is_late = self._first_ns is None or time_ns >= self._first_ns
        return is_late and (self._last_ns is None or time_ns <= self._last_ns)
