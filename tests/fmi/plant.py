"""The paper's reduced plant (28), and its solution in closed form for inputs that are straight lines."""

import numpy as np

from cosim.core.linear import LinearModel
from cosim.core.signals import Interface, Signal

A = np.array([[-1.0, 1.0], [-1.0, -2.0]])
B = np.array([[-1.0, 1.0], [1.0, 0.0]])
C = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
D = np.array([[-1.0, 0.0], [0.0, 0.0], [0.0, 0.0], [-1.0, 0.0]])
START = np.array([1.0, -1.0])
FACE = Interface(
    (Signal("u", role="input"), Signal("delta", role="input")),
    (Signal("y"), Signal("x_a", 2, role="state"), Signal("x_b")),
    {"y": ("u",), "x_a": (), "x_b": ("u",)},
)
U0, SLOPE = np.array([0.5, -1.0]), np.array([0.7, 1.5])  # u = U0 + SLOPE t
FREE = np.zeros(2, np.bool_)


def model() -> LinearModel:
    return LinearModel(FACE, ("x_a[0]", "x_a[1]"), A, B, C, D, START, np.zeros((2, 2)))


def inputs(t, slope=SLOPE):
    """Straight lines, so that a communication step hides nothing."""
    return U0 + np.multiply.outer(t, slope)


def transition(t: float):
    """exp(A t): A + 1.5 I squares to -3/4 I, so exp(A t) = exp(-1.5 t) (cos(w t) I + sin(w t)/w (A + 1.5 I)), w = sqrt(3)/2."""
    w = np.sqrt(3.0) / 2.0
    return np.exp(-1.5 * t) * (
        np.cos(w * t) * np.eye(2) + np.sin(w * t) / w * (A + 1.5 * np.eye(2))
    )


def solution(t, slope=SLOPE):
    """Give the outputs (y, x_a, x_b) at the times t: a straight line plus the free motion; shape (len(t), 4)."""
    p1 = -np.linalg.solve(A, B @ slope)
    p0 = np.linalg.solve(A, p1 - B @ U0)
    x = np.array([p0 + p1 * s + transition(s) @ (START - p0) for s in t])
    return x @ C.T + inputs(t, slope) @ D.T


def run(
    component, *, step: float, stop: float = 2.0, blocks: int | None = None, held=FREE, u=inputs
):
    """Run a component from 0; outputs at every communication point, shape (steps + 1, n_y)."""
    steps = round(stop / step)
    t = np.arange(steps + 1) * round(step * 1e9) / 1e9
    rows = u(t)
    component.prepare(step, held, {})
    found = [component.initialize(0.0, rows[0])[np.newaxis]]
    size = blocks or steps
    for k in range(0, steps, size):
        found.append(component.advance(t[k : k + size + 1], step, rows[k : k + size + 1]))
    return np.concatenate(found)


def grid(step: float, stop: float = 2.0):
    return np.arange(round(stop / step) + 1) * step
