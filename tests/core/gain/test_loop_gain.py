"""The gain of a loop against runs of the graph itself, and what it refuses."""

import math

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.blocks.dynamics import Delay, integrator
from cosim.blocks.pid import Pid, PidParameters
from cosim.blocks.sampled import Decimated, Sampled
from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.gain.loop_gain import LinearizedLoops
from cosim.core.gain.loop_map import loop_model, one_step_maps
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.errors import NonFiniteError
from tests.core.graphs import gain_of, loops_of, pair
from tests.core.parts import Scripted, times

NEWTON = {"coupling": "newton", "input_interpolation": "linear"}
WAYS = [
    {"coupling": coupling, "input_interpolation": interpolation}
    for coupling in ("gauss-seidel", "jacobi")
    for interpolation in ("linear", "zero-order")
]
WAYS += [
    {"coupling": "gauss-seidel", "input_interpolation": "latest"},
    {"coupling": "gauss-seidel", "input_interpolation": "linear", "iterations": 2},
    {"coupling": "jacobi", "input_interpolation": "latest", "iterations": 3},
    NEWTON,
]


def name_of(way):
    """Name a coupling with its options."""
    return "-".join(map(str, way.values()))


def system(A, B, C, D, x0=None):
    """Return a linear component with input u, outputs y and x."""
    return Linear(controller(A=A, B=B, C=C, D=D, x0=x0))


def scalar(a, b, c, d=0.0, x0=1.0):
    """Return x' = a x + b u, y = c x + d u."""
    values = [np.array([[value]]) for value in (a, b, c, d)]
    return system(*values, x0=np.array([x0]))


def rows_of(graph, clock):
    """Return all rows of a run."""
    memory = Memory()
    run(graph, clock, memory)
    names = [
        f"{channel.name}.{s.name}" for channel in graph.layout.channels for s in channel.signals
    ]
    return memory[names]


# --- the gain against runs ---


def random_parts(rng, *, h):
    """Return components by name and the connections of a random loop, without algebraic loops.

    Each has 1 to 3 states of any stability, and is driven by one or two others.
    """
    count = int(rng.integers(2, 5))
    names = [f"c{i}" for i in range(count)]
    parts = {}
    connections = {}
    for i, name in enumerate(names):
        n = int(rng.integers(1, 4))
        A = rng.normal(size=(n, n)) * rng.choice([0.1, 1.0]) / h
        A -= rng.uniform(0.0, 2.0) / h * np.eye(n)
        D = rng.normal(size=(1, 1)) * float(i > 0 and rng.random() < 0.5)
        parts[name] = (A, rng.normal(size=(n, 1)) / h, rng.normal(size=(1, n)), D)
        # what feeds through is driven by those before it alone, so that no cycle is algebraic
        others = names[:i] if D.any() else [other for other in names if other != name]
        sources = {names[i - 1]} | {str(rng.choice(others))}
        if D.any():
            sources &= set(others)
        gains = rng.normal(size=(1, len(sources)))
        connections[f"{name}.u"] = Connection([f"{s}.y" for s in sorted(sources)], gain=gains)
    return parts, connections


def identified_radius(parts, connections, clock, way):
    """Return the spectral radius of the map behind the rows of runs from many initial states.

    Rows have the states of all components, and so all that a step hands on: what one row does to
    the next is that map, on all that is reached (dynamic mode decomposition).
    """
    rng = np.random.default_rng(1)
    before, after = [], []
    for _ in range(8):
        components = {
            name: system(*matrices, x0=rng.normal(size=len(matrices[0])))
            for name, matrices in parts.items()
        }
        rows = rows_of(Graph(components, connections, **way), clock)
        scale = np.abs(rows[:-1]).max(axis=1, keepdims=True)
        before.append(rows[:-1] / scale)
        after.append(rows[1:] / scale)
    X = np.vstack(before).T
    U, values, _ = np.linalg.svd(X, full_matrices=False)
    U = U[:, values > 1e-9 * values[0]]
    reduced = U.T @ np.vstack(after).T @ np.linalg.pinv(U.T @ X, rcond=1e-12)
    return np.abs(np.linalg.eigvals(reduced)).max()


