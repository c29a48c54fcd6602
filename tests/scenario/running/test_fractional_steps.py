"""Steps that are no whole number of nanoseconds: 1/60 s, 1/44100 s."""

from fractions import Fraction

import pytest

import cosim
from cosim.errors import CosimError, ScenarioError
from tests.scenario.refusals import check_refused

RATES = [30, 60, 120, 144, 44_100]


def changes_of(rate, **more):
    """Return what the shipped motor and its controller take at a rate [Hz]."""
    times = {"scenario.stop": 1.0, "setpoint.time": 0.5, "load.time": 0.75}
    return {**times, "scenario.step": f"1/{rate}", "controller.period": f"2/{rate}", **more}


def run_pair(rate, out=None, **more):
    """Run them."""
    return cosim.run("pair", set=changes_of(rate, **more), out=out)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Return the log of a run at 120 Hz, whose controller has 60 Hz."""
    path = tmp_path_factory.mktemp("logs") / "pair.mcap"
    return run_pair(120, path)


@pytest.mark.parametrize("rate", RATES)
def test_points_are_multiples_of_the_fraction(rate):
    """Stamps are the whole nanoseconds next to k/rate, and nothing accumulates."""
    stop = 0.5 if rate > 1000 else 1.0
    run = run_pair(rate, **{"scenario.stop": stop, "setpoint.time": 0.0, "load.time": 0.5})
    expected = [round(Fraction(k * 10**9, rate)) for k in range(round(stop * rate) + 1)]
    assert run.time_ns("motor").tolist() == expected


def test_components_get_the_double_next_to_each_point():
    """A ramp of slope 1 shows the time that it was given: k/60, not what the log is stamped."""
    changes = changes_of(60)
    del changes["load.time"]
    changes["load"] = {"kind": "expression", "y": "t", "unit": "N.m"}
    run = cosim.run("pair", set=changes)
    assert run["load.y"].tolist() == [k / 60 for k in range(61)]
    assert run.time("load")[1] == 0.016666667
    with cosim.load("pair").edit(set=changes_of(60)).start() as session:
        session.step(7)
        assert session.t == 7 / 60
        assert session.t_ns == 116_666_667


def test_a_log_replays_bit_for_bit(log):
    """The whole of it, its plants too, and a part between two points."""
    assert log.steps == 120
    assert log["controller.y"].shape == (61,)
    assert cosim.diff(log, cosim.replay(log)).equal
    assert cosim.diff(log, cosim.replay(log, rerun=True)).equal
    for window in [(0.25, 0.75), (0.016666667, 0.983333333), (1 / 60, 59 / 60)]:
        part = cosim.replay(log, window=window)
        whole = log.window(*(round(end, 9) for end in window))
        assert (part["motor.y"] == whole["motor.y"]).all()
        assert (part.time_ns("motor") == whole.time_ns("motor")).all()
        assert part.end_ns == whole.end_ns
        assert part.steps == len(whole["motor.y"]) - 1


def test_a_recording_takes_the_place_of_what_it_recorded(log):
    """At its stamps, which are up to half a nanosecond from the points of the run."""
    run = cosim.run("pair", set=changes_of(120), swap={"motor": str(log.path)})
    assert (run["motor.y"] == log["motor.y"]).all()
    assert (run["controller.y"] == log["controller.y"]).all()
    with pytest.raises(CosimError, match=r"expected steps of 1/60 s .* got 1/120 s"):
        cosim.run("pair", set=changes_of(60), swap={"motor": str(log.path)})


def test_the_error_of_the_step_is_estimated_from_halves_of_it(tmp_path):
    """1/120 and 1/240 s; a search for a step, which tries whole nanoseconds, is refused."""
    certificate = cosim.certificate(cosim.run("pair", set=changes_of(60), certify=True))
    assert certificate.step == 1 / 60
    assert certificate.finer_steps == (1 / 120, 1 / 240)
    source = 'wave = { kind = "expression", y = "sin(t)" }'
    path = tmp_path / "wave.toml"
    path.write_text(
        f'[scenario]\nname = "wave"\nstop = 1.0\nstep = "1/60"\n[components]\n{source}\n'
    )
    with pytest.raises(CosimError, match="got 1/60 s"):
        cosim.run(path, find_step={"wave.y": 1e-3})


def ramp_of(tmp_path, out=None, **changes):
    """Run a ramp of slope 1 at 60 Hz."""
    path = tmp_path / "ramp.toml"
    text = '[scenario]\nname = "ramp"\nstop = 1.0\nstep = "1/60"\n[components.ramp]\n'
    path.write_text(text + 'kind = "expression"\ny = "t"\n')
    return cosim.run(path, set=changes, out=out)


def test_a_step_jumps_at_the_point_that_its_time_is_the_stamp_of():
    """7/60 s is less than its stamp, 0.116666667 s, and 8/60 s more."""
    for number in (7, 8):
        time = round(number / 60, 9)
        run = run_pair(60, **{"setpoint.time": time})
        assert run["setpoint.y"].tolist() == [0.0] * number + [100.0] * (61 - number)


def test_a_table_has_the_points_that_its_times_are_the_stamps_of(tmp_path):
    """From start to stop, held and interpolated; a window of it has the bits of the whole."""
    start, seven, last = (round(number / 60, 9) for number in (1, 7, 59))
    table = {"kind": "table", "t": [start, seven, last], "y": [0.0, 1.0, 2.0]}
    times = {"scenario.start_time": start, "scenario.stop": last}
    held = ramp_of(tmp_path, held={**table, "interpolation": "zero-order"}, **times)
    assert held["held.y"].tolist() == [0.0] * 6 + [1.0] * 52 + [2.0]
    line = ramp_of(tmp_path, tmp_path / "line.mcap", line=table, **times)
    assert line["line.y"][[0, 6, 58]].tolist() == [0.0, 1.0, 2.0]
    part = cosim.replay(line, rerun=True, window=(start, 0.5))
    assert (part["line.y"] == line["line.y"][:30]).all()


def test_conditions_of_a_run_and_of_metrics_are_true_at_the_same_point(tmp_path):
    """With t as the log has it, and durations that are as rounded as its stamps."""
    whole = ramp_of(tmp_path)
    for condition, number in {
        "t >= 0.116666667": 7,
        "t >= 0.116666667 for 0.05 s": 10,
        "ramp.y > 0.11 for 0.016666667 s": 8,
        "ramp.y > 0.13 for 0.033333333 s": 10,
    }.items():
        run = ramp_of(tmp_path, **{"scenario.until": condition})
        assert run.steps == number
        metrics = {"first": f"first(t, {condition})"}
        assert cosim.metrics(whole, metrics) == {"first": round(number / 60, 9)}


OFF_GRID = [
    ({"scenario.step": 1 / 60}, 'scenario.step.*"1/60"'),
    ({"scenario.step": 0.0166666666666667}, 'scenario.step.*"1/60"'),
    ({"scenario.step": "1/0"}, "scenario.step.*1/0"),
    ({"scenario.step": "-1/60"}, "scenario.step.*-1/60"),
    ({"scenario.step": "0/60"}, "scenario.step.*> 0"),
    ({"scenario.step": "1/3000000000"}, "scenario.step.*1e-9 s"),
    ({"scenario.stop": 0.51}, r"scenario.stop.*0\.516666667"),
    ({"scenario.start_time": 0.01}, r"scenario.stop.*0\.016666667|0\.016666667.*scenario.stop"),
    ({"controller.period": 0.02}, "controller.*1/60 s"),
    ({"controller.period": "1/50"}, "controller.*1/60 s"),
    ({"scenario.substeps": {}}, "scenario.substeps.*whole nanoseconds"),
]


def test_what_is_off_the_grid_is_refused():
    """With the key, and a value that would do."""
    check_refused(OFF_GRID, lambda changes: run_pair(60, **changes), ScenarioError)
