"""Actions at communication points that are known before the run."""

import numpy as np
import pytest

from cosim.blocks.arithmetic import gain
from cosim.blocks.source import constant, ramp
from cosim.core.clock import Clock
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.recorders import Memory
from cosim.core.recording import SignalEvent
from cosim.core.simulation import Simulation
from cosim.core.stepping.actions import (
    ConditionalAction,
    Injection,
    Override,
    Release,
    Setting,
    TimedAction,
)
from cosim.core.stepping.repeating import RecordedChanges, repeat, run_with_actions
from cosim.errors import GraphError, NonFiniteError
from tests.core.graphs import loop
from tests.core.parts import Scripted, integrator, times

STEP = 0.1
ACTIONS = [
    TimedAction(17, Release("plant.u")),
    TimedAction(0, Override("late.u", (2.0,))),
    TimedAction(5, Injection("controller.u", "noise", (0.1, 3))),
    TimedAction(5, Injection("plant.u", "offset", (0.5,))),
    TimedAction(23, Release("controller.u")),
    TimedAction(39, Injection("late.u", "freeze", ())),
]


def clock(steps=40):
    return Clock(steps * STEP, STEP)


def by_hand(graph, recorder=None, steps=40):
    """Return a simulation on which the same was done by hand, one step at a time."""
    plan = graph.prepare(clock(steps).step_ns)
    if recorder is not None:
        recorder.begin(plan)
    simulation = Simulation(graph, clock(steps), plan, recorder=recorder)
    for index in range(steps):
        for timed in ACTIONS:
            if timed.index == index:
                timed.action.perform(simulation)
        simulation.step()
    return simulation


def test_a_run_with_actions_is_the_simulation_that_does_the_same_by_hand():
    """Rows and events."""
    expected = Memory()
    with expected:
        by_hand(loop(), expected).close()
    for native in (True, False):
        memory = Memory()
        run_with_actions(loop(native=native), clock(), memory, actions=ACTIONS)
        assert memory.events() == expected.events()
        for name in memory.signals:
            assert memory[name].tobytes() == expected[name].tobytes(), name
        again = Memory()
        repeat(loop(native=native), clock(), again, changes=RecordedChanges(memory.events()))
        assert again.events() == memory.events()
        for name in memory.signals:
            assert again[name].tobytes() == memory[name].tobytes(), name


@pytest.mark.parametrize("size", [1, 7, 40])
def test_actions_happen_to_who_steps_by_hand_too(size):
    """Whatever the steps: the rows of one call go on over an action."""
    memory = Memory()
    run_with_actions(loop(), clock(), memory, actions=ACTIONS)
    simulation = Simulation(loop(), clock(), actions=ACTIONS)
    parts = []
    while simulation.steps_left:
        rows = simulation.step(min(size, simulation.steps_left))
        assert rows.steps == len(rows.time_ns)
        parts.append(rows)
    for name in memory.signals:
        found = np.concatenate([rows[name] for rows in parts])
        assert found.tobytes() == memory[name][1:].tobytes(), name
    assert parts[-1].time_ns[-1] == 40 * 10**8


def test_an_action_is_performed_when_its_point_is_reached():
    """Who reads there sees the right limit; who goes back, does not meet it again."""
    simulation = Simulation(loop(), clock(), actions=ACTIONS)
    assert simulation["late.u"] == 2.0
    simulation.step(5)
    assert simulation["plant.u"] == simulation["controller.y"] + 0.5


def test_a_failure_between_actions_keeps_the_rows_before():
    """Those of the parts that were completed, and of the one that was not."""
    values = [1.0] * 8 + [np.inf] * 40
    components = {"s": Scripted(values), "x": integrator()}
    graph = Graph(components, {"x.u": "s.y"})
    actions = [TimedAction(3, Override("x.u", (0.5,))), TimedAction(5, Release("x.u"))]
    simulation = Simulation(graph, clock(), actions=actions)
    with pytest.raises(NonFiniteError):
        simulation.step(20)
    assert simulation.index == 7
    assert simulation.rows.steps == 7
    assert simulation.rows["x.u"][:, 0].tolist() == [1.0, 1.0, 1.0, 0.5, 0.5, 1.0, 1.0]


def test_a_regular_end_ends_a_run_with_actions_without_an_error():
    """What was completed is recorded."""
    stop = Stopped(np.zeros((0, 1)), "enough", failed=False)
    graph = Graph({"s": Scripted([1.0] * 6 + [stop]), "x": integrator()}, {"x.u": "s.y"})
    memory = Memory()
    run_with_actions(graph, clock(), memory, actions=[TimedAction(2, Override("x.u", (3.0,)))])
    assert len(memory["x.u"]) == 6
    assert memory["x.u"][3:].tolist() == [3.0] * 3