@pytest.mark.fast("gauss-seidel-linear")
@pytest.mark.parametrize("way", WAYS, ids=name_of)
def test_the_gain_is_that_of_runs_and_what_explodes_is_refused(way):
    """Rows of runs grow by rho in a step, for every coupling and interpolation.

    Refused is what grows tenfold beyond the poles of the system, which are solved for otherwise.
    """
    wrong = []
    steps = 300
    for seed in range(12):
        rng = np.random.default_rng(seed)
        parts, connections = random_parts(rng, h=0.01)
        components = {name: system(*matrices) for name, matrices in parts.items()}
        gain = gain_of(Graph(components, connections, **way), Clock(steps * 0.01, 0.01))
        radius = identified_radius(parts, connections, Clock(0.3, 0.01), way)
        rate = max(pole.real for pole in poles_of(parts, connections))
        exponent = steps * (math.log(radius) - max(0.0, 0.01 * rate))
        assert abs(exponent - math.log(10.0)) > 0.1  # no seed is so close that the fit decides
        # The fit knows a mode as well as it stands out of the others: 1e-6 of it was the worst.
        agrees = radius == pytest.approx(gain.rho, rel=1e-5)
        agrees &= gain.rate == pytest.approx(rate, rel=1e-9)
        agrees &= (gain.verdict == "refused") == (exponent > math.log(10.0))
        if not agrees:
            wrong.append((seed, gain, radius, rate, exponent))
    assert wrong == []


def sampled_loops():
    """Return loops with components of periods of their own, by name, with a growth near 1."""
    plant = scalar(0.4, 1.0, 1.0)
    discrete = Pid(PidParameters(-2.5, integral_time=0.3), period=0.04)
    loop = {"p.u": "k.y"}
    return {
        "delay": (
            {"p": plant, "k": Delay(7, initial=0.0)},
            {"p.u": "k.y", "k.u": Connection("p.y", gain=-3.0)},
        ),
        "sampled": (
            {"p": plant, "k": Sampled(times(-26.0), 8, hold=True)},
            {**loop, "k.u": "p.y"},
        ),
        "sampled PI": (
            {"p": plant, "k": Sampled(discrete, 4, hold=True), "r": Scripted([0.0] * 601)},
            {**loop, "k.setpoint": "r.y", "k.measurement": Connection("p.y", gain=-1.0)},
        ),
        "slow": (
            {"p": plant, "k": Sampled(scalar(-1.0, 1.0, -3.0, -0.2), 3)},
            {**loop, "k.u": "p.y"},
        ),
        "decimated": (
            {"p": plant, "k": Decimated(scalar(-2.0, 1.0, -9.0, -0.2), 5)},
            {**loop, "k.u": "p.y"},
        ),
        "two periods": (
            {
                "p": plant,
                "k": Sampled(times(-2.0), 3, hold=True),
                "l": Decimated(scalar(-2.0, 1.0, -3.0, -0.2), 2),
            },
            {"p.u": Connection(["k.y", "l.y"], gain=[[1.0, 1.0]]), "k.u": "p.y", "l.u": "p.y"},
        ),
    }


@pytest.mark.fast("two periods")
@pytest.mark.parametrize("name", sampled_loops())
def test_the_map_of_loops_with_periods_and_delays_gives_the_rows_of_runs(name):
    """From the initial state every row is the map of the row before, over many periods."""
    for way in WAYS:
        components, connections = sampled_loops()[name]
        rows, mapped = rows_and_maps(Graph(components, connections, **way))
        for before, after, found in zip(rows, rows[1:], mapped, strict=False):
            # rounding of 600 products
            atol = 1e-11 * np.abs(before).max()
            np.testing.assert_allclose(found, after, rtol=0, atol=atol, err_msg=str(way))


