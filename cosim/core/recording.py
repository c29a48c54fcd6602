"""What a run records: what a recorder takes, and what a recording gives back."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final, Literal, NamedTuple, Protocol, Self, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Nanoseconds
from cosim.core.contracts import Block, Design
from cosim.core.port import Port
from cosim.core.recorded.partial import PartialChannels, PartialRecord
from cosim.core.signals import Channel, FaultKind, Layout
from cosim.instants import StepNs, duration, last_nanosecond

EventCause: TypeAlias = FaultKind | Literal["override", "release", "set", "swap", "follow", "jump"]
MessageLevel: TypeAlias = Literal["debug", "info", "warning", "error", "fatal"]
INNER_STEP: Final = "inner step"  # of a component: category of a message, key of the results
SHARED_INNER_STEP: Final = "inner step in a loop"  # of it, or of another one of its loop
TimedRows: TypeAlias = tuple[Nanoseconds, Matrix]  # the rows of a component and their instants


def joined(blocks: Iterable[TimedRows]) -> TimedRows:
    """Return the rows of at least one block as one; what is one already is not copied."""
    parts = list(blocks)
    if len(parts) == 1:
        return parts[0]
    return np.concatenate([times for times, _ in parts]), np.concatenate([r for _, r in parts])


# a signal or elements of it, or several that are stacked
SignalNames: TypeAlias = str | Port | Sequence[str | Port]


@dataclass(frozen=True, slots=True)
class Plan:
    """What is fixed before the run: it goes to the log, and a replay follows it.

    Parameters
    ----------
    layout : Layout
    step_ns : int or Fraction
        Communication step [ns].
    designs : mapping of component name to Design
    held : mapping of component name to Mask
        Which input elements have a zero-order hold.
    schedule : tuple of str
        The stages in order, readable: ``"cascade plant"``, ``"gauss-seidel controller plant
        observer"``.
    partial : PartialRecord or None
        What the layout is a part of; None: it has all that the run computes.
    """

    layout: Layout
    step_ns: StepNs
    designs: Mapping[str, Design]
    held: Mapping[str, Mask]
    schedule: tuple[str, ...]
    partial: PartialRecord | None = None

    @property
    def channels(self) -> Mapping[str, Channel]:
        """The recorded components by name."""
        channels = {channel.name: channel for channel in self.layout.channels}
        return channels if self.partial is None else PartialChannels(channels, self.partial)

    @property
    def declared(self) -> Mapping[str, Channel]:
        """All components of the run, with all their signals."""
        return self.channels if self.partial is None else self.partial.declared


class SignalEvent(NamedTuple):
    """A jump of a signal at a communication point: the limit that is not in the row there.

    Of what is done at the point that is the right limit, as the row was recorded before it; of a
    signal that jumps by itself it is the left one.

    Parameters
    ----------
    time_ns : int
    cause : EventCause
        An input was overridden, has a fault, or was released; a parameter was set, or a component
        swapped; or the signal followed one of these. "jump": a continuous output jumped, with a
        discrete signal or by itself; ``values`` is its left limit. (That of a discrete one is in
        the row before.)
    signal : str
        ``component.signal``; but for one that followed also elements of one; or
        ``component.parameter``, ``component.file``.
    values : tuple of float
        Of its elements.
    parameters : tuple of float
        Of a fault, one element's after the other's; see :mod:`cosim.core.stages.faults`.
    """

    time_ns: int
    cause: EventCause
    signal: str
    values: tuple[float, ...]
    parameters: tuple[float, ...] = ()


class Substep(NamedTuple):
    """A part of a communication step that a loop took, or refused.

    Parameters
    ----------
    begin, end : float
        [s]. A whole number of nanoseconds, or the time that a component gave of its event.
    loop : str
        The first component of the loop.
    error : float or None
        The estimated error, in units of what is tolerated; None: there is no estimate, as an event
        divides it, or leaves less than two nanoseconds.
    accepted : bool
        Whether the loop went on from its end.
    event : str
        The component that has an event at its end, or inside it where it was refused for that;
        empty: none has.
    values : tuple of float
        Where it was accepted: the applied inputs and outputs of all components of the loop at its
        end, one component's after the other's, in the order of the loop; after them the left
        limits of those that jump.
    """

    begin: float
    end: float
    loop: str
    error: float | None
    accepted: bool
    event: str = ""
    values: tuple[float, ...] = ()

    @property
    def length(self) -> float:
        """How long it is [s]."""
        return duration(self.begin, self.end)

    @property
    def begin_ns(self) -> int:
        """The last whole nanosecond at or before its begin."""
        return last_nanosecond(self.begin)


@runtime_checkable
class Recorder(Protocol):
    """A context manager that takes blocks of rows and leaves a complete record behind.

    It does so however the run ends. Order of the calls: ``__enter__``; ``begin``, unless a
    component cannot be prepared; ``write`` after every block; ``__exit__``.
    :func:`cosim.core.run` calls neither ``message`` nor ``result``; running a scenario does. There
    are events only where signals jump: inputs that are overridden or faulty, parameters that are
    set, components that are swapped (:class:`cosim.core.Simulation`), what follows them, and
    continuous outputs that jump with discrete signals or by themselves; there are substeps only of
    loops that take them.

    Two methods more are called where a recorder has them:

    ``follow(rows)`` takes a function that another thread may call; it returns what is computed of
    a block that is not handed over yet, as ``write`` takes it, or None. Rows 1 to K stay as they
    are until the block is written, as usual: then those that were taken are left out.

    ``memory_for(block, steps)`` returns where the rows of a block will stay, shape (K+1, width), to
    be filled where they stay, or None; ``steps`` of the run are still to come, with those of the
    block. Row 0 is the last row of the block before. What is written of the block then is passed
    to ``write`` as usual, as a part of this array.
    """

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Complete the record.

        ``error`` is what ended the run, also the :class:`Stopped` of a regular end (``failed``
        False); :func:`cosim.core.end_of_run` turns it into a status and a reason.
        """
        return

    def begin(self, plan: Plan) -> None:
        """Receive what is fixed before the run; called before the first write."""
        return

    def write(self, block: Block, signals: Matrix) -> None:
        """Write rows 1 to K of ``signals``, shape (K+1, width); row 0 too in the first block.

        Parameters
        ----------
        block : Block
            ``index`` is 0 for the first block; the step number of row k is ``index + k``.
        signals : Matrix, shape (K+1, width)
            All rows; where the plan's layout gives a channel a ``period``, the rows whose step
            number is a multiple of it are to be kept. The array is used again: copy what is kept.
        """
        return

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Record a message of the run or of a component, ``source``, at a simulation time [ns]."""
        return

    def event(self, event: SignalEvent) -> None:
        """Record a jump of a signal; called after the row at its instant was written."""
        return

    def substep(self, substep: Substep) -> None:
        """Record a substep; called when the row after it has been written."""
        return

    def result(self, values: Mapping[str, Any]) -> None:
        """Record plain values about the end of the run; called before ``__exit__``."""
        return


RowsUnderWay: TypeAlias = Callable[[], tuple[Block, Matrix] | None]
RowMemory: TypeAlias = Callable[[Block, int], Matrix | None]


@runtime_checkable
class Recording(Protocol):
    """A finished run to read from: a log file, or memory."""

    @property
    def label(self) -> str:
        """What was recorded to: a path, or ``the run``."""
        ...

    @property
    def status(self) -> str:
        """How it ended: ``complete``, ``failed`` or ``interrupted``."""
        ...

    @property
    def reason(self) -> str:
        """The stop reason; empty where the run came to its end."""
        ...

    @property
    def channels(self) -> Mapping[str, Channel]:
        """The recorded components by name."""
        ...

    def __getitem__(self, signal: SignalNames) -> NDArray[np.float64]:
        """Return a signal, or elements of it: shape (N,) for one element, else (N, size).

        Several signals of the same instants are stacked: shape (N, sum of their sizes).

        Raises
        ------
        LogError
            If a signal is unknown, or several have different instants.
        """
        ...

    def blocks(
        self, component: str, *, first_ns: int | None = None, last_ns: int | None = None
    ) -> Iterator[TimedRows]:
        """Yield times and rows of a component in order of time, some at a time.

        The rows have its applied inputs, then its outputs. With bounds [ns], both included, they
        are those between them. There is a block at least, which may have no rows.
        """
        ...

    def blocks_of(
        self,
        components: Sequence[str],
        *,
        first_ns: int | None = None,
        last_ns: int | None = None,
    ) -> Iterator[tuple[str, Nanoseconds, Matrix]]:
        """Yield names, times and rows of components as they come, each in order of time."""
        ...

    def time_ns(self, component: str) -> Nanoseconds:
        """Return the instants of the rows of a component, or of a signal, shape (N,) [ns]."""
        ...

    @property
    def left_out(self) -> Mapping[str, str] | None:
        """What cannot be read of a file of another tool, and why; None: it is a run of cosim."""
        ...

    @property
    def held(self) -> Mapping[str, Mask]:
        """Which input elements of every component had a zero-order hold."""
        ...

    @property
    def step_ns(self) -> StepNs:
        """Communication step [ns]."""
        ...

    @property
    def steps(self) -> int:
        """Number of communication steps."""
        ...

    @property
    def end_ns(self) -> int:
        """The last recorded instant [ns]."""
        ...

    @property
    def metadata(self) -> Mapping[str, Any]:
        """What was recorded beside the signals."""
        ...

    @property
    def results(self) -> Mapping[str, Any]:
        """What was recorded of the end of the run."""
        ...

    def events(self) -> list[SignalEvent]:
        """Return the jumps of signals, in the order of time."""
        ...

    def substeps(self) -> list[Substep]:
        """Return the substeps of loops, in the order of where they begin."""
        ...
