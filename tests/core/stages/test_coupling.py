"""The order of stages and operations, and what coupling costs."""

from __future__ import annotations

import random
from itertools import pairwise

import numpy as np
import pytest
import scipy.integrate
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim import blocks
from cosim.blocks.arithmetic import sum_of
from cosim.blocks.dynamics import Delay
from cosim.blocks.sampled import Sampled
from cosim.blocks.source import Noise, sine
from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.contracts import prepare
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.port import Port
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.core.simulation import Simulation
from cosim.core.structure.cycles import strongly_connected
from cosim.core.structure.feedthrough import UnknownFeedthrough
from cosim.core.structure.order import order_loop
from tests.core.graphs import discretized, gain_of, pair, pair_map, record
from tests.core.parts import InPython, half_through, integrator, through, times


def reference():
    return sine(amplitude=1.0, rate=3.0, phase=0.2, offset=0.5)


def cascade(**options):
    """Return r -> a -> b with a sum of both, listed in the wrong order."""
    components = {
        "sum": sum_of([1.0, -2.0]),
        "b": integrator(3.0),
        "a": through(),
        "r": reference(),
    }
    return Graph(
        components, {"a.u": "r.y", "b.u": "a.y", "sum.u1": "a.x", "sum.u2": "b.y"}, **options
    )


def loop(coupling="gauss-seidel", **options):
    """Return r - k v -> plant (v without, y with feedthrough), k a gain, and a sink behind y."""
    components = {
        "sink": integrator(2.0),
        "k": times(2.0),
        "s": sum_of([1.0, -1.0]),
        "plant": half_through(),
        "r": reference(),
    }
    connections = {
        "s.u1": "r.y",
        "s.u2": "k.y",
        "plant.u": "s.y",
        "k.u": "plant.v",
        "sink.u": "plant.y",
    }
    return Graph(components, connections, coupling=coupling, **options)


def two_lags(coupling="gauss-seidel", **options):
    """Return x1' = 2 (r - x2 - x1), x2' = 5 (x1 - x2)."""
    components = {
        "r": reference(),
        "s": sum_of([1.0, -1.0]),
        "x1": integrator(2.0, 1.0),
        "x2": integrator(5.0, -0.5),
    }
    return Graph(
        components,
        {"s.u1": "r.y", "s.u2": "x2.y", "x1.u": "s.y", "x2.u": "x1.y"},
        coupling=coupling,
        **options,
    )


def recorded_with(designs):
    """Return a run of the two lags with recorded designs."""
    graph = two_lags()
    memory = Memory()
    run(graph, Clock(1.0, 0.01), memory, graph.prepare(10**7, designs))
    return memory


def table(memory):
    """Return all signals side by side."""
    columns = []
    for channel in memory.channels.values():
        columns += [memory[f"{channel.name}.{signal.name}"] for signal in channel.signals]
    return np.column_stack(columns)


def test_cascades_are_ordered_by_their_connections():
    """Whatever the order they are named in."""
    assert cascade().prepare(10**7).schedule == (
        "cascade r",
        "cascade a",
        "cascade b",
        "cascade sum",
    )


def test_loops_are_separate_stages():
    """Two loops one after the other, and what stands before and behind, each in its place."""
    components = {name: integrator() for name in ("b2", "end", "a1", "a2")}
    components |= {"b1": sum_of([1.0, -1.0]), "sum": sum_of([1.0, 1.0]), "r": reference()}
    connections = {
        "sum.u1": "r.y",
        "sum.u2": "a2.y",
        "a1.u": "sum.y",
        "a2.u": "a1.y",
        "b1.u1": "a2.y",
        "b1.u2": "b2.y",
        "b2.u": "b1.y",
        "end.u": "b2.y",
    }
    schedule = Graph(components, connections).prepare(10**7).schedule
    assert schedule == ("cascade r", "gauss-seidel a1 a2 sum", "gauss-seidel b2 b1", "cascade end")
    assert Graph({"x": integrator()}, {"x.u": "x.y"}).prepare(10**7).schedule == ("gauss-seidel x",)


def interface(inputs, **outputs):
    return Interface(tuple(map(Signal, inputs)), tuple(map(Signal, outputs)), outputs)


