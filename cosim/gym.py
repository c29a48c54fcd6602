"""Scenarios as environments of Gymnasium, for reinforcement learning; needs the extra ``gym``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from numbers import Integral
from pathlib import Path
from typing import Any, Final, SupportsFloat, TypeAlias, cast, final

import numpy as np
from numpy.typing import NDArray

from cosim.arguments import callable_argument
from cosim.arrays import Vector
from cosim.core.arguments import kind_of
from cosim.core.contracts import Stopped
from cosim.core.stepping.step_rows import StepRows
from cosim.errors import UsageError
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.running.execution import load
from cosim.scenario.session import Session

try:
    import gymnasium
    from gymnasium.spaces import Box
except ImportError as error:
    raise ImportError(
        "cosim.gym needs gymnasium, which is not installed: pip install gymnasium, or, in a clone "
        "of cosim, pip install -e '.[gym]'"
    ) from error

SEEDS: Final = 2**31  # seeds of components are drawn below it

Reward: TypeAlias = Callable[[StepRows], float]
SignalBounds: TypeAlias = Sequence[str] | Mapping[str, tuple[float, float]]


@final
class Env(gymnasium.Env[NDArray[np.float64], NDArray[np.float64]]):
    """A scenario with inputs as actions and signals as observations.

    An action overrides inputs for a number of communication steps. An episode is truncated at the
    stop time of the scenario, and terminated when a component stops the run or ``terminated``
    returns True.

    A reset draws a new seed for every component with a ``seed`` in its table, so that a seeded
    reset repeats an episode; without such components all episodes start alike.

    Parameters
    ----------
    scenario : str, Path or Scenario
        A shipped name, a path, or what :func:`cosim.load` returned.
    act : sequence of str, or mapping of str to (lowest, highest)
        Inputs that an action sets, in this order, and the bounds of their elements.
    observe : sequence of str, or mapping of str to (lowest, highest)
        Signals of an observation, in the same form; NaN while a signal has no value.
    reward : callable
        Computes the reward from the rows of an action.
    steps : int
        Communication steps per action.
    terminated : callable, optional
        Returns from the rows of an action whether the episode ends.
    out : str or Path, optional
        Log of the first episode; later ones go to ``x-2.mcap``, ``x-3.mcap``, ...

    Raises
    ------
    UsageError
        If a signal does not exist, bounds are invalid, an element of an input is listed twice, or
        the scenario is not a whole number of actions long.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (declared so by gymnasium)

    def __init__(
        self,
        scenario: str | Path | Scenario,
        *,
        act: SignalBounds,
        observe: SignalBounds,
        reward: Reward,
        steps: int = 1,
        terminated: Callable[[StepRows], bool] | None = None,
        out: str | Path | None = None,
    ) -> None:
        self._scenario = scenario if isinstance(scenario, Scenario) else load(scenario)
        self._act = tuple(act)
        self._observe = tuple(observe)
        callable_argument("reward", reward)
        callable_argument("terminated", terminated)
        self._reward = reward
        self._steps = steps
        self._terminated = terminated
        self._out = out
        self._seeded = _seeded(self._scenario)
        self._problem = "there is no episode yet"  # why no step can be taken
        self._is_closed = False
        self._session = self._scenario.start()
        try:
            self._check_steps()
            self._low, self._high = self._bounds("act", act)
            self.action_space = _box(self._low, self._high)
            self.observation_space = _box(*self._bounds("observe", observe))
            self._parts = self._input_parts()
        except BaseException:
            self._session.close()
            raise

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        """Start an episode; the same ``seed`` gives the same episode.

        Raises
        ------
        UsageError
            If the environment is closed.
        """
        if self._is_closed:
            raise UsageError("reset: this environment is closed; make a new one")
        super().reset(seed=seed)
        if self._seeded or (self._out is not None and not self._session.logs):
            self._session.close()
            self._session = self._next_session()
        else:
            self._session.reset()
        self._problem = ""
        return self._observation(), self._info()

    def step(
        self, action: NDArray[np.float64]
    ) -> tuple[Vector, SupportsFloat, bool, bool, dict[str, Any]]:
        """Take an action: override the inputs, and advance.

        Returns
        -------
        observation, reward, terminated, truncated, info
            ``info`` has the current time, ``t_ns``.

        Raises
        ------
        UsageError
            If the action does not fit, or the episode has ended.
        RunError
            If the run fails.
        """
        session = self._session
        if self._problem:
            raise UsageError(f"step: {self._problem}; call reset() first")
        values = self._checked(action)
        for to, part in self._parts.items():
            session[to] = values[part]
        is_over = False
        try:
            rows = session.step(self._steps)
        except Stopped as stop:
            if stop.failed or session.rows is None:
                raise
            rows = session.rows
            is_over = True
        if self._terminated is not None:
            is_over = is_over or bool(self._terminated(rows))
        truncated = not session.steps_left and not is_over
        if is_over or truncated:
            self._problem = "the episode has ended"
        return self._observation(), float(self._reward(rows)), is_over, truncated, self._info()

    def close(self) -> None:
        """Close the session; complete its log."""
        self._is_closed = True
        self._session.close()

    @property
    def session(self) -> Session:
        """The session of this episode."""
        return self._session

    def _next_session(self) -> Session:
        seeds = self.np_random.integers(SEEDS, size=len(self._seeded)).tolist()
        changes = dict(zip(self._seeded, seeds, strict=True))
        return self._scenario.edit(set=changes).start(out=self._out, numbered=self._out is not None)

    def _observation(self) -> Vector:
        return np.concatenate([self._session[name] for name in self._observe])

    def _info(self) -> dict[str, Any]:
        return {"t_ns": self._session.t_ns}

    def _checked(self, action: NDArray[np.float64]) -> Vector:
        """Return an action that fits the action space."""
        try:
            values = np.asarray(action, np.float64)
        except (TypeError, ValueError) as error:
            raise UsageError(f"action: expected numbers, got {kind_of(action)}") from error
        if values.shape != self._low.shape:
            raise UsageError(
                f"action: expected shape {self._low.shape} ({', '.join(self._act)}), got "
                f"{values.shape}"
            )
        is_inside = (values >= self._low) & (values <= self._high)
        if not is_inside.all():
            first = int(is_inside.argmin())
            low = float(self._low[first])
            high = float(self._high[first])
            raise UsageError(
                f"action[{first}]: expected {low} to {high}, got {float(values[first])}"
            )
        return values

    def _check_steps(self) -> None:
        total = self._session.steps_left
        is_whole = isinstance(self._steps, Integral) and not isinstance(self._steps, bool)
        if not is_whole or self._steps < 1 or total % self._steps:
            raise UsageError(
                f"steps: expected a whole number of communication steps that divides the {total} "
                f"steps of the scenario, got {self._steps!r}"
            )

    def _input_parts(self) -> dict[str, slice]:
        """Return which elements of an action belong to which input."""
        parts = {}
        start = 0
        for name in self._act:
            values = self._session[name]
            before = self._session.overrides
            self._session[name] = np.zeros(len(values))  # refuses what is no input
            if len(self._session.overrides) < len(before) + len(values):
                raise UsageError(
                    f"act: '{name}' has elements of another input of the action; expected every "
                    "element once"
                )
            parts[name] = slice(start, start + len(values))
            start += len(values)
        return parts

    def _bounds(self, key: str, signals: SignalBounds) -> tuple[Vector, Vector]:
        """Return the lowest and highest values of signals, one after the other."""
        if not signals or isinstance(signals, str):
            raise UsageError(f"{key}: expected a list of signal names, got {signals!r}")
        low: list[float] = []
        high: list[float] = []
        for name in signals:
            bounds = signals[name] if isinstance(signals, Mapping) else (-np.inf, np.inf)
            lowest, highest = _checked_bounds(key, name, bounds)
            size = len(self._session[name])
            low += [lowest] * size
            high += [highest] * size
        return np.array(low), np.array(high)


def _box(low: Vector, high: Vector) -> gymnasium.Space[NDArray[np.float64]]:
    """Return a space of vectors between bounds."""
    return cast("gymnasium.Space[NDArray[np.float64]]", Box(low, high, dtype=np.float64))


def _checked_bounds(key: str, name: str, bounds: tuple[float, float]) -> tuple[float, float]:
    try:
        lowest, highest = map(float, bounds)
    except (TypeError, ValueError) as error:
        raise UsageError(
            f"{key}: expected (lowest, highest) as the bounds of '{name}', got {bounds!r}"
        ) from error
    if not lowest < highest:
        raise UsageError(
            f"{key}: expected lowest <= highest for '{name}', got {lowest} to {highest}"
        )
    return lowest, highest


def _seeded(scenario: Scenario) -> list[str]:
    """Return the keys of the seeds in the components' tables."""
    keys = []
    for name, table in scenario.tree["components"].items():
        if table.get("seed") is not None:
            keys.append(f"components.{name}.seed")
    return keys
