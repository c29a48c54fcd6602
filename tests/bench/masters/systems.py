"""The systems that the masters run: lags in a ring and in a chain, and their closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, lil_array
from scipy.sparse.linalg import expm_multiply

from cosim.arrays import Matrix

STEP_NS = 1_000_000  # communication step [ns]


@dataclass(frozen=True)
class Lag:
    """A lag ``y' = gain u + bias - y`` from y = 0; ``source`` is the number of the lag behind u."""

    gain: float
    bias: float
    source: int | None


@dataclass(frozen=True)
class System:
    """Lags by their numbers, in the order in which they are stepped."""

    name: str
    lags: tuple[Lag, ...]

    def exact(self, steps: Sequence[int]) -> Matrix:
        """Return the outputs behind some numbers of steps, increasing, in closed form.

        Shape (number of them, n).
        """
        n = len(self.lags)
        augmented = lil_array((n + 1, n + 1))  # by a state that is 1
        for i, lag in enumerate(self.lags):
            augmented[i, i] = -1.0
            augmented[i, n] = lag.bias
            if lag.source is not None:
                augmented[i, lag.source] = lag.gain
        rates = csc_array(augmented)
        state = np.zeros(n + 1)
        state[n] = 1.0
        rows = []
        for distance in np.diff(steps, prepend=0).tolist():
            state = expm_multiply(rates * (distance * STEP_NS / 1e9), state)
            rows.append(state[:n])
        return np.array(rows)

    def error(self, samples: Sequence[tuple[int, Sequence[float]]]) -> float:
        """Return the largest distance from the closed form of outputs behind numbers of steps."""
        outputs = np.array([row for _, row in samples])
        exact = self.exact([step for step, _ in samples])
        return float(np.abs(outputs - exact).max())


def ring(count: int) -> System:
    """Return lags in a ring that oscillate and decay slowly: the first one gets a step."""
    lags = []
    for i in range(count):
        lags.append(Lag(gain=-1.9, bias=0.0 if i else 1.0, source=(i - 1) % count))
    return System(f"ring-{count}", tuple(lags))


def chain(count: int) -> System:
    """Return lags in a chain: the first one gets a step."""
    lags = [Lag(gain=1.0, bias=1.0, source=None)]
    for i in range(1, count):
        lags.append(Lag(gain=1.0, bias=0.0, source=i - 1))
    return System(f"chain-{count}", tuple(lags))
