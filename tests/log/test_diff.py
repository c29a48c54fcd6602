"""Two runs compared: signal by signal, event by event, at shared instants and between them."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.core.recorded.partial import PartialChannels, PartialRecord, RecordSelection
from cosim.core.recorded.run import rows_within
from cosim.core.recording import SignalEvent
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import LogError, UnknownSignalError, UsageError
from cosim.log import open_log
from cosim.log.diff import diff
from cosim.log.difference import (
    ElementDifference,
    ElementEvent,
    ElementEventDifference,
    EventsDifference,
)
from tests.log.recordings import STEP_NS, layout, numbered, record, table

STEP = STEP_NS / 1e9


class Run:
    """A recording made by hand, of one component ``c``; each signal as it is declared."""

    left_out = None

    def __init__(self, values, times=None, events=(), cuts=(), held=(), **declared):
        self.label = "the run"
        self.held = {"c": np.array(held, bool)}
        columns = {name: np.asarray(own, dtype=float) for name, own in values.items()}
        sizes = [own[:1].size or 1 for own in columns.values()]
        count = len(next(iter(columns.values())))
        times = np.asarray(np.arange(count) if times is None else times, np.int64) * STEP_NS
        parts = [
            own.reshape(count, size) for own, size in zip(columns.values(), sizes, strict=True)
        ]
        rows = np.hstack(parts)
        bounds = pairwise([0, *cuts, count])
        self._blocks = [(times[begin:end], rows[begin:end]) for begin, end in bounds]
        self._events = list(events)
        signals = [Signal(*own, **declared) for own in zip(columns, sizes, strict=True)]
        inputs = len(held)  # of one element each
        interface = Interface(tuple(signals[:inputs]), tuple(signals[inputs:]))
        self.channels = {"c": Channel("c", interface, 0)}

    def events(self):
        return self._events

    def blocks(self, component, *, first_ns=None, last_ns=None):
        assert component == "c"
        for times, rows in self._blocks:
            yield rows_within(times, rows, first_ns, last_ns)


def one(a, b, **options):
    """Compare two runs of one signal; return its row."""
    (row,) = diff(a, b, **options).rows
    return row


def statuses(a, b, **options):
    """Return how the signals compare, but those that are equal."""
    rows = diff(a, b, **options).rows
    return {row.signal: row.status for row in rows if row.status != "equal"}


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Return a log, and one whose u, x_a[1] and theta[0] are apart by 1, 1e-3 and one bit."""
    folder = tmp_path_factory.mktemp("pair")
    rows = np.nan_to_num(table(layout(), 100), posinf=1.0, neginf=-1.0)
    rows = np.round(rows * 1024) / 1024  # so that the sums below are exact to the last bit but one
    record(folder / "a.mcap", rows=rows)
    rows[50, 0] += 1.0
    rows[60, 2] += 1e-3
    rows[40, 8] = np.nextafter(rows[40, 8], np.inf)
    record(folder / "b.mcap", rows=rows)
    return open_log(folder / "a.mcap"), open_log(folder / "b.mcap")


# --- values ---


def test_a_log_equals_itself_bit_for_bit(tmp_path):
    """With NaN and infinities; one other bit of one element is a difference, with its place."""
    rows = record(tmp_path / "a.mcap", steps=100)
    log = open_log(tmp_path / "a.mcap")
    assert diff(log, log).equal
    assert diff(log, log).first is diff(log, log).worst is None
    changed = rows.copy()
    changed[40, 6] = np.nextafter(rows[40, 6], np.inf)
    record(tmp_path / "b.mcap", rows=changed)
    difference = diff(log, open_log(tmp_path / "b.mcap"))
    assert not difference.equal
    assert not difference.within
    first = ElementDifference("identifier.y[1]", 40 * STEP_NS, rows[40, 6], changed[40, 6])
    assert difference.first == first
    as_json = json.loads(json.dumps(difference.to_dict()))
    assert as_json["first"]["time_ns"] == 40 * STEP_NS
    assert as_json["first"]["differing_bits"] == first.differing_bits > 0


