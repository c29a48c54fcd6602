"""Loops that take substeps: tolerances, the tree of parts, what is recorded, replays."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.blocks.dynamics import Delay
from cosim.blocks.replay import Replay
from cosim.blocks.sampled import Sampled
from cosim.blocks.source import ramp, step
from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.contracts import Stopped
from cosim.core.ensemble import run_members
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.core.simulation import Simulation
from cosim.core.stages.spans import Span, StepPart
from cosim.core.stages.substep_control import SubstepTolerance
from cosim.errors import GraphError, LogError, RunError
from cosim.instants import whole_duration
from tests.core.graphs import pair, record, solution, state_space, states

SIGNALS = ("one.u", "one.y", "one.x", "two.u", "two.y", "two.x")


def tolerance(value, min_ns=1000):
    return SubstepTolerance(rtol=value, atol=value, min_ns=min_ns)


def counts_of(graph):
    return graph.substep_controls[0].counts


@given(st.integers(2, 10**12), st.integers(1, 10**9), st.integers(0, 10**12), st.data())
def test_the_parts_of_a_step_follow_each_other_in_whole_nanoseconds(step_ns, min_ns, at, data):
    """Halves meet, none is shorter than the shortest substep, and every length is known before."""
    if 2 * min_ns > step_ns:
        return
    limits = SubstepTolerance(min_ns=min_ns)
    step = Span(at / 1e9, (at + step_ns) / 1e9, at, at + step_ns, is_step=True)
    level = data.draw(st.integers(0, limits.finest_level(step_ns) - 1))
    part = StepPart(step, level, data.draw(st.integers(0, 2**level - 1)))
    first, second = part.halves
    assert first.begin == part.begin
    assert first.end == second.begin
    assert second.end == part.end
    for half in (first, second):
        length = whole_duration(half.begin, half.end)
        assert length >= min_ns / 1e9
        assert length in limits.lengths(step_ns)
    assert StepPart(step, level, 2**level - 1).end == step.end


@given(st.floats(0.0, 1e6), st.floats(1e-15, 10.0), st.data())
def test_the_rest_behind_an_event_is_divided_at_whole_nanoseconds(begin, length, data):
    """Its ends are what was given, to the last bit; its parts follow each other."""
    span = Span.between(begin, begin + length)
    if not span.whole.has_halves:
        assert length < 4e-9
        return
    deepest = (span.last_ns - span.first_ns).bit_length() - 1
    level = data.draw(st.integers(0, deepest - 1))
    part = StepPart(span, level, data.draw(st.integers(0, 2**level - 1)))
    assert span.begin <= part.begin < part.halves[0].end < part.end <= span.end
    assert part.halves[0].end == part.halves[1].begin
    assert whole_duration(part.halves[0].end, 0.0) is not None
    assert (part.following(level) or span).begin in (part.end, span.begin)


def test_the_error_follows_the_tolerance():
    """Errors of single substeps add up: over this run to less than a hundred times one of them."""
    exact = solution(1.0)
    used = []
    for value in (1e-4, 1e-6, 1e-8):
        graph = pair(substeps=tolerance(value))
        error = np.abs(states(record(graph, step=0.1)) - exact).max()
        assert error < 100 * value
        assert counts_of(graph).missed == 0
        used.append(counts_of(graph).accepted)
    # of second order: a local error of third order, so 100 ** (1 / 3) = 4.6 times as many
    assert used[0] < used[1] < used[2] < 10 * used[1]


def test_substeps_are_short_where_the_loop_is_fast_and_long_behind():
    """The coupled pair has a pole at -3079 /s, which has decayed after a few of its times."""
    graph = pair(substeps=tolerance(1e-6))
    memory = record(graph, step=0.1)
    accepted = [substep for substep in memory.substeps() if substep.accepted]
    early = [s.length for s in accepted if s.begin < 1e-3]
    late = [s.length for s in accepted if s.begin > 0.9]
    assert max(early) < 1e-3 < min(late)


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi", "newton"])
def test_halves_of_a_step_are_steps_of_half_the_length(coupling):
    """With nothing between a step and its halves to choose from, the rows are those of h / 2."""
    strict = SubstepTolerance(rtol=0.0, atol=1e-300, min_ns=5_000_000)
    divided = record(pair(coupling, substeps=strict), stop=0.1, step=0.01)
    finer = record(pair(coupling), stop=0.1, step=0.005)
    for signal in SIGNALS:
        if coupling == "newton":  # what is solved for is known to the tolerance of the solver
            np.testing.assert_allclose(divided[signal], finer[signal][::2], rtol=1e-9)
        else:
            np.testing.assert_array_equal(divided[signal], finer[signal][::2])


def driven(source, substeps=None, **options):
    """x1' = -x1 + u + y2, x2' = -2 x2 + y1, of which ``source`` drives u."""
    one = state_space(-1.0, 1.0, 1.0, 0.0, 0.0)
    two = state_space(-2.0, 1.0, 1.0, 0.0, 0.0)
    sum_of_both = Connection(("drive.y", "two.y"), gain=np.array([[1.0, 1.0]]))
    wires = {"one.u": sum_of_both, "two.u": "one.y"}
    return Graph({"drive": source, "one": one, "two": two}, wires, substeps=substeps, **options)


def test_inputs_of_a_loop_are_interpolated_between_communication_points():
    """A ramp is a straight line, so that halves of a step are those of a finer run but rounding."""
    strict = SubstepTolerance(rtol=0.0, atol=1e-300, min_ns=5_000_000)
    divided = record(driven(ramp(slope=3.0), strict), stop=0.1, step=0.01)
    finer = record(driven(ramp(slope=3.0)), stop=0.1, step=0.005)
    for signal in ("one.x", "two.x", "one.u"):
        np.testing.assert_allclose(divided[signal], finer[signal][::2], rtol=1e-13, atol=1e-15)


def test_a_discrete_signal_holds_through_the_substeps():
    """It steps at 0.05 s, a communication point; the halves of the step before see nothing of it.

    Exactly as in steps of half the length, where the point is one, too.
    """
    strict = SubstepTolerance(rtol=0.0, atol=1e-300, min_ns=5_000_000)
    source = {"time": 0.05, "before": 0.0, "after": 1.0}
    divided = record(driven(step(**source), strict), stop=0.1, step=0.01)
    finer = record(driven(step(**source)), stop=0.1, step=0.005)
    for signal in ("one.x", "two.x", "one.u"):
        np.testing.assert_array_equal(divided[signal], finer[signal][::2])


def same(a, b):
    for signal in SIGNALS:
        assert a[signal].tobytes() == b[signal].tobytes()
    assert a.substeps() == b.substeps()


def test_blocks_and_compiled_code_change_no_bit():
    """Neither of the rows nor of the substeps."""
    limits = tolerance(1e-5)
    whole = record(pair(substeps=limits), stop=0.2)
    same(whole, record(pair(substeps=limits), stop=0.2, block=3))
    same(whole, record(pair(substeps=limits, native=False), stop=0.2))


def test_a_condition_that_ends_a_run_leaves_the_substeps_up_to_there():
    """Stages that were ahead of the row go back, and take the same substeps again."""
    limits = tolerance(1e-5)
    whole = record(pair(substeps=limits), stop=0.2)
    for block in (None, 4):
        memory = Memory()
        run(pair(substeps=limits), Clock(0.2, 0.01, block), memory, until="one.x < 0.9")
        end_ns = memory.end_ns
        assert 0 < end_ns < 200_000_000
        expected = [s for s in whole.substeps() if s.begin_ns < end_ns]
        assert memory.substeps() == expected


def test_a_state_goes_back_with_the_length_of_the_next_substep():
    """The steps behind it have the same bits again."""
    simulation = Simulation(pair(substeps=tolerance(1e-6)), Clock(1.0, 0.01))
    simulation.step(10)
    saved = simulation.state
    first = simulation.step(5)["one.u"]
    simulation.state = saved
    assert simulation.step(5)["one.u"].tobytes() == first.tobytes()


def test_every_substep_is_recorded_with_what_the_loop_had_at_its_end():
    """Accepted ones fill the run without gaps; a refused one has no values."""
    memory = record(pair(substeps=tolerance(1e-5)), stop=0.05)
    substeps = memory.substeps()
    accepted = [substep for substep in substeps if substep.accepted]
    refused = [substep for substep in substeps if not substep.accepted]
    assert refused
    assert all(substep.error > 1.0 and substep.values == () for substep in refused)
    assert all(substep.error <= 1.0 for substep in accepted)
    reached = 0
    for substep in accepted:
        assert substep.begin == reached / 1e9
        reached += round(substep.length * 1e9)
        if reached % 10_000_000 == 0:
            row = [memory[signal][reached // 10_000_000] for signal in SIGNALS]
            assert substep.values == tuple(row)
    assert reached == 50_000_000
    begins = [substep.begin for substep in substeps]
    assert begins == sorted(begins)


class Limited:
    """x' = -x - u by Euler, which refuses steps of more than ``longest``; y = x."""

    def __init__(self, longest, nominal=1.0):
        self.longest = longest
        y = Signal("y", nominal=(nominal,))
        self.interface = Interface((Signal("u"),), (y,), rollback=True, substeps=True)

    def initialize(self, t, u):
        self.x = 1.0
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([self.x])

    def advance(self, t, h, u):
        if h > self.longest:
            raise Stopped(np.empty((0, 1)), f"a step of {h} s is too long")
        self.x -= h * (u[0, 0] + self.x)
        return np.array([[self.x]])

    def save(self):
        return self.x

    def restore(self, state):
        self.x = state


