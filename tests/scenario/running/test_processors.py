"""Runs and replays have the same bits whatever instructions the processor has.

The C library, numpy and BLAS choose other code on other processors; where they can be told to
leave instructions out, one machine shows what another would compute.
"""

import json
import math
import os
import platform
import subprocess
import sys

import pytest

import cosim
from cosim.native.numerics.runge_kutta import EXPLICIT
from cosim.report.inspection import describe_log
from cosim.scenario.document.document import find, shipped
from cosim.scenario.exporting import export_component
from cosim.scenario.kinds.variants import METHODS
from tests.scenario.online import COARSE, ONLINE, noisy

EVERYTHING = """
scenario = { name = "everything", stop = 2.0, step = 1e-3, coupling = "gauss-seidel" }
[components]
jumps = { kind = "expression", discrete = true, y = ["sign(sin(9*t) - t/3)", "step(t - 1)"] }
noise = { kind = "noise", deviation = 0.1, seed = 7, size = 20 }
sine = { kind = "sine", rate = 30.0, phase = 0.1, unit = "deg" }
chirp = { kind = "chirp", rate = 3.0, sweep = 40.0 }
ramp = { kind = "ramp", slope = 0.7, start_time = 0.3 }
jump = { kind = "step", time = 0.5, after = 0.7 }
lag = { kind = "lag", time_constant = 0.07, unit = "rad" }
error = { kind = "sum", signs = [1, -0.7] }
loop = { kind = "lag", time_constant = 0.3 }
filtered = { kind = "lag", time_constant = 0.011, size = 20 }
table = { kind = "table", t = [0.0, 0.3, 1.1, 2.0], y = [0.1, -0.3, 1.9, 0.7] }

functions = { kind = "expression", y = [
  "sin(30*t + 1)", "cos(17*t)", "tan(3*t + 0.2)", "asin(0.9*sin(7*t))", "acos(0.9*cos(5*t))",
  "atan(9*t - 3)", "sinh(t - 1)", "cosh(2*t)", "tanh(t - 1)", "exp(-1.7*t)", "log(0.1 + t)",
  "(0.3 + t)**2.7", "sqrt(t)", "abs(t - 1)",
  "min(t, 1/3) + max(t, pi)",
] }

disturbance = { kind = "disturbance", terms = [
  { alpha = "1.35 + 0.25*sin(1.7*t)", family = "exponential", theta = -0.1, amplitude = 1.3 },
  { alpha = "1.1 + 0.2*cos(2.3*t)", family = "sine", theta = 2.3, phase = 0.4 },
] }

[components.sensor]
kind = "sensor"
delay = 1.3e-3
jitter = 0.3e-3
bias = [0.1, -0.2]
noise = 1e-3
lower = -1.7
upper = 1.9
bits = 10
dropout = 0.01
seed = 5
size = 2

[components.controller]
kind = "controller"
A = [[-3.1, 0.3], [0.7, -1.9]]
B = [[1.1], [0.3]]
C = [[0.9, -0.4]]
D = [[0.1]]

[connections]
"lag.u" = "sine.y"
"filtered.u" = "noise.y"
"sensor.u" = ["disturbance.y", "lag.y"]
"error.u1" = "disturbance.y"
"error.u2" = "loop.y"
"controller.u" = "error.y"
"loop.u" = { from = "controller.y", gain = 0.7, offset = 0.1 }
"""

# A child process prints numbers of the C library, and of each log: whether its replay is equal, and
# the content of a new run.
CHILD = """
import json, math, sys
from pathlib import Path
import cosim

folder, scenarios, stops = sys.argv[1:]
stops = json.loads(stops)
found = {"library": [f(x / 7.0).hex() for f in (math.sin, math.exp) for x in range(1, 4000)]}
for name, scenario in json.loads(scenarios).items():
    log = cosim.open_log(Path(folder) / f"{name}.mcap")
    again = cosim.run(scenario, out=Path(folder) / f"{name}-again.mcap", set=stops.get(name))
    replayed = cosim.diff(log, cosim.replay(log.path)).equal
    found[name] = [replayed, again.content_hash()]
print(json.dumps(found))
"""
# past the start of the identification at 6.461 s
SHORT = {name: {"scenario.stop": 7.0} for name in shipped()}
NEWTON = {"scenario.coupling": "newton", "scenario.stop": 1.0}
# where theta is wrong, the verdict on a long record costs more than all else
STOP = {"drem": 8.0, "gradient": 8.0}
BY_METHOD = {
    method: {**COARSE, "scenario.stop": STOP.get(method, 14.0), "identifier.method": method}
    for method in METHODS
    if method not in ("output-error", "least-squares")  # they are in "short"
}
# of an FMU of model exchange: these methods compute without BLAS, others say what they compute with
OF_FMU = {"scenario.stop": 2.0, "scenario.step": 0.04, "identifier.period": 0.04}
BY_SOLVER = {solver: {**OF_FMU, "plant.solver": solver} for solver in EXPLICIT}
BY_SOLVER["residual"] = {**OF_FMU, "plant.dae": "residual"}
IMPLICIT = {"Radau": "LAPACK", "BDF": "LAPACK", "LSODA": "ODEPACK", "CVode": "SUNDIALS"}
STOPS = {
    "short": {**SHORT, "online": COARSE, "newton": NEWTON},
    "methods": BY_METHOD,
    "solvers": BY_SOLVER,
    "whole": {"online": ONLINE},
}
DESIGNED = {"compensation"}  # its gains are LAPACK's: a new run has others, its replay has not
TUNABLES = "glibc.cpu.hwcaps=-FMA,-AVX2,-FMA4,-AVX,-AVX_Fast_Unaligned_Load"


