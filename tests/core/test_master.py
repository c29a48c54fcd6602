"""What ends a run, and what is recorded then."""

from dataclasses import replace

import numpy as np
import pytest

from cosim.blocks.arithmetic import gain, sum_of
from cosim.blocks.dynamics import Delay
from cosim.blocks.sampled import Decimated, Sampled
from cosim.blocks.source import Noise, Table, sine
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.master import run, simulate
from cosim.core.recorders import Memory, Nothing, Watched
from cosim.core.signals import Interface, Signal
from cosim.errors import LogError, NonFiniteError, RunError, UsageError
from tests.core.parts import Scripted, integrator, times

BLOCKS = [1, 3, 1000]


class Guarded(Memory):
    """Notes how often it was entered and left."""

    def __init__(self):
        super().__init__()
        self.calls = []

    def __enter__(self):
        self.calls.append("enter")
        return self

    def __exit__(self, kind, error, trace):
        super().__exit__(kind, error, trace)
        self.calls.append(kind)


def attempt(components, connections, expected=None, *, block=None, steps=10, text=".*", **options):
    """Run for ``steps`` of 0.1 s; return the recorder, which was closed."""
    memory = Guarded()
    clock = Clock(steps / 10, 0.1, block)
    if expected is None:
        run(Graph(components, connections, **options), clock, memory)
    else:
        with pytest.raises(expected, match=text):
            run(Graph(components, connections, **options), clock, memory)
    assert memory.calls in (
        [["enter", expected]] if expected else [["enter", None], ["enter", Stopped]]
    )  # a recorder sees a regular stop, too
    return memory


class Followed(Memory):
    """Keeps the function that returns the rows of a block under way."""

    def follow(self, rows):
        self.rows = rows


class Looking(Scripted):
    """Notes the rows that are completed whenever it advances."""

    def __init__(self, recorder):
        super().__init__([*range(12)], inputs=1)
        self._recorder = recorder
        self.seen = []

    def advance(self, t, h, u):
        block, rows = self._recorder.rows()
        self.seen.append((block.index + block.steps, float(block.time[-1]), rows.shape))
        return super().advance(t, h, u)


@pytest.mark.parametrize("block", [1, 3, 10])
@pytest.mark.parametrize("until", [None, "x.y > 100"])
def test_rows_of_a_block_under_way_are_shown(block, until):
    """In a loop, whose steps are taken one by one: those behind the last completed step never."""
    memory = Followed()
    looking = Looking(memory)
    graph = Graph({"x": looking, "behind": integrator()}, {"behind.u": "x.y", "x.u0": "behind.y"})
    run(graph, Clock(1.0, 0.1, block), memory, until=until)
    steps = [number for number, _, _ in looking.seen]
    assert len(steps) == 10
    assert all(step <= k for k, step in enumerate(steps))
    assert until or steps == [*range(10)]
    for step, time, shape in looking.seen:
        assert time == pytest.approx(0.1 * step)
        assert shape[1] == graph.layout.width


def script(value, at, **options):
    """Return 0, 1, 2, ... with ``value`` at step ``at``."""
    return Scripted([*range(at), value, *range(at + 1, 12)], **options)


def stop(*, failed=True, done=()):
    return Stopped(np.reshape(np.array(done, np.float64), (-1, 1)), "enough", failed=failed)


@pytest.mark.parametrize("block", BLOCKS)
def test_a_stop_cuts_the_block_for_all(block):
    """Components before, beside and behind the one that stops end at the same row.

    Everything up to there is recorded, nothing after it.
    """
    components = {
        "early": sine(amplitude=1.0, rate=1.0, phase=0.0, offset=0.0),
        "x": script(stop(), 5, inputs=1),
        "behind": integrator(),
        "n": Noise(deviation=1.0, seed=1),
    }
    memory = attempt(
        components,
        {"x.u0": "early.y", "behind.u": "x.y"},
        Stopped,
        block=block,
        text=r"'x' stopped at t = 0\.4 s: enough",
    )
    for name in components:
        assert memory.time(name).tolist() == [0.0, 0.1, 0.2, 0.3, 0.4]
    assert memory["x.y"].tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("block", BLOCKS)
