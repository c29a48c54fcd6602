"""Our models as FMUs: valid, simulated by another tool, clean under the sanitizers."""

import hashlib
import shutil
import subprocess
import zipfile
from dataclasses import replace
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu

from cosim.core.linear import LinearModel
from cosim.core.signals import Interface, Signal
from cosim.errors import FmuError
from cosim.fmi.component import ModelExchange, load
from cosim.fmi.exporting import kernels
from cosim.fmi.exporting.export import export
from cosim.fmi.exporting.kernels import DiscreteModel
from cosim.fmi.generated import GeneratedInstance
from cosim.fmi.options import FmuOptions
from cosim.fmi.reading.model_description import read
from cosim.native import build
from cosim.native.estimation.alphas import AlphaSignal, PastAlphas
from cosim.native.estimation.regression import (
    LeastSquaresConstants,
    RecoveryConstants,
    RegressorConstants,
)
from cosim.native.numerics.expression import compile_expression
from cosim.native.numerics.linear import first_order_hold
from tests.fmi.dae import descriptor
from tests.fmi.identifiers import output_error
from tests.fmi.plant import (
    INTERFACE,
    STATIC,
    A,
    B,
    C,
    D,
    grid,
    inputs,
    model,
    run,
    solution,
    static,
)

NAMES = ("y", "x_a[0]", "x_a[1]", "x_b")


def test_exported_fmu_is_valid(exported):
    """The validator finds nothing; sources, headers and binary are inside."""
    assert validate_fmu(str(exported)) == []
    with zipfile.ZipFile(exported) as archive:
        names = set(archive.namelist())
    assert {
        "modelDescription.xml",
        "sources/fmi2.c",
        "sources/model.c",
        "sources/linear.c",
        "sources/cosim.h",
    } <= names
    assert "sources/fmi2Functions.h" in names
    assert any(name.startswith("binaries/") for name in names)


def simulate(path, interface_type, *, step, slope):
    t = grid(step)
    rows = np.array(
        list(zip(t, *inputs(t, slope).T, strict=True)),
        dtype=[("time", float), ("u", float), ("delta", float)],
    )
    result = fmpy.simulate_fmu(
        str(path),
        stop_time=2.0,
        step_size=1e-3,
        output_interval=step,
        fmi_type=interface_type,
        solver="CVode",
        relative_tolerance=1e-10,
        input=rows,
        output=NAMES,
    )
    columns = [np.asarray(result[name]) for name in NAMES]
    return np.asarray(result["time"]), np.column_stack(columns)


def test_fmpy_simulates_it_as_model_exchange(exported):
    """CVode at a relative tolerance of 1e-10 is within 1e-7 of the closed form.

    fmpy holds inputs, so they are constant here.
    """
    still = np.zeros(2)
    t, y = simulate(exported, "ModelExchange", step=0.01, slope=still)
    assert abs(y - solution(t, still)).max() < 1e-7


def test_fmpy_simulates_it_as_co_simulation(exported):
    """The FMU's own steps are exact; 1e-9 leaves room for fmpy's times.

    fmpy's input derivatives take one input only.
    """
    still = np.zeros(2)
    t, y = simulate(exported, "CoSimulation", step=0.01, slope=still)
    assert abs(y - solution(t, still)).max() < 1e-9


def with_dynamics(A):
    return LinearModel(INTERFACE, model().states, A, B, C, D, np.zeros(2), np.zeros((2, 2)))


@pytest.mark.slow
def test_export_is_deterministic(exported, tmp_path, monkeypatch):
    """The same model gives the same GUID and the same archive; another model another GUID.

    Also where nothing is kept of what was compiled, and all is compiled in one call.
    """
    monkeypatch.setenv("COSIM_CACHE", "")
    again = export(model(), tmp_path / "again.fmu", name="academic").path
    assert again.read_bytes() == exported.read_bytes()
    export(with_dynamics(2.0 * A), tmp_path / "other.fmu", name="academic")
    tokens = [
        fmpy.read_model_description(str(path)).guid for path in (again, tmp_path / "other.fmu")
    ]
    assert tokens[0] != tokens[1]


