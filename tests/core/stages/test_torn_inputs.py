"""Loops that iterate: order of convergence, algebraic loops, what cannot be solved."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from cosim.blocks import lag, switch
from cosim.blocks.derived import derived
from cosim.blocks.measurement import SensorParameters
from cosim.blocks.replay import Replay
from cosim.blocks.sampled import Sampled
from cosim.blocks.sensor import Sensor
from cosim.blocks.source import constant, ramp, step
from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.core.simulation import Simulation
from cosim.errors import GraphError, NonFiniteError, RunError
from tests.core.graphs import pair, record, solution, state_space, states


def relay(coupling="newton", *, part=None, plant=None):
    """Return a lag that a relay holds at 0.5, its threshold: u = -1 above and 1 below it."""
    components = {
        "relay": part or switch(),
        "below": constant([1.0]),
        "above": constant([-1.0]),
        "plant": plant or Linear(lag(time_constant=0.5, initial=0.0)),
    }
    connections = {
        "relay.control": "plant.y",
        "relay.u1": "above.y",
        "relay.u2": "below.y",
        "plant.u": "relay.y",
    }
    return Graph(components, connections, coupling=coupling)


@pytest.mark.parametrize("step", [0.1, 0.001])
def test_a_jump_that_a_loop_cannot_solve_is_named(step):
    """y(t1) of the plant is below 0.5 with u = -1 and above it with u = 1, so no u is what drives.

    That is so with any step, and the ways out that are offered run.
    """
    ways_out = 'discrete = true, or a period), or coupling = "gauss-seidel" or "jacobi"'
    with pytest.raises(
        RunError, match=r"inputs plant\.u of.*loop.*not solved.*'plant\.u'.*inputs of.*loop.*solve"
    ) as raised:
        record(relay(), step=step)
    assert "relay.y may jump with inputs of the loop" in str(raised.value)
    assert ways_out in str(raised.value)
    assert "smaller step" not in str(raised.value)
    record(relay(part=switch(discrete=True)), step=step)
    for coupling in ("gauss-seidel", "jacobi"):
        record(relay(coupling), step=step)


def test_a_jump_that_leaves_no_initial_values_is_named():
    graph = relay(plant=Linear(lag(time_constant=0.5)))
    with pytest.raises(GraphError, match=r"relay\.y may jump as inputs change, so that there may"):
        record(graph)


def test_initial_values_solve_the_algebraic_loop():
    """By hand: u1 = y2, u2 = y1 at x = (1, 1)."""
    memory = record(pair(), stop=0.01)
    found = [memory["one.u"][0], memory["two.u"][0]]
    expected = [-17.736842105263158, -14.736842105263158]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_newton_is_second_order_through_an_algebraic_loop():
    """The reference is the matrix exponential of the coupled system."""
    np.testing.assert_allclose(
        solution(1.0), [0.08597640367353255, 0.00839266482037434], rtol=1e-12
    )
    errors = []
    for h in (0.01, 0.005, 0.0025, 0.00125):
        error = states(record(pair(), step=h)) - solution(1.0)
        errors.append(np.abs(error).max())
    assert errors[0] < 1e-5
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(orders, 2.0, atol=0.1)
    assert np.abs(states(record(pair(), step=0.001)) - solution(1.0)).max() < 1e-7


def test_a_loop_without_feedthrough_is_second_order():
    """Of x1' = x2, x2' = -x1, against the cosine; Gauss-Seidel beside it is first order."""

    def error(coupling, step):
        components = {"p": state_space(0.0, 1.0, 1.0, 0.0, 1.0)}
        components["v"] = state_space(0.0, -1.0, 1.0, 0.0, 0.0)
        graph = Graph(components, {"p.u": "v.y", "v.u": "p.y"}, coupling=coupling)
        memory = record(graph, step=step)
        return np.abs(memory["p.x"] - np.cos(memory.time("p"))).max()

    steps = 0.01 / 2.0 ** np.arange(6)
    for coupling, order in (("gauss-seidel", 1.0), ("newton", 2.0)):
        errors = np.array([error(coupling, step) for step in steps])
        np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), order, atol=0.1)


def test_the_bits_do_not_depend_on_blocks_or_compiled_code():
    """What the solver keeps from step to step goes on from block to block."""
    whole = record(pair(), stop=0.2)
    for other in (record(pair(), 0.2, block=3), record(pair(native=False), 0.2)):
        for signal in ("one.u", "one.x", "two.u", "two.x"):
            assert whole[signal].tobytes() == other[signal].tobytes()


def test_an_input_with_a_held_element_follows_the_others():
    """One element is driven by a sampled signal, one is solved for: only the first is held."""
    matrices = {"A": -np.eye(1), "B": np.ones((1, 2)), "C": np.eye(1), "D": np.zeros((1, 2))}
    components = {
        "slow": Sampled(state_space(-0.5, 1.0, 1.0, 0.0, 0.1), 4, hold=True),
        "one": Linear(controller(**matrices, x0=np.ones(1))),
        "two": state_space(-2.0, 1.0, 1.0, 0.0, -0.5),
    }
    connections = {
        "slow.u": "one.y",
        "one.u[0]": "slow.y",
        "one.u[1]": "two.y",
        "two.u": "one.y",
    }
    graph = Graph(components, connections, coupling="newton")
    assert graph.held["one"].tolist() == [True, False]
    assert graph.held["two"].tolist() == [False]
    assert not graph.stages[0].is_first_order


@pytest.mark.parametrize("names", [("a", "b"), ("b", "a")])
def test_a_loop_is_torn_where_nothing_jumps(names):
    """The plant follows a step at once, so that its output jumps; that of the lag does not."""
    plant, lag = names
    matrices = {"A": -np.eye(1), "B": np.ones((1, 2)), "C": np.eye(1)}
    components = {
        "u": step(time=0.5, before=0.0, after=1.0),
        plant: Linear(controller(**matrices, D=np.array([[1.0, 0.0]]), x0=np.ones(1))),
        lag: state_space(-2.0, 1.0, 1.0, 0.0, 0.0),
    }
    connections = {
        f"{plant}.u[0]": "u.y",
        f"{plant}.u[1]": f"{lag}.y",
        f"{lag}.u": f"{plant}.y",
    }
    graph = Graph(components, connections, coupling="newton")
    assert graph.stages[1].torn.labels == [f"{plant}.u[1]"]
    assert graph.warnings == []
    # x1' = -x1 + u + x2, x2' = -2 x2 + x1 + u, with u = 1 from 0.5 s on
    A = np.array([[-1.0, 1.0], [1.0, -2.0]])
    before = scipy.linalg.expm(0.5 * A) @ [1.0, 0.0]
    rest = -np.linalg.solve(A, np.ones(2))
    exact = rest + scipy.linalg.expm(0.5 * A) @ (before - rest)
    memory = record(graph)
    found = [memory[f"{plant}.x"][-1], memory[f"{lag}.x"][-1]]
    np.testing.assert_allclose(found, exact, atol=1e-4)  # h^2; a ramp of 0.01 s would err by 5e-3


def test_a_state_goes_back_with_what_the_solver_keeps():
    """The steps behind it have the same bits again."""
    simulation = Simulation(pair(), Clock(1.0, 0.01))
    simulation.step(10)
    saved = simulation.state
    first = simulation.step(5)["one.u"]
    simulation.state = saved
    assert simulation.step(5)["one.u"].tobytes() == first.tobytes()


def test_a_loop_with_recorded_components_takes_what_was_solved_for():
    """A recorded component does not answer: solved again, other inputs would come out."""
    original = record(pair())

    def again(*, taken):
        components = {"one": Replay(original, "one"), "two": pair().components["two"]}
        connections = {"one.u": "two.y", "two.u": "one.y"}
        graph = Graph(components, connections, coupling="newton")
        if taken:
            graph.take_solutions(original, ["one"])
        return record(graph)

    same = again(taken=True)
    for signal in ("one.u", "one.y", "two.u", "two.y", "two.x"):
        assert same[signal].tobytes() == original[signal].tobytes()
    solved = again(taken=False)["one.u"]
    assert (solved != original["one.u"]).any()
    np.testing.assert_allclose(solved, original["one.u"], rtol=1e-10)


# --- nonlinear, and what has no solution ---


class Function:
    """y = f(u), which feeds through; ``rollback`` as there is nothing to go back to."""

    def __init__(self, function, n_u=1, *, rollback=True):
        self.function = function
        inputs = tuple(Signal(f"u{i}") for i in range(n_u))
        names = tuple(signal.name for signal in inputs)
        self.interface = Interface(inputs, (Signal("y"),), {"y": names}, rollback=rollback)

    def initialize(self, t, u):
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([self.function(t, *u)])

    def advance(self, t, h, u):
        return np.array([self.outputs(t1, u1) for t1, u1 in zip(t[1:], u[1:], strict=True)])

    def save(self):
        return None

    def restore(self, state):
        pass


def functions(**parts):
    """Return components of functions that take each other's outputs, by name."""
    components = {}
    connections = {}
    for name, (function, *sources) in parts.items():
        components[name] = Function(function, len(sources))
        for i, source in enumerate(sources):
            connections[f"{name}.u{i}"] = f"{source}.y"
    return Graph(components, connections, coupling="newton")