def test_tolerances_are_absolute_plus_relative_to_the_signals_scale(subtests):
    """|a - b| <= atol + rtol max|a|, here with max|a| = 4 from another row."""
    for a, b, tolerance, status, largest in [
        (0.0, -0.0, {}, "outside", 0.0),
        (0.0, -0.0, {"atol": 1e-300}, "within", 0.0),
        (np.nan, np.nan, {}, "equal", 0.0),
        (np.nan, -np.nan, {"atol": 1.0}, "within", 0.0),
        (np.nan, 1.0, {"atol": 1.0}, "outside", np.inf),
        (np.inf, np.inf, {"atol": 1.0}, "equal", 0.0),
        (np.inf, 1.0, {"rtol": 1.0}, "outside", np.inf),
        (np.nan, 1.0, {"rtol": 1.7e308}, "outside", np.inf),  # of a tolerance that is infinite
        (1.0, 1.5, {"atol": 0.5}, "within", 0.5),
        (1.0, 1.5, {"atol": 0.49}, "outside", 0.5),
        (1.0, 1.5, {"rtol": 0.125}, "within", 0.5),
        (1.0, 1.5, {"rtol": 0.12}, "outside", 0.5),
        (1.0, 1.5, {"atol": 0.25, "rtol": 0.0625}, "within", 0.5),
    ]:
        row = one(Run({"y": [4.0, a]}), Run({"y": [4.0, b]}), **tolerance)
        with subtests.test(case=(a, b, tolerance)):
            assert (row.status, row.largest, row.scale) == (status, largest, 4.0)
            assert row.ratio == largest / 4
            assert (row.first is not None) == (status == "outside")
    assert one(Run({"y": [0.0]}), Run({"y": [1.0]})).ratio == np.inf
    # that comes in a later block
    runs = [Run({"y": [y, y, 4.0, 4.0]}, cuts=[2]) for y in (1.0, 1.5)]
    assert one(*runs, rtol=0.125).status == "within"


def test_a_signal_has_its_own_tolerance_in_the_place_of_that_of_all(pair):
    """Of several patterns the last that matches counts; 0 compares bits."""
    apart = {"plant.u": "outside", "plant.x_a": "outside", "identifier.theta": "outside"}
    assert statuses(*pair) == apart
    assert statuses(*pair, tol={"plant.u": 1.1}) == apart | {"plant.u": "within"}
    own = {"plant.u": 1.1, "plant.x_a": 1e-4}
    found = statuses(*pair, atol=1e-2, tol=own)
    assert found == {"plant.u": "within", "plant.x_a": "outside", "identifier.theta": "within"}
    assert statuses(*pair, atol=2.0, tol={"identifier.theta": 0})["identifier.theta"] == "outside"
    assert diff(*pair, tol={"*": 1e-2, "plant.u": 2.0}).within
    assert not diff(*pair, tol={"plant.u": 2.0, "*": 1e-2}).within
    rows = {row.signal: row for row in diff(*pair, rtol=0.5, tol={"plant.x_a": 1e-4}).rows}
    assert rows["plant.x_a"].tolerance == 1e-4
    assert rows["plant.u"].tolerance == 0.5 * rows["plant.u"].scale


def test_the_worst_is_the_one_that_exceeds_its_tolerance_most(pair):
    """Whatever its size is; among those without a tolerance the ratio to the scale decides."""
    assert diff(*pair).worst.signal == "plant.u"
    worst = diff(*pair, atol=1e-20, tol={"plant.u": 0.5, "plant.x_a": 1e-5}).worst
    assert worst.signal == "identifier.theta"
    assert diff(*pair, tol={"*": 0.9, "plant.x_a": 1e-4}).worst.signal == "plant.x_a"


def test_a_tolerance_that_is_no_number_from_0_on_is_refused(pair, subtests):
    """Each by its name; so is one of no compared signal, as it would be forgotten in silence."""
    for value in (-1.0, math.nan, math.inf, "1", True, None):
        with subtests.test(case=value):
            with pytest.raises(UsageError, match=rf"^tol\['plant\.u'\]: .*>= 0, got {value!r}"):
                diff(*pair, tol={"plant.u": value})
            for name in ("atol", "tube"):
                with pytest.raises(UsageError, match=rf"^{name}: .*>= 0, got {value!r}"):
                    diff(*pair, **{name: value})
    with pytest.raises(UsageError, match=r"^tol\['plant\.v'\]: .*did you mean 'plan"):
        diff(*pair, tol={"plant.v": 1.0})
    with pytest.raises(UsageError, match=r"^tol\['identifier\.\*'\]: no compared signal"):
        diff(*pair, tol={"identifier.*": 1.0}, signals=["plant.u"])
    with pytest.raises(UsageError, match=r"^tol: expected a mapping .*got 1e-06"):
        diff(*pair, tol=1e-6)


# --- signals ---


