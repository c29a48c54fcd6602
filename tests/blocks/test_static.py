"""Components without memory, by a function in Python."""

import numpy as np

from cosim.blocks.source import Expression
from cosim.blocks.static import Static
from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.signals import Interface, Signal
from cosim.core.simulation import Simulation

SCALAR = Interface((Signal("u"),), (Signal("y"),), {"y": ("u",)})


def test_a_session_goes_back_over_a_component_without_memory():
    """Of a dead zone from -1 to 1 behind u = t: y = max(t - 1, 0), each time it is stepped."""
    zone = Static(SCALAR, lambda u: u - np.clip(u, -1.0, 1.0))
    components = {"u": Expression(["t"]), "zone": zone}
    simulation = Simulation(Graph(components, {"zone.u": "u.y"}), Clock(10.0, 0.5))
    simulation.step(1)
    state = simulation.state
    for _ in range(2):
        assert simulation.step(3)["zone.y"][:, 0].tolist() == [0.0, 0.5, 1.0]
        simulation.state = state


def test_a_linearization_is_local_where_it_does_not_hold_far_away():
    """By outputs near, far and farther; where it is not defined there it is local, too."""
    functions = {
        "a line": (lambda u: 3.0 * u + 1.0, False),
        "a square": (lambda u: u**2, True),
        "a limit": (lambda u: np.clip(u, -500.0, 500.0), True),
        "a modulus": (np.abs, True),
        "a root": (lambda u: np.sqrt(u + 2.0), True),
    }
    interface = Interface((Signal("u"),), (Signal("y"),), {"y": ("u",)})
    for name, (function, is_local) in functions.items():
        own = Static(interface, function).linearized(0.0, np.zeros(1))
        assert own.is_local == is_local, name