def rows_and_maps(graph):
    """Return the rows of a run, and those that the maps of its steps make of the initial state."""
    clock = Clock(6.0, 0.01)
    loops = loops_of(graph, clock)
    (loop,) = (stage for stage in graph.stages if stage.is_loop)
    masks = (graph.held, graph.latest)
    model = loop_model(loop, loops.linearized, *masks, h=clock.step, width=graph.layout.width)
    maps = one_step_maps(model)
    rows = outputs_of(graph, clock, [member.name for member in loop.members])
    state = []
    for member, step, linearized in zip(loop.members, model.steps(0), model.members, strict=True):
        start = np.zeros(step.n_s)  # what is held is set where the first step begins
        if not linearized.delay and "x" in member.channel.by_name:
            start[: len(linearized.A)] = 1.0
        state.append(start)
    kept = [model.wiring[number][element] @ rows[0] for number, element in model.torn]
    state = np.concatenate([*state, rows[0], kept[: model.n_kept]])
    end = len(state) - model.n_kept
    mapped = []
    for k in range(clock.steps):
        state = maps[k % len(maps)] @ state
        mapped.append(state[end - rows.shape[1] : end])
    return rows, mapped


def outputs_of(graph, clock, names):
    """Return the rows of a run: the outputs of some components, one behind the other."""
    memory = Memory()
    run(graph, clock, memory)
    signals = [f"{name}.{s.name}" for name in names for s in graph.layout[name].interface.outputs]
    return memory[signals]


# --- what is refused ---


def poles_of(parts, connections):
    """Return the poles of connected parts by the pencil s E - A of all their equations."""
    names = list(parts)
    n = sum(len(parts[name][0]) for name in names)
    m = len(names)
    E = np.zeros((n + 2 * m, n + 2 * m))
    M = np.zeros_like(E)
    E[:n, :n] = np.eye(n)
    first = 0
    for i, name in enumerate(names):
        A, B, C, D = parts[name]
        x = slice(first, first + len(A))
        first += len(A)
        u, y = n + i, n + m + i
        M[x, x] = A
        M[x, u] = B[:, 0]
        M[y, x] = C
        M[y, u] = D[0, 0]
        M[y, y] = -1.0
        connection = connections[f"{name}.u"]
        for source, gain in zip(connection.sources, connection.matrix[0], strict=True):
            M[u, n + m + names.index(source.component)] += gain
        M[u, u] = -1.0
    poles = scipy.linalg.eigvals(M, E)
    return poles[np.isfinite(poles) & (np.abs(poles) < 1e8)]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(WAYS))
def test_a_damped_loop_at_a_small_step_is_not_refused(seed, way):
    """As the step goes to zero every coupling without algebraic loop follows the system."""
    rng = np.random.default_rng(seed)
    parts, connections = random_parts(rng, h=0.01)
    rate = max(pole.real for pole in poles_of(parts, connections))
    if rate > -1.0:
        return
    components = {name: system(*matrices) for name, matrices in parts.items()}
    clock = Clock(10.0, 1e-6)
    gain = gain_of(Graph(components, connections, **way), clock)
    assert gain.verdict == "fine"
    assert gain.rho < 1.0


def chain(count, way):
    """Return integrators in a chain that is closed by a connection without gain."""
    parts = {f"i{k}": Linear(integrator()) for k in range(count)}
    connections = {f"i{k}.u": f"i{k - 1}.y" for k in range(1, count)}
    connections["i0.u"] = Connection(f"i{count - 1}.y", gain=0.0)
    return Graph(parts, connections, **way)


@pytest.mark.parametrize("way", WAYS, ids=name_of)
def test_integrators_in_a_chain_are_not_refused_for_rounding(way):
    """Their eigenvalues coincide at 1, and none of them is beyond it, however long the run."""
    for count in (2, 3, 5):
        gain = gain_of(chain(count, way), Clock(1e6, 1e-3))
        assert gain.verdict == "fine", count
        assert gain.rho == pytest.approx(1.0, abs=1e-14), count


def oscillator(way, rate=1.0):
    """Return x1' = x2, x2' = -rate^2 x1 as two components: undamped."""
    parts = {"a": Linear(integrator(initial=1.0)), "b": Linear(integrator())}
    return Graph(parts, {"a.u": "b.y", "b.u": Connection("a.y", gain=-(rate**2))}, **way)


