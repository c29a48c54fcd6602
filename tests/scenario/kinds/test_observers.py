"""Observers that are designed on an FMU, and on models in the general form."""

import json
import math
import re
import shutil
import tomllib
from dataclasses import replace

import numpy as np
import pytest

import cosim
from cosim.errors import RunError, ScenarioError, UsageError
from cosim.fmi.linearizing.linearize import linearize, open_for_linearization
from cosim.fmi.linearizing.moving import MovingLinearization
from cosim.fmi.linearizing.request import LinearizationRequest
from cosim.fmi.reading.model_description import read
from cosim.report.summary import summarize
from cosim.scenario.assumptions.report import check_assumptions
from cosim.scenario.exporting import export_component
from cosim.scenario.kinds.observer_design import MovingModel, design_model, model_toml, split
from cosim.scenario.record import component_record, recorded_warnings
from tests.fmi.pendulum import FRICTION, G, jacobian, pendulum
from tests.scenario.fmu_edits import rewritten
from tests.scenario.general_plant import GENERAL, MIXING_Q, PARTITIONED, X0, write
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


def test_a_table_names_its_operating_point_and_what_it_lacks(folder):
    """The constants are named; what is not there is left out; what is there has its matrices."""
    linearization = linearize(folder / "pendulum.fmu", outputs=["y"], start={"torque": 1.0})
    table = model_toml(linearization, ["wind"])
    assert "linearized at t = 0.0 s, theta = 0.5, omega = 0.0, torque = 1.0, wind = 0.0" in table
    assert f"it lacks c = {linearization.constants[0].tolist()} of x' = ... + c" in table
    assert f"Bu = {jacobian(0.5, 0.0, 1.0)[1][:, :1].tolist()}" in table
    assert "Bd" not in model_toml(linearization, [])
    plant = linearize(folder / "plant.fmu", outputs=["y"])
    table = model_toml(plant, ["delta"])
    assert "# x: x_a[0], x_a[1]; u: u; delta: delta; y: y" in table
    model = tomllib.loads(table)["models"]["academic_plant"]
    assert model["A"] == plant.A.tolist()
    assert np.hstack([model["Bu"], model["Bd"]]).tolist() == plant.B.tolist()
    assert (model["C"], model["Du"]) == (plant.C.tolist(), plant.D[:, :1].tolist())


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


# --- observers on models in the general form, of disturbances that reach y directly ---

OBSERVER = """
"observer.u" = "u.y"
"observer.y" = "plant.y"
[components.observer]
kind = "unknown-input-observer"
model = "m"
{keys}
[truth]
"observer.x" = "plant.x"
"observer.delta" = "delta.y"
"""
# the first disturbance is that of the example, the second one reaches its second output directly
DIRECT = """\
E = [[1, 0, 0], [0, 1, 0], [0, 0, 0]]
A = [[0, 1, 1], [0, -2, 1], [1, 0, 1]]
B = [[1, 0, 0], [0, 2, 1], [0, 1, 0]]
C = [[2, 0, 1], [0, 1, 0]]
D = [[0, 0, 0], [0, 0, 0.5]]
disturbances = [0, 2]
"""
SECOND = {"kind": "sine", "amplitude": 0.3, "rate": 3.0, "phase": 0.7}
FILTERS = {
    "first-order": "filter_rate = 1e4",
    "consistent": 'filter = "consistent"\nfilter_rate = 200.0',
    "savitzky-golay": 'filter = "savitzky-golay"\nhalf_width = 0.05',
}


@pytest.mark.parametrize("name", FILTERS)
def test_every_filter_reconstructs_both_disturbances(tmp_path, name):
    """Poles at -4 and the zero: after 3 s e^-6 of the start is left, times 1e-2 what lag leaves.

    The direct one follows y - x at once, or is averaged as the other is: one lag for all of delta.
    """
    keys = f"poles = [-4.0]\n{FILTERS[name]}\nx0 = [0.5, 0.0, 0.0]"
    more = OBSERVER.format(keys=keys)
    path = write(tmp_path / "direct.toml", DIRECT, "x0 = [1.0, -1.0, -1.0]", more)
    two = {"components.second": SECOND, "connections.plant.delta": ["delta.y", "second.y"]}
    two["truth.observer.delta"] = ["delta.y", "second.y"]
    log = cosim.run(path, set={**two, "scenario.step": 1e-3, "scenario.stop": 8.0})
    lag = {"first-order": 0, "consistent": 5, "savitzky-golay": 50}[name]
    delta = np.column_stack([log["delta.y"], log["second.y"]])
    late = 6000
    found = log["observer.delta"][late:]
    expected = delta[late - lag : len(delta) - lag]
    # first-order: rate 1e4, so w''/rate; averages: second order in the window
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-3)
    x = log["plant.x"]
    np.testing.assert_allclose(log["observer.x"][late:], x[late:], rtol=0, atol=1e-3)