def test_gauss_seidel_extrapolates_as_few_inputs_as_possible():
    """Components that need no input at the end of the step go first.

    Only the input that closes the cycle is extrapolated.
    """
    interfaces = {
        "gain": interface(["u"], y=("u",)),
        "sum": interface(["r", "u"], y=("r", "u")),
        "lag": interface(["u"], y=()),
    }
    sources = {
        "gain": {"u": (Port("lag", "y"),)},
        "sum": {"r": (Port("out", "y"),), "u": (Port("gain", "y"),)},
        "lag": {"u": (Port("sum", "y"),)},
    }
    order = order_loop(interfaces, sources, coupling="gauss-seidel")
    assert order.operations == (("advance", "lag"), ("advance", "gain"), ("advance", "sum"))
    assert order.extrapolated == {"lag": {"u"}, "gain": set(), "sum": set()}


def test_an_output_is_evaluated_again_when_an_extrapolated_input_feeds_through():
    """A plant has the outputs v = x and y = C x + D u, and a gain leads from v to u.

    The output y waits for the gain, and is evaluated again once.
    """
    interfaces = {"plant": interface(["u"], v=(), y=("u",)), "gain": interface(["u"], y=("u",))}
    sources = {"plant": {"u": (Port("gain", "y"),)}, "gain": {"u": (Port("plant", "v"),)}}
    order = order_loop(interfaces, sources, coupling="gauss-seidel")
    assert order.operations == (("advance", "plant"), ("advance", "gain"), ("refresh", "plant"))
    assert order.extrapolated == {"plant": {"u"}, "gain": set()}


def test_jacobi_extrapolates_every_input_from_inside():
    """All components advance with the values of the start of the step.

    Outputs that feed through are evaluated again, in order.
    """
    interfaces = {
        "gain": interface(["u"], y=("u",)),
        "sum": interface(["r", "u"], y=("r", "u")),
        "lag": interface(["u"], y=()),
    }
    sources = {
        "gain": {"u": (Port("lag", "y"),)},
        "sum": {"r": (Port("out", "y"),), "u": (Port("gain", "y"),)},
        "lag": {"u": (Port("sum", "y"),)},
    }
    order = order_loop(interfaces, sources, coupling="jacobi")
    assert order.operations == (
        ("advance", "gain"),
        ("advance", "lag"),
        ("advance", "sum"),
        ("refresh", "gain"),
        ("refresh", "sum"),
    )
    assert order.extrapolated == {"gain": {"u"}, "sum": {"u"}, "lag": {"u"}}


def test_all_unknown_feedthrough_of_a_component_is_one_warning():
    """However many ports close cycles; those that close none are not named."""
    names = [f"u{i}" for i in range(8)]
    interfaces = {
        "plant": interface([*names, "w"], y=None, v=None),
        "gain": interface(names, **{f"y{i}": (f"u{i}",) for i in range(8)}),
    }
    sources = {
        "plant": {f"u{i}": (Port("gain", f"y{i}"),) for i in range(8)} | {"w": (Port("out", "y"),)},
        "gain": {f"u{i}": (Port("plant", "y"),) for i in range(8)},
    }
    (unknown,) = order_loop(interfaces, sources, coupling="gauss-seidel").unknown
    assert unknown == UnknownFeedthrough("plant", ("y",), tuple(names))
    assert str(unknown).startswith(
        "plant.y may depend directly on plant.u0, plant.u1, plant.u2, plant.u3, plant.u4, "
        "plant.u5 and 2 more ("
    )


@given(
    st.integers(1, 9).flatmap(
        lambda n: st.lists(st.tuples(st.integers(0, n - 1), st.integers(0, n - 1)), max_size=25)
    )
)
def test_cycles_are_what_reaches_itself(edges):
    """Two ports stand together where each reaches the other, by the closure of the relation."""
    ports = [Port("c", str(i)) for i in range(9)]
    behind = {port: [ports[b] for a, b in edges if a == i] for i, port in enumerate(ports)}
    reach = np.eye(9, dtype=bool)
    for a, b in edges:
        reach[a, b] = True
    for k in range(9):
        reach |= reach[:, k : k + 1] & reach[k]
    found = strongly_connected(behind)
    for i, p in enumerate(ports):
        for j, q in enumerate(ports):
            assert (found[p] == found[q]) == (reach[i, j] and reach[j, i])


