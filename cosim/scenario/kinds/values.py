"""What kinds say of their components, as values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

from cosim.arrays import Matrix, Vector
from cosim.core.connections import Connection
from cosim.core.port import Port

# a signal at instants of the run (N,) [s]
KnownSignal: TypeAlias = Callable[[Vector], Vector]


@dataclass(frozen=True, slots=True)
class LinearSystem:
    """``x' = A x + B u``, ``y = C x + D u``: a component near its initial state.

    Parameters
    ----------
    A, B, C, D : Matrix, shapes (n_x, n_x), (n_x, n_u), (n_y, n_x), (n_y, n_u)
    error : float
        Estimate of the largest error of an entry; 0: rounding.
    """

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix
    error: float


@dataclass(frozen=True, slots=True)
class Spectrum:
    """What is known of a signal before the run.

    Parameters
    ----------
    amplitude : float
        Its root mean square.
    bandwidth : float
        Its highest rate [rad/s].
    source : Mapping
        What that was computed from, in plain values.
    assumption : str
        What was assumed.
    """

    amplitude: float
    bandwidth: float
    source: Mapping[str, Any]
    assumption: str


@dataclass(frozen=True, slots=True)
class Sampling:
    """At which communication points a component takes its inputs.

    Parameters
    ----------
    period : int
        Communication steps between two of them.
    offset : int
        Communication steps before the first one.
    holds : bool
        It holds the inputs of a point up to the next one; else those without a zero-order hold are
        interpolated linearly.
    """

    period: int
    offset: int
    holds: bool


@dataclass(frozen=True, slots=True)
class StepDependence:
    """What another communication step changes of a component, beside the error of the step.

    Parameters
    ----------
    draws : bool
        It draws random numbers at every communication step: another step, others.
    jumps_at_points : bool
        It is known to jump at communication points alone, whatever the step is. So does what has
        its instants from its table, as a period, or from what drives it.
    times : tuple of float
        Times [s] of its table that need not be whole communication steps: its error depends on the
        part of a step that they leave over.
    """

    draws: bool = False
    jumps_at_points: bool = True
    times: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class ImpliedConnection:
    """A connection that [connections] does not write, for it follows from what the file does.

    Parameters
    ----------
    connection : Connection or None
        None: the origin has none either.
    origin : Port or None
        The input, or elements of it, whose connection it follows from; None: it follows from the
        component's own table.
    """

    connection: Connection | None
    origin: Port | None


def shared_connections(
    to: Port, origin: Port, connections: Mapping[Port, Connection]
) -> dict[Port, ImpliedConnection]:
    """Return the connections that an input shares with another input, as a whole or by elements."""
    shared = {}
    for port, connection in connections.items():
        if port.whole == origin:
            own = replace(port, component=to.component, signal=to.signal)
            shared[own] = ImpliedConnection(connection, port)
    return shared or {to: ImpliedConnection(None, origin)}