def test_states_that_are_no_outputs_units_and_calculated_states(tmp_path):
    """A model with a hidden state, units, and an initial state that follows the input.

    Its FMU is valid, and computes the same as the model in the package.
    """
    interface = Interface(
        (Signal("force", unit="N", role="input"),),
        (Signal("v", unit="m/s"), Signal("twice", unit="N.m")),
        {"v": (), "twice": ()},
    )
    A = np.array([[0.0, 1.0], [-4.0, -0.5]])
    B = np.array([[0.0], [1.0]])
    C = np.array([[0.0, 1.0], [2.0, 0.0]])
    D = np.zeros((2, 1))
    hidden = LinearModel(
        interface, ("position", "v"), A, B, C, D, np.array([0.5, 0.0]), np.array([[0.25], [0.0]])
    )
    path = export(
        hidden, tmp_path / "mass.fmu", name="mass", description="a mass <on> a spring & damper"
    ).path
    assert validate_fmu(str(path)) == []

    def force(t):
        return np.sin(t)[:, np.newaxis] + 1.0

    expected = run(
        ModelExchange(GeneratedInstance.of(hidden), "rk4"),
        step=0.01,
        held=np.array([False]),
        u=force,
    )
    with load(path, FmuOptions(solver="rk4")) as fmu:
        assert fmu.description["position"].initial == "calculated"
        shown = [(s.name, s.unit, s.role) for s in fmu.component.interface.outputs]
        assert shown == [
            ("v", "m/s", "state"),
            ("twice", "N.m", "output"),
            ("position", None, "state"),
        ]
        assert np.array_equal(
            run(fmu.component, step=0.01, held=np.array([False]), u=force)[:, :2], expected
        )
    with load(path, FmuOptions(interface_type="cs")) as fmu:
        assert run(fmu.component, step=0.01, held=np.array([False]), u=force)[
            :, :2
        ] == pytest.approx(expected, abs=1e-8)
    with pytest.raises(FmuError, match="'position' has no start value that can be set"):
        load(path, FmuOptions(start={"position": 1.0}))


def test_any_number_of_instances_at_once(exported):
    """Instances share nothing that changes."""
    with (
        load(exported, FmuOptions(interface_type="cs"), instance_name="one") as first_fmu,
        load(exported, FmuOptions(interface_type="cs", start={"x_a[1]": 0.0})) as second_fmu,
    ):
        first = run(first_fmu.component, step=0.1)
        run(second_fmu.component, step=0.05)
        assert np.array_equal(first, run(first_fmu.component, step=0.1))


def test_components_that_cannot_be_exported_are_refused(tmp_path):
    """Numbers that are not finite, names that are no identifiers, missing folders."""
    with pytest.raises(FmuError, match="matrix A holds NaN or infinity"):
        export(with_dynamics(A * np.nan), tmp_path / "x.fmu", name="x")
    with pytest.raises(FmuError, match="name 'my plant': expected a C identifier"):
        export(model(), tmp_path / "x.fmu", name="my plant")
    with pytest.raises(FmuError, match=r"no folder .*missing; create it first"):
        export(model(), tmp_path / "missing" / "x.fmu", name="x")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("fmi", ["2", "3"])
def test_without_a_compiler_the_sources_are_written(fmi, tmp_path, monkeypatch):
    """The notes say how to compile them."""
    monkeypatch.setattr(build, "compiler", list)
    result = export(model(), tmp_path / "x.fmu", name="x", fmi=fmi)
    assert result.platforms == ()
    assert "sources only" in result.lines[0]
    assert "no C compiler was found" in result.lines[1]
    assert f"fmi{fmi}.c instance.c continuous.c model.c linear.c -o" in result.lines[1]
    assert validate_fmu(str(result.path)) == []
    with pytest.raises(
        FmuError, match="no binary for this platform; found binaries for: none; expected binaries/"
    ):
        load(result.path)


def discrete(kernel, *, optional=False, size=1, step_ns=1_000_000):
    interface = Interface(
        (Signal("u", 1, role="input", optional=optional),),
        (Signal("y", size, optional=optional),),
        {},
    )
    return DiscreteModel(interface, kernel, step_ns, "it is discrete")


def products(alpha):
    past = PastAlphas(alphas=[alpha], ages=(0.0, 0.0025), h=0.001)
    return RegressorConstants(
        past, (0, 2), np.array([0, 1]), np.array([[1], [0]]), np.array([1.0, -1.0])
    )


def regressor():
    constants = products(compile_expression("1 + 0.5*sin(t)"))
    return discrete(kernels.regressor(constants), size=2, optional=True)


def regressor_with_signal():
    kernel = kernels.regressor(products(AlphaSignal("schedule.y", 0)))
    inputs = tuple(Signal(name, 1, role="input", optional=True) for name in ("delta", "alpha"))
    interface = Interface(inputs, (Signal("y", 2, optional=True),), {"y": ("delta", "alpha")})
    return DiscreteModel(interface, kernel, 1_000_000, "it is discrete")


