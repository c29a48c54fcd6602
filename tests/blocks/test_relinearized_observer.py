"""The observer that is designed anew at its estimate, on plants in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cosim.arrays import Vector
from cosim.blocks.observer import observer_model
from cosim.blocks.relinearized_observer import RelinearizedObserver
from cosim.core.contracts import Stopped
from cosim.core.linear import Linear
from cosim.errors import RunError
from cosim.testing import check_component
from cosim.theory.observers.observer import design
from cosim.theory.plants.descriptor import ReducedSystem

H = 0.01
RATE = 50.0


def local_model(A, B, b, C, c, d) -> ReducedSystem:
    """Return x' = A x + B u + b delta + c, y = C x + d as a model with the constant 1."""
    n = len(A)
    return ReducedSystem(
        A_a=A,
        B_1a=np.column_stack([B, c]),
        B_2a=b,
        C3=C,
        C4=np.column_stack([np.zeros((len(C), 1)), d]),
        C5=np.zeros((len(C), 1)),
        Kx=np.zeros((0, n)),
        Ku=np.zeros((0, 2)),
        Kd=np.zeros((0, 1)),
    )


class Tank:
    """x1' = u - x1 |x1|, x2' = x1^2 - x2 + delta, y = x2: its slopes change with x1."""

    x = np.array([1.0, 0.5])
    delta = np.zeros(1)
    reach = np.inf

    def local(self, t: float, x: Vector, u: Vector, delta: Vector) -> ReducedSystem:
        """Linearize in closed form; beyond ``reach`` delta does not act any more."""
        gain = 1.0 if x[1] < self.reach else 0.0
        A = np.array([[-2.0 * abs(x[0]), 0.0], [2.0 * x[0], -1.0]])
        B = np.array([[1.0], [0.0]])
        b = np.array([[0.0], [gain]])
        C = np.array([[0.0, 1.0]])
        dx = np.array([u[0] - x[0] * abs(x[0]), x[0] ** 2 - x[1] + gain * delta[0]])
        c = dx - A @ x - B @ u - b @ delta
        return local_model(A, B, b, C, c, np.zeros(1))


class Plant:
    """The same matrices everywhere."""

    x = np.array([0.3, -0.2])
    delta = np.zeros(1)
    reduced = local_model(
        np.array([[-1.0, 0.5], [0.2, -2.0]]),
        np.array([[1.0], [0.5]]),
        np.array([[1.0], [0.0]]),
        np.array([[1.0, 0.3]]),
        np.array([0.1, -0.4]),
        np.array([0.7]),
    )

    def local(self, t: float, x: Vector, u: Vector, delta: Vector) -> ReducedSystem:
        """Return them."""
        return self.reduced


def designed(reduced: ReducedSystem):
    return design(reduced, L=np.array([[0.0], [3.0]]), filter_rate=RATE)


def observer(model, x_a0=None) -> RelinearizedObserver:
    first = model.local(0.0, model.x, np.zeros(1), model.delta)
    linear = observer_model(first, designed(first), constant=True)
    return RelinearizedObserver(model, designed, linear.interface, x_a0)


@pytest.mark.slow
def test_it_keeps_the_contract_of_a_component():
    """K steps are one step K times, outputs change nothing, restore undoes."""
    t = np.arange(7) * H
    inputs = np.column_stack([1.0 + np.sin(t), 0.5 + 0.1 * np.cos(3.0 * t)])
    check_component(lambda: observer(Tank()), inputs=inputs, h=H)


def test_of_a_linear_plant_it_is_the_observer_that_is_designed_once():
    """The same design at every point: what goes on from one to the next is all of the state."""
    model = Plant()
    x_a0 = np.array([1.0, 2.0])
    once = Linear(observer_model(model.reduced, designed(model.reduced), x_a0=x_a0, constant=True))
    anew = observer(model, x_a0)
    t = np.arange(201) * H
    u = np.column_stack([np.sin(t), np.cos(2.0 * t)])
    held = np.zeros(2, np.bool_)
    rows = []
    for component in (once, anew):
        component.prepare(H, held, {})
        rows.append(np.vstack([component.initialize(0.0, u[0]), component.advance(t, H, u)]))
    # rounding, which lambda_f = 50 multiplies in delta
    np.testing.assert_allclose(rows[1], rows[0], atol=1e-12)


