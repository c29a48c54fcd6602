"""Switches, sensors and look-up tables: what they do, say and refuse."""

import re

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document
from cosim.scenario.exporting import export_component
from tests.scenario.refusals import check_refused

SWITCH = """
scenario = { name = "switching", stop = 1.0, step = 0.25 }
[components]
ramp = { kind = "ramp", slope = 1.0 }
up = { kind = "step", time = 0.5 }
on = { kind = "constant", value = true }
switch = { kind = "switch" }
after = { kind = "integrator" }
[connections]
"switch.u1" = "ramp.y"
"switch.control" = "up.y"
"switch.u2" = "on.y"
"after.u" = "switch.y"
"""
U1 = "connections.switch.u1"
CONTROL = "connections.switch.control"


@pytest.mark.parametrize(
    ("changes", "y", "after", "said"),
    [
        ({U1: "up.y"}, [1.0, 1.0, 1.0, 1.0, 1.0], None, ""),  # discrete with all of its inputs
        ({}, [1.0, 1.0, 0.5, 0.75, 1.0], None, r"up\.y: interpolated linearly together with ramp"),
        ({CONTROL: "ramp.y"}, None, [0.0, 0.25, 0.4375, 0.59375, 0.8125], "becomes a ramp over"),
        ({"switch.discrete": True}, None, [0.0, 0.25, 0.5, 0.625, 0.8125], ""),
        ({"switch.discrete": True, CONTROL: "ramp.y"}, None, None, "that shows at the second"),
    ],
)
def test_a_switch_jumps_at_communication_points_or_says_so(tmp_path, changes, y, after, said):
    """Jumps of a continuous control, or of a discrete one over a continuous signal, are ramps."""
    log = cosim.run(parse(Document(SWITCH, "switching", tmp_path)), set=changes)
    assert y is None or log["switch.y"].tolist() == y
    assert after is None or log["after.y"].tolist() == after
    messages = "\n".join(message.text for message in log.messages())
    assert re.search(said, messages) if said else messages == ""


JUMP = """
scenario = { name = "jump", stop = 0.1, step = 0.01 }
[components]
setpoint = { kind = "step", time = 0.05, before = 1.0, after = 5.0 }
ramp = { kind = "ramp", slope = 1.0 }
pid = { kind = "pid", gain = 2.0, integral_time = 0.5, upper = 3.0 }
product = { kind = "product", operations = "*/" }
[connections]
"pid.setpoint" = "setpoint.y"
"pid.measurement" = "ramp.y"
"product.u1" = "ramp.y"
"product.u2" = "setpoint.y"
"""


@pytest.mark.slow
@pytest.mark.parametrize(("name", "fmi"), [("pid", "3"), ("product", "3"), ("pid", "2")])
def test_an_fmu_follows_a_jump_without_a_line_from_before_it(name, fmi, tmp_path):
    """By an event of FMI 3: from before a jump no derivative leads to the output after it.

    Such a line ended 7 beyond the limit of the controller, and made the quotient negative. Without
    events, of FMI 2, the output is that before the jump for one point more, which is said.
    """
    scenario = tmp_path / "jump.toml"
    scenario.write_text(JUMP, encoding="utf-8")
    expected = cosim.run(scenario)[f"{name}.y"]
    fmu = tmp_path / f"{name}.fmu"
    settings = {f"{name}.interface_type": "cs"}
    export_component(str(scenario), name, fmu, fmi=fmi)
    run = cosim.run(scenario, swap={name: fmu}, set=settings)
    found = run[f"{name}.y"]
    if fmi == "3":
        np.testing.assert_allclose(found, expected, rtol=0, atol=10 * 3 * 2.0**-52)
        return
    assert found.max() == 3.0
    assert np.flatnonzero(abs(found - expected) > 1e-14).tolist() == [5]
    assert any("by up to one step" in message.text for message in run.messages())


# --- sensors: in front of an observer, replayed, changed, refused ---