def limited(longest, substeps, nominal=1.0):
    components = {"one": Limited(longest, nominal), "two": Limited(1.0, nominal)}
    return Graph(components, {"one.u": "two.y", "two.u": "one.y"}, substeps=substeps)


def test_a_step_that_a_component_cannot_take_is_divided():
    """FMUs discard steps that are too long."""
    graph = limited(2e-3, SubstepTolerance(1.0, 1.0, 1000))
    memory = record(graph, stop=0.1)
    longest = max(substep.length for substep in memory.substeps() if substep.accepted)
    assert longest == 625e-6  # half of the longest that could be taken at once
    assert math.inf in [substep.error for substep in memory.substeps()]


def test_a_step_that_cannot_be_divided_further_ends_the_run():
    """The component's own reason is the one that is given."""
    graph = limited(2e-3, SubstepTolerance(1.0, 1.0, 4_000_000))
    with pytest.raises(RunError, match=r"'one' stopped at t = 0.0.* too long"):
        record(graph, stop=0.1)


class Eventful(Limited):
    """The same, with events at the times that a function of the begin and end of a step gives."""

    def __init__(self, event_time):
        super().__init__(math.inf)
        self.interface = replace(self.interface, locates_events=True)
        self._event_time = event_time

    def advance(self, t, h, u):
        self._ends = t
        return super().advance(t, h, u)

    def first_event(self):
        return self._event_time(*self._ends.tolist())