def test_unknown_feedthrough_counts_where_it_closes_no_cycle():
    """A plant of unknown feedthrough behind a lag waits for its input.

    Its outputs are evaluated again where that input is extrapolated.
    """
    interfaces = {"plant": interface(["u"], y=None), "lag": interface(["u"], y=())}
    sources = {"plant": {"u": (Port("lag", "y"),)}, "lag": {"u": (Port("plant", "y"),)}}
    order = order_loop(interfaces, sources, coupling="gauss-seidel")
    assert order.operations == (("advance", "lag"), ("advance", "plant"))
    assert (order.extrapolated, order.unknown) == ({"lag": {"u"}, "plant": set()}, ())
    order = order_loop(interfaces, sources, coupling="jacobi")
    assert order.operations == (("advance", "lag"), ("advance", "plant"), ("refresh", "plant"))
    assert (order.extrapolated, order.unknown) == ({"plant": {"u"}, "lag": {"u"}}, ())


def test_unknown_feedthrough_that_closes_a_cycle_is_taken_as_not_there():
    """Only where it does: w of the plant still counts, and y is refreshed with it."""
    interfaces = {
        "plant": interface(["u", "w"], y=None),
        "gain": interface(["u"], y=("u",)),
        "lag": interface(["u"], y=()),
    }
    sources = {
        "plant": {"u": (Port("gain", "y"),), "w": (Port("lag", "y"),)},
        "gain": {"u": (Port("plant", "y"),)},
        "lag": {"u": (Port("plant", "y"),)},
    }
    order = order_loop(interfaces, sources, coupling="gauss-seidel")
    assert order.unknown == (UnknownFeedthrough("plant", ("y",), ("u",)),)
    assert order.operations == (("advance", "lag"), ("advance", "plant"), ("advance", "gain"))
    assert order.extrapolated == {"lag": {"u"}, "plant": {"u"}, "gain": set()}
    order = order_loop(interfaces, sources, coupling="jacobi")
    assert order.unknown == (UnknownFeedthrough("plant", ("y",), ("u",)),)
    assert [operation for operation in order.operations if operation[0] == "refresh"] == [
        ("refresh", "plant"),
        ("refresh", "gain"),
    ]


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
def test_undeclared_feedthrough_is_a_step_late(coupling):
    """y = x + 0.5 u with u = -y / 2 of the step before, as the warning says.

    The output of the gain is of the same instant.
    """
    plant = through(0.5)
    plant.interface = Interface(
        plant.interface.inputs, plant.interface.outputs, {"y": None, "x": ()}, prepares=True
    )
    log = record(
        Graph({"p": plant, "k": times(-0.5)}, {"p.u": "k.y", "k.u": "p.y"}, coupling=coupling)
    )
    assert (log["k.y"] == -0.5 * log["p.y"]).all()
    assert (log["p.y"][1:] == log["p.x"][1:] + 0.5 * log["p.u"][:-1]).all()
    assert (
        abs(log["p.y"][0] - 0.3 / 1.25) <= 1e-15
    )  # at the start the algebraic loop is solved: y = x - 0.25 y


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
def test_direct_feedthrough_in_a_loop_belongs_to_the_same_instant(coupling):
    """The static equations hold at every row with the recorded values of that row."""
    log = record(loop(coupling))
    assert (log["k.y"] == 2.0 * log["plant.v"]).all()
    assert (log["s.y"] == log["r.y"] - log["k.y"]).all()
    assert (log["plant.u"] == log["s.y"]).all()
    # y = 2 v + 0.5 u, the kernel's sum starting from zero: the same two products
    assert (log["plant.y"] == 2.0 * log["plant.v"] + 0.5 * log["plant.u"]).all()


def error(graph, step):
    """Compare x1 and x2 of the loop at t = 2 s with an independent integration."""
    log = record(graph, 2.0, step)

    def f(t, x):
        return [2.0 * (np.sin(3.0 * t + 0.2) + 0.5 - x[1] - x[0]), 5.0 * (x[0] - x[1])]

    exact = scipy.integrate.solve_ivp(
        f, (0.0, 2.0), [1.0, -0.5], method="DOP853", rtol=1e-12, atol=1e-14
    ).y[:, -1]
    return np.abs(exact - [log["x1.y"][-1], log["x2.y"][-1]]).max()


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
def test_loops_are_first_order(coupling):
    """Extrapolated inputs hold: halving the step halves the error, up to the next order."""
    coarse, fine = (error(two_lags(coupling), step) for step in (4e-3, 2e-3))
    assert 1.9 < coarse / fine < 2.1


