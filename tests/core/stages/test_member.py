"""Components of users: what they are handed, what they return, what they raise."""

import copy
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest

from cosim.blocks.dynamics import Delay
from cosim.blocks.source import constant, sine
from cosim.core.clock import Clock
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.master import run, simulate
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.errors import AssumptionError, CosimError, GraphError, RunError
from tests.core.parts import integrator, times


class Custom:
    """Counts its steps, as y = k + 0 u; each method may be replaced."""

    interface = Interface((Signal("u"),), (Signal("y"),), prepares=True)

    def __init__(self, **methods):
        self.k = 0.0
        for name, method in methods.items():
            setattr(self, name, method)

    def prepare(self, h, held, recorded):
        return {"A": np.eye(1)}

    def initialize(self, t, u):
        self.k = 0.0
        return np.zeros(1)

    def outputs(self, t, u):
        return np.array([self.k])

    def advance(self, t, h, u):
        y = self.k + np.arange(1.0, len(t))[:, np.newaxis]
        self.k = float(y[-1, 0])
        return y


def cascade(part):
    """Return the component between a sine and an integrator, whose time and input it could spoil.

    In the order of the stages a cascade behind it has yet to advance.
    """
    components = {"s": sine(rate=1.0), "x": part, "z": sine(rate=2.0), "behind": integrator()}
    return Graph(components, {"x.u": "s.y", "behind.u": "x.y"})


def loop(part):
    """Return the component in a loop, in which its outputs are evaluated again."""
    part.interface = replace(part.interface, feedthrough={"y": ("u",)})
    return Graph({"x": part, "d": integrator()}, {"x.u": "d.y", "d.u": "x.y"}, coupling="jacobi")


def failure(graph, block=5):
    """Return the text of the error that ends a run, and the rows that it leaves."""
    memory = Memory()
    with pytest.raises(CosimError) as caught:
        run(graph, Clock(0.02, 1e-3, block), memory)
    return caught.value, memory


def spoils_time(t, h, u):
    t[:] = 5.0


def spoils_input(t, h, u):
    u *= 0.0


def spoils_output_input(t, u):
    u *= 0.0


@pytest.mark.parametrize("build", [cascade, loop])
@pytest.mark.parametrize("method", [spoils_time, spoils_input])
def test_time_and_inputs_cannot_be_written_to(build, method):
    """Else all components behind would have another time, and the record other inputs."""
    error, _ = failure(build(Custom(advance=method)))
    assert str(error).startswith("'x' stopped at t = 0.0 s: advance raised ValueError: ")
    assert "read-only" in str(error)
    assert str(error).endswith("; arrays passed to a component are read-only: copy them first")


def test_the_inputs_of_outputs_cannot_be_written_to():
    """They are the recorded ones."""
    error, _ = failure(loop(Custom(outputs=spoils_output_input)))
    assert str(error).startswith("'x' stopped at t = 0.0 s: outputs raised ValueError: ")


def test_the_inputs_of_initialize_cannot_be_written_to():
    """The record has what the connection gives there, not what a component made of it."""

    def spoils(t, u):
        u[:] = 9.0
        return u.copy()

    error, _ = failure(cascade(Custom(initialize=spoils)))
    assert str(error).startswith("'x' stopped at t = 0.0 s: initialize raised ValueError: ")
    assert "read-only" in str(error)


def test_the_mask_and_the_recorded_design_cannot_be_written_to():
    """The mask goes to the log; the recorded design is another's."""

    def spoils_held(h, held, recorded):
        held[:] = True

    def spoils_design(h, held, recorded):
        recorded["A"][:] = 2.0

    text = "'x': prepare raised ValueError: .*read-only"
    with pytest.raises(RunError, match=text):
        cascade(Custom(prepare=spoils_held)).prepare(10**6)
    graph = cascade(Custom(prepare=spoils_design))
    recorded = {"x": {"A": np.eye(1)}}
    with pytest.raises(RunError, match=text):
        graph.prepare(10**6, recorded)
    assert recorded["x"]["A"] == 1.0


