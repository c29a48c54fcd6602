"""A recorder for a part of what a run computes; the run itself stays the same, to the last bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix
from cosim.core.contracts import Block
from cosim.core.passing_recorders import PassingRecorder
from cosim.core.recorded.partial import PartialRecord, RecordSelection, partial_layout
from cosim.core.recorded.selection import select_signals
from cosim.core.recorders import follow
from cosim.core.recording import Plan, Recorder, RowsUnderWay
from cosim.core.signals import Channel
from cosim.errors import UsageError, listing

_LAST: Final = "last"  # the values of all signals at the end, by the names of their elements
_NONE: Final[Mapping[str, Channel]] = {}


def chosen_signals(
    channels: Mapping[str, Channel],
    selection: RecordSelection,
    *,
    beside: Mapping[str, Channel] = _NONE,
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


@final
class PartialRecorder(PassingRecorder):
    """Passes on the chosen signals.

    Parameters
    ----------
    recorder : Recorder
    selection : RecordSelection
    beside : mapping of component name to Channel
        As of :func:`chosen_signals`.
    """

    def __init__(
        self,
        recorder: Recorder,
        selection: RecordSelection,
        *,
        beside: Mapping[str, Channel] = _NONE,
    ) -> None:
        super().__init__(recorder)
        self._selection = selection
        self._beside = beside
        self._columns: slice | NDArray[np.intp] = slice(None)
        self._labels: frozenset[str] | None = None

    def begin(self, plan: Plan) -> None:
        """Pass on the plan of what is chosen."""
        declared = plan.channels
        signals = chosen_signals(declared, self._selection, beside=self._beside)
        layout, columns = partial_layout(plan.layout, signals, self._selection.every)
        partial = PartialRecord(self._selection, declared)
        chosen = {channel.name: channel for channel in layout.channels}
        if all(partial.is_whole(name, chosen) for name in declared):
            self._recorder.begin(plan)
            return
        is_start = columns == list(range(len(columns)))
        self._columns = slice(len(columns)) if is_start else np.array(columns, np.intp)
        self._labels = frozenset(_labels(layout.channels))
        self._recorder.begin(replace(plan, layout=layout, partial=partial))

    def follow(self, rows: RowsUnderWay) -> None:
        """Pass on the columns that are chosen."""

        def chosen() -> tuple[Block, Matrix] | None:
            found = rows()
            return None if found is None else (found[0], found[1][:, self._columns])

        follow(self._recorder, chosen)

    def write(self, block: Block, signals: Matrix) -> None:
        """Pass on the columns that are chosen; the recorder picks the rows by their periods."""
        self._recorder.write(block, signals[:, self._columns])

    def result(self, values: Mapping[str, Any]) -> None:
        """Pass on; of the last row the elements that are chosen."""
        last = values.get(_LAST)
        if self._labels is not None and isinstance(last, Mapping):
            kept = {label: value for label, value in last.items() if label in self._labels}
            values = {**values, _LAST: kept}
        self._recorder.result(values)


def _labels(channels: Sequence[Channel]) -> list[str]:
    """Return the names of all elements, ``component.signal[0]``."""
    labels = []
    for channel in channels:
        for signal in channel.signals:
            labels += [f"{channel.name}.{element}" for element in signal.elements]
    return labels
