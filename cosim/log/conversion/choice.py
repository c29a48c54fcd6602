"""The signals and the span of time that are chosen from a log."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from cosim.core.recorded.joined_rows import JoinedRows, joined_rows
from cosim.core.recorded.run import RecordedRun, RecordedWindow, span_ns
from cosim.core.recorded.selection import (
    SelectedColumn,
    select_signals,
    selected_columns,
    split_names,
)
from cosim.core.recorded.signals import RecordedPort
from cosim.core.signals import Signal


@dataclass(frozen=True, slots=True)
class LogChoice:
    """Some signals of a run, or of a window of it.

    Parameters
    ----------
    run : RecordedRun
    selection : mapping of name to RecordedPort
    """

    run: RecordedRun
    selection: Mapping[str, RecordedPort]

    @staticmethod
    def of(run: RecordedRun, signals: Iterable[str] | str | None = None) -> LogChoice:
        """Choose signals of a run by names and patterns; None: all.

        Raises
        ------
        LogError
            If one of them chooses nothing.
        """
        return LogChoice(run, select_signals(run.channels, signals, source=run.label))

    @property
    def columns(self) -> tuple[SelectedColumn, ...]:
        """The elements of the signals, each once."""
        return selected_columns(self.selection)

    def joined(self) -> Iterator[JoinedRows]:
        """Yield the signals joined on time, some rows at a time."""
        return joined_rows(self.run, self.columns)


def signal_metadata(signal: Signal, unit: str | None) -> dict[str, str]:
    """Return what a signal, or an element in a unit, is, as far as that is declared."""
    metadata = {"unit": unit or "", "description": signal.description}
    metadata |= {"role": signal.role, "variability": signal.variability, "type": signal.type}
    return {key: text for key, text in metadata.items() if text}


def choose(
    run: RecordedRun, names: Iterable[str] | None, start: float | None, stop: float | None
) -> LogChoice:
    """Choose of a run what options of the command line say.

    Parameters
    ----------
    run : RecordedRun
    names : iterable of str, or None
        Names and patterns, several with commas between; None: all.
    start, stop : float or None
        First and last time [s].

    Raises
    ------
    UsageError
        If ``start`` is after ``stop``.
    LogError
        If a signal is unknown.
    """
    span = span_ns(start, stop, names=("--from", "--to"))
    part = run if span == (None, None) else RecordedWindow(run, *span)
    return LogChoice.of(part, None if names is None else split_names(",".join(names)))
