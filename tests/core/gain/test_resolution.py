"""What a step makes of the responses of a model, against runs with a shorter one, closed forms."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from cosim.blocks.arithmetic import gain, sum_of
from cosim.blocks.dynamics import Delay, lag
from cosim.blocks.measurement import SensorParameters
from cosim.blocks.sampled import Sampled
from cosim.blocks.sensor import Sensor
from cosim.blocks.source import sine, step
from cosim.blocks.state_space import controller
from cosim.blocks.static import Static
from cosim.core.clock import Clock
from cosim.core.gain.loop_gain import LinearizedLoops
from cosim.core.gain.resolution import LIMIT, may_be_unresolved, resolution
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.signals import Interface, Signal
from cosim.core.stages.substep_control import SubstepTolerance
from tests.core.graphs import pair, record, solution
from tests.core.parts import InPython

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


def test_the_step_that_is_offered_is_written_to_the_nanosecond():
    """1/512 s has seven digits; with six it is no part of the step."""
    found = found_of(cascade(step(time=0.125), 240.0, 200.0), h=1 / 64)
    assert found.step_ns == 1_953_125
    assert found.cure == "use step = 0.001953125"


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


def test_what_holds_is_exact_where_it_is_sampled_and_late_where_all_is():
    """The hold of a component with a period is its own; that of every input lags by half a step."""
    parts = {"r": step(time=0.1), "fast": Sampled(first_order(240.0), 2), "slow": first_order(20.0)}
    found = found_of(Graph(parts, {"fast.u": "r.y", "slow.u": "fast.y"}))
    assert found.missed.error == 0.0
    graph = cascade(step(time=0.1), 240.0, 20.0)
    held = Graph(graph.components, graph.connections, input_interpolation="zero-order")
    assert found_of(held).missed.error > found_of(graph).missed.error


def linear(A, B, C):
    """Return x' = A x + B u, y = C x."""
    A, B, C = (np.array(M, np.float64) for M in (A, B, C))
    D = np.zeros((len(C), B.shape[1]))
    return Linear(controller(A=A, B=B, C=C, D=D, x0=np.zeros(len(A))))


def oscillating(rate, damping, output):
    """Return a system of second order; y is its state or that of its derivative."""
    A = [[0.0, rate], [-rate, -2.0 * damping * rate]]
    return linear(A, [[0.0], [rate]], np.eye(2)[[output]])


def behind(*blocks):
    """Return a jump and blocks one behind the other."""
    parts = {"r": step(time=0.1)}
    connections = {}
    for number, block in enumerate(blocks):
        connections[f"b{number}.u"] = f"{list(parts)[-1]}.y"
        parts[f"b{number}"] = block
    return parts, connections


def beside(a, b):
    """Return the difference of two lags that a jump drives, and a lag behind it."""
    parts = {"r": step(time=0.1), "f": first_order(a), "g": first_order(b)}
    parts |= {"sum": sum_of([1.0, -1.0]), "c": first_order(20.0)}
    wires = {"f.u": "r.y", "g.u": "r.y", "sum.u1": "f.y", "sum.u2": "g.y", "c.u": "sum.y"}
    return parts, wires


def around(forward):
    """Return a lag that feeds back to what drives it beside a jump."""
    return {"r": step(time=0.1), "f": forward, "c": first_order(20.0)}, {
        "f.u": ["r.y", "c.y"],
        "c.u": "f.y",
    }


def first_of_two(rate):
    """Return x' = rate (u[0] - u[1] - x)."""
    return linear([[-rate]], [[rate, -rate]], [[1.0]])


