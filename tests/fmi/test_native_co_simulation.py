"""Co-simulation FMUs in compiled code: the bits, messages and ends of the methods in Python."""

from functools import cache

import pytest

from cosim.blocks.source import Expression
from cosim.core import Clock, Graph, run
from cosim.core.connections import Connection
from cosim.core.recorders import Memory
from cosim.errors import RunError
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from tests.fmi import lag

STEP = 0.01
STOP = 0.6
COUNT = 3  # lags

INTERRUPTED = {"longest": 0.007, "begin": 0.1, "until": 0.2}
USUAL = [
    ("1", (), {}),
    ("2", (), {}),
    ("3", (), {}),
    ("2", ("D",), {}),
    ("3", ("D",), {}),
    ("1", ("lines",), {}),
    ("2", ("lines", "D"), {}),
    ("3", ("lines", "D"), {}),
    ("3", ("lines", "d moves"), {}),
    ("2", ("state", "any step"), {}),
    ("2", ("state", "any step", "lines", "D"), {}),
    ("3", ("state", "any step", "events", "D"), {}),
    ("3", ("events", "D", "d is shown"), {}),
    ("3", ("lines",), {"asks": 1.0}),
    ("2", (), {"inner": 0.001}),
    ("3", ("events",), {"inner": 0.03}),
]
RARE = [
    ("2", ("state", "any step"), INTERRUPTED),
    ("2", ("state", "any step", "lines"), INTERRUPTED),
    ("3", ("any step",), INTERRUPTED),
    ("3", ("any step", "lines"), INTERRUPTED),
    ("1", (), INTERRUPTED),
    ("2", ("any step",), INTERRUPTED),
    ("3", ("any step", "events"), {"returns": 0.025}),
    ("3", ("any step", "events", "lines"), {"returns": 0.025}),
    ("3", ("any step", "events"), {"event": 0.025, "announces": 1.0}),
    ("3", ("any step", "events"), {"event": 0.025}),
    ("3", ("any step", "events"), {"event": 0.05, "announces": 2.0, "iterations": 3.0}),
    ("3", ("events",), {"event": 0.025, "announces": 1.0}),
    ("3", ("any step", "events"), {"returns": -0.01}),
    ("2", (), {"end": 0.25}),
    ("3", (), {"end": 0.25}),
    ("3", ("events", "any step"), {"event": 0.1, "end": 0.25, "status": -1.0}),
    ("3", (), {"end": 0.25, "status": -2.0}),
    ("1", (), {"fail": 0.25, "status": 3.0}),
    ("2", (), {"fail": 0.25, "status": 3.0}),
    ("2", (), {"fail": 0.25, "status": 4.0}),
    ("3", (), {"fail": 0.25, "status": 3.0}),
    ("1", ("lines",), {"no_slopes": 0.0}),
    ("2", ("lines",), {"no_slopes": 0.0}),
    ("2", ("lines",), {"no_slopes": 0.3}),
    ("3", ("lines", "D"), {"asks": 0.0}),
]


@pytest.fixture(scope="session")
def path(tmp_path_factory):
    """Return the path of the lag of a version with some capabilities."""
    folder = tmp_path_factory.mktemp("lag")
    compiled = {version: lag.build(folder, version) for version in "123"}

    @cache
    def path(version, *can):
        name = f"{version}-{'-'.join(can)}.fmu".replace(" ", "_")
        return lag.able(compiled[version], folder / name, version, *can)

    return path


def connected(wiring):
    """Return how the sources "u" and "d" and the lags are connected: in a chain, or in a ring."""
    connections = {f"lag{i}.d": "d.y" for i in range(COUNT)}
    for i in range(1, COUNT):
        connections[f"lag{i}.u"] = f"lag{i - 1}.{'xy'[i % 2]}"
    if wiring == "chain":
        connections["lag0.u"] = "u.y"
    else:
        connections["lag0.u"] = Connection(f"lag{COUNT - 1}.x", gain=-0.5, offset=1.0)
    return connections


def simulated(
    path, version, can, start, *, native, wiring="chain", coupling="gauss-seidel", block=None
):
    """Return rows, error and messages of a run."""
    sources = {
        "u": Expression(["sin(7*t)"]),
        "d": Expression(["step(t - 0.2) + step(t - 0.405)/4"], variability="discrete"),
    }
    fmus = [load(path(version, *can), FmuOptions(start=start)) for _ in range(COUNT)]
    components = {**sources, **{f"lag{i}": fmu.component for i, fmu in enumerate(fmus)}}
    graph = Graph(components, connected(wiring), coupling=coupling, native=native)
    memory = Memory()
    error = ""
    try:
        run(graph, Clock(STOP, STEP, block=block), memory)
    except RunError as raised:
        error = str(raised)
    rows = {name: memory[name].tobytes() for name in memory.signals()}
    messages = [fmu.drain() for fmu in fmus]
    for fmu in fmus:
        fmu.close()
    return rows, error, messages


@pytest.mark.parametrize("wiring", ["chain", "ring"])
@pytest.mark.parametrize(("version", "can", "start"), USUAL + RARE)
def test_rows_messages_and_ends_are_those_of_the_methods(path, version, can, start, wiring):
    case = (path, version, can, start)
    expected = simulated(*case, native=False, wiring=wiring, block=1)
    assert simulated(*case, native=True, wiring=wiring, block=1) == expected
