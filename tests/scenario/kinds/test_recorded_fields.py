"""An MCAP of another tool in the place of the plant, and of what drives it."""

from __future__ import annotations

import re

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.log import open_log
from cosim.scenario.record import component_table, recorded_warnings
from tests.log.crafting import put_together, take_apart
from tests.log.foreign.field_logs import EPOCH, write_json
from tests.scenario.field_recordings import (
    BOTH,
    COUNT,
    LOOP,
    PLANT,
    STEP,
    STEP_NS,
    command,
    field_log,
    level,
)
from tests.scenario.refusals import check_refused


@pytest.fixture
def loop(tmp_path):
    path = tmp_path / "loop.toml"
    path.write_text(LOOP, encoding="utf-8")
    return cosim.load(path)


def warnings_of(log):
    return "\n".join(text for _, text in recorded_warnings(log))


def test_fields_take_the_place_of_the_plant_and_of_its_input(loop, tmp_path):
    """By name; t = 0 is the first instant by which all of them have a sample."""
    swapped = loop.swap(plant=field_log(tmp_path), map=BOTH)
    log = cosim.run(swapped, out=tmp_path / "run.mcap")
    t = log.time("plant.y")
    shift = 3e-3  # the first /cmd
    samples = np.arange(-50, COUNT) * STEP - shift
    expected = np.interp(t, samples, level(samples + shift))
    np.testing.assert_allclose(log["plant.y"], expected, atol=1e-12)
    np.testing.assert_allclose(log["plant.u"], command(t + shift), atol=1e-12)
    np.testing.assert_allclose(log["double.y"], 2.0 * log["plant.u"], atol=1e-12)
    np.testing.assert_array_equal(log["command.y"], cosim.run(loop)["command.y"])
    text = warnings_of(log)
    assert "'plant.u' is recorded: model.u, double.u take it in the place of command.y" in text
    assert "has no inputs" not in text
    assert component_table(log, "plant")["zero_ns"] == EPOCH + 3_000_000
    (tmp_path / "field.mcap").unlink()  # a replay does without it, bit for bit
    again = cosim.replay(log.path)
    assert cosim.diff(log, again).equal
    other = cosim.replay(log.path, set={"model.time_constant": 0.1})
    assert not np.array_equal(other["error.y"], log["error.y"])
    np.testing.assert_array_equal(other["plant.u"], log["plant.u"])


def test_components_from_one_file_have_one_time(loop, tmp_path):
    """The field that begins last decides for both, so that they are not shifted."""
    path = field_log(tmp_path)
    names = {"plant.y": "/drive/state.position", "command.y": "/cmd.values[0]"}
    log = cosim.run(loop.swap(plant=path, command=path, map=names))
    other = cosim.run(loop.swap(plant=path, map=BOTH))
    np.testing.assert_array_equal(log["plant.y"], other["plant.y"])
    np.testing.assert_array_equal(log["command.y"], other["plant.u"])


@pytest.mark.parametrize(
    ("field", "changes", "shift"),
    [
        (PLANT["plant.y"], {"offset": EPOCH / 1e9}, 0.0),
        (PLANT["plant.y"], {"offset": EPOCH / 1e6, "time_unit": "ms"}, 0.0),
        (PLANT["plant.y"], {"offset": EPOCH / 1e9 + 0.25}, 0.25),
        (PLANT["plant.y"], {"offset": "first"}, -0.5),
        (PLANT["plant.y"], {"time": "publish_time", "offset": EPOCH / 1e9}, -7e-9),
        ("/cmd.values[0]", {"time": "stamp"}, 3e-3),
    ],
)
def test_times_are_those_that_are_named_from_the_offset_on(loop, tmp_path, field, changes, shift):
    """In s, or the unit that is given, or from the first sample; a field of each message too."""
    swapped = loop.swap(plant=field_log(tmp_path), map={"plant.y": field})
    log = cosim.run(swapped.set({f"plant.{key}": value for key, value in changes.items()}))
    course = command if "stamp" in changes.values() else level
    # straight lines for curves, by the square of the step: 1.7**2 / 8 x 1e-4, of a command 25 / 8
    # x 1e-4, and 5 x 3e-7 by times in s since 1970
    tolerance = 4e-4 if course is command else 4e-5
    expected = course(log.time("plant.y") + shift)
    np.testing.assert_allclose(log["plant.y"], expected, atol=tolerance)


