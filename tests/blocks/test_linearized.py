"""Components linearized where they start: their steps move small deviations as they say."""

import numpy as np
import pytest

from cosim.blocks.declared import with_units
from cosim.blocks.dynamics import Delay, integrator, lag
from cosim.blocks.limited_integrator import LimitedIntegrator
from cosim.blocks.look_up import LookUpTable
from cosim.blocks.pid import Pid, PidParameters
from cosim.blocks.product import Product
from cosim.blocks.sampled import Decimated, Sampled
from cosim.blocks.sensor import Sensor, SensorParameters
from cosim.blocks.source import sine
from cosim.blocks.static import Static
from cosim.core.contracts import linearized, prepare
from cosim.core.gain.member_step import member_step, phase_of
from cosim.core.linear import Linear
from cosim.core.linearization import Linearized
from cosim.core.signals import Interface, Signal
from cosim.errors import GraphError
from tests.blocks.parts import discrete, through
from tests.blocks.renaming import CASES, renamed

H = 1e-3
STEPS = 12


def pid(**more):
    times = {"integral_time": 0.01, "derivative_time": 0.005}
    return Pid(PidParameters(2.0, lower=-1e3, upper=1e3, **times, **more))


def sampled_pid():
    times = {"integral_time": 0.05, "derivative_time": 0.01, "derivative_setpoint_weight": 0.5}
    return Pid(PidParameters(-2.0, setpoint_weight=0.3, **times), period=4 * H)


def squares():
    inputs = (Signal("u", 2),)
    interface = Interface(inputs, (Signal("y"),), {"y": ("u",)})
    return Static(interface, lambda u: (u**2).sum(axis=1, keepdims=True))


COMPONENTS = {
    "lag": lambda: Linear(lag(time_constant=0.01, size=2)),
    "integrator": lambda: Linear(integrator(size=2)),
    "feedthrough": through,
    "limited integrator": lambda: LimitedIntegrator(lower=-1e3, upper=2e3, size=2),
    "PID": pid,
    "PID with all weights": lambda: pid(setpoint_weight=0.3, derivative_setpoint_weight=0.5),
    "sampled PID": lambda: Sampled(sampled_pid(), 4, hold=True),
    "product": lambda: Product("*/", size=2),
    "table": lambda: LookUpTable(
        [np.array([-9.0, 0.0, 9.0])], np.array([3.0, -1.0, 4.0]), extrapolation="linear"
    ),
    "static": squares,
    "delay": lambda: Delay(3, size=2),
    "discrete": discrete,
    "sampled discrete": lambda: Sampled(discrete(), 3, hold=True),
    "sampled": lambda: Sampled(through(), 3),
    "sampled with hold": lambda: Sampled(through(), 4, hold=True),
    "sampled at every step": lambda: Sampled(through(), 1),
    "decimated": lambda: Decimated(through(), 4),
    "decimated at every step": lambda: Decimated(through(), 1),
    "in other units": lambda: with_units(Linear(lag(time_constant=0.01)), {"y": "degC"}),
    "sensor": lambda: Sensor(SensorParameters(noise=0.1, bias=0.5, seed=1), size=2),
    "sensor with a delay": lambda: Sensor(SensorParameters(delay=3.0), size=2),
    "sensor with a period": lambda: Sensor(SensorParameters(noise=0.1, period=4, seed=1)),
    "renamed": lambda: renamed(CASES["vectors"]),
    "elements renamed": lambda: renamed(CASES["elements of a vector"]),
}


def rows_of(make, held, u):
    """Return the outputs of a run, one step a call, with outputs evaluated at the end of each."""
    component = make()
    prepare(component, H, held, {})
    component.initialize(0.0, u[0])
    component.outputs(0.0, u[0])
    t = H * np.arange(len(u))
    return np.array(
        [component.advance(t[k : k + 2], H, u[k : k + 2])[0].copy() for k in range(len(u) - 1)]
    )


@pytest.mark.parametrize("name", COMPONENTS)
def test_a_linearized_step_moves_deviations_as_the_component_does(name):
    """Two runs with inputs that differ by little differ by what the linearized steps say."""
    for hold in (False, True):
        check_deviations(name, hold=hold)


def check_deviations(name, *, hold):
    """Compare two runs, with held inputs or without."""
    make = COMPONENTS[name]
    component = make()
    n_u = component.interface.n_u
    held = np.full(n_u, hold)
    rng = np.random.default_rng(3)
    u = np.tile(0.3 + 0.1 * rng.random(n_u), (STEPS + 1, 1))
    small = 1e-5 * rng.standard_normal((STEPS + 1, n_u))
    small[0] = 0.0  # both start at the operating point
    prepare(component, H, held, {})
    component.initialize(0.0, u[0])
    local = linearized(component, 0.0, u[0])
    expected = rows_of(make, held, u + small) - rows_of(make, held, u)
    state = None
    for k in range(STEPS):
        step = member_step(local, H, held, phase_of(local, k))
        state = np.zeros((step.n_s, 1)) if state is None else state
        u0, u1 = small[k][:, np.newaxis], small[k + 1][:, np.newaxis]
        state, y = step.advance(state, u0, u1)
        # the square of the deviations, which the linearization leaves out, and rounding
        assert np.allclose(y[:, 0], expected[k], rtol=1e-4, atol=1e-9), k


def test_an_integrator_at_its_limit_does_not_move():
    """Its input points out of the limit: small changes of it change nothing."""
    component = LimitedIntegrator(lower=0.0, size=2)
    prepare(component, H, np.zeros(2, np.bool_), {})
    u = np.array([-1.0, 1.0])
    component.initialize(0.0, u)
    assert linearized(component, 0.0, u).B.tolist() == [[0.0, 0.0], [0.0, 1.0]]


@pytest.mark.parametrize(
    "make",
    [
        lambda: Sampled(Sampled(through(), 2), 3),
        lambda: Decimated(Sampled(through(), 2), 3),
        lambda: Decimated(Delay(2), 2),
        lambda: sine(amplitude=1.0, rate=1.0),
        lambda: Sensor(SensorParameters(delay=0.4)),
        lambda: Sensor(SensorParameters(dropout=0.4, seed=1)),
    ],
)
def test_components_with_steps_of_several_kinds_are_not_linearized(make):
    """None, in place of numbers that are not its own."""
    component = make()
    n_u = component.interface.n_u
    prepare(component, H, np.zeros(n_u, np.bool_), {})
    component.initialize(0.0, np.zeros(n_u))
    assert linearized(component, 0.0, np.zeros(n_u)) is None


def test_matrices_that_do_not_fit_together_are_refused():
    """With the name of the matrix, found and needed shape."""
    square = np.zeros((2, 2))
    with pytest.raises(GraphError, match=r"linearized: B:.*shape \(2, 1\).*\(2, 2\)"):
        Linearized(square, square, np.zeros((1, 2)), np.zeros((1, 1)))