def trajectory(t):
    """Return u, x and y of the tank with delta = sin(2 t), by steps of rk4 a tenth as long."""

    def rate(s, x):
        u = 1.0 + 0.5 * np.sin(s)
        return np.array([u - x[0] * abs(x[0]), x[0] ** 2 - x[1] + np.sin(2.0 * s)])

    x = np.empty((len(t), 2))
    x[0] = (1.2, 0.5)
    for k in range(len(t) - 1):
        s = t[k]
        now = x[k]
        h = (t[k + 1] - s) / 10.0
        for _ in range(10):
            k1 = rate(s, now)
            k2 = rate(s + 0.5 * h, now + 0.5 * h * k1)
            k3 = rate(s + 0.5 * h, now + 0.5 * h * k2)
            k4 = rate(s + h, now + h * k3)
            now = now + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            s += h
        x[k + 1] = now
    return 1.0 + 0.5 * np.sin(t), x


def settled_errors(model, h, output):
    """Return the largest errors of both states after 7 s, at a step of h, shape (2,)."""
    t = np.arange(round(8.0 / h) + 1) * h
    u, x = trajectory(t)
    component = observer(model, np.array([0.8, 0.5]))
    component.prepare(h, np.zeros(2, np.bool_), {})
    inputs = np.column_stack([u, output(x[:, 1])])
    component.initialize(0.0, inputs[0])
    rows = component.advance(t, h, inputs)
    settled = t[1:] > 7.0
    return np.abs(rows[settled, :2] - x[1:][settled]).max(axis=0)


@pytest.mark.slow
def test_its_estimate_is_of_second_order_in_the_step():
    """x1 is not in y: its error is that of the local models alone, and a half step quarters it."""
    coarse, fine = (settled_errors(Tank(), h, lambda x2: x2)[0] for h in (0.04, 0.02))
    assert 3.5 < coarse / fine < 4.5


class BentTank(Tank):
    """The same with y = x2 + 0.3 sin x2."""

    def local(self, t: float, x: Vector, u: Vector, delta: Vector) -> ReducedSystem:
        """Linearize y, too."""
        tank = super().local(t, x, u, delta)
        slope = 1.0 + 0.3 * np.cos(x[1])
        d = np.array([x[1] + 0.3 * np.sin(x[1]) - slope * x[1]])
        constant = np.column_stack([np.zeros((1, 1)), d])
        return replace(tank, C3=np.array([[0.0, slope]]), C4=constant)


@pytest.mark.slow
def test_where_y_is_no_straight_line_of_x_it_is_of_first_order():
    """What y bends within a step is taken for a motion of x: a half step halves the error."""
    errors = (settled_errors(BentTank(), h, lambda x2: x2 + 0.3 * np.sin(x2)) for h in (0.02, 0.01))
    coarse, fine = (error[1] for error in errors)
    assert 1.7 < coarse / fine < 2.3


def test_by_default_it_begins_next_to_the_state_of_the_model():
    """Of all states with C x = y(0) the closest: here x1 stays, and x2 is y."""
    component = observer(Tank())
    component.prepare(H, np.zeros(2, np.bool_), {})
    first = component.initialize(0.0, np.array([1.0, 0.9]))
    np.testing.assert_allclose(first[:2], [1.0, 0.9], atol=1e-14)


def test_a_condition_that_fails_on_the_way_stops_the_run():
    """The rows before it are there, and time, estimate and condition are named."""
    model = Tank()
    model.reach = 0.8
    component = observer(model)
    component.prepare(H, np.zeros(2, np.bool_), {})
    t = np.arange(101) * H
    inputs = np.column_stack([np.ones(101), 0.5 + t])
    component.initialize(0.0, inputs[0])
    text = r"linearized at the estimate x_a = \[\S+, 0\.8\] at t = 0\.3 s: .*DEPENDENT_DISTURBANCES"
    with pytest.raises(Stopped, match=text) as stopped:
        component.advance(t, H, inputs)
    assert stopped.value.steps == 29

    model.reach = 0.4
    with pytest.raises(RunError, match=r"at t = 0\.0 s: "):
        component.initialize(0.0, inputs[0])
