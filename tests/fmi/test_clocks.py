"""Clocks of FMI 3 in co-simulation and model exchange, against closed forms.

All of them are those of ``c/clocked3.c``, which answers whatever the standard forbids with an
error. Where communication steps of 40 ms divide no interval, ticks are inside them.
"""

import math
from contextlib import ExitStack
from itertools import count

import numpy as np
import pytest

from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.errors import FmuError, RunError
from cosim.fmi.checking.check import check
from cosim.fmi.component import describe, load
from cosim.fmi.options import FmuOptions
from cosim.testing import check_component, check_rollback
from tests.core.parts import Scripted, integrator
from tests.fmi import clocked

H = 0.04
STEPS = 100
STOP = STEPS * H
TYPES = pytest.mark.parametrize("interface_type", ["cs", "me"])
# Values up to 1e2, summed in at most 1e2 roundings: 1e2 * 1e2 * 2^-53 = 1.1e-12.
ROUNDING = 2e-12


@pytest.fixture
def opened(tmp_path):
    """Open the FMU with some clocks: its component, and its messages with ``drain``."""
    numbers = count()
    with ExitStack() as stack:

        def opened(interface_type, *clocks, can=("any step", "events"), changes=None, **start):
            path = tmp_path / f"{next(numbers)}.fmu"
            clocked.build(path, *clocks, can=can, changes=changes)
            options = FmuOptions(interface_type=interface_type, start=start)
            return stack.enter_context(load(path, options))

        yield opened


class Trace:
    """The outputs of a component by name, at every communication point."""

    def __init__(self, fmu, *, h=H, steps=STEPS, **inputs):
        interface = fmu.component.interface
        self.t = np.arange(steps + 1) * round(h * 1e9) / 1e9
        names = [signal.name for signal in interface.inputs]
        u = np.zeros((steps + 1, len(names)))
        for name, function in inputs.items():
            u[:, names.index(name)] = [function(time) for time in self.t]
        fmu.component.prepare(h, np.ones(len(names), np.bool_), {})
        fmu.component.initialize(0.0, u[0])
        first = fmu.component.outputs(0.0, u[0])
        self.rows = np.vstack([first, fmu.component.advance(self.t, h, u)])
        self._names = [signal.name for signal in interface.outputs]

    def __getitem__(self, name):
        return self.rows[:, self._names.index(name)]


def ticks_by(t, instants_ns):
    """Return how many instants there are up to each of these times."""
    return np.searchsorted(instants_ns, np.rint(t * 1e9), side="right")


def every(interval_ns, shift_ns=0, stop=STOP):
    return np.arange(shift_ns, round(stop * 1e9) + 1, interval_ns)


# --- based on time ---


@TYPES
def test_a_clock_ticks_at_its_instants(opened, interface_type):
    """Every 100 ms, the first at the start: it samples what the input was at that step's start.

    x' = count, so that x shows when the ticks really were: x = sum of t - tick over past ticks.
    """
    trace = Trace(opened(interface_type, "sample"), u=lambda t: t)
    ticks = every(100_000_000)
    n = ticks_by(trace.t, ticks)
    assert trace["count"].tolist() == n.tolist()
    sampled = ticks // 40_000_000 * 40_000_000 / 1e9
    assert abs(trace["sum"] - np.cumsum(sampled)[n - 1]).max() < ROUNDING
    x = [sum(max(0.0, t - tick / 1e9) for tick in ticks) for t in trace.t]
    assert abs(trace["x"] - x).max() < ROUNDING


@pytest.mark.slow
def test_instants_do_not_accumulate(opened):
    """After 10000 intervals of 0.1 s the time of a tick is the double k / 10; 0.1 k is not."""
    steps = 1000
    trace = Trace(opened("me", "sample"), h=1.0, steps=steps)
    assert trace["count"][-1] == 10 * steps + 1
    assert trace["when"].tolist() == trace.t.tolist()
    trace = Trace(opened("me", "sample"), h=0.7, steps=steps)
    ticks = np.rint(trace.t * 1e9).astype(np.int64) // 100_000_000
    assert trace["when"].tolist() == (ticks * 100_000_000 / 1e9).tolist()