def test_an_observer_in_any_coordinates_estimates_the_users_x(tmp_path):
    """E singular and mixed: x_hat converges to x at the rates of the gain and the zero, 4 and 2."""
    keys = "poles = [-4.0]\nfilter_rate = 1e3"
    more = OBSERVER.format(keys=keys)
    path = write(tmp_path / "mixed.toml", GENERAL, f"x0 = {X0.tolist()}", more)
    log = cosim.run(path, out=tmp_path / "mixed.mcap")
    error = np.abs(log["observer.x"] - log["plant.x"]).max(axis=1)
    t = log.time("plant.x")
    assert error[t == 2.0] < 2.0 * np.exp(-4.0) * error[0]
    assert error[t == 4.0] < 2.0 * np.exp(-8.0) * error[0]
    replayed = cosim.replay(log)
    np.testing.assert_array_equal(replayed["observer.x"], log["observer.x"])
    given = {"observer.x0": X0.tolist(), "delta.amplitude": 0.0}
    exact = cosim.run(path, set=given)
    np.testing.assert_allclose(exact["observer.x"][0], X0, rtol=0, atol=1e-13)
    # y is no straight line within a step of 1e-2: an error of its second order
    np.testing.assert_allclose(exact["observer.x"], exact["plant.x"], rtol=0, atol=1e-5)


def test_a_gain_is_one_of_the_users_states(tmp_path):
    """L of x has a row a state, or is a list of one column."""
    keys = "L = [[4.0], [0.0]]\nfilter_rate = 1e3"
    model = "A = [[-1, 1], [-1, -2]]\nBu = [[-1], [1]]\nBd = [[1], [0]]\nC = [[1, 0]]\nDu = [[-1]]"
    path = write(tmp_path / "gain.toml", model, "x0 = [1.0, -1.0]", OBSERVER.format(keys=keys))
    column = cosim.run(path)
    listed = cosim.run(path, set={"observer.L": [4.0, 0.0]})
    np.testing.assert_array_equal(column["observer.x"], listed["observer.x"])
    with pytest.raises(ScenarioError, match=r"L: expected shape \(2, 1\).*got \(1, 1\)"):
        cosim.run(path, set={"observer.L": [[4.0]]})


WHOLLY_DIRECT = "A = [[-1]]\nB = [[1, 0.5]]\nC = [[1]]\nD = [[0, 2]]\ndisturbances = [1]"
IDENTIFIED = """
"regressor.delta" = "observer.delta"
"identifier.regressor" = "regressor.mu"
[components.regressor]
kind = "regressor"
terms = [{ family = "sine" }]
delays = [0.0, 0.3, 0.6]
[components.identifier]
kind = "identifier"
method = "least-squares"
"""


def test_a_filter_of_no_derivative_is_not_needed(tmp_path):
    """Where y - x is 2 delta there is no q, and held inputs do no harm to a derivative.

    T_id is that of observer and delays; the one fixed mode is -1 - 0.5 / 2. Noise of y counts by
    1/2. The keys of the filter change nothing.
    """
    observer = '"observer.u" = "u.y"\n"observer.y" = "plant.y"'
    more = observer + IDENTIFIED + OBSERVER.format(keys="poles = []").replace(observer, "")
    path = write(tmp_path / "direct.toml", WHOLLY_DIRECT, "x0 = [1.0]", more)
    log = cosim.run(path, set={"scenario.stop": 10.0})
    assert "observer.q" not in log
    # e^-12.5 of the start, and y is no straight line within a step of 1e-2
    np.testing.assert_allclose(log["observer.delta"][-1], log["delta.y"][-1], rtol=0, atol=1e-5)
    times = component_record(log, "identifier").times
    assert times["T_f"] == 0.0
    assert times["T_id"] == pytest.approx(np.log(1e3) / 1.25 + 0.6)
    (reconstruction,) = summarize(log).reconstructions
    assert reconstruction.filter == "direct"
    assert reconstruction.bias.coefficient == 0.0
    np.testing.assert_allclose(reconstruction.noise_gain, [0.5], rtol=0.3)  # and what x hat adds
    held = {"scenario.stop": 1.0, "scenario.input_interpolation": "zero-order"}
    assert recorded_warnings(cosim.run(path, set=held)) == []
    useless = {"observer.filter_rate": 100.0, "observer.q0": [0.0]}
    same = cosim.run(path, set={"scenario.stop": 1.0, **useless})
    np.testing.assert_array_equal(same["observer.delta"], log["observer.delta"][: len(same["u.y"])])
    ((_, warning),) = recorded_warnings(same)
    assert warning.startswith("filter_rate and q0: without effect, as delta follows from y direct")


CALM = GENERAL.replace("disturbances = [0]", "")
THREE = DIRECT.replace("disturbances = [0, 2]", "disturbances = [0, 1, 2]")
RATE = "filter_rate = 1.0"
CHOSEN = 'filter = "auto"\nnoise = 0.1\namplitude = 1.0\nbandwidth = 1.0'
IMPOSSIBLE = [
    (CALM, f"poles = []\n{RATE}", "components.observer: expected a design model with a dist"),
    (THREE, f"poles = []\n{RATE}", "3 outputs"),
    (DIRECT, "poles = [-4.0]", "filter_rate is missing; filter = "),
    (GENERAL, f"poles = [-4.0]\n{RATE}\nx_a0 = [1.0, 2.0]", "x_a0: .*'m' .* expected x0"),
    (GENERAL, f"poles = [-4.0]\n{RATE}\nx0 = [1.0, 2.0]", r"\(3,\)"),
    (WHOLLY_DIRECT, f"poles = []\n{CHOSEN}", "filter = 'auto' .*, but delta feeds through"),
]


