"""The order of a loop: fewest broken connections, what needs no input first, names decide."""

import itertools
import random
from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.blocks.arithmetic import sum_of
from cosim.blocks.dynamics import Delay, lag
from cosim.blocks.sampled import Decimated, Sampled
from cosim.blocks.source import Noise, sine
from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.port import Port
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.core.structure import order as order_module
from cosim.core.structure.cycles import groups_in_order
from cosim.core.structure.order import order_loop
from cosim.testing import check_component
from tests.core.parts import InPython, half_through, integrator, times


def permuted(mapping, order):
    """Return a mapping with its items in another order."""
    items = list(mapping.items())
    return dict(items[i] for i in order)


# --- what goes first ---


def error_of_lag(names, slow, steps):
    """Return the error of x' = 2 (r - d - x) at 2 s; d is x delayed by 0.1 s, at first x(0).

    The reference integrates over each delay in turn, with the solution of the one before.
    """
    h = 0.1 / steps
    d, x = names
    components = {
        x: integrator(2.0, 1.0),
        d: slow(steps),
        "r": sine(rate=3.0),
        "s": sum_of([1.0, -1.0]),
    }
    connections = {"s.u1": "r.y", "s.u2": f"{d}.y", f"{x}.u": "s.y", f"{d}.u": f"{x}.y"}
    memory = Memory()
    run(Graph(components, connections), Clock(2.0, h), memory)
    past = lambda t: 1.0  # noqa: E731
    value = 1.0
    worst = 0.0
    for k in range(20):
        solution = scipy.integrate.solve_ivp(
            lambda t, y, past=past: 2.0 * (np.sin(3.0 * t) - past(t - 0.1) - y),
            (0.1 * k, 0.1 * (k + 1)),
            [value],
            method="DOP853",
            rtol=1e-12,
            atol=1e-14,
            dense_output=True,
        )
        past = lambda t, y=solution.sol: y(t)[0]  # noqa: E731
        value = solution.y[0, -1]
        worst = max(worst, abs(memory[f"{x}.y"][(k + 1) * steps] - value))
    return worst


@pytest.mark.parametrize("names", [("a", "b"), ("b", "a")])
def test_a_loop_with_a_delay_is_second_order(names):
    """The delay needs no input at the end of a step, so that the lag can be interpolated.

    Whatever their names: halving the step quarters the error.
    """
    coarse, fine = (error_of_lag(names, lambda n: Delay(n, initial=1.0), n) for n in (10, 20))
    assert 3.8 < coarse / fine < 4.2


@pytest.mark.parametrize(
    ("first", "coupling", "is_second"),
    [
        (lambda: Delay(1), "gauss-seidel", True),
        (lambda: Sampled(integrator(), 1, hold=True), "gauss-seidel", True),
        (integrator, "gauss-seidel", False),
        (lambda: Delay(1), "jacobi", False),
    ],
)
def test_the_schedule_names_the_order_of_a_loop(first, coupling, is_second):
    """The log and the summary of a run rest on it."""
    components = {"a": first(), "b": integrator()}
    graph = Graph(components, {"a.u": "b.y", "b.u": "a.y"}, coupling=coupling)
    (stage,) = graph.stages
    assert stage.is_first_order == (not is_second)
    assert stage.description.endswith(" (second order)") == is_second


class Lagging(InPython):
    """A plant whose y, which feeds through, belongs to the input inside a step."""

    def __init__(self):
        super().__init__(half_through())
        self.interface = replace(self.interface, lagging=("y",))


@pytest.mark.parametrize(("output", "is_second"), [("y", False), ("v", True)])
def test_a_loop_through_an_output_that_lags_is_first_order(output, is_second):
    """It is wrong by its slope over a part of a step; where another closes the loop, it is not."""
    components = {"plant": Lagging(), "b": integrator(), "sink": integrator()}
    connections = {"plant.u": "b.y", "b.u": f"plant.{output}", "sink.u": "plant.y"}
    graph = Graph(components, connections, coupling="newton")
    (loop,) = [stage for stage in graph.stages if len(stage.members) > 1]
    assert loop.is_first_order == (not is_second)
    assert loop.description.endswith(" (second order)") == is_second