MODELS = {
    "a stage behind a slower one": lambda: behind(
        first_order(10.11), oscillating(350.61, 0.25, 1), first_order(1.0 / 0.0092)
    ),
    "two stages that are fast": lambda: behind(
        first_order(212.1), oscillating(217.8, 0.5, 0), first_order(16.4)
    ),
    "a gain between": lambda: behind(
        first_order(150.0), gain(np.array([[3.0]])), first_order(80.0)
    ),
    "branches nearly alike": lambda: beside(40.0, 44.0),
    "fast branches nearly alike": lambda: beside(150.0, 160.0),
    "a loop": lambda: around(first_of_two(60.0)),
    "a fast loop": lambda: around(first_of_two(150.0)),
    "a jump beside what is continuous": lambda: (
        {
            "r": step(time=0.1),
            "v": first_order(2.0),
            "s": sum_of([1.0, 1.0]),
            "c": first_order(100.0),
        },
        {"v.u": "r.y", "s.u1": "r.y", "s.u2": "v.y", "c.u": "s.y"},
    ),
}


def largest_error(make, **options):
    """Return the largest error of an output of a run, by a run with a twentieth of the step."""
    coarse, fine = (record(Graph(*make(), **options), STOP, step) for step in (H, H / 20))
    errors = {}
    for name, member in Graph(*make(), **options).members.items():
        for signal in member.channel.interface.outputs:
            label = f"{name}.{signal.name}"
            exact = fine[label][::20]
            error = np.abs(coarse[label] - exact).max(axis=0) / np.abs(exact).max(axis=0)
            errors[label] = float(np.max(error))
    return max(errors.values())


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi", "newton"])
@pytest.mark.parametrize("model", MODELS)
def test_the_error_of_a_model_is_that_of_a_run(model, coupling):
    """By a fifth; stage by stage it would be less, or none, in the most of these."""
    options = {"coupling": coupling}
    found = found_of(Graph(*MODELS[model](), **options))
    error = largest_error(MODELS[model], **options)
    assert found.missed.error == pytest.approx(error, rel=0.2)
    assert found.is_resolved == (error <= LIMIT)
    assert found.unknown == ()


@pytest.mark.parametrize("held", ["zero-order", "latest"])
def test_inputs_that_hold_count_too(held):
    options = {"input_interpolation": held}
    found = found_of(Graph(*MODELS["a gain between"](), **options))
    error = largest_error(MODELS["a gain between"], **options)
    assert found.missed.error == pytest.approx(error, rel=0.2)


def squared(scale):
    """Return y = u**2, or a line through the same points that is none near 0."""
    interface = Interface((Signal("u"),), (Signal("y", variability="inherited"),), {"y": ("u",)})
    return Static(interface, lambda u: u**2 if scale is None else scale * u)


def test_what_is_not_linear_between_a_fast_mode_and_another_is_not_known():
    """It is where it is linear, where the mode is slow, and where nothing integrates behind it."""
    cases = {
        "squared": (squared(None), 300.0, first_order(50.0), True),
        "linear": (squared(2.0), 300.0, first_order(50.0), False),
        "slow": (squared(None), 3.0, first_order(50.0), False),
        "last": (squared(None), 300.0, gain(np.eye(1)), False),
    }
    for name, (between, rate, last, is_unknown) in cases.items():
        found = found_of(Graph(*behind(first_order(rate), between, last)))
        assert found.unknown == (("b1",) if is_unknown else ()), name


def test_of_what_cannot_be_linearized_nothing_is_known_where_fast_modes_drive_it():
    """One that is not known to take samples; one that only drives others may be fast itself."""
    for rates, unknown in (((300.0, 50.0), "b1"), ((3.0, 50.0), None), ((3.0, 50.0, 5.0), "b1")):
        blocks = [first_order(rate) for rate in rates]
        blocks[1] = InPython(blocks[1])
        blocks[1].interface = replace(blocks[1].interface, continuous=False)
        found = found_of(Graph(*behind(*blocks)))
        assert found.unknown == (() if unknown is None else (unknown,))


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
    found = found_of(graph, h=0.1)
    assert found.components == ()
    assert found.is_resolved
    assert found.unknown == ()


