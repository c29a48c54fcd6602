"""Co-simulation FMUs in loops: order of convergence, algebraic loops, compiled steps.

The pair: x1' = -0.9 x1 + 0.5 u1, y1 = 3 x1 + u1; x2' = -x2 + 10 u2, y2 = -31 x2 - 0.9 u2; u1 = y2,
u2 = y1, x(0) = (1, 1). Each FMU is exact for inputs on a line, or for constant ones.
"""

import math

import numpy as np
import pytest
import scipy.linalg

from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.simulation import Simulation
from cosim.core.stages.substep_control import SubstepTolerance
from cosim.errors import GraphError
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from tests.fmi import small
from tests.fmi.small import ONE, TWO

STEPS = (0.01, 0.005, 0.0025, 0.00125)


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    """Compile the FMU of the small systems."""
    return small.compiled(tmp_path_factory.mktemp("small"))


@pytest.fixture
def opened(fmu, tmp_path):
    """Return a function that opens an FMU with some capabilities; all are closed at the end."""
    fmus = []

    def open_fmu(*can, **values):
        path = small.able(fmu, tmp_path / f"{len(fmus)}.fmu", *can, **values)
        values.pop("u", None)  # of a connected input only the description has a start value
        fmus.append(load(path, FmuOptions(start=values)))
        return fmus[-1].component

    open_fmu.fmus = fmus
    yield open_fmu
    for opened_fmu in fmus:
        opened_fmu.close()


@pytest.fixture
def pair(opened):
    """Return a function that makes a graph of the pair."""

    def graph(*can, coupling="newton", **options):
        can = ("state", "steps", *can)
        components = {"one": opened(*can, **ONE), "two": opened(*can, **TWO)}
        connections = {"one.u": "two.y", "two.u": "one.y"}
        return Graph(components, connections, coupling=coupling, **options)

    return graph


def record(graph, step, stop=1.0, block=None):
    memory = Memory()
    run(graph, Clock(stop, step, block), memory)
    return memory


def solution(t):
    """Return (x1, x2) of the pair, its algebraic loop eliminated, by the matrix exponential."""
    swap = np.array([[0.0, 1.0], [1.0, 0.0]])
    C = np.diag([3.0, -31.0])
    D = np.diag([1.0, -0.9])
    u_of_x = np.linalg.solve(np.eye(2) - swap @ D, swap @ C)
    return scipy.linalg.expm((np.diag([-0.9, -1.0]) + np.diag([0.5, 10.0]) @ u_of_x) * t).sum(1)


def error(memory):
    """Return the largest error of the states at the end."""
    return abs(np.array([memory["one.x"][-1], memory["two.x"][-1]]) - solution(1.0)).max()


@pytest.mark.fast("held")
@pytest.mark.parametrize(
    ("can", "interpolation", "order"),
    [
        (("slopes",), "linear", 2.0),  # y belongs to the end of the line
        (("D",), "linear", 2.0),  # y of the mean is corrected by D
        ((), "linear", 1.0),  # y belongs to the mean
        (("slopes", "D"), "zero-order", 1.0),  # the states follow held inputs
    ],
    ids=["slopes", "means corrected", "means", "held"],
)
def test_newton_has_the_order_of_how_inputs_are_followed(pair, can, interpolation, order):
    """Through the algebraic loop of the two feedthroughs."""
    errors = []
    for step in STEPS:
        errors.append(error(record(pair(*can, input_interpolation=interpolation), step)))
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(orders, order, atol=0.1)


@pytest.mark.parametrize("can", ["slopes", "D"])
def test_the_errors_of_newton_are_known(pair, can):
    """1e-5 at 10 ms and 1e-7 at 1 ms; u(0) by hand."""
    np.testing.assert_allclose(
        solution(1.0), [0.08597640367353255, 0.00839266482037434], rtol=1e-12
    )
    memory = record(pair(can), 0.01)
    assert error(memory) < 1e-5
    initial = [memory["one.u"][0], memory["two.u"][0]]
    np.testing.assert_allclose(
        initial, [-17.736842105263158, -14.736842105263158], rtol=0, atol=1e-12
    )
    assert error(record(pair(can), 0.001)) < 1e-7


