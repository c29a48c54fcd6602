"""Our models as FMUs: valid, simulated by another tool, clean under the sanitizers."""

import shutil
import subprocess
import zipfile
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu

from cosim.core.signals import Interface, Signal
from cosim.core.solver import LinearModel
from cosim.errors import FmuError
from cosim.fmi import export as exporting
from cosim.fmi.component import ModelExchange, load
from cosim.fmi.export import export
from cosim.fmi.generated import GeneratedUnit
from cosim.native import build
from tests.fmi.plant import FACE, A, B, C, D, grid, inputs, model, run, solution

NAMES = ("y", "x_a[0]", "x_a[1]", "x_b")


def test_exported_fmu_is_valid(exported):
    """The validator finds nothing; sources, headers and binary are inside."""
    assert validate_fmu(str(exported)) == []
    with zipfile.ZipFile(exported) as archive:
        names = set(archive.namelist())
    assert {"modelDescription.xml", "sources/fmi2.c", "sources/model.c", "sources/linear.c", "sources/cosim.h"} <= names
    assert "sources/fmi2Functions.h" in names
    assert any(name.startswith("binaries/") for name in names)


def simulate(path, kind, *, step, slope):
    t = grid(step)
    rows = np.array(list(zip(t, *inputs(t, slope).T, strict=True)), dtype=[("time", float), ("u", float), ("delta", float)])
    found = fmpy.simulate_fmu(
        str(path), stop_time=2.0, step_size=1e-3, output_interval=step, fmi_type=kind, solver="CVode", relative_tolerance=1e-10,
        input=rows, output=NAMES,
    )  # fmt: skip
    return np.asarray(found["time"]), np.column_stack([np.asarray(found[name]) for name in NAMES])


def test_fmpy_simulates_it_as_model_exchange(exported):
    """CVode at a relative tolerance of 1e-10 is within 1e-7 of the closed form; fmpy holds inputs, so they are constant here."""
    still = np.zeros(2)
    t, y = simulate(exported, "ModelExchange", step=0.01, slope=still)
    assert abs(y - solution(t, still)).max() < 1e-7


def test_fmpy_simulates_it_as_co_simulation(exported):
    """The FMU's own steps are exact; 1e-9 leaves room for fmpy's times. Its input derivatives take one input only."""
    still = np.zeros(2)
    t, y = simulate(exported, "CoSimulation", step=0.01, slope=still)
    assert abs(y - solution(t, still)).max() < 1e-9


def test_export_is_deterministic(exported, tmp_path):
    """The same model gives the same GUID and the same archive; another model another GUID."""
    again = export(model(), tmp_path / "again.fmu", name="academic").path
    assert again.read_bytes() == exported.read_bytes()
    export(
        LinearModel(FACE, model().states, 2.0 * A, B, C, D, np.zeros(2), np.zeros((2, 2))),
        tmp_path / "other.fmu",
        name="academic",
    )
    tokens = [fmpy.read_model_description(str(path)).guid for path in (again, tmp_path / "other.fmu")]
    assert tokens[0] != tokens[1]


def test_states_that_are_no_outputs_units_and_calculated_starts(tmp_path):
    """A model with a hidden state, units, and a start that follows the input: valid, and the same in both homes."""
    face = Interface(
        (Signal("force", unit="N", role="input"),), (Signal("v", unit="m/s"), Signal("twice", unit="N.m")), {"v": (), "twice": ()}
    )
    A, B = np.array([[0.0, 1.0], [-4.0, -0.5]]), np.array([[0.0], [1.0]])
    C, D = np.array([[0.0, 1.0], [2.0, 0.0]]), np.zeros((2, 1))
    hidden = LinearModel(face, ("position", "v"), A, B, C, D, np.array([0.5, 0.0]), np.array([[0.25], [0.0]]))
    path = export(hidden, tmp_path / "mass.fmu", name="mass", description="a mass <on> a spring & damper").path
    assert validate_fmu(str(path)) == []

    def force(t):
        return np.sin(t)[:, np.newaxis] + 1.0

    expected = run(ModelExchange(GeneratedUnit.of(hidden), "rk4"), step=0.01, held=np.array([False]), u=force)
    with load(path) as fmu:
        assert fmu.description["position"].initial == "calculated"
        shown = [(s.name, s.unit, s.role) for s in fmu.component.interface.outputs]
        assert shown == [("v", "m/s", "state"), ("twice", "N.m", "output"), ("position", None, "state")]
        assert np.array_equal(run(fmu.component, step=0.01, held=np.array([False]), u=force)[:, :2], expected)
    with load(path, mode="cs") as fmu:
        assert run(fmu.component, step=0.01, held=np.array([False]), u=force)[:, :2] == pytest.approx(expected, abs=1e-8)
    with pytest.raises(FmuError, match="'position' cannot be set at the start"):
        load(path, start={"position": 1.0})


def test_any_number_of_instances_at_once(exported):
    """Instances share nothing that changes."""
    with load(exported, mode="cs", instance_name="one") as one, load(exported, mode="cs", start={"x_a[1]": 0.0}) as two:
        first = run(one.component, step=0.1)
        run(two.component, step=0.05)
        assert np.array_equal(first, run(one.component, step=0.1))


def test_what_cannot_be_exported_is_refused(tmp_path):
    """Numbers that are not finite, names that are no identifiers, missing folders."""
    with pytest.raises(FmuError, match="matrix A holds NaN or infinity"):
        export(
            LinearModel(FACE, model().states, A * np.nan, B, C, D, np.zeros(2), np.zeros((2, 2))), tmp_path / "x.fmu", name="x"
        )
    with pytest.raises(FmuError, match="name 'my plant': needed an identifier of C"):
        export(model(), tmp_path / "x.fmu", name="my plant")
    with pytest.raises(FmuError, match=r"there is no folder .*missing; make it first"):
        export(model(), tmp_path / "missing" / "x.fmu", name="x")
    assert list(tmp_path.iterdir()) == []


def test_without_a_compiler_the_sources_are_written(tmp_path, monkeypatch):
    """The answer says how to compile them."""
    monkeypatch.setattr(build, "compiler", list)
    found = exporting.export(model(), tmp_path / "x.fmu", name="x")
    assert found.platform is None
    assert "no C compiler was found" in found.note
    assert "fmi2.c model.c linear.c -o" in found.note
    assert validate_fmu(str(found.path)) == []
    with pytest.raises(FmuError, match="no binary for this platform; found binaries for: none; needed binaries/"):
        load(found.path)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_sources_are_clean_under_warnings_and_sanitizers(exported, tmp_path):
    """A C driver goes through both kinds, states and refused calls; -Werror, address and undefined sanitizers."""
    with zipfile.ZipFile(exported) as archive:
        archive.extractall(tmp_path)
    sources = [str(tmp_path / "sources" / name) for name in exporting.SOURCES]
    flags = ["-std=c11", "-g", "-O1", "-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Wconversion", "-Werror"]
    sanitize = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    driver = str(Path(__file__).with_name("driver.c"))
    include = f"-I{tmp_path / 'sources'}"
    result = subprocess.run(
        ["gcc", *flags, *sanitize, include, driver, *sources, "-o", str(tmp_path / "driver"), "-lm"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    result = subprocess.run([str(tmp_path / "driver")], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