def eventful(event_time, substeps):
    components = {"one": Eventful(event_time), "two": Limited(1.0)}
    return Graph(components, {"one.u": "two.y", "two.u": "one.y"}, substeps=substeps)


def test_a_substep_ends_at_the_time_of_an_event_to_the_last_bit():
    """Also a part of a nanosecond behind the begin, or before the end."""
    times = [0.0033333333333333335, 0.0133, 0.02 + 3e-13, 0.04 - 4e-13]
    graph = eventful(
        lambda t0, t1: min([t for t in times if t0 < t], default=math.inf), tolerance(1.0)
    )
    memory = record(graph, stop=0.05, step=0.01)
    accepted = [s for s in memory.substeps() if s.accepted]
    assert [s.end for s in accepted if s.event] == times
    assert {s.event for s in accepted} == {"one", ""}
    assert [s.begin for s in accepted[1:]] == [s.end for s in accepted[:-1]]
    refused = [s for s in memory.substeps() if not s.accepted]
    assert [(s.event, s.error, s.values) for s in refused] == [("one", None, ())] * 4
    counts = counts_of(graph)
    assert counts.events == 4
    assert counts.shortest >= 1e-3  # of those that the control has chosen


def test_substeps_that_an_event_begins_or_ends_are_not_the_shortest():
    """Also where the event is at a whole nanosecond, as those that an FMU announces often are."""
    graph = eventful(lambda t0, t1: 0.005000003 if t0 < 0.005000003 else math.inf, tolerance(1.0))
    memory = record(graph, stop=0.05, step=0.01)
    lengths = {s.length for s in memory.substeps() if s.accepted}
    counts = counts_of(graph)
    assert counts.events == 1
    assert min(lengths) < counts.shortest
    assert counts.shortest in lengths