def test_a_design_that_fails_names_its_component():
    """The assumption that does not hold is one of the method, which knows no name."""

    def fails(h, held, recorded):
        raise AssumptionError("(13): no observer")

    with pytest.raises(AssumptionError, match=re.escape("'x': (13): no observer")):
        cascade(Custom(prepare=fails)).prepare(10**6)


WRONG = {
    "None": lambda y: None,
    "a list": lambda y: y.tolist(),
    "complex": lambda y: y + 0j,
    "integers": lambda y: y.astype(np.int64),
    "single precision": lambda y: y.astype(np.float32),
    "another byte order": lambda y: y.astype(y.dtype.newbyteorder()),
    "masked": lambda y: np.ma.masked_array(y, mask=True),
    "a matrix object": lambda y: y.view(type("Sub", (np.ndarray,), {})),
    "objects": lambda y: y.astype(object),
    "too many": lambda y: np.concatenate([y, y]),
    "too few": lambda y: y[:-1],
    "another axis": lambda y: y[np.newaxis],
}


@pytest.mark.parametrize("wrong", WRONG.values(), ids=WRONG)
@pytest.mark.parametrize("build", [cascade, loop])
def test_results_that_are_none_are_refused(wrong, build):
    """The error names the component, the method, what was found and what was needed."""
    for method, shape in (("initialize", r"\(1,\)"), ("advance", r"\(\d, 1\)")):
        part = Custom()
        sound = getattr(part, method)
        setattr(part, method, lambda *arguments, sound=sound: wrong(sound(*arguments)))
        error, _ = failure(build(part))
        assert isinstance(error, RunError)
        text = rf"'x'.*{method} returned .*; expected a float64 array of shape {shape}"
        assert re.search(text, str(error))
    if build is loop:
        part = Custom()
        part.outputs = lambda t, u: wrong(np.zeros(1))
        error, _ = failure(build(part))
        assert "'x' stopped at t = 0.0 s: outputs returned " in str(error)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_results_that_are_not_finite_are_refused(value):
    """By component, signal and time; of a design by its name."""
    error, _ = failure(cascade(Custom(outputs=lambda t, u: np.array([value]))))
    assert str(error).startswith(f"'x.y' became {value} at t = 0.0 s")
    later = np.array([value])
    error, _ = failure(loop(Custom(outputs=lambda t, u: later if t else np.zeros(1))))
    assert str(error).startswith(f"'x.y' became {value} at t = 0.001 s")
    error, _ = failure(cascade(Custom(advance=lambda t, h, u: np.full((len(t) - 1, 1), value))))
    assert str(error).startswith(f"'x.y' became {value} at t = 0.001 s")
    error, _ = failure(cascade(Custom(prepare=lambda h, held, recorded: {"K": np.full(2, value)})))
    assert str(error) == (
        "'x': prepare: expected a float64 array of finite numbers as 'K', got an array of float64, "
        "shape (2,), with NaN or infinity"
    )


@pytest.mark.parametrize(
    "design", [None, 5, {"A": None}, {"A": [1.0]}, {"A": np.eye(1, dtype=int)}]
)
def test_a_design_that_is_none_is_refused(design):
    """It must be float64 arrays by name, to be recorded."""
    error, _ = failure(cascade(Custom(prepare=lambda h, held, recorded: design)))
    assert isinstance(error, RunError)
    assert str(error).startswith("'x': prepare")


@pytest.mark.parametrize("method", ["prepare", "initialize", "outputs", "advance"])
@pytest.mark.parametrize(
    "raised", [ZeroDivisionError("mine"), KeyError("y"), StopIteration(), SystemExit(0)]
)
def test_foreign_exceptions_are_named(method, raised):
    """Component, method, type and line stand in the message; the exception itself is the cause."""

    def fail(*arguments):
        raise raised

    part = Custom()
    setattr(part, method, fail)
    error, _ = failure(loop(part))
    assert isinstance(error, RunError)
    assert f"{method} raised {type(raised).__name__}" in str(error)
    assert "'x'" in str(error)
    assert "test_member.py, line " in str(error)
    causes = [error.__cause__]
    while causes[-1] is not None:
        causes.append(causes[-1].__cause__)
    assert raised in causes