def order_of(components, connections, **options):
    graph = Graph(components, connections, **options)
    (loop,) = [stage for stage in graph.stages if len(stage.members) > 1]
    operations = loop.description.removeprefix("gauss-seidel ").removesuffix("(second order)")
    return operations.split(), loop.extrapolated


@pytest.mark.parametrize(
    "first",
    [
        lambda: Delay(1),
        lambda: Sampled(integrator(), 1, hold=True),
        lambda: Decimated(Delay(2), 3),
        lambda: Sampled(Delay(2), 3),
    ],
)
def test_components_without_feedthrough_go_first(first):
    """A delay, a sampled controller, also inside another component."""
    components = {"a": integrator(), "r": sine(rate=1.0), "s": sum_of([1.0, 1.0]), "z": first()}
    connections = {"a.u": "s.y", "s.u1": "r.y", "s.u2": "z.y", "z.u": "a.y"}
    operations, extrapolated = order_of(components, connections)
    assert operations == ["z", "s", "a"]
    assert extrapolated == {"z": {"u"}, "s": set(), "a": set()}


def test_a_sampled_controller_with_feedthrough_still_samples_at_the_start():
    """Its outputs wait for the plant; whoever is first, no connection is broken twice."""
    interfaces = {
        "a": Interface((Signal("u"),), (Signal("y"),)),
        "c": Interface((Signal("u"),), (Signal("y"),), {"y": ("u",)}, delayed=("u",)),
    }
    sources = {"a": {"u": (Port("c", "y"),)}, "c": {"u": (Port("a", "y"),)}}
    order = order_loop(interfaces, sources, coupling="gauss-seidel")
    assert order.operations == (("advance", "a"), ("advance", "c"))
    assert order.broken == 1


def test_connections_from_a_zero_order_hold_are_not_broken():
    """A discrete output holds over the step anyway: the lag behind it goes first."""
    discrete = Decimated(integrator(3.0), 1)
    components = {"b": discrete, "z": integrator()}
    connections = {"z.u": "b.y", "b.u": "z.y"}
    operations, extrapolated = order_of(components, connections)
    assert operations == ["z", "b"]
    assert extrapolated["b"] == set()
    operations, _ = order_of(
        {"a": integrator(), "b": integrator(3.0)},
        {"a.u": "b.y", "b.u": "a.y"},
        input_interpolation="zero-order",
    )
    assert operations == ["a", "b"]


def test_a_stacked_input_counts_by_what_drives_it():
    """Of a discrete and a continuous source only the continuous one is broken.

    Behind a, nothing of the hub z is left to break where h is discrete, so that it goes before h.
    """
    for h, expected in ((Decimated(integrator(), 1), "a z h"), (integrator(), "a h z")):
        two = np.eye(2)
        hub = controller(A=-two, B=two, C=two, D=np.zeros((2, 2)), x0=np.zeros(2))
        components = {"z": Linear(hub), "h": h, "a": integrator(2.0)}
        connections = {"z.u": ["a.y", "h.y"], "h.u": "z.y[0]", "a.u": "z.y[1]"}
        operations, _ = order_of(components, connections)
        assert " ".join(operations) == expected


def test_a_sum_of_what_jumps_and_what_does_not_is_broken_as_a_whole():
    """Under a matrix each element may be a sum of all sources, so it follows them over the step."""
    two = np.eye(2)
    hub = controller(A=-two, B=two, C=two, D=np.zeros((2, 2)), x0=np.zeros(2))
    components = {"z": Linear(hub), "h": Decimated(integrator(), 1), "a": integrator(2.0)}
    connections = {
        "z.u": Connection(["a.y", "h.y"], [[1.0, 0.5], [0.0, 1.0]]),
        "h.u": "z.y[0]",
        "a.u": "z.y[1]",
    }
    operations, _ = order_of(components, connections)
    assert operations == ["a", "h", "z"]