@pytest.mark.slow
def test_parts_of_a_co_simulation_step_end_at_the_ticks(opened):
    """The FMU adds the length of the part to its begin: a rounding of each, and of the sum."""
    trace = Trace(opened("cs", "sample"), h=0.7, steps=1000)
    ticks = np.rint(trace.t * 1e9).astype(np.int64) // 100_000_000
    assert abs(trace["when"] - ticks * 100_000_000 / 1e9).max() <= 2 * math.ulp(700.0)


@TYPES
def test_shift_and_fraction(opened, interface_type):
    """The first tick is the shift after the start; two twenty-fifths of a second are 80 ms."""
    fraction = (
        'intervalVariability="constant" intervalDecimal="0.0" supportsFraction="true" '
        'resolution="25" intervalCounter="2" shiftCounter="3"'
    )
    trace = Trace(opened(interface_type, "sample", changes={"sample": fraction}))
    assert trace["count"].tolist() == ticks_by(trace.t, every(80_000_000, 120_000_000)).tolist()


@TYPES
@pytest.mark.parametrize("fractions", ["false", "true"])
def test_the_fmu_says_interval_and_shift(opened, interface_type, fractions):
    """In Initialization Mode, after its parameters were set; as numbers or as fractions."""
    for variability in ("fixed", "tunable"):
        interval = f'intervalVariability="{variability}" supportsFraction="{fractions}"'
        fmu = opened(interface_type, "asked", changes={"asked": interval}, period=0.05, offset=0.03)
        trace = Trace(fmu)
        ticks = every(50_000_000, 30_000_000)
        assert trace["asked_count"].tolist() == ticks_by(trace.t, ticks).tolist()


@TYPES
@pytest.mark.parametrize("variability", ["fixed", "tunable"])
def test_a_clock_keeps_the_interval_of_its_file(opened, interface_type, variability):
    """It holds where the importer sets none: FMI 3.0 section 2.2.9.2."""
    interval = {"sample": f'intervalVariability="{variability}" intervalDecimal="0.2"'}
    trace = Trace(opened(interface_type, "sample", changes=interval))
    assert trace["count"].tolist() == ticks_by(trace.t, every(200_000_000)).tolist()


def test_an_interval_may_be_a_rounding_off(opened):
    """3 * 0.1 is not 0.3, but means it."""
    trace = Trace(opened("me", "asked", period=3 * 0.1), h=0.3)
    assert 3 * 0.1 != 0.3
    assert trace["asked_count"].tolist() == list(range(1, STEPS + 2))


@TYPES
def test_a_changing_interval_is_asked_for_at_every_tick(opened, interface_type):
    """The k-th interval is k * 10 ms, so that the k-th tick is at k (k + 1) / 2 * 10 ms."""
    trace = Trace(opened(interface_type, "next"))
    k = np.arange(1, 40)
    ticks = k * (k + 1) // 2 * 10_000_000
    assert trace["next_count"].tolist() == ticks_by(trace.t, ticks).tolist()


@TYPES
@pytest.mark.parametrize("can", [("any step", "events"), ("any step", "events", "state")])
@pytest.mark.parametrize("k", [25, 30])
def test_a_tuned_interval_begins_where_it_is_tuned(opened, interface_type, can, k):
    """300 ms until 1 s or 1.2 s, 50 ms from there; of the two a tick is at 1.2 s, and is not lost.

    An FMU that can go back has not had that tick yet when it is tuned.
    """
    interval = {"asked": 'intervalVariability="tunable"'}
    fmu = opened(interface_type, "asked", can=can, changes=interval)
    component = fmu.component
    t = np.arange(STEPS + 1) * round(H * 1e9) / 1e9
    u = np.zeros((STEPS + 1, 0))
    component.prepare(H, np.zeros(0, np.bool_), {})
    component.initialize(0.0, u[0])
    first = component.outputs(0.0, u[0])
    rows = [first, *component.advance(t[: k + 1], H, u[: k + 1])]
    fmu.tune(float(t[k]), {"period": (0.05,)})
    rows += list(component.advance(t[k:], H, u[k:]))
    before = np.arange(0, k * 40_000_000 + 1, 300_000_000)
    ticks = np.concatenate([before, every(50_000_000, k * 40_000_000 + 50_000_000)])
    column = [signal.name for signal in component.interface.outputs].index("asked_count")
    assert [row[column] for row in rows] == ticks_by(t, ticks).tolist()


