"""Metrics of runs while they advance are those of what is recorded of them, to the last bit."""

import numpy as np
import pytest

import cosim
from cosim.blocks.dynamics import lag
from cosim.blocks.source import sine, step
from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.partial_recorder import PartialRecorder
from cosim.core.recorded.partial import RecordSelection
from cosim.core.recorders import Memory
from cosim.core.recording import Recorder
from cosim.errors import NonFiniteError, UsageError
from cosim.log.reading.reader import open_log
from cosim.studies.measuring import MetricRecorder
from cosim.studies.metrics import parse_metrics
from tests.core.graphs import derivative_filter, stand
from tests.core.parts import Scripted, integrator

CLOCK = Clock(2.0, 1e-3)
TEXTS = {
    "error": "rms(plant.y - u.y, t > 0.5)",
    "peak": "max(abs(plant.y))",
    "late": "first(t, plant.y > 0.3 for 100 ms)",
    "settling": "settling(plant.y)",
    "slow": "std(slow.y - plant.u) + 1/count(slow.y)",
    "time": "last(t)",
}


def wave():
    components = {"u": sine(rate=3.0), "plant": integrator(5.0), "slow": integrator(0.5)}
    connections = {"plant.u": "u.y", "slow.u": "plant.y"}
    return Graph(components, connections, periods={"slow": 7})


def both(graph, clock, texts):
    """Return metrics of a run while it advances, and of its rows in memory."""
    metrics = parse_metrics(texts)
    recorder = MetricRecorder(metrics)
    run(graph, clock, recorder)
    memory = Memory()
    run(graph, clock, memory)
    return recorder.values(), metrics.of(memory)


@pytest.mark.parametrize("block", [None, 1, 13, 500])
def test_a_run_has_the_metrics_of_its_rows_whatever_its_blocks(block):
    """Equal floats; of a component with one row in seven too."""
    found, recorded = both(wave(), Clock(2.0, 1e-3, block), TEXTS)
    assert found == recorded
    assert found == both(wave(), CLOCK, TEXTS)[0]
    assert None not in found.values()


def test_where_signals_jump_the_row_has_the_right_limit():
    """Left limits, which stand behind the signals of a row, are not seen, as in memory."""
    components = {"u": step(time=0.5), "plant": stand(), "filter": derivative_filter()}
    connections = {"plant.u": "u.y", "filter.u": "u.y", "filter.y": "plant.y"}
    graph = Graph(components, connections)
    texts = {"max": "max(plant.y)", "step": "first(t, plant.y < 2)", "last": "last(filter.d)"}
    found, recorded = both(graph, Clock(1.0, 1e-3), texts)
    assert graph.layout.row_width > graph.layout.width
    assert found == recorded
    assert found["step"] == 0.5


@pytest.mark.parametrize("condition", ["plant.y > 0.3", "plant.y**2 > 0.09 for 100 ms", "t >= 0.7"])
def test_first_is_where_a_run_until_the_condition_ends(condition):
    """``first(t, C)`` and ``until C`` name the same instant."""
    found, _ = both(wave(), CLOCK, {"m": f"first(t, {condition})"})
    memory = Memory()
    run(wave(), CLOCK, memory, until=condition)
    assert memory.end_ns < CLOCK.stop * 1e9
    assert found["m"] == memory.end_ns / 1e9
    metrics = parse_metrics(TEXTS)
    recorder = MetricRecorder(metrics)
    run(wave(), CLOCK, recorder, until=condition)
    assert recorder.values() == metrics.of(memory)


def test_a_run_that_fails_has_the_metrics_of_its_rows():
    """Up to the last one before the value that is not finite; the next run begins anew."""
    graph = Graph({"s": Scripted([1.0, 2.0, 3.0, np.inf]), "x": integrator()}, {"x.u": "s.y"})
    recorder = MetricRecorder(parse_metrics({"m": "mean(s.y)", "n": "count(s.y)"}))
    for _ in range(2):
        with pytest.raises(NonFiniteError, match="became inf"):
            run(graph, Clock(0.003, 1e-3), recorder)
        assert recorder.values() == {"m": 2.0, "n": 3.0}


def test_a_recorder_takes_runs_of_other_graphs():
    """Each with columns of its own; what is missing is named before the first step."""
    recorder = MetricRecorder(parse_metrics({"m": "last(plant.y)", "u": "max(plant.u)"}))
    assert isinstance(recorder, Recorder)
    run(wave(), CLOCK, recorder)
    first = recorder.values()
    plant = Linear(lag(time_constant=1.0, initial=3.0))
    run(Graph({"u": step(time=9.0), "plant": plant}, {"plant.u": "u.y"}), CLOCK, recorder)
    assert recorder.values()["m"] == pytest.approx(3.0 * np.exp(-2.0), rel=1e-12)
    graph = wave()
    for _ in range(2):
        run(graph, CLOCK, recorder)
        assert recorder.values() == first
    with pytest.raises(UsageError) as error:
        run(Graph({"p": plant, "u": step(time=9.0)}, {"p.u": "u.y"}), CLOCK, recorder)
    assert [line.split(";")[0] for line in str(error.value).splitlines()] == [
        "metrics.m: the run has no component 'plant'",
        "metrics.u: the run has no component 'plant'",
    ]


def test_before_a_run_there_are_no_values():
    """None of them, rather than those of no rows."""
    metrics = parse_metrics({"m": "last(plant.y)", "t": "last(t)"})
    assert MetricRecorder(metrics).values() == {"m": None, "t": None}
    with pytest.raises(UsageError, match="one component in the run, got none"):
        parse_metrics({"t": "last(t)"}).of(Memory())


def test_of_a_part_of_a_run_they_are_those_of_the_part():
    """Behind a recorder of some rows, and of what it has recorded."""
    metrics = parse_metrics({"n": "count(plant.y)", "m": "mean(plant.y)", "t": "count(t)"})
    selection = RecordSelection(("plant.y",), 5)
    recorder = MetricRecorder(metrics)
    memory = Memory()
    run(wave(), CLOCK, PartialRecorder(recorder, selection))
    run(wave(), CLOCK, PartialRecorder(memory, selection))
    assert recorder.values() == metrics.of(memory)
    assert recorder.values()["n"] == 401.0
    with pytest.raises(UsageError, match=r"metrics.u: the run has no 'plant.u': "):
        parse_metrics({"u": "last(plant.u)"}).of(memory)


@pytest.mark.slow
def test_a_shipped_scenario_has_the_metrics_of_its_log(tmp_path):
    """Of a log file and of a window of it, too."""
    texts = {
        "error": "rms(observer.delta - delta.y)",
        "theta": "last(identifier.theta[0])",
        "converged": "first(t, abs(observer.delta - delta.y) < 0.1 for 100 ms)",
        "settled": "settling(observer.delta, 0.5)",
        "estimates": "count(identifier.theta[0]) - count('identifier.theta[1]')",
    }
    metrics = parse_metrics(texts)
    changes = {"scenario.stop": 12.0}
    recorder = cosim.run("academic", set=changes, recorder=MetricRecorder(metrics))
    found = recorder.values()
    assert found["theta"] is not None
    assert found["estimates"] == 0.0
    path = tmp_path / "x.mcap"
    cosim.run("academic", set=changes, out=path)
    log = open_log(path)
    assert metrics.of(log) == found
    later = metrics.of(log.window(t0=5.0))
    error = (log["observer.delta"] - log["delta.y"])[log.t >= 5.0]
    needed = np.sqrt(np.mean(error**2))
    assert later["error"] == pytest.approx(needed, rel=len(error) * 2.0**-52)
    assert later["converged"] == 5.1