def test_only_the_signals_given_are_compared(pair):
    """Signals, elements, slices and patterns, each once; what differs elsewhere does not matter."""
    chosen = diff(*pair, signals=["plant.x_a[0:1]", "plant.n", "plant.x_a[0]"])
    assert chosen.equal
    assert [row.signal for row in chosen.rows] == ["plant.x_a[0:1]", "plant.n", "plant.x_a[0]"]
    row = one(*pair, signals="plant.x_a[1:2]")
    assert (row.status, row.first.signal) == ("outside", "plant.x_a[1]")
    rows = diff(*pair, signals=["*.x_a", "plant.*", "identifier.theta[0]"]).rows
    names = [row.signal for row in rows]
    assert names == [*("plant.x_a", "plant.u", "plant.der(x)", "plant.n"), "identifier.theta[0]"]
    with pytest.raises(UnknownSignalError, match=r"'plnt\.\*'"):
        diff(*pair, signals=["plnt.*"])


def test_signals_that_only_one_run_has_are_listed(tmp_path):
    """Also a size that changed, and whole components; those that neither has are refused."""
    a = Run({"p": np.zeros(4), "x": np.zeros((4, 3))})
    b = Run({"x": np.zeros((4, 2)), "q": np.zeros(4)})
    difference = diff(a, b)
    assert not difference.within
    assert [(row.signal, row.status, row.rows) for row in difference.rows] == [
        ("c.p", "only in a", (4, 0, 0)),
        ("c.x", "other size", (4, 4, 0)),
        ("c.q", "only in b", (0, 4, 0)),
    ]
    rows = diff(a, b, signals=["c.q", "c.x[2]", "c.x"]).rows
    assert [row.status for row in rows] == ["only in b", "only in a", "other size"]
    for signal, match in (
        ("c.y", r"'c\.y'.*: p, x"),
        ("d.p", "component 'd'"),
        ("c.x[3]", r"'c\.x'.*3 elements"),
        (5, "expected the name of a signal, .* got 5"),
    ):
        with pytest.raises(LogError, match=match):
            diff(a, b, signals=["c.p", signal])
    record(tmp_path / "a.mcap", steps=10)
    record(tmp_path / "b.mcap", lay=Layout(layout().channels[:1]), rows=np.zeros((11, 5)))
    difference = diff(open_log(tmp_path / "b.mcap"), open_log(tmp_path / "a.mcap"))
    assert [row.status for row in difference.rows[4:]] == ["only in b", "only in b"]
    with pytest.raises(LogError, match="expected a recording, got str"):
        diff("a.mcap", a)


def test_signals_of_other_names_are_compared_where_a_map_says_so():
    """A signal, or an element; both runs need to have it. Events go with their signals."""
    jump = [SignalEvent(STEP_NS, "override", "c.level", (2.0,))]
    other = [SignalEvent(STEP_NS, "override", "c.x[1]", (2.0,))]
    a = Run({"level": [1.0, 2.0], "y": [0.0, 0.0]}, events=jump)
    b = Run({"x": [[9.0, 1.0], [9.0, 2.0]], "level": [5.0, 5.0]}, events=other)
    assert diff(a, b).rows[0].status == "outside"
    difference = diff(a, b, map={"c.level": "c.x[1]"}, signals=["c.level"])
    assert difference.equal
    assert difference.events.events == (1, 1)
    b = Run({"x": [[9.0, 1.0], [9.0, 3.0]]})
    assert one(a, b, map={"c.level": "c.x[1]"}, signals=["c.level"]).first.b == 3.0
    found = statuses(a, Run({"p": [1.0, 2.0], "q": [0.0, 0.0]}), map={"c.level": "c.p"})
    assert found == {"c.y": "only in a", "c.q": "only in b"}
    namesake = Run({"p": [1.0, 2.0], "y": [0.0, 0.0], "level": [7.0, 7.0]})
    assert statuses(a, namesake, map={"c.level": "c.p"}) == {"c.level of b": "only in b"}
    swapped = Run({"level": [0.0, 0.0], "y": [1.0, 2.0]})
    assert diff(a, swapped, map={"c.level": "c.y", "c.y": "c.level"}).same_rows
    for wrong in ({"c.level": "c.z"}, {"c.z": "c.x"}):
        with pytest.raises(UnknownSignalError, match=r"c\.z"):
            diff(a, b, map=wrong)


