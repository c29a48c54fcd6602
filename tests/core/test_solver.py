"""Solvers over one communication step, against closed forms."""

import math

import numpy as np
import pytest

from cosim.core.signals import Interface, Signal
from cosim.core.solver import ADAPTIVE, LinearModel, feedthrough_of, integrator, rk4
from cosim.errors import GraphError, RunError


def relax(t, x, u):
    """Give x' = -2 x + u."""
    return -2.0 * x + u


def exact(t, x0, u0, slope):
    """Solve x' = -2 x + u0 + slope t."""
    steady = u0 / 2.0 - slope / 4.0
    return (x0 - steady) * math.exp(-2.0 * t) + steady + slope * t / 2.0


def test_rk4_is_of_fourth_order():
    """Halving the step divides the error of one second by 16; the inputs move on straight lines."""

    def error(steps):
        h, x = 1.0 / steps, np.array([1.5])
        for k in range(steps):
            x = rk4(relax, k * h, (k + 1) * h, x, np.array([0.3 + 2.0 * k * h]), np.array([0.3 + 2.0 * (k + 1) * h]))
        return abs(x[0] - exact(1.0, 1.5, 0.3, 2.0))

    assert 14.0 < error(20) / error(40) < 18.0


@pytest.mark.parametrize("method", ADAPTIVE)
def test_adaptive_solvers_keep_their_tolerance(method):
    """At the end of a step of half a second with the input on a straight line, within a hundred times the tolerance."""
    x = integrator(method)(relax, 1.0, 1.5, np.array([1.5]), np.array([0.3]), np.array([1.3]))
    # the tolerance 1e-9 holds for each of some dozens of inner steps, whose errors add up
    assert abs(x[0] - exact(0.5, 1.5, 0.3, 2.0)) < 1e-7


def test_a_solver_that_fails_says_so_in_its_own_words():
    """x' = x^2 from 1 has no value at t = 1."""
    with pytest.raises(RunError, match="solver RK45: Required step size is less than spacing between numbers"):
        integrator("RK45")(lambda t, x, u: x * x, 0.0, 2.0, np.ones(1), np.zeros(0), np.zeros(0))


def test_feedthrough_is_read_off_the_blocks_of_d():
    """Any nonzero number in the block of an output and an input."""
    interface = Interface((Signal("a", 2), Signal("b")), (Signal("y"), Signal("z", 2)))
    D = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
    assert feedthrough_of(interface, D) == {"y": ("a",), "z": ("b",)}


def test_a_matrix_of_the_wrong_shape_is_refused():
    """By name, with both shapes."""
    interface = Interface((Signal("u"),), (Signal("y"),))
    eye, zero = np.eye(1), np.zeros((1, 1))
    with pytest.raises(GraphError, match=r"matrix C: found shape \(1, 2\), needed \(1, 1\)"):
        LinearModel(interface, ("x",), eye, eye, np.ones((1, 2)), zero, np.zeros(1), zero)
