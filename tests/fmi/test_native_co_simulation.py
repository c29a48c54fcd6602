"""Co-simulation FMUs in compiled code: the bits, messages and ends of the methods in Python."""

from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from cosim.blocks.source import Expression
from cosim.core import Clock, Graph, run
from cosim.core.connections import Connection
from cosim.core.master import simulate
from cosim.core.recorders import Memory
from cosim.errors import RunError
from cosim.fmi.component import load
from cosim.fmi.driving.stepping import Stepper
from cosim.fmi.options import FmuOptions
from tests.fmi import lag
from tests.fmi.compiled import compile_fmu
from tests.fmi.rogues import STATELESS

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
    rows = {name: memory[name].tobytes() for name in memory.signals}
    messages = [fmu.drain() for fmu in fmus]
    for fmu in fmus:
        fmu.close()
    return rows, error, messages


def check_rows(path, version, can, start, wiring):
    """Check that compiled steps give the rows, error and messages of the methods."""
    case = (path, version, can, start)
    expected = simulated(*case, native=False, wiring=wiring, block=1)
    assert simulated(*case, native=True, wiring=wiring, block=1) == expected


@pytest.mark.fast("rare-1", "usual-1", "rarer-2")
@pytest.mark.parametrize("version", ["1", "2", "3"])
@pytest.mark.parametrize(
    ("cases", "wiring"),
    [(USUAL, "ring"), (RARE[:10], "chain"), (RARE[10:], "chain")],
    ids=["usual", "rare", "rarer"],
)
def test_rows_messages_and_ends_are_those_of_the_methods(path, version, cases, wiring, subtests):
    """Usual steps in a ring, rare ones in a chain."""
    for case in cases:
        if case[0] == version:
            with subtests.test(case=case):
                check_rows(path, *case, wiring)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cases", "wiring"), [(USUAL, "chain"), (RARE, "ring")], ids=["usual", "rare"]
)
def test_rows_messages_and_ends_are_those_of_the_methods_in_the_other_graph(
    path, cases, wiring, subtests
):
    for case in cases:
        with subtests.test(case=case):
            check_rows(path, *case, wiring)


@pytest.mark.parametrize(("version", "can", "start"), [USUAL[4], USUAL[10], RARE[3], RARE[9]])
def test_bits_depend_on_no_block_size(path, version, can, start, subtests):
    case = (path, version, can, start)
    for coupling in ("gauss-seidel", "jacobi"):
        options = {"wiring": "ring", "coupling": coupling}
        expected = simulated(*case, native=False, **options)
        for block in (None, 7):
            with subtests.test(coupling=coupling, block=block):
                assert simulated(*case, native=True, block=block, **options) == expected


def test_usual_steps_are_compiled(path, monkeypatch, subtests):
    """All of them, but for the first one of an FMU whose state is saved before each."""
    taken = []
    step = Stepper.step

    def counted(self, *arguments):
        taken.append(arguments)
        return step(self, *arguments)

    monkeypatch.setattr(Stepper, "step", counted)

    for (version, can, start), wiring in product(
        [case for case in USUAL if "events" not in case[1]], ["chain", "ring"]
    ):
        with subtests.test(version=version, can=can, start=start, wiring=wiring):
            if "state" in can:
                simulated(path, version, can, start, native=True, wiring=wiring)  # tries the state
            taken.clear()
            simulated(path, version, can, start, native=True, wiring=wiring)
            assert len(taken) == (COUNT if version == "2" and "state" in can else 0)


def test_the_process_is_restored_once_for_many_steps(tmp_path):
    """The report names all FMUs that ran in the same call; the numbers are right all the same."""
    path = compile_fmu(
        tmp_path / "mover.fmu", STATELESS, "rogue2.c", defines=("ROGUE=MOVES", "WHERE=STEP")
    )
    home = Path.cwd()
    rows = {}
    for native in (False, True):
        with load(path) as a, load(path) as b:
            components = {"u": Expression(["0.5"]), "a": a.component, "b": b.component}
            graph = Graph(components, {"a.u": "u.y", "b.u": "a.y"}, native=native)
            memory = Memory()
            run(graph, Clock(0.05, 0.01), memory)
            rows[native] = memory["b.y"].tobytes()
            texts = [message.text for fmu in (a, b) for message in fmu.drain()]
        assert Path.cwd() == home
        assert any("changed the working directory; it is as before again" in text for text in texts)
    assert rows[True] == rows[False]
    name = a.description.name
    expected = f"{name}: it, or one of {name}, changed the working directory; it is as before again"
    assert texts == [expected]


