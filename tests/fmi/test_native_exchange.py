"""Compiled steps of model exchange give the bits of the methods, and share their state."""

from itertools import product

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cosim.blocks.sampled import Sampled
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.master import run, simulate
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.errors import RunError
from cosim.fmi.component import ModelExchange, load
from cosim.fmi.generated import GeneratedInstance
from cosim.fmi.options import FmuOptions
from cosim.native.numerics.runge_kutta import EMBEDDED, EXPLICIT
from tests.core.parts import integrator, times
from tests.fmi import eventful
from tests.fmi.compiled import compile_fmu
from tests.fmi.eventful import LEVELS
from tests.fmi.pendulum import pendulum
from tests.fmi.probes import xml1
from tests.fmi.variabilities import VARIABILITIES, Watched, model

STEPS = 60
H = 0.01
T = np.arange(STEPS + 1) * H


class Compiled:
    """A component that takes its compiled steps as a stage does, and the others as it always did.

    Attributes
    ----------
    taken : int
        Compiled steps.
    rows : list of Matrix
        Those of an advance that stopped.
    """

    def __init__(self, component):
        self.component = component
        self.taken = 0
        self.rows = []
        self._step = None

    def begin(self, u, held):
        """Initialize; return the first row."""
        self.component.prepare(H, held, {})
        self.component.initialize(0.0, u)
        y = self.component.outputs(0.0, u)
        self._step = self.component.native()
        return y

    def advance(self, k, end, u):
        """Return the rows of steps k to end."""
        rows = self.rows = []
        while k < end:
            y = self._step.advance(T[k : end + 1], H, u[k : end + 1])
            rows.append(y)
            self.taken += len(y)
            k += len(y)
            if k < end:
                rows.append(self.component.advance(T[k : k + 2], H, u[k : k + 2]))
                k += 1
        return np.concatenate(rows)


class Plain(Compiled):
    """The same without compiled steps."""

    def begin(self, u, held):
        self.component.prepare(H, held, {})
        self.component.initialize(0.0, u)
        return self.component.outputs(0.0, u)

    def advance(self, k, end, u):
        return self.component.advance(T[k : end + 1], H, u[k : end + 1])


def inputs_of(names, seed=1):
    """Return inputs: what is discrete changes now and then, the rest at every step."""
    u = np.random.default_rng(seed).standard_normal((STEPS + 1, len(names)))
    for column, name in enumerate(names):
        if name == "discrete":
            u[:, column] = np.repeat(u[::7, column], 7)[: STEPS + 1]
    return u


def run_alone(driven, u, held, size=STEPS):
    """Return all rows, in blocks of ``size`` steps."""
    rows = [driven.begin(u[0], held)[np.newaxis]]
    for k in range(0, STEPS, size):
        rows.append(driven.advance(k, min(k + size, STEPS), u))
    return np.concatenate(rows)


def exact(inputs):
    return ModelExchange(GeneratedInstance.of(model(inputs)), "exact")


def messages(component):
    return [(message.time, message.text) for message in component.drain()]