def test_an_observer_that_cannot_be_is_refused(tmp_path):
    """Before any run, with what is expected."""

    def refuse(model, keys):
        path = write(tmp_path / "wrong.toml", model, "x0 = [1.0]", OBSERVER.format(keys=keys))
        cosim.run(path)

    check_refused(IMPOSSIBLE, refuse, ScenarioError)


# --- initial states that the algebraic equations do not allow: made consistent, and said ---

PLAIN = """\
E = [[1, 0, 0], [0, 1, 0], [0, 0, 0]]
A = [[0, 1, 1], [0, -2, 1], [1, 0, 1]]
B = [[1, 0], [0, 2], [0, 1]]
C = [[2, 0, 1]]
disturbances = [0]
"""


def changes(run):
    """Return what a run says of its initial states."""
    return run.results.get("initial_states", {})


def test_an_inconsistent_entry_is_named_before_and_after(call, tmp_path):
    """x_b(0) = -x1 - u = -1 by the algebraic row; x1 and x2 stay as they are given.

    A replay and the command line say the same.
    """
    path = write(tmp_path / "x.toml", PLAIN, "x0 = [1.0, -1.0, 5.0]")
    log = cosim.run(path, out=tmp_path / "x.mcap")
    assert changes(log) == {"plant": [{"entry": "x[2]", "before": 5.0, "after": -1.0}]}
    np.testing.assert_allclose(log["plant.x"][0], [1.0, -1.0, -1.0], rtol=0, atol=1e-15)
    (message,) = [message for message in log.messages() if message.source == "plant"]
    assert message.level == "warning"
    assert message.text.endswith("E x0 is kept, and x[2] = 5 is -1")
    _, out, err = call("replay", "x.mcap", "--out", "again.mcap")
    assert "warning: plant: x0 does not fulfill the algebraic equations" in err
    assert "plant.x[2]\tinitial value -1 instead of 5 (x0)" in out
    _, out, _ = call("replay", "again.mcap", "--json")
    (change,) = json.loads(out)["changed_states"]
    assert change == {"component": "plant", "entry": "x[2]", "before": 5.0, "after": -1.0}


def test_in_mixed_coordinates_E_x0_is_what_is_kept(tmp_path):
    """Any other x0 with the same E x0 is the same run; entries that change are said."""
    E = np.diag([1.0, 1.0, 0.0]) @ MIXING_Q
    kernel = np.linalg.solve(MIXING_Q, [0.0, 0.0, 1.0])
    assert np.abs(E @ kernel).max() < 1e-15
    given = X0 + 2.0 * kernel
    log = cosim.run(write(tmp_path / "x.toml", GENERAL, f"x0 = {given.tolist()}"))
    np.testing.assert_allclose(log["plant.x"][0], X0, rtol=0, atol=1e-14)
    changed = {change["entry"]: change for change in changes(log)["plant"]}
    assert set(changed) == {f"x[{i}]" for i in range(3) if kernel[i] != 0.0}
    for i in range(3):
        assert changed[f"x[{i}]"]["before"] == given[i]


@pytest.mark.parametrize("window", [False, True])
def test_an_estimate_is_made_consistent_too(tmp_path, window):
    """x_b hat(0) = -x1 - u; a window has no x that follows delta yet, here x does not."""
    filter_keys = "filter_rate = 1e3"
    if window:
        filter_keys = 'filter = "savitzky-golay"\nhalf_width = 0.1'
    keys = f"poles = [-4.0]\n{filter_keys}\nx0 = [0.5, 0.0, 0.0]"
    observer = OBSERVER.format(keys=keys).partition("[truth]")[0]
    log = cosim.run(write(tmp_path / "x.toml", PLAIN, "x0 = [1.0, -1.0, -1.0]", observer))
    expected = [{"entry": "x[2]", "before": 0.0, "after": -0.5}]
    assert changes(log) == {"observer": expected}


@pytest.mark.parametrize(
    ("model", "initial"),
    [
        (GENERAL, f"x0 = {X0.tolist()}"),  # as computed: consistent to rounding
        (PARTITIONED, "x_a0 = [1.0, -1.0]"),
        ("A = [[-1.0]]\nB = [[1.0, 1.0]]\nC = [[1.0]]\ndisturbances = [1]", "x0 = [3.0]"),
    ],
)
def test_nothing_is_said_where_nothing_changes(tmp_path, model, initial):
    """A consistent x0, the form that has x_a0 alone, a regular E."""
    log = cosim.run(write(tmp_path / "x.toml", model, initial))
    assert changes(log) == {}
