"""A run ends where a condition comes true, whatever the blocks; components stand there."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.blocks.product import Product
from cosim.blocks.source import sine
from cosim.core.clock import Clock
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.core.simulation import Simulation
from cosim.core.stepping.actions import Override, TimedAction
from cosim.core.stepping.repeating import run_with_actions
from cosim.errors import RunError, UsageError
from tests.core.parts import integrator, through, times

CONNECTIONS = {"x.u": "u.y", "z.u": "x.y", "a.u": "b.y", "b.u": "a.y"}
BLOCKS = (1, 2, 7, 1000, None)


def graph(native=True):
    """Return two cascades behind a sine, and a loop beside them."""
    components = {
        "u": sine(rate=3.0),
        "x": integrator(2.0),
        "z": integrator(5.0),
        "a": integrator(1.0, start=1.0),
        "b": times(-2.0),
    }
    return Graph(components, CONNECTIONS, native=native)


def recorded(until, *, block=None, native=True, graph=graph):
    memory = Memory()
    run(graph(native), Clock(4.0, 0.05, block), memory, until=until)
    return memory


FULL = recorded(None)
CONDITIONS = st.tuples(
    st.sampled_from(["x.y", "z.y", "abs(x.y)", "a.y", "x.y - z.y", "b.y"]),
    st.sampled_from(["<", ">"]),
    st.floats(-0.6, 0.6).map(lambda value: round(value, 3)),
    st.sampled_from([0, 1, 5, 20]),
)


def expected_end(signal, comparator, value, steps):
    """Return the first row where it held for so many steps, by the rows of the whole run."""
    names = {name: FULL[name] for name in ("x.y", "z.y", "a.y", "b.y")}
    text = signal
    for name in names:
        text = text.replace(name, f"names[{name!r}]")
    holds = eval(f"{text} {comparator} value", {"names": names, "value": value, "abs": np.abs})
    for row in range(len(holds)):
        if row >= steps and holds[row - steps : row + 1].all():
            return row
    return None


@settings(deadline=None, max_examples=40)
@given(CONDITIONS, st.sampled_from(BLOCKS), st.booleans())
def test_a_run_ends_at_the_row_where_the_condition_is_met(condition, block, native):
    """As the rows of the whole run say; those up to there are the same, and there are no others."""
    signal, comparator, value, steps = condition
    until = f"{signal} {comparator} {value} for {50 * steps} ms"
    if not steps:
        until = f"{signal} {comparator} {value}"
    end = expected_end(*condition)
    memory = recorded(until, block=block, native=native)
    assert memory.status == "complete"
    if end is None:
        assert memory.reason == ""
        end = FULL.steps
    else:
        assert memory.reason == f"until {until!r}: came true at t = {end * 50 / 1000} s"
    assert memory.steps == end
    for name in FULL:
        assert memory[name].tobytes() == FULL[name][: end + 1].tobytes()


@pytest.mark.parametrize("block", BLOCKS)
def test_a_condition_that_is_true_at_the_start_leaves_the_first_row(block):
    """The initial values are there; no step is taken."""
    memory = recorded("a.y >= 1", block=block)
    assert (memory.status, memory.steps, len(memory["x.y"])) == ("complete", 0, 1)
    assert memory.reason == "until 'a.y >= 1': came true at t = 0.0 s"


class Counter:
    """y counts the steps that were taken; it knows the last one that it ever took.

    Parameters
    ----------
    rollback, restarts : bool
        As it declares.
    fails_at : int, optional
        The step that it cannot take.
    lies : bool
        ``restore`` changes nothing.
    """

    def __init__(self, *, rollback=True, restarts=False, fails_at=None, lies=False):
        self.interface = Interface((), (Signal("y"),), rollback=rollback, restarts=restarts)
        self.fails_at = fails_at
        self.lies = lies
        self.last = 0
        self.saves = 0

    def initialize(self, t, u):
        self.k = 0
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([float(self.k)])

    def advance(self, t, h, u):
        rows = []
        for _ in t[1:]:
            if self.k + 1 == self.fails_at:
                raise Stopped(np.array(rows).reshape(-1, 1), "no further")
            self.k += 1
            self.last = max(self.last, self.k)
            rows.append([float(self.k)])
        return np.array(rows)

    def save(self):
        self.saves += 1
        return self.k

    def restore(self, state):
        if not self.lies:
            self.k = state


class Doomed(Counter):
    """A counter that cannot go back either, once it has failed."""

    has_failed = False

    def advance(self, t, h, u):
        try:
            return super().advance(t, h, u)
        except Stopped:
            self.has_failed = True
            raise

    def restore(self, state):
        if self.has_failed:
            raise RunError("it has failed")
        super().restore(state)


@pytest.mark.parametrize("block", BLOCKS)
def test_a_component_that_failed_behind_the_row_need_not_go_back(block):
    """The run ends at the row; in one that goes on there would be no way."""
    memory = Memory()
    doomed = Graph({"c": Doomed(fails_at=8)}, {})
    run(doomed, Clock(3.0, 0.1, block), memory, until="c.y >= 5")
    assert (memory.status, memory.steps) == ("complete", 5)


def count(until, block=8, others=(), **options):
    counter = Counter(**options)
    components = {"c": counter, "x": integrator()}
    components.update(others)
    memory = Memory()
    run(Graph(components, {"x.u": "c.y"}), Clock(3.0, 0.1, block), memory, until=until)
    return counter, memory


@pytest.mark.parametrize("block", BLOCKS)
def test_components_stand_at_the_last_row(block):
    """Those that ran past it have gone back, and so has what follows them."""
    counter, memory = count("c.y >= 5", block)
    assert counter.k == memory.steps == 5
    assert counter.last >= 5


def test_components_with_rollback_go_ahead():
    """Else the blocks would be of one step for nothing."""
    counter, _ = count("c.y >= 5", block=8)
    assert counter.last == 8


@pytest.mark.parametrize("options", [{"rollback": False}, {"restarts": True}])
@pytest.mark.parametrize("block", BLOCKS)
def test_components_without_rollback_do_not_pass_the_row(block, options):
    """Nor is it saved, as that would change the steps that follow."""
    counter, memory = count("c.y >= 5", block, **options)
    assert counter.last == counter.k == memory.steps == 5
    assert counter.saves == 0


@pytest.mark.parametrize("block", BLOCKS)
def test_an_error_after_the_row_where_a_run_ends_is_not_raised(block):
    """No run comes there, so that blocks of one step would not see it either."""
    counter, memory = count("c.y >= 5", block, fails_at=6)
    assert (memory.status, memory.steps, counter.k) == ("complete", 5, 5)
    with pytest.raises(Stopped, match=r"'c' stopped at t = 0\.4 s: no further"):
        count("c.y >= 5", block, fails_at=5)


def test_a_component_that_does_other_steps_the_second_time_is_an_error():
    """Its restore does not fit its save: its rows are those of no one run."""
    with pytest.raises(RunError) as error:
        count("c.y >= 5", block=8, lies=True)
    assert str(error.value) == (
        "'c' went back to t = 0.0 s and repeated the same steps with different values, "
        "first at t = 0.1 s; its save() and restore() must be complete, or its interface must not "
        "declare rollback"
    )


def simulation(until):
    return Simulation(graph(), Clock(4.0, 0.05), until=until)


def advance_by(advanced, size):
    """Advance by so many steps at a time, up to the end of the clock."""
    while advanced.steps_left:
        advanced.step(min(size, advanced.steps_left))


def test_a_simulation_stops_where_the_condition_came_true():
    """As at a component's regular end: the steps up to there are completed, and can be read."""
    until = "x.y > 0.3 for 100 ms"
    end = expected_end("x.y", ">", 0.3, 2)
    for size in (1, 3, 80):
        advanced = simulation(until)
        with pytest.raises(Stopped) as stop:
            advance_by(advanced, size)
        assert not stop.value.failed
        assert str(stop.value) == f"until {until!r}: came true at t = {end * 50 / 1000} s"
        assert advanced.index == end
        assert advanced["z.y"].tobytes() == FULL["z.y"][end].tobytes()
        assert advanced.rows.steps == (end - 1) % size + 1
        with pytest.raises(UsageError, match=r"the simulation ended at t = .*came true"):
            advanced.step()
        advanced.reset()
        advanced.step(end - 1)