def test_values_are_compared_in_the_unit_of_the_first_run():
    """What has no unit is taken as it is; units of other kinds are not compared."""
    a = Run({"y": [0.0, 1500.0]}, unit="mm")
    for unit, values, status in (
        ("m", [0.0, 1.5], "equal"),
        ("m", [0.0, 1500.0], "outside"),
        (None, [0.0, 1500.0], "equal"),
        (None, [0.0, 1.5], "outside"),
        ("kg", [0.0, 1500.0], "other unit"),
    ):
        b = Run({"y": values}, unit=unit)
        for options in ({}, {"interpolate": True}, {"tube": STEP / 10}):
            assert one(a, b, **options).status == status
    row = one(a, Run({"y": [0.0, 1.501]}, unit="m"), atol=1.1)
    assert (row.status, row.first, row.largest) == ("within", None, pytest.approx(1.0))
    events = [SignalEvent(STEP_NS, "override", "c.y", (own,)) for own in (1500.0, 1.5)]
    runs = [
        Run({"y": [0.0]}, events=[own], unit=u) for own, u in zip(events, ("mm", "m"), strict=True)
    ]
    assert diff(*runs).equal


# --- instants ---


def test_runs_of_other_length_compare_where_both_have_values():
    """Other times are reported, even if all values agree; rows of one instant pair up in order."""
    a = Run({"y": [1, 2, 3, 4]})
    row = one(a, Run({"y": [3, 4, 5]}, times=[2, 3, 4]))
    assert (row.status, row.rows, row.largest) == ("other times", (4, 3, 2), 0.0)
    assert not diff(a, Run({"y": [1, 2, 3, 4, 5]}), atol=1.0).within
    row = one(a, Run({"y": [3, 9]}, times=[2, 3]))
    assert row.status == "outside"
    assert row.first == ElementDifference("c.y", 3 * STEP_NS, 4.0, 9.0)
    row = one(a, Run({"y": [3]}, times=[9]))
    assert (row.status, row.rows) == ("other times", (4, 1, 0))
    row = one(Run({"y": [0, 1, 2, 3]}, [0, 1, 1, 2]), Run({"y": [0, 1, 7]}, [0, 1, 1]))
    assert row.rows == (4, 3, 3)
    assert row.first == ElementDifference("c.y", STEP_NS, 2.0, 7.0)


@st.composite
def runs(draw):
    """Draw instants in order, several rows at some of them, and where their blocks end."""
    times = sorted(draw(st.lists(st.integers(0, 12), max_size=25)))
    cuts = sorted(draw(st.lists(st.integers(0, len(times)), max_size=6)))
    return times, cuts


@given(runs(), runs())
def test_windows_pair_what_stands_at_the_same_instant(a, b):
    """Of blocks that end anywhere: every row once, those of one instant in their order."""
    both = [
        Run({"y": np.arange(len(times)) + number / 2}, times, cuts=cuts)
        for number, (times, cuts) in enumerate((a, b))
    ]
    instants_b = {instant: row for row, instant in enumerate(numbered(b[0]))}
    shared = [
        (time, row, instants_b[time, number])
        for row, (time, number) in enumerate(numbered(a[0]))
        if (time, number) in instants_b
    ]
    found = one(*both)
    assert found.rows == (len(a[0]), len(b[0]), len(shared))
    assert found.largest == max((abs(in_a - in_b - 0.5) for _, in_a, in_b in shared), default=0.0)
    if shared:
        time, in_a, in_b = shared[0]
        assert found.first == ElementDifference("c.y", time * STEP_NS, in_a, in_b + 0.5)


def test_rows_that_a_partial_run_does_not_have_are_no_difference():
    """Nor are signals, unless one of them is asked for, or nothing else is there."""
    whole = Run({"y": np.arange(5.0), "z": np.zeros(5)})
    thin = Run({"y": [0.0, 2.0, 4.0]}, [0, 2, 4])
    record = PartialRecord(RecordSelection(("c.y",), 2), whole.channels)
    thin.channels = PartialChannels({"c": replace(thin.channels["c"], period=2)}, record)
    for runs, left_out, rows in (
        ((whole, thin), "not recorded in b", (5, 3, 3)),
        ((thin, whole), "not recorded in a", (3, 5, 3)),
    ):
        difference = diff(*runs)
        assert difference.equal
        assert {row.signal: row.status for row in difference.rows} == {
            "c.y": "equal",
            "c.z": left_out,
        }
        assert difference.rows[0].rows == rows
        assert diff(*runs, signals=["c.*"]).equal
        with pytest.raises(UnknownSignalError, match="the log is partial"):
            diff(*runs, signals=["c.z"])
        with pytest.raises(LogError, match="no recorded signal in common"):
            diff(*runs, signals=["*.z"])
        with pytest.raises(LogError, match="no recorded signal in common"):
            diff(*runs, signals=["c.y"], span_ns=(3 * STEP_NS, 3 * STEP_NS))
    late = Run({"y": [4.0]}, [6])
    late.channels = thin.channels
    assert one(thin, late).status == "other times"
    longer = Run({"y": [0.0, 2.0, 4.0, 6.0]}, [0, 2, 4, 6])
    assert one(longer, Run({"y": [0.0, 2.0, 4.0]}, [0, 2, 4])).status == "other times"