def numpy_features():
    """Return the instruction sets that numpy uses here and can do without."""
    from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

    return " ".join(name for name in __cpu_dispatch__ if __cpu_features__[name])


def with_fmu(folder):
    """Write the example with its plant as an FMU that has both forms; return its path."""
    export_component("academic", "plant", folder / "plant.fmu", fmi="3", dae=True)
    text = find("academic").text
    swap = '[swap]\nplant = "plant.fmu#me"\n\n[connections]'
    (folder / "fmu.toml").write_text(text.replace("[connections]", swap, 1), encoding="utf-8")
    return str(folder / "fmu.toml")


def child(folder, scenarios, stops, variables):
    """Run the child process."""
    done = subprocess.run(
        [sys.executable, "-c", CHILD, folder, json.dumps(scenarios), json.dumps(stops)],
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc" or platform.machine() != "x86_64",
    reason="only glibc on x86-64 can be told to leave instructions out",
)
@pytest.mark.parametrize(
    "length", ["short", "methods", "solvers", pytest.param("whole", marks=pytest.mark.campaign)]
)
def test_runs_and_replays_have_the_same_bits_on_other_processors(length, tmp_path):
    """Replays are equal, and new runs, without FMA and AVX in the C library, numpy and BLAS.

    But for new runs with gains of LAPACK's.
    """
    everything = tmp_path / "everything.toml"
    everything.write_text(EVERYTHING, encoding="utf-8")
    scenarios = {name: name for name in shipped()} | {"everything": str(everything)}
    scenarios["online"] = noisy(tmp_path)
    if length == "short":
        scenarios["newton"] = "closed-loop"
    if length == "methods":
        scenarios = dict.fromkeys(BY_METHOD, scenarios["online"])
    if length == "solvers":
        scenarios = dict.fromkeys(BY_SOLVER, with_fmu(tmp_path))
    hashes = {}
    for name, scenario in scenarios.items():
        log = cosim.run(scenario, out=tmp_path / f"{name}.mcap", set=STOPS[length].get(name))
        hashes[name] = [True, "" if name in DESIGNED else log.content_hash()]
    other = {"GLIBC_TUNABLES": TUNABLES, "OPENBLAS_CORETYPE": "Nehalem"}
    other["NPY_DISABLE_CPU_FEATURES"] = numpy_features()
    found = child(tmp_path, scenarios, STOPS[length], other)
    library = [f(x / 7.0).hex() for f in (math.sin, math.exp) for x in range(1, 4000)]
    if found.pop("library") == library:
        pytest.skip("this processor has no instructions that its C library could leave out")
    for name in DESIGNED & found.keys():
        found[name][1] = ""
    assert found == hashes
    if length == "solvers":
        assert len({content for _, content in hashes.values()}) == len(BY_SOLVER)


@pytest.mark.slow
def test_a_log_says_what_the_bits_of_a_solver_depend_on(tmp_path):
    """Of a generated plant and of an FMU; of other solvers nothing, as they depend on nothing."""
    for scenario in ("academic", with_fmu(tmp_path)):
        for solver in (*(["exact"] if scenario == "academic" else []), *EXPLICIT, *IMPLICIT):
            settings = {"scenario.stop": 0.02, "plant.solver": solver}
            cosim.run(scenario, set=settings, out=tmp_path / "a.mcap", force=True)
            bits = describe_log(str(tmp_path / "a.mcap"))["metadata"]["plant"].get("bits", "")
            said = f"solver {solver} computes with {IMPLICIT.get(solver)}: "
            assert bits.startswith(said) if solver in IMPLICIT else bits == ""
