"""Loops that iterate: order of convergence, algebraic loops, what cannot be solved."""

import numpy as np
import scipy.linalg

from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory


def state_space(A, B, C, D, x0):
    matrices = [np.array([[value]], np.float64) for value in (A, B, C, D)]
    names = dict(zip("ABCD", matrices, strict=True))
    return Linear(controller(**names, x0=np.array([x0], np.float64)))


def pair(coupling="newton", d2=-0.9, **options):
    """x1' = -0.9 x1 + 0.5 u1, y1 = 3 x1 + u1; x2' = -x2 + 10 u2, y2 = -31 x2 + d2 u2."""
    components = {
        "one": state_space(-0.9, 0.5, 3.0, 1.0, 1.0),
        "two": state_space(-1.0, 10.0, -31.0, d2, 1.0),
    }
    connections = {"one.u": "two.y", "two.u": "one.y"}
    return Graph(components, connections, coupling=coupling, **options)


def solution(t, d2=-0.9):
    """Return (x1, x2) of the pair, its algebraic loop eliminated."""
    A = np.diag([-0.9, -1.0])
    B = np.diag([0.5, 10.0])
    C = np.diag([3.0, -31.0])
    D = np.diag([1.0, d2])
    swap = np.array([[0.0, 1.0], [1.0, 0.0]])
    u_of_x = np.linalg.solve(np.eye(2) - swap @ D, swap @ C)
    return scipy.linalg.expm((A + B @ u_of_x) * t) @ np.ones(2)


def record(graph, stop=1.0, step=0.01, block=None):
    memory = Memory()
    run(graph, Clock(stop, step, block), memory)
    return memory


def states(memory):
    return np.array([memory["one.x"][-1], memory["two.x"][-1]])


def test_initial_values_solve_the_algebraic_loop():
    """By hand: u1 = y2, u2 = y1 at x = (1, 1)."""
    memory = record(pair(), stop=0.01)
    found = [memory["one.u"][0], memory["two.u"][0]]
    expected = [-17.736842105263158, -14.736842105263158]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_newton_is_second_order_through_an_algebraic_loop():
    """The reference is the matrix exponential of the coupled system."""
    np.testing.assert_allclose(
        solution(1.0), [0.08597640367353255, 0.00839266482037434], rtol=1e-12
    )
    errors = []
    for step in (0.01, 0.005, 0.0025, 0.00125):
        error = states(record(pair(), step=step)) - solution(1.0)
        errors.append(np.abs(error).max())
    assert errors[0] < 1e-5
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(orders, 2.0, atol=0.1)
    assert np.abs(states(record(pair(), step=0.001)) - solution(1.0)).max() < 1e-7
