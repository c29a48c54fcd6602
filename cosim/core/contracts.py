"""The contracts: what a model, a component, a recorder and a recording are.

A component has an interface and three methods; ``h`` is the same in all calls, unless its interface
declares ``substeps``. Order of the calls: ``prepare`` once, where its interface declares it, and
``prepare_substeps`` behind it; ``initialize`` one or more times; then
``outputs`` and ``advance`` in any order, and ``save``, ``restore`` and ``linearized`` where its
interface declares them. An output that depends on an input at the same instant is declared as
feedthrough: ``outputs`` computes it for the inputs given, ``advance`` uses ``u[k + 1]`` for it.

The arrays that a component is handed, ``t`` and ``u``, cannot be written to. They are views of rows
that are used again, so they are valid during the call only: copy what is kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import (
    Any,
    Literal,
    NamedTuple,
    Protocol,
    Self,
    TypeAlias,
    TypeVar,
    cast,
    runtime_checkable,
)

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Nanoseconds, Vector
from cosim.core.linearization import Linearized
from cosim.core.port import Port
from cosim.core.signals import Channel, FaultKind, Interface, Layout
from cosim.errors import LogError, RunError
from cosim.native.step import NativeStep

Design: TypeAlias = Mapping[str, NDArray[np.float64]]
EventCause: TypeAlias = FaultKind | Literal["override", "release", "set", "swap", "follow", "jump"]
MessageLevel: TypeAlias = Literal["debug", "info", "warning", "error", "fatal"]
# a signal or elements of it, or several that are stacked
SignalNames: TypeAlias = str | Port | Sequence[str | Port]
State = TypeVar("State")


class Component(Protocol):
    """Owns its state; advances over communication steps."""

    @property
    def interface(self) -> Interface:
        """Inputs, outputs, feedthrough, and the optional methods that there are; constant."""
        ...

    def initialize(self, t: float, u: Vector) -> Vector:
        """Set the initial state at ``t`` for inputs ``u``; return the outputs, shape (n_y,).

        Forgets the past. May be called again with other inputs until the first advance. The outputs
        that a run starts with are those of :meth:`outputs` then, which may differ: an FMU leaves
        its initialization there.
        """
        ...

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the outputs, shape (n_y,), at ``t``, the time reached; change nothing.

        Parameters
        ----------
        t : float
            Time [s].
        u : Vector, shape (n_u,)
            Inputs at ``t``; they may differ from those of the last advance.
        """
        ...

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Advance over the K communication steps between the K+1 times ``t``, each ``h`` long.

        Parameters
        ----------
        t : Vector, shape (K+1,)
            Times [s].
        h : float
            Communication step [s]; a part of it where the interface declares ``substeps``.
        u : Matrix, shape (K+1, n_u)
            Inputs at those times; rows may be strided.

        Returns
        -------
        Matrix, shape (K, n_y)
            Outputs at ``t[1:]``.

        Raises
        ------
        Stopped
            If it cannot, or need not, go on to the end; carries the outputs up to there.
        """
        ...


class Preparable(Protocol):
    """For components that compute before the run; their interface declares ``prepares``."""

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Compute what needs linear algebra, once before the run: gains, discretized matrices.

        BLAS and LAPACK give other bits on other processors, so the result is recorded, and a replay
        takes it from there.

        Parameters
        ----------
        h : float
            Communication step [s].
        held : Mask, shape (n_u,)
            Input elements with a zero-order hold: they keep their value from the start of a step.
            The others are interpolated linearly. What an input is at the end of a step reaches the
            outputs there in both cases.
        recorded : Design
            Arrays to take instead of computing them; empty, or complete. They come from a log:
            :func:`check_design` checks them.

        Returns
        -------
        Design
            Arrays of float64 by name; ``recorded`` itself where it is not empty, empty where there
            is nothing to record.
        """
        ...


class PreparableSubsteps(Preparable, Protocol):
    """For components that compute before the run and whose interface declares ``substeps``."""

    def prepare_substeps(self, lengths: tuple[float, ...], recorded: Design) -> Design:
        """Compute what steps of other lengths need; called behind ``prepare``, where there are any.

        Parameters
        ----------
        lengths : tuple of float
            Parts of the communication step [s], which ``advance`` may get as ``h`` from now on.
        recorded : Design
            As for ``prepare``.

        Returns
        -------
        Design
            As of ``prepare``.
        """
        ...


class Rollback(Protocol[State]):
    """For components that can go back; their interface declares ``rollback``.

    Loops that iterate go back to the start of a step, sessions to a state that was saved, and a run
    that a condition ends inside a block to its row.
    """

    def save(self) -> State:
        """Copy the state."""
        ...

    def restore(self, state: State) -> None:
        """Go back to a saved state."""
        ...