def test_events_at_the_ends_of_a_step_divide_nothing():
    """They happen at a communication point."""
    graph = eventful(lambda t0, t1: t1, tolerance(1.0))
    record(graph, stop=0.05, step=0.01)
    assert counts_of(graph).events == 0


def test_an_event_that_comes_earlier_each_time_is_found_by_and_by():
    """With the inputs of each shorter part it is nearer to 3 ms: a thousandth of the distance."""
    graph = eventful(lambda t0, t1: 3e-3 + 1e-3 * (t1 - 3e-3) if t0 < 3e-3 else t1, tolerance(1.0))
    memory = record(graph, stop=0.01, step=0.01)
    ends = [s.end for s in memory.substeps() if s.accepted and s.event]
    assert ends[0] == pytest.approx(3e-3, abs=1e-17)
    assert len(ends) < 10


@pytest.mark.parametrize("event_time", [lambda t0, t1: t0 + 1e-14, lambda t0, t1: 0.5 * (t0 + t1)])
def test_events_without_end_stop_the_run(event_time):
    """As in an FMU whose relay slides."""
    graph = eventful(event_time, tolerance(1.0))
    reason = r"'one' stopped at t = .*: 1000 events at t = .* s, the last at .* s, do not advance"
    with pytest.raises(RunError, match=reason):
        record(graph, stop=0.05, step=0.01)


def test_any_number_of_events_fits_into_one_step():
    """1 100 of them, 1 us apart."""
    graph = eventful(lambda t0, t1: 1e-6 * math.floor(1e6 * t0 + 1.001), tolerance(1.0))
    record(graph, stop=0.0011, step=0.0011)
    assert counts_of(graph).events == 1099


@pytest.mark.parametrize(
    ("event_time", "text"),
    [
        (lambda t0, t1: math.nan, r"first_event: .*a time \[s\], or infinity.* got nan"),
        (lambda t0, t1: None, r"first_event: .*a time \[s\], or infinity.* got None"),
    ],
)
def test_a_time_of_an_event_that_is_none_is_refused(event_time, text):
    """By the name of the component, with the rows up to there."""
    graph = eventful(event_time, tolerance(1.0))
    with pytest.raises(RunError, match=rf"'one' stopped at t = 0.0 s: {text}"):
        record(graph, stop=0.05, step=0.01)


def test_substeps_that_miss_the_tolerance_are_counted():
    """They cannot be shorter: the run goes on, and says so."""
    graph = pair("gauss-seidel", substeps=tolerance(1e-9, min_ns=1_000_000))
    memory = record(graph, stop=0.1)
    counts = counts_of(graph)
    missing = [s for s in memory.substeps() if s.accepted and s.error > 1.0]
    assert counts.missed == len(missing) > 0
    assert counts.worst_error == max(s.error for s in missing)
    assert counts.shortest == min(s.length for s in missing) >= 1e-3


# --- recorded components ---


def again(original, coupling="newton", *, native=True):
    """Build the pair with its first component as it was recorded."""
    limits = tolerance(1e-5)
    components = {
        "one": Replay(original, "one"),
        "two": pair().components["two"],
    }
    connections = {"one.u": "two.y", "two.u": "one.y"}
    graph = Graph(components, connections, coupling=coupling, substeps=limits, native=native)
    graph.take_solutions(original, ["one"])
    return graph