def identifier():
    recovery = [RecoveryConstants(1, (0, 1), (0,), (1.0, -1.0), 0.001)]
    constants = LeastSquaresConstants(
        unknowns=1, start_time=0.002, information=1e-3, recovery=recovery, held=False
    )
    interface = Interface(
        (Signal("mu", 2, role="input", optional=True),),
        (Signal("theta", optional=True), Signal("eta", optional=True)),
    )
    return DiscreteModel(
        interface, kernels.least_squares(constants), 1_000_000, "it is discrete", steps_per_sample=3
    )


def sampled():
    own = first_order_hold(np.array([[-2.0]]), np.array([[1.0]]), 0.003, np.array([True]))
    kernel = kernels.sampled(own, C=np.array([[1.0]]), D=np.array([[0.5]]), X0=np.array([1.0]))
    return replace(discrete(kernel), steps_per_sample=3, zero_order_hold=True)


MODELS = {
    "plant": model,
    "static": lambda: static(STATIC, np.array([[1.0, 2.0], [0.0, -1.0]])),
    "regressor": regressor,
    "regressor-with-signal": regressor_with_signal,
    "identifier": identifier,
    "output-error": output_error,
    "sampled": sampled,
    "delay": lambda: discrete(kernels.delay(3, 1, None)),
    "limit": lambda: discrete(kernels.limit(-0.5, 0.5), step_ns=0),
    "descriptor": descriptor,
}
OF_VERSION = {"2": [name for name in MODELS if name != "descriptor"], "3": list(MODELS)}


WARNINGS = (
    "-std=c11",
    "-g",
    "-O1",
    "-Wall",
    "-Wextra",
    "-Wpedantic",
    "-Wshadow",
    "-Wconversion",
    "-Werror",
)
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory):
    """Compile C files with warnings and sanitizers; one that is the same in several FMUs once."""
    folder = tmp_path_factory.mktemp("sanitized")

    def compile_all(sources: list[Path], headers: Path) -> list[Path]:
        objects = []
        for source in sources:
            file = folder / f"{hashlib.sha256(source.read_bytes()).hexdigest()}.o"
            if not file.exists():
                compiled = subprocess.run(
                    ["gcc", *WARNINGS, *SANITIZERS, f"-I{headers}", "-c", source, "-o", file],
                    capture_output=True,
                    text=True,
                    check=False,
                )
                assert compiled.returncode == 0, compiled.stderr
            objects.append(file)
        return objects

    return compile_all


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
@pytest.mark.parametrize(
    ("name", "fmi"),
    [*((name, "2") for name in OF_VERSION["2"]), *((name, "3") for name in OF_VERSION["3"])],
)
def test_sources_are_clean_under_warnings_and_sanitizers(
    name, fmi, tmp_path, monkeypatch, sanitized
):
    """A C driver calls every function, also wrongly; -Werror, address and undefined sanitizers."""
    monkeypatch.setattr(build, "compiler", list)  # sources are enough
    path = export(MODELS[name](), tmp_path / "x.fmu", name="x", fmi=fmi).path
    assert validate_fmu(str(path)) == []
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path)
    sources = tmp_path / "sources"
    driver = Path(__file__).with_name("c") / f"drive_fmi{fmi}.c"
    objects = sanitized([driver, *sources.glob("*.c")], sources)
    for step in (
        ["gcc", *SANITIZERS, *objects, "-o", tmp_path / "driver", "-lm"],
        [tmp_path / "driver"],
    ):
        result = subprocess.run(step, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("gcc") is None or shutil.which("nm") is None, reason="needs gcc and nm"
)
@pytest.mark.parametrize("fmi", ["2", "3"])
def test_nothing_is_shared_by_instances_that_changes(fmi, tmp_path, monkeypatch):
    """No file has a variable outside the instance: nm finds no writable data.

    Memory is allocated by instance_new and by copies alone.
    """
    monkeypatch.setattr(build, "compiler", list)
    seen: set[bytes] = set()  # most files are the same for every model
    for name in OF_VERSION[fmi]:
        folder = tmp_path / name
        folder.mkdir()
        with zipfile.ZipFile(
            export(MODELS[name](), folder / "x.fmu", name="x", fmi=fmi).path
        ) as archive:
            archive.extractall(folder)
        new = [
            source for source in (folder / "sources").glob("*.c") if source.read_bytes() not in seen
        ]
        seen.update(source.read_bytes() for source in new)
        for source in new:
            subprocess.run(
                ["gcc", "-std=c11", "-fno-pie", "-c", source, "-o", folder / "x.o"],
                check=True,
            )
            symbols = subprocess.run(
                ["nm", folder / "x.o"], capture_output=True, text=True, check=True
            ).stdout
            kinds = {line.split()[-2] for line in symbols.splitlines()}
            assert not kinds & set("BbDdCc"), f"{source.name}: {symbols}"
            assert source.name in ("instance.c", f"fmi{fmi}.c") or "alloc" not in symbols
    assert {"instance.c", f"fmi{fmi}.c"} <= {
        source.name for source in (tmp_path / "plant" / "sources").iterdir()
    }