def test_a_usage_error_in_a_step_ends_the_run():
    """The run began, so that what was computed is kept, and the component is named."""

    def refuse(t, h, u):
        if t[0] > 0.0095:
            raise GraphError("not here")
        return np.zeros((len(t) - 1, 1))

    error, memory = failure(cascade(Custom(advance=refuse)))
    assert isinstance(error, Stopped)
    assert str(error).endswith("advance: not here")
    assert len(memory["x.y"]) == 11


@pytest.mark.parametrize(
    "rows", [None, 3.0, [[1.0]], np.zeros(1), np.zeros((99, 1)), np.zeros((1, 2))]
)
@pytest.mark.parametrize("build", [cascade, loop])
def test_a_stop_with_other_rows_than_asked_is_refused(rows, build):
    """More than were asked for, of another width, or none at all; its reason is kept."""

    def stop(t, h, u):
        raise Stopped(rows, "enough")

    error, memory = failure(build(Custom(advance=stop)))
    assert str(error).startswith(
        "'x' stopped at t = 0.0 s: advance stopped, 'enough', and returned"
    )
    assert len(memory["x.y"]) == 1


@pytest.mark.parametrize("build", [cascade, loop])
def test_results_may_be_views_that_change_later(build):
    """A component that returns its inputs, or a buffer that it writes to again, is read in time."""
    buffer = np.zeros((100, 1))

    class Aliasing(Custom):
        def initialize(self, t, u):
            buffer[:] = 0.0
            return buffer[0]

        def outputs(self, t, u):
            return buffer[0]

        def advance(self, t, h, u):
            rows = buffer[: len(t) - 1]
            rows += 1.0
            return rows

        def prepare(self, h, held, recorded):
            return {"b": buffer}

    graph = build(Aliasing())
    memory = Memory()
    buffer[:] = 0.0
    run(graph, Clock(0.005, 1e-3, 1), memory)
    assert memory["x.y"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert not memory.plan.designs["x"]["b"].any()

    passing = Custom(advance=lambda t, h, u: u[1:], initialize=lambda t, u: u)
    graph = cascade(passing)
    memory = Memory()
    run(graph, Clock(0.005, 1e-3), memory)
    assert (memory["x.y"] == memory["s.y"]).all()


def test_one_object_under_two_names_is_refused():
    """It has one state, and would advance twice in every step."""
    part = integrator()
    with pytest.raises(GraphError, match=r"components 'a' and 'b' are.*object"):
        Graph({"a": part, "b": part, "c": constant([1.0])}, {"a.u": "c.y", "b.u": "c.y"})


def test_an_interface_cannot_change_behind_the_graph():
    """What is declared is copied; another interface set later is not seen."""
    feedthrough = {"y": ["u"]}
    inputs = [Signal("u")]
    interface = Interface(inputs, (Signal("y"),), feedthrough)
    feedthrough["y"].append("v")
    feedthrough["z"] = ()
    inputs.append(Signal("v"))
    assert (interface.feedthrough, interface.inputs) == ({"y": ("u",)}, (Signal("u"),))
    with pytest.raises(TypeError):
        interface.feedthrough["y"] = ()

    part = Custom()
    graph = cascade(part)
    part.interface = Interface()
    memory = Memory()
    run(graph, Clock(0.005, 1e-3), memory)
    assert memory["x.y"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert "A" in memory.plan.designs["x"]


def test_an_interface_can_be_copied_and_sent():
    """To another process, with a recording that holds it."""
    interface = replace(Delay(2).interface, initial={"y": None})
    for copied in (pickle.loads(pickle.dumps(interface)), copy.deepcopy(interface)):
        assert copied == interface
        assert copied.delayed == ("u",)
    memory = Memory()
    run(cascade(times(1.0)), Clock(0.005, 1e-3), memory)
    sent = pickle.loads(pickle.dumps(memory))
    assert (sent["x.y"] == memory["x.y"]).all()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"feedthrough": {"Y": ("u",)}}, "feedthrough: there is no output 'Y'; "),
        ({"feedthrough": {"y": ("U",)}}, "feedthrough of 'y': there is no input 'U'; "),
        ({"initial": {"y": ("y",)}}, "initial of 'y': there is no input 'y'"),
        ({"initial": {"y": "u"}}, r"initial of 'y':.*a tuple of input names.*'u'"),
        ({"delayed": ("y",)}, "delayed: there is no input 'y'"),
        ({"delayed": "u"}, r"delayed:.*a tuple of input names.*'u'"),
        ({"feedthrough": ["y"]}, r"feedthrough:.*output names.*input names.*\['y'\]"),
        ({"outputs": ("y",)}, r"outputs:.*a Signal.*'y'"),
        ({"inputs": 3}, r"inputs:.*a tuple of Signal.*3"),
    ],
)
def test_declarations_of_what_is_not_there_are_refused(options, text):
    """A misspelt name would silently declare nothing."""
    arguments = {"inputs": (Signal("u"),), "outputs": (Signal("y"),)} | options
    with pytest.raises(GraphError, match=text):
        Interface(**arguments)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"name": 5}, r"signal name:.*string.*5"),
        ({"size": 0}, r"signal 'y': size:.*at least 1.*0"),
        ({"size": 1.5}, r"signal 'y': size:.*at least 1.*1\.5"),
        ({"size": True}, r"signal 'y': size:.*at least 1.*True"),
        ({"variability": "discret"}, "signal 'y': variability 'discret'; did you mean 'discrete'"),
        ({"type": "int"}, "signal 'y': type 'int'; did you mean 'integer'"),
        ({"role": "out"}, "signal 'y': role 'out'; did you mean"),
        ({"name": ""}, r"signal name:.*string.*''"),
        ({"unit": 5}, r"signal 'y': unit:.*a string, a tuple.*or None.*5"),
        ({"optional": 1}, r"signal 'y': optional:.*True or False.*1"),
        ({"base": "m"}, r"signal 'y': base:.*a BaseUnit, a tuple.*or None.*'m'"),
        (
            {"start": [1.0]},
            r"signal 'y': start:.*a tuple of numbers, none of them NaN.*\[1\.0\]",
        ),
        ({"start": (np.nan,)}, r"start:.*a tuple of numbers, none of them NaN.*\(nan,\)"),
        ({"connection": "requierd"}, "connection 'requierd'; did you mean 'required'"),
        ({"first": "x"}, r"first:.*0.*'x'"),
        ({"first": -1}, r"first:.*0.*-1"),
        ({"description": 5}, r"description:.*a string.*5"),
    ],
)
def test_signals_that_are_none_are_refused(options, text):
    """With what was found, and what is needed: a log of them could not be read."""
    with pytest.raises(GraphError, match=text):
        Signal(**({"name": "y"} | options))


def test_a_block_that_a_component_spoils_is_kept_up_to_it():
    """Rows of earlier calls are recorded; the generator yields them before it raises."""

    class Late(Custom):
        def advance(self, t, h, u):
            if t[-1] > 0.0125:
                raise ZeroDivisionError
            return super().advance(t, h, u)

    blocks = simulate(cascade(Late()), Clock(0.02, 1e-3, 5))
    rows = next(blocks)[0].steps + next(blocks)[0].steps
    assert rows == 10
    block, signals = next(blocks)
    assert len(signals) == block.steps + 1
    with pytest.raises(Stopped, match="advance raised ZeroDivisionError"):
        next(blocks)
