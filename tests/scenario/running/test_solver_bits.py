"""What the bits of a run depend on: not on BLAS, or the log says so."""

import hashlib
import json
import os
import subprocess
import sys

import pytest

import cosim
from cosim.native.numerics.runge_kutta import EXPLICIT
from cosim.report.inspection import describe_log
from cosim.scenario.exporting import export_component

# Kernels of OpenBLAS with AVX2 and SSE; that with AVX-512 is a further one of the same kind.
KERNELS = pytest.mark.parametrize(
    "kernels",
    [
        ("Haswell", "Nehalem"),
        pytest.param(("Haswell", "SkylakeX"), marks=pytest.mark.campaign),
    ],
    ids="-".join,
)

CHILD = """
import json, sys
from pathlib import Path
import cosim
fmu, folder, *solvers = sys.argv[1:]
results = {}
for solver in solvers:
    settings = {"scenario.stop": 2.0, "scenario.step": 0.04, "plant.solver": solver}
    settings["identifier.period"] = 0.04
    if solver == "residual":
        settings["plant.dae"] = settings.pop("plant.solver")
    log = cosim.run(
        "academic", swap={"plant": fmu + "#me"}, set=settings, out=Path(folder) / (solver + ".mcap")
    )
    signals = ("plant.y", "plant.x_a", "plant.x_b")
    results[solver] = [log[signal].tobytes().hex() for signal in signals]
print(json.dumps(results))
"""


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    path = tmp_path_factory.mktemp("fmus") / "academic.fmu"
    export_component("academic", "plant", path, fmi="3", dae=True)
    return path


@pytest.mark.slow
@KERNELS
def test_explicit_methods_and_the_residual_form_give_the_same_bits_whatever_blas_computes_with(
    kernels, plant, tmp_path
):
    """Of a model exchange FMU over 50 steps, in processes whose BLAS takes other instructions."""
    results = {}
    for kernel in kernels:
        folder = tmp_path / kernel
        folder.mkdir()
        result = subprocess.run(
            [sys.executable, "-c", CHILD, str(plant), str(folder), *EXPLICIT, "residual"],
            env={**os.environ, "OPENBLAS_CORETYPE": kernel},
            capture_output=True,
            text=True,
            check=True,
        )
        results[kernel] = json.loads(result.stdout)
    first = results[kernels[0]]
    assert len({hashlib.sha256("".join(rows).encode()).digest() for rows in first.values()}) == 6
    for kernel in kernels:
        assert results[kernel] == first


IMPLICIT = {"Radau": "LAPACK", "BDF": "LAPACK", "LSODA": "ODEPACK", "CVode": "SUNDIALS"}


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["exact", *EXPLICIT, *IMPLICIT])
def test_a_log_says_what_the_bits_of_a_solver_depend_on(solver, plant, tmp_path):
    """Of a generated plant and of an FMU; of other solvers nothing, as they depend on nothing."""
    settings = {"scenario.stop": 0.02, "plant.solver": solver}
    for swap in ({}, {"plant": f"{plant}#me"}) if solver != "exact" else ({},):
        log = tmp_path / f"{len(swap)}.mcap"
        cosim.run("academic", swap=swap, set=settings, out=log)
        bits = describe_log(str(log))["metadata"]["plant"].get("bits", "")
        said = f"solver {solver} computes with {IMPLICIT[solver]}: " if solver in IMPLICIT else ""
        assert bits[: len(said) or None] == said