@pytest.mark.parametrize("inputs", VARIABILITIES)
def test_exact_steps_in_blocks_of_any_size(inputs):
    """Equal bits and the same events, whether compiled or not.

    The change of a discrete input is an event, wherever in a block it comes.
    """
    names = VARIABILITIES[inputs]
    u = inputs_of(names)
    held = np.zeros(len(names), np.bool_)
    plain = Plain(exact(inputs))
    expected = run_alone(plain, u, held)
    events = messages(plain.component)
    assert len(events) == (0 if inputs == "continuous" else STEPS // 7)
    for size in (1, 7, STEPS):
        other = Plain(exact(inputs))
        assert run_alone(other, u, held, size).tobytes() == expected.tobytes()
        assert messages(other.component) == events
        compiled = Compiled(exact(inputs))
        assert run_alone(compiled, u, held, size).tobytes() == expected.tobytes()
        assert messages(compiled.component) == events
        assert compiled.taken == STEPS - len(events)


@pytest.mark.parametrize("inputs", VARIABILITIES)
def test_exact_outputs_and_states_between_compiled_steps(inputs):
    """The methods show the time reached; a state goes back over compiled steps."""
    names = VARIABILITIES[inputs]
    u = inputs_of(names)
    held = np.zeros(len(names), np.bool_)
    expected = run_alone(Plain(exact(inputs)), u, held)
    compiled = Compiled(exact(inputs))
    compiled.begin(u[0], held)
    compiled.advance(0, 20, u)
    component = compiled.component
    assert component.outputs(T[20], u[20]).tobytes() == expected[20].tobytes()
    state = component.save()
    rows = compiled.advance(20, 50, u)
    assert rows.tobytes() == expected[21:51].tobytes()
    for _ in range(2):
        component.restore(state)
        assert component.outputs(T[20], u[20]).tobytes() == expected[20].tobytes()
        assert compiled.advance(20, 50, u).tobytes() == rows.tobytes()
    assert component.outputs(T[50], u[50]).tobytes() == expected[50].tobytes()
    assert compiled.advance(50, STEPS, u).tobytes() == expected[51:].tobytes()
    assert component.initialize(0.0, u[0]).tobytes() == expected[0].tobytes()
    component.outputs(0.0, u[0])
    assert compiled.advance(0, STEPS, u).tobytes() == expected[1:].tobytes()


def test_exact_steps_are_declined_before_the_initialization_is_over_and_after_the_end():
    """Then the methods do what they always did: leave the initialization, and stop."""
    component = ModelExchange(Watched("discrete", end_at=2), "exact")
    component.prepare(H, np.zeros(1, np.bool_), {})
    u = np.zeros((STEPS + 1, 1))
    component.initialize(0.0, u[0])
    step = component.native()
    assert len(step.advance(T, H, u)) == 0
    component.advance(T[:2], H, u[:2])
    assert len(step.advance(T[1:4], H, u[1:4])) == 2
    component.outputs(T[3], u[3] + 1.0)  # an event, which asks for the end
    assert len(step.advance(T[3:], H, u[3:])) == 0


class Pulses:
    """A discrete source in Python, which changes at every seventh step."""

    interface = Interface((), (Signal("y", variability="discrete"),))

    def initialize(self, t, u):
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([float(round(t / H) // 7 % 3)])

    def advance(self, t, h, u):
        return np.array([self.outputs(time, u) for time in t[1:]])


def graph(plant, coupling, native):
    """Return a plant in a loop with a gain, where it goes first, and a lag behind them."""
    components = {"plant": plant, "gain": times(-0.5), "lag": integrator(3.0), "pulses": Pulses()}
    connections = {
        "plant.c": "gain.y",
        "plant.d": "pulses.y",
        "gain.u": "plant.w",
        "lag.u": "plant.v",
    }
    return Graph(components, connections, coupling=coupling, native=native)


def signals_of(system, block):
    """Return all rows of a graph."""
    rows = []
    for _, signals in simulate(system, Clock(STEPS * H, H, block)):
        rows.append(signals[1:].copy())
    return np.concatenate(rows)


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
def test_exact_plants_in_loops(coupling):
    """Whatever the block size, with the outputs that feed through refreshed, and the events."""
    plant = exact("both")
    expected = signals_of(graph(plant, coupling, False), STEPS)
    events = messages(plant)
    for block in (1, 7, STEPS):
        plant = exact("both")
        assert signals_of(graph(plant, coupling, True), block).tobytes() == expected.tobytes()
        assert messages(plant) == events


# --- FMUs with a Runge-Kutta method ---


def swinging():
    """Return the inputs u and d of those models."""
    u = np.sin(7.0 * T)
    d = np.arange(STEPS + 1) // 7 % 3
    return np.column_stack([u, d])


def events_of(fmu):
    """Return what the run says, and how often it evaluated and accepted."""
    instance = fmu._instance
    references = instance.description.references_of(["evaluations", "completed"])
    counts = instance.get_float64(references).tolist()
    return [(m.time, m.level, m.text) for m in fmu.drain()], counts


def run_eventful(driving, path, options, held, size):
    """Return the rows, how it stopped, what it said, and how many compiled steps it took."""
    with load(path, options) as fmu:
        driven = driving(fmu.component)
        u = swinging()
        rows = [driven.begin(u[0], held)[np.newaxis]]
        ended = ("", False)
        try:
            for k in range(0, STEPS, size):
                rows.append(driven.advance(k, min(k + size, STEPS), u))
        except Stopped as stop:
            driven.rows.append(stop.outputs.reshape(-1, len(rows[0][0])))
            rows += driven.rows
            ended = (str(stop), stop.failed)
        return np.concatenate(rows).tobytes(), ended, events_of(fmu), driven.taken


def check_eventful(model, solver, version, saves):
    """Check that compiled steps give the rows, end, messages and evaluations of the methods.

    Inputs interpolated linearly, or held, so that each step begins with an event. An FMU that
    cannot go back is left behind the events at the end of a step.
    """
    path = eventful.build(model, version, saves=saves)
    longest = None if saves else 0.004  # less than half a communication step
    options = FmuOptions(solver=solver, max_step=longest, start={"p": LEVELS[model]})
    for held in ([False, False], [True, False]):
        mask = np.array(held)
        *expected, _ = run_eventful(Plain, path, options, mask, 1)
        for size in (1, 7, STEPS):
            *found, taken = run_eventful(Compiled, path, options, mask, size)
            assert found == expected
            assert taken >= 5


@pytest.mark.fast("BALL", "FRICTION", "SAW", "TWO", "SWITCH")
@pytest.mark.parametrize("model", sorted(LEVELS.keys() - {"SLIDE"}))
def test_events_of_fmus_in_compiled_steps(model):
    """State, time, step and input events, ends and failures: equal bits, words and evaluations."""
    check_eventful(model, "rk4", 2, True)
    check_eventful(model, "RK45", 3, False)


@pytest.mark.slow
@pytest.mark.parametrize("solver", EXPLICIT)
@pytest.mark.parametrize("version", [2, 3])
def test_events_of_fmus_in_compiled_steps_of_every_solver(solver, version, subtests):
    """All models; with a way back every second pair of solver and version."""
    saves = (EXPLICIT.index(solver) + version) % 2 == 0
    for name in LEVELS:
        with subtests.test(name=name):
            check_eventful(name, solver, version, saves)


@pytest.mark.parametrize("model", ["BALL", "SAW", "TWO", "SWITCH", "SCALED"])
def test_states_of_fmus_between_compiled_steps(model, subtests):
    """Whatever comes between: outputs, also with other inputs, a saved state, and going back."""
    for solver in ["rk4", "RK45"]:
        with subtests.test(solver=solver):
            path = eventful.build(model)
            options = FmuOptions(solver=solver, start={"p": LEVELS[model]})
            u = swinging()
            held = np.zeros(2, np.bool_)
            rows = []
            for driving in (Plain, Compiled):
                with load(path, options) as fmu:
                    driven = driving(fmu.component)
                    y = [driven.begin(u[0], held)[np.newaxis]]
                    y.append(driven.advance(0, 20, u))
                    y.append(fmu.component.outputs(T[20], u[20] + 1.0)[np.newaxis])
                    state = fmu.component.save()
                    y.append(driven.advance(20, 40, u))
                    fmu.component.restore(state)
                    y.append(driven.advance(20, 50, u))
                    fmu.component.restore(state)
                    y.append(fmu.component.outputs(T[20], u[20])[np.newaxis])
                    y.append(driven.advance(20, STEPS, u))
                    fmu.component.initialize(0.0, u[0])
                    fmu.component.outputs(0.0, u[0])
                    y.append(driven.advance(0, STEPS, u))
                    rows.append([part.tobytes() for part in y])
            assert rows[0] == rows[1]
            assert driven.taken > 100


@pytest.mark.slow
def test_more_events_than_there_is_room_for():
    """They are listed all the same, as many of each communication step as ever."""
    path = eventful.build("SLIDE")
    options = FmuOptions(solver="euler", start={"p": 0.5})
    texts = []
    for driving in (Plain, Compiled):
        with load(path, options) as fmu:
            driven = driving(fmu.component)
            u = np.zeros((STEPS + 1, 2))
            u[:, 1] = np.arange(STEPS + 1)
            driven.begin(u[0], np.zeros(2, np.bool_))
            for _ in range(60):
                driven.advance(0, 40, u)
                fmu.component.initialize(0.0, u[0])
                fmu.component.outputs(0.0, u[0])
            texts.append([(m.time, m.text) for m in fmu.drain()])
    assert texts[0] == texts[1]
    assert len(texts[0]) > 2048


def connected(coupling, native, fmus):
    """Return two FMUs in a loop, and a third behind it; the first one gets a discrete signal."""
    components = {f"fmu{i}": fmu.component for i, fmu in enumerate(fmus)}
    components["pulses"] = Pulses()
    connections = {
        "fmu0.u": Connection("fmu1.x", gain=-0.5, offset=1.0),
        "fmu1.u": "fmu0.x",
        "fmu2.u": "fmu1.v",
        **{f"fmu{i}.d": "pulses.y" for i in range(3)},
    }
    return Graph(components, connections, coupling=coupling, native=native)


CONNECTED = ("SWITCH", "SCALED", "MEMORY", "FRICTION")


def check_connected(model, solver, version, coupling):
    """Check that it makes no difference how a graph of three FMUs is computed.

    With extrapolated inputs that are corrected at every step; one that chatters stops.
    """
    found = []
    for native, block in ((False, STEPS), (True, 1), (True, 7), (True, STEPS)):
        options = FmuOptions(solver=solver, start={"p": LEVELS[model]})
        fmus = [load(eventful.build(model, version), options) for _ in range(3)]
        memory = Memory()
        error = ""
        try:
            run(connected(coupling, native, fmus), Clock(STEPS * H, H, block), memory)
        except RunError as raised:
            error = str(raised)
        rows = [memory[name].tobytes() for name in memory.signals]
        found.append((rows, error, [events_of(fmu) for fmu in fmus]))
        for fmu in fmus:
            fmu.close()
    assert all(other == found[0] for other in found[1:])


@pytest.mark.fast("SCALED", "FRICTION", "MEMORY")
@pytest.mark.parametrize("model", CONNECTED)
def test_fmus_in_loops_and_cascades(model):
    """With Gauss-Seidel."""
    check_connected(model, "rk4", 2, "gauss-seidel")


@pytest.mark.slow
@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
@pytest.mark.parametrize("version", [2, 3])
def test_fmus_in_loops_and_cascades_of_every_coupling(version, coupling, subtests):
    """With solvers of fixed and of variable step."""
    for name, solver in product(CONNECTED, ["rk4", "RK45"]):
        with subtests.test(name=name, solver=solver):
            check_connected(name, solver, version, coupling)


@pytest.mark.parametrize("version", [2, 3])
def test_the_end_that_an_fmu_requests_comes_with_the_row_of_its_step(version):
    """Also where that is the last step of the run, or one of several with the FMU's own period."""
    options = FmuOptions(solver="rk4", start={"p": 0.45})
    ends = []
    for native in (False, True):
        for period in (1, 2):
            with load(eventful.build("TIRED", version), options) as fmu:
                component = fmu.component if period == 1 else Sampled(fmu.component, period)
                memory = Memory()
                run(Graph({"fmu": component}, {}, native=native), Clock(0.46, H), memory)
                ends.append((memory.reason, memory.steps))
    expected = ("'fmu' stopped at t = 0.46 s: the FMU requests the end of the run", 46)
    assert ends == [expected] * 4


@pytest.mark.parametrize("driving", [Plain, Compiled])
@pytest.mark.parametrize("version", [2, 3])
def test_inputs_that_change_where_an_fmu_requests_the_end_are_no_event_any_more(version, driving):
    """Only its end may follow, whatever the block: d changes at t = 0.49 s, where it is tired."""
    path = eventful.build("TIRED", version)
    options = FmuOptions(solver="rk4", start={"p": 0.485})
    mask = np.zeros(2, np.bool_)
    found = [run_eventful(driving, path, options, mask, size)[:3] for size in (1, 7, 10, STEPS)]
    assert found[1:] == found[:1] * 3
    messages, _ = found[0][2]
    assert max(time for time, _, _ in messages) == 0.42


@pytest.mark.parametrize("native", [False, True])
@pytest.mark.parametrize("version", [2, 3])
def test_an_fmu_that_requests_the_end_when_it_is_initialized_stops_the_run_there(version, native):
    """There are no compiled steps of it: its states were never read."""
    options = FmuOptions(solver="rk4", start={"p": -1.0})
    with load(eventful.build("ENDS", version), options) as fmu:
        memory = Memory()
        run(Graph({"fmu": fmu.component}, {}, native=native), Clock(0.05, H), memory)
    assert memory.steps == 0
    assert memory.reason == "'fmu' stopped at t = 0.0 s: the FMU requests the end of the run"


@pytest.mark.parametrize("solver", ["rk4", "DOP853"])
def test_fmi_1_in_compiled_steps(solver, tmp_path):
    """FMI 1.0 has no modes of events and no FMU state."""
    path = compile_fmu(tmp_path / "probe1.fmu", xml1(interface_type="me"), "probe1.c")
    rows = []
    for driving in (Plain, Compiled):
        with load(path, FmuOptions(solver=solver)) as fmu:
            driven = driving(fmu.component)
            n_u = fmu.component.interface.n_u
            u = np.random.default_rng(4).standard_normal((STEPS + 1, n_u))
            rows.append(run_alone(driven, u, np.zeros(n_u, np.bool_), 7).tobytes())
            rows.append(run_alone(driven, u, np.ones(n_u, np.bool_), 7).tobytes())
    assert rows[:2] == rows[2:]
    assert driven.taken == 2 * STEPS


@pytest.mark.parametrize("method", EMBEDDED)
def test_compiled_steps_solve_the_equations_that_scipy_solves(method, tmp_path):
    """A pendulum with a torque, swinging for 0.6 s.

    Each solver is within 1e-9 a step of the exact solution, in fewer than 200 steps.
    """
    path = pendulum(tmp_path / "pendulum.fmu", derivatives=False, level=False)
    torque = 0.3
    with load(path, FmuOptions(solver=method, tolerance=1e-9, outputs=("theta", "omega"))) as fmu:
        driven = Compiled(fmu.component)
        u = np.tile([torque, 0.0], (STEPS + 1, 1))
        rows = run_alone(driven, u, np.zeros(2, np.bool_))
        names = list(fmu.component.interface.output_columns())
        found = rows[-1][[names.index("theta"), names.index("omega")]]
        instance = fmu._instance
        x0 = np.array([0.5, 0.0])

        def slope(t, x):
            instance.set_continuous_states(x)
            return instance.get_derivatives()

        expected = solve_ivp(slope, (0.0, STEPS * H), x0, method="DOP853", rtol=1e-12, atol=1e-13)
    assert abs(found - expected.y[:, -1]).max() < 200 * 1e-9
    assert driven.taken == STEPS