@pytest.mark.fast("newton")
@pytest.mark.parametrize("coupling", ["newton", "gauss-seidel", "jacobi"])
def test_a_loop_with_recorded_components_takes_the_recorded_substeps(coupling):
    """The others compute the same bits from what was applied to them then.

    In this algebraic loop the outputs belong to inputs from before the substep, with Jacobi.
    """
    original = record(pair(coupling, substeps=tolerance(1e-5)), stop=0.01, step=0.005)
    for native in (True, False):
        replayed = again(original, coupling, native=native)
        same(original, record(replayed, stop=0.01, step=0.005))


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
@pytest.mark.parametrize("recorded", ["one", "two"])
def test_components_that_took_the_latest_values_take_them_again(recorded, coupling, native):
    """The first one had what the other gave at the begin of a substep, over all of it."""
    method = {"coupling": coupling, "input_interpolation": "latest", "native": native}

    def loop(**components):
        own = {
            "one": state_space(-1.0, 1.0, 1.0, 0.0, 1.0),
            "two": state_space(-2.0, 1.0, 1.0, 0.5, 0.0),
        }
        connections = {
            "one.u": Connection(("two.y",), gain=np.array([[-1.0]])),
            "two.u": "one.y",
        }
        return Graph({**own, **components}, connections, substeps=tolerance(1e-4), **method)

    original = record(loop(), stop=0.2)
    replayed = loop(**{recorded: Replay(original, recorded)})
    replayed.take_solutions(original, [recorded])
    memory = record(replayed, stop=0.2)
    for signal in ("one.x", "two.x", "one.y", "two.y", "one.u", "two.u"):
        assert memory[signal].tobytes() == original[signal].tobytes()
    assert memory.substeps() == original.substeps()


def test_a_change_of_a_component_shows_beside_recorded_ones():
    """The comparison of a replay rests on it."""
    original = record(pair(substeps=tolerance(1e-5)), stop=0.2)
    graph = again(original)
    graph.components["two"].model.A[0, 0] = -1.1
    assert (record(graph, stop=0.2)["two.x"][1:] != original["two.x"][1:]).all()


def test_substeps_that_are_missing_are_named():
    """Rows at communication points do not say what a component was given between them."""
    original = record(pair(substeps=tolerance(1e-5)), stop=0.2)
    whole = original.substeps()
    first = next(substep for substep in whole if substep.accepted)
    for damaged in ([], [s for s in whole if s is not first], whole[:-1]):
        original.substeps = lambda damaged=damaged: damaged
        with pytest.raises(LogError, match=r"the substeps of the loop of 'one'.*loop.*step"):
            again(original)


def jumping(source, components=None, substeps=None):
    """Return a loop whose first output jumps with its source, and a filter that follows it."""
    matrices = {"A": -np.eye(1), "B": np.ones((1, 2)), "C": np.eye(1), "D": np.array([[1.0, 0.0]])}
    parts = {
        "drive": source,
        "one": Linear(controller(**matrices, x0=np.ones(1))),
        "two": state_space(-2.0, -1.0, 1.0, 0.0, 0.0),
        "filter": state_space(-50.0, 50.0, 1.0, 0.0, 0.0),
        **(components or {}),
    }
    connections = {
        "one.u[0]": "drive.y",
        "one.u[1]": "two.y",
        "two.u": "one.y",
        "filter.u": "one.y",
    }
    return Graph(parts, connections, coupling="newton", substeps=substeps)


def test_followers_of_a_jump_behind_recorded_substeps_take_its_left_limit():
    """The row has the right one; the left one is that of the last substep before the jump."""
    limits = tolerance(1e-5)
    source = {"time": 0.05, "before": 0.0, "after": 1.0}
    original = record(jumping(step(**source), substeps=limits), stop=0.1)
    assert [event.signal for event in original.events()] == ["one.y"]
    graph = jumping(step(**source), {"two": Replay(original, "two")}, limits)
    graph.take_solutions(original, ["two"])
    again = record(graph, stop=0.1)
    for signal in ("one.y", "one.x", "two.y", "filter.u", "filter.y"):
        assert again[signal].tobytes() == original[signal].tobytes(), signal
    assert again.events() == original.events()


# --- components with steps of their own ---


