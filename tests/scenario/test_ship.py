"""The dp-ship demo of the Open Simulation Platform, here and in libcosim: five FMUs of FMI 1.0.

They are no part of the project: ``COSIM_FMU_COLLECTION`` is a folder with a copy of
open-simulation-platform/demo-cases in it, however deep.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.core.recorders import Memory

COLLECTION = os.environ.get("COSIM_FMU_COLLECTION")
pytestmark = [
    pytest.mark.campaign,
    pytest.mark.skipif(not COLLECTION, reason="COSIM_FMU_COLLECTION is no folder of FMUs"),
]

STEP = 0.04  # s, of the demo
STEPS = 250
FMUS = {
    "controller": "DPController",
    "observer": "NLPobserver",
    "reference": "ReferenceGenerator",
    "thrust": "ThMPC",
    "ship": "OSOM",
}
AXES = ("x", "y", "psi")
CONNECTIONS = {  # of OspSystemStructure.xml, by element
    **{f"ship.Thrust_d[{i}]": f"thrust.F{i}c" for i in (1, 2, 3)},
    **{f"ship.input[{i}]": f"thrust.alpha{i}" for i in (1, 2)},
    **{f"controller.{axis}": f"observer.y_hat[{i}]" for i, axis in enumerate(AXES, 1)},
    **{f"controller.d{axis}": f"observer.v_hat[{i}]" for i, axis in enumerate(AXES, 1)},
    **{f"controller.{axis}_ref": f"reference.{axis}_ref" for axis in AXES},
    **{f"controller.d{axis}_ref": f"reference.d{axis}_ref" for axis in AXES},
    **{f"observer.y[{i}]": f"ship.q[{i}]" for i in (1, 2, 3)},
    **{f"observer.tau[{i}]": f"thrust.{force}g" for i, force in enumerate(("Fx", "Fy", "Mz"), 1)},
    **{f"thrust.ref{axis}": f"controller.Control{axis}" for axis in ("x", "y", "Mz")},
}
WAYPOINT = {"x_wp": 5.0, "y_wp": -3.0}  # m
WATCHED = ("ship.q", "observer.y_hat", "observer.v_hat")

LIBCOSIM = """
import json, sys
from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimLogging import CosimLogLevel, log_output_level
from libcosimpy.CosimObserver import CosimObserver
from libcosimpy.CosimSlave import CosimLocalSlave

task = json.loads(sys.stdin.read())
log_output_level(CosimLogLevel.ERROR)
execution = CosimExecution.from_step_size(step_size=round(task["step"] * 1e9))
observer = CosimObserver.create_last_value()
execution.add_observer(observer)
slaves, at = [], {}
for name, path in task["fmus"].items():
    slaves.append(CosimLocalSlave(fmu_path=path, instance_name=name))
    at[name] = execution.add_local_slave(slaves[-1])
for component, reference, value in task["starts"]:
    assert execution.real_initial_value(at[component], reference, value)
for source, output, target, input_ in task["connections"]:
    assert execution.connect_real_variables(at[source], output, at[target], input_) == 0
rows = []
for k in range(task["steps"]):
    execution.step()
    rows.append([observer.last_real_values(at[name], refs) for name, refs in task["watched"]])
json.dump(rows, open(task["result"], "w"))
"""


@pytest.fixture(scope="module")
def folder():
    return next(Path(COLLECTION).resolve().rglob("dp-ship/OSOM.fmu")).parent


@pytest.fixture(scope="module")
def descriptions(folder):
    from cosim.fmi.reading.model_description import read

    return {name: read(folder / f"{fmu}.fmu").description for name, fmu in FMUS.items()}


@pytest.fixture(scope="module")
def theirs(folder, descriptions, tmp_path_factory):
    """Return the watched outputs after every step, from a process of libcosim's own."""

    def reference(port):
        component, _, variable = port.partition(".")
        return component, descriptions[component][variable].reference

    watched = []
    for signal in WATCHED:
        component = signal.partition(".")[0]
        watched.append((component, [reference(f"{signal}[{i}]")[1] for i in (1, 2, 3)]))
    result = tmp_path_factory.mktemp("ship") / "rows.json"
    task = {
        "step": STEP,
        "steps": STEPS,
        "fmus": {name: str(folder / f"{fmu}.fmu") for name, fmu in FMUS.items()},
        "starts": [(*reference(f"reference.{name}"), v) for name, v in WAYPOINT.items()],
        "connections": [
            (*reference(source), *reference(target)) for target, source in CONNECTIONS.items()
        ],
        "watched": watched,
        "result": str(result),
    }
    subprocess.run(
        [sys.executable, "-c", LIBCOSIM], input=json.dumps(task), text=True, check=True, timeout=120
    )
    return np.array(json.loads(result.read_text())).reshape(STEPS, len(WATCHED), 3)


def scenario(folder, path):
    """Write the scenario: elements of one input are one connection with several sources."""
    lines = [
        f'[scenario]\nname = "ship"\nstop = {STEP * STEPS}\nstep = {STEP}\ncoupling = "jacobi"\n'
        'input_interpolation = "zero-order"\n'
    ]
    for name, fmu in FMUS.items():
        lines.append(f'[components.{name}]\nkind = "fmu"\npath = "{folder / fmu}.fmu"')
    starts = ", ".join(f"{name} = {value}" for name, value in WAYPOINT.items())
    lines.insert(4, f"start = {{ {starts} }}")
    inputs = {}
    for target, source in CONNECTIONS.items():
        element = source.replace("[1]", "[0]").replace("[2]", "[1]").replace("[3]", "[2]")
        inputs.setdefault(target.partition("[")[0], []).append(element)
    lines.append("[connections]")
    for target, sources in inputs.items():
        lines.append(f'"{target}" = {json.dumps(sources)}')
    path.write_text("\n".join(lines))
    return path


def test_the_ship_agrees_with_libcosim(folder, theirs, tmp_path):
    """Jacobi with held inputs, as there: the same calls with the same values.

    Only the times may differ by their last bit, 1.8e-15 s, which 250 steps at a speed below 1 m/s
    make 5e-13 of.
    """
    memory = cosim.run(scenario(folder, tmp_path / "ship.toml"), recorder=Memory())
    assert memory.status == "complete"
    for number, signal in enumerate(WATCHED):
        ours = memory[signal][1:]
        assert abs(theirs[:, number]).max() > 1e-4
        assert abs(ours - theirs[:, number]).max() < 1e-12, signal