def test_a_nonlinear_loop_that_moves_is_solved_at_every_step():
    """cos(t + y) = y, against scipy's root finder."""
    graph = functions(a=(lambda t, y: np.cos(t + y), "b"), b=(lambda t, y: y, "a"))
    memory = record(graph, step=0.1)
    for t, y in zip(memory.time("a"), memory["a.y"], strict=True):
        expected = scipy.optimize.brentq(lambda v, t=t: np.cos(t + v) - v, -1.5, 1.5, xtol=1e-15)
        assert abs(y - expected) < 1e-12


def test_a_loop_without_a_solution_stops_and_names_its_inputs():
    """y = y^2 + 0.2 + t / 10 has two until 0.2 + t / 10 = 0.25, where they meet."""

    def square(t, y):
        return y * y + 0.2 + 0.1 * t

    graph = functions(a=(square, "b"), b=(lambda t, y: y, "a"))
    memory = Memory()
    expected = r"the inputs a\.u0 of.*loop were not solved at t ="
    with pytest.raises(RunError, match=expected):
        run(graph, Clock(1.0, 0.01), memory)
    assert 0.45 < memory.time("a")[-1] < 0.55


def test_a_component_that_cannot_go_back_is_named_before_the_run():
    """With what remains."""
    components = {
        "a": Function(lambda t, y: 0.5 * y, rollback=False),
        "b": Function(lambda t, y: y),
    }
    expected = r"coupling:.*'gauss-seidel' or 'jacobi' with 1 iteration"
    with pytest.raises(GraphError, match=expected):
        Graph(components, {"a.u0": "b.y", "b.u0": "a.y"}, coupling="newton")
    Graph(components, {"a.u0": "b.y", "b.u0": "a.y"}, coupling="jacobi")