# --- between instants ---


def test_a_straight_line_is_itself_at_any_instants():
    """It is compared at all instants of the first run that lie within the second."""
    fine = np.arange(0, 101)
    coarse = np.arange(0, 101, 7)
    a, b = Run({"y": 3.0 * fine}, fine), Run({"y": 3.0 * coarse}, coarse)
    assert one(a, b, atol=1e-9).status == "other times"
    row = one(a, b, atol=1e-9, interpolate=True)
    assert row.rows == (101, 15, 99)  # b ends at 98
    assert row.status == "other times"
    assert row.largest <= 1e-12
    whole = Run({"y": [0.0, 300.0]}, [0, 100])
    assert one(a, whole, atol=1e-9, interpolate=True).status == "within"
    assert one(a, Run({"y": [0.0, 301.0]}, [0, 100]), atol=0.5, interpolate=True).largest == 1.0
    jump = Run({"y": [0.0, 0.0, 1.0, 1.0]}, [0, 5, 5, 9])
    assert one(jump, jump, interpolate=True).status == "equal"
    assert (
        one(jump, Run({"y": [0.0, 0.5, 1.0, 1.0]}, [0, 5, 5, 9]), interpolate=True).largest == 0.5
    )
    # what b does between two instants of a is not seen, but counted, and never called equal
    row = one(Run({"y": [0.0, 0.0]}, [0, 2]), Run({"y": [0.0, 9.0, 0.0]}), interpolate=True)
    assert (row.status, row.rows) == ("within", (2, 3, 2))


@pytest.mark.parametrize("declared", [{"variability": "discrete"}, {"type": "boolean"}])
def test_a_value_that_is_held_is_no_line(declared):
    """It keeps its value until the next row, as one of the runs says; in a tube, too."""
    rows = [([0.0, 0.0, 1.0], [0, 5, 10]), ([0.0, 1.0], [0, 10])]
    lines = [Run({"y": own}, at) for own, at in rows]
    steps = [Run({"y": own}, at, **declared) for own, at in rows]
    for runs in (steps, (lines[0], steps[1]), (steps[0], lines[1])):
        assert one(*runs, interpolate=True).status == "within"
    row = one(*lines, interpolate=True)
    assert (row.status, row.largest) == ("outside", 0.5)
    assert row.first.time_ns == 5 * STEP_NS
    halfway = Run({"y": [0.0, 0.5, 1.0]}, [0, 9, 10], **declared)
    assert one(halfway, lines[1], tube=STEP).largest == 0.5  # b never has this value
    early = Run({"y": [0.0, 1.0, 1.0]}, [0, 9, 10], **declared)
    assert one(early, lines[1], tube=STEP).status == "within"
    assert one(early, lines[1], tube=0.9 * STEP).status == "outside"


def test_a_delayed_signal_is_within_a_tube_as_wide_as_the_delay():
    """And outside of a narrower one; also where its instants are shifted, at both ends."""
    times = np.arange(0, 300)
    a, b = (Run({"y": np.clip((times - begin) / 100, 0, 1)}, times) for begin in (100, 120))
    assert one(a, b, rtol=0.005).status == "outside"
    assert one(a, b, tube=20 * STEP).status == "within"
    assert one(a, b, tube=19 * STEP).largest == pytest.approx(0.01)
    assert one(a, b, tube=19 * STEP, rtol=0.005).status == "outside"
    assert one(a, b, tube=19 * STEP, rtol=0.011).status == "within"
    wave = np.sin(times / 20)
    shifted = Run({"y": wave}, times), Run({"y": wave}, times + 10)
    row = one(*shifted, tube=10 * STEP)
    assert (row.status, row.rows) == ("within", (300, 300, 300))
    assert one(*shifted, tube=9 * STEP, atol=1.0).status == "other times"
    assert one(*shifted, interpolate=True, atol=2.0).status == "other times"


def test_a_tube_looks_at_all_rows_near_an_instant():
    """The largest and the smallest of them, and both limits of a jump, bound what is right."""
    a = Run({"y": [0.0, 5.0, 0.0]}, [0, 50, 100])
    b = Run({"y": [0.0, 0.0, 5.0, 0.0, 0.0]}, [0, 57, 58, 59, 100])
    assert one(a, b, tube=7 * STEP).status == "outside"
    assert one(a, b, tube=8 * STEP).status == "within"
    assert one(a, b, tube=8 * STEP).largest == 0.0
    assert one(a, b, tube=7.5 * STEP, atol=2.5).status == "within"
    a = Run({"y": [0.0, 0.0, 0.4, 1.0, 1.0]}, [0, 49, 50, 51, 100])
    b = Run({"y": [0.0, 0.0, 1.0, 1.0]}, [0, 50, 50, 100])
    assert one(a, b, interpolate=True).largest == pytest.approx(0.6)
    assert one(a, b, tube=STEP).status == "within"
    assert one(a, b, tube=0.9 * STEP).status == "outside"