@pytest.mark.parametrize(
    "behind", [integrator, lambda: Delay(2), lambda: Decimated(integrator(), 2), lambda: times(2.0)]
)
def test_a_stop_in_the_very_first_step_leaves_the_start(behind, block):
    """Components behind are not asked for steps that are not there."""
    components = {
        "x": script(stop(), 1),
        "behind": behind(),
        "n": Noise(deviation=1.0, seed=1),
        "t": Table(np.array([0.0, 9.0]), np.ones((2, 1))),
    }
    components["last"] = Scripted(list(range(12)))
    memory = attempt(components, {"behind.u": "x.y"}, Stopped, block=block)
    assert memory.time("n").tolist() == [0.0]


@pytest.mark.parametrize("block", BLOCKS)
def test_a_regular_end_is_no_error(block):
    """A component that asks for the end gets it, with the step it completed."""
    memory = attempt(
        {"x": script(stop(failed=False, done=[7.0]), 5), "a": integrator()},
        {"a.u": "x.y"},
        block=block,
    )
    assert memory["x.y"].tolist() == [0, 1, 2, 3, 4, 7]
    assert memory.status == "complete"
    assert memory.reason == "'x' stopped at t = 0.5 s: enough"
    assert len(memory["a.y"]) == 6


@pytest.mark.parametrize("block", BLOCKS)
def test_the_first_of_two_stops_counts(block):
    """By time, whoever is asked first."""
    late = script(stop(), 6)
    early = script(stop(failed=False), 4)
    assert len(attempt({"late": late, "early": early}, {}, block=block)["late.y"]) == 4
    late = script(stop(failed=False), 6)
    early = script(stop(), 4)
    attempt(
        {"late": late, "early": early},
        {},
        Stopped,
        block=block,
        text=r"'early' stopped at t = 0\.3\d* s: enough",
    )


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
@pytest.mark.parametrize("block", BLOCKS)
def test_a_loop_stops_with_everything_before(block, coupling):
    """A failed step is not recorded.

    A step completed before a regular end is recorded, for every component of the loop.
    """
    for failed, done, rows in ((True, [], 5), (False, [], 5), (False, [7.0], 6)):
        components = {
            "x": script(stop(failed=failed, done=done), 5, inputs=1),
            "a": integrator(),
            "behind": times(1.0),
        }
        memory = attempt(
            components,
            {"a.u": "x.y", "x.u0": "a.y", "behind.u": "a.y"},
            Stopped if failed else None,
            block=block,
            coupling=coupling,
        )
        assert memory["x.y"].tolist() == [0, 1, 2, 3, 4, *done]
        assert len(memory["a.y"]) == len(memory["behind.y"]) == rows
        assert (memory["a.u"] == memory["x.y"]).all()
        assert (memory["x.u0"] == memory["a.y"]).all()