# --- parameters ---


def chain(**options):
    """Return a source, a gain and a lag, whose parameters are set on the way."""
    components = {"s": constant([2.0]), "g": times(1.0), "x": integrator(rate=1.0)}
    return Graph(components, {"g.u": "s.y", "x.u": "g.y"}, **options)


def settings(graph, factor=3.0, rate=4.0):
    """Return actions that set the gain at step 5, and the rate of the lag at step 8."""
    actions = []
    changed = [
        (5, "g", times(factor), {"K": (factor,)}),
        (8, "x", integrator(rate=rate), {"rate": (rate,)}),
    ]
    for index, name, component, values in changed:
        graph.prepare_variant(name, component, clock().step_ns, {})
        actions.append(TimedAction(index, Setting(name, component, values)))
    return actions


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("size", [1, 40])
def test_a_component_goes_on_from_its_state_with_other_parameters(native, size):
    """x' = r (K u - x) from where it was: in closed form on each part."""
    graph = chain(native=native)
    simulation = Simulation(graph, clock(), actions=settings(graph))
    rows = []
    while simulation.steps_left:
        rows.append(simulation.step(min(size, simulation.steps_left))["x.y"][:, 0])
        if simulation.index == 5:
            assert simulation["x.u"] == 6.0, "what feeds through follows at once"
    x = np.concatenate([[0.0], *rows])
    t = STEP * np.arange(41)
    expected = 2.0 * (1.0 - np.exp(-t[:6]))
    before = expected[5]
    middle = 6.0 + (before - 6.0) * np.exp(-(t[5:9] - t[5]))
    late = 6.0 + (middle[-1] - 6.0) * np.exp(-4.0 * (t[8:] - t[8]))
    reference = np.concatenate([expected, middle[1:], late[1:]])
    # 40 steps, each with a rounding of a few parts in 2^53 of values up to 6
    assert abs(x - reference).max() < 40 * 4 * 6.0 * 2**-53


def test_a_setting_is_an_event_and_repeated():
    """With the values; outputs that jump follow."""
    graph = chain()
    memory = Memory()
    run_with_actions(graph, clock(), memory, actions=settings(graph))
    assert memory.events() == [
        SignalEvent(5 * 10**8, "set", "g.K", (3.0,)),
        SignalEvent(5 * 10**8, "follow", "g.y", (6.0,)),
        SignalEvent(5 * 10**8, "follow", "x.u", (6.0,)),
        SignalEvent(8 * 10**8, "set", "x.rate", (4.0,)),
    ]
    other = chain()
    by_key = {}
    for timed in settings(other):
        by_key[timed.index * 10**8, timed.action.name] = timed.action
    again = Memory()
    repeat(other, clock(), again, changes=RecordedChanges(memory.events(), settings=by_key))
    assert again.events() == memory.events()
    for name in memory.signals:
        assert again[name].tobytes() == memory[name].tobytes(), name


def test_a_setting_of_a_recorded_component_is_taken_from_what_followed():
    """It is not computed: what it became is in its events."""
    events = [
        SignalEvent(5 * 10**8, "set", "g.K", (3.0,)),
        SignalEvent(5 * 10**8, "follow", "g.y", (7.0,)),
    ]
    memory = Memory()
    repeat(chain(), clock(), memory, changes=RecordedChanges(events, copied=["g"]))
    assert memory.events() == [*events, SignalEvent(5 * 10**8, "follow", "x.u", (7.0,))]


@pytest.mark.parametrize("index", [3, 6, 9])
def test_who_goes_back_over_a_setting_has_the_parameters_of_then(index):
    """And meets it again."""
    graph = chain()
    simulation = Simulation(graph, clock(), actions=settings(graph))
    simulation.step(index)
    state = simulation.state
    first = simulation.step(20)["x.y"].tobytes()
    simulation.state = state
    assert simulation.step(20)["x.y"].tobytes() == first
    simulation.reset()
    assert simulation.step(20)["x.u"][:, 0].tolist() == [2.0] * 5 + [6.0] * 15


def test_a_graph_has_its_own_components_again_behind_a_run():
    """The next run begins with them."""
    graph = chain()
    runs = []
    for _ in range(2):
        memory = Memory()
        run_with_actions(graph, clock(), memory, actions=settings(graph))
        runs.append(memory["x.y"].tobytes())
    assert runs[0] == runs[1]