def test_an_infinite_value_is_named_where_it_arose():
    """Not as an equation without a solution."""
    graph = functions(
        a=(lambda t, y: np.inf if t > 0.35 else 0.5 * y, "b"), b=(lambda t, y: y + 1.0, "a")
    )
    with pytest.raises(NonFiniteError, match=r"'a\.y' became inf at t = 0\.4 s"):
        record(graph, step=0.1)


def test_unknown_feedthrough_is_solved_with_the_rest():
    """There is nothing to assume, and to warn of."""
    component = state_space(-2.0, 1.0, 1.0, 0.5, 0.3)
    inputs = component.interface.inputs
    outputs = component.interface.outputs
    unknown = Interface(inputs, outputs, {o.name: None for o in outputs})
    component.interface = replace(component.interface, feedthrough=unknown.feedthrough)
    connections = {"a.u": "b.y", "b.u": "a.y"}
    parts = {"a": component, "b": state_space(-1.0, 1.0, 1.0, 0.5, 1.0)}
    graph = Graph(parts, connections, coupling="newton")
    assert graph.warnings == []
    memory = record(graph)
    np.testing.assert_allclose(memory["a.u"], memory["b.y"], rtol=1e-12)
    np.testing.assert_allclose(memory["a.y"], memory["a.x"] + 0.5 * memory["a.u"], rtol=1e-12)