def test_an_undamped_oscillator_is_refused_only_when_its_error_has_grown_tenfold():
    """Jacobi multiplies its energy by 1 + (h w)^2 in a step: tenfold after 2 ln(10)/(h w)^2."""
    way = {"coupling": "jacobi"}
    h = 0.01
    gain = gain_of(oscillator(way), Clock(1.0, h))
    assert gain.rho == pytest.approx(math.sqrt(1.0 + h**2), rel=1e-14)
    assert gain.rate == pytest.approx(0.0, abs=1e-15)
    tenfold = 2.0 * math.log(10.0) / math.log1p(h**2) * h
    assert gain_of(oscillator(way), Clock(math.floor(tenfold), h)).verdict == "noted"
    assert gain_of(oscillator(way), Clock(math.ceil(tenfold), h)).verdict == "refused"


def test_an_unstable_plant_is_not_mistaken_for_an_unstable_coupling():
    """x' = 3 x + u, u = -1 x: the system grows by exp(2 t), which no coupling can change."""
    parts = {"p": scalar(3.0, 1.0, 1.0), "k": times(-1.0)}
    gain = gain_of(Graph(parts, {"p.u": "k.y", "k.u": "p.y"}), Clock(10.0, 1e-4))
    assert gain.verdict in ("fine", "noted")
    assert gain.rate == pytest.approx(2.0, rel=1e-12)
    assert gain.is_unstable
    assert not gain_of(oscillator({}), Clock(10.0, 1e-4)).is_unstable


def stiff(way, **settings):
    """Return x' = -x + u, u = -1000 x: Jacobi is stable for steps below about 2 ms."""
    parts = {"p": scalar(-1.0, 1.0, 1.0), "k": scalar(-1e4, -1e7, 1.0)}
    return Graph(parts, {"p.u": "k.y", "k.u": "p.y"}, **way, **settings)


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS[:-1], ids=name_of)
def test_the_step_that_is_offered_is_right_and_the_next_larger_one_is_not(way):
    """It divides the step of the run; what is refused there becomes infinite, what is fine ends."""
    clock = Clock(100.0, 0.02)
    loops = loops_of(stiff(way), clock)
    assert loops.gains()[0].verdict == "refused"
    assert gain_of(stiff(NEWTON), clock).verdict == "fine"
    step_ns = loops.step_for(0)
    assert clock.step_ns % step_ns == 0
    found = gain_of(stiff(way), Clock(100.0, step_ns / 1e9))
    assert found.verdict == "fine"
    larger = min(d for d in range(step_ns + 1, clock.step_ns + 1) if clock.step_ns % d == 0)
    assert gain_of(stiff(way), Clock(100.0, larger / 1e9)).verdict != "fine"
    with pytest.raises(NonFiniteError):
        run(stiff(way), clock, Memory())
    sizes = np.abs(rows_of(stiff(way), Clock(20.0, step_ns / 1e9))).max(axis=1)
    assert sizes[-100:].max() < 10.0 * sizes[:100].max()


def test_of_an_undamped_loop_a_step_is_offered_that_is_not_refused():
    """Its error grows by (1 + (h w)^2)^(1 / 2h) a second, by less than 1 % only at tiny steps."""
    loops = loops_of(oscillator({"coupling": "jacobi"}), Clock(1000.0, 0.01))
    assert loops.gains()[0].verdict == "refused"
    h = loops.step_for(0) / 1e9
    growth = 1000.0 / h * 0.5 * math.log1p(h**2)
    assert growth <= math.log(10.0)
    assert gain_of(oscillator({"coupling": "jacobi"}), Clock(1000.0, h)).verdict == "noted"


def test_where_no_step_helps_none_is_offered():
    """A loop of sampled parts is what it is: its own growth, which is no matter of the coupling."""
    parts = {"p": Sampled(times(2.0), 2, hold=True), "k": Delay(1)}
    clock = Clock(10.0, 0.01)
    loops = loops_of(Graph(parts, {"p.u": "k.y", "k.u": "p.y"}), clock)
    (gain,) = loops.gains()
    assert gain.verdict == "fine"
    assert gain.is_unstable
    assert gain.rho == pytest.approx(math.sqrt(2.0), rel=1e-12)


# --- what is not known ---


def test_components_that_cannot_be_linearized_are_named():
    """Then the gain is not known, and nothing is refused."""
    script = Scripted([0.0] * 20, inputs=1)
    graph = Graph({"p": scalar(-1.0, 1.0, 1.0), "s": script}, {"p.u": "s.y", "s.u0": "p.y"})
    gain = gain_of(graph, Clock(0.1, 0.01))
    assert gain.unknown == ("s",)
    assert gain.verdict == "unknown"
    assert gain.rho is None


