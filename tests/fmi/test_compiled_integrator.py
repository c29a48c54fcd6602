"""What an integrator and its compiled steps hand to each other, number by number."""

import ctypes
import math

import numpy as np
import pytest

from cosim.core.clock import Standstill
from cosim.fmi.component import load
from cosim.fmi.driving.compiled import CompiledIntegrator
from cosim.fmi.driving.integrator import IntegratorState, Interruption
from cosim.fmi.options import FmuOptions
from cosim.native.fmi.model_exchange import (
    AT_BEGIN,
    AT_END,
    EVENT,
    EVENT_IS_OVER,
    FAILED_CALL,
    FAILED_INPUTS,
    INTEGRATING,
    STATE_EVENT,
    TIME_EVENT,
)
from tests.fmi import eventful

# of FRICTION: two states, two inputs, two indicators
ARRAYS = {
    "x": np.array([1.0, 2.0]),
    "inputs": np.array([3.0, 4.0]),
    "indicators": np.array([5.0, 6.0]),
    "nominals": np.array([7.0, 8.0]),
}
STATE = IntegratorState(
    t=0.5, **ARRAYS, next_event=0.75, due=("state event", "time event"), ended=False
)


@pytest.fixture
def compiled():
    """Return the compiled steps of an FMU that was just initialized, which are allowed."""
    with load(eventful.build("FRICTION"), FmuOptions(solver="rk4", start={"p": 0.5})) as fmu:
        component = fmu.component
        component.prepare(0.01, np.zeros(2, np.bool_), {})
        component.initialize(0.0, np.zeros(2))
        component.outputs(0.0, np.zeros(2))
        assert component.native() is not None
        yield component.component._compiled


def arrays_of(compiled):
    """Return the arrays that compiled steps work on, by the name of what they hold."""
    return {
        "x": compiled._x,
        "inputs": compiled._inputs,
        "indicators": compiled._indicators,
        "nominals": compiled._nominals,
    }


def moved(compiled, **numbers):
    """Let compiled steps have moved, up to some numbers; return their arrays."""
    values = {
        "moved": 1,
        "t": 1.5,
        "next_event": 1.75,
        "inputs_time": 1.25,
        "due": TIME_EVENT,
        **numbers,
    }
    for name, value in values.items():
        setattr(compiled._struct, name, value)
    arrays = arrays_of(compiled)
    for name in ("x", "inputs", "indicators"):
        arrays[name][:] = 10.0 * ARRAYS[name]
    return arrays


def test_compiled_steps_begin_where_the_integrator_is(compiled):
    """Nothing is left of the steps before."""
    integrator = compiled._integrator
    integrator.state = STATE
    integrator.inputs_time = 0.25
    integrator.events.add("time event", 0.125)
    struct = compiled._struct
    for name in ("allowed", "reached", "failure", "moved"):
        setattr(struct, name, 0 if name == "allowed" else 1)
    struct.ended = 1
    compiled.hand_over()
    for name, values in arrays_of(compiled).items():
        assert values.tolist() == ARRAYS[name].tolist(), name
    assert (struct.t, struct.next_event, struct.inputs_time) == (0.5, 0.75, 0.25)
    assert struct.due == STATE_EVENT | TIME_EVENT
    assert (struct.in_step, struct.first) == (1, 0.125)
    assert (struct.reached, struct.failure, struct.moved, struct.ended) == (AT_BEGIN, 0, 0, 0)
    assert (struct.allowed, struct.rolls_back) == (1, 1)
    arrays_of(compiled)["x"][:] = 0.0
    assert STATE.x.tolist() == [1.0, 2.0]


def test_a_way_back_is_handed_over_where_there_is_one(compiled):
    integrator = compiled._integrator
    assert not compiled._struct.fmu_state
    integrator.fmu_state = compiled._instance.get_fmu_state(None)
    integrator.rolls_back = False
    compiled.hand_over()
    assert compiled._struct.fmu_state == compiled._addresses.state(integrator.fmu_state)
    assert compiled._struct.rolls_back == 0


def test_behind_the_end_of_the_run_no_step_is_allowed(compiled):
    compiled.take_over()
    compiled._integrator.state.ended = True
    compiled.hand_over()
    assert compiled._struct.allowed == 0


def test_without_a_step_the_integrator_stays_where_it_is(compiled):
    """Also where one was declined before it began."""
    before = compiled._integrator.state
    compiled._events[0] = (0.5, STATE_EVENT, 0)
    compiled._struct.n_events = 1
    for allowed in (1, 0):
        compiled._struct.allowed = allowed
        assert compiled.take_over() is None
        assert compiled._integrator.state is before
        assert compiled._struct.allowed == 0
    compiled.list_events()
    assert compiled._struct.n_events == 1
    assert compiled._integrator.events.drain() == []