def test_a_spike_is_outside_of_a_tube_in_whichever_run_it_is():
    """At an instant of both, and between two of the other; a step between these is none."""
    flat, spike = np.zeros(41), np.zeros(41)
    spike[20] = 1.0
    for coarse in (flat, flat[::4], flat[::3]):
        times = np.linspace(0, 40, len(coarse)).round()
        runs = Run({"y": coarse}, times), Run({"y": spike})
        for a, b in (runs, runs[::-1]):
            row = one(a, b, tube=3 * STEP, atol=0.5)
            assert (row.status, row.largest) == ("outside", 1.0)
            assert row.first.time_ns == 20 * STEP_NS
    late = flat.copy()
    late[36] = 1.0
    for runs in ((late, spike), (spike, late)):
        a, b = (Run({"y": own}) for own in runs)
        assert one(a, b, tube=3 * STEP).first.time_ns == 20 * STEP_NS  # the first of both
    samples = Run({"y": [0.0, 0.0, 1.0, 1.0]}, [0, 10, 20, 30])
    step = Run({"y": [0.0, 0.0, 1.0, 1.0]}, [0, 13, 13, 30])
    assert one(samples, step, tube=STEP).status == "within"
    assert one(samples, Run({"y": [0.0, 0.0, 1.2, 1.0]}, [0, 13, 13, 30]), tube=STEP).largest > 0.1


def test_what_is_no_number_is_right_only_where_both_are_none():
    """NaN and infinity are not interpolated away; NaN that says "no value" is no row."""
    b = Run({"y": [0.0, 0.0, 0.0, 1.0]})
    for value in (np.nan, np.inf):
        a = Run({"y": [0.0, value, 0.0, 1.0]})
        for options in ({"interpolate": True}, {"tube": STEP / 2}):
            assert one(a, a, **options).status == "equal"
            assert one(a, b, **options, atol=1e9).status == "outside"
            assert one(b, a, **options, atol=1e9).status == "outside"
            assert one(a, Run({"y": [0.0, 1.0]}, [0, 3]), **options, atol=1e9).status == "outside"
    gaps = Run({"y": [0.0, np.nan, 2.0, np.nan, np.nan]}, optional=True)
    line = Run({"y": [0.0, 1.0, 2.0, 3.0]}, optional=True)
    row = one(gaps, line, interpolate=True)
    assert (row.status, row.rows) == ("within", (2, 4, 2))
    row = one(line, gaps, interpolate=True)  # which ends earlier
    assert (row.status, row.rows) == ("other times", (4, 2, 3))
    assert one(Run({"y": [0.0, 1.5]}), gaps, interpolate=True).largest == 0.5


def test_a_signal_is_held_where_its_source_is(subtests):
    """An input that was held is no line, nor what is made of such inputs alone."""
    rows = {"u": [0.0, 1.0, 0.0], "y": [0.0, 1.0, 0.0]}
    steps = {"u": [0.0, 0.0, 1.0, 1.0, 0.0], "y": [0.0, 0.0, 1.0, 1.0, 0.0]}
    for held, variability, expected in (
        ([True], "continuous", {"c.u": "within", "c.y": "outside"}),
        ([True], "inherited", {"c.u": "within", "c.y": "within"}),
        ([False], "inherited", {"c.u": "outside", "c.y": "outside"}),
    ):
        with subtests.test(held=held, variability=variability):
            options = {"held": held, "variability": variability}
            a, b = Run(steps, [0, 9, 10, 19, 20], **options), Run(rows, [0, 10, 20], **options)
            assert statuses(a, b, interpolate=True) == expected
            assert statuses(a, b, tube=STEP / 2) == expected