def cascade_error(step, **options):
    """Compare b of the cascade at t = 2 s with an independent integration."""
    log = record(cascade(**options), 2.0, step)

    def f(t, x):
        u = np.sin(3.0 * t + 0.2) + 0.5
        return [-2.0 * x[0] + u, 3.0 * (x[0] + 0.5 * u - x[1])]

    exact = scipy.integrate.solve_ivp(
        f, (0.0, 2.0), [0.3, 0.0], method="DOP853", rtol=1e-12, atol=1e-14
    ).y[:, -1]
    return np.abs(exact - [log["a.x"][-1], log["b.y"][-1]]).max()


def test_cascades_are_second_order():
    """With linear interpolation of the inputs, halving the step quarters the error.

    With a zero-order hold it halves the error.
    """
    assert 3.5 < cascade_error(0.02) / cascade_error(0.01) < 4.5
    assert (
        1.9
        < cascade_error(0.02, input_interpolation="zero-order")
        / cascade_error(0.01, input_interpolation="zero-order")
        < 2.1
    )


def noisy_loop(coupling):
    """Return a loop of noise, a delay, a plant, and a slow component with feedthrough."""
    components = {
        "n": Noise(deviation=1.0, seed=2),
        "s": sum_of([1.0, -1.0]),
        "slow": Sampled(through(), 4),
        "d": Delay(2, initial=0.25),
        "p": half_through(),
    }
    connections = {"s.u1": "n.y", "s.u2": "d.y", "slow.u": "s.y", "p.u": "slow.y", "d.u": "p.y"}
    return Graph(components, connections, coupling=coupling)


GRAPHS = {
    "cascade": cascade,
    "cascade with held inputs": lambda: cascade(input_interpolation="zero-order"),
    **{f"loop, {c}": lambda c=c: loop(c) for c in ("gauss-seidel", "jacobi")},
    **{f"two lags, {c}": lambda c=c: two_lags(c) for c in ("gauss-seidel", "jacobi")},
    **{f"noisy loop, {c}": lambda c=c: noisy_loop(c) for c in ("gauss-seidel", "jacobi")},
}


@pytest.mark.parametrize("name", GRAPHS)
def test_the_size_of_the_blocks_does_not_matter(name):
    """K = 1, 7 and 1000 give equal bits."""
    one, seven, thousand = (table(record(GRAPHS[name](), block=block)) for block in (1, 7, 1000))
    assert len(one) == 101
    assert (one.view(np.uint64) == thousand.view(np.uint64)).all()
    assert (seven.view(np.uint64) == thousand.view(np.uint64)).all()


@pytest.mark.parametrize("name", GRAPHS)
def test_every_component_can_be_verified_alone(name):
    """Recorded inputs and the mask of held inputs give the recorded outputs bit for bit."""
    memory = record(GRAPHS[name]())
    for component, alone in GRAPHS[name]().components.items():
        channel = memory.channels[component]
        plan = memory.plan
        u = np.hstack(
            [
                np.zeros((101, 0)),
                *(
                    np.atleast_2d(memory[f"{component}.{s.name}"].T).T
                    for s in channel.interface.inputs
                ),
            ]
        )
        y = np.hstack(
            [np.atleast_2d(memory[f"{component}.{s.name}"].T).T for s in channel.interface.outputs]
        )
        prepare(alone, 0.01, plan.held[component], plan.designs[component])
        found = np.vstack(
            [alone.initialize(0.0, u[0]), alone.advance(memory.time(component), 0.01, u)]
        )
        assert (found.view(np.uint64) == np.ascontiguousarray(y).view(np.uint64)).all(), component


def test_recorded_designs_are_used():
    """Another recorded matrix changes the run as it should; the same ones repeat it."""
    first = record(two_lags())
    designs = first.plan.designs
    assert (table(recorded_with(designs)) == table(first)).all()
    changed = {**designs, "x2": {**designs["x2"], "Ad": np.nextafter(designs["x2"]["Ad"], 2.0)}}
    second = recorded_with(changed)
    assert (second.plan.designs["x2"]["Ad"] == changed["x2"]["Ad"]).all()
    assert (
        second["x2.y"][1]
        == changed["x2"]["Ad"][0, 0] * -0.5
        + designs["x2"]["B0"][0, 0] * first["x2.u"][0]
        + designs["x2"]["B1"][0, 0] * first["x2.u"][1]
    )
    assert (table(second)[2:] != table(first)[2:]).any()


