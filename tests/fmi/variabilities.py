"""A linear model with discrete and continuous inputs, and one that watches when they are set."""

import numpy as np

from cosim.core.linear import LinearModel
from cosim.core.signals import Interface, Signal
from cosim.fmi.generated import GeneratedInstance
from cosim.fmi.instance import DiscreteStates

A = np.array([[-1.0, 1.0], [-1.0, -2.0]])
X0 = np.array([1.0, -1.0])
C = np.array([[1.0, 0.0], [1.0, 0.0]])  # v feeds through, w is the state
VARIABILITIES = {
    "discrete": ("discrete",),
    "continuous": ("continuous",),
    "both": ("continuous", "discrete"),
}


def model(inputs) -> LinearModel:
    """x' = A x + B u, v = x_1 + u_1 (+ u_2), w = x_1: every input feeds through to v, none to w."""
    names = VARIABILITIES[inputs]
    n_u = len(names)
    signals = tuple(Signal(name[0], variability=name) for name in names)
    feedthrough = {"v": tuple(signal.name for signal in signals)}
    interface = Interface(signals, (Signal("v"), Signal("w")), feedthrough)
    B = np.ones((2, n_u))
    D = np.vstack([np.ones(n_u), np.zeros(n_u)])
    return LinearModel(interface, ("x[0]", "x[1]"), A, B, C, D, X0, np.zeros((2, n_u)))


class Watched:
    """A generated model that records discrete inputs set outside event mode.

    It may request the end of the run, in its event number ``end_at``.
    """

    def __init__(self, inputs, end_at=None):
        self._instance = GeneratedInstance.of(model(inputs), "watched")
        self._end_at = end_at
        self._events = 0
        self._in_event_mode = True
        self.misplaced = []
        variables = self._instance.description.variables
        self._discrete = {v.reference for v in variables if v.variability == "discrete"}

    def __getattr__(self, name):
        return getattr(self._instance, name)

    def enter_event_mode(self):
        self._in_event_mode = True
        self._instance.enter_event_mode()

    def enter_continuous_time_mode(self):
        self._in_event_mode = False
        self._instance.enter_continuous_time_mode()

    def set_float64(self, references, values):
        if not self._in_event_mode:
            for group in references.groups:
                self.misplaced += self._discrete.intersection(group.references.tolist())
        self._instance.set_float64(references, values)

    def update_discrete_states(self):
        self._events += 1
        return DiscreteStates(
            need_update=False, terminate=self._events == self._end_at, next_event_time=None
        )