def test_the_interpolation_between_samples_must_be_named(loop, tmp_path):
    """Of a recording that is coarser than the step; a hold is that of numpy's searchsorted."""
    path = field_log(tmp_path, step_ns=4 * STEP_NS)
    swapped = loop.swap(plant=path, map=PLANT)
    message = r"0\.01 s.*'/drive/state\.position'.*0\.04 s.*interpolation.*zero-order"
    with pytest.raises(ScenarioError, match=message):
        cosim.run(swapped)
    samples = np.arange(-50, COUNT) * 4 * STEP_NS / 1e9
    t = cosim.run(loop).time("plant.y")
    offset = {"plant.offset": EPOCH / 1e9}
    line = cosim.run(swapped.set({**offset, "plant.interpolation": "linear"}))
    np.testing.assert_allclose(line["plant.y"], np.interp(t, samples, level(samples)), atol=1e-12)
    held = cosim.run(swapped.set({**offset, "plant.interpolation": "zero-order"}))
    last = np.searchsorted(samples, t, side="right") - 1
    np.testing.assert_array_equal(held["plant.y"], level(samples)[last])


def test_a_run_with_a_recording_is_certified(loop, tmp_path):
    """Between the samples are straight lines with half the step, too, and the same columns."""
    log = cosim.run(loop.swap(plant=field_log(tmp_path), map=BOTH), certify=True)
    certificate = cosim.certificate(log)
    assert certificate["plant.y"].largest == 0.0
    # a linear model with inputs on straight lines is exact, whatever the step
    assert "at the level of rounding" in certificate["model.y"].reason


def test_a_scenario_has_the_same_in_its_file(tmp_path):
    """As a component of its own, and in the table [swap]."""
    path = field_log(tmp_path)
    kind = LOOP.replace(
        'plant = { kind = "lag", time_constant = 0.5 }',
        'plant = { kind = "field-data", path = "field.mcap", columns = { '
        'y = "/drive/state.position", x = ["/cmd.values[0:2]", "/cmd.values[1]"] } }',
    ).replace('"plant.u" = "command.y"\n', "")
    file = tmp_path / "own.toml"
    file.write_text(kind, encoding="utf-8")
    log = cosim.run(file)
    np.testing.assert_array_equal(log["plant.x"][:, 1:], np.full((301, 2), 7.0))
    swap = '\n[swap]\nplant = {{ path = "{}", map = {{ "plant.y" = "/drive/state.position" }} }}\n'
    file.write_text(LOOP + swap.format("field.mcap#samples"), encoding="utf-8")
    np.testing.assert_array_equal(
        cosim.run(file)["plant.y"],
        cosim.run(cosim.load(file).swap(plant=path, map=PLANT))["plant.y"],
    )
    file.write_text(LOOP + swap.format("field.mcap"), encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"another tool; .*'field.mcap#samples'"):
        cosim.run(file)


