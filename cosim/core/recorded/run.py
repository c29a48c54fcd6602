"""A finished run: what it was made from, its times, tables and windows.

A window reads like a run of its own: it has the same signals, but only the rows, messages and jumps
of a span of time. Its rows are read when they are first used.
"""

from __future__ import annotations

import json
import math
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np

from cosim.arguments import number_argument
from cosim.arrays import Mask, Matrix, Nanoseconds, Vector
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.signals import RecordedSignals, RunMessage, find_channel
from cosim.core.recording import SignalEvent, Substep
from cosim.core.signals import Channel
from cosim.errors import LogError, UsageError, quoted
from cosim.instants import NANOSECONDS, Grid, StepNs, first_nanosecond, last_nanosecond

if TYPE_CHECKING:
    import pandas
    import polars
    import xarray

SCENARIO_FILE: Final = "scenario.toml"

_LATEST: Final = 9e9  # s; every recorded instant is before it


class RecordedRun(RecordedSignals):
    """A finished run: its signals by name, what they rest on, and windows of it."""

    @property
    @abstractmethod
    def metadata(self) -> Mapping[str, Any]:
        """What was recorded beside the signals."""

    @property
    @abstractmethod
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""

    @abstractmethod
    def attachment(self, name: str) -> bytes:
        """Return the content of an attachment."""

    @property
    @abstractmethod
    def held(self) -> Mapping[str, Mask]:
        """Which input elements of every component had a zero-order hold."""

    @property
    @abstractmethod
    def step_ns(self) -> StepNs:
        """Communication step [ns]."""

    @property
    def grid(self) -> Grid:
        """The communication points: number 0 is that at which the run began."""
        return Grid(Grid(self.end_ns, self.step_ns).stamp(-self.steps), self.step_ns)

    @abstractmethod
    def events(self) -> list[SignalEvent]:
        """Return the jumps of signals, in the order of time."""

    @abstractmethod
    def substeps(self) -> list[Substep]:
        """Return the substeps of loops, in the order of where they begin."""

    def blocks(
        self, component: str, *, first_ns: int | None = None, last_ns: int | None = None
    ) -> Iterator[tuple[Nanoseconds, Matrix]]:
        """Yield times and rows of a component in order of time, some at a time.

        With bounds [ns], both included, only the rows between them.

        Raises
        ------
        UnknownSignalError
            If there is no such component; names the nearest.
        """
        whole = self.time_ns(component), self.rows(component)
        yield from blocks_within(iter([whole]), first_ns, last_ns)

    def blocks_of(
        self,
        components: Sequence[str],
        *,
        first_ns: int | None = None,
        last_ns: int | None = None,
    ) -> Iterator[tuple[str, Nanoseconds, Matrix]]:
        """Yield names, times and rows of components as they come, each in order of time.

        Raises
        ------
        UnknownSignalError
            If there is no such component; names the nearest.
        """
        for name in components:
            for times, rows in self.blocks(name, first_ns=first_ns, last_ns=last_ns):
                yield name, times, rows

    def load(self, *components: str) -> None:
        """Read several components at once, where they are not in memory yet."""

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

    def _repr_html_(self) -> str:
        """Return a table of the signals; of a run of a scenario, what the tables after it show."""
        page = super()._repr_html_()
        if "scenario" in self.metadata.get("cosim.run", {}):
            page += import_module("cosim.report.tables.run").html_summary(self)
        return page

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
        from cosim.core.recorded.frames import to_pandas  # few need it

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
        from cosim.core.recorded.frames import to_polars  # few need it

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
        from cosim.core.recorded.frames import to_xarray  # few need it

        return to_xarray(self, signals)


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
    t0: float | None, t1: float | None, names: tuple[str, str] = ("t0", "t1")
) -> tuple[int | None, int | None]:
    """Return the first and the last nanosecond in ``t0 <= t <= t1``; None stays None.

    Parameters
    ----------
    t0, t1 : float or None
        [s].
    names : tuple of str
        What they are called in messages.

    Raises
    ------
    UsageError
        If one is no finite number, or t1 is before t0.
    """
    for name, value in zip(names, (t0, t1), strict=True):
        if value is not None and not math.isfinite(number_argument(name, value)):
            raise UsageError(f"{name}: expected a finite number of seconds, got {value!r}")
    if t0 is not None and t1 is not None and t1 < t0:
        raise UsageError(
            f"expected {names[0]} <= {names[1]}, got {names[0]} = {t0} s and {names[1]} = {t1} s"
        )
    first_ns = None if t0 is None else first_nanosecond(_within_range(t0))
    last_ns = None if t1 is None else last_nanosecond(_within_range(t1))
    return first_ns, last_ns


