"""Sum, gain, limit and switch: functions of the inputs at the same instant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.arrays import Matrix
from cosim.blocks.static import CompiledStatic
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError
from cosim.native.blocks.functions import gain_step, limit_step, sum_step, switch_step


def _with_feedthrough(inputs: Sequence[Signal], size: int, unit: str | None) -> Interface:
    """Return the interface whose output y feeds through from all inputs."""
    output = Signal("y", size, unit, "inherited")
    names = tuple(signal.name for signal in inputs)
    return Interface(tuple(inputs), (output,), {"y": names})


def sum_of(signs: Sequence[float], *, size: int = 1, unit: str | None = None) -> CompiledStatic:
    """Build ``y = sum_i signs_i u_i``: inputs ``u1``, ``u2``, ... of the same size.

    Raises
    ------
    UsageError
        If there are no signs.
    """
    if not signs:
        raise UsageError("sum: expected one sign per input, like [1, -1], got none")
    names = [f"u{i}" for i in range(1, len(signs) + 1)]
    inputs = [Signal(name, size, unit) for name in names]
    interface = _with_feedthrough(inputs, size, unit)
    signed = np.hstack([sign * np.eye(size) for sign in signs])
    return CompiledStatic(interface, sum_step(signs, size), gain=signed)


def gain(K: Matrix, *, unit: str | None = None) -> CompiledStatic:
    """Build ``y = K u`` for K of shape (n_y, n_u); the sum runs in a fixed order."""
    n_y, n_u = K.shape
    u = Signal("u", n_u)
    interface = _with_feedthrough([u], n_y, unit)
    return CompiledStatic(interface, gain_step(K), gain=K)


def limit(*, lower: float, upper: float, size: int = 1, unit: str | None = None) -> CompiledStatic:
    """Build ``y = min(max(u, lower), upper)``.

    Raises
    ------
    UsageError
        If lower is not below upper.
    """
    if not lower < upper:
        raise UsageError(f"limit: expected lower < upper, got lower = {lower} and upper = {upper}")
    u = Signal("u", size, unit)
    interface = _with_feedthrough([u], size, unit)
    return CompiledStatic(interface, limit_step(lower, upper, size))


def switch(
    *, threshold: float = 0.5, size: int = 1, discrete: bool = False, unit: str | None = None
) -> CompiledStatic:
    """Build ``y = u1`` where ``control >= threshold``, else ``y = u2``.

    Parameters
    ----------
    threshold : float
        With 0.5 the control may be a Boolean signal.
    size : int
        Number of elements of y, u1 and u2.
    discrete : bool
        y keeps its value over a communication step. Else it does so where all inputs do.
    unit : str, optional
        The unit of y, u1 and u2.
    """
    inputs = (Signal("u1", size, unit), Signal("u2", size, unit), Signal("control"))
    names = tuple(signal.name for signal in inputs)
    y = Signal("y", size, unit, "discrete" if discrete else "inherited")
    interface = Interface(inputs, (y,), {"y": names}, jumping=() if discrete else ("y",))
    return CompiledStatic(interface, switch_step(threshold, size))