@pytest.mark.parametrize("n", [1, 2, 3])
def test_delays_in_a_cycle_are_discrete(n):
    """Nothing continuous is behind them, also where one drives itself."""
    components = {f"d{i}": Delay(1, initial=1.0) for i in range(n)}
    connections = {f"d{i}.u": f"d{(i + 1) % n}.y" for i in range(n)}
    graph = Graph(components, connections)
    assert {graph.variability(Port(name, "y")) for name in components} == {"discrete"}


# --- fewest broken connections ---


def random_loop(seed, n):
    """Return interfaces and sources of components with some feedthrough and delayed inputs.

    A ring through all makes it one loop. Feedthrough goes from earlier to later names only, so that
    it closes no cycle.
    """
    chance = random.Random(seed)
    names = [f"c{i}" for i in range(n)]
    interfaces = {}
    sources = {}
    for i, name in enumerate(names):
        drivers = {names[(i + 1) % n]}
        drivers.update(chance.sample(names, chance.randint(0, min(2, n))))
        inputs = {f"u{j}": driver for j, driver in enumerate(sorted(drivers))}
        direct = tuple(u for u, d in inputs.items() if d < name and chance.random() < 0.4)
        delayed = tuple(u for u in inputs if chance.random() < 0.2)
        interfaces[name] = Interface(
            tuple(map(Signal, inputs)),
            (Signal("y"), Signal("v")),
            {"y": direct},
            delayed=delayed,
        )
        sources[name] = {u: (Port(d, chance.choice("yv")),) for u, d in inputs.items()}
    return interfaces, sources


def broken_by(sequence, interfaces, sources):
    """Count the connections that a sequence breaks, by sets of ports: no code in common."""
    final = set()
    advanced = []
    count = 0
    for name in sequence:
        for u, (port,) in sources[name].items():
            count += port not in final and u not in interfaces[name].delayed
        advanced.append(name)
        while True:
            new = {
                Port(c, output.name)
                for c in advanced
                for output in interfaces[c].outputs
                if all(sources[c][u][0] in final for u in interfaces[c].feeds(output.name))
            }
            if new <= final:
                break
            final |= new
    return count


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10**6), st.integers(1, 5))
def test_no_order_breaks_fewer_connections(seed, n):
    """All n! orders are tried."""
    interfaces, sources = random_loop(seed, n)
    order = order_loop(interfaces, sources, coupling="gauss-seidel")
    sequence = [name for kind, name in order.operations if kind == "advance"]
    least = min(broken_by(s, interfaces, sources) for s in itertools.permutations(interfaces))
    assert sorted(sequence) == sorted(interfaces)
    assert order.broken == broken_by(sequence, interfaces, sources) == least


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10**6), st.integers(2, 12))
def test_the_heuristic_is_a_valid_order(seed, n):
    """It says how many connections it breaks, and each component advances once."""
    interfaces, sources = random_loop(seed, n)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(order_module, "SEARCH", 0)
        order = order_loop(interfaces, sources, coupling="gauss-seidel")
    sequence = [name for kind, name in order.operations if kind == "advance"]
    assert sorted(sequence) == sorted(interfaces)
    assert order.broken == broken_by(sequence, interfaces, sources)


def ring(n):
    """Return a ring of n components, each without feedthrough."""
    interfaces = {f"c{i:04}": Interface((Signal("u"),), (Signal("y"),)) for i in range(n)}
    names = list(interfaces)
    sources = {name: {"u": (Port(names[i - 1], "y"),)} for i, name in enumerate(names)}
    return interfaces, sources


def test_a_large_ring_breaks_one_connection():
    """The search ends at its first candidate."""
    assert order_loop(*ring(1000), coupling="gauss-seidel").broken == 1


