"""Small scenarios with code of users, for certificates."""

from pathlib import Path
from textwrap import dedent

from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document

MODULE = '''
import numpy as np

from cosim.core import Interface, Signal


class Static:
    """Outputs without a memory."""

    def initialize(self, t, u):
        return self.outputs(t, u)

    def advance(self, t, h, u):
        return np.array([self.outputs(*point) for point in zip(t[1:], u[1:])])


class Jump(Static):
    """y = sin t, and a jump at an instant that it tells nobody of."""

    interface = Interface((), (Signal("y"),))

    def __init__(self, time: float):
        self.time = time

    def outputs(self, t, u):
        return np.array([np.sin(t) + (t >= self.time)])


class Holder(Static):
    """y is sin t at the last multiple of a time that it tells nobody of."""

    interface = Interface((), (Signal("y", variability="discrete"),))

    def __init__(self, time: float):
        self.time = time

    def outputs(self, t, u):
        return np.array([np.sin(np.floor(t / self.time + 1e-9) * self.time)])


class Relay(Static):
    """y = -sign(u): in a loop it switches at every step."""

    interface = Interface((Signal("u"),), (Signal("y"),), feedthrough={"y": ("u",)})

    def outputs(self, t, u):
        return -np.sign(u)


class Echo:
    """y at the end of a step is -1.02 u at its start: a gain a step, whatever the step is."""

    interface = Interface((Signal("u"),), (Signal("y"),), delayed=("u",))

    def __init__(self, gain: float = -1.02, initial: float = 1e-3):
        self.gain = gain
        self.initial = initial

    def initialize(self, t, u):
        self.y = self.initial
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([self.y])

    def advance(self, t, h, u):
        rows = self.gain * u[:-1]
        self.y = float(rows[-1, 0])
        return rows
'''

HEAD = '[scenario]\nname = "small"\nstop = 4.0\nstep = 0.01\n'


def write(folder, text):
    """Write a scenario of 4 s beside the module of the classes; return its path."""
    (folder / "parts.py").write_text(MODULE, encoding="utf-8")
    path = folder / "small.toml"
    path.write_text(HEAD + dedent(text), encoding="utf-8")
    return path


def lag_behind(source):
    """Return a scenario in which a lag of 0.5 s follows a class of ours, or what a table says."""
    name, value = source
    table = value if name == "kind" else f'"python", class = "parts:{name}", time = {value}'
    return f"""
        [components]
        source = {{ kind = {table} }}
        lag = {{ kind = "lag", time_constant = 0.5 }}

        [connections]
        "lag.u" = "source.y"
        """


LORENZ = """
    [components]
    x = { kind = "integrator", initial = 1.0 }
    y = { kind = "integrator", initial = 2.0 }
    z = { kind = "integrator", initial = 3.0 }
    of_x = { kind = "expression", y = "10*(y.y - x.y)" }
    of_y = { kind = "expression", y = "x.y*(28 - z.y) - y.y" }
    of_z = { kind = "expression", y = "x.y*y.y - 8/3*z.y" }

    [connections]
    "x.u" = "of_x.y"
    "y.u" = "of_y.y"
    "z.u" = "of_z.y"
    """

RELAY = """
    [components]
    relay = { kind = "python", class = "parts:Relay" }
    mass = { kind = "integrator", initial = 0.1234 }

    [connections]
    "relay.u" = "mass.y"
    "mass.u" = "relay.y"
    """

SMOOTH = """
    [components]
    sine = { kind = "sine", rate = 1.0 }
    lag = { kind = "lag", time_constant = 0.5, initial = 0.0 }

    [connections]
    "lag.u" = "sine.y"
    """

EXACT = """
    [components]
    third = { kind = "constant", value = 0.3333333333333333 }
    lag = { kind = "lag", time_constant = 0.7, initial = 0.2 }

    [connections]
    "lag.u" = "third.y"
    """

ECHO = """
    [components]
    echo = { kind = "python", class = "parts:Echo" }
    gain = { kind = "gain", K = [[1.0]] }

    [connections]
    "echo.u" = "gain.y"
    "gain.u" = "echo.y"
    """

SPRING = """
    [components]
    mass = { kind = "integrator", initial = 1.0 }
    speed = { kind = "integrator" }
    force = { kind = "gain", K = [[-4.0]] }

    [connections]
    "mass.u" = "speed.y"
    "speed.u" = "force.y"
    "force.u" = "mass.y"
    """


def parsed(text):
    """Return a scenario of 4 s without code of users."""
    return parse(Document(HEAD + dedent(text), "small", Path()))
