"""Compiled steps of model exchange give the bits of the methods, and share their state."""

import numpy as np
import pytest

from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.master import simulate
from cosim.core.signals import Interface, Signal
from cosim.fmi.component import ModelExchange
from cosim.fmi.generated import GeneratedInstance
from tests.core.parts import integrator, times
from tests.fmi.test_contract import VARIABILITIES, Watched, model

STEPS = 60
H = 0.01
T = np.arange(STEPS + 1) * H


class Compiled:
    """A component that takes its compiled steps as a stage does, and the others as it always did.

    Attributes
    ----------
    taken : int
        Compiled steps.
    """

    def __init__(self, component):
        self.component = component
        self.taken = 0
        self._step = None

    def begin(self, u, held):
        """Initialize; return the first row."""
        self.component.prepare(H, held, {})
        self.component.initialize(0.0, u)
        y = self.component.outputs(0.0, u)
        self._step = self.component.native()
        return y

    def advance(self, k, end, u):
        """Return the rows of steps k to end."""
        rows = []
        while k < end:
            y = self._step.advance(T[k : end + 1], H, u[k : end + 1])
            rows.append(y)
            self.taken += len(y)
            k += len(y)
            if k < end:
                rows.append(self.component.advance(T[k : k + 2], H, u[k : k + 2]))
                k += 1
        return np.concatenate(rows)


class Plain(Compiled):
    """The same without compiled steps."""

    def begin(self, u, held):
        self.component.prepare(H, held, {})
        self.component.initialize(0.0, u)
        return self.component.outputs(0.0, u)

    def advance(self, k, end, u):
        return self.component.advance(T[k : end + 1], H, u[k : end + 1])


def inputs_of(names, seed=1):
    """Return inputs: what is discrete changes now and then, the rest at every step."""
    u = np.random.default_rng(seed).standard_normal((STEPS + 1, len(names)))
    for column, name in enumerate(names):
        if name == "discrete":
            u[:, column] = np.repeat(u[::7, column], 7)[: STEPS + 1]
    return u


def run(driven, u, held, size=STEPS):
    """Return all rows, in blocks of ``size`` steps."""
    rows = [driven.begin(u[0], held)[np.newaxis]]
    for k in range(0, STEPS, size):
        rows.append(driven.advance(k, min(k + size, STEPS), u))
    return np.concatenate(rows)


def exact(inputs):
    return ModelExchange(GeneratedInstance.of(model(inputs)), "exact")


def messages(component):
    return [(message.time, message.text) for message in component.drain()]


@pytest.mark.parametrize("inputs", VARIABILITIES)
def test_exact_steps_in_blocks_of_any_size(inputs):
    """Equal bits and the same events, whether compiled or not.

    The change of a discrete input is an event, wherever in a block it comes.
    """
    names = VARIABILITIES[inputs]
    u = inputs_of(names)
    held = np.zeros(len(names), np.bool_)
    plain = Plain(exact(inputs))
    expected = run(plain, u, held)
    events = messages(plain.component)
    assert len(events) == (0 if inputs == "continuous" else STEPS // 7)
    for size in (1, 7, STEPS):
        other = Plain(exact(inputs))
        assert run(other, u, held, size).tobytes() == expected.tobytes()
        assert messages(other.component) == events
        compiled = Compiled(exact(inputs))
        assert run(compiled, u, held, size).tobytes() == expected.tobytes()
        assert messages(compiled.component) == events
        assert compiled.taken == STEPS - len(events)


@pytest.mark.parametrize("inputs", VARIABILITIES)
def test_exact_outputs_and_states_between_compiled_steps(inputs):
    """The methods show the time reached; a state goes back over compiled steps."""
    names = VARIABILITIES[inputs]
    u = inputs_of(names)
    held = np.zeros(len(names), np.bool_)
    expected = run(Plain(exact(inputs)), u, held)
    compiled = Compiled(exact(inputs))
    compiled.begin(u[0], held)
    compiled.advance(0, 20, u)
    component = compiled.component
    assert component.outputs(T[20], u[20]).tobytes() == expected[20].tobytes()
    state = component.save()
    rows = compiled.advance(20, 50, u)
    assert rows.tobytes() == expected[21:51].tobytes()
    for _ in range(2):
        component.restore(state)
        assert component.outputs(T[20], u[20]).tobytes() == expected[20].tobytes()
        assert compiled.advance(20, 50, u).tobytes() == rows.tobytes()
    assert component.outputs(T[50], u[50]).tobytes() == expected[50].tobytes()
    assert compiled.advance(50, STEPS, u).tobytes() == expected[51:].tobytes()
    assert component.initialize(0.0, u[0]).tobytes() == expected[0].tobytes()
    component.outputs(0.0, u[0])
    assert compiled.advance(0, STEPS, u).tobytes() == expected[1:].tobytes()


def test_exact_steps_are_declined_before_the_initialization_is_over_and_after_the_end():
    """Then the methods do what they always did: leave the initialization, and stop."""
    component = ModelExchange(Watched("discrete", end_at=2), "exact")
    component.prepare(H, np.zeros(1, np.bool_), {})
    u = np.zeros((STEPS + 1, 1))
    component.initialize(0.0, u[0])
    step = component.native()
    assert len(step.advance(T, H, u)) == 0
    component.advance(T[:2], H, u[:2])
    assert len(step.advance(T[1:4], H, u[1:4])) == 2
    component.outputs(T[3], u[3] + 1.0)  # an event, which asks for the end
    assert len(step.advance(T[3:], H, u[3:])) == 0


class Pulses:
    """A discrete source in Python, which changes at every seventh step."""

    interface = Interface((), (Signal("y", variability="discrete"),))

    def initialize(self, t, u):
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([float(round(t / H) // 7 % 3)])

    def advance(self, t, h, u):
        return np.array([self.outputs(time, u) for time in t[1:]])


def graph(plant, coupling, native):
    """Return a plant in a loop with a gain, where it goes first, and a lag behind them."""
    components = {"plant": plant, "gain": times(-0.5), "lag": integrator(3.0), "pulses": Pulses()}
    connections = {
        "plant.c": "gain.y",
        "plant.d": "pulses.y",
        "gain.u": "plant.w",
        "lag.u": "plant.v",
    }
    return Graph(components, connections, coupling=coupling, native=native)


def signals_of(system, block):
    """Return all rows of a graph."""
    rows = []
    for _, signals in simulate(system, Clock(STEPS * H, H, block)):
        rows.append(signals[1:].copy())
    return np.concatenate(rows)


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
def test_exact_plants_in_loops(coupling):
    """Whatever the block size, with the outputs that feed through refreshed, and the events."""
    plant = exact("both")
    expected = signals_of(graph(plant, coupling, False), STEPS)
    events = messages(plant)
    for block in (1, 7, STEPS):
        plant = exact("both")
        assert signals_of(graph(plant, coupling, True), block).tobytes() == expected.tobytes()
        assert messages(plant) == events
