"""What linear interpolation over a step makes of fast modes, against runs and closed forms."""

import numpy as np
import pytest

from cosim.blocks.dynamics import lag
from cosim.blocks.sampled import Sampled
from cosim.blocks.source import sine, step
from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.gain.loop_gain import LinearizedLoops
from cosim.core.gain.resolution import LIMIT, resolution
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.stages.substep_control import SubstepTolerance
from tests.core.graphs import pair, record, solution

H = 0.01
STOP = 1.0


def first_order(rate, initial=0.0):
    """Return x' = rate (u - x)."""
    return Linear(lag(time_constant=1.0 / rate, initial=initial))


def found_of(graph, stop=STOP, h=H):
    """Return what is known of the step of a graph."""
    clock = Clock(stop, h)
    graph.prepare(clock.step_ns)
    row = np.zeros(graph.layout.width)
    graph.initialize(0.0, row)
    return resolution(graph, clock, row, LinearizedLoops.of(graph, clock, row).linearized)


def cascade(source, a, b, initial=0.0):
    """Return a source, a lag of the rate a, and one of the rate b that it drives."""
    parts = {"r": source, "fast": first_order(a, initial), "slow": first_order(b)}
    return Graph(parts, {"fast.u": "r.y", "slow.u": "fast.y"})


@pytest.mark.parametrize("product", [0.2, 0.5, 1.0, 2.4, 10.0])
def test_the_error_behind_a_jump_is_that_of_the_run(product):
    """Two lags a and b in a row answer a jump with 1 - (b exp(-a t) - a exp(-b t)) / (b - a)."""
    a = product / H
    b = 15.0
    graph = cascade(step(time=0.1), a, b)
    memory = record(graph, STOP, H)
    t = np.maximum(memory.time("slow.y") - 0.1, 0.0)
    exact = 1.0 - (b * np.exp(-a * t) - a * np.exp(-b * t)) / (b - a)
    error = np.abs(memory["slow.y"] - exact).max() / exact.max()
    found = found_of(graph)
    assert found.components == ("fast",)
    assert found.rate == pytest.approx(a)
    # which is found by straight lines between eight points of a step
    assert found.missed.error == pytest.approx(error, rel=0.05)
    assert (found.missed.signal, found.missed.cause) == ("slow.y", "a jump of r.y")
    assert found.is_resolved == (error <= LIMIT)


def test_the_step_that_is_offered_is_enough_and_the_next_longer_one_is_not():
    graph = cascade(step(time=0.1), 240.0, 20.0)
    found = found_of(graph)
    assert not found.is_resolved
    h = found.step_ns / 1e9
    assert found_of(graph, h=h).is_resolved
    assert not found_of(graph, h=2.0 * h).is_resolved


def test_an_initial_state_that_is_not_at_rest_excites_modes_as_a_jump_does():
    """An input that stays at 0, and a state that begins at 1; at rest there is no error."""
    for initial in (1.0, 0.0):
        found = found_of(cascade(sine(rate=0.0), 240.0, 20.0, initial=initial))
        assert found.is_resolved == (initial == 0.0)
        assert found.missed.cause == ("the initial state" if initial else "")


def oscillator(output):
    """Return x'' = 20 (u - x) - x' and a filter of u of 240 1/s; y is one of both."""
    A = np.array([[0.0, 1.0, 0.0], [-20.0, -1.0, 0.0], [0.0, 0.0, -240.0]])
    B = np.array([[0.0], [20.0], [240.0]])
    C = np.eye(3)[[output]]
    return Linear(controller(A=A, B=B, C=C, D=np.zeros((1, 1)), x0=np.zeros(3)))


RESOLVED = {
    "nothing excites it": ({"r": sine(rate=2.0), "fast": first_order(240.0)}, {"fast.u": "r.y"}),
    "it does not reach y": ({"r": step(time=0.1), "fast": oscillator(0)}, {"fast.u": "r.y"}),
}


