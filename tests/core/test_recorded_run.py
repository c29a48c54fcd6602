"""What a finished run tells beside its signals, and windows of it, in memory and from file."""

import json
import tomllib
from decimal import Decimal

import numpy as np
import pytest

import cosim
from cosim.core.recorded.run import span_ns
from cosim.core.recorders import Memory
from cosim.errors import LogError, UsageError
from cosim.log.diff import diff
from cosim.scenario.document.document import find
from tests.log.recordings import STEP_NS, plan, same_bits

SHORT = {"scenario.stop": 0.1}


def test_t_has_the_instants_of_the_fastest_component(two_rates):
    """Every communication point here, not those of the slower one; before a run it is empty."""
    log, _ = two_rates
    assert len(Memory().t) == 0
    assert np.array_equal(log.t, np.arange(1001) * STEP_NS / 1e9)
    assert len(log.time("identifier")) == 201


@pytest.mark.usefixtures("without_verdicts")
def test_parameters_are_those_of_the_scenario(recorded):
    """Also where a run was started with others than its file has."""
    shown = tomllib.loads(find("academic").text)["components"]
    assert list(recorded.parameters) == list(recorded.channels)
    for name, table_ in shown.items():
        kind = table_.pop("kind")
        assert recorded.parameters[name] == table_
        assert kind
    changed = cosim.run("academic", set={**SHORT, "observer.filter_rate": 500})
    assert changed.parameters["observer"]["filter_rate"] == 500


@pytest.mark.usefixtures("without_verdicts")
def test_parameters_of_components_that_are_not_recorded_are_known(in_memory):
    """A log of some signals tells of the whole run what it was."""
    run = cosim.run("academic", set={**SHORT, "record.signals": ["plant.y"]})
    assert list(run.channels) == ["plant"]
    assert run.parameters == in_memory.parameters


def test_the_scenario_is_its_text(recorded):
    """As the run attached it."""
    assert recorded.scenario == find("academic").text


def test_a_run_without_a_scenario_has_no_parameters_and_no_text(two_rates):
    """It says what is missing."""
    log, _ = two_rates
    assert log.parameters == {"plant": {}, "identifier": {}}
    with pytest.raises(LogError, match=r"has no attachment 'scenario\.toml'"):
        log.scenario  # noqa: B018


@pytest.mark.parametrize("text", ["[1]", "{", "[" * 100_000, '{"a": 1', "null"])
def test_parameters_that_cannot_be_understood_are_refused(text):
    """A log may come from anywhere."""
    memory = Memory(metadata={"cosim.component.plant": {"table": text}})
    memory.begin(plan())
    with pytest.raises(LogError, match=r"parameters of 'plant' cannot be.*JSON"):
        memory.parameters  # noqa: B018


def test_a_scenario_that_is_no_text_is_refused():
    """Bytes that are no UTF-8."""
    memory = Memory(attachments={"scenario.toml": b"\xff"})
    with pytest.raises(LogError, match=r"scenario\.toml cannot be read"):
        memory.scenario  # noqa: B018


def test_a_window_has_the_rows_of_its_time(two_rates):
    """Both ends included, every component by its own instants."""
    log, rows = two_rates
    part = log.window(0.1, 0.2)
    assert list(part) == list(log)
    assert part.t[0] == 0.1
    assert part.t[-1] == 0.2
    assert same_bits(part["plant.x_a"], rows[100:201, 1:3])
    assert same_bits(part["identifier.y"], rows[100:201:5, 5:8])
    assert np.array_equal(part.time("identifier"), np.arange(100, 201, 5) * STEP_NS / 1e9)
    assert not part["plant.x_a"].flags.writeable
    assert (part.steps, part.end_ns) == (200, 200 * STEP_NS)
    assert part.label == f"{log.label} from 0.1 s to 0.2 s"
    whole = repr(log).removeprefix(f"<{log.label}: ")
    assert repr(part) == f"<{part.label}: of a run: {whole}"