@TYPES
def test_several_clocks_at_once(opened, interface_type):
    """Also where they tick at one instant."""
    trace = Trace(opened(interface_type, "sample", "asked", "next", period=0.05))
    assert trace["count"].tolist() == ticks_by(trace.t, every(100_000_000)).tolist()
    assert trace["asked_count"].tolist() == ticks_by(trace.t, every(50_000_000)).tolist()


# --- triggered ---


def triggers(*points):
    return lambda t: float(round(t / H) in points)


@TYPES
def test_an_input_clock_ticks_where_its_signal_is_1(opened, interface_type):
    """At each such communication point once, also at the first and where the one before is 1."""
    points = [0, 3, 4, 5, 9]
    trace = Trace(opened(interface_type, "in"), **{"in": triggers(*points)}, v=lambda t: 2.0 * t)
    k = np.arange(STEPS + 1)
    n = np.searchsorted(points, k, side="right")
    assert trace["in_count"].tolist() == n.tolist()
    latched = [2.0 * trace.t[points[i - 1]] for i in n]
    assert trace["latched"].tolist() == latched


@TYPES
@pytest.mark.parametrize("delay", [0.0, 0.025, 0.08, 0.1])
def test_a_countdown_begins_at_an_event(opened, interface_type, delay):
    """It ticks so long after a trigger; after none, at the same instant behind it."""
    points = [2, 7, 20]
    trace = Trace(opened(interface_type, "in", "later", delay=delay), **{"in": triggers(*points)})
    ticks = np.array([point * 40_000_000 + round(delay * 1e9) for point in points])
    n = ticks_by(trace.t, ticks)
    assert trace["later_count"].tolist() == n.tolist()
    when = [ticks[i - 1] / 1e9 if i else 0.0 for i in n]
    assert abs(trace["later_when"] - when).max() <= 2 * math.ulp(STOP)


@TYPES
def test_an_output_clock_is_1_at_the_end_of_the_step_it_ticks_in(opened, interface_type):
    """With every second tick of 100 ms; what belongs to it keeps its value until the next."""
    trace = Trace(opened(interface_type, "sample", "out"), u=lambda t: 1.0)
    ticks = every(200_000_000, 100_000_000)
    n = ticks_by(trace.t, ticks)
    assert trace["out"].tolist() == [0.0, *np.diff(n).astype(float)]
    assert trace["shown"].tolist() == (2.0 * n).tolist()


@TYPES
def test_what_belongs_to_a_local_clock_follows_it(opened, interface_type, monkeypatch):
    """No other component sees that clock tick; the output is taken at each of its ticks."""
    monkeypatch.setitem(clocked.CLOCKS, "out", (6, "local", 'intervalVariability="triggered"'))
    fmu = opened(interface_type, "sample", "out")
    assert "out" not in [signal.name for signal in fmu.component.interface.outputs]
    trace = Trace(fmu, u=lambda t: 1.0)
    n = ticks_by(trace.t, every(200_000_000, 100_000_000))
    assert trace["shown"].tolist() == (2.0 * n).tolist()


@TYPES
def test_two_ticks_in_a_step_are_reported(opened, interface_type):
    fmu = opened(interface_type, "sample", "out")
    trace = Trace(fmu, h=1.0, steps=3)
    assert trace["out"].tolist() == [0.0, 1.0, 1.0, 1.0]
    warnings = [message.text for message in fmu.drain() if message.level == "warning"]
    assert warnings == [
        "clocked: clock 'out' ticks more than once in the communication step to or from t = 0.3 s; "
        "its signal shows one tick, and what it triggers gets one"
    ]


# --- between components ---