def test_straight_lines_between_truth_values_are_said(loop, tmp_path):
    """What is half of a truth value is none; a hold keeps it."""
    rows = [(EPOCH + i * STEP_NS, {"on": i % 2 == 0}) for i in range(COUNT)]
    path = write_json(tmp_path / "on.mcap", {"/t": rows})
    swapped = loop.swap(plant=path, map={"plant.y": "/t.on"})
    shifted = swapped.set({"plant.offset": (EPOCH + STEP_NS // 2) / 1e9})
    log = cosim.run(shifted, out=tmp_path / "line.mcap")
    assert "linear interpolation between Booleans or enumerations, /t.on: between" in warnings_of(
        log
    )
    held = cosim.run(shifted.set({"plant.interpolation": "zero-order"}), out=tmp_path / "h.mcap")
    assert "truth values" not in warnings_of(held)
    assert set(held["plant.y"].tolist()) == {0.0, 1.0}
    assert not set(log["plant.y"].tolist()) & {0.0, 1.0}


def test_disorder_and_gaps_are_said(loop, tmp_path):
    """Behind the run, with where the gap is; and nothing where there is none."""
    assert "topic" not in warnings_of(
        cosim.run(loop.swap(plant=field_log(tmp_path), map=PLANT), out=tmp_path / "plain.mcap")
    )
    rows = [(EPOCH + i * STEP_NS, {"x": i}) for i in range(COUNT) if not 200 < i < 205]
    rows[100], rows[101] = rows[101], rows[100]
    rows[10:10] = [(rows[9][0], {"x": 98}), (rows[9][0], {"x": 99})]  # three of one instant
    path = write_json(tmp_path / "bad.mcap", {"/t": rows})
    out = tmp_path / "run.mcap"
    log = cosim.run(loop.swap(plant=path, map={"plant.y": "/t.x"}), out=out)
    text = warnings_of(open_log(out))
    of_topic = r"topic '/t': 1 of 398 .*; 2 of 398 .*; the largest gap is 0\.05 s, from t = 2 s on"
    assert re.search(of_topic, text)
    assert log["plant.y"][9] == 99.0
    assert log["plant.y"][100] == 100.0


U = "connections.plant.u"
WRONG_OPTIONS = [
    (PLANT, {"plant.time": "stampp"}, "'/drive/state.stampp', message 1: "),
    ({}, {}, "expected a map, map={'PORT': '/topic.field'}, or columns"),
    ({"plant.y": "/drive/state.positio"}, {}, "did you mean '/drive/state.position'?"),
    ({"plant.y": "/drive/stat.x"}, {}, "no topic for '/drive/stat.x'"),
    ({"plant.y": "/drive/state"}, {}, "'/drive/state'"),
    ({"plant.y": "/drive/state.name"}, {}, "text"),
    (PLANT, {"scenario.stop": 5.0}, "0.0 s to 5.0 s"),
    (PLANT, {"plant.offset": 0.0}, "from 0.0 s to 3.0 s, got 1699999999.5 s to 1700000003.99 s"),
    (PLANT, {"plant.maximum_gap": 1e-3}, "maximum_gap = 0.001 s"),
    (PLANT, {"plant.time_unit": "m"}, "such as ms, got 'm'"),
    (PLANT, {"plant.offset": -1e10}, "within 2**63 ns of the offset"),
    (BOTH, {U: {"from": "command.y", "gain": 2.0}}, "'plant.u' takes command.y with a gain"),
    (BOTH, {U: ["command.y", "model.y"]}, "takes 2 signals, command.y, model.y; expected one name"),
]


def test_wrong_options_are_refused(loop, tmp_path):
    """Before the run, with the way out."""
    swapped = {"plant": str(field_log(tmp_path))}

    def refuse(names, changes):
        cosim.run(loop, swap=swapped, map=names, set=changes)

    cases = [(*case, re.escape(text)) for *case, text in WRONG_OPTIONS]
    check_refused(cases, refuse, ScenarioError)
    document = tmp_path / "parts.toml"
    document.write_text(LOOP.replace('"plant.u"', '"plant.u[0]"'), encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"'plant\.u' is connected by its elements"):
        cosim.run(document, swap=swapped, map=BOTH)


VECTOR = """
scenario = { name = "vector", stop = 1.0, step = 1e-2 }
[components]
command = { kind = "constant", value = [1.0, 2.0] }
ramp = { kind = "ramp", slope = 1.0 }
plant = { kind = "gain", K = [[1.0, 1.0]] }
one = { kind = "gain", K = 1.0 }
both = { kind = "gain", K = [[0.0, 1.0]] }
[connections]
"plant.u" = "command.y"
"one.u" = "command.y[1]"
"both.u" = "command.y[0:2]"
"""
TWO = VECTOR.replace('= "command.y"', '= ["command.y[0]", "ramp.y"]').replace(
    '"command.y[1]"', '"ramp.y"'
)


@pytest.mark.parametrize(
    ("text", "u"),
    [
        (VECTOR, "/cmd.values"),
        (TWO, ["/cmd.values[0]", "/cmd.values[1]"]),
    ],
)
def test_elements_of_a_recorded_input_are_those_of_what_drove_it(tmp_path, text, u):
    """``command.y[1]`` becomes ``plant.u[1]``, a slice is one too; each signal has its own."""
    path = tmp_path / "vector.toml"
    path.write_text(text, encoding="utf-8")
    names = {**PLANT, "plant.u": u}
    log = cosim.run(cosim.load(path).swap(plant=field_log(tmp_path), map=names))
    assert log["plant.u"].shape == (101, 2)
    np.testing.assert_array_equal(log["one.y"], np.full(101, 7.0))
    if text == VECTOR:
        np.testing.assert_array_equal(log["both.y"], np.full(101, 7.0))


def test_an_own_log_is_no_field_recording(loop, tmp_path):
    """Also where another tool has copied it: its component is taken, at the rows of its run."""
    own = tmp_path / "own.mcap"
    log = cosim.run(loop, out=own)
    copied = tmp_path / "copied.mcap"
    put_together(take_apart(own), copied)
    for path in (own, copied):
        again = cosim.run(loop.set({"command.rate": 1.0}).swap(plant=path))
        np.testing.assert_array_equal(again["plant.y"], log["plant.y"])


def test_a_topic_published_once_or_on_change_is_held(tmp_path):
    """To the end of the recording, whatever topic ends it; further where that is asked for."""
    step = 10_000_000
    topics = {
        "/map": [(EPOCH, {"size": 3})],
        "/mode": [(EPOCH, {"m": 1}), (EPOCH + 40 * step, {"m": 2}), (EPOCH + 41 * step, {"m": 3})],
        "/pose": [(EPOCH + i * step, {"x": i}) for i in range(151)],
    }
    write_json(tmp_path / "once.mcap", topics)
    table = 'kind = "field-data", path = "once.mcap", columns = { y = "/map.size", m = "/mode.m" }'

    def run(stop, keys):
        text = f"scenario = {{ name = 's', stop = {stop}, step = 0.1 }}\n"
        (tmp_path / "s.toml").write_text(f"{text}[components]\nd = {{ {table}{keys} }}\n")
        return cosim.run(tmp_path / "s.toml")

    with pytest.raises(ScenarioError, match=r"'y' \(/map.size\) ends .*: interpolation = \"zero"):
        run(1.5, "")
    held = ', interpolation = "zero-order"'
    log = run(1.5, held)
    assert log["d.y"].tolist() == [3.0] * 16
    assert log["d.m"].tolist() == [1.0] * 4 + [2.0] + [3.0] * 11
    with pytest.raises(ScenarioError, match=r"stop = 1.5 .* inside, or extrapolation = \"hold\""):
        run(2.0, held)
    assert run(2.0, f'{held}, extrapolation = "hold"')["d.y"].tolist() == [3.0] * 21


def test_a_whole_offset_of_messages_is_exact_to_the_ns(tmp_path):
    """As an integer in ns, of 19 digits."""
    begin = EPOCH + 123_456_789
    topics = {"/t": [(begin + i, {"x": i}) for i in range(9)]}
    path = write_json(tmp_path / "log.mcap", topics)
    columns = {"x": "/t.x"}
    data = cosim.read_field_data(path, columns=columns, time_unit="ns", offset=begin + 2)
    assert data.t.tolist() == [i / 1e9 for i in range(-2, 7)]
    assert data.zero_ns == begin + 2
