"""Where a compiled step declines, the component does what it does without it."""

import importlib
import pkgutil

import numpy as np
import pytest

import cosim.blocks
from cosim.blocks.arithmetic import gain
from cosim.blocks.look_up import LookUpTable
from cosim.blocks.modulated_source import ModulatedSource, Modulation
from cosim.blocks.product import Product
from cosim.blocks.renamed import Renamed
from cosim.blocks.renaming import Renaming, map_ports
from cosim.blocks.replay import Replay
from cosim.blocks.sampled import Decimated, Sampled
from cosim.blocks.source import Expression, Noise, Table, ramp
from cosim.core.clock import Clock
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.port import Port
from cosim.core.recorders import Memory
from cosim.core.signals import Signal
from cosim.errors import RunError
from tests.blocks.parts import H, identifier


def recorded(stop):
    memory = Memory()
    run(Graph({"u": ramp(slope=1.0)}, {}), Clock(stop, H), memory)
    return memory


def renamed_product():
    """Return u1/u2 with its inputs in the other order, under other names."""
    component = Product("*/")
    renamings = [
        Renaming(Port("part", "divisor"), (Port("part", "u2"),)),
        Renaming(Port("part", "factor"), (Port("part", "u1"),)),
    ]
    return Renamed(component, map_ports(component.interface, renamings))


# a component, what drives its inputs, and why it stops
STOPS = {
    "product": (
        lambda: Product("*/"),
        {"u1": "t", "u2": "t - 15*0.001"},
        "u2 is 0",
    ),
    "look-up table": (
        lambda: LookUpTable([np.array([-1.0, 0.0131])], np.array([0.0, 1.0])),
        {"u": "t"},
        r"0\.013.*look-up table: covers u from -1\.0 to 0\.0131.*0\.014\)",
    ),
    "table": (
        lambda: Table(np.array([0.0, 0.015]), np.array([[1.0], [2.0]])),
        {},
        r"0\.015 s: table:.*0\.0 s to 0\.015 s.*0\.016 s",
    ),
    "sampled product": (
        lambda: Sampled(Product("*/"), 5),
        {"u1": "t", "u2": "t - 15*0.001"},
        "u2 is 0",
    ),
    "decimated product": (
        lambda: Decimated(Product("*/"), 4),
        {"u1": "t", "u2": "t - 15*0.001"},
        "u2 is 0",
    ),
    "renamed product": (
        renamed_product,
        {"divisor": "t - 15*0.001", "factor": "t"},
        "u2 is 0",
    ),
    "modulated table": (
        lambda: ModulatedSource(
            Table(np.array([0.0, 0.015]), np.array([[1.0, 2.0], [2.0, 1.0]])),
            [Modulation(0, 0)],
            (Signal("alpha"),),
        ),
        {"alpha": "1 + t"},
        r"0\.015 s: table:.*0\.0 s to 0\.015 s.*0\.016 s",
    ),
    "replay": (
        lambda: Replay(recorded(0.02), "u"),
        {},
        r"the recording ends at 0.02 s",
    ),
}


def graph_of(make, texts, *, native):
    """Return a graph of a component, behind sources of its inputs."""
    sources = {f"source_{name}": Expression([text]) for name, text in texts.items()}
    connections = {f"part.{name}": f"source_{name}.y" for name in texts}
    return Graph({**sources, "part": make()}, connections, native=native)


@pytest.mark.parametrize("steps", [1, 7, 100])
@pytest.mark.parametrize("name", STOPS)
def test_a_step_that_is_declined_ends_as_it_does_in_python(name, steps):
    """The same message, and the same rows before it."""
    make, texts, message = STOPS[name]
    ends = []
    for native in (False, True):
        memory = Memory()
        with pytest.raises(RunError, match=message) as error:
            run(graph_of(make, texts, native=native), Clock(0.03, H, steps), memory)
        ends.append((str(error.value), memory["part.y"].tobytes(), memory.status))
    assert ends[0] == ends[1]


def test_an_identifier_without_a_value_stops_as_it_does_in_python():
    """The kernel declines the sample, and the component says why."""
    u = np.full((11, 4), np.nan)
    messages = []
    for native in (False, True):
        component = identifier()
        component.prepare(H, np.zeros(4, np.bool_), {})
        component.initialize(0.0, u[0])
        t = np.arange(11) * 1_000_000 / 1e9
        first = 0
        if native:
            step = component.native()
            first = len(step.advance(t, H, u))
        with pytest.raises(Stopped) as stop:
            component.advance(t[first:], H, u[first:])
        messages.append((str(stop.value), first + stop.value.steps))
    assert messages[0] == messages[1]


@pytest.mark.parametrize("steps", [pytest.param(1, marks=pytest.mark.slow), 1000, 9000])
def test_noise_goes_on_where_all_that_was_drawn_is_used_up(steps):
    """Its numbers depend neither on the blocks, nor on how many are drawn at once."""
    rows = []
    for native in (False, True):
        memory = Memory()
        graph = Graph(
            {"noise": Noise(deviation=2.0, seed=5, size=3), "gain": gain(np.ones((1, 3)))},
            {"gain.u": "noise.y"},
            native=native,
        )
        run(graph, Clock(9.0, H, steps), memory)
        rows.append((memory["noise.y"].tobytes(), memory["gain.y"].tobytes()))
    one = Noise(deviation=2.0, seed=5, size=3)
    first = one.initialize(0.0, np.zeros(0))
    whole = np.vstack([first, one.advance(np.zeros(9001), H, np.zeros((9001, 0)))])
    assert rows[0] == rows[1]
    assert rows[0][0] == whole.tobytes()


# components that advance in Python, and why
IN_PYTHON = {
    "Static": "its function is one in Python",
    "RelinearizedObserver": "at every step its model is linearized, and the observer designed, "
    "by code in Python or by an FMU; the step itself is a small part of that",
}


def component_classes():
    """Yield the component classes of the package by name."""
    for module in pkgutil.iter_modules(cosim.blocks.__path__):
        home = importlib.import_module(f"cosim.blocks.{module.name}")
        for name, thing in vars(home).items():
            is_own = isinstance(thing, type) and thing.__module__ == home.__name__
            if is_own and callable(getattr(thing, "advance", None)) and not is_protocol(thing):
                yield name, thing


def is_protocol(thing):
    return getattr(thing, "_is_protocol", False)


def test_every_component_class_has_a_compiled_step():
    """But for those in the list, which has the reasons."""
    classes = dict(component_classes())
    assert len(classes) > 20
    without = {name for name, thing in classes.items() if not hasattr(thing, "native")}
    assert without == IN_PYTHON.keys()