@pytest.mark.parametrize("variability", ["continuous", "discrete"])
def test_a_tube_does_not_bridge_nan(variability):
    """Neither of a signal nor of one of its elements; a line to NaN is NaN."""
    values = np.array([[1.0, 1.0], [1.0, np.nan], [3.0, 3.0]])
    b = Run({"y": values}, [0, 10, 20], variability=variability)
    assert one(b, b, tube=2 * STEP).status == "equal"
    for value, expected in ((2.0, "outside"), (np.nan, "within")):
        a = Run(
            {"y": np.where(np.isnan(values), value, values)}, [0, 10, 20], variability=variability
        )
        assert one(a, b, tube=2 * STEP).status == (expected if value == 2.0 else "equal")
        row = one(a, b, tube=15 * STEP)
        assert row.status == (expected if value == 2.0 else "equal")
    near = Run({"y": [1.0, np.nan, 1.0]}, [0, 10, 20], variability=variability)
    late = Run({"y": [1.0, np.nan, 1.0]}, [0, 11, 20], variability=variability)
    assert one(near, late, tube=2 * STEP).status == "within"
    if variability == "discrete":
        assert one(near, late, tube=STEP / 2).status == "outside"


def test_a_tube_finds_nan_on_a_line_to_it():
    """Not only at a row; and a number nowhere on it."""
    b = Run({"y": [0.0, np.nan]}, [0, 4])
    a = Run({"y": [0.0, np.nan, np.nan]}, [0, 0, 4])
    assert one(a, b, interpolate=True).status == "outside"
    assert one(a, b, tube=STEP).status == "within"
    assert one(Run({"y": [0.0, 1.0]}, [0, 4]), b, tube=STEP).status == "outside"


def test_elements_have_rows_of_their_own():
    """As two columns of a table have that were sampled in turn; nothing is between NaN and them."""
    turns = np.array([[0.0, np.nan], [np.nan, 1.0], [2.0, np.nan], [np.nan, 3.0]])
    a = Run({"y": turns}, [0, 2, 4, 6], optional=True)
    b = Run({"y": np.arange(0.0, 3.5, 0.5).repeat(2).reshape(-1, 2)})
    for options in ({"interpolate": True}, {"tube": STEP / 4}):
        assert one(a, b, **options).status == "within"
        assert one(a, a, **options).status == "equal"


def test_what_one_run_has_alone_is_not_compared_and_said():
    """A reference that ends early, and one of another time altogether."""
    short, long = Run({"y": [0.0, 0.0]}), Run({"y": [0.0, 0.0, 9.0]})
    for options in ({"interpolate": True}, {"tube": STEP}):
        difference = diff(short, long, **options)
        assert difference.within
        assert difference.not_compared == (
            "c.y: b has rows from 0.0 s to 0.002 s, a only from 0.0 s to 0.001 s",
        )
        assert not diff(long, short, **options).within
    assert "no instant in common" in diff(short, Run({"y": [0.0]}, [10**9])).not_compared[0]
    with pytest.raises(UsageError, match="tube"):
        diff(short, long, tube=1e300)


def test_what_has_nothing_to_compare_is_not_called_equal():
    """Runs that do not overlap, and runs without a row on one side."""
    a, none = Run({"y": [0.0, 0.0]}), Run({"y": [np.nan]}, optional=True)
    for options in ({"interpolate": True}, {"tube": STEP}):
        for runs in ((a, Run({"y": [0.0, 0.0]}, [5, 6])), (a, none), (none, a)):
            difference = diff(*runs, **options)
            assert [row.status for row in difference.rows] == ["other times"]
            assert not difference.within
            assert not difference.equal
        point = Run({"y": [0.0]}, [1])
        assert one(point, a, **options).status == "within"
        assert one(point, Run({"y": [0.0, 1.0]}), **options, atol=0.5).status == "outside"


