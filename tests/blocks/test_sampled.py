"""Components that sample less often than every communication step."""

import numpy as np
import pytest

from cosim.blocks.arithmetic import gain
from cosim.blocks.dynamics import lag
from cosim.blocks.sampled import Decimated, Sampled
from cosim.blocks.source import Table, sine
from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.errors import ClockError
from tests.blocks.stepping import drive

N = 7
U = np.random.default_rng(4).standard_normal((10 * N + 1, 1))


def through():
    """Build x' = -20 (x - u), y = x + u / 2."""
    return Linear(
        controller(A=np.array([[-20.0]]), B=np.array([[20.0]]), C=np.eye(1), D=np.array([[0.5]]))
    )


@pytest.mark.parametrize("held", [False, True])
def test_sampled_is_the_component_on_its_own_grid(held):
    """Every n-th row has the bits of the component with the step n h, and holds between."""
    computed = drive(Sampled(through(), N), U, held=held)
    reference = drive(through(), U[::N], step_ns=N * 1_000_000, held=held)
    assert (computed == np.repeat(reference, N, axis=0)[: len(computed)]).all()
    assert all(
        signal.variability == "discrete" for signal in Sampled(through(), N).interface.outputs
    )


def test_sampled_agrees_with_the_exact_step_response():
    """x' = -20 (x - u) from 0 with u held at 1: 1 - exp(-20 t) at the ends of the slow steps."""
    computed = drive(
        Sampled(Linear(lag(time_constant=0.05, initial=0.0)), N),
        np.ones((10 * N + 1, 1)),
        held=True,
    )[:, 0]
    t = (np.arange(10 * N + 1) // N) * N * 1e-3
    np.testing.assert_allclose(
        computed, -np.expm1(-20.0 * t), rtol=0, atol=10 * 2.3e-16
    )  # ten steps, one last bit each


def test_held_outputs_follow_an_input_that_was_extrapolated():
    """A loop evaluates the outputs again with the right input; these hold until the next sample.

    The extrapolated input leaves no trace.
    """
    sampled = Sampled(through(), 3)
    right = drive(Sampled(through(), 3), U[:13], held=True)
    sampled.prepare(1e-3, np.array([True]), {})
    sampled.initialize(0.0, U[0])
    for k in range(12):
        sampled.advance(np.array([k, k + 1]) / 1e3, 1e-3, np.vstack([U[k], U[k + 1] + 100.0]))
        assert (sampled.outputs((k + 1) / 1e3, U[k + 1]) == right[k + 1]).all()


def test_sampled_passes_a_stop_on():
    """With the rows up to there."""
    source = Sampled(Table(np.array([0.0, 0.01]), np.ones((2, 1))), 4)
    with pytest.raises(Stopped, match=r"table:.*0\.0 s to 0\.01 s.*0\.012 s") as stop:
        drive(source, np.zeros((31, 0)))
    assert stop.value.steps == 11


@pytest.mark.parametrize("held", [False, True])
def test_decimated_holds_its_sample_between(held):
    """The component sees every row; every n-th of its outputs is passed on and holds."""
    every = drive(through(), U, held=held)
    assert (
        drive(Decimated(through(), N), U, held=held) == np.repeat(every[::N], N, axis=0)[: len(U)]
    ).all()


def test_decimated_declares_the_feedthrough_of_its_component():
    """At a sample instant the outputs depend on the input; a loop must know."""
    assert Decimated(through(), 4).interface.feeds("y") == ("u",)
    assert Decimated(Linear(lag(time_constant=1.0)), 4).interface.feeds("y") == ()


def test_decimated_passes_a_stop_on():
    """With the rows up to there."""
    t = np.array([0.0, 0.01])
    y = np.array([[0.0], [10.0]])
    with pytest.raises(Stopped, match=r"s.*0\.01 s.*0\.011 s") as stop:
        drive(Decimated(Table(t, y), 4), np.zeros((31, 0)))
    np.testing.assert_allclose(
        stop.value.outputs[:, 0], [0, 0, 0, 4, 4, 4, 4, 8, 8, 8], rtol=0, atol=2e-15
    )


@pytest.mark.parametrize("kind", [Sampled, Decimated])
def test_a_period_of_nothing_is_refused(kind):
    """At least one communication step."""
    with pytest.raises(ClockError, match=r"period:.*at least 1 communication step.*0"):
        kind(through(), 0)


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
@pytest.mark.parametrize("kind", [Sampled, Decimated])
def test_a_slow_component_with_feedthrough_works_in_a_loop(kind, coupling):
    """The output of the slow component is 2 u of the sample instant, for every size of the blocks.

    This holds too where u is extrapolated first.
    """
    tables = []
    for block in (1, 1000):
        memory = Memory()
        components = {
            "r": sine(amplitude=1.0, rate=40.0, phase=0.3, offset=0.0),
            "slow": kind(gain(np.array([[2.0]])), 5),
            "lag": Linear(lag(time_constant=0.02, initial=1.0)),
        }
        graph = Graph(components, {"slow.u": "lag.y", "lag.u": "slow.y"}, coupling=coupling)
        run(graph, Clock(0.1, 1e-3, block), memory)
        assert (memory["slow.y"] == np.repeat(2.0 * memory["lag.y"][::5], 5)[:101]).all()
        tables.append(np.column_stack([memory["slow.y"], memory["lag.y"]]))
    assert (tables[0] == tables[1]).all()