class Jumping(Protocol):
    """For components with outputs that jump by themselves; their interface names these."""

    def left_limits(self, t: Vector) -> Mapping[int, Vector]:
        """Return all outputs before their jumps, shape (n_y,), by place in ``t``.

        Parameters
        ----------
        t : Vector
            Times at which the last ``advance`` returned outputs [s]. Where these did not jump they
            need not be returned.
        """
        ...


class Transfer(Protocol):
    """Hands the state of a component over to its successor, which saves states otherwise.

    Both are known to it: ``take`` is called first, then the successor is initialized.
    """

    def take(self) -> Any:
        """Return the state of the component."""
        ...

    def give(self, state: Any) -> None:
        """Set the state of the successor, which is initialized."""
        ...


class Native(Protocol):
    """For components that may have a compiled step; their interface declares ``native``."""

    def native(self) -> NativeStep | None:
        """Return the compiled step of the component as it is now initialized; None: it has none.

        The step and the methods of the component share one state, and give the same bits: each may
        go on where the other ended. A status other than 0 means that the step was not taken, and
        that ``advance`` (or ``outputs``) is to take it, or to go on from where the compiled step
        left it; whatever is rare or fails is done there.
        """
        ...


class Linearizable(Protocol):
    """For components that can be linearized; their interface declares ``linearizable``."""

    def linearized(self, t: float, u: Vector) -> Linearized | None:
        """Linearize at the state, for inputs ``u`` at ``t``, the time reached; change nothing.

        Called before the run, after ``initialize``. None: it cannot be linearized here.
        """
        ...


def prepare(component: Component, h: float, held: Mask, recorded: Design) -> Design:
    """Prepare a component whose interface declares it; return its design, empty for all others."""
    if not component.interface.prepares:
        return {}
    return cast(Preparable, component).prepare(h, held, recorded)


def prepare_substeps(component: Component, lengths: tuple[float, ...], recorded: Design) -> Design:
    """Prepare a component for parts of a step, where it prepares at all; return that design."""
    if not component.interface.prepares:
        return {}
    return cast(PreparableSubsteps, component).prepare_substeps(lengths, recorded)


def linearized(component: Component, t: float, u: Vector) -> Linearized | None:
    """Linearize a component; None: it cannot be, or its interface does not declare it."""
    if not component.interface.linearizable:
        return None
    return cast(Linearizable, component).linearized(t, u)


def left_limits(component: Component, t: Vector) -> Mapping[int, Vector]:
    """Return the left limits of a component; none where its interface names no output."""
    if not component.interface.left_limits:
        return {}
    return cast(Jumping, component).left_limits(t)