@pytest.mark.fast("types0-can0", "types1-can0", "types2-can0")
@pytest.mark.parametrize("can", [("any step", "events"), ("any step", "events", "state")])
@pytest.mark.parametrize("types", [("cs", "cs"), ("cs", "me"), ("me", "cs"), ("me", "me")])
def test_a_clock_triggers_that_of_another_component(opened, types, can):
    """At the end of the step; the same bits with any length of blocks, natively or not."""
    outcomes = []
    for block, native in [(1, True), (7, True), (None, True), (None, False)]:
        source = opened(types[0], "sample", "out", can=can)
        target = opened(types[1], "in", "later", can=can)
        t = np.arange(STEPS + 1) * H
        components = {"u": Scripted(t), "a": source.component, "b": target.component}
        connections = {"a.u": "u.y", "b.in": "a.out", "b.v": "a.shown"}
        memory = Memory()
        graph = Graph(components, connections, native=native)
        run(graph, Clock(STOP, H, block), memory)
        outcomes.append([memory.rows(name).tobytes() for name in components])
        ticks = every(200_000_000, 100_000_000)
        n = ticks_by(memory.time_ns("a") / 1e9, ticks)
        assert memory["b.in_count"].tolist() == n.tolist()
        assert memory["b.latched"].tolist() == memory["a.shown"].tolist()
        # 25 ms behind the end of the step, which is within the next one.
        assert memory["b.later_count"][1:].tolist() == n[:-1].tolist()
    assert all(outcome == outcomes[0] for outcome in outcomes)


@pytest.mark.parametrize("can", [("any step", "events"), ("any step", "events", "state")])
@TYPES
def test_a_sampled_controller_in_a_loop(opened, interface_type, can):
    """It sums at communication points what the plant is there; the plant is x' = -S - x.

    With S held, x[k + 1] + S[k] = (x[k] + S[k]) exp(-h) and S[k + 1] = S[k] + x[k + 1].
    """
    period = 'intervalVariability="constant" intervalDecimal="0.04"'
    fmu = opened(interface_type, "sample", can=can, changes={"sample": period})
    components = {"plant": integrator(start=1.0), "controller": fmu.component}
    negative = Connection("controller.sum", gain=-1.0)
    connections = {"controller.u": "plant.y", "plant.u": negative}
    memory = Memory()
    run(Graph(components, connections), Clock(STOP, H), memory)
    x = 1.0
    total = 1.0
    for k in range(STEPS + 1):
        assert abs(memory["plant.y"][k] - x) < ROUNDING
        assert abs(memory["controller.sum"][k] - total) < ROUNDING
        x = (x + total) * math.exp(-H) - total
        total += x


@pytest.mark.slow
@TYPES
def test_the_contract_holds_with_clocks(opened, interface_type):
    """Blocks of any length; outputs that change nothing; states that are saved, clocks too."""
    can = ("any step", "events", "state")
    draw = np.random.default_rng(3)
    inputs = draw.normal(size=(31, 3))
    clocks = ("sample", "next", "in", "later", "out")

    def make():
        return opened(interface_type, *clocks, can=can).component

    names = [signal.name for signal in make().interface.inputs]
    inputs[:, names.index("in")] = draw.integers(0, 2, 31)
    check_component(make, inputs=inputs, h=H)
    check_rollback(make, inputs=inputs, h=H)


@pytest.mark.slow
@TYPES
def test_a_good_clocked_fmu_has_no_findings(tmp_path, interface_type):
    can = ("any step", "events", "state")
    path = clocked.build(tmp_path / "x.fmu", *clocked.CLOCKS, can=can)
    assert [finding for finding in check(path) if finding.level != "note"] == []
    interface = describe(path, FmuOptions(interface_type=interface_type)).interface
    ports = {signal.name: (signal.type, signal.variability) for signal in interface.inputs}
    assert ports["in"] == ("boolean", "discrete")
    assert "sample" not in ports
    assert set(interface.feeds("latched")) == {"in", "v"}


@TYPES
def test_a_time_based_clock_is_an_output_where_it_is_asked_for(tmp_path, interface_type):
    """It then shows its ticks, and may trigger clocks of other components."""
    period = 'intervalVariability="constant" intervalDecimal="0.1" shiftDecimal="0.1"'
    path = clocked.build(tmp_path / "a.fmu", "sample", changes={"sample": period})
    other = clocked.build(tmp_path / "b.fmu", "in")
    options = FmuOptions(interface_type=interface_type, outputs=("sample",))
    with load(path, options) as a, load(other, FmuOptions(interface_type=interface_type)) as b:
        assert a.component.interface.feeds("sample") == ()
        memory = Memory()
        graph = Graph({"a": a.component, "b": b.component}, {"b.in": "a.sample"})
        run(graph, Clock(STOP, H), memory)
        n = ticks_by(memory.time_ns("a") / 1e9, every(100_000_000, 100_000_000))
        assert memory["a.sample"].tolist() == [0.0, *np.diff(n).astype(float)]
        assert memory["b.in_count"].tolist() == n.tolist()


