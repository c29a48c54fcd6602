"""A member has the bits of its own run, in whatever order members are run in one process."""

import gc
import tempfile
import tracemalloc
from contextlib import contextmanager
from functools import cache
from itertools import takewhile

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import cosim
from cosim.errors import CosimError
from cosim.scenario.exporting import export_component
from cosim.studies.contracts import StudyMember, StudySubject
from cosim.studies.members import member_builder as builder_module
from cosim.studies.members.runner import open_runner
from tests.fmi.compiled import kept_folder
from tests.fmi.small import able, compiled
from tests.studies.members.sinks import Digest

ACADEMIC = {
    "initial state": {"plant.x_a0": [0.5, -2.0]},
    "one of it": {"plant.x_a0[1]": -0.5},
    "theta": {"delta.terms[0].theta": -0.2},
    "both": {"delta.terms[1].theta": -0.25, "plant.x_a0": [2.0, 0.0]},
    "seed": {"sensor.seed": 7},
    "noise": {"sensor.noise": 1e-2},
    "observer": {"observer.L": [3.0, 0.5]},
    "filter": {"observer.filter_rate": 200.0},
    "model": {"models.academic.A[0][1]": 1.25},
    "regressor": {"regressor.delays": [1.0, 2.0, 2.5]},
    "identifier": {"identifier.period": 0.2},
    "stop": {"scenario.stop": 3.5},
    "until": {"scenario.until": "plant.y < -1.0"},
    "action": {"actions": [{"at": 1.0, "signal": "sensor.u", "offset": 0.25}]},
    "interpolation": {"scenario.input_interpolation": "zero-order"},
    "wire": {"connections.observer.y": "plant.y"},
    "unstable observer": {"observer.L": [-4.0, 0.0]},
    "singular model": {"models.academic.A[2][2]": 0.0},
    "no such key": {"plant.xa": 1.0},
    "no such component": {"plent.x_a0": [1.0, 1.0]},
    "wrong size": {"plant.x_a0": [1.0]},
    "overflow": {"plant.x_a0": [1e308, 1e308]},
}
LOOP = """
[scenario]
name = "loop"
stop = 1.0
step = 0.01
coupling = "jacobi"
[components.one]
kind = "controller"
A = [[-0.9]]
B = [[0.5, 0.1]]
C = [[3.0]]
D = [[0.5, 0.0]]
x0 = [1.0]
[components.two]
kind = "controller"
A = [[-1.0]]
B = [[1.0]]
C = [[-1.0]]
x0 = [1.0]
[components]
reference = { kind = "sine", amplitude = 1.0, rate = 2.0 }
after = { kind = "lag", time_constant = 0.2, initial = 0.0 }
[connections]
"one.u" = ["two.y", "reference.y"]
"two.u" = "one.y"
"after.u" = "two.y"
"""
LOOPS = {
    "reference": {"reference.rate": 3.0},
    "in the loop": {"two.C": [[-1.5]]},
    "behind it": {"after.time_constant": 0.5},
    "refused": {"two.C": [[-31.0]], "two.B": [[10.0]], "two.D": [[-1.9]]},
    "noted": {"one.C": [[4.0]], "two.C": [[-7.0]]},
    "unstable": {"two.A": [[30.0]]},
    "warned": {"two.C": [[-31.0]], "two.B": [[10.0]], "scenario.coupling_check": "warn"},
    "newton": {"scenario.coupling": "newton"},
    "overflow": {"reference.amplitude": 1.7e308, "one.x0": [1.7e308]},
}
MIXED = """
scenario = {{ name = "mixed", stop = 0.5, step = 0.01 }}
[components]
u = {{ kind = "sine", amplitude = 1.0, rate = 3.0 }}
plant = {{ kind = "fmu", path = "{fmu}", start = {{ A = -1.0, B = 1.0, C = 1.0, x = 0.5 }} }}
count = {{ kind = "python", class = "counting:Counting", gain = 2.0 }}
loop = {{ kind = "lag", time_constant = 0.1, initial = 0.25 }}
[connections]
"plant.u" = {{ from = ["u.y", "loop.y"], gain = [[1.0, 0.5]] }}
"count.u" = "plant.y"
"loop.u" = "count.y"
"""
COUNTING = '''
import numpy as np

from cosim.core import Interface, Signal


class Counting:
    """y = gain u + calls / 1000; it does not forget its calls where it is initialized again."""

    interface = Interface(inputs=(Signal("u"),), outputs=(Signal("y", variability="discrete"),))

    def __init__(self, gain: float):
        if gain < 0.0:
            raise ValueError("a negative gain")
        self.gain = gain
        self.calls = 0

    def initialize(self, t, u):
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([self.gain * 0.0 + self.calls / 1000.0])

    def advance(self, t, h, u):
        self.calls += 1
        return np.array([self.gain * u[k, 0] + self.calls / 1000.0 for k in range(1, len(t))])[
            :, np.newaxis
        ]
'''
MIXTURES = {
    "source": {"u.amplitude": 2.0},
    "start": {"plant.start.x": 2.0},
    "parameter": {"plant.start.A": -3.0},
    "user's parameter": {"count.gain": 1.5},
    "user's error": {"count.gain": -1.0},
    "unknown variable": {"plant.start.q": 2.0},
    "lag": {"loop.time_constant": 0.3},
    "not finite": {"plant.start.x": 1.7e308, "count.gain": 1e3},
    "stop": {"scenario.stop": 0.25},
    "model": {"plant.interface_type": "me"},
}
FAULTS = """
scenario = { name = "faults", stop = 3.0, step = 1e-2, until = "plant.y > 2.5" }
actions = [
  { at = 0.5, signal = "pid.measurement", offset = 0.2 },
  { at = 1.0, signal = "plant.u", noise = 0.1, seed = 3 },
  { when = "plant.y > 0.8", signal = "pid.setpoint", override = 0.5 },
  { at = 2.0, signal = "plant.u", release = true },
]
[components]
setpoint = { kind = "constant", value = 1.0 }
pid = { kind = "pid", gain = 2.0, integral_time = 1.0, lower = -3.0, upper = 3.0 }
plant = { kind = "lag", time_constant = 0.5, initial = 0.0 }
[connections]
"pid.setpoint" = "setpoint.y"
"pid.measurement" = "plant.y"
"plant.u" = "pid.y"
"""
FAULT_EDITS = {
    "gain": {"pid.gain": 3.0},
    "setpoint": {"setpoint.value": 4.0},
    "plant": {"plant.time_constant": 0.3},
    "action": {"actions.0.offset": 0.3},
    "seed": {"actions[1].seed": 4},
    "until": {"scenario.until": "plant.y > 0.5"},
    "refused": {"pid.gain": 1e3, "plant.time_constant": 0.02},
}
SWAPPED = {
    "theta": {"delta.terms[0].theta": -0.2},
    "initial state": {"plant.start": {"x_a[0]": 0.5, "x_a[1]": -2.0}},
    "observer": {"observer.L": [3.0, 0.5]},
    "no such variable": {"plant.start.q": 1.0},
    "stop": {"scenario.stop": 0.5},
}


