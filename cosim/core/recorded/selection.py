"""Signals chosen by name or by pattern: ``plant.y``, ``plant.x_a[0]``, ``plant.*``, ``*.delta``.

``*`` matches any number of characters and ``?`` matches one; all other characters, brackets too,
match themselves. A name that exists is not read as a pattern. An index after a pattern selects that
element of every signal that the rest of the pattern matches.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from cosim.core.port import Port, split_element
from cosim.core.recorded.partial import RecordSelection, partial_of
from cosim.core.recorded.signals import RecordedPort, find_signal, own_columns
from cosim.core.signals import Channel, Signal
from cosim.errors import UnknownSignalError, UsageError, listing, nearest, quoted

_COMMA_OUTSIDE_BRACKETS = re.compile(r",(?![^\[]*\])")
_WILDCARDS = {"*": ".*", "?": "."}


@dataclass(frozen=True, slots=True)
class SelectedColumn:
    """An element of a chosen signal.

    Parameters
    ----------
    name : str
        ``component.signal``, with an index where the signal has several elements.
    component : str
    column : int
        Where it stands in the rows of the component.
    signal : Signal
    unit : str or None
    """

    name: str
    component: str
    column: int
    signal: Signal
    unit: str | None


def split_names(text: str) -> list[str]:
    """Split names with commas between; those in brackets are part of a name."""
    return [part.strip() for part in _COMMA_OUTSIDE_BRACKETS.split(text)]


def is_pattern(text: str) -> bool:
    """Return whether a text has a character that stands for others."""
    return any(character in text for character in _WILDCARDS)


def matches(pattern: str, name: str) -> bool:
    """Return whether a pattern stands for a name, as a whole."""
    return _expression(pattern).fullmatch(name) is not None


def _expression(pattern: str) -> re.Pattern[str]:
    parts = [_WILDCARDS.get(character) or re.escape(character) for character in pattern]
    return re.compile("".join(parts), re.DOTALL)


def select_signals(
    channels: Mapping[str, Channel], patterns: Iterable[str] | str | None, *, source: str
) -> dict[str, RecordedPort]:
    """Return the signals that names and patterns choose, by name; each once, in their order.

    Parameters
    ----------
    channels : mapping of component name to Channel
    patterns : iterable of str, str or None
        None: all signals.
    source : str
        What was recorded to, for messages.

    Raises
    ------
    UsageError
        If a pattern is no text, or there are none.
    UnknownSignalError
        If one of them chooses nothing; names the nearest.
    """
    names = _names(channels)
    if patterns is None:
        return names
    listed = [patterns] if isinstance(patterns, str) else list(patterns)
    chosen: dict[str, RecordedPort] = {}
    for pattern in listed:
        if not isinstance(pattern, str):
            raise UsageError(
                f"signals: expected names such as 'plant.y' or 'plant.*', got {quoted(pattern)}"
            )
        for name, port in _matching(channels, names, pattern, source).items():
            chosen.setdefault(name, port)
    if not chosen:
        raise UsageError("signals: expected at least one, or None for all, got an empty list")
    return chosen


def _names(channels: Mapping[str, Channel]) -> dict[str, RecordedPort]:
    """Return all signals by name."""
    names = {}
    for component, channel in channels.items():
        for signal in channel.signals:
            port = Port(component, signal.name)
            names[str(port)] = RecordedPort(channel, signal, own_columns(channel, signal))
    return names


def _matching(
    channels: Mapping[str, Channel],
    names: Mapping[str, RecordedPort],
    pattern: str,
    source: str,
) -> dict[str, RecordedPort]:
    """Return the signals, or elements, that one name or pattern chooses."""
    if pattern in names:
        return {pattern: names[pattern]}
    if not is_pattern(pattern):
        return {pattern: find_signal(channels, pattern, source=source)}
    whole = _expression(pattern)
    found = {name: port for name, port in names.items() if whole.fullmatch(name)}
    if found:
        return found
    stem, element = split_element(pattern)
    if element is not None:
        suffix = pattern[len(stem) :]
        expression = _expression(stem)
        for name in names:
            if expression.fullmatch(name):
                found[f"{name}{suffix}"] = find_signal(channels, f"{name}{suffix}", source=source)
    if not found:
        partial = partial_of(channels)
        if partial is not None and _matches_any(whole, partial.declared):
            reason = partial.reason(channels)
            raise UnknownSignalError(f"{source}: no recorded signal matches {pattern!r}: {reason}")
        raise UnknownSignalError(
            f"{source}: no signal matches {pattern!r}; {nearest(pattern, names)}"
        )
    return found


def _matches_any(expression: re.Pattern[str], channels: Mapping[str, Channel]) -> bool:
    return any(expression.fullmatch(name) for name in _names(channels))


def selected_columns(selection: Mapping[str, RecordedPort]) -> tuple[SelectedColumn, ...]:
    """Return the elements of chosen signals, each once, in their order.

    Raises
    ------
    UsageError
        If two of them have the same name, as ``x[0]`` and the first of ``x`` would.
    """
    columns: dict[tuple[str, int], SelectedColumn] = {}
    for port in selection.values():
        component = port.channel.name
        first = own_columns(port.channel, port.signal).start
        described = port.described
        for column in range(port.columns.start, port.columns.stop):
            name = f"{component}.{described.element(column - first)}"
            unit = described.measure(column - first).name
            selected = SelectedColumn(name, component, column, described, unit)
            columns.setdefault((component, column), selected)
    counts = Counter(column.name for column in columns.values())
    for name, count in counts.items():
        if count > 1:
            raise UsageError(
                f"{name!r} is ambiguous: it is the name of {count} columns; choose one of the "
                "signals"
            )
    return tuple(columns.values())


def chosen_signals(
    channels: Mapping[str, Channel],
    selection: RecordSelection,
    *,
    beside: Mapping[str, Channel] = MappingProxyType({}),
) -> dict[str, list[str]]:
    """Return the signals of a run that it records, by component.

    Parameters
    ----------
    channels : mapping of component name to Channel
        Of the run.
    selection : RecordSelection
    beside : mapping of component name to Channel
        Components that the run has not, or not all signals of, but may be named: of a replay, those
        of its log.

    Raises
    ------
    UnknownSignalError
        If a pattern chooses nothing; names the nearest.
    UsageError
        If one chooses elements of a signal, or only what the run has not.
    """
    if selection.signals is None:
        return {name: [signal.name for signal in c.signals] for name, c in channels.items()}
    known = {**beside, **channels}
    for name, channel in channels.items():
        if name in beside and beside[name].by_name.keys() > channel.by_name.keys():
            known[name] = beside[name]
    chosen: dict[str, list[str]] = {}
    for name, port in select_signals(known, selection.signals, source="the run").items():
        if port.size != port.signal.size:
            raise UsageError(
                f"expected whole signals, such as '{port.channel.name}.{port.signal.name}', got "
                f"{name!r}, a part of a signal"
            )
        own = channels.get(port.channel.name)
        if own is not None and port.signal.name in own.by_name:
            chosen.setdefault(own.name, []).append(port.signal.name)
    if not chosen:
        raise UsageError(
            f"{selection} matches no signal of this run's components: {listing([*channels])}; use "
            "one of these, or record.signals = ['*'] for all"
        )
    return chosen