def check_design(recorded: Design, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Check names and shapes of the arrays that a component takes: kernels that step trust them.

    Raises
    ------
    LogError
        If they are not those needed.
    """
    recorded_shapes = {name: np.shape(array) for name, array in recorded.items()}
    if recorded_shapes != shapes:
        raise LogError(
            f"the recorded design has arrays of shapes {recorded_shapes}, needed {dict(shapes)}; "
            "run the scenario to compute it again"
        )


class Stopped(RunError):
    """A component stops before the end of its block.

    Parameters
    ----------
    outputs : Matrix, shape (k, n_y)
        Outputs of the k steps that were completed.
    reason : str
        What stopped it.
    failed : bool
        False where the component asked for a regular end (FMI: terminateSimulation).
    """

    def __init__(self, outputs: Matrix, reason: str, *, failed: bool = True) -> None:
        super().__init__(reason)
        self.outputs = outputs
        self.failed = failed

    @property
    def steps(self) -> int:
        """Number of communication steps that were completed."""
        return len(self.outputs)

    def at(self, component: str, t: float) -> Stopped:
        """Return the same stop with the component and the time [s] in the message."""
        return Stopped(
            self.outputs, f"{component!r} stopped at t = {t} s: {self}", failed=self.failed
        )


class Model(Protocol):
    """``x' = f(t, x, u)``, ``y = g(t, x, u)``: functions without memory (FMI: model exchange)."""

    @property
    def interface(self) -> Interface:
        """Inputs, outputs and feedthrough."""
        ...

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the n_x continuous state elements."""
        ...

    def initial(self, t: float, u: Vector) -> Vector:
        """Return the consistent initial state x(t), shape (n_x,)."""
        ...

    def derivatives(self, t: float, x: Vector, u: Vector) -> Vector:
        """Return x', shape (n_x,)."""
        ...

    def outputs(self, t: float, x: Vector, u: Vector) -> Vector:
        """Return y, shape (n_y,)."""
        ...


@dataclass(frozen=True, slots=True)
class Block:
    """K consecutive communication steps.

    ``index`` is the number of the step at row 0; row k stands for the instant ``time_ns[k]``.
    """

    index: int
    time_ns: Nanoseconds  # (K+1,)
    time: Vector  # (K+1,) [s], each computed from its integer
    h: float  # [s]

    @property
    def steps(self) -> int:
        """Number of communication steps, K."""
        return len(self.time_ns) - 1

    def part(self, begin: int, end: int) -> Block:
        """Return the block of the steps from row ``begin`` to row ``end``."""
        rows = slice(begin, end + 1)
        return Block(self.index + begin, self.time_ns[rows], self.time[rows], self.h)


@dataclass(frozen=True, slots=True)
class Plan:
    """What is fixed before the run: it goes to the log, and a replay follows it.

    Parameters
    ----------
    layout : Layout
    step_ns : int
        Communication step [ns].
    designs : mapping of component name to Design
    held : mapping of component name to Mask
        Which input elements have a zero-order hold.
    schedule : tuple of str
        The stages in order, readable: ``"cascade plant"``, ``"gauss-seidel controller plant
        observer"``.
    """

    layout: Layout
    step_ns: int
    designs: Mapping[str, Design]
    held: Mapping[str, Mask]
    schedule: tuple[str, ...]


class SignalEvent(NamedTuple):
    """A jump of a signal at a communication point: the limit that is not in the row there.

    Of what is done at the point that is the right limit, as the row was recorded before it; of a
    signal that jumps by itself it is the left one.

    Parameters
    ----------
    time_ns : int
    cause : EventCause
        An input was overridden, has a fault, or was released; a parameter was set, or a component
        swapped; or the signal followed one of these. "jump": a continuous output jumped with a
        discrete signal; ``values`` is its left limit. (That of a discrete one is in the row
        before.)
    signal : str
        ``component.signal``; but for one that followed also elements of one; or
        ``component.parameter``, ``component.file``.
    values : tuple of float
        Of its elements.
    parameters : tuple of float
        Of a fault, one element's behind the other's; see :mod:`cosim.core.stages.faults`.
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
    begin_ns : int
        Where it begins.
    length_ns : int
    loop : str
        The first component of the loop.
    error : float
        The estimated error, in units of what is tolerated.
    accepted : bool
    values : tuple of float
        Where it was accepted: the applied inputs and outputs of all components of the loop at its
        end, one component's behind the other's, in the order of the loop; behind them the left
        limits of those that jump.
    """

    begin_ns: int
    length_ns: int
    loop: str
    error: float
    accepted: bool
    values: tuple[float, ...] = ()


@runtime_checkable
class Recorder(Protocol):
    """A context manager that takes blocks of rows and leaves a complete record behind.

    It does so however the run ends. Order of the calls: ``__enter__``; ``begin``, unless a
    component cannot be prepared; ``write`` after every block; ``__exit__``.
    :func:`cosim.core.run` calls neither ``message`` nor ``result``; running a scenario does. There
    are events only where signals jump: inputs that are overridden or faulty, parameters that are
    set, components that are swapped (:class:`cosim.core.Simulation`), and what follows them.
    """

    def __enter__(self) -> Self: ...

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
        ...

    def begin(self, plan: Plan) -> None:
        """Receive what is fixed before the run; called before the first write."""
        ...

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
        ...

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Record a message of the run or of a component, ``source``, at a simulation time [ns]."""
        ...

    def event(self, event: SignalEvent) -> None:
        """Record a jump of a signal; called after the row at its instant was written."""
        ...

    def substep(self, substep: Substep) -> None:
        """Record a substep; called after the row behind it was written."""
        ...

    def result(self, values: Mapping[str, Any]) -> None:
        """Record plain values about the end of the run; called before ``__exit__``."""
        ...


@runtime_checkable
class RowMemory(Protocol):
    """For recorders that keep the rows of a run in memory: they are computed where they stay."""

    def memory_for(self, block: Block, steps: int) -> Matrix | None:
        """Return where the rows of a block will stay, shape (K+1, width), to be filled.

        Row 0 is the last row of the block before. None: there is no such memory. What is
        written of the block then is passed to ``write`` as usual, as a part of this array.

        Parameters
        ----------
        block : Block
        steps : int
            Steps of the run that are still to come, with those of the block.
        """
        ...


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
            If a signal is unknown, or several have not the same instants.
        """
        ...

    def blocks(self, component: str) -> Iterator[tuple[Nanoseconds, Matrix]]:
        """Yield times and rows of a component in order of time, some at a time.

        The rows have its applied inputs, then its outputs.
        """
        ...

    def time_ns(self, component: str) -> Nanoseconds:
        """Return the instants of a component's rows, shape (N,) [ns]."""
        ...

    @property
    def held(self) -> Mapping[str, Mask]:
        """Which input elements of every component had a zero-order hold."""
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


class CompleteRecording(Recording, Protocol):
    """A recording with the scenario of its run, which can be built again from it."""

    @property
    def step_ns(self) -> int:
        """Communication step [ns]."""
        ...

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        ...

    def attachment(self, name: str) -> bytes:
        """Return the content of an attachment."""
        ...

    def load(self, *components: str) -> None:
        """Read several components at once, where they are not in memory yet."""
        ...