def sampled_loop(samples, substeps=None, native=True, coupling="gauss-seidel"):
    """Two coupled systems, whose sum a sampled controller with direct feedthrough drives."""
    controller_gain = state_space(-0.5, 1.0, -0.3, -0.8, 0.1)
    components = {
        "control": Sampled(controller_gain, samples, hold=True),
        "one": Linear(
            controller(
                A=-np.eye(1), B=np.ones((1, 2)), C=np.eye(1), D=np.zeros((1, 2)), x0=np.ones(1)
            )
        ),
        "two": state_space(-2.0, 1.0, 1.0, 0.0, -0.5),
    }
    wires = {
        "control.u": "one.y",
        "one.u[0]": "control.y",
        "one.u[1]": "two.y",
        "two.u": "one.y",
    }
    return Graph(components, wires, substeps=substeps, native=native, coupling=coupling)


SAMPLED_SIGNALS = ("control.u", "control.y", "one.u", "one.x", "two.x")


@pytest.mark.parametrize("coupling", ["gauss-seidel", "newton"])
def test_a_sampled_controller_keeps_to_communication_steps(coupling):
    """Beside it halves of a step are steps of half the length, in which it holds its output."""
    strict = SubstepTolerance(rtol=0.0, atol=1e-300, min_ns=5_000_000)
    divided = record(sampled_loop(2, strict, coupling=coupling), stop=0.2, step=0.01)
    finer = record(sampled_loop(4, coupling=coupling), stop=0.2, step=0.005)
    for signal in SAMPLED_SIGNALS:
        # Newton's method is at an end within its tolerance
        rtol = 1e-9 if coupling == "newton" else 1e-14
        np.testing.assert_allclose(divided[signal], finer[signal][::2], rtol=rtol, atol=1e-12)


def test_the_description_shows_which_components_advance_inside_a_step():
    """The two systems do; the controller advances behind them."""
    graph = sampled_loop(2, tolerance(1e-6))
    (loop,) = graph.stages
    assert loop.nested.late == {"control"}
    assert [stage.is_loop for stage in loop.nested.stages] == [True]
    assert loop.description.endswith("(inside a step: gauss-seidel one two (substeps))")


@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi", "newton"])
def test_nested_loops_have_the_same_bits_in_any_block(coupling):
    """With compiled code and without."""
    limits = tolerance(1e-5)
    whole = record(sampled_loop(3, limits, coupling=coupling), stop=0.2)
    others = [
        record(sampled_loop(3, limits, coupling=coupling), stop=0.2, block=3),
        record(sampled_loop(3, limits, native=False, coupling=coupling), stop=0.2),
    ]
    assert whole.substeps()
    for other in others:
        for signal in SAMPLED_SIGNALS:
            assert whole[signal].tobytes() == other[signal].tobytes()
        assert whole.substeps() == other.substeps()


def test_a_delay_advances_before_the_substeps():
    """Its output at the end of a step is known at its start; exactly, by the method of steps.

    x' = z - x(t - 1) with x = 1 before, z' = -z, z(0) = 0: x = 1 - t up to t = 1; z only follows.
    """
    components = {
        "x": state_space(0.0, 1.0, 1.0, 0.0, 1.0),
        "z": state_space(-1.0, 0.0, 1.0, 0.0, 0.0),
        "w": state_space(-1.0, 1.0, 0.0, 0.0, 0.0),
        "late": Delay(10, initial=1.0),
    }
    drive = Connection(("z.y", "late.y", "w.y"), gain=np.array([[1.0, -1.0, 1.0]]))
    wires = {"x.u": drive, "z.u": "x.y", "w.u": "x.y", "late.u": "x.y"}
    graph = Graph(components, wires, substeps=tolerance(1e-6))
    (loop,) = graph.stages
    assert loop.nested.early == {"late"}
    memory = record(graph, stop=1.0, step=0.1)
    np.testing.assert_allclose(memory["x.x"], 1.0 - memory.time("x"), atol=1e-12)


