"""How the components of a scenario advance, as text and as a picture."""

import re

import pytest

from cosim.report.schedule import describe_schedule
from tests.scenario import certified
from tests.scenario.certified import write


def courses(schedule):
    """Return what the input of each connection has within a step."""
    return {(one["source"], one["to"]): one["course"] for one in schedule["connections"]}


def loop_of(schedule):
    """Return the stage that is coupled."""
    (loop,) = [stage for stage in schedule["stages"] if stage["coupling"]]
    return loop


def test_a_loop_has_its_members_in_order_and_what_is_extrapolated():
    """In closed-loop the actuator, whose output needs no input, advances first."""
    schedule = describe_schedule("closed-loop")
    loop = loop_of(schedule)
    assert loop["members"] == ["controller", "plant", "observer", "feedback", "error"]
    assert loop["is_first_order"]
    found = courses(schedule)
    late = [ports for ports, course in found.items() if course == "extrapolated"]
    assert late == [("error.y", "controller.u")]
    assert found["reference.y", "error.u1"] == "linear"
    compensation = courses(describe_schedule("compensation"))
    assert compensation["identifier.theta", "compensator.theta"] == "delayed"


def test_newton_solves_for_the_inputs_of_its_loop(tmp_path):
    """Which is of second order."""
    path = write(tmp_path, certified.SPRING)
    path.write_text(path.read_text().replace("step = 0.01", 'step = 0.01\ncoupling = "newton"'))
    schedule = describe_schedule(path)
    loop = loop_of(schedule)
    assert (loop["coupling"], loop["solved"]) == ("newton", ["mass.u"])
    assert not loop["is_first_order"]
    assert "solved" in courses(schedule).values()


SAMPLED = """
scenario = {{ name = "sampled", stop = 1.2, step = 0.1 }}
[components]
sine = {{ kind = "sine", rate = 1.0 }}
step = {{ kind = "step", time = 0.5 }}
own = {{ kind = "controller", A = [[-1.0]], B = [[1.0]], C = [[1.0]]{keys} }}
meter = {{ kind = "sensor", period = 0.2 }}
[connections]
"own.u" = "{source}.y"
"meter.u" = "own.y"
"""
OFFSET = ", period = 0.6, offset = 0.2"
LINEAR = ', input_interpolation = "linear"'


@pytest.mark.parametrize(
    ("keys", "source", "rate", "course"),
    [
        (OFFSET, "sine", (0.6, 0.2), "sampled"),
        (", period = 0.1", "sine", (None, 0.0), "sampled"),
        (f", period = 0.6{LINEAR}", "sine", (0.6, 0.0), "linear over period"),
        (f", period = 0.6{LINEAR}", "step", (0.6, 0.0), "sampled"),
        (f", period = 0.1{LINEAR}", "sine", (None, 0.0), "linear"),
        ("", "step", (None, 0.0), "zero-order hold"),
        ("", "sine", (None, 0.0), "linear"),
    ],
)
def test_period_and_offset_say_what_an_input_has(tmp_path, keys, source, rate, course):
    """A component with a period takes its inputs at its own instants, whatever they do between."""
    path = tmp_path / "sampled.toml"
    path.write_text(SAMPLED.format(keys=keys, source=source))
    schedule = describe_schedule(path)
    own = {entry["name"]: entry for entry in schedule["components"]}["own"]
    assert (own["period"], own["offset"]) == rate
    assert courses(schedule)[f"{source}.y", "own.u"] == course
    assert courses(schedule)["own.y", "meter.u"] == "sampled"


def test_the_picture_has_what_the_tables_say(call, tmp_path):
    """Each component with its number in the loop; each input where its arrow turns."""
    pytest.importorskip("matplotlib")
    assert call("info", "closed-loop", "--graph", "--out", "a.svg")[1].endswith("\na.svg\n")
    shown = re.findall(r"<text[^>]*>([^<]*)</text>", (tmp_path / "a.svg").read_text("utf-8"))
    assert {"delta", "1  controller", "5  error", "loop: gauss-seidel, first order"} <= set(shown)
    assert {"every 0.1 s", "feedthrough: u1 u2", "extrapolated", "linear"} <= set(shown)
    assert shown.count("u1") == 1


def test_ports_that_user_code_defines_are_not_asked_for(tmp_path, call):
    code, out, err = call("info", write(tmp_path, certified.ECHO), "--graph")
    assert (code, out) == (2, "")
    assert re.search("the ports of echo are defined by user code", err)