@pytest.mark.parametrize("block", BLOCKS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_stops_the_run(value, block):
    """It is named where it arose, not where it was seen first; everything before is recorded."""
    components = {"behind": times(2.0), "x": script(value, 5), "b": integrator()}
    text = rf"^'x\.y' became {value} at t = 0\.5 s; everything before is kept$"
    memory = attempt(
        components, {"behind.u": "x.y", "b.u": "x.y"}, NonFiniteError, block=block, text=text
    )
    assert memory["x.y"].tolist() == [0, 1, 2, 3, 4]
    assert len(memory["behind.y"]) == 5


@pytest.mark.parametrize("block", BLOCKS)
def test_the_first_value_that_is_not_finite_is_named(block):
    """By time; an element of a vector by its number."""
    vector = {"a": script(np.nan, 7), "b": script(np.nan, 4), "v": gain(np.array([[0.0], [1.0]]))}
    attempt(
        vector,
        {"v.u": "a.y"},
        NonFiniteError,
        block=block,
        text=r"^'b\.y' became nan at t = 0\.4 s",
    )
    big = {"a": Scripted([1e300] * 12), "v": gain(np.array([[0.0], [1e10]]))}
    attempt(
        big,
        {"v.u": "a.y"},
        NonFiniteError,
        block=block,
        text=r"^'v\.y\[1\]' became inf at t = 0\.0 s",
    )


@pytest.mark.parametrize("block", BLOCKS)
def test_an_infinity_behind_a_gain_is_named_at_the_input(block):
    """The output before it is sound."""
    components = {"a": script(1e300, 3), "b": times(1.0)}
    attempt(
        components,
        {"b.u": Connection("a.y", 1e10)},
        NonFiniteError,
        block=block,
        text=r"^'b\.u' became inf at t = 0\.3\d* s",
    )


class Failing(Scripted):
    """``y = u0 / 2``, or 0.1 where nothing feeds through; not a number from some call on."""

    def __init__(self, method, *, feeds):
        super().__init__([0.0] * 12, inputs=1)
        dependencies = {"y": ("u0",)} if feeds else {}
        self.interface = replace(self.interface, feedthrough=dependencies)
        self.method = method
        self.feeds = feeds

    def initialize(self, t, u):
        self.k = 0
        return np.array([np.nan]) if self.method == "initialize" else self.outputs(t, u)

    def outputs(self, t, u):
        failed = self.method == "outputs" or (self.method == "advance" and self.k >= 3)
        return np.array([np.nan if failed else u[0] / 2.0 if self.feeds else 0.1])

    def advance(self, t, h, u):
        rows = []
        for k in range(1, len(t)):
            self.k += 1
            rows.append(self.outputs(t[k], u[k]))
        return np.array(rows)


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
@pytest.mark.parametrize("names", ["ab", "ba"])
@pytest.mark.parametrize("method", ["initialize", "outputs", "advance"])
@pytest.mark.parametrize("feeds", [True, False])
def test_the_cause_in_a_loop_is_named_not_what_it_has_gone_around_to(
    names, method, feeds, coupling
):
    """At the end everything in the loop is NaN; whoever made it of finite inputs is named."""
    cause, other = names
    components = {other: integrator() if feeds else times(0.5), cause: Failing(method, feeds=feeds)}
    connections = {f"{other}.u": f"{cause}.y", f"{cause}.u0": f"{other}.y"}
    if method == "initialize" and not feeds:
        attempt(components, connections, coupling=coupling)  # what it starts with is sound
        return
    time = r"0\.3" if method == "advance" else r"0\.0"
    attempt(
        components,
        connections,
        NonFiniteError,
        text=rf"'{cause}\.y' became nan at t = {time} s",
        coupling=coupling,
    )


def test_a_start_that_is_not_finite_leaves_nothing():
    """At t = 0 there is nothing before."""
    memory = attempt(
        {"x": script(np.nan, 0)}, {}, NonFiniteError, text=r"'x\.y' became nan at t = 0\.0 s"
    )
    assert memory["x.y"].shape == (0,)
    assert memory.time_ns("x").shape == (0,)


@pytest.mark.parametrize("block", BLOCKS)
def test_no_value_yet_passes_where_it_may(block):
    """NaN in an optional output goes on; infinity does not."""
    memory = attempt({"x": script(np.nan, 5, optional=True)}, {}, block=block)
    assert np.isnan(memory["x.y"]).tolist() == [k == 5 for k in range(11)]
    attempt(
        {"x": script(np.inf, 5, optional=True)},
        {},
        NonFiniteError,
        block=block,
        text=r"'x\.y' became inf at t = 0\.5 s",
    )


class Fussy(Scripted):
    """Stops at an input that is NaN, as an FMU may."""

    def advance(self, t, h, u):
        bad = np.flatnonzero(np.isnan(u[1:, 0]))
        if bad.size:
            done = super().advance(t[: bad[0] + 1], h, u) if bad[0] else np.empty((0, 1))
            raise Stopped(done, "my input is NaN")
        return super().advance(t, h, u)


@pytest.mark.parametrize("block", BLOCKS)
def test_the_cause_is_named_not_who_suffers(block):
    """A component behind never sees the value that is not finite.

    Its own complaint would hide where that value arose.
    """
    components = {"x": script(np.nan, 5), "fussy": Fussy(list(range(12)), inputs=1)}
    attempt(
        components,
        {"fussy.u0": "x.y"},
        NonFiniteError,
        block=block,
        text=r"'x\.y' became nan at t = 0\.5 s",
    )


@pytest.mark.parametrize("block", [1, 3])
def test_an_exception_inside_a_component_leaves_the_recorder_closed(block):
    """With every block before it; the error names component, method and line."""
    memory = attempt(
        {"x": script(ZeroDivisionError("mine"), 5)},
        {},
        Stopped,
        block=block,
        text=r"'x' stopped at t = .*: advance raised ZeroDivisionError: mine \(.*parts.py, line",
    )
    assert memory["x.y"].tolist() == list(range(5 if block == 1 else 4))


def test_a_keyboard_interrupt_leaves_the_recorder_closed():
    """It is no exception of ours, and passes through."""

    class Pressed(Scripted):
        def advance(self, t, h, u):
            raise KeyboardInterrupt

    memory = attempt({"x": Pressed([0.0])}, {}, KeyboardInterrupt)
    assert (memory.status, memory.reason) == ("interrupted", "interrupted by the user")


# --- recorders ---


def small():
    components = {
        "u": sine(amplitude=1.0, rate=1.0, phase=0.0, offset=0.0),
        "s": sum_of([1.0, 1.0], size=1),
        "d": Decimated(integrator(), 3),
    }
    return Graph(components, {"s.u1": "u.y", "s.u2": "u.y", "d.u": "s.y"}, periods={"d": 3})


def test_memory_keeps_the_rows_of_a_period():
    """A component with a period of three steps keeps every third row."""
    memory = Memory({"name": "small"})
    run(small(), Clock(1.0, 0.1, 4), memory)
    assert memory.time_ns("u").tolist() == [k * 10**8 for k in range(11)]
    assert memory.time_ns("d").tolist() == [0, 3 * 10**8, 6 * 10**8, 9 * 10**8]
    assert len(memory["d.y"]) == len(memory["d.u"]) == 4
    assert memory.time("d.y").tolist() == memory.time("d").tolist() == [0.0, 0.3, 0.6, 0.9]
    assert memory.metadata == {"name": "small"}
    assert (memory.status, memory.reason) == ("complete", "")
    assert list(memory.channels) == ["u", "s", "d"]


def test_memory_names_what_was_not_recorded():
    """With the nearest name."""
    memory = Memory()
    run(small(), Clock(1.0, 0.1), memory)
    with pytest.raises(LogError, match=r"the run has no component 'x'.*u, s, d"):
        memory["x.y"]
    with pytest.raises(
        LogError, match=r"'s\.u3': 's' has no signal 'u3'; did you mean 'u2'\? Available: u1, u2, y"
    ):
        memory["s.u3"]


def test_nothing_keeps_nothing():
    """It only takes."""
    run(small(), Clock(1.0, 0.1), Nothing())


@pytest.mark.parametrize("block", BLOCKS)
def test_watched_reports_after_recording_and_may_end_the_run(block):
    """What was reported is recorded, and the recorder is closed."""
    memory = Guarded()
    instants = []

    def reached(block, rows):
        assert rows[-1].tolist() == memory._rows.all()[-1].tolist()
        instants.append(block.time_ns[-1])
        assert memory._times[-1][-1] == block.time_ns[-1]
        if block.time_ns[-1] >= 5 * 10**8:
            raise RunError("that will do")

    with pytest.raises(RunError, match="that will do"):
        run(small(), Clock(1.0, 0.1, block), Watched(memory, reached))
    assert memory.calls == ["enter", RunError]
    assert memory.time_ns("u")[-1] == instants[-1]
    assert instants[-1] == {1: 5, 3: 6, 1000: 10}[block] * 10**8


class Refusing:
    """A component that counts its steps, and refuses its outputs or a step from t = 0.5 s on.

    Its refusal of outputs does not say how far it came.
    """

    interface = Interface((), (Signal("y"),))

    def __init__(self, *, asked):
        self.asked = asked

    def initialize(self, t, u):
        self.y = 0.0
        return np.zeros(1)

    def outputs(self, t, u):
        if self.asked and t > 0.45:
            raise RunError("no outputs")
        return np.array([self.y])

    def advance(self, t, h, u):
        rows = np.empty((len(t) - 1, 1))
        for k in range(len(rows)):
            if not self.asked and t[k] > 0.45:
                raise Stopped(rows[:k].copy(), "no step")
            self.y += 1.0
            rows[k] = self.y
        return rows


@pytest.mark.parametrize(
    ("wrap", "asked"),
    [
        (lambda part: Sampled(part, 1), True),
        (lambda part: Sampled(part, 2), True),
        (lambda part: Sampled(part, 2), False),
        (
            lambda part: Decimated(part, 2),
            False,
        ),  # Decimated asks for outputs where a block begins, and only there
    ],
)
def test_rows_before_a_failure_do_not_depend_on_the_block(wrap, asked):
    """An error of a component with a period keeps the rows before it, whatever the block size.

    The message names component and time.
    """
    kept = []
    for block in (1, 7, 1000):
        memory = attempt(
            {"c": wrap(Refusing(asked=asked))}, {}, Stopped, block=block, text="'c' stopped at t = "
        )
        kept.append(memory["c.y"].tolist())
    assert kept[0] == kept[1] == kept[2]


def test_a_simulation_stands_still_between_blocks():
    """Block after block, as many as are asked for; the rows are those that a run records."""
    graph = Graph({"u": sine(rate=1.0), "x": integrator()}, {"x.u": "u.y"})
    memory = Memory()
    run(graph, Clock(0.1, 1e-3, block=7), memory)
    times = []
    rows = []
    for block, signals in simulate(graph, Clock(0.1, 1e-3, block=7)):
        times += block.time[1:].tolist()
        rows.append(signals[1:].copy())
        assert signals.shape == (block.steps + 1, graph.layout.width)
        if len(rows) == 3:
            break
    assert times == (np.arange(1, 22) * 1_000_000 / 1e9).tolist()
    column = graph.layout["x"].outputs
    assert (np.vstack(rows)[:, column][:, 0] == memory["x.y"][1:22]).all()


def test_a_simulation_raises_behind_the_last_block():
    """What was completed is yielded first, then the error comes."""
    graph = Graph({"x": Scripted([1.0, 2.0, np.inf, 3.0])}, {})
    blocks = simulate(graph, Clock(0.003, 1e-3, block=3))
    block, signals = next(blocks)
    assert (block.steps, signals[:, 0].tolist()) == (1, [1.0, 2.0])
    with pytest.raises(NonFiniteError, match=r"'x\.y' became inf at t = 0\.002 s"):
        next(blocks)


def test_memory_keeps_messages_and_results():
    """A recorder that is no file needs no other place for them; messages are sorted by time."""
    memory = Memory()
    memory.message(5, "warning", "plant", "slow")
    memory.message(3, "info", "sensor", "warm")
    memory.result({"last": 1.0})
    memory.result({"steps": 2})
    messages = [(3, "info", "sensor", "warm"), (5, "warning", "plant", "slow")]
    assert memory.messages() == messages
    assert memory.results == {"last": 1.0, "steps": 2}


def test_two_simulations_of_one_graph_do_not_mix():
    """The components have one state: the first simulation ends where a second has begun."""
    graph = Graph({"u": sine(rate=1.0), "x": integrator()}, {"x.u": "u.y"})
    clock = Clock(0.1, 1e-3, block=7)
    first = simulate(graph, clock)
    next(first)
    second = simulate(graph, clock)
    next(second)
    with pytest.raises(UsageError, match="another simulation of this graph has begun"):
        next(first)
    assert sum(block.steps for block, _ in second) == 93