def test_the_integrator_goes_on_where_compiled_steps_ended(compiled):
    """What it takes is a copy, and taken once."""
    integrator = compiled._integrator
    nominals = integrator.state.nominals
    arrays = moved(compiled, ended=1, nominals_changed=1, n_events=2)
    compiled._struct.in_step = 2
    compiled._struct.first = 1.0
    compiled._struct.latest = 1.5
    compiled._events[:2] = np.array([(1.0, STATE_EVENT, 0), (1.5, TIME_EVENT, 0)], EVENT)
    assert compiled.take_over() is None  # the last step was completed
    state = integrator.state
    for name in ("x", "inputs", "indicators"):
        assert getattr(state, name).tolist() == (10.0 * ARRAYS[name]).tolist(), name
        arrays[name][:] = 0.0
        assert getattr(state, name).tolist() == (10.0 * ARRAYS[name]).tolist(), name
    assert (state.t, state.next_event, integrator.inputs_time) == (1.5, 1.75, 1.25)
    assert (state.due, state.ended) == (("time event",), True)
    assert state.nominals is nominals
    events = integrator.events
    assert (events.in_step, events.first, events.latest) == (2, 1.0, 1.5)
    compiled._events[:2] = 0
    assert [message.time for message in events.drain()] == [1.0, 1.5]
    struct = compiled._struct
    assert (struct.moved, struct.n_events, struct.nominals_changed) == (0, 0, 0)
    assert compiled.take_over() is None
    assert integrator.state is state


def test_a_step_that_was_declined_inside_is_an_interruption(compiled):
    """With how far it came, what failed, the events so far, and whether one is to be finished."""
    compiled._struct.handled = 7
    compiled._struct.since = 0.5
    standstill = Standstill(0.5, 7)
    moved(compiled, allowed=0, reached=INTEGRATING, failure=EVENT_IS_OVER, nominals_changed=1)
    assert compiled.take_over() == Interruption(INTEGRATING, EVENT_IS_OVER, True, standstill)
    moved(compiled, allowed=0, reached=AT_END, failure=0)
    assert compiled.take_over() == Interruption(AT_END, 0, False, standstill)


def test_left_limits_are_taken_over_where_there_are_some(compiled):
    integrator = compiled._integrator
    integrator.left = None
    compiled._left[:] = 3.0
    moved(compiled, has_left=0)
    compiled.take_over()
    assert integrator.left is None
    moved(compiled, has_left=1)
    compiled.take_over()
    compiled._left[:] = 0.0
    assert integrator.left.tolist() == [3.0] * len(compiled._left)


def test_left_limits_are_computed_for_those_who_ask(compiled):
    """The step has the address of a flag, and that of the values."""

    def made(keeps_left):
        compiled._integrator.keeps_left = keeps_left
        return CompiledIntegrator(compiled._integrator, compiled._instance, compiled._addresses)

    nobody = made(False)
    assert nobody.native().left_outputs is None
    assert not nobody._struct.left
    somebody = made(True)
    flag, values = somebody.native().left_outputs
    assert somebody._struct.left == values == somebody._left.ctypes.data
    ctypes.c_int32.from_address(flag).value = 1
    assert somebody._struct.has_left == 1


def test_the_first_event_of_a_step_is_counted_anew_once_it_is_fetched(compiled):
    compiled._struct.first = 0.125
    compiled._struct.in_step = 3
    assert compiled.first_event == 0.125
    compiled.begin_events()
    assert compiled._struct.in_step == 0
    compiled._struct.first = math.inf
    assert compiled.first_event == math.inf


def test_an_interruption_is_finished_as_it_says(compiled, monkeypatch, subtests):
    """A failure is raised, else an event is finished, if there is one.

    Of a call it is that of the call, of inputs that of setting them, with the words of the method.
    """
    finished = []
    integrator = compiled._integrator
    monkeypatch.setattr(integrator, "finish_event", lambda: finished.append(True))
    called = RuntimeError("a call")
    failed = RuntimeError("no call")
    monkeypatch.setattr(type(compiled._addresses), "failure", lambda addresses: called)
    monkeypatch.setattr(integrator, "failure", lambda interruption: failed)
    refused = RuntimeError("inputs")

    def set_float64(references, values):
        assert references is compiled._instance.description.references("input")
        assert values is integrator.state.inputs
        raise refused

    monkeypatch.setattr(compiled._instance, "set_float64", set_float64)

    for failure, changed, error, count in [
        (0, False, None, 0),
        (0, True, None, 1),
        (FAILED_CALL, True, called, 0),
        (FAILED_INPUTS, True, refused, 0),
        (EVENT_IS_OVER, True, failed, 0),
    ]:
        with subtests.test(failure=failure, changed=changed):
            finished.clear()
            interruption = Interruption(INTEGRATING, failure, changed, Standstill(0.0))
            if error is None:
                compiled.finish(interruption)
            else:
                with pytest.raises(RuntimeError) as raised:
                    compiled.finish(interruption)
                assert raised.value is error
            assert len(finished) == count