def test_a_clock_that_is_not_activated_is_no_output(tmp_path):
    path = clocked.build(tmp_path / "x.fmu", "sample", can=("any step",))
    options = FmuOptions(interface_type="cs", outputs=("sample",))
    with pytest.raises(FmuError, match="outputs: 'sample' is a clock, and none is activated"):
        load(path, options)


# --- refused ---


@TYPES
def test_an_interval_is_a_whole_number_of_nanoseconds(opened, interface_type):
    """In the file it is refused before the run, from the FMU when it says it."""
    third = 'intervalVariability="constant" resolution="3" intervalCounter="1"'
    with pytest.raises(FmuError) as error:
        opened(interface_type, "sample", changes={"sample": third})
    assert str(error.value) == (
        "clocked: interval of clock 'sample': expected a whole number of nanoseconds, "
        "got 0.3333333333333333 s (1/3)"
    )
    with pytest.raises(
        RunError,
        match=r"interval of clock 'asked': expected .*, got 2\.5e-09 s \(1/400000000\)",
    ):
        Trace(opened(interface_type, "asked", period=2.5e-9))


@TYPES
def test_intervals_that_are_none(opened, interface_type):
    """Not above zero, below zero, not finite."""
    for name, clock, start, text in [
        ("asked", "asked", {"period": 0.0}, "expected more than 0 s, got 0.0 s"),
        ("next", "next", {"step": -0.01}, "expected 0 s or more, got -0.01 s"),
        ("later", "in", {"delay": -0.01}, "expected 0 s or more, got -0.01 s"),
    ]:
        fmu = opened(interface_type, *{clock, name}, **start)
        inputs = {"in": triggers(3)} if clock == "in" else {}
        with pytest.raises(RunError, match=f"interval of clock '{name}': {text}"):
            Trace(fmu, **inputs)


def test_a_tick_inside_a_step_that_cannot_be_divided(opened):
    """Where the interval is a whole number of steps, nothing needs to be divided."""
    fmu = opened("cs", "sample", can=("events",))
    with pytest.raises(
        Stopped,
        match=r"clocked: a clock ticks at t = 0\.1 s, inside the communication step of 0\.04 s "
        r"from t = 0\.08 s, which the FMU cannot divide \(canHandleVariableCommunicationStepSize "
        r"is false\); choose a communication step that divides the intervals and shifts",
    ):
        Trace(fmu)
    trace = Trace(opened("cs", "sample", can=("events",)), h=0.05)
    assert trace["count"].tolist() == ticks_by(trace.t, every(100_000_000, stop=5.0)).tolist()


@TYPES
def test_a_trigger_is_0_or_1(opened, interface_type):
    with pytest.raises(
        Stopped, match=r"clocked: clock 'in': expected 1 \(the clock ticks\) or 0, got 0\.5"
    ):
        Trace(opened(interface_type, "in"), **{"in": lambda t: 0.5 * (t > 1.0)})


def test_without_event_mode_no_clock_is_activated(opened):
    """Nor is one a port: in co-simulation clocks are active in event mode only."""
    fmu = opened("cs", "in", "out", can=("any step",))
    assert fmu.notes[0] == (
        "clocked: its clocks are not activated, as it has no event mode: in, out"
    )
    assert "in" not in [signal.name for signal in fmu.component.interface.inputs]


@TYPES
def test_ticks_off_the_communication_points_are_reported(opened, interface_type):
    assert opened(interface_type, "sample", "out").notes[:2] == (
        "clocked: a tick inside a communication step reaches other components at its end, and they "
        "trigger clocks at communication points: out",
        "clocked: where a clock ticks inside a communication step, what it samples is as at the "
        "start of that step: u",
    )