EVERY = {
    "delay": 1.5e-3,
    "jitter": 2e-4,
    "bias": 0.01,
    "noise": 1e-3,
    "lower": -5,
    "upper": 5,
    "bits": 12,
    "dropout": 0.01,
    "seed": 7,
}
PLANT = cosim.load("academic").set({"scenario.stop": 2.0, "scenario.verdicts": False})


def measured(**errors):
    """Return the plant of the paper with a sensor in front of its observer."""
    return PLANT.set(
        {
            "components.sensor": {"kind": "sensor", **errors},
            "connections.sensor.u": "plant.y",
            "connections.observer.y": "sensor.y",
        }
    )


def test_noise_needs_no_warning_and_is_changed_by_its_seed_alone(tmp_path):
    """Its samples are joined by lines; in a replay with another seed the plant is as it was."""
    log = cosim.run(measured(noise=1e-3, seed=1), out=tmp_path / "noisy.mcap")
    assert [message for message in log.messages() if message.source == "sensor"] == []
    other = cosim.replay(log.path, set={"sensor.seed": 8})
    np.testing.assert_array_equal(other["plant.y"], log["plant.y"])
    assert (other["sensor.y"] != log["sensor.y"]).all()


@pytest.mark.parametrize("period", [{}, {"period": 5e-3}])
def test_a_replay_of_a_sensor_is_bit_exact(tmp_path, period):
    """Its numbers follow from the file, which is in the log; blocks do not matter."""
    scenario = measured(**EVERY, **period)
    log = cosim.run(scenario, out=tmp_path / "run.mcap")
    assert cosim.diff(log, cosim.replay(log.path)).equal
    assert cosim.diff(log, cosim.run(scenario, block=1)).equal
    lost = np.count_nonzero(log["sensor.valid"] == 0.0)
    assert 0 < lost < 0.1 * len(log["sensor.valid"])


def test_times_are_seconds_and_the_log_keeps_the_samples_of_a_period():
    """A delay of 2.5 steps lies between two outputs of the plant; one row a sample, from 0 on."""
    run = cosim.run(measured(delay=2.5e-3))
    y = run["plant.y"]
    # outputs of a few ones, rounded
    middle = (y[:-3] + y[1:-2]) / 2.0
    np.testing.assert_allclose(run["sensor.y"][3:], middle, rtol=1e-15, atol=1e-15)


WRONG_VALUES = [
    ({"noise": 0.1}, ": seed: expected"),
    ({"delay": -1e-3}, "delay[^ ]*: expected a number >= 0, got -0.001"),
    ({"jitter": -1e-3, "seed": 1}, "jitter[^ ]*: expected a number >= 0, got -0.001"),
    ({"delay": 1.5e-10}, "1.5e-10 s"),
    ({"period": 1.5e-3}, "period of 'sensor': "),
]


def test_a_wrong_value_is_one_problem_of_the_component():
    place = r"\Aset\['sensor'\]"
    cases = [(errors, rf"{place}[^\n]*{text}[^\n]*\Z") for errors, text in WRONG_VALUES]
    check_refused(cases, lambda errors: cosim.run(measured(**errors)), ScenarioError)


# --- look-up tables ---


def run(folder, table, inputs=("u",), **more):
    """Run a look-up table on ramps: u, u1 are t, u2 is 2 t."""
    sources = {"u": "once.y", "u1": "once.y", "u2": "twice.y"}
    connections = [f'"f.{name}" = "{sources[name]}"' for name in inputs]
    head = 'scenario = { name = "f", stop = 1.0, step = 0.25 }'
    once, twice = (f'{{ kind = "ramp", slope = {slope} }}' for slope in (1.0, 2.0))
    own = f'[components.f]\nkind = "look-up-table"\n{table}'
    parts = f"[components]\nonce = {once}\ntwice = {twice}\n{own}"
    text = "\n".join([head, parts, "[connections]", *connections])
    return cosim.run(parse(Document(text, "f", folder)), **more)