@cache
def folder():
    """Return where the scenarios are."""
    path = kept_folder()
    (path / "loop.toml").write_text(LOOP)
    (path / "counting.py").write_text(COUNTING)
    fmu = able(compiled(path, "COUNTS"), path / "once.fmu", "once", "state", "slopes", D=0.0)
    (path / "mixed.toml").write_text(MIXED.format(fmu=fmu.name))
    (path / "faults.toml").write_text(FAULTS)
    return path


@cache
def plant():
    """Return an FMU of the academic plant."""
    path = kept_folder() / "plant.fmu"
    export_component("academic", "plant", path)
    return str(path)


SUBJECTS = {
    "faults": (lambda: StudySubject(str(folder() / "faults.toml")), FAULT_EDITS),
    "swapped": (
        lambda: StudySubject(
            "academic",
            set={"scenario.stop": 1.0},
            swap={"plant": plant()},
            map={"plant.y": "y"},
        ),
        SWAPPED,
    ),
    "academic": (
        lambda: StudySubject("academic-noisy", set={"scenario.stop": 4.0, "scenario.step": 0.01}),
        ACADEMIC,
    ),
    "loop": (lambda: StudySubject(str(folder() / "loop.toml")), LOOPS),
    "mixed": (lambda: StudySubject(str(folder() / "mixed.toml")), MIXTURES),
}
COSTLY = ("academic", "swapped")
NAMES = [
    pytest.param(name, marks=pytest.mark.slow) if name in COSTLY else name for name in SUBJECTS
]


@pytest.fixture
def temporary_folders(tmp_path, monkeypatch):
    """Return where temporary folders are made."""
    folder()
    made = tmp_path / "temporary"
    made.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(made))
    return made