def test_the_heuristic_breaks_few_connections_of_a_large_loop():
    """Ten rings of ten on one hub: one connection each, or only those that enter the hub."""
    n = 10
    inputs = tuple(Signal(f"u{i}") for i in range(10))
    interfaces = {"hub": Interface(inputs, (Signal("y"),))}
    sources = {"hub": {f"u{i}": (Port(f"r{i}c{n - 1:02}", "y"),) for i in range(10)}}
    for i in range(10):
        for j in range(n):
            interfaces[f"r{i}c{j:02}"] = Interface((Signal("u"),), (Signal("y"),))
            behind = "hub" if j == 0 else f"r{i}c{j - 1:02}"
            sources[f"r{i}c{j:02}"] = {"u": (Port(behind, "y"),)}
    order = order_loop(interfaces, sources, coupling="gauss-seidel")
    assert order.broken == 10


def test_the_heuristic_counts_what_a_component_completes(monkeypatch):
    """A hub drives six components, which all drive its driver: it is cut before the hub, once.

    Each of the six breaks one connection too, and comes first by name.
    """
    monkeypatch.setattr(order_module, "SEARCH", 0)
    leaves = [f"a{i}" for i in range(6)]
    interfaces = {name: Interface((Signal("u"),), (Signal("y"),)) for name in (*leaves, "hub")}
    inputs = tuple(Signal(f"u{i}") for i in range(6))
    interfaces["tail"] = Interface(inputs, (Signal("y"),))
    sources = {name: {"u": (Port("hub", "y"),)} for name in leaves}
    sources["hub"] = {"u": (Port("tail", "y"),)}
    sources["tail"] = {f"u{i}": (Port(name, "y"),) for i, name in enumerate(leaves)}
    order = order_loop(interfaces, sources, coupling="gauss-seidel")
    assert order.broken == 1
    assert order.operations[0] == ("advance", "hub")


def test_among_equals_fewer_outputs_are_evaluated_again():
    """Delayed inputs that feed through break nothing in any order; in one, nothing waits."""
    discrete = Interface((Signal("u"),), (Signal("y"),), {"y": ("u",)}, delayed=("u",))
    interfaces = {"a": discrete, "b": discrete, "c": discrete}
    interfaces["z"] = Interface((Signal("u"),), (Signal("y"),), delayed=("u",))
    names = ["z", "c", "b", "a"]
    sources = {name: {"u": (Port(names[i - 1], "y"),)} for i, name in enumerate(names)}
    order = order_loop(interfaces, sources, coupling="gauss-seidel")
    assert order.operations == tuple(("advance", name) for name in names)


# --- nothing depends on the order of a file ---


@settings(deadline=None, max_examples=40)
@given(
    st.integers(0, 10**6),
    st.integers(1, 8),
    st.randoms(use_true_random=False),
    st.sampled_from(["gauss-seidel", "jacobi", "newton"]),
)
def test_the_order_does_not_depend_on_that_of_the_components(seed, n, chance, coupling):
    """Operations, extrapolated inputs and what is unknown are the same, also of the heuristic."""
    interfaces, sources = random_loop(seed, n)
    shuffled = list(interfaces)
    chance.shuffle(shuffled)
    first = order_loop(interfaces, sources, coupling=coupling)
    again = order_loop(
        {name: interfaces[name] for name in shuffled},
        {name: sources[name] for name in reversed(shuffled)},
        coupling=coupling,
    )
    assert first == again


@given(st.integers(0, 10**6), st.integers(1, 12), st.randoms(use_true_random=False))
def test_groups_come_after_what_they_depend_on(seed, n, chance):
    """In one order, whatever the order of the nodes; of two that could, the first by name."""
    names = [f"c{i}" for i in range(n)]
    draw = random.Random(seed)
    dependencies = {name: draw.sample(names, draw.randint(0, min(2, n))) for name in names}
    groups = groups_in_order(dependencies)
    shuffled = names[:]
    chance.shuffle(shuffled)
    assert groups_in_order({name: dependencies[name] for name in shuffled}) == groups
    place = {name: i for i, group in enumerate(groups) for name in group}
    for name, others in dependencies.items():
        assert all(place[other] <= place[name] for other in others)
    for first, second in itertools.pairwise(groups):
        depends = {other for name in second for other in dependencies[name]}
        assert depends & set(first) or first[0] < second[0]


