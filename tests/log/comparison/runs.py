"""Recordings made by hand, of one component."""

from __future__ import annotations

import numpy as np

from cosim.core.recorded.run import rows_within
from cosim.core.signals import Channel, Interface, Signal
from tests.log.recordings import STEP_NS


class Run:
    """A recording made by hand, of one component ``c``."""

    def __init__(self, values, times=None, events=()):
        self.metadata = {}
        self._events = list(events)
        self.status = "complete"
        self.reason = ""
        self._signals = {}
        declared = []
        for name, array in values.items():
            self._signals[name] = np.asarray(array, dtype=float)
            size = self._signals[name][0].size
            declared.append(Signal(name, size))
        if times is None:
            times = np.arange(len(next(iter(self._signals.values()))))
        self._times = np.asarray(times) * STEP_NS
        self.steps = len(self._times) - 1
        self.end_ns = int(self._times[-1]) if len(self._times) else 0
        self.channels = {"c": Channel("c", Interface((), tuple(declared)), 0)}

    def events(self):
        return self._events

    def blocks(self, component, *, first_ns=None, last_ns=None):
        assert component == "c"
        columns = [values.reshape(len(self._times), -1) for values in self._signals.values()]
        yield rows_within(self._times, np.hstack(columns), first_ns, last_ns)