# --- a fixed number of iterations, and inputs that hold their latest value ---


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
@pytest.mark.parametrize("interpolation", ["linear", "latest"])
def test_iterations_have_the_same_bits_in_compiled_code(coupling, interpolation):
    """In blocks of any length."""
    options = {"coupling": coupling, "input_interpolation": interpolation, "iterations": 3}
    expected = record(pair(**options, native=False), 0.1, 0.001)
    for block in (None, 1, 7):
        found = record(pair(**options), 0.1, 0.001, block=block)
        for signal in ("one.u", "one.x", "two.u", "two.x"):
            assert found[signal].tobytes() == expected[signal].tobytes()


def test_many_iterations_come_to_the_solution_of_newton():
    """Where each reduces what is left: without feedthrough, by the step times the gains."""

    def graph(**options):
        components = {"p": state_space(-1.0, 1.0, 1.0, 0.0, 1.0)}
        components["v"] = state_space(-1.0, -1.0, 1.0, 0.0, 0.0)
        return Graph(components, {"p.u": "v.y", "v.u": "p.y"}, **options)

    solved = record(graph(coupling="newton"))["p.x"]
    errors = []
    for iterations in (1, 2, 3, 8):
        iterated = record(graph(coupling="gauss-seidel", iterations=iterations))["p.x"]
        errors.append(np.abs(iterated - solved).max())
    assert errors[1] < 0.01 * errors[0]
    assert errors[2] < 0.01 * errors[1]
    assert errors[3] < 1e-14


def test_cascades_take_the_latest_value_over_the_whole_step():
    """A ramp behind an integrator: the rule of the right end, in one call or step by step."""
    for native in (True, False):
        for block in (None, 1, 4):
            graph = Graph(
                {"r": ramp(slope=1.0), "i": state_space(0.0, 1.0, 1.0, 0.0, 0.0)},
                {"i.u": "r.y"},
                input_interpolation="latest",
                native=native,
            )
            memory = record(graph, 1.0, 0.1, block=block)
            k = np.arange(11)
            np.testing.assert_allclose(memory["i.x"], 0.01 * k * (k + 1) / 2, rtol=1e-13)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"iterations": 0}, "iterations: expected an integer >= 1, got 0"),
        ({"iterations": 2}, "iterations: expected 1 with coupling = 'newton'"),
        (
            {"iterations": 2, "coupling": "jacobi", "input_interpolation": "zero-order"},
            "iterations: expected 1 with input_interpolation = 'zero-order'",
        ),
    ],
)
def test_iterations_that_change_nothing_are_refused(options, text):
    """With what would do."""
    with pytest.raises(GraphError) as caught:
        pair(**options)
    assert str(caught.value).startswith(text)


def test_the_order_of_a_loop_is_reported_as_measured():
    """Second order is said of lines that are solved for alone."""

    def order(**options):
        (stage,) = pair(**options).stages
        return 1 if stage.is_first_order else 2

    assert order() == 2
    assert order(input_interpolation="zero-order") == 1
    assert order(input_interpolation="latest") == 1
    assert order(coupling="gauss-seidel") == 1
    assert order(coupling="gauss-seidel", iterations=3) == 1


