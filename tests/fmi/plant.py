"""The paper's reduced plant (28), its solution for inputs linear in time, and static ones."""

import numpy as np

from cosim.core.linear import LinearModel
from cosim.core.signals import Interface, Signal

A = np.array([[-1.0, 1.0], [-1.0, -2.0]])
B = np.array([[-1.0, 1.0], [1.0, 0.0]])
C = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
D = np.array([[-1.0, 0.0], [0.0, 0.0], [0.0, 0.0], [-1.0, 0.0]])
START = np.array([1.0, -1.0])
INTERFACE = Interface(
    (Signal("u", role="input"), Signal("delta", role="input")),
    (Signal("y"), Signal("x_a", 2, role="state"), Signal("x_b")),
    {"y": ("u",), "x_a": (), "x_b": ("u",)},
)
STATIC = Interface((Signal("u", 2, role="input"),), (Signal("y", 2),), {"y": ("u",)})
# u = U0 + SLOPE t
U0 = np.array([0.5, -1.0])
SLOPE = np.array([0.7, 1.5])
FREE = np.zeros(2, np.bool_)


def model() -> LinearModel:
    states = ("x_a[0]", "x_a[1]")
    return LinearModel(INTERFACE, states, A, B, C, D, START, np.zeros((2, 2)))


def static(interface: Interface, D) -> LinearModel:
    """Return y = D u, without a state."""
    n_y, n_u = D.shape
    nothing = np.zeros((0, n_u))
    return LinearModel(
        interface, (), np.zeros((0, 0)), nothing, np.zeros((n_y, 0)), D, np.zeros(0), nothing
    )


def inputs(t, slope=SLOPE):
    """Return inputs linear in time, so that a communication step hides nothing."""
    return U0 + np.multiply.outer(t, slope)


def transition(t: float):
    """Return exp(A t).

    A + 1.5 I squares to -3/4 I. So, with w = sqrt(3)/2,
    exp(A t) = exp(-1.5 t) (cos(w t) I + sin(w t)/w (A + 1.5 I)).
    """
    w = np.sqrt(3.0) / 2.0
    shifted = A + 1.5 * np.eye(2)
    oscillation = np.cos(w * t) * np.eye(2) + np.sin(w * t) / w * shifted
    return np.exp(-1.5 * t) * oscillation


def solution(t, slope=SLOPE):
    """Return the outputs (y, x_a, x_b) at the times t, shape (len(t), 4).

    The state is p0 + p1 t, which follows the inputs, plus the free motion.
    """
    p1 = -np.linalg.solve(A, B @ slope)
    p0 = np.linalg.solve(A, p1 - B @ U0)
    free = START - p0
    x = np.array([p0 + p1 * s + transition(s) @ free for s in t])
    return x @ C.T + inputs(t, slope) @ D.T


def run(
    component, *, step: float, stop: float = 2.0, blocks: int | None = None, held=FREE, u=inputs
):
    """Run a component from 0.

    Returns
    -------
    array, shape (steps + 1, n_y)
        The outputs at every communication point.
    """
    steps = round(stop / step)
    t = np.arange(steps + 1) * round(step * 1e9) / 1e9
    rows = u(t)
    component.prepare(step, held, {})
    outputs = [component.initialize(0.0, rows[0])[np.newaxis]]
    size = blocks or steps
    for k in range(0, steps, size):
        block = slice(k, k + size + 1)
        outputs.append(component.advance(t[block], step, rows[block]))
    return np.concatenate(outputs)


def grid(step: float, stop: float = 2.0):
    return np.arange(round(stop / step) + 1) * step
