"""Metrics of runs while they advance are those of their rows, to the last bit; assertions."""

import numpy as np
import pytest

import cosim
from cosim.blocks.source import sine, step
from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorded.partial import RecordSelection
from cosim.core.recorders import Memory, Slice
from cosim.errors import NonFiniteError, UsageError, shell_language
from cosim.studies.measuring import AssertedView, Assertions, MetricRecorder
from cosim.studies.metrics import parse_metrics
from tests.core.graphs import derivative_filter, stand
from tests.core.parts import Scripted, integrator

CLOCK = Clock(2.0, 1e-3)
TEXTS = {
    "error": "rms(plant.y - u.y, t > 0.5)",
    "settling": "settling(plant.y)",
    "slow": "std(slow.y - plant.u) + 1/count(slow.y)",
    "time": "last(t)",
}


def wave():
    components = {"u": sine(rate=3.0), "plant": integrator(5.0), "slow": integrator(0.5)}
    return Graph(components, {"plant.u": "u.y", "slow.u": "plant.y"}, periods={"slow": 7})


def measured(graph, clock, texts, **options):
    """Return metrics of a run while it advances, which are those of its rows in memory."""
    metrics = parse_metrics(texts)
    recorder, memory = MetricRecorder(metrics), Memory()
    for one in (recorder, memory):
        run(graph, clock, one, **options)
    assert recorder.values() == metrics.of(memory)
    return recorder.values()


def test_a_run_has_the_metrics_of_its_rows_whatever_its_blocks():
    """Equal floats; ``first(t, C)`` and ``until C`` name the same instant."""
    condition = "plant.y**2 > 0.09 for 100 ms"
    found = measured(wave(), CLOCK, {**TEXTS, "first": f"first(t, {condition})"})
    assert None not in found.values()
    for block in (1, 13):
        assert measured(wave(), Clock(2.0, 1e-3, block), TEXTS).items() < found.items()
    ended = measured(wave(), CLOCK, TEXTS, until=condition)
    assert ended["time"] == found["first"] < CLOCK.stop


def test_where_signals_jump_the_row_has_the_right_limit():
    """Left limits, which stand behind the signals of a row, are not seen, as in memory."""
    components = {"u": step(time=0.5), "plant": stand(), "filter": derivative_filter()}
    graph = Graph(components, {"plant.u": "u.y", "filter.u": "u.y", "filter.y": "plant.y"})
    assert graph.layout.row_width > graph.layout.width
    texts = {"max": "max(plant.y)", "step": "first(t, plant.y < 2)", "last": "last(filter.d)"}
    assert measured(graph, Clock(1.0, 1e-3), texts)["step"] == 0.5


def test_a_recorder_takes_runs_of_other_graphs():
    """Each with its own columns; a run that fails has the metrics of its rows before that."""
    graph = Graph({"s": Scripted([1.0, 2.0, 3.0, np.inf]), "x": integrator()}, {"x.u": "s.y"})
    recorder = MetricRecorder(parse_metrics({"m": "mean(s.y)", "n": "count(s.y)"}))
    assert recorder.values() == {"m": None, "n": None}
    for _ in range(2):
        with pytest.raises(NonFiniteError, match="became inf"):
            run(graph, Clock(0.003, 1e-3), recorder)
        assert recorder.values() == {"m": 2.0, "n": 3.0}
    run(Graph({"x": integrator(), "s": step(time=9.0)}, {"x.u": "s.y"}), CLOCK, recorder)
    assert recorder.values() == {"m": 0.0, "n": 2001.0}
    with pytest.raises(UsageError, match=r"(?s)^metrics.m: .*'s'.*\nmetrics.n: .*'s'"):
        run(wave(), CLOCK, recorder)
    with pytest.raises(UsageError, match="one component in the run, got none"):
        parse_metrics({"t": "last(t)"}).of(Memory())


def test_of_a_part_of_a_run_they_are_those_of_the_part():
    """Behind a recorder of some rows, and of what it has recorded."""
    metrics, memory = parse_metrics({"n": "count(plant.y)"}), Memory()
    for one in (recorder := MetricRecorder(metrics), memory):
        run(wave(), CLOCK, Slice(one, RecordSelection(("plant.y",), 5)))
    assert recorder.values() == metrics.of(memory) == {"n": 401.0}


def test_metrics_of_a_log_are_those_of_its_run(tmp_path):
    """Of a window of it, too; and the assertions while it goes on are of the same values."""
    texts = {
        "error": "rms(observer.delta - delta.y)",
        "settled": "settling(observer.delta, 0.5)",
        "theta": "count('identifier.theta[1]')",
    }
    changes = {"scenario.stop": 0.5, "scenario.verdicts": False}
    view = AssertedView(Assertions(["error < 1e-3", "theta < 1e9"], texts))
    log = cosim.run("academic", live=view, set=changes, out=tmp_path / "x.mcap")
    recorder = MetricRecorder(parse_metrics(texts))
    found = cosim.run("academic", set=changes, recorder=recorder).values()
    assert cosim.metrics(tmp_path / "x.mcap", texts) == found
    assert view.problems == {"error < 1e-3": f"error = {found['error']!r}"}
    later = parse_metrics(texts).of(log.window(t0=0.25))["error"]
    error = (log["observer.delta"] - log["delta.y"])[log.t >= 0.25]
    assert later == pytest.approx(np.sqrt(np.mean(error**2)), rel=len(error) * 2.0**-52)


VALUES = {"rms(a.y)": 0.5, "last(a.y)": 2.0, "first(t, a.y > 1 for 1 s)": None, "peak": 3.0}
FULFILLED = {
    "rms(a.y) < 0.6": "",
    "rms(a.y) < 0.5": "rms(a.y) = 0.5",
    "last(a.y) != 2": "last(a.y) = 2.0",
    "0 < rms(a.y) < last(a.y)": "",
    "rms(a.y) < 1 and last(a.y) > 3": "last(a.y) = 2.0",
    "rms(a.y) < 1 and last(a.y) > -2*e": "",
    "peak >= 3": "",
    "first(t, a.y > 1 for 1 s) != 9": "first(t, a.y > 1 for 1 s) = no value",
}


def test_a_comparison_holds_or_says_what_the_metrics_are():
    """A metric without a value fulfils nothing; those of a study go by their names."""
    found = Assertions(FULFILLED, {"peak": "max(a.y)"})
    assert found.problems(VALUES) == {text: why for text, why in FULFILLED.items() if why}
    assert found.metrics == {**{text: text for text in VALUES}, "peak": "max(a.y)"}


def test_what_is_no_assertion_is_refused():
    """Nothing of a text is run: it is one of the language of metrics."""
    for text, named in {
        "rms(a.y) < 1 or rms(a.y) > 2": "expected a comparison, such as rms",
        "rms(a.y) in 3": "< <= > >= == !=",
        "1 < 2": "at least one reduction",
        "peak < 1": r"a reduction, such as last\(peak\)",
        "__import__('os').getcwd() < 1": "allowed: numbers",
    }.items():
        with shell_language(), pytest.raises(UsageError, match=f"--assert: .*{named}"):
            Assertions([text])