@pytest.mark.parametrize("case", RESOLVED)
def test_a_fast_mode_that_nothing_excites_or_shows_is_no_error(case):
    """Product of mode and step 2.4 all the same; against the run with a tenth of the step."""
    parts, connections = RESOLVED[case]
    graph = Graph({**parts, "slow": first_order(20.0)}, {**connections, "slow.u": "fast.y"})
    found = found_of(graph)
    assert found.rate * H == pytest.approx(2.4)
    assert found.is_resolved
    coarse = record(graph, STOP, H)["slow.y"]
    fine = record(graph, STOP, H / 10)["slow.y"][::10]
    assert np.abs(coarse - fine).max() <= LIMIT * np.abs(fine).max()


def test_the_same_mode_where_it_is_shown_is_an_error():
    parts = {"r": step(time=0.1), "fast": oscillator(2), "slow": first_order(20.0)}
    assert not found_of(Graph(parts, {"fast.u": "r.y", "slow.u": "fast.y"})).is_resolved


def test_what_is_held_is_not_interpolated():
    """A component with a period has outputs that hold; the hold is exact for what follows."""
    parts = {"r": step(time=0.1), "fast": Sampled(first_order(240.0), 2), "slow": first_order(20.0)}
    found = found_of(Graph(parts, {"fast.u": "r.y", "slow.u": "fast.y"}))
    assert found.components == ()
    assert found.is_resolved
    graph = cascade(step(time=0.1), 240.0, 20.0)
    held = Graph(graph.components, graph.connections, input_interpolation="zero-order")
    assert found_of(held).components == ()


@pytest.mark.parametrize("h", [0.004, 0.01])
def test_the_error_of_a_loop_that_is_solved_is_that_of_the_run(h):
    """An algebraic loop with a mode of 163 1/s, its exact solution by a matrix exponential.

    Which is lost to straight lines alone, from both components to both.
    """
    graph = pair("newton")
    memory = record(graph, STOP, h)
    exact = np.array([solution(t) for t in memory.time("one.x")])
    found = found_of(pair("newton"), h=h)
    assert found.components == ("one", "two")
    assert not found.is_resolved
    swap = np.array([[0.0, 1.0], [1.0, 0.0]])
    C = np.diag([3.0, -31.0])
    D = np.diag([1.0, -0.9])
    y = np.linalg.solve(np.eye(2) - D @ swap, C @ exact.T).T
    errors = np.abs(np.column_stack([memory["one.y"], memory["two.y"]]) - y).max(axis=0)
    assert found.missed.signal == "one.y"
    assert found.missed.error == pytest.approx((errors / np.abs(y).max(axis=0)).max(), rel=0.05)


def test_of_an_unstable_mode_the_error_is_that_of_its_course():
    """Lines through exp(a t) have an integral too large by ah/2 coth(ah/2) - 1, at any time."""
    for rate, error in ((50.0, 0.25 / np.tanh(0.25) - 1.0), (500.0, 2.5 / np.tanh(2.5) - 1.0)):
        A, B, C = (np.array([[value]]) for value in (rate, 1.0, 1.0))
        unstable = Linear(controller(A=A, B=B, C=C, D=np.zeros((1, 1)), x0=np.zeros(1)))
        parts = {"r": step(time=0.1), "fast": unstable, "slow": first_order(0.1)}
        found = found_of(Graph(parts, {"fast.u": "r.y", "slow.u": "fast.y"}), stop=100.0)
        assert found.missed.error == pytest.approx(error, rel=0.05)


def test_a_loop_that_divides_its_steps_resolves_itself():
    graph = pair("newton", substeps=SubstepTolerance(1e-6, 1e-6))
    assert found_of(graph, h=0.1).components == ()


def test_of_what_a_component_with_a_period_makes_of_it_nothing_is_known():
    """Its input is interpolated over its period, here two steps: what the line misses counts."""
    parts = {"r": step(time=0.1), "fast": first_order(240.0), "slow": Sampled(first_order(20.0), 2)}
    found = found_of(Graph(parts, {"fast.u": "r.y", "slow.u": "fast.y"}))
    s = np.linspace(0.0, 1.0, 9)
    missed = 1.0 - np.exp(-4.8 * s) - s * (1.0 - np.exp(-4.8))
    assert found.missed.signal == "slow.u"
    assert found.missed.error == pytest.approx(missed.max(), rel=1e-6)