def test_a_variant_needs_the_same_interface_and_a_state():
    """Refused before the run."""
    graph = chain()
    with pytest.raises(GraphError, match=r"'g':.*interface"):
        graph.prepare_variant("g", integrator(), clock().step_ns, {})
    components = {"s": Scripted([1.0] * 50)}
    graph = Graph(components, {})
    with pytest.raises(GraphError, match="'s': its state cannot be passed on"):
        graph.prepare_variant("s", Scripted([2.0] * 50), clock().step_ns, {})


# --- conditions ---


def watched(**options):
    """Return a ramp, and what follows it by a gain and a lag."""
    components = {"r": ramp(slope=1.0), "g": times(1.0), "x": integrator()}
    return Graph(components, {"g.u": "r.y", "x.u": "g.y"}, **options)


REACTIONS = [
    ConditionalAction("r.y > 1.05", (Override("x.u", (5.0,)),)),
    ConditionalAction("x.y > 2", (Release("x.u"), Injection("g.u", "offset", (1.0,)))),
    ConditionalAction("x.y < -1", (Override("g.u", (0.0,)),)),
]


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("block", [1, 7, None])
def test_actions_happen_where_conditions_come_true_first(native, block):
    """Each once; the rows depend on no block size."""
    memory = Memory()
    graph = watched(native=native)
    run_with_actions(graph, Clock(4.0, STEP, block), memory, actions=[], reactions=REACTIONS)
    assert (memory["x.u"][:12] == memory["g.y"][:12]).all()
    x = memory["x.y"]
    end = int((x > 2.0).argmax())
    assert (memory["x.u"][12 : end + 1] == 5.0).all()
    assert (memory["x.u"][end + 1 :] == memory["g.y"][end + 1 :]).all()
    assert (memory["g.u"][end + 1 :] == memory["r.y"][end + 1 :] + 1.0).all()
    own = [event[:3] for event in memory.events() if event.cause != "follow"]
    assert own == [
        (11 * 10**8, "override", "x.u"),
        (end * 10**8, "release", "x.u"),
        (end * 10**8, "offset", "g.u"),
    ]
    texts = [message.text for message in memory.messages()]
    assert texts == [
        "when 'r.y > 1.05': came true",
        "when 'x.y > 2': came true",
        "when 'x.y < -1': never came true",
    ]
    assert memory.results["never_came_true"] == ["x.y < -1"]
    again = Memory()
    repeat(watched(native=native), clock(), again, changes=RecordedChanges(memory.events()))
    assert again.events() == memory.events()
    for name in memory.signals:
        assert again[name].tobytes() == memory[name].tobytes(), name


@pytest.mark.parametrize("size", [1, 9, 40])
def test_who_steps_by_hand_meets_the_conditions_too(size):
    """And goes back over them: an action that was not performed then is performed again."""
    memory = Memory()
    run_with_actions(watched(), clock(), memory, actions=[], reactions=REACTIONS)
    simulation = Simulation(watched(), clock(), reactions=REACTIONS)
    parts = []
    while simulation.steps_left:
        parts.append(simulation.step(min(size, simulation.steps_left))["x.u"])
    assert np.concatenate(parts).tobytes() == memory["x.u"][1:].tobytes()
    simulation.reset()
    simulation.step(5)
    early = simulation.state
    simulation.step(10)
    late = simulation.state
    rest = simulation.step(20)["x.u"].tobytes()
    simulation.state = late
    assert simulation.step(20)["x.u"].tobytes() == rest
    simulation.state = early
    simulation.step(10)
    assert simulation.step(20)["x.u"].tobytes() == rest


def test_an_action_at_the_first_row_and_one_at_the_end_of_the_run():
    """True at the start is coming true there; where the run ends nothing happens any more."""
    reactions = [
        ConditionalAction("r.y >= 0", (Override("x.u", (5.0,)),)),
        ConditionalAction("r.y > 2.95", (Override("g.u", (5.0,)),)),
    ]
    memory = Memory()
    run_with_actions(
        watched(), clock(), memory, actions=[], reactions=reactions, until="r.y > 2.95"
    )
    assert (memory["x.u"][1:] == 5.0).all()
    assert len(memory["x.u"]) == 31
    assert [event.signal for event in memory.events()] == ["x.u"]
    assert memory.results["never_came_true"] == ["r.y > 2.95"]


def test_a_release_that_need_not_be_releases_what_is_overridden():
    """All of it, a part of it or nothing."""
    graph = Graph({"c": constant([1.0, 2.0]), "g": gain(np.eye(2))}, {"g.u": "c.y"})
    simulation = Simulation(graph, clock())
    simulation.release_overridden("g.u")
    simulation["g.u[1]"] = 5.0
    simulation.release_overridden("g.u")
    assert simulation.overrides == {}
    assert simulation["g.u"].tolist() == [1.0, 2.0]
