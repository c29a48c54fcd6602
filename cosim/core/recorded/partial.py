"""Partial recordings: of a run only chosen signals, or only every n-th step, were recorded.

A component whose rows are ``period`` communication steps apart keeps the rows at multiples of both
the period and ``every``, that is of their least common multiple, counted from the start of the run.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, final

from cosim.core.signals import Channel, Dependencies, Interface, Layout
from cosim.errors import MOST_NAMES, listing


@dataclass(frozen=True, slots=True)
class RecordSelection:
    """Which signals a run records, and how often.

    Parameters
    ----------
    signals : tuple of str or None
        Names and patterns, as of :func:`cosim.core.recorded.selection.select_signals`; None: all.
    every : int
        Communication steps between rows, at least 1.
    """

    signals: tuple[str, ...] | None = None
    every: int = 1

    def __str__(self) -> str:
        entries = []
        if self.signals is not None:
            names = ", ".join(f'"{signal}"' for signal in self.signals)
            entries.append(f"signals = [{names}]")
        if self.every > 1:
            entries.append(f"every = {self.every}")
        return f"[record] {', '.join(entries)}".rstrip()


@dataclass(frozen=True, slots=True)
class PartialRecord:
    """What a run recorded of what there was.

    Parameters
    ----------
    selection : RecordSelection
    declared : mapping of component name to Channel
        All components of the run, in the order of its rows, with all their signals and their own
        periods.
    """

    selection: RecordSelection
    declared: Mapping[str, Channel]

    def missing(self, recorded: Mapping[str, Channel]) -> dict[str, list[str]]:
        """Return the signals that are not recorded, by component; of all with some."""
        missing = {}
        for name, channel in self.declared.items():
            known = recorded[name].by_name if name in recorded else {}
            names = [signal.name for signal in channel.signals if signal.name not in known]
            if names:
                missing[name] = names
        return missing

    def is_whole(self, name: str, recorded: Mapping[str, Channel]) -> bool:
        """Return whether all signals of a component are recorded, at each of its rows."""
        if name not in recorded:
            return False
        declared = self.declared[name]
        channel = recorded[name]
        return channel.signals == declared.signals and channel.period == declared.period

    def text(self, recorded: Mapping[str, Channel]) -> str:
        """Return what is recorded of what, in words."""
        text = (
            f"{_count(recorded)} of {_count(self.declared)} signals, of {len(recorded)} of "
            f"{len(self.declared)} components"
        )
        every = self.selection.every
        return f"{text}, at every {every} steps" if every > 1 else text

    def reason(self, recorded: Mapping[str, Channel]) -> str:
        """Return why a signal is not recorded, and which are."""
        names = []
        for name, channel in recorded.items():
            names += [f"{name}.{signal.name}" for signal in channel.signals]
        return (
            f"the log is partial (recorded with {self.selection}); available: "
            f"{listing(names, MOST_NAMES)}"
        )

    def overview(self, recorded: Mapping[str, Channel]) -> dict[str, Any]:
        """Return what is recorded of what, as plain values."""
        return {
            "signals": None if self.selection.signals is None else list(self.selection.signals),
            "every": self.selection.every,
            "recorded signals": _count(recorded),
            "of signals": _count(self.declared),
            "recorded components": len(recorded),
            "of components": len(self.declared),
        }


def _count(channels: Mapping[str, Channel]) -> int:
    return sum(len(channel.signals) for channel in channels.values())


@final
class PartialChannels(dict[str, Channel]):
    """The recorded components by name, with what was not recorded of them and others.

    Parameters
    ----------
    channels : mapping of component name to Channel
    partial : PartialRecord
    """

    def __init__(self, channels: Mapping[str, Channel], partial: PartialRecord) -> None:
        super().__init__(channels)
        self.partial = partial


def partial_of(channels: Mapping[str, Channel]) -> PartialRecord | None:
    """Return what recorded components are a part of; None: nothing is missing."""
    return channels.partial if isinstance(channels, PartialChannels) else None


def declared_channels(channels: Mapping[str, Channel]) -> Mapping[str, Channel]:
    """Return all components of the run that some are recorded of, with all their signals."""
    partial = partial_of(channels)
    return channels if partial is None else partial.declared


def is_recorded_whole(channels: Mapping[str, Channel], component: str, *signals: str) -> bool:
    """Return whether signals of a component are recorded, at each of its rows; none named: all."""
    partial = partial_of(channels)
    if partial is None:
        return True
    if not signals:
        return partial.is_whole(component, channels)
    channel = channels.get(component)
    if channel is None or not channel.by_name.keys() >= set(signals):
        return False
    return channel.period == partial.declared[component].period


def partial_layout(
    layout: Layout, signals: Mapping[str, Collection[str]], every: int
) -> tuple[Layout, list[int]]:
    """Return the layout of some signals, and the columns in a row of ``layout`` that it has.

    Parameters
    ----------
    layout : Layout
    signals : mapping of component name to names of signals
        Components that are not there are left out.
    every : int
    """
    channels = []
    columns: list[int] = []
    for channel in layout.channels:
        if channel.name not in signals:
            continue
        names = signals[channel.name]
        interface = reduced_interface(channel.interface, names)
        period = math.lcm(channel.period, every)
        channels.append(Channel(channel.name, interface, len(columns), period))
        for signal in interface.signals:
            own = channel.signal_columns[signal.name]
            columns += range(own.start, own.stop)
    return Layout(tuple(channels)), columns


def reduced_interface(interface: Interface, names: Collection[str]) -> Interface:
    """Return an interface with some of its signals; what is said of the others is left out."""
    inputs = tuple(signal for signal in interface.inputs if signal.name in names)
    outputs = tuple(signal for signal in interface.outputs if signal.name in names)
    if len(inputs) + len(outputs) == len(interface.signals):
        return interface
    return replace(
        interface,
        inputs=inputs,
        outputs=outputs,
        feedthrough=_reduced(interface.feedthrough, names),
        initial=_reduced(interface.initial, names),
        delayed=tuple(name for name in interface.delayed if name in names),
        lagging=tuple(name for name in interface.lagging if name in names),
        jumping=tuple(name for name in interface.jumping if name in names),
        left_limits=tuple(name for name in interface.left_limits if name in names),
        one_value=tuple(name for name in interface.one_value if name in names),
    )


def _reduced(dependencies: Dependencies, names: Collection[str]) -> Dependencies:
    reduced: dict[str, tuple[str, ...] | None] = {}
    for output, inputs in dependencies.items():
        if output in names:
            kept = None if inputs is None else tuple(name for name in inputs if name in names)
            reduced[output] = kept
    return reduced