def _within_range(t: float) -> float:
    """Return a time that fits into 64 bits of nanoseconds, on the same side of all rows."""
    return min(max(float(t), -_LATEST), _LATEST)


def blocks_within(
    blocks: Iterator[tuple[Nanoseconds, Matrix]], first_ns: int | None, last_ns: int | None
) -> Iterator[tuple[Nanoseconds, Matrix]]:
    """Yield the rows of blocks in ``first_ns <= time <= last_ns``; None: without that bound.

    There is a block at least, which may have no rows; none is read after the last row.
    """
    for time_ns, rows in blocks:
        begin = 0 if first_ns is None else int(np.searchsorted(time_ns, first_ns))
        end = len(time_ns)
        if last_ns is not None:
            end = int(np.searchsorted(time_ns, last_ns, side="right"))
        yield time_ns[begin:end], rows[begin:end]
        if end < len(time_ns):
            return


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
        self._rows: dict[str, tuple[Nanoseconds, Matrix]] = {}

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

    def rows(self, component: str) -> Matrix:
        """Return the rows of a component here: applied inputs, then outputs; shape (N, width)."""
        return self._times_and_rows(component)[1]

    def time_ns(self, component: str) -> Nanoseconds:
        """Return the instants of a component's rows here, shape (N,) [ns]."""
        return self._times_and_rows(component)[0]

    def _times_and_rows(self, component: str) -> tuple[Nanoseconds, Matrix]:
        find_channel(self.channels, component, source=self.label)
        if component not in self._rows:
            blocks = list(self.blocks(component))
            time_ns, rows = blocks[0]
            if len(blocks) > 1:
                time_ns = np.concatenate([times for times, _ in blocks])
                rows = np.concatenate([part for _, part in blocks])
            time_ns.flags.writeable = False
            rows.flags.writeable = False
            self._rows[component] = time_ns, rows
        return self._rows[component]

    def blocks(
        self, component: str, *, first_ns: int | None = None, last_ns: int | None = None
    ) -> Iterator[tuple[Nanoseconds, Matrix]]:
        """Yield times and rows of a component here, in order of time, some at a time."""
        first, last = self._bounds(first_ns, last_ns)
        return self._run.blocks(component, first_ns=first, last_ns=last)

    def blocks_of(
        self,
        components: Sequence[str],
        *,
        first_ns: int | None = None,
        last_ns: int | None = None,
    ) -> Iterator[tuple[str, Nanoseconds, Matrix]]:
        """Yield names, times and rows of components here as they come, each in order of time."""
        first, last = self._bounds(first_ns, last_ns)
        return self._run.blocks_of(components, first_ns=first, last_ns=last)

    def _bounds(self, first_ns: int | None, last_ns: int | None) -> tuple[int | None, int | None]:
        """Return the narrower ones of the bounds here and of others."""
        firsts = [bound for bound in (self._first_ns, first_ns) if bound is not None]
        lasts = [bound for bound in (self._last_ns, last_ns) if bound is not None]
        return max(firsts, default=None), min(lasts, default=None)

    def load(self, *components: str) -> None:
        """Read the rows of several components here; none named: all."""
        for name in components or tuple(self.channels):
            self._times_and_rows(name)

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