@pytest.mark.parametrize(
    ("t0", "t1", "first", "last"),
    [
        (None, None, 0, 1000),
        (0.9, None, 900, 1000),
        (None, 0.0, 0, 0),
        (0.0995, 0.1015, 100, 101),
        (-5.0, 1e300, 0, 1000),
        (0.5, 0.5, 500, 500),
    ],
)
def test_a_bound_that_is_left_out_or_off_the_grid_takes_all_rows_inside(
    two_rates, t0, t1, first, last
):
    """The rows are those with ``t0 <= t <= t1``, compared as numbers."""
    log, rows = two_rates
    part = log.window(t0, t1)
    assert same_bits(part["plant.u"], rows[first : last + 1, 0])
    assert part.end_ns == last * STEP_NS


@pytest.mark.parametrize(("t0", "t1"), [(0.1001, 0.1009), (5.0, None), (None, -1.0)])
def test_a_window_without_rows_is_a_run_without_rows(two_rates, t0, t1):
    """Its arrays are empty, of the shape of each signal."""
    log, _ = two_rates
    part = log.window(t0, t1)
    assert part["plant.x_a"].shape == (0, 2)
    assert part["plant.u"].shape == (0,)
    assert len(part.t) == 0
    assert f"<{part.label}: no rows of a run: " in repr(part)


def test_a_window_of_a_window_is_what_both_have(two_rates):
    """And a window is compared as any run."""
    log, rows = two_rates
    part = log.window(0.1, 0.5).window(0.4, 0.9)
    assert same_bits(part["plant.u"], rows[400:501, 0])
    assert diff(part, log.window(0.4, 0.5)).equal
    assert {row.rows for row in diff(part, log).rows} == {(101, 1001, 101), (21, 201, 21)}


def test_the_edges_of_a_window_are_doubles_as_the_times_are():
    """Each instant is in the window from its own time to its own time."""
    for k in range(0, 10**9, 99_999_937):
        assert span_ns(k / 1e9, k / 1e9) == (k, k)


def test_the_edges_of_a_window_may_be_decimals():
    """Which tell nanoseconds since 1970 apart; beyond all rows any time is the same."""
    t = Decimal("1764570000.123456789")
    assert span_ns(t, t) == (1764570000123456789, 1764570000123456789)
    between = Decimal("1764570000.1234567895")
    assert span_ns(between, between) == (1764570000123456790, 1764570000123456789)
    assert span_ns(Decimal("-1e300"), Decimal("1e300")) == span_ns(-1e300, 1e300)
    with pytest.raises(UsageError, match=r"t0 = 1764570000\.123456789 s and t1 = 2\.0 s"):
        span_ns(t, Decimal(2))
    with pytest.raises(UsageError, match=r"t1: .*seconds, got nan"):
        span_ns(None, Decimal("nan"))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_bounds_are_finite_numbers_in_their_order(two_rates, value):
    """None is how a bound is left out; others are refused, rather than an empty window."""
    log, _ = two_rates
    with pytest.raises(UsageError, match=r"t1: .*seconds, got (nan|inf)"):
        log.window(0.0, value)
    with pytest.raises(UsageError, match=r"t0: .*'a'"):
        log.window("a", 1.0)
    with pytest.raises(UsageError, match=r"t0.*t1.*t0 = 2\.0 s.*t1 = 1\.0 s"):
        log.window(2.0, 1.0)


def test_a_window_has_the_messages_and_jumps_of_its_time(tmp_path):
    """An override at 0.05 s is in one half and not in the other."""
    scenario = cosim.load("academic").set(SHORT)
    with scenario.start(out=tmp_path / "a.mcap") as sim:
        sim.step(50)
        sim["plant.u"] = 0.3
        sim.step(50)
    log = cosim.open_log(tmp_path / "a.mcap")
    assert [event.signal for event in log.window(0.0, 0.04).events()] == []
    assert "plant.u" in [event.signal for event in log.window(0.05, 0.05).events()]
    whole = log.messages()
    halves = log.window(None, 0.03).messages() + log.window(0.030001, None).messages()
    assert halves == whole
    assert json.loads(log.window(0.0, 0.01).metadata["cosim.run"]["edits"])
    assert log.window(0.0, 0.01).parameters == log.parameters