@pytest.mark.parametrize("can", [(), ("slopes",), ("D",), ("slopes", "D")])
def test_compiled_steps_of_newton_have_the_same_bits(pair, can):
    """In blocks of any length, and where steps are taken by hand."""
    expected = record(pair(*can, native=False), 0.01)
    simulation = Simulation(pair(*can), Clock(1.0, 0.01))
    by_hand = np.concatenate([simulation.step(k)["two.u"] for k in (1, 9, 40, 1, 49)])
    assert by_hand.tobytes() == expected["two.u"][1:].tobytes()
    for block in (None, 1, 7):
        found = record(pair(*can), 0.01, block=block)
        for signal in ("one.u", "one.x", "one.y", "two.u", "two.x", "two.y"):
            assert found[signal].tobytes() == expected[signal].tobytes()


@pytest.mark.parametrize("native", [True, False])
def test_messages_of_a_sweep_that_is_rolled_back_are_dropped(opened, native):
    """One message a step, though Newton's method takes each step at least twice."""
    can = ("state", "steps", "slopes")
    one = opened(*can, **ONE, SAYS=1.0)
    components = {"one": one, "two": opened(*can, **TWO)}
    connections = {"one.u": "two.y", "two.u": "one.y"}
    record(Graph(components, connections, coupling="newton", native=native), 0.01, stop=0.05)
    texts = [message.text for message in opened.fmus[0].drain()]
    assert texts == ["to 0.01 s", "to 0.02 s", "to 0.03 s", "to 0.04 s", "to 0.05 s"]


@pytest.mark.fast("True")
@pytest.mark.parametrize("native", [True, False])
def test_a_nonlinear_loop_is_solved_together(opened, native):
    """a + b + c = 0, 2 a - 3 b + 2 c = 9, a^2 + b^2 + c^2 = 5, for which sweeps alone diverge.

    By hand: b = -9/5, a + c = 9/5, a c = ((a + c)^2 - (a^2 + c^2)) / 2 = 0.74.
    """
    can = ("state", "steps")
    components = {"plane": opened(*can, KIND=1.0, u=1.0), "sphere": opened(*can, KIND=2.0)}
    connections = {"plane.u": "sphere.y", "sphere.u": "plane.y", "sphere.v": "plane.z"}
    graph = Graph(components, connections, coupling="newton", native=native)
    memory = record(graph, 0.1)
    difference = math.sqrt(1.8**2 - 4 * 0.74)
    roots = ((1.8 - difference) / 2, (1.8 + difference) / 2)
    for k in (0, -1):
        a, b, c = memory["sphere.y"][k], memory["plane.y"][k], memory["plane.z"][k]
        np.testing.assert_allclose(sorted([a, c]), roots, rtol=1e-12)
        assert b == -1.8
        residuals = (a + b + c, 2 * a - 3 * b + 2 * c - 9, a * a + b * b + c * c - 5)
        np.testing.assert_allclose(residuals, 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("can", "order"), [(("slopes",), 2), (("D",), 2), ((), 1)], ids=["slopes", "D", "means"]
)
def test_the_order_that_a_loop_is_said_to_have_is_that_of_its_error(pair, can, order):
    """Outputs that belong to the mean of the inputs, without D, make it the first."""
    (stage,) = pair(*can).stages
    assert stage.is_first_order is (order == 1)
    assert ("(second order)" in stage.description) is (order == 2)


# --- substeps ---


@pytest.mark.slow
@pytest.mark.parametrize("can", ["slopes", "D"])
def test_substeps_keep_the_tolerance(pair, can):
    """In FMUs that take steps of any length; with compiled code and without the same bits."""
    tolerance = SubstepTolerance(rtol=1e-6, atol=1e-6)
    memory = record(pair(can, substeps=tolerance), 0.1)
    assert error(memory) < 1e-5
    plain = record(pair(can, substeps=tolerance, native=False), 0.1)
    assert memory["one.x"].tobytes() == plain["one.x"].tobytes()
    assert memory.substeps() == plain.substeps()


def test_substeps_need_steps_of_any_length(opened):
    """FMI: canHandleVariableCommunicationStepSize."""
    components = {
        "one": opened("state", "steps", "slopes", **ONE),
        "two": opened("state", "slopes", **TWO),
    }
    connections = {"one.u": "two.y", "two.u": "one.y"}
    with pytest.raises(GraphError, match=r"two in this loop .* canHandleVariableCommunication"):
        Graph(components, connections, substeps=SubstepTolerance())
