"""Product, switch, integrator, transfer function, PID, discrete-time systems, and sensors."""

import re

import numpy as np
import pytest
from fmpy.validation import validate_fmu

import cosim
from cosim.errors import ScenarioError
from cosim.fmi.reading.model_description import read
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document
from cosim.scenario.exporting import export_component
from tests.scenario.refusals import check_refused

PARTS = """
scenario = { name = "parts", stop = 0.5, step = 1e-3 }
[components]
wave = { kind = "expression", y = ["sin(17*t)", "cos(9*t) + 1.3"] }
pulse = { kind = "expression", y = "step(t - 0.1) - step(t - 0.4)", discrete = true }
product = { kind = "product", operations = "*/", unit = "N" }
switch = { kind = "switch", size = 2 }
integrator = { kind = "integrator", initial = 0.01 }
limited = { kind = "integrator", initial = 0.01, upper = 0.05 }
filter = { kind = "transfer-function", numerator = [1.0, 300.0], denominator = [1.0, 50.0, 1e4] }
[components.pid]
kind = "pid"
gain = 2.0
integral_time = 0.05
derivative_time = 0.01
lower = -1.0
upper = 2.0
[components.digital]
kind = "pid"
gain = 2.0
integral_time = 0.05
derivative_time = 0.02
derivative_setpoint_weight = 0.1
lower = -1.0
upper = 2.0
period = 0.01
[components.discrete]
kind = "discrete-state-space"
period = 0.004
A = [[0.9, 0.1], [0.0, 0.8]]
B = [[0.0], [1.0]]
C = [[1.0, 0.0]]
D = [[0.5]]
x0 = [1.0, 0.0]
[connections]
"product.u1" = "wave.y[0]"
"product.u2" = "wave.y[1]"
"switch.u1" = "wave.y"
"switch.u2" = ["integrator.y", "limited.y"]
"switch.control" = "pulse.y"
"integrator.u" = "wave.y[0]"
"limited.u" = "wave.y[0]"
"filter.u" = "wave.y[0]"
"pid.setpoint" = "wave.y[0]"
"pid.measurement" = "filter.y"
"digital.setpoint" = "wave.y[0]"
"digital.measurement" = "filter.y"
"discrete.u" = "wave.y[1]"
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("parts")
    path = folder / "parts.toml"
    path.write_text(PARTS, encoding="utf-8")
    return path, cosim.run(path, out=folder / "parts.mcap")


def test_a_log_of_them_replays_bit_for_bit(recorded):
    """All that can be computed again is, with blocks of one size or another."""
    path, log = recorded
    assert cosim.diff(log, cosim.replay(log)).equal
    single = cosim.run(path, block=1)
    assert cosim.diff(log, single).equal


@pytest.mark.slow
def test_as_fmus_they_are_the_same(recorded, tmp_path):
    """A run with FMUs in their places records what the run recorded.

    The inputs at the end of a step are u0 + h (u1 - u0)/h there, which is u1 but for its rounding,
    and 500 of these add up.
    """
    names = ("switch", "limited", "filter", "discrete")
    path, expected = recorded
    swaps = {name: tmp_path / f"{name}.fmu" for name in names}
    for name, fmu in swaps.items():
        export_component(str(path), name, fmu, fmi="3")
        assert validate_fmu(str(fmu)) == []
        is_linear = name == "filter"
        assert ("me" in read(fmu).description.capabilities) == is_linear
    settings = {f"{name}.interface_type": "cs" for name in names}
    run = cosim.run(path, swap=swaps, set=settings)
    for name in names:
        known = expected[f"{name}.y"]
        difference = abs(run[f"{name}.y"][:: 4 if name == "discrete" else 1] - known)
        assert difference.max() <= 1e-13 * abs(known).max(), name


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


def test_a_sensor_without_errors_changes_nothing_behind_it():
    """The observer has the same bits as on the plant's own output: y is no zero-order hold."""
    run = cosim.run(measured())
    direct = cosim.run(PLANT)
    for name in ("observer.delta", "observer.x_a"):
        np.testing.assert_array_equal(run[name], direct[name])


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
    run = cosim.run(measured(period=0.1))
    np.testing.assert_array_equal(run.time("sensor.y"), np.arange(21) / 10.0)
    np.testing.assert_array_equal(run["sensor.y"], run["plant.y"][::100])


WRONG_VALUES = [
    ({"noise": 0.1}, ": seed: expected"),
    ({"delay": -1e-3}, "delay[^ ]*: expected a number >= 0, got -0.001"),
    ({"jitter": -1e-3, "seed": 1}, "jitter[^ ]*: expected a number >= 0, got -0.001"),
    ({"delay": 1.5e-10}, "1.5e-10 s"),
    ({"period": 1.5e-3}, "period of 'sensor': "),
]


def test_a_wrong_value_is_one_problem_of_the_component():
    def refuse(errors):
        cosim.run(measured(**errors))

    place = r"\Aset\['sensor'\]"
    cases = [(errors, rf"{place}[^\n]*{text}[^\n]*\Z") for errors, text in WRONG_VALUES]
    check_refused(cases, refuse, ScenarioError)