@pytest.mark.parametrize("native", [True, False])
def test_latest_values_are_the_same_in_blocks_of_any_length(native):
    """Of a component outside every loop, too, whose output feeds through from them."""
    memories = []
    for block in (1, 3, 20):
        components = {"u": sine(rate=5.0), "x": InPython(through()), "z": through()}
        connections = {"x.u": "u.y", "z.u": "x.y"}
        graph = Graph(components, connections, input_interpolation="latest", native=native)
        memory = Memory()
        run(graph, Clock(1.0, 0.05, block), memory)
        memories.append(memory)
    for memory in memories[1:]:
        for name in memory:
            assert memory[name].tobytes() == memories[0][name].tobytes()


# --- Jacobi: in every step all components take what the others gave before it ---


@pytest.mark.parametrize("interpolation", ["linear", "zero-order", "latest"])
@pytest.mark.parametrize("native", [True, False])
def test_an_algebraic_loop_takes_the_outputs_from_before_the_step(interpolation, native):
    """Row by row the map worked out by hand; the inputs recorded are what the sources gave last."""
    h = 6e-4
    graph = pair("jacobi", input_interpolation=interpolation, native=native)
    rows = record(graph, 0.3, h)[["one.x", "two.x", "one.y", "two.y"]]
    for before, after in pairwise(rows):
        # rounding of sums of values below 50, and of exp(A h)
        np.testing.assert_allclose(after, pair_map(h) @ before, rtol=0, atol=1e-12)
    memory = record(pair("jacobi"), 0.3, h)
    assert memory["one.u"].tobytes() == memory["two.y"].tobytes()
    assert memory["two.u"].tobytes() == memory["one.y"].tobytes()


@pytest.mark.parametrize("native", [True, False])
def test_an_override_of_what_is_kept_holds_from_where_it_is_set(native):
    """The output follows it at once, as it is no output from before the step."""
    simulation = Simulation(pair("jacobi", native=native), Clock(0.6, 6e-4))
    simulation.step(3)
    simulation["one.u"] = 2.0
    rows = simulation.step(4)
    np.testing.assert_allclose(rows["one.y"], 3.0 * rows["one.x"] + 2.0, rtol=1e-13)
    simulation.release("one.u")
    before = [simulation[name][0] for name in ("one.x", "two.x", "one.y", "two.y")]
    simulation.step(1)
    after = [simulation[name][0] for name in ("one.x", "two.x", "one.y", "two.y")]
    np.testing.assert_allclose(after, pair_map(6e-4) @ before, rtol=0, atol=1e-12)


@pytest.mark.parametrize("h", [0.01, 6.1e-4, 6e-4, 1e-4])
def test_the_gain_of_an_algebraic_loop_is_that_of_the_map_by_hand(h):
    """1.97 a step of 10 ms, which is refused; below 0.61 ms it is stable, and accepted."""
    gain = gain_of(pair("jacobi"), Clock(1000 * h, h))
    radius = np.abs(np.linalg.eigvals(pair_map(h))).max()
    assert gain.rho == pytest.approx(radius, rel=1e-12)
    if h == 0.01:
        assert gain.rho == pytest.approx(1.97, abs=0.005)
        assert gain.verdict == "refused"
    elif h <= 6e-4:
        assert gain.rho < 1.0
        assert gain.verdict == "fine"


def two_inputs():
    """Return x' = -2 x + u0 + 3 u1, y = x + 0.5 u0 + 0.3 u1."""
    D = np.array([[0.5, 0.3]])
    return Linear(controller(A=-2.0 * np.eye(1), B=np.array([[1.0, 3.0]]), C=np.eye(1), D=D))