@pytest.mark.parametrize("variability", ["continuous", "discrete"])
def test_random_runs_agree_with_a_search_instant_by_instant(variability):
    """Interpolated and in a tube, against the definition; some rows share their instant."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        times_a = np.sort(rng.choice(200, 40, replace=False))
        times_b = np.sort(rng.choice(np.arange(-5, 210, 3), 60, replace=True))
        values_a, values_b = rng.normal(size=40), rng.normal(size=60)
        runs = [
            Run({"y": values}, times, variability=variability)
            for values, times in ((values_a, times_a), (values_b, times_b))
        ]
        for tube in (0, *rng.integers(1, 8, size=2).tolist()):
            found = one(*runs, tube=tube * STEP, interpolate=True)
            is_near = (times_b[0] - tube <= times_a) & (times_a <= times_b[-1] + tube)
            largest = 0.0
            for time, value in zip(times_a[is_near], values_a[is_near], strict=True):
                near = around(time - tube, time + tube, times_b, values_b, variability)
                largest = max(largest, apart(value, near, variability))
            is_within = (times_a[0] <= times_b) & (times_b <= times_a[-1]) & (tube > 0)
            for time, value in zip(times_b[is_within], values_b[is_within], strict=True):
                begin = min(time - tube, times_a[times_a <= time].max())
                end = max(time + tube, times_a[times_a >= time].min())
                near = around(begin, end, times_a, values_a, variability)
                largest = max(largest, apart(value, near, variability))
            assert found.largest == pytest.approx(largest, abs=1e-12)
            assert found.rows == (40, 60, is_near.sum())


def apart(value, near, variability):
    """Return how far a value is from what is held near it, or from the span of a line."""
    if variability == "discrete":
        return min(abs(own - value) for own in near)
    return max(0.0, min(near) - value, value - max(near))


def around(begin, end, times, values, variability):
    """Return the values at both ends, and where there is a span those of the rows in it."""
    ends = [known_at(time, times, values, variability) for time in (begin, end)]
    if begin == end:
        return ends
    return [*ends, *values[(begin <= times) & (times <= end)]]


def known_at(time, times, values, variability):
    """Return the later value at a time, at the ends those of the ends."""
    before = np.flatnonzero(times <= time)
    if not len(before) or before[-1] == len(times) - 1:
        return values[0 if not len(before) else -1]
    last = before[-1]
    if variability == "discrete":
        return values[last]
    return np.interp(time, times[last : last + 2], values[last : last + 2])


# --- events ---


VALUES = {"u": [[1.0, 2.0], [3.0, 4.0]], "y": [0.0, 5.0]}


def override(values, *, signal="c.u", time=1, cause="override"):
    return SignalEvent(time * STEP_NS, cause, signal, values)


def events_of(a, b, **options):
    """Compare runs of the same rows with other events."""
    return diff(Run(VALUES, events=a), Run(VALUES, events=b), **options)


def test_runs_with_the_same_events_are_equal():
    """To the bit; NaN is equal to itself, and an override by elements is one of the whole."""
    events = [override((0.5, math.nan)), override((7.0,), signal="c.y", cause="follow")]
    difference = events_of(events, list(events))
    assert difference.equal
    assert difference.events == EventsDifference((2, 2), 3, 0, True, None)
    parts = [override((0.5,), signal="c.u[0]"), override((0.25,), signal="c.u[1]")]
    assert events_of([override((0.5, 0.25))], parts).equal


def test_another_event_is_a_difference_that_is_named(subtests):
    """Of runs with equal rows: one that is missing, of another value, cause, element or time."""
    for other, signal, a, b in [
        ([], "c.u[0]", ("override", 0.5), None),
        ([override((0.5, 0.75))], "c.u[1]", ("override", 0.25), ("override", 0.75)),
        ([override((0.5, 0.25), cause="release")], "c.u[0]", ("override", 0.5), ("release", 0.5)),
        ([override((0.5,), signal="c.u[0]")], "c.u[1]", ("override", 0.25), None),
        ([override((0.5, 0.25), time=0)], "c.u[0]", None, ("override", 0.5)),
    ]:
        difference = events_of([override((0.5, 0.25))], other)
        expected = [own and ElementEvent(*own) for own in (a, b)]
        time = 0 if a is None else STEP_NS
        as_json = json.loads(json.dumps(difference.to_dict()))
        with subtests.test(case=other):
            assert difference.same_rows
            assert not difference.equal
            assert not difference.within
            assert difference.events.first == ElementEventDifference(signal, time, *expected)
            assert as_json["events"]["first"]["signal"] == signal
    assert not events_of([override((), cause="set", signal="c")], []).equal
    # the left limit of what jumps by itself, and where something led to at the same instant
    later = override((0.5, 0.25))
    assert events_of([override((0.1, 0.1), cause="jump"), later], [later]).events.outside == 2


def test_events_of_compared_elements_have_the_tolerance_of_their_signals():
    """Of the largest value in the rows of a; one that does not fit its run is refused."""
    a, b = [override((0.5, 0.25))], [override((0.5, 0.5))]
    difference = events_of(a, b, rtol=0.1)
    assert difference.within  # 0.25 <= 0.1 * 4
    assert not difference.events.equal
    difference = events_of(a, [override((0.5, 0.75))], rtol=0.1)
    assert difference.events.outside == 1
    zeros = [[override((zero, 0.25))] for zero in (0.0, -0.0)]
    assert not events_of(*zeros).within
    assert events_of(*zeros, atol=1e-300).within
    assert events_of(a, b, signals=["c.y"]).equal
    assert events_of(a, b, signals=["c.u[0]"]).equal
    assert not events_of(a, b, signals=["c.u[1]"]).equal
    with pytest.raises(LogError, match=r"'c\.u' at t = .* expected 2 values, got 1"):
        events_of([override((0.5,))], [])
