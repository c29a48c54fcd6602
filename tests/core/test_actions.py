"""Actions at communication points that are known before the run."""

import numpy as np
import pytest

from cosim.core.clock import Clock
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.recorders import Memory
from cosim.core.simulation import Simulation
from cosim.core.stepping.actions import Injection, Override, Release, TimedAction
from cosim.core.stepping.repeating import repeat, run_with_actions
from cosim.errors import NonFiniteError
from tests.core.parts import Scripted, integrator
from tests.core.test_faults import loop

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
        for name in memory.signals():
            assert memory[name].tobytes() == expected[name].tobytes(), name
        again = Memory()
        repeat(loop(native=native), clock(), again, events=memory.events())
        assert again.events() == memory.events()
        for name in memory.signals():
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
    for name in memory.signals():
        found = np.concatenate([rows[name] for rows in parts])
        assert found.tobytes() == memory[name][1:].tobytes(), name
    assert parts[-1].time_ns[-1] == 40 * 10**8


def test_an_action_is_performed_when_its_point_is_reached():
    """Who reads there sees the right limit; who goes back, does not meet it again."""
    simulation = Simulation(loop(), clock(), actions=ACTIONS)
    assert simulation["late.u"] == 2.0
    simulation.step(5)
    assert simulation["plant.u"] == simulation["controller.y"] + 0.5


def test_what_fails_between_actions_keeps_the_rows_before():
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