@pytest.mark.parametrize("fmi", ["2", "3"])
def test_the_archive_names_the_sources_that_are_there(fmi, tmp_path, monkeypatch):
    """SourceFiles of FMI 2.0, buildDescription.xml of FMI 3.0, as fmpy reads them.

    There is one set for both interface types.
    """
    monkeypatch.setattr(build, "compiler", list)
    path = export(model(), tmp_path / "x.fmu", name="x", fmi=fmi).path
    (configuration,) = fmpy.read_model_description(str(path)).buildConfigurations
    named = set()
    for group in configuration.sourceFileSets:
        named.update(group.sourceFiles)
    with zipfile.ZipFile(path) as archive:
        in_archive = {
            name.removeprefix("sources/") for name in archive.namelist() if name.endswith(".c")
        }
    assert named == in_archive


def test_arrays_of_fmi_3_are_the_scalars_of_fmi_2(tmp_path):
    """x_a[0], x_a[1] become x_a with the reference of the first, as do their derivatives.

    It depends on what either did.
    """
    path = export(model(), tmp_path / "x.fmu", name="x", fmi="3").path
    description = read(path).description
    assert [(v.name, v.reference, v.dimensions, v.start) for v in description.variables] == [
        ("u", 0, (), (0.0,)),
        ("delta", 1, (), (0.0,)),
        ("y", 2, (), None),
        ("x_a", 3, (2,), (1.0, -1.0)),
        ("x_b", 5, (), None),
        ("der(x_a)", 6, (2,), None),
        ("time", 10, (), None),
    ]
    assert description.states == ("x_a",)
    assert description.dependencies["y"] == ("u", "x_a")
    assert description.dependencies["der(x_a)"] == ("u", "delta", "x_a")
    assert set(description.initial_dependencies) == {"y", "x_b", "der(x_a)"}


def test_a_variable_called_time_is_refused_in_fmi_3(tmp_path):
    """FMI 3 has a variable of that name already."""
    interface = Interface((Signal("u", role="input"),), (Signal("time"),), {"time": ("u",)})
    gain = static(interface, np.ones((1, 1)))
    with pytest.raises(
        FmuError,
        match="a variable is called 'time', which in FMI 3 is the time; use FMI 2, or another name",
    ):
        export(gain, tmp_path / "x.fmu", name="x", fmi="3")


def test_an_instance_that_is_too_large_is_refused(tmp_path):
    """Steps need four matrices of states and inputs."""
    many = 4000
    interface = Interface((Signal("u", many, role="input"),), (Signal("y"),), {})
    wide = static(interface, np.zeros((1, many)))
    with pytest.raises(
        FmuError, match=r"x: an instance needs 256000001 numbers; the limit is 134217728"
    ):
        export(wide, tmp_path / "x.fmu", name="x")


def test_the_page_says_what_it_is(exported, tmp_path, monkeypatch):
    """Ports, matrices, how to compile; a discrete model, its step, and that NaN is no value."""
    with zipfile.ZipFile(exported) as archive:
        page = archive.read("documentation/index.html").decode()
    assert "x&#x27; = A x + B u" in page or "x' = A x + B u" in page
    assert "<td>delta</td><td>input</td>" in page
    assert "fmi2.c instance.c continuous.c model.c linear.c" in page
    monkeypatch.setattr(build, "compiler", list)  # the page is enough
    with zipfile.ZipFile(export(regressor(), tmp_path / "r.fmu", name="r").path) as archive:
        page = archive.read("documentation/index.html").decode()
    assert "NaN: no value yet" in page
    assert "Its communication step is 0.001 s, and no other." in page


def test_further_files_go_into_the_archive(tmp_path):
    """Such as the manifest of a layered standard."""
    path = export(
        model(),
        tmp_path / "x.fmu",
        name="x",
        fmi="3",
        extra={"extra/org.example/manifest.xml": b"<a/>"},
    ).path
    with zipfile.ZipFile(path) as archive:
        assert archive.read("extra/org.example/manifest.xml") == b"<a/>"
