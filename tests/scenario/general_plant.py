"""A plant in the general form, with a coordinate change: that of the academic scenario."""

from __future__ import annotations

from pathlib import Path

import numpy as np

PARTITIONED = """\
n_a = 2
A = [[0, 1, 1], [0, -2, 1], [1, 0, 1]]
Bu = [[0], [2], [1]]
Bd = [[1], [0], [0]]
C = [[2, 0, 1]]
"""
MIXING_P = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, -1.0], [0.5, 0.0, 2.0]])  # of the equations
MIXING_Q = np.array([[1.0, 0.0, 0.5], [1.0, 2.0, 0.0], [0.0, -0.5, 1.0]])  # x of the form = Q x
E = MIXING_P @ np.diag([1.0, 1.0, 0.0]) @ MIXING_Q
A = MIXING_P @ np.array([[0.0, 1, 1], [0, -2, 1], [1, 0, 1]]) @ MIXING_Q
B = MIXING_P @ np.array([[1.0, 0.0], [0.0, 2.0], [0.0, 1.0]])
C = np.array([[2.0, 0.0, 1.0]]) @ MIXING_Q
X0 = np.linalg.solve(MIXING_Q, [1.0, -1.0, -1.0])  # u(0) = 0: x_b(0) = -x1


def rows(matrix):
    """Write a matrix in TOML."""
    return repr(np.asarray(matrix).tolist())


GENERAL = f"""\
E = {rows(E)}
A = {rows(A)}
B = {rows(B)}
C = {rows(C)}
disturbances = [0]
"""

SCENARIO = """
scenario = {{ name = "general", stop = 4.0, step = 1e-2 }}
[models.m]
{model}
[components]
u = {{ kind = "sine", rate = 1.0 }}
delta = {{ kind = "sine", amplitude = 0.5, rate = 2.0 }}
[components.plant]
kind = "descriptor"
model = "m"
{initial}
[connections]
"plant.u" = "u.y"
"plant.delta" = "delta.y"
"""


def write(path: Path, model: str, initial: str, more: str = "") -> Path:
    """Write a scenario with a model and the initial states of its plant."""
    path.write_text(SCENARIO.format(model=model, initial=initial) + more, encoding="utf-8")
    return path