def test_outputs_evaluated_again_keep_the_inputs_that_close_an_algebraic_loop():
    """a and b feed through to each other; a has a second input, known as soon as c has advanced.

    Outputs are evaluated again for that one, and belong to the other one from before the step.
    """
    h = 0.01
    parts = {"a": two_inputs(), "b": through(0.4), "c": integrator(3.0, 1.0)}
    connections = {"a.u": ["b.y", "c.y"], "b.u": "a.y", "c.u": "a.y"}
    graph = Graph(parts, connections, coupling="jacobi")
    (stage,) = graph.stages
    assert ("refresh", "a") in stage.order
    grown, by_input = discretized(-2.0, 1.0, h)
    grown_c, by_input_c = discretized(-3.0, 3.0, h)
    M = np.zeros((5, 5))  # of x_a, x_b, y_a, y_b, y_c
    M[0] = [grown, 0.0, 0.0, by_input, 3.0 * by_input]
    M[1] = [0.0, grown, by_input, 0.0, 0.0]
    M[4] = [0.0, 0.0, by_input_c, 0.0, grown_c]
    M[2] = M[0] + 0.3 * M[4]
    M[2, 3] += 0.5
    M[3] = M[1]
    M[3, 2] += 0.4
    gain = gain_of(Graph(parts, connections, coupling="jacobi"), Clock(1.0, h))
    assert gain.rho == pytest.approx(np.abs(np.linalg.eigvals(M)).max(), rel=1e-12)
    for native in (True, False):
        graph = Graph(parts, connections, coupling="jacobi", native=native)
        rows = record(graph, 1.0, h)[["a.x", "b.x", "a.y", "b.y", "c.y"]]
        for before, after in pairwise(rows):
            np.testing.assert_allclose(after, M @ before, rtol=0, atol=1e-14)


def graph_of(seed, names, **options):
    """Return a random loop of some names, with feedthrough, algebraic loops, and a sum."""
    draw = random.Random(seed)
    components = {}
    connections = {}
    for name in names:
        components[name] = draw.choice([integrator, through, half_through, two_inputs])()
    for i, name in enumerate(names):
        sources = [names[i - 1], draw.choice(names)]
        ports = []
        for source in sources:
            ports.append(f"{source}.{draw.choice(components[source].interface.outputs).name}")
        gains = np.array([[0.4, draw.choice([-0.3, 0.0, 0.2])]])
        if components[name].interface.n_u == 2:
            gains = np.diag(gains[0])
        connections[f"{name}.u"] = Connection(tuple(ports), gains)
    return Graph(components, connections, coupling="jacobi", **options)


@pytest.mark.slow
@settings(max_examples=40)
@given(
    st.integers(0, 10**6),
    st.permutations(["a", "b", "c", "d", "e"]),
    st.sampled_from(["linear", "zero-order", "latest"]),
    st.sampled_from([1, 2]),
    st.booleans(),
)
def test_names_decide_nothing(seed, names, interpolation, iterations, native):
    """All see the same, so that it does not matter who advances first."""
    if interpolation == "zero-order":
        iterations = 1  # more change nothing, and are refused
    tables = []
    for own_names in (sorted(names), names):
        options = {"input_interpolation": interpolation, "iterations": iterations}
        graph = graph_of(seed, own_names, native=native, **options)
        memory = Memory()
        run(graph, Clock(0.05, 0.01), memory)
        tables.append(np.hstack([memory.rows(name) for name in own_names]))
    # initial values of algebraic loops are solved for to 1e-12, and 5 steps multiply that by < 100
    np.testing.assert_allclose(tables[0], tables[1], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("interpolation", ["linear", "latest"])
@pytest.mark.parametrize("iterations", [2, 3])
def test_an_iteration_sees_what_the_one_before_gave(iterations, interpolation, native):
    """Beside a plain loop: x' = v, v' = -4 x, exact for straight lines or for constant inputs.

    A line begins where the one of the step before has ended: with what was tried there at last.

    Of 100 steps each of some roundings of values up to 2.
    """
    components = {
        "x": Linear(blocks.integrator(initial=1.0)),
        "v": Linear(blocks.integrator(initial=0.0)),
    }
    connections = {"x.u": "v.y", "v.u": Connection("x.y", gain=-4.0)}
    options = {"input_interpolation": interpolation, "iterations": iterations}
    memory = Memory()
    graph = Graph(components, connections, coupling="jacobi", native=native, **options)
    run(graph, Clock(1.0, 0.01), memory)
    h = 0.01
    weight = 0.5 if interpolation == "linear" else 1.0
    x, v = 1.0, 0.0
    begin = (v, x)  # of the inputs
    for _ in range(100):
        next_x, next_v = x, v
        for _ in range(iterations):
            end = (next_v, next_x)
            given = tuple(b + weight * (e - b) for b, e in zip(begin, end, strict=True))
            next_x, next_v = x + h * given[0], v - 4.0 * h * given[1]
        begin = end
        x, v = next_x, next_v
    assert memory["x.y"][-1] == pytest.approx(x, abs=1e-13)
    assert memory["v.y"][-1] == pytest.approx(v, abs=1e-13)
