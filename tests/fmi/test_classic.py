"""The classic algorithms of co-simulation give the bits of plain loops over FMPy's calls."""

from contextlib import ExitStack, contextmanager
from itertools import product

import fmpy
import numpy as np
import pytest
from fmpy.fmi2 import FMU2Slave

from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from tests.fmi import small

STABLE = (
    {"A": -0.9, "B": 0.5, "C": 3.0, "D": 0.0, "x": 1.0},
    {"A": -1.0, "B": 10.0, "C": -31.0, "D": -0.9, "x": 1.0},
)
UNSTABLE = ({**STABLE[0], "D": 1.0}, STABLE[1])  # with an algebraic loop
STEPS = 50
X, Y, U = (small.NAMES.index(name) for name in "xyu")


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    """Two FMUs of the small systems, which can go back to a saved state."""
    folder = tmp_path_factory.mktemp("classic")
    fmu = small.compiled(folder)
    return [small.able(fmu, folder / f"{i}.fmu", "state", D=1.0) for i in range(2)]


@contextmanager
def slave(path, values):
    """Initialize an FMU by FMPy's calls."""
    description = fmpy.read_model_description(path)
    folder = fmpy.extract(path)
    fmu = FMU2Slave(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="plain",
    )
    fmu.instantiate()
    fmu.setupExperiment(startTime=0.0)
    fmu.setReal([small.NAMES.index(name) for name in values], list(values.values()))
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    yield fmu
    fmu.terminate()
    fmu.freeInstance()


def plain(fmus, initial_outputs, h, algorithm, *, iterations, order):
    """Step two FMUs that drive each other with what is known of their outputs; return (x, y)."""
    y = list(initial_outputs)
    rows = []
    for k in range(STEPS):
        states = [fmu.getFMUState() for fmu in fmus]
        for iteration in range(iterations):
            before = list(y)
            for i in order:
                if iteration:
                    fmus[i].setFMUState(states[i])
                driving = before if algorithm == "jacobi" else y
                fmus[i].setReal([U], [driving[1 - i]])
                fmus[i].doStep(k * h, h)
                y[i] = fmus[i].getReal([Y])[0]
        for fmu, state in zip(fmus, states, strict=True):
            fmu.freeFMUState(state)
        rows.append([fmus[0].getReal([X])[0], fmus[1].getReal([X])[0], *y])
    return np.array(rows)


@pytest.mark.fast("unstable")
@pytest.mark.parametrize(
    ("values", "h"), [(STABLE, 1e-3), (UNSTABLE, 1e-2)], ids=["stable", "unstable"]
)
def test_the_bits_are_those_of_a_plain_loop(paths, values, h, subtests):
    """Also where the coupling is unstable: it multiplies an error by 1.97 a step of 10 ms."""
    for (algorithm, interpolation, iterations), native in product(
        [
            ("jacobi", "zero-order", 1),
            ("jacobi", "latest", 1),
            ("jacobi", "latest", 3),
            ("gauss-seidel", "latest", 1),
            ("gauss-seidel", "latest", 4),
        ],
        [True, False],
    ):
        with subtests.test(
            algorithm=algorithm, interpolation=interpolation, iterations=iterations, native=native
        ):
            with ExitStack() as opened:
                fmus = []
                for path, own in zip(paths, values, strict=True):
                    fmus.append(opened.enter_context(load(path, FmuOptions(start=own))))
                graph = Graph(
                    {"one": fmus[0].component, "two": fmus[1].component},
                    {"one.u": "two.y", "two.u": "one.y"},
                    coupling=algorithm,
                    input_interpolation=interpolation,
                    iterations=iterations,
                    native=native,
                )
                (stage,) = graph.stages
                order = [
                    ("one", "two").index(m.name)
                    for kind, m in stage.operations
                    if kind == "advance"
                ]
                memory = Memory()
                run(graph, Clock(STEPS * h, h), memory)
                found = np.column_stack(
                    [memory[f"{name}.{s}"] for s in "xy" for name in ("one", "two")]
                )
            with ExitStack() as opened:
                slaves = []
                for path, own in zip(paths, values, strict=True):
                    slaves.append(opened.enter_context(slave(path, own)))
                expected = plain(
                    slaves, found[0, 2:], h, algorithm, iterations=iterations, order=order
                )
            assert found[1:].tobytes() == expected.tobytes()
            if values is UNSTABLE and algorithm == "jacobi" and iterations == 1:
                assert abs(expected[-1, 1]) > 1e6