@cache
def alone(name, member):
    """Return what a member comes to in a run of its own: status, reason, steps and all bits."""
    make, edits = SUBJECTS[name]
    subject = make()
    digest = Digest()
    changes = {**subject.set, **edits.get(member, {})}
    try:
        cosim.run(
            subject.scenario, set=changes, swap=subject.swap, map=subject.map, recorder=digest
        )
    except CosimError as error:
        return "failed", str(error), digest.steps
    return "complete", digest.reason, digest.steps, digest.values()["digest"]


def found(outcome):
    """Return the same of an outcome."""
    if outcome.status == "failed":
        return "failed", outcome.reason, outcome.steps
    return "complete", outcome.reason, outcome.steps, outcome.metrics["digest"]


@pytest.mark.fast("loop")
@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=6, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_member_has_the_bits_of_its_own_run_in_any_order(name, data):
    """Also behind members that fail, and where another one of the same values was run before."""
    make, edits = SUBJECTS[name]
    members = data.draw(st.lists(st.sampled_from(["as it is", *edits]), min_size=3, max_size=8))
    with open_runner(make(), sink_of=Digest) as runner:
        for number, member in enumerate(members):
            outcome = runner.run(StudyMember(number, edits.get(member, {})))
            assert found(outcome) == alone(name, member), (number, member)


@pytest.mark.fast("mixed")
@pytest.mark.parametrize("name", NAMES)
def test_every_member_has_the_bits_of_its_own_run(name):
    """One behind the other, and back."""
    make, edits = SUBJECTS[name]
    with open_runner(make(), sink_of=Digest) as runner:
        for member in ["as it is", *edits, *reversed(edits), "as it is"]:
            outcome = runner.run(StudyMember(0, edits.get(member, {})))
            assert found(outcome) == alone(name, member), member


KEPT = {
    "faults": {"as it is", "gain", "setpoint", "plant"},
    "swapped": {"as it is", "theta", "initial state", "observer"},
    "academic": {
        *("as it is", "initial state", "one of it", "theta", "both", "seed", "noise", "observer"),
        *("filter", "model", "regressor", "overflow"),
    },
    "loop": {"as it is", "reference", "in the loop", "behind it", "noted", "unstable", "overflow"},
    "mixed": {"as it is", "source", "start", "parameter", "user's parameter", "lag", "not finite"},
}


@pytest.mark.parametrize("name", NAMES)
def test_the_graph_is_built_once(name, monkeypatch):
    """Only what changes more than tables of components and models is built as a whole."""
    make, edits = SUBJECTS[name]
    whole = []
    build = builder_module.build_experiment

    def counted(*arguments, **options):
        whole.append(member)
        return build(*arguments, **options)

    monkeypatch.setattr(builder_module, "build_experiment", counted)
    with open_runner(make(), sink_of=Digest) as runner:
        for member in ["as it is", *edits]:
            runner.run(StudyMember(0, edits.get(member, {})))
    assert KEPT[name].isdisjoint(whole)


@contextmanager
def traced_memory():
    """Trace allocations, and no longer than for this."""
    tracemalloc.start()
    try:
        yield
    finally:
        tracemalloc.stop()


LEAVING = [MIXTURES[name] for name in ("source", "start", "user's error", "not finite", "stop")]


def test_no_temporary_folder_stays_of_members(temporary_folders):
    """One of the runner is there while it is open."""
    with open_runner(SUBJECTS["mixed"][0]()) as runner:
        for number, changes in enumerate(LEAVING):
            runner.run(StudyMember(number, changes))
        assert len(list(temporary_folders.iterdir())) == 1
    assert list(temporary_folders.iterdir()) == []


@pytest.mark.slow
def test_no_memory_stays_of_members():
    """Nor of those that fail."""
    members = LEAVING

    def run_all(runner, times):
        for number in range(times):
            runner.run(StudyMember(number, members[number % len(members)]))
        gc.collect()

    def growth(runner):
        """Return by how many bytes a window of members grew."""
        before, _ = tracemalloc.get_traced_memory()
        run_all(runner, 50)
        after, _ = tracemalloc.get_traced_memory()
        return after - before

    with open_runner(SUBJECTS["mixed"][0]()) as runner:
        with traced_memory():  # from the first member on: what replaces other memory is no growth
            run_all(runner, 55)
            objects = len(gc.get_objects())
            # What is kept of each member is in every window; a slab or a larger table is in one.
            grown = list(takewhile(lambda size: size >= 50 * 100, map(growth, [runner] * 8)))
            assert len(grown) < 8, grown
        assert len(gc.get_objects()) <= objects + 20
