"""Solvers of models: integrate any model, and run on over communication points; see :class:`Solver`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, Protocol, TypeAlias, final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import RunError

ADAPTIVE: Final = ("RK45", "DOP853", "Radau", "BDF", "LSODA")  # scipy.integrate
TOLERANT: Final = (*ADAPTIVE, "CVode")  # what keeps to a relative tolerance
STEPPING: Final = ("rk4", *TOLERANT)  # for any model
SOLVERS: Final = ("exact", *STEPPING)

Slope: TypeAlias = Callable[[float, Vector], Vector]  # (t, x) -> x'


class Solver(Protocol):
    """Moves ``x' = f(t, x)`` on step by step, and runs on: what it learnt of the solution it keeps until it is started anew.

    ``f`` is asked for no time beyond the ``t_end`` of a step. It may change its slope there, but not its value: then the solver
    is to be started anew.
    """

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin at ``t`` [s] with ``x``; the absolute tolerance of a state is ``rtol`` times its nominal value."""
        ...

    def step(self, t_end: float) -> float:
        """Take one step of the solver's own length, to ``t_end`` at most; give the time reached.

        Raises
        ------
        RunError
            Where the solver fails; with its own words.
        """
        ...

    def at(self, t: float) -> Vector:
        """Give the state at a time within the last step, shape (n_x,)."""
        ...

    def save(self) -> object:
        """Copy the state; a solver whose state cannot be copied starts anew here, as it will after ``restore``."""
        ...

    def restore(self, state: object) -> None:
        """Go back to a saved state."""
        ...


def rk4(f: Slope, t0: float, t1: float, x: Vector) -> Vector:
    """Integrate over one step with the classical Runge-Kutta method of order 4 (Kutta, 1901)."""
    h, t = t1 - t0, 0.5 * (t0 + t1)
    k1 = f(t0, x)
    k2 = f(t, x + 0.5 * h * k1)
    k3 = f(t, x + 0.5 * h * k2)
    k4 = f(t1, x + h * k3)
    return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


@final
class RungeKutta:
    """``rk4``: one step to wherever the step may end; the state within it is that of a shorter step.

    Parameters
    ----------
    f : callable
        x' at t and x.
    """

    def __init__(self, f: Slope) -> None:
        self._f = f
        self.start(0.0, np.empty(0), np.empty(0))

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin at ``t``; there are no tolerances to keep."""
        self._begin = self._end = (t, x)

    def step(self, t_end: float) -> float:
        """Take one step to ``t_end``."""
        self._begin = self._end
        self._end = t_end, rk4(self._f, self._begin[0], t_end, self._begin[1])
        return t_end

    def at(self, t: float) -> Vector:
        """Give the state at a time within the last step."""
        return (
            self._end[1] if t == self._end[0] else rk4(self._f, self._begin[0], t, self._begin[1])
        )

    def save(self) -> object:
        """Copy the state: where it is."""
        return self._end

    def restore(self, state: object) -> None:
        """Go back to a saved state."""
        self._begin = self._end = state  # type: ignore[assignment]


@final
class Adaptive:
    """One of scipy's error-controlled solvers.

    scipy's object is kept, and its bound moved on from step to step. LSODA starts anew at every bound: before scipy 1.17 all
    LSODA solvers of a process share one memory, so that two of them cannot run on in turns.

    Parameters
    ----------
    method : str
        One of ``ADAPTIVE``.
    f : callable
        x' at t and x.
    rtol : float
        Relative tolerance of the state.
    """

    def __init__(self, method: str, f: Slope, *, rtol: float) -> None:
        import scipy.integrate

        self._class, self._method, self._f, self._rtol = (
            getattr(scipy.integrate, method),
            method,
            f,
            rtol,
        )
        self._runs_on = method != "LSODA"
        self.start(0.0, np.empty(0), np.empty(0))

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin at ``t`` with ``x``."""
        self._first, self._nominals = (t, x), nominals
        self._solver: Any = None

    def step(self, t_end: float) -> float:
        """Take one step, to ``t_end`` at most."""
        try:
            solver = self._bounded(t_end)
            message = solver.step()
        except (
            ValueError,
            np.linalg.LinAlgError,
        ) as error:  # scipy's linear algebra refuses what is not finite
            raise RunError(f"solver {self._method}: {error}") from error
        if solver.status == "failed":
            raise RunError(f"solver {self._method}: {message}")
        self._dense: Any = None
        return float(solver.t)

    def _bounded(self, t_end: float) -> Any:
        solver = self._solver
        if solver is not None and solver.status == "finished" and not self._runs_on:
            self._first, solver = (solver.t, solver.y), None
        if solver is None:
            atol = self._rtol * self._nominals
            self._solver = solver = self._class(
                self._f, *self._first, t_end, rtol=self._rtol, atol=atol
            )
        elif self._runs_on:
            solver.t_bound, solver.status = t_end, "running"
        return solver

    def at(self, t: float) -> Vector:
        """Give the state at a time within the last step."""
        solver = self._solver
        if t == solver.t:
            return np.array(solver.y)
        if self._dense is None:
            self._dense = solver.dense_output()
        return np.array(self._dense(t))

    def save(self) -> object:
        """Copy the state: every array of scipy's object, the rest of which is never written to."""
        solver = self._solver
        if solver is not None and not self._runs_on:
            self.start(float(solver.t), np.array(solver.y), self._nominals)
        return (
            self._first,
            self._nominals,
            self._solver,
            None if self._solver is None else _copied(vars(self._solver)),
        )

    def restore(self, state: object) -> None:
        """Go back to a saved state."""
        kept: dict[str, Any]
        self._first, self._nominals, self._solver, kept = state  # type: ignore[misc]
        if self._solver is not None:
            vars(self._solver).update(_copied(kept))


def _copied(attributes: dict[str, Any]) -> dict[str, Any]:
    copies = {
        name: value.copy() if isinstance(value, np.ndarray) else value
        for name, value in attributes.items()
    }
    if (
        "K_extended" in copies
    ):  # DOP853 writes its stages to K, the beginning of K_extended, and interpolates from that
        copies["K"] = copies["K_extended"][: len(copies["K"])]
    return copies


@final
class Stateless:
    """The solver of a model without continuous states: time just moves."""

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin anywhere."""

    def step(self, t_end: float) -> float:
        """Go to ``t_end``."""
        return t_end

    def at(self, t: float) -> Vector:
        """Give no states."""
        return np.empty(0)

    def save(self) -> object:
        """Copy nothing."""
        return None

    def restore(self, state: object) -> None:
        """Go back to nothing."""