def test_a_simulation_that_has_ended_at_its_start_takes_no_step():
    """It starts, and the first step raises; no row is behind the start."""
    advanced = simulation("a.y >= 1")
    with pytest.raises(Stopped, match=r"came true at t = 0\.0 s"):
        advanced.step(5)
    assert advanced.index == 0
    assert advanced.rows.steps == 0


def test_a_state_knows_how_long_a_condition_has_held():
    """Whoever goes back to it, or takes it elsewhere, ends at the same row."""
    end = expected_end("x.y", ">", 0.3, 2)
    advanced = simulation("x.y > 0.3 for 100 ms")
    advanced.step(end - 1)
    state = advanced.state
    other = simulation("x.y > 0.3 for 100 ms")
    other.state = pickle.loads(pickle.dumps(state))
    for simulated in (advanced, other):
        with pytest.raises(Stopped):
            simulated.step(9)
        assert simulated.index == end
    advanced.state = state
    with pytest.raises(Stopped):
        advanced.step()
    assert advanced.index == end


def test_an_override_makes_a_condition_true_one_step_later():
    """A condition looks at the row as it is recorded, which has the left limit."""
    advanced = simulation("z.u > 5")
    advanced.step(3)
    advanced["z.u"] = 9.0
    with pytest.raises(Stopped, match=r"came true at t = 0\.2 s"):
        advanced.step(5)