BOTH = ("u1", "u2")
SHORT = "u = [0.25, 0.5]\ny = [0.0, 1.0]\n"
PRODUCT = "u1 = [0.0, 1.0]\nu2 = [0.0, 2.0]\ny = [[0.0, 0.0], [0.0, 2.0]]"


@pytest.mark.parametrize(
    ("table", "inputs", "y"),
    [
        ("u = [0.0, 0.5, 1.0]\ny = [0.0, 1.0, 0.0]", ("u",), [0.0, 0.5, 1.0, 0.5, 0.0]),
        (f'{SHORT}extrapolation = "hold"', ("u",), [0.0, 0.0, 1.0, 1.0, 1.0]),
        (f'{SHORT}extrapolation = "linear"', ("u",), [-1.0, 0.0, 1.0, 2.0, 3.0]),
        (PRODUCT, BOTH, [0.0, 0.125, 0.5, 1.125, 2.0]),
        ('file = "f.csv"\ncolumns = ["a", "c"]', ("u",), [1.0, 1.5, 2.0, 2.5, 3.0]),
        ('file = "g.csv"', BOTH, [0.0, 0.125, 0.5, 1.125, 2.0]),
    ],
)
def test_a_function_by_its_values(tmp_path, table, inputs, y):
    """Arrays, or a file with a row for each point, in any order."""
    (tmp_path / "f.csv").write_text("a,b,c\n0,9,1\n1,9,3\n")
    (tmp_path / "g.csv").write_text("u1,u2,y\n1,2,2\n0,2,0\n0,0,0\n1,0,0\n")
    log = run(tmp_path, table, inputs, out=tmp_path / "f.mcap")
    assert log["f.y"].tolist() == y
    assert cosim.diff(log, cosim.replay(log)).equal


def test_a_file_says_the_units_of_its_columns(tmp_path):
    """Of u and y, so that connections convert to and from them: 0 to 1 s are 0 to 1000 ms."""
    (tmp_path / "f.csv").write_text("u [ms],y [kN]\n0,1\n1000,3\n")
    log = run(tmp_path, 'file = "f.csv"', set={"components.once.unit": "s"})
    assert [log.signals[name].unit for name in ("f.u", "f.y")] == ["ms", "kN"]
    assert log["f.y"].tolist() == [1.0, 1.5, 2.0, 2.5, 3.0]
    with pytest.raises(ScenarioError, match=r"unit of 'y': got 'N'.*declares 'kN'"):
        run(tmp_path, 'file = "f.csv"\nunit = "N"')


NO_FUNCTIONS = [
    ("u = [0.0, 1.0]", "or file, got u"),
    ("u1 = [0.0, 1.0]\ny = [0.0, 1.0]", "or file, got u1, y"),
    ("", "or file, got nothing"),
    ("u = [0.0, 1.0]\ny = [[0.0, 1.0]]", "y: expected one number per entry of u"),
    ("u1 = [0.0, 1.0]\nu2 = [0.0, 1.0]\ny = [0.0, 1.0]", "y: expected one number per entry"),
    ('file = "f.csv"\ny = [0.0]', "expected either file or arrays, got both"),
    ('file = "f.csv"\ncolumns = ["a"]', "one or two columns of inputs and one of y, got 1"),
    ('file = "f.csv"\ncolumns = ["a", "d"]', "no column 'd'; available: a, b, c"),
    ('file = "f.csv"', r"each pair of 2 x 2 .*4 rows.*got 3 rows"),
    ('file = "g.csv"', r"each pair of 2 x 2 .*4 rows.*got 4 rows"),
]


def test_a_table_without_a_function_is_refused(tmp_path):
    """With what was expected and what was found."""

    def refuse(table):
        (tmp_path / "f.csv").write_text("a,b,c\n0,0,1\n1,0,3\n1,1,3\n")
        (tmp_path / "g.csv").write_text("a,b,c\n0,0,1\n1,0,3\n1,1,3\n1,1,4\n")
        run(tmp_path, table)

    check_refused(NO_FUNCTIONS, refuse, ScenarioError)
