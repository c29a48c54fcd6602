"""An observer that is designed on an FMU: as on the matrices, replayed from the log alone."""

import json
import math
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

import cosim
from cosim.errors import RunError, ScenarioError, UsageError
from cosim.fmi.linearizing.linearize import linearize, open_for_linearization
from cosim.fmi.linearizing.moving import MovingLinearization
from cosim.fmi.linearizing.request import LinearizationRequest
from cosim.fmi.reading.model_description import read
from cosim.scenario.assumptions.report import check_assumptions
from cosim.scenario.exporting import export_component
from cosim.scenario.kinds.observer_design import (
    MovingModel,
    design_model,
    model_toml,
    split,
)
from tests.fmi.pendulum import FRICTION, G, jacobian, pendulum
from tests.scenario.fmu_edits import rewritten
from tests.scenario.refusals import check_refused

pytestmark = pytest.mark.usefixtures("without_verdicts")

MODEL = {"fmu": "plant.fmu", "disturbance": "delta"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with the scenario, its plant as an FMU, and a pendulum."""
    folder = tmp_path_factory.mktemp("linearized")
    export_component("academic", "plant", folder / "plant.fmu")
    pendulum(folder / "pendulum.fmu", derivatives=True, level=False)
    (folder / "academic.toml").write_text(cosim.load("academic").document.text)
    return folder


@pytest.mark.slow
def test_an_observer_designed_on_the_fmu_is_the_one_of_the_matrices(folder):
    """The exported plant holds the reduced matrices bit for bit and linearizing it rounds nothing.

    Therefore theta has the same bits.
    """
    scenario = folder / "academic.toml"
    matrices = cosim.run(scenario)
    fmu = cosim.run(scenario, set={"observer.model": MODEL})
    for signal in ("observer.x_a", "observer.delta", "identifier.theta"):
        assert np.array_equal(fmu[signal], matrices[signal], equal_nan=True), signal


@pytest.mark.slow
def test_a_replay_needs_the_log_alone(folder, tmp_path):
    """The linearization is in the log: the FMU may be gone.

    Even a changed pole is designed on what was recorded.
    """
    shutil.copy(folder / "academic.toml", tmp_path)
    shutil.copy(folder / "plant.fmu", tmp_path)
    log = cosim.run(
        tmp_path / "academic.toml",
        set={"observer.model": MODEL, "scenario.stop": 8.0},
        out=tmp_path / "run.mcap",
    )
    (tmp_path / "plant.fmu").unlink()
    again = cosim.replay(log, out=tmp_path / "again.mcap")
    assert cosim.diff(log, again).equal
    assert cosim.diff(again, cosim.replay(again)).equal
    faster = cosim.replay(log, set={"observer.L": [6.0, 0.0]})
    assert not np.array_equal(faster["observer.x_a"], log["observer.x_a"])
    metadata = json.loads(log.metadata["cosim.component.observer"]["metadata"])
    assert len(metadata["linearization"]["sha256"]) == 64
    text = r"components\.observer: 'plant\.fmu': a replay opens no files"
    with pytest.raises(ScenarioError, match=text):
        cosim.replay(log, set={"observer.model.at": 1.0})
    with pytest.raises(ScenarioError, match=r"plant\.fmu"):
        cosim.replay(log, set={"observer.model.at": 1.0, "observer.model.fmu": "plant.fmu"})


START = {"theta": 0.5, "torque": 4.0}
SWING = f"""
scenario = {{{{ name = "swing", stop = 4.0, step = 1e-3 }}}}
[components]
torque = {{{{ kind = "constant", value = 4.0 }}}}
wind = {{{{ kind = "sine", amplitude = {{amplitude}}, rate = 2.0 }}}}
[components.plant]
kind = "fmu"
path = "pendulum.fmu"
interface_type = "me"
start = {{{{ theta = {math.asin(4.0 / 9.81)!r} }}}}
[components.observer]
kind = "unknown-input-observer"
model = {{model}}
poles = [-5.0]
x_a0 = [{math.asin(4.0 / 9.81)!r}, 0.0]
filter_rate = 1e4
[connections]
"plant.torque" = "torque.y"
"plant.wind" = "wind.y"
"observer.u" = "torque.y"
"observer.y" = "plant.y"
"""


def swing(folder, amplitude, **model):
    """Write a pendulum in a wind that the observer is to find."""
    table = {"fmu": "pendulum.fmu", "disturbance": "wind", **model}
    inline = json.dumps({"start": START, **table}).replace('": ', '" = ')
    (folder / "swing.toml").write_text(SWING.format(amplitude=amplitude, model=inline))
    return folder / "swing.toml"


@pytest.mark.slow
def test_an_observer_of_a_nonlinear_plant_errs_by_the_square_of_the_swing(folder):
    """It neglects G sin(theta)/2 dtheta^2: half the wind leaves a quarter, but for the next order.

    Linearized at rest under its torque, or away from it: the constants are part of the observer,
    which then errs by G sin(theta)/2 (1.5e-4)^2 = 5e-8 without wind.
    """

    def error(amplitude, **model):
        run = cosim.run(swing(folder, amplitude, **model))
        return abs(run["observer.delta"] - run["wind.y"]).max()

    rest = {"at": 300.0, "start": {"torque": 4.0}}
    assert 3.5 < error(0.5, **rest) / error(0.25, **rest) < 4.5
    assert error(0.0, start={"theta": 0.42, "omega": 0.1}) <= 1e-7


def test_the_signals_of_the_observer_have_the_units_of_the_fmu(folder):
    """One an element, or none where an element has none; what drives them is converted."""
    run = cosim.run(swing(folder, 0.1), set={"scenario.stop": 0.01})
    interface = run.channels["observer"].interface
    units = {s.name: s.unit for s in (*interface.inputs, *interface.outputs)}
    assert units == {"u": "N.m", "y": None, "x_a": None, "delta": "N.m", "z": None, "q": None}
    linear = linearize(folder / "pendulum.fmu", start={"theta": 0.5, "torque": 4.0})
    first, second = linear.states
    own = {**linear.units, first: "m", second: "2"}
    designed = design_model(replace(linear, units=own, bases={}), ["wind"])
    assert [unit.name for unit in designed.units["x_a"]] == ["m", "2"]
    del own[second]
    assert design_model(replace(linear, units=own), ["wind"]).units["x_a"] == ()


REFUSED = [
    ({**MODEL, "fmu": "no.fmu"}, r"components\.observer: .*no\.fmu"),
    ({**MODEL, "disturbance": "detla"}, r"observer: .*'detla' is not an input .*mean 'delta'"),
    ({**MODEL, "disturbance": ["delta", "delta"]}, r"disturbance 'delta' is named twice"),
    ({**MODEL, "inputs": ["u", "delta"]}, r"academic_plant: input 'delta' is named twice"),
    ({**MODEL, "outputs": ["yy"]}, r"academic_plant: no output 'yy'; did you mean 'y'\?"),
    ({**MODEL, "fmu": "nameless.fmu"}, r"academic_plant: .*'y'; did you mean 'y_m'\?.*: y_m, x_a"),
    ({**MODEL, "fmu": "cs.fmu"}, r".*cs\.fmu: is for co-simulation only"),
    ({"fmu": "plant.fmu"}, r"observer\.model('\])?: 'disturbance' is missing"),
    ({**MODEL, "output": ["y"]}, r"observer\.model\.output: unknown key 'output'"),
    (3, r"observer\.model('\])?: expected a string or a table, got 3"),
]


@pytest.mark.slow
def test_an_fmu_without_a_design_model_is_refused(folder, foreign2):
    """One clear error each, with the component, or the key of the table."""
    shutil.copy(foreign2, folder / "cs.fmu")
    rewritten(folder / "plant.fmu", folder / "nameless.fmu", ('name="y"', 'name="y_m"'))

    def refuse(model):
        cosim.run(folder / "academic.toml", set={"observer.model": model})

    check_refused(REFUSED, refuse, ScenarioError)


@pytest.mark.slow
def test_a_table_of_a_scenario_is_the_same_model(folder):
    """The printed [models] table, in the place of the shipped one; it lacks what is not there.

    y = x1 - u by its D gives the same theta; the plant's x is the x_a of the matrices.
    """
    table = model_toml(linearize(folder / "plant.fmu", outputs=["y"]), ["delta"])
    text = (folder / "academic.toml").read_text()
    before, _, rest = text.partition("[models.academic]")
    named = table.replace("[models.academic_plant]", "[models.academic]")
    rest = "\n[components.u]" + rest.partition("[components.u]")[2]
    rest = rest.replace("x_a0 =", "x0 =").replace(
        '"observer.x_a" = "plant.x_a"', '"observer.x" = "plant.x"'
    )
    (folder / "table.toml").write_text(before + named + rest)
    assert "# x: x_a[0], x_a[1]; u: u; delta: delta; y: y" in table
    matrices = cosim.run(folder / "academic.toml")
    run = cosim.run(folder / "table.toml")
    assert abs(run["identifier.theta"][-1] - matrices["identifier.theta"][-1]).max() <= 1e-9


def test_a_table_names_its_operating_point_and_what_it_lacks(folder):
    """The constants are named; what is not there is left out."""
    linearization = linearize(folder / "pendulum.fmu", outputs=["y"], start={"torque": 1.0})
    table = model_toml(linearization, ["wind"])
    assert "linearized at t = 0.0 s, theta = 0.5, omega = 0.0, torque = 1.0, wind = 0.0" in table
    assert f"it lacks c = {linearization.constants[0].tolist()} of x' = ... + c" in table
    assert f"Bu = {jacobian(0.5, 0.0, 1.0)[1][:, :1].tolist()}" in table
    assert "Bd" not in model_toml(linearization, [])


def test_disturbances_are_named_by_elements_or_by_ports_that_exist(tmp_path):
    """``f[1]`` and ``f[2]`` are the port ``f``."""

    def renamed(xml):
        return xml.replace('name="torque"', 'name="f[1]"').replace('name="wind"', 'name="f[2]"')

    path = pendulum(tmp_path / "names.fmu", derivatives=True, edit=renamed)
    linearization = linearize(path, outputs=["y"])
    assert split(linearization, ["f[2]"]) == ([0], [1])
    assert split(linearization, ["f"]) == ([], [0, 1])
    for name in ("f[", ""):
        message = re.escape(f"disturbance {name!r} is not an input of pendulum")
        with pytest.raises(UsageError, match=message):
            split(linearization, [name])


# --- linearized anew along the estimate ---


def far_swing(folder):
    """Write a swing of 1.3 rad, of which y and the height are measured; the start is not known."""
    far = cosim.load(swing(folder, 2.5, outputs=["y", "reach"]))
    y = ["plant.y", "plant.reach"]
    return far.set({"connections.observer.y": y, "observer.poles": [-4.0, -5.0]})


ANEW = {"observer.relinearize": True, "observer.x_a0": [0.0, 0.0], "observer.filter_rate": 1e3}
COARSE = {"scenario.step": 8e-3, "scenario.stop": 4.0}


def late_errors(run):
    """Return the largest errors of angle and wind in the second half."""
    late = run.time("observer.delta") > 2.0
    angle = np.abs(run["observer.x_a"][late, 0] - run["plant.angle"][late]).max()
    wind = np.abs(run["observer.delta"][late] - run["wind.y"][late]).max()
    return angle, wind


@pytest.mark.slow
def test_linearized_anew_the_estimates_converge_where_those_of_one_model_stay_wrong(folder):
    """The angle by three orders, the wind to what its filter lags."""
    scenario = far_swing(folder)
    fixed = late_errors(cosim.run(scenario, set={**ANEW, **COARSE, "observer.relinearize": False}))
    anew = late_errors(cosim.run(scenario, set={**ANEW, **COARSE}))
    # of second order in the step of 8 ms: some (8e-3)^2
    assert anew[0] < 1e-4
    assert fixed[0] > 1000.0 * anew[0]
    # the derivative of y belongs to a time half a step and 1/filter_rate earlier, 5 ms: times
    # y'', at most 17.1 rad/s^2 here
    assert anew[1] < 5e-3 * 17.2
    assert fixed[1] > 10.0 * anew[1]


def test_the_local_model_is_exact_at_its_point(folder):
    """Where torque and wind act on the outputs at once: the pendulum's own equations say so."""
    request = LinearizationRequest(outputs=["power", "push"])
    with open_for_linearization(read(folder / "pendulum.fmu"), {}) as fmu:
        model = MovingModel(MovingLinearization(fmu.instance, request), [0], [1])
        theta, omega, torque, wind = 0.4, 0.7, 4.0, -1.5
        x, u, delta = np.array([theta, omega]), np.array([torque, 1.0]), np.array([wind])
        local = model.local(0.0, x, u[:1], delta)
    push = -G * math.sin(theta) - FRICTION * omega + torque + wind
    dx = local.A_a @ x + local.B_1a @ u + local.B_2a @ delta
    y = local.C3 @ x + local.C4 @ u + local.C5 @ delta
    # sums of a few terms, the largest 5.6
    np.testing.assert_allclose(dx, [omega, push], atol=1e-14)
    np.testing.assert_allclose(y, [torque * omega, push], atol=1e-14)


def test_its_assumptions_are_decided_at_the_operating_point_alone(folder):
    """Where the estimate will be, and the model linearized, only the run knows."""
    report = check_assumptions(swing(folder, 2.5), set=ANEW)
    of_observer = [verdict for name, verdict in report.verdicts if name == "observer"]
    assert len(of_observer) == 4
    for verdict in of_observer:
        assert verdict.fulfilled is None
        assert "fulfilled at the operating point" in verdict.evidence


def test_a_replay_takes_it_from_the_log(folder, tmp_path):
    """Bits that depend on the processor are not promised: the outputs are those of the run."""
    shutil.copy(swing(folder, 2.5), tmp_path)
    shutil.copy(folder / "pendulum.fmu", tmp_path)
    short = {**ANEW, "scenario.step": 5e-3, "scenario.stop": 0.2}
    log = cosim.run(tmp_path / "swing.toml", set=short, out=tmp_path / "run.mcap")
    (tmp_path / "pendulum.fmu").unlink()
    again = cosim.replay(log, out=tmp_path / "again.mcap")
    assert cosim.diff(log, again).equal
    with pytest.raises(UsageError, match=r"observer\.filter_rate"):
        cosim.replay(log, set={"observer.filter_rate": 500.0})


def test_a_run_stops_where_the_disturbance_does_not_reach_the_outputs_any_more(folder):
    """d/dt power = torque omega' + ...: of a torque that passes zero it knows nothing there."""
    fading = {
        "torque": {"kind": "ramp", "offset": 4.0, "slope": -8.0},
        "connections.observer.y": ["plant.power", "plant.angle"],
        "observer.poles": [-4.0, -5.0],
    }
    path = swing(folder, 0.5, outputs=["power", "angle"])
    message = r"observer.*at the estimate x_a = \[\S+, \S+\] at t = 0\.5 s: .*Assumption 5"
    with pytest.raises(RunError, match=message):
        cosim.run(path, set={**ANEW, **fading, "scenario.step": 5e-3, "scenario.stop": 1.0})


OF_FMU = {"observer.relinearize": True, "observer.model": MODEL}
COMPENSATED = {
    "components.c": {"kind": "compensator", "poles": [-1.0, -2.0]},
    "connections.c.x_a": "observer.x_a",
}
ANEW_REFUSED = [
    ({"observer.relinearize": True}, "got the linear model 'academic'"),
    (OF_FMU | {"observer.filter": "consistent"}, 'relinearize: .*"first-order", .*\'consistent'),
    (OF_FMU | {"observer.q0": [0.0]}, "q0: not available with relinearize = true"),
    (OF_FMU, "'observer' is relinearized during the run, so y"),
    (OF_FMU | COMPENSATED, "'observer' is relinearized during the run; stability"),
    (OF_FMU | {"observer.x_a0": [0.0]}, "x_a0: expected 2 numbers, one per state of the FMU"),
]


def test_options_of_another_filter_or_model_are_refused(folder):
    """One clear error each, with the way out."""

    def refuse(changes):
        cosim.run(folder / "academic.toml", set=changes)

    check_refused(ANEW_REFUSED, refuse, ScenarioError)
    regression = OF_FMU | {"identifier.method": "least-squares", "identifier.start": 4.0}
    with pytest.raises(UsageError, match="relinearized during the run, so y has no fixed model"):
        cosim.design(folder / "academic.toml", set=regression, noise=1e-3)
    with pytest.raises(UsageError, match="relinearize = false"):
        export_component(far_swing(folder).set(ANEW), "observer", folder / "x.fmu")
