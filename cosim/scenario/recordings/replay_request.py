"""What is asked of the replay of a recording: what is computed and changed, and what is recorded.

With a window all is computed from the start, and only that part of the time is recorded. Components
have states, which a log has not: what happens in a window follows from all that was before it. So
its rows are those of the whole replay, bit for bit, and nothing after it is computed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.arguments import (
    mapping_argument,
    swap_argument,
    texts_argument,
    truth_argument,
    whole_argument,
)
from cosim.core.clock import whole_steps
from cosim.core.recorded.run import RecordedRun
from cosim.core.recorders import Slice
from cosim.core.recording import (
    Recorder,
)
from cosim.core.signals import Channel
from cosim.errors import UsageError, option, quoted
from cosim.instants import Grid, step_value
from cosim.scenario.document.swaps import PortNames

if TYPE_CHECKING:
    from cosim.scenario.kinds.base import Scenario


@dataclass(kw_only=True, slots=True)
class ReplayRequest:
    """What is asked of a replay.

    Parameters
    ----------
    set, swap, map, allow_code, rerun, window, components, scenario, block
        As of :func:`cosim.replay`.

    Attributes
    ----------
    changes : mapping of dotted key to value
    swaps : mapping of component name to path
    maps : mapping of port to names

    Raises
    ------
    UsageError
        If one of them is of another type, or does not go with the others.
    """

    set: Mapping[str, Any] | None = None
    swap: Mapping[str, str | Path] | None = None
    map: Mapping[str, PortNames] | None = None
    allow_code: bool = False
    rerun: bool = False
    window: tuple[float | None, float | None] | None = None
    components: Sequence[str] | None = None
    scenario: str | Path | Scenario | None = None
    block: int | None = None
    changes: Mapping[str, Any] = field(init=False)
    swaps: Mapping[str, str | Path] = field(init=False)
    maps: Mapping[str, PortNames] = field(init=False)

    def __post_init__(self) -> None:
        self.changes = mapping_argument("set", self.set)
        self.swaps = swap_argument(self.swap)
        self.maps = mapping_argument("map", self.map)
        self.allow_code = truth_argument("allow_code", self.allow_code)
        self.rerun = truth_argument("rerun", self.rerun)
        self.components = texts_argument("components", self.components)
        self.block = whole_argument("block", self.block)
        if self.components == ():
            raise UsageError(
                f"{option('components')}: expected at least one component to compute, or None for "
                "all; got none"
            )

    @property
    def is_as_recorded(self) -> bool:
        """Whether nothing is changed or swapped."""
        return not (self.changes or self.swaps)


@dataclass(frozen=True, slots=True)
class ReplayWindow:
    """The part of a replay that is recorded, from one communication point to another.

    Parameters
    ----------
    begin_ns, end_ns : int
        Both included [ns].
    index : int
        Number of the communication point where it begins.
    """

    begin_ns: int
    end_ns: int
    index: int

    @property
    def ends(self) -> tuple[float, float]:
        """Where it begins and ends [s]."""
        return self.begin_ns / 1e9, self.end_ns / 1e9

    def beside(self, recorder: Recorder) -> Recorder:
        """Return a recorder that passes on what is in the window."""
        if not self.index:
            return recorder
        return Slice(recorder, index=self.index, begin_ns=self.begin_ns)

    def check_begin(self, channels: Mapping[str, Channel], grid: Grid) -> None:
        """Check that all components that a replay records have a row where it begins.

        Parameters
        ----------
        channels : mapping of component name to Channel
            What the replay records; a log need not have all of these.
        grid : Grid
            Of the communication points.

        Raises
        ------
        UsageError
            If a component has none there.
        """
        for name, channel in channels.items():
            late = self.index % channel.period
            if late:
                raise UsageError(
                    f"the window begins at {self.ends[0]} s, where {name!r} has no row: it has "
                    f"one every {channel.period} communication steps; nearest before: "
                    f"{grid.stamp(self.index - late) / 1e9} s"
                )


def window_of(source: RecordedRun, ends: object) -> ReplayWindow:
    """Return a window of a recording.

    Parameters
    ----------
    source : RecordedRun
    ends : (float or None, float or None)
        Where it begins and ends [s]; None: where the recording does.

    Raises
    ------
    UsageError
        If it is no window, or not within the recording; a ClockError if it is not on the grid of
        the communication points.
    """
    if not isinstance(ends, Sequence) or len(ends) != 2:
        raise UsageError(
            f"window: expected its begin and end [s], such as (2.0, 4.0), got {quoted(ends)}"
        )
    begin, end = ends
    stamp = source.grid.stamp
    index = 0 if begin is None else _point(source, begin, "begins")
    last = source.steps if end is None else _point(source, end, "ends")
    if index >= last:
        raise UsageError(
            f"the window from {stamp(index) / 1e9} s to {stamp(last) / 1e9} s: expected at least "
            f"one communication step, {step_value(source.step_ns)} s"
        )
    return ReplayWindow(stamp(index), stamp(last), index)


def _point(source: RecordedRun, time: object, verb: str) -> int:
    """Return the number of a communication point of a recording."""
    if isinstance(time, bool) or not isinstance(time, int | float):
        raise UsageError(f"the window {verb} at {quoted(time)}; expected a time [s]")
    first_ns = source.grid.start_ns
    if not first_ns / 1e9 <= time <= source.end_ns / 1e9:
        raise UsageError(
            f"the window {verb} at {time} s; expected a time within the recording, "
            f"{first_ns / 1e9} s to {source.end_ns / 1e9} s"
        )
    return whole_steps(time, source.step_ns, f"where the window {verb}", start_ns=first_ns)