def test_too_many_states_are_left_undecided():
    many = linear(-np.eye(201), np.ones((201, 1)), np.ones((1, 201)))
    assert found_of(Graph(*behind(many))).unknown == ("b0",)


def test_a_loop_through_a_sampled_component_is_decided_only_far_below_the_limit():
    """What feeds back through it may multiply the error, as in the run; it is not in the model."""
    for rate, is_decided in ((250.0, False), (2.5, True)):
        parts = {"r": step(time=0.1), "fast": first_order(rate), "c": first_order(3.0)}
        parts |= {"e": sum_of([1.0, -1.0]), "p": Sampled(gain(np.array([[2.0]])), 5)}
        wires = {"e.u1": "r.y", "e.u2": "c.y", "p.u": "e.y", "fast.u": "p.y", "c.u": "fast.y"}
        found = found_of(Graph(parts, wires))
        assert found.is_resolved
        assert found.unknown == (() if is_decided else ("p",))


def two_states(w, x0):
    """Return x'' = w^2 (u - x) - w x', and x + u."""
    A = np.array([[0.0, w], [-w, -w]])
    B = np.array([[0.0], [w]])
    C = np.array([[1.0, 0.3]])
    return Linear(controller(A=A, B=B, C=C, D=np.array([[1.143]]), x0=np.asarray(x0)))


@pytest.mark.parametrize("w", [1.3, 2.7, 3.1, 4.2, 5.286, 5.9])
def test_what_stays_at_rest_has_no_response(w):
    """Rounding of equations solved together, and of an exponential, is none."""
    parts = {"r": sine(rate=0.0), "rests": two_states(w, [0.0, 0.0])}
    parts |= {"moves": two_states(6.428, [1.0, 0.5]), "slow": first_order(3.0)}
    connections = {"rests.u": "r.y", "moves.u": "rests.y", "slow.u": "moves.y"}
    found = found_of(Graph(parts, connections))
    assert found.is_resolved
    assert found.missed.signal.startswith("slow.")


@pytest.mark.parametrize("interpolation", ["linear", "zero-order", "latest"])
@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
def test_a_run_looks_at_what_holds_by_the_scenario(coupling, interpolation):
    lags = {"r": step(time=0.1), "fast": first_order(240.0), "slow": first_order(20.0)}
    connections = {"fast.u": "r.y", "slow.u": "fast.y"}
    graph = Graph(lags, connections, coupling=coupling, input_interpolation=interpolation)
    graph.prepare(Clock(STOP, H).step_ns)
    assert may_be_unresolved(graph, graph.components.keys())


def test_a_sensor_with_a_period_of_one_step_holds():
    """Its samples jump; from them the exact response of what follows is that of the run."""
    measured = Sensor(SensorParameters(), holds=True)
    parts = {"r": step(time=0.1), "fast": first_order(5.27), "m": measured, "g": first_order(5.52)}
    found = found_of(Graph(parts, {"fast.u": "r.y", "m.u": "fast.y", "g.u": "m.y"}))
    assert found.missed.error == 0.0


@pytest.mark.parametrize(("rate", "unknown"), [(288.0, ("delay",)), (0.5, ())])
def test_behind_a_delay_it_is_decided_only_where_a_jump_would_be_resolved(rate, unknown):
    """What a slow lag sends through the delay begins with a kink, which may excite a fast mode."""
    one = np.eye(1)
    washout = controller(A=-rate * one, B=rate * one, C=-one, D=one, x0=np.zeros(1))
    parts = {
        "r": step(time=0.1),
        "slow": first_order(5.0),
        "delay": Delay(2),
        "washout": Linear(washout),
        "behind": first_order(min(rate, 20.0)),
    }
    names = list(parts)
    wires = {f"{to}.u": f"{name}.y" for name, to in pairwise(names)}
    found = found_of(Graph(parts, wires))
    assert found.unknown == unknown
    assert found.missed.error < LIMIT
