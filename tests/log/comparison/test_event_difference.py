"""Events of two runs compared."""

from __future__ import annotations

import json
import math

import pytest

from cosim.core.recording import SignalEvent
from cosim.errors import LogError
from cosim.log.diff import diff
from cosim.log.difference import (
    ElementEvent,
    ElementEventDifference,
    EventsDifference,
)
from tests.log.comparison.runs import Run
from tests.log.recordings import STEP_NS

VALUES = {"u": [[1.0, 2.0], [3.0, 4.0]], "y": [0.0, 5.0]}


def override(values, *, signal="c.u", time=1, cause="override"):
    return SignalEvent(time * STEP_NS, cause, signal, values)


def events_of(a, b, **options):
    """Compare runs of the same rows with other events."""
    return diff(Run(VALUES, events=a), Run(VALUES, events=b), **options)


def test_runs_with_the_same_events_are_equal():
    """To the bit; NaN is equal to itself."""
    events = [override((0.5, math.nan)), override((7.0,), signal="c.y", cause="follow")]
    difference = events_of(events, list(events))
    assert difference.equal
    assert difference.events == EventsDifference((2, 2), 3, 0, True, None)


def test_another_event_is_a_difference_that_is_named(subtests):
    """Of runs with equal rows: one that is missing, of another value, cause, element or time."""
    for other, signal, a, b in [
        ([], "c.u[0]", ElementEvent("override", 0.5), None),
        (
            [override((0.5, 0.75))],
            "c.u[1]",
            ElementEvent("override", 0.25),
            ElementEvent("override", 0.75),
        ),
        (
            [override((0.5, 0.25), cause="release")],
            "c.u[0]",
            ElementEvent("override", 0.5),
            ElementEvent("release", 0.5),
        ),
        ([override((0.5,), signal="c.u[0]")], "c.u[1]", ElementEvent("override", 0.25), None),
        ([override((0.5, 0.25), time=0)], "c.u[0]", None, ElementEvent("override", 0.5)),
    ]:
        difference = events_of([override((0.5, 0.25))], other)
        time = 0 if a is None else STEP_NS
        as_json = json.loads(json.dumps(difference.to_dict()))
        with subtests.test(case=other):
            assert difference.same_rows
            assert not difference.equal
            assert not difference.within
            assert difference.events.first == ElementEventDifference(signal, time, a, b)
            assert as_json["events"]["first"]["signal"] == signal


def test_events_of_all_elements_equal_the_event_of_the_signal():
    """An override by elements is one of the whole."""
    parts = [override((0.5,), signal="c.u[0]"), override((0.25,), signal="c.u[1]")]
    assert events_of([override((0.5, 0.25))], parts).equal


def test_the_values_of_events_have_the_tolerance_of_their_signals():
    """Of the largest value in the rows of a."""
    difference = events_of([override((0.5, 0.25))], [override((0.5, 0.5))], rtol=0.1)
    assert difference.within  # 0.25 <= 0.1 * 4
    assert not difference.events.equal
    difference = events_of([override((0.5, 0.25))], [override((0.5, 0.75))], rtol=0.1)
    assert difference.events.outside == 1


def test_only_events_of_chosen_elements_are_compared():
    """As of the signals."""
    a = [override((0.5, 0.25))]
    b = [override((0.5, 0.75))]
    assert events_of(a, b, signals=["c.y"]).equal
    assert events_of(a, b, signals=["c.u[0]"]).equal
    assert not events_of(a, b, signals=["c.u[1]"]).equal


def test_an_event_that_does_not_fit_its_run_is_refused():
    """Of a log that was changed."""
    with pytest.raises(LogError, match=r"'c\.u' at t = .* expected 2 values, got 1"):
        events_of([override((0.5,))], [])