def test_recorded_components_beside_sampled_ones_take_the_recorded_substeps():
    """In a loop of which one that takes substeps is recorded; the controller is computed again."""
    limits = tolerance(1e-5)
    original = record(sampled_loop(3, limits), stop=0.2)
    plain = sampled_loop(3, limits)
    components = {**plain.components, "two": Replay(original, "two")}
    graph = Graph(components, plain.connections, substeps=limits)
    graph.take_solutions(original, ["two"])
    again = record(graph, stop=0.2)
    for signal in SAMPLED_SIGNALS:
        assert again[signal].tobytes() == original[signal].tobytes()
    assert again.substeps() == original.substeps()


# --- what is refused ---


class Follows:
    """y = u, of which its steps cannot be divided."""

    def __init__(self):
        self.interface = Interface((Signal("u"),), (Signal("y"),), {"y": ("u",)})

    def initialize(self, t, u):
        return u.copy()

    def outputs(self, t, u):
        return u.copy()

    def advance(self, t, h, u):
        return u[1:].copy()


def test_a_component_that_others_follow_through_a_step_is_refused():
    """It would have to be known between communication points."""
    components = {"one": state_space(-1.0, 1.0, 1.0, 0.0, 0.0), "whole": Follows()}
    connections = {"one.u": "whole.y", "whole.u": "one.y"}
    with pytest.raises(
        GraphError, match=r"whole in this loop cannot take part of a step.*step.*a loop.*step"
    ):
        Graph(components, connections, substeps=tolerance(1e-6))


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"rtol": -1e-6}, r"rtol:.*0.*-1e-06"),
        ({"atol": math.nan}, r"atol:.*0.*nan"),
        ({"rtol": "small"}, r"rtol:.*0.*'small'"),
        ({"rtol": 0.0, "atol": 0.0}, r"rtol.*0.*atol.*0.*rtol = atol = 0"),
        ({"min_ns": 0}, r"min_ns:.*1.*0"),
        ({"min_ns": 1.5}, r"min_ns:.*1.*1\.5"),
    ],
)
def test_a_wrong_tolerance_is_refused(values, text):
    """Each by its name."""
    with pytest.raises(GraphError, match=text):
        SubstepTolerance(**values)


def test_a_shortest_substep_that_is_no_half_of_a_step_is_refused():
    """There would be nothing to choose."""
    graph = pair(substeps=SubstepTolerance(min_ns=6_000_000))
    text = r"min:.*at most 0\.005 s, half.*step of 0\.01 s.*0\.006 s"
    with pytest.raises(GraphError, match=text):
        graph.prepare(10_000_000)


def test_absolute_tolerances_are_multiplied_by_nominal_values():
    """Of an output of nominal 1024 errors may be 1024 times as large; by powers of 2, exactly."""

    def substeps(atol, nominal):
        graph = limited(1.0, SubstepTolerance(rtol=0.0, atol=atol), nominal=nominal)
        return record(graph, stop=0.1).substeps()

    plain = substeps(2.0**-13, 1.0)
    assert substeps(2.0**-23, 2.0**10) == plain != substeps(2.0**-23, 1.0)


def test_members_of_an_ensemble_take_their_own_substeps():
    """The last rows are those of runs of their own; the next member begins with whole steps."""
    limits = tolerance(1e-5)
    graph = pair(substeps=limits)
    others = [{}, {"two": state_space(-2.0, 10.0, -31.0, -0.9, 1.0)}]
    found = run_members(graph, Clock(0.1, 0.01), others)
    for number, components in enumerate(others):
        own = pair(substeps=limits)
        own = Graph(
            {**own.components, **components}, own.connections, coupling="newton", substeps=limits
        )
        memory = record(own, stop=0.1)
        last = [memory[signal][-1] for signal in SIGNALS]
        assert found.last[number].tolist() == last
    assert graph.substep_controls[0].drain(1_000_000_000) == []


def test_the_order_of_a_nested_loop_is_that_of_what_takes_substeps():
    """The controller holds its output, which costs no order; Gauss-Seidel inside does."""
    second = sampled_loop(2, tolerance(1e-6), coupling="newton").stages[0]
    first = sampled_loop(2, tolerance(1e-6)).stages[0]
    assert not second.is_first_order
    assert first.is_first_order