@pytest.mark.parametrize("native", [True, False])
def test_a_simulation_goes_on_after_outputs_and_saved_states_in_between(path, native):
    """Python methods and compiled steps share one state."""
    fmus = [load(path("2", "state", "any step", "D")) for _ in range(2)]
    rows = []
    for fmu in fmus:
        components = {"u": Expression(["sin(7*t)"]), "d": Expression(["0"]), "lag": fmu.component}
        graph = Graph(components, {"lag.u": "u.y", "lag.d": "d.y"}, native=native)
        blocks = []
        for block, signals in simulate(graph, Clock(STOP, STEP, block=10)):
            blocks.append(signals[1:].copy())
            if fmu is fmus[0]:
                component = fmu.component
                saved = component.save()
                component.outputs(float(block.time[-1]), np.array([0.3, 0.0]))
                component.advance(np.array([block.time[-1], 9.0]), 1.0, np.ones((2, 2)))
                component.restore(saved)
        rows.append(np.concatenate(blocks).tobytes())
        fmu.close()
    assert rows[0] == rows[1]


CALLS = (
    "SET_REAL",
    "SET_INTEGER",
    "SET_SLOPES",
    "DO_STEP",
    "GET_REAL",
    "GET_BOOLEAN",
    "SAVE",
    "DERIVE",
)
STATUSES = ("fmi2Warning", "fmi2Discard", "fmi2Error", "fmi2Fatal")


def typed_xml(*, interpolates):
    """Describe ``c/typed2.c``; our own tool, so that nothing is tried when it is loaded."""
    slopes = str(interpolates).lower()
    variables = ""
    for number, (name, kind) in enumerate(
        {"u": "Real", "x": "Real", "y": "Real", "n": "Integer", "m": "Integer"}.items()
    ):
        variables += _scalar(number, name, kind)
    variables += _scalar(5, "b", "Boolean") + _scalar(6, "c", "Boolean")
    outputs = '<Unknown index="2" dependencies=""/><Unknown index="3" dependencies="1"/>'
    outputs += '<Unknown index="5" dependencies=""/><Unknown index="7" dependencies=""/>'
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="typed" guid="typed" generationTool="cosim">
<CoSimulation modelIdentifier="model" canGetAndSetFMUstate="true" canInterpolateInputs="{slopes}"
 canHandleVariableCommunicationStepSize="true" providesDirectionalDerivative="true"/>
<ModelVariables>{variables}</ModelVariables>
<ModelStructure><Outputs>{outputs}</Outputs></ModelStructure></fmiModelDescription>"""


def _scalar(number, name, kind):
    is_input = name in "unb"
    variability = "continuous" if kind == "Real" else "discrete"
    roles = f'causality="{"input" if is_input else "output"}" variability="{variability}"'
    start = "" if name == "y" else ' start="0"'
    if not is_input:
        roles += f' initial="{"calculated" if name == "y" else "exact"}"'
    attributes = f'name="{name}" valueReference="{number}" {roles}'
    return f"<ScalarVariable {attributes}><{kind}{start}/></ScalarVariable>"


def typed_run(path, *, native):
    """Return rows, error and messages of a run of ``c/typed2.c``."""
    components = {
        "u": Expression(["cos(5*t)"]),
        "n": Expression(["step(t - 0.1) - 2*step(t - 0.2)"], variability="discrete"),
        "b": Expression(["step(t - 0.15)"], variability="discrete"),
    }
    memory = Memory()
    error = ""
    with load(path) as fmu:
        components["plant"] = fmu.component
        wires = {f"plant.{name}": f"{name}.y" for name in "unb"}
        graph = Graph(components, wires, native=native)
        try:
            run(graph, Clock(0.3, 0.01, block=1), memory)
        except RunError as raised:
            error = str(raised)
        messages = fmu.drain()
        fmu.close()
    rows = {name: memory[name].tobytes() for name in memory.signals}
    return rows, error, messages


def typed(folder, call, status):
    defines = (f"CALL={call}", f"STATUS={status}", "AT=0.05")
    xml = typed_xml(interpolates=call != "DERIVE")  # outputs are not corrected otherwise
    return compile_fmu(folder / f"{call}{status}.fmu", xml, "typed2.c", defines=defines)


@pytest.mark.fast("SET_REAL")
@pytest.mark.parametrize("call", CALLS)
def test_a_call_that_warns_or_fails_in_compiled_code_is_reported_alike(tmp_path, call, subtests):
    """In every call of a step: the same rows, the same error, the same messages and times."""
    for status in STATUSES:
        with subtests.test(status=status):
            path = typed(tmp_path, call, status)
            rows, error, messages = typed_run(path, native=False)
            assert typed_run(path, native=True) == (rows, error, messages)
            assert (error == "") == (status == "fmi2Warning")
            assert messages != []


def test_integers_and_booleans_are_carried_as_by_the_methods(tmp_path):
    path = typed(tmp_path, "NEVER", "fmi2OK")
    rows, error, _ = typed_run(path, native=True)
    assert error == ""
    assert typed_run(path, native=False)[0] == rows
    counted = np.frombuffer(rows["plant.m"])
    n = np.frombuffer(rows["plant.n"])
    b = np.frombuffer(rows["plant.b"])
    c = np.frombuffer(rows["plant.c"])
    # Held inputs have their value from the start of the step.
    assert counted[1:].tolist() == (n[:-1] + np.arange(1, len(n))).tolist()
    assert c[1:].tolist() == (1.0 - b[:-1]).tolist()