def test_a_map_that_is_too_large_is_not_looked_at():
    """As of a delay of very many steps: its eigenvalues would take longer than the run."""
    parts = {"p": scalar(-1.0, 1.0, 1.0), "k": Delay(5000)}
    gain = gain_of(Graph(parts, {"p.u": "k.y", "k.u": "p.y"}), Clock(10.0, 0.001))
    assert gain.verdict == "unknown"
    assert gain.reason == "its one-step map is too large to look at before a run"


def test_a_graph_without_loops_has_no_gains():
    """Nothing is computed of its components."""
    graph = Graph({"r": Scripted([1.0] * 20), "p": scalar(-1.0, 1.0, 1.0)}, {"p.u": "r.y"})
    loops = loops_of(graph, Clock(0.1, 0.01))
    assert loops.gains() == ()


# --- an algebraic loop ---


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi", "newton"])
@pytest.mark.parametrize("h", [0.01, 0.0006])
def test_the_gain_through_an_algebraic_loop_is_that_of_runs(coupling, h):
    """Of a pair whose outputs feed through: those that nothing evaluates again are states."""
    parts = {}
    for name, values in {"one": (-0.9, 0.5, 3.0, 1.0), "two": (-1.0, 10.0, -31.0, -0.9)}.items():
        parts[name] = tuple(np.array([[value]]) for value in values)
    connections = {}
    for name, other in (("one", "two"), ("two", "one")):
        connections[f"{name}.u"] = Connection([f"{other}.y"], gain=[[1.0]])
    way = {"coupling": coupling}
    gain = gain_of(pair(coupling), Clock(100 * h, h))
    radius = identified_radius(parts, connections, Clock(30 * h, h), way)
    assert gain.rho == pytest.approx(radius, rel=1e-6)
    rate = max(pole.real for pole in poles_of(parts, connections))
    assert gain.rate == pytest.approx(rate, rel=1e-9)


def test_an_unstable_algebraic_loop_is_not_refused_as_coupling():
    """With a second feedthrough of 1.1 the system itself has a pole at +3084 /s."""
    for coupling in ("gauss-seidel", "jacobi", "newton"):
        gain = gain_of(pair(coupling, d2=1.1), Clock(1.0, 0.01))
        assert gain.verdict == "fine"
        assert gain.is_unstable
        assert gain.rate == pytest.approx(3084.0068, abs=1e-4)


def test_a_loop_without_a_solution_has_no_gain():
    """y1 = u1 and y2 = u2 around: any value is a solution, and so none is one to rely on."""
    parts = {"a": scalar(-1.0, 1.0, 1.0, 1.0), "b": scalar(-1.0, 1.0, 1.0, 1.0)}
    graph = Graph(parts, {"a.u": "b.y", "b.u": "a.y"}, coupling="newton")
    row = np.zeros(graph.layout.width)
    clock = Clock(1.0, 0.01)
    graph.prepare(clock.step_ns)
    for member in graph.members.values():
        member.component.initialize(0.0, np.zeros(1))
    (gain,) = LinearizedLoops.of(graph, clock, row).gains()
    assert gain.verdict == "unknown"
    assert gain.reason == "its algebraic loop has no one solution at the start"


@pytest.mark.parametrize("offset", [1, 2])
def test_when_the_first_sample_is_taken_does_not_change_the_gain(offset):
    """Of a loop with one period: its maps are the same ones in turn."""
    connections = {"p.u": "k.y", "k.u": "p.y"}
    gains = []
    for first in (0, offset):
        k = Sampled(scalar(-1.0, 1.0, -9.0, -0.2), 3, hold=True, offset=first)
        gains.append(
            gain_of(Graph({"p": scalar(0.4, 1.0, 1.0), "k": k}, connections), Clock(6.0, 0.01))
        )
    assert gains[1].rho == pytest.approx(gains[0].rho, rel=1e-12)
    assert gains[1].rate == pytest.approx(gains[0].rate, rel=1e-9)