@pytest.mark.parametrize(("until", "steps"), [("a.y >= 1", 0), ("t >= 0.2", 4), ("t > 0.2", 5)])
def test_where_a_run_ends_no_action_is_performed(until, steps):
    """Nothing comes behind the last row, at the start neither; before it actions go on."""
    memory = Memory()
    actions = [TimedAction(k, Override("z.u", (float(k),))) for k in (0, 4)]
    run_with_actions(graph(), Clock(4.0, 0.05), memory, actions=actions, until=until)
    assert memory.steps == steps
    overrides = [event for event in memory.events() if event.cause == "override"]
    assert len(overrides) == sum(action.index < steps for action in actions)


REFUSED = {
    "x.y": "condition 'x.y': got 'x.y'",
    "x.v > 1": "the graph has no 'x.v': 'x' has no signal 'v'; ",
    "x.y > 1 for 70 ms": "for: 0.07 s is not a whole number of 0.05 s steps; nearest: 0.05 s",
}


@pytest.mark.parametrize("until", REFUSED)
def test_only_conditions_of_the_graph_are_taken(until):
    """Before anything begins; so is what is no text."""
    with pytest.raises(UsageError) as error:
        recorded(until)
    assert REFUSED[until] in str(error.value)
    with pytest.raises(UsageError, match=r"until:.*1"):
        recorded(1)


LOOPS = (
    {"coupling": "newton"},
    {"coupling": "gauss-seidel", "iterations": 3},
    {"coupling": "jacobi", "iterations": 2},
    {"coupling": "gauss-seidel", "input_interpolation": "latest"},
    {"coupling": "gauss-seidel", "input_interpolation": "zero-order"},
)


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("options", LOOPS, ids=lambda options: " ".join(map(str, options.values())))
def test_a_loop_goes_back_with_all_that_it_keeps(options, native):
    """What loops that iterate keep from step to step decides the last bits of those that follow."""

    def loop(native):
        components = {
            "u": sine(rate=3.0, amplitude=2.0),
            "x": through(0.9),
            "z": through(0.9) if options["coupling"] == "newton" else integrator(),
            "d": Product("**"),
        }
        connections = {"x.u": "d.y", "z.u": "x.y", "d.u1": "z.y", "d.u2": "u.y"}
        return Graph(components, connections, native=native, **options)

    whole = recorded(None, native=native, graph=loop)
    different = []
    for block in BLOCKS:
        memory = recorded("t > 1.72", block=block, native=native, graph=loop)
        assert 0 < memory.steps < whole.steps
        for name in whole:
            if memory[name].tobytes() != whole[name][: memory.steps + 1].tobytes():
                different.append((block, name))
    assert different == []