@pytest.mark.parametrize("coupling", ["newton", "gauss-seidel"])
def test_a_jump_in_an_algebraic_loop_is_solved_together(coupling):
    """Where an override is released, all of the loop is at the instant what follows from x."""
    simulation = Simulation(pair(coupling), Clock(1.0, 1e-3))
    simulation.step(10)
    simulation["one.u"] = 1.0
    simulation.step(5)
    x = np.array([simulation["one.x"][0], simulation["two.x"][0]])
    simulation.release("one.u")
    # y1 = 3 x1 + y2, y2 = -31 x2 - 0.9 y1, by hand
    y1 = (3.0 * x[0] - 31.0 * x[1]) / 1.9
    y2 = -31.0 * x[1] - 0.9 * y1
    found = [simulation[name][0] for name in ("one.u", "one.y", "two.u", "two.y")]
    np.testing.assert_allclose(found, [y2, y1, y1, y2], rtol=1e-12)
    simulation.step(1)


def test_a_jump_that_leaves_no_solution_is_reported():
    """y = u + 1 and u = y have none; an override held them apart until then."""
    parts = {"a": Function(lambda t, u: u if t < 0.05 else u + 1.0), "b": Function(lambda t, u: u)}
    parts["b"].function = lambda t, u: 0.5 * u if t < 0.05 else u
    graph = Graph(parts, {"a.u0": "b.y", "b.u0": "a.y"}, coupling="newton")
    simulation = Simulation(graph, Clock(1.0, 0.1))
    simulation["a.u0"] = 2.0
    simulation.step(1)
    simulation.release("a.u0")
    expected = r"after a jump at t = 0\.1 s, a\.u0, a\.y, b\.u0, b\.y"
    with pytest.raises(RunError, match=expected):
        simulation.step(1)


def test_the_schedule_names_iterations_and_unknowns():
    """A log keeps it, and a saved state is known by it."""
    schedules = []
    for options in ({}, {"coupling": "gauss-seidel", "iterations": 3}):
        schedules += pair(**options).prepare(10**7).schedule
    assert schedules == [
        "newton one two [one.u] (second order)",
        "gauss-seidel one two [one.u] (3 iterations)",
    ]


def test_a_loop_of_very_different_values_is_solved_in_each_of_them():
    """b = cos(3 t) + b / 2, with 1e16 b in the same loop: by hand b = 2 cos(3 t)."""
    graph = functions(
        a=(lambda t, u: 1e16 * u, "b"), b=(lambda t, u: 0.5e-16 * u + np.cos(3.0 * t), "a")
    )
    memory = record(graph, step=0.1)
    # the residual allowed, 2e-13 of the value, by (1 - 1 / 2)^-1; cos(3 t) is 0.06 at the least
    expected = 2.0 * np.cos(3.0 * memory.time("b"))
    np.testing.assert_allclose(memory["b.y"].ravel(), expected, rtol=1e-11)


@pytest.mark.parametrize("k", [5.0, 20.0, 100.0])
def test_a_steep_saturation_is_solved(k):
    """v = sin(5 t) - tanh(k v): it rises throughout, so that there is one solution."""
    graph = functions(
        a=(lambda t, v: np.sin(5.0 * t) - np.tanh(k * v), "b"), b=(lambda t, v: v, "a")
    )
    memory = record(graph, stop=2.0, step=0.01)
    for t, v in zip(memory.time("b"), memory["b.y"], strict=True):
        expected = scipy.optimize.brentq(
            lambda v, t=t: np.sin(5.0 * t) - np.tanh(k * v) - v, -2.0, 2.0, xtol=1e-15
        )
        assert abs(v - expected) < 1e-11


def test_outputs_that_may_jump_are_declared():
    """A switch, sign and step of signals, a quantizer; not where y is held, nor under a map."""
    assert switch().interface.jumping == ("y",)
    assert switch(discrete=True).interface.jumping == ()
    assert derived(["2 * sign(a.y)"]).interface.jumping == ("y",)
    assert derived(["2 * sign(a.y)"], variability="discrete").interface.jumping == ()
    assert derived(["abs(a.y)"]).interface.jumping == ()
    assert Sensor(SensorParameters(resolution=0.1)).interface.jumping == ("y",)
    assert Sensor(SensorParameters(resolution=0.1), holds=True).interface.jumping == ()
    assert Sensor(SensorParameters(bias=0.1)).interface.jumping == ()
