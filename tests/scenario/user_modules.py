"""Components as users write them, for scenarios of tests."""

import textwrap

from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document

RELAY = '''
import numpy as np

from cosim.core import Interface, Signal


class Relay:
    """y is 1 once u falls below -width, 0 once it rises above width."""

    interface = Interface(inputs=(Signal("u"),), outputs=(Signal("y", variability="discrete"),))

    def __init__(self, width: float):
        self.width = width

    def initialize(self, t, u):
        self.on = False
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([float(self.on)])

    def advance(self, t, h, u):
        y = np.empty((len(t) - 1, 1))
        for k in range(len(y)):
            if abs(u[k, 0]) > self.width:
                self.on = bool(u[k, 0] < 0.0)
            y[k] = self.on
        return y
'''

THERMOSTAT = """\
[scenario]
name = "thermostat"
stop = 60.0
step = 0.1

[components]
room = { kind = "lag", time_constant = 10.0, initial = 15.0 }

[components.relay]
kind = "python"
class = "relay:Relay"
width = 0.5

[connections]
"room.u" = { from = "relay.y", gain = 15.0, offset = 10.0 }
"relay.u" = { from = "room.y", offset = -20.0 }
"""

ONE = """\
[scenario]
name = "one"
stop = 1.0
step = 0.25

[components.u]
kind = "ramp"
slope = 1.0

[components.own]
kind = "python"
class = "own:Own"
{parameters}

[connections]
"own.u" = "u.y"
"""

OWN = """
import numpy as np

from cosim.core import Interface, Signal


class Own:
    interface = Interface((Signal("u"),), (Signal("y"),), feedthrough={{"y": ("u",)}})

    def __init__(self{parameters}):
        {constructor}

    def initialize(self, t, u):
        {initialize}
        return 2.0 * u

    def outputs(self, t, u):
        {outputs}
        return 2.0 * u

    def advance(self, t, h, u):
        {advance}
        return 2.0 * u[1:]
"""


def own_module(folder, parameters="", **bodies):
    """Write ``own.py``, whose component doubles u; ``bodies`` are what its methods do first."""
    methods = dict.fromkeys(("constructor", "initialize", "outputs", "advance"), "pass") | bodies
    (folder / "own.py").write_text(OWN.format(parameters=parameters, **methods))


def one(folder, parameters=""):
    """Return the scenario of one component, that of ``own.py``."""
    return parse(Document(ONE.format(parameters=parameters), "one.toml", folder))


def write(folder, **modules):
    """Write modules by name."""
    folder.mkdir(exist_ok=True, parents=True)
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(textwrap.dedent(text))
