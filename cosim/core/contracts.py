"""The contracts of a component and of a model, and how a component is stepped.

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

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias, TypeVar, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Nanoseconds, Vector
from cosim.core.linearization import Linearized
from cosim.core.signals import Interface
from cosim.errors import LogError, RunError
from cosim.native.step import NativeStep

Design: TypeAlias = Mapping[str, NDArray[np.float64]]
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
            Communication step [s]; any part of it where the interface declares ``substeps``.
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
            Parts of the communication step [s], which ``advance`` may get as ``h`` from now on. It
            may get others, too: where an event ends a substep. What these need must have the same
            bits on every processor, as it is not recorded.
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


class Eventful(Protocol):
    """For components with events inside of steps; their interface declares ``locates_events``."""

    def first_event(self) -> float:
        """Return the time of the first event inside the last step [s]; infinity: there was none.

        Of the last step of the last ``advance``. The time of one of its ends says the same as
        infinity: what happens there divides nothing.
        """
        ...


@dataclass(frozen=True, slots=True)
class InputWiring:
    """What drives the inputs of a component, as masks of shape (n_u,).

    Parameters
    ----------
    driven : Mask
        Something drives these.
    held : Mask
        These have a zero-order hold.
    latest : Mask
        What drives these may jump inside of a step: where they have one value over it, it is that
        at its end. The others that are not held have the mean of both ends.
    in_loop : Mask
        These are driven from a loop of its own without any discrete output.
    """

    driven: Mask
    held: Mask
    latest: Mask
    in_loop: Mask

    def of(self, own: Callable[[Mask], Mask]) -> InputWiring:
        """Return it for other inputs, whose masks a function returns."""
        return InputWiring(own(self.driven), own(self.held), own(self.latest), own(self.in_loop))


@runtime_checkable
class Wired(Protocol):
    """For components that need to know what drives their inputs, as those of FMUs do."""

    def take_wiring(self, wiring: InputWiring) -> None:
        """Take what drives the inputs, before ``prepare``."""
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


def take_wiring(component: Component, wiring: InputWiring) -> None:
    """Say to a component what drives its inputs, if it asks; see :class:`Wired`."""
    if isinstance(component, Wired):
        component.take_wiring(wiring)


def left_limits(component: Component, t: Vector) -> Mapping[int, Vector]:
    """Return the left limits of a component; none where its interface names no output."""
    if not component.interface.left_limits:
        return {}
    return cast(Jumping, component).left_limits(t)


def first_event(component: Component) -> float:
    """Return the time of the first event inside the last step of a component; infinity: none."""
    if not component.interface.locates_events:
        return math.inf
    return cast(Eventful, component).first_event()


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
            f"the recorded design: expected arrays of shapes {dict(shapes)}, got "
            f"{recorded_shapes}; run the scenario to compute it again"
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
