"""Recordings of others in the place of the plant: samples of a file, fields of an MCAP."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import chi2

import cosim
from cosim.errors import ScenarioError
from cosim.log import open_log
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document
from cosim.scenario.record import (
    IDENTIFICATION,
    component_table,
    recorded_identification,
    recorded_warnings,
)
from cosim.scenario.running.identifying import identifier_record
from cosim.theory.plants.descriptor import reduce
from tests.log.crafting import put_together, take_apart
from tests.log.foreign_files import EPOCH, write_json
from tests.scenario.field_recordings import (
    BOTH,
    COUNT,
    LOOP,
    PLANT,
    STEP_NS,
    command,
    field_log,
    level,
)
from tests.scenario.refusals import check_refused
from tests.theory.academic import THETA, academic, alpha

STOP = 40.0
MILLIMETERS = {"plant.unit": {"y": "mm"}, "observer.unit": {"y": "m"}}
HALVED = {"connections.observer.y": {"from": "plant.y", "gain": 0.5}}
STEP = 1e-2
SIGMA = 2e-2
JITTER = 1e-4
# theta, the amplitudes, x(0): what is not known of the example
TRUTH = np.array([*THETA, 1.0, 1.0, 1.0, -1.0])


def outputs_at(t, unknowns):
    """Solve the example for m values of the unknowns, shape (6, m); return y, shape (N, m)."""
    reduced = reduce(academic())
    m = unknowns.shape[1]

    def rate(t, x):
        exponentials = np.exp(unknowns[:2] * t) * unknowns[2:4]
        forced = np.outer(reduced.B_2a[:, 0], alpha(np.array(t)) @ exponentials)
        forced += np.outer(reduced.B_1a[:, 0], np.full(m, np.sin(t)))
        return (reduced.A_a @ x.reshape(2, m) + forced).ravel()

    solution = solve_ivp(
        rate, (0.0, t[-1]), unknowns[4:].ravel(), method="DOP853", rtol=1e-12, atol=1e-12, t_eval=t
    )
    x = solution.y.reshape(2, m, len(t))
    return (np.tensordot(reduced.C3[0], x, axes=1) + reduced.C4[0, 0] * np.sin(t)).T


def written(folder, t, y, *, header="t,y", form="{!r},{!r}"):
    """Write samples as a CSV file; return its path."""
    path = folder / "field.csv"
    lines = [form.format(*row) for row in zip(t.tolist(), y.tolist(), strict=True)]
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
    return path


class Experiment:
    """Samples with jitter, 1 % of them lost, and the Cramer-Rao bound for those that are there."""

    def __init__(self, step, sigma):
        rng = np.random.default_rng(11)
        t = np.arange(round(STOP / step) + 1) * step
        t = t + rng.uniform(-JITTER, JITTER, len(t))
        kept = rng.random(len(t)) >= 0.01
        kept[[0, -1]] = True
        self.t = t[kept]
        self.t[0] = 0.0
        self.t[-1] = STOP
        h = 1e-5
        nearby = TRUTH[:, np.newaxis] + h * np.hstack([np.zeros((6, 1)), np.eye(6), -np.eye(6)])
        y = outputs_at(self.t, nearby)
        self.y = y[:, 0]
        self.sigma = sigma
        jacobian = (y[:, 1:7] - y[:, 7:]) / (2.0 * h)
        # an estimate rests on the samples before the last step
        jacobian = jacobian[self.t <= STOP - step]
        self.covariance = sigma**2 * np.linalg.inv(jacobian.T @ jacobian)[:2, :2]
        changes = {"scenario.step": step, "observer.filter_rate": 50.0, "identifier.period": STOP}
        self.scenario = cosim.load("academic").set(changes)

    def measured(self, seed):
        noise = np.random.default_rng(seed).standard_normal(len(self.t))
        return self.y + self.sigma * noise

    def written(self, folder, y, *, scale=1.0, **form):
        return written(folder, self.t, scale * y, **form)

    def run(self, path, changes=None, **options):
        swapped = self.scenario.swap(plant=path)
        return cosim.run(swapped.set(changes or {}), **options)


@pytest.fixture(scope="module")
def experiment():
    return Experiment(STEP, SIGMA)


@pytest.fixture(scope="module")
def plain(experiment, tmp_path_factory):
    """Return a run of the samples of seed 0, in the plainest form of a file, without verdicts."""
    folder = tmp_path_factory.mktemp("plain")
    path = experiment.written(folder, experiment.measured(0))
    return experiment.run(path, {"scenario.verdicts": False})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("step", "sigma", "seeds"),
    [(STEP, SIGMA, 6), pytest.param(1e-3, 1e-3, 200, marks=pytest.mark.campaign)],
)
@pytest.mark.usefixtures("without_verdicts")
def test_estimates_reach_the_bound_for_the_samples_that_are_there(step, sigma, seeds, tmp_path):
    """The errors over seeds, in units of the bound, are as chi-square says, up to 1.15."""
    experiment = Experiment(step, sigma)
    total = 0.0
    for seed in range(seeds):
        log = experiment.run(experiment.written(tmp_path, experiment.measured(seed)))
        error = log["identifier.theta"][-1] - THETA
        total += error @ np.linalg.inv(experiment.covariance) @ error
        deviations = np.sqrt(np.diag(experiment.covariance))
        # that of the noise is known to 1.1 % from 4000 samples; the bound is that at the estimate
        np.testing.assert_allclose(log["identifier.standard_error"][-1], deviations, rtol=0.08)
    # a run at 1.15 times the bound exceeds this once in a thousand cases
    assert total < 1.15**2 * chi2.isf(1e-3, 2 * seeds)
    assert total > 0.85**2 * chi2.isf(1 - 1e-3, 2 * seeds)


def test_the_verdict_knows_the_inputs_between_the_samples(experiment, tmp_path):
    """Of one sample in 20 the verdict has the estimate of the run, and the truth in its interval.

    Straight lines from sample to sample, of u and alpha, would move theta by far more. A later fit
    of the log is that of the run, the gain of the connection applied.
    """
    sparse = np.append(np.arange(0, len(experiment.t) - 1, 20), len(experiment.t) - 1)
    path = written(tmp_path, experiment.t[sparse], 2.0 * experiment.y[sparse])
    changes = {"plant.maximum_gap": 1.0, **HALVED}
    log = experiment.run(path, changes, out=tmp_path / "run.mcap")
    recorded = dict(log.results[IDENTIFICATION]["identifier"])
    parameters = recorded["parameters"]
    for parameter, true in zip(parameters, THETA, strict=True):
        assert parameter["verdict"] == "IDENTIFIABLE"
        assert parameter["lower"] <= true <= parameter["upper"]
    record = identifier_record(open_log(log.path))
    of_the_log = cosim.identify(log).assessment.to_dict()
    assert of_the_log == {key: recorded[key] for key in of_the_log}
    measured = record.data.t[record.data.measured[:, 0]]
    np.testing.assert_array_equal(measured, experiment.t[sparse])
    assert all(parameter["upper"] - parameter["lower"] < 1e-4 for parameter in parameters)
    values = [parameter["value"] for parameter in parameters]
    np.testing.assert_allclose(values, log["identifier.theta"][-1], atol=1e-6)


@pytest.mark.usefixtures("without_verdicts")
def test_the_samples_reach_the_identifier_as_they_are(experiment, tmp_path):
    """Each with its own time; only y at the communication points is on straight lines."""
    t = experiment.t
    y = experiment.measured(3)
    log = experiment.run(experiment.written(tmp_path, y))
    np.testing.assert_allclose(log["plant.y"], np.interp(log.time("plant.y"), t, y), atol=1e-12)
    times = log["plant.sample_times"]
    samples = log["plant.y_samples"]
    is_there = np.isfinite(times)
    np.testing.assert_array_equal(times[is_there], t)
    np.testing.assert_array_equal(samples[is_there], y)
    every = slice(None, None, len(times) - 1)  # the rows that the log keeps of the identifier
    np.testing.assert_array_equal(log["identifier.samples"], samples[every])
    np.testing.assert_array_equal(log["identifier.sample_times"], times[every])


@pytest.mark.slow
@pytest.mark.usefixtures("without_verdicts")
def test_a_log_replays_without_the_file(experiment, tmp_path):
    """Bit for bit: the samples are signals, and nothing else of the file is needed."""
    path = experiment.written(tmp_path, experiment.measured(4))
    out = tmp_path / "run.mcap"
    log = experiment.run(path, out=out)
    path.unlink()
    again = cosim.replay(out, out=tmp_path / "again.mcap")
    for signal in log:
        assert log[signal].tobytes() == again[signal].tobytes(), signal
    other = cosim.replay(out, set={"identifier.window": 30.0})
    assert not np.array_equal(other["identifier.theta"][-1], log["identifier.theta"][-1])
    assert open_log(out).steps == round(STOP / STEP)


@pytest.mark.parametrize(
    ("form", "names", "changes"),
    [
        ({"header": "t,x[0],x[1]", "form": "{0!r},0,{1!r}"}, {"observer.y": "x[1]"}, {}),
        ({"header": "t,level", "scale": 1e3}, {"plant.y": "level"}, MILLIMETERS),
        ({"scale": 2.0}, {}, HALVED),
    ],
)
@pytest.mark.usefixtures("without_verdicts")
def test_maps_units_and_gains_of_y_are_those_of_its_samples(
    experiment, plain, tmp_path, form, names, changes
):
    """An element of another name, a unit that the file has not, a gain of the connection."""
    path = experiment.written(tmp_path, experiment.measured(0), **form)
    log = cosim.run(experiment.scenario.swap(plant=path, map=names).set(changes))
    theta = plain["identifier.theta"][-1]
    np.testing.assert_allclose(log["identifier.theta"][-1], theta, rtol=1e-6)


@pytest.mark.usefixtures("without_verdicts")
def test_data_that_differ_from_the_model_are_warned_of(experiment, tmp_path):
    """Signals that the file lacks, connections that have no effect, and the units."""
    path = experiment.written(tmp_path, experiment.y, header="t,y [mm]")
    log = experiment.run(path)
    warnings = "\n".join(text for _, text in recorded_warnings(log))
    for text in (
        "has no 'plant.x_a': the report leaves out 'observer.x_a'",
        "has no inputs: the connections to u, delta are left out, and what [truth] compares with",
        "kind field-data (was model exchange)",
        "units that cannot be compared with what is connected: y unit mm",
    ):
        assert text in warnings
    assert "samples causality" not in warnings


def test_times_in_another_unit_are_suspected(experiment, tmp_path):
    """In ms without a unit two samples are left of 4000: no error, and a number neither."""
    path = experiment.written(tmp_path, experiment.y, form="{:.9f}e3,{!r}")
    changes = {"scenario.stop": 15.0, "identifier.period": 1.0}
    log = experiment.run(path, changes, out=tmp_path / "run.mcap")
    warnings = "\n".join(text for _, text in recorded_warnings(log))
    assert "2 of 3" in warnings
    assert "samples are within the run, 0 s to 15 s, as their median distance is 10" in warnings
    assert "are the times in another unit than s?" in warnings
    assert recorded_identification(log)["identifier"].problem


HALF = {
    "components.half": {"kind": "gain", "K": 1.0},
    "connections.half.u": "plant.y",
    "connections.observer.y": "half.y",
}
INTERPOLATED = "y is interpolated between the samples of 'plant'"
WRONG_OPTIONS = [
    ({"scenario.stop": 41.0}, "0.0 s to 41.0 s"),
    ({"plant.offset": 1.0}, "start_time = 0.0 and stop = 39.0 of [scenario] are inside"),
    ({"plant.maximum_gap": 1e-3}, "maximum_gap = 0.001 s"),
    ({"plant.time_unit": "ms"}, "from 0.0 s to 40.0 s, got 0.0 s to 0.04 s"),
    ({"plant.columns": {"y": "level"}}, "has no column 'level'"),
    ({"plant.columns": {"level": "y"}}, "'plant' has no output 'y'"),
    ({"connections.observer.y": {"from": "plant.y", "gain": [[1.0]]}}, INTERPOLATED),
    ({"connections.observer.y": "plant.y[0]"}, INTERPOLATED),
    (HALF, INTERPOLATED),
    ({"plant.kind": "field"}, "unknown kind 'field'; did you mean 'field-data'?"),
]


def test_wrong_options_are_refused(experiment, tmp_path):
    """Before the run, with the way out, in one line."""
    path = experiment.written(tmp_path, experiment.y)

    cases = [(changes, re.escape(text)) for changes, text in WRONG_OPTIONS]
    check_refused(cases, lambda changes: experiment.run(path, changes), ScenarioError)
    # it is no problem of the identifier, which asks how many samples there are
    with pytest.raises(ScenarioError, match=r"\A.*plant.*cannot be read.*\Z"):
        experiment.run(tmp_path / "missing.csv")


def test_too_many_samples_in_a_step_are_refused(experiment, tmp_path):
    """Every one of them has a place in the log, so there is a limit."""
    t = np.array([0.0, *(2.0 + 1e-6 * np.arange(1500)), *np.arange(2.1, 41.0, 0.1)])
    path = written(tmp_path, t, 0.0 * t)
    with pytest.raises(ScenarioError, match=r"at most 1000 .*1499 .*4000"):
        experiment.run(path, {"plant.maximum_gap": 3.0})


# --- an MCAP of another tool in the place of the plant, and of what drives it ---


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
    samples = np.arange(-50, COUNT) * 1e-2 - shift
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
    """Of a recording that is coarser than the step."""
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
WRONG_FIELDS = [
    (PLANT, {"plant.time": "stampp"}, "'/drive/state.stampp', message 1: "),
    ({}, {}, "expected a map, map={'PORT': '/topic.field'}, or columns"),
    ({"plant.y": "/drive/state.positio"}, {}, "did you mean '/drive/state.position'?"),
    ({"plant.y": "/drive/stat.x"}, {}, "no topic for '/drive/stat.x'"),
    ({"plant.y": "/drive/state"}, {}, "'/drive/state'"),
    ({"plant.y": "/drive/state.name"}, {}, "text"),
    (PLANT, {"plant.offset": 0.0}, "from 0.0 s to 3.0 s, got 1699999999.5 s to 1700000003.99 s"),
    (PLANT, {"plant.time_unit": "m"}, "such as ms, got 'm'"),
    (PLANT, {"plant.offset": -1e10}, "within 2**63 ns of the offset"),
    (BOTH, {U: {"from": "command.y", "gain": 2.0}}, "'plant.u' takes command.y with a gain"),
    (BOTH, {U: ["command.y", "model.y"]}, "takes 2 signals, command.y, model.y; expected one name"),
]


def test_wrong_options_of_fields_are_refused(loop, tmp_path):
    """Before the run, with the way out."""
    swapped = {"plant": str(field_log(tmp_path))}

    def refuse(names, changes):
        cosim.run(loop, swap=swapped, map=names, set=changes)

    cases = [(*case, re.escape(text)) for *case, text in WRONG_FIELDS]
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
    ("text", "u", "sevens"),
    [
        (VECTOR, "/cmd.values", ["one.y", "both.y"]),
        (TWO, ["/cmd.values[0]", "/cmd.values[1]"], ["one.y"]),
    ],
)
def test_elements_of_a_recorded_input_are_those_of_what_drove_it(tmp_path, text, u, sevens):
    """``command.y[1]`` becomes ``plant.u[1]``, a slice is one too; each signal has its own."""
    swap = {"plant": field_log(tmp_path)}
    scenario = parse(Document(text, "vector", tmp_path))
    log = cosim.run(scenario, swap=swap, map={**PLANT, "plant.u": u})
    assert log["plant.u"].shape == (101, 2)
    for signal in sevens:
        np.testing.assert_array_equal(log[signal], np.full(101, 7.0))


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