def mixed_loop(seed):
    """Return components and connections of two random loops with all kinds of parts."""
    draw = random.Random(seed)
    makers = [
        lambda: integrator(draw.uniform(0.5, 5.0), 1.0),
        lambda: Delay(draw.randint(1, 4), initial=0.5),
        lambda: half_through(),
        lambda: Sampled(integrator(2.0, 0.3), draw.randint(1, 3), hold=draw.random() < 0.5),
        lambda: Decimated(integrator(1.5, 0.2), draw.randint(1, 3)),
    ]
    n = draw.randint(2, 6)
    components = {"n": Noise(deviation=1.0, seed=seed), "r": sine(rate=2.0)}
    connections = {}
    for i in range(n):
        components[f"p{i}"] = draw.choice(makers)()
        components[f"s{i}"] = sum_of([1.0, -0.5, 0.25])
        connections[f"p{i}.u"] = f"s{i}.y"
    for i in range(n):
        sources = [f"p{(i + 1) % n}", f"p{draw.randrange(n)}"]
        # v of a plant does not feed through, y may close an algebraic loop
        ports = [
            f"{p}.v" if len(components[p].interface.outputs) > 1 else f"{p}.y" for p in sources
        ]
        connections[f"s{i}.u1"] = "n.y" if i % 2 else "r.y"
        connections[f"s{i}.u2"] = ports[0]
        connections[f"s{i}.u3"] = Connection(ports[1], 0.5)
    return components, connections


@settings(deadline=None, max_examples=8)
@given(
    st.integers(0, 10**6),
    st.randoms(use_true_random=False),
    st.sampled_from(["gauss-seidel", "jacobi"]),
)
def test_results_do_not_depend_on_the_order_of_components_and_connections(seed, chance, coupling):
    """Bit for bit, with the schedule and the masks."""
    plans = []
    tables = []
    for shuffle in (False, True):
        components, connections = mixed_loop(seed)
        if shuffle:
            orders = [list(range(len(part))) for part in (components, connections)]
            for order in orders:
                chance.shuffle(order)
            components = permuted(components, orders[0])
            connections = permuted(connections, orders[1])
        memory = Memory()
        run(Graph(components, connections, coupling=coupling), Clock(0.03, 1e-3), memory)
        plans.append(memory.plan)
        tables.append(
            {
                f"{name}.{signal.name}": memory[f"{name}.{signal.name}"].tobytes()
                for name, channel in memory.channels.items()
                for signal in channel.signals
            }
        )
    assert plans[0].schedule == plans[1].schedule
    assert tables[0] == tables[1]
    for name, mask in plans[0].held.items():
        assert (mask == plans[1].held[name]).all()


def test_the_first_error_does_not_depend_on_the_order_of_components():
    """Of two components that fail at the same time the first by name is reported."""
    for names in (("a", "b"), ("b", "a")):
        components = {name: integrator(1.0, 1.0) for name in names}
        connections = {f"{name}.u": Connection(f"{name}.y", 1e200) for name in names}
        for name in names:
            components[f"k{name}"] = times(1e300)
            connections[f"k{name}.u"] = f"{name}.y"
        with pytest.raises(Exception, match=r"^'a\.") as caught:
            run(Graph(components, connections), Clock(1.0, 0.5), Memory())
        assert "became" in str(caught.value)


def test_the_contract_finds_a_delay_that_needs_its_input():
    """A component that says its input is delayed must not take it at the end of a step."""

    class Claims(Linear):
        def __init__(self):
            super().__init__(lag(time_constant=1.0, initial=0.0))
            self.interface = replace(self.interface, delayed=("u",))

    with pytest.raises(AssertionError, match="advance ignores a held input at the end of the step"):
        check_component(Claims)
    check_component(lambda: Sampled(Linear(lag(time_constant=1.0)), 2, hold=True))
