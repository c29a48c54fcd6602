"""Solvers of models: integrate any model across communication points; see :class:`Solver`."""

from __future__ import annotations

from typing import Any, Final, NamedTuple, Protocol, TypeAlias, TypeVar, final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import RunError
from cosim.native.numerics.runge_kutta import EMBEDDED, EXPLICIT, RightHandSide

ADAPTIVE: Final = ("Radau", "BDF", "LSODA")  # scipy.integrate
IMPLICIT: Final = (*ADAPTIVE, "CVode")
TOLERANT: Final = (*EMBEDDED, *IMPLICIT)  # what keeps to a relative tolerance
STEPPING: Final = (*EXPLICIT, *IMPLICIT)  # for any model
SOLVERS: Final = ("exact", *STEPPING)

LIBRARIES: Final = {"Radau": "LAPACK", "BDF": "LAPACK", "LSODA": "ODEPACK", "CVode": "SUNDIALS"}
"""What the solvers compute with whose last bits depend on the processor."""

SolutionPoint: TypeAlias = tuple[float, Vector]  # (t, x)
SolverState = TypeVar("SolverState")


class Solver(Protocol[SolverState]):
    """Integrates ``x' = f(t, x)`` step by step.

    What a solver learned of the solution it keeps over communication points, until it is started
    anew. ``f`` is evaluated at no time beyond the ``t_end`` of a step, where it may have a kink. If
    it jumps there, the solver must be started anew.
    """

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin at ``t`` [s] with ``x``.

        The absolute tolerance of a state is ``rtol`` times its nominal value.
        """
        ...

    def step(self, t_end: float) -> float:
        """Take one step of the solver's own length, to ``t_end`` at most; return the time reached.

        Raises
        ------
        RunError
            If the solver fails; with its own words.
        """
        ...

    def at(self, t: float) -> Vector:
        """Return the state at a time within the last step, shape (n_x,)."""
        ...

    def save(self) -> SolverState:
        """Copy the state.

        A solver whose state cannot be copied starts anew here, as it will after ``restore``.
        """
        ...

    def restore(self, state: SolverState) -> None:
        """Go back to a saved state."""
        ...


class AdaptiveState(NamedTuple):
    """A copy of an ``Adaptive``."""

    start: SolutionPoint
    nominals: Vector
    solver: Any  # scipy's object itself; None: not made yet
    attributes: dict[str, Any]  # of that object, its arrays copied


@final
class Adaptive:
    """One of scipy's implicit solvers.

    scipy's object is kept, and its bound moved on from step to step. LSODA starts anew at every
    bound: before scipy 1.17 all LSODA solvers of a process share one memory, so that two of them
    cannot run on in turns.

    Parameters
    ----------
    method : str
        One of ``ADAPTIVE``.
    f : callable
        x' at t and x.
    rtol : float
        Relative tolerance of the state.
    """

    def __init__(self, method: str, f: RightHandSide, *, rtol: float) -> None:
        import scipy.integrate

        self._class = getattr(scipy.integrate, method)
        self._method = method
        self._f = f
        self._rtol = rtol
        self._runs_on = method != "LSODA"
        self.start(0.0, np.empty(0), np.empty(0))

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin at ``t`` with ``x``."""
        self._start = (t, x)
        self._nominals = nominals
        self._solver: Any = None  # made at the first step, whose bound it wants
        self._dense_output: Any = None  # made where it is asked for

    def step(self, t_end: float) -> float:
        """Take one step, to ``t_end`` at most.

        Raises
        ------
        RunError
            If scipy's solver fails.
        """
        try:
            solver = self._bounded(t_end)
            message = solver.step()
        except (ValueError, np.linalg.LinAlgError) as error:
            # scipy's linear algebra refuses what is not finite
            raise RunError(f"solver {self._method}: {error}") from error
        if solver.status == "failed":
            raise RunError(f"solver {self._method}: {message}")
        self._dense_output = None
        return float(solver.t)

    def _bounded(self, t_end: float) -> Any:
        """Return scipy's object with ``t_end`` as its bound."""
        solver = self._solver
        if solver is not None and solver.status == "finished" and not self._runs_on:
            self._start = (solver.t, solver.y)
            solver = None
        if solver is None:
            t, x = self._start
            atol = self._rtol * self._nominals
            solver = self._class(self._f, t, x, t_end, rtol=self._rtol, atol=atol)
            self._solver = solver
        elif self._runs_on:
            # At its bound scipy's object calls itself finished and would refuse the next step.
            solver.t_bound = t_end
            solver.status = "running"
        return solver

    def at(self, t: float) -> Vector:
        """Return the state at a time within the last step."""
        solver = self._solver
        if t == solver.t:
            return np.array(solver.y)
        if self._dense_output is None:
            self._dense_output = solver.dense_output()
        return np.array(self._dense_output(t))

    def save(self) -> AdaptiveState:
        """Copy the state: every array of scipy's object, the rest of which is never written to."""
        solver = self._solver
        if solver is not None and not self._runs_on:
            self.start(float(solver.t), np.array(solver.y), self._nominals)
        attributes = {} if self._solver is None else _copied(vars(self._solver))
        return AdaptiveState(self._start, self._nominals, self._solver, attributes)

    def restore(self, state: AdaptiveState) -> None:
        """Go back to a saved state."""
        self._start = state.start
        self._nominals = state.nominals
        self._solver = state.solver
        self._dense_output = None  # that of the step that was left
        if self._solver is not None:
            # Copied again: the solver writes to its arrays, and a state may be restored twice.
            vars(self._solver).update(_copied(state.attributes))


def _copied(attributes: dict[str, Any]) -> dict[str, Any]:
    copies = {}
    for name, value in attributes.items():
        copies[name] = value.copy() if isinstance(value, np.ndarray) else value
    return copies


@final
class Stateless:
    """The solver of a model without continuous states: only time advances."""

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin anywhere."""

    def step(self, t_end: float) -> float:
        """Go to ``t_end``."""
        return t_end

    def at(self, t: float) -> Vector:
        """Return no states."""
        return np.empty(0)

    def save(self) -> None:
        """Copy nothing."""

    def restore(self, state: None) -> None:
        """Go back to nothing."""
