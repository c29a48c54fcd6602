"""A scenario that is advanced by hand, with a log of it or without."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self, TypeAlias, final
from weakref import finalize

import numpy as np

from cosim.arrays import Vector
from cosim.core.contracts import Stopped
from cosim.core.recorded.signals import RunMessage, warning_texts
from cosim.core.recorders import close
from cosim.core.recording import Recorder
from cosim.core.simulation import Simulation
from cosim.core.stages.overrides import OverrideValue
from cosim.core.stepping.states import SimulationState
from cosim.core.stepping.step_rows import StepRows
from cosim.errors import CosimError, Interrupted, UsageError, warn


@dataclass(frozen=True)
class Opened:
    """A simulation that has begun.

    Parameters
    ----------
    simulation : Simulation
    recorder : Recorder
        Entered; it ends the FMUs, and the log where there is one.
    log : callable
        Returns the path of the log; None: there is none.
    warnings : callable
        Returns the warnings so far.
    """

    simulation: Simulation
    recorder: Recorder
    log: Callable[[], Path | None]
    warnings: Callable[[], list[RunMessage]]


Opener: TypeAlias = Callable[[ExitStack, bool], Opened]


@final
class Session:
    """A scenario advanced by the caller; :meth:`Scenario.start` returns it.

    A context manager: on exit the log is completed and FMUs are closed. Only the thread that
    started a session may use it. The log of a session that is garbage-collected is completed, too,
    with a ``ResourceWarning``. Warnings of the scenario are shown when the session starts, those of
    FMUs when it is closed: :class:`cosim.CosimWarning`. Time, signals and states are those of its
    :class:`cosim.core.Simulation`, whose methods document their errors.

    Parameters
    ----------
    opener : callable
        From resources, and whether a log is the next one beside others, to what is opened.
    """

    def __init__(self, opener: Opener) -> None:
        self._opener = opener
        self._logs: list[Path] = []
        self._shown: set[str] = set()
        self._is_open = False
        self._open(is_next=False)

    def _open(self, *, is_next: bool) -> None:
        with ExitStack() as resources:
            self._opened = self._opener(resources, is_next)
            self._resources = resources.pop_all()
        self._simulation = self._opened.simulation
        path = self._opened.log()
        self._unclosed: finalize[[Opened, ExitStack, int], Session] | None = None
        if path is not None:
            self._logs.append(path)
            self._unclosed = finalize(
                self, _complete_unclosed, self._opened, self._resources, os.getpid()
            )
        self._is_open = True
        try:
            self._warn()
        except BaseException:  # where warnings are errors
            self.close()
            raise

    def _warn(self) -> None:
        """Show the warnings that were not shown yet."""
        texts = warning_texts(self._opened.warnings())
        new = [text for text in texts if text not in self._shown]
        self._shown.update(new)
        warn(new)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Complete the log, and close what was opened.

        Raises
        ------
        CosimError
            If the log cannot be completed, or an FMU fails at its end.
        UsageError
            If another thread started the session; it continues.
        """
        self._close(error, "closed")

    def close(self) -> None:
        """Complete the log, and close what was opened; as at the end of a ``with`` block.

        Raises
        ------
        CosimError
            If the log cannot be completed, or an FMU fails at its end.
        UsageError
            If another thread started the session; it continues.
        """
        self._close(None, "closed")

    def _close(self, error: BaseException | None, how: str) -> None:
        if not self._is_open:
            return
        self._simulation.check_thread()
        self._is_open = False
        if self._unclosed is not None:
            self._unclosed.detach()
        with self._resources:
            try:
                self._simulation.close()
            except BaseException as failure:
                close(self._opened.recorder, error or failure)
                raise
            ended = error or self._simulation.error
            if ended is None and self.steps_left:
                reason = f"the session was {how} at t = {self.t} s, before its stop"
                ended = Stopped(np.empty((0, 0)), reason, failed=False)
            close(self._opened.recorder, ended)
        if error is None:
            self._warn()

    # --- time ---

    @property
    def t_ns(self) -> int:
        """The current time [ns]."""
        return self._simulation.t_ns

    @property
    def t(self) -> float:
        """The current time [s]."""
        return self._simulation.t

    @property
    def steps_left(self) -> int:
        """Communication steps up to the stop of the scenario."""
        return self._simulation.steps_left

    def step(self, count: int = 1) -> StepRows:
        """Advance by a number of communication steps; return their rows by signal name.

        See :meth:`cosim.core.Simulation.step`. The arrays have shape (count, size) and are
        read-only. If the run ends earlier, by ``until`` or because a component stops it,
        :class:`cosim.core.Stopped` is raised with the reason, and :attr:`rows` has the rows before.
        """
        return self._simulation.step(count)

    @property
    def rows(self) -> StepRows | None:
        """The rows of the last step, also if it ended early; None: there was no step."""
        return self._simulation.rows

    def run_until(self, t: float) -> StepRows:
        """Advance up to an instant [s]; see :meth:`cosim.core.Simulation.run_until`."""
        return self._simulation.run_until(t)

    # --- signals ---

    @property
    def signals(self) -> tuple[str, ...]:
        """The names of all signals."""
        return self._simulation.signals

    def __getitem__(self, signal: str) -> Vector:
        """Return a signal at the current time, after its jumps; shape (size,)."""
        return self._simulation[signal]

    def __setitem__(self, to: str, value: OverrideValue) -> None:
        """Override an input, or elements of it, from the current time on.

        The override holds until it is changed or released. The row at this instant keeps the value
        before; outputs with direct feedthrough follow at once. See
        :meth:`cosim.core.Simulation.__setitem__`.
        """
        self._simulation[to] = value

    def release(self, to: str) -> None:
        """Release an override; see :meth:`cosim.core.Simulation.release`."""
        self._simulation.release(to)

    @property
    def overrides(self) -> dict[str, float]:
        """The overridden elements of inputs, and their values."""
        return self._simulation.overrides

    # --- going back ---

    @property
    def state(self) -> SimulationState:
        """The state at the current time, to go back to; it can be pickled."""
        return self._simulation.state

    @state.setter
    def state(self, state: SimulationState) -> None:
        """Go back to a state of this scenario; without a log."""
        self._simulation.state = state

    def reset(self) -> None:
        """Restart at the start time, without overrides.

        The log is completed, and the next one is written beside it: ``x-2.mcap``, ...

        Raises
        ------
        UsageError
            If the session is closed, or another thread started it.
        """
        if not self._is_open:
            raise UsageError("reset: this session is closed; start a new one")
        if not self._logs:
            self._simulation.reset()
            return
        self._simulation.check_thread()
        self._close(None, "reset")
        self._open(is_next=True)

    # --- logs ---

    @property
    def logs(self) -> tuple[Path, ...]:
        """The logs of this session in order: one, and one more for every reset."""
        return tuple(self._logs)


def _complete_unclosed(opened: Opened, resources: ExitStack, process: int) -> None:
    """Complete the log of a session that nobody has any more."""
    if os.getpid() != process:  # a copy of it, in a process that was forked
        return
    simulation = opened.simulation
    path = opened.log()
    ended = simulation.error
    if ended is None:
        ended = Interrupted(f"the session was not closed, at t = {simulation.t} s")
    with resources:
        with suppress(CosimError):
            simulation.close()
        close(opened.recorder, ended)
    text = f"{path}: the session was not closed; call sim.close(), or use a with block"
    warnings.warn(text, ResourceWarning, stacklevel=2)
