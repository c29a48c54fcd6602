"""The components of the shipped scenarios as FMUs: the same numbers, by us and by fmpy."""

from ctypes import c_double, c_uint32

import fmpy
import numpy as np
import pytest
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu

import cosim
from cosim.core.contracts import prepare
from cosim.core.linear import Linear
from cosim.errors import CosimError
from cosim.fmi.component import ModelExchange, load
from cosim.fmi.generated import GeneratedInstance
from cosim.fmi.options import FmuOptions
from cosim.fmi.reading.model_description import read
from cosim.scenario.document.document import find
from cosim.scenario.exporting import export_component
from tests.scenario.exported import (
    ACADEMIC,
    COMPONENTS,
    START,
    STATES,
    STOP,
    H,
    case,
    drive,
    export,
)
from tests.scenario.refusals import check_refused

FMI = pytest.mark.parametrize("fmi", ["2", "3"])
LINEAR = pytest.mark.parametrize(
    ("key", "name"),
    [STATES[0], *(pytest.param(*component, marks=pytest.mark.slow) for component in STATES[1:])],
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("exported")


def relative(values, expected):
    """Return the largest difference relative to each column's largest value.

    No value must be no value in both.
    """
    assert np.array_equal(np.isnan(values), np.isnan(expected))
    known = ~np.isnan(expected).all(axis=1)
    largest = np.maximum(np.nanmax(abs(expected[known]), axis=0, initial=0.0), 1e-300)
    return np.nanmax(abs(values[known] - expected[known]) / largest, initial=0.0)


@FMI
@pytest.mark.parametrize(("key", "name"), COMPONENTS)
def test_fmpy_finds_no_problems(key, name, fmi, folder):
    """Schema, names, structure, start values, units; the interface types fit the component."""
    path = export(key, name, fmi, folder)
    assert validate_fmu(str(path)) == []
    description = fmpy.read_model_description(str(path), validate=True)
    assert description.coSimulation is not None
    assert (description.modelExchange is None) == (
        name in ("regressor", "identifier") or key in ("sampled", "step")
    )


@pytest.mark.fast("academic-plant-3")
@FMI
@pytest.mark.parametrize(("key", "name"), COMPONENTS)
def test_co_simulation_by_us_gives_what_the_component_gave(key, name, fmi, folder):
    """Bit for bit where the inputs are interpolated linearly.

    In steps this small u0 + h (u1 - u0)/h is u1 but near its zeros, and there it is 1e-16. Held
    inputs cost rounding: their two columns of the discretization are added at each step, not once.
    """
    original = case(key, name)
    with load(export(key, name, fmi, folder), FmuOptions(interface_type="cs")) as fmu:
        y = drive(fmu.component, original)
    assert relative(y, original.y) <= 1e-12
    if not original.held.any():
        assert np.array_equal(y, original.y, equal_nan=True)


@pytest.mark.fast("academic-plant-3")
@FMI
@LINEAR
def test_model_exchange_by_us_has_the_bits_of_the_component_with_the_same_solver(
    key, name, fmi, folder
):
    """rk4 on the FMU and rk4 on the component call the same C."""
    original = case(key, name)
    expected = drive(ModelExchange(GeneratedInstance.of(original.model), "rk4"), original)
    with load(export(key, name, fmi, folder), FmuOptions(interface_type="me", solver="rk4")) as fmu:
        assert np.array_equal(drive(fmu.component, original), expected)


def rows(original, held=None):
    """Return recorded inputs, or constant ones, as fmpy takes them."""
    u = original.u if held is None else np.tile(held, (len(original.u), 1))
    columns_of = original.component.interface.input_columns()
    signals = original.component.interface.inputs
    return u, [(s.name, s.size, u[:, columns_of[s.name]]) for s in signals]


def by_fmpy(path, interface_type, original, named, stop):
    """Simulate with fmpy alone; the outputs side by side."""
    arrays = fmpy.read_model_description(str(path)).fmiVersion.startswith("3")
    fields = [("time", float)]
    values = [original.t]
    for name, size, u in named:
        if size == 1 or arrays:
            fields.append((name, float) if size == 1 else (name, float, (size,)))
            values.append(u[:, 0] if size == 1 else u)
        else:
            fields += [(f"{name}[{i}]", float) for i in range(size)]
            values += list(u.T)
    table = np.zeros(len(original.t), fields)
    for (field, *_), value in zip(fields, values, strict=True):
        table[field] = value
    result = fmpy.simulate_fmu(
        str(path),
        stop_time=stop,
        output_interval=H,
        fmi_type=interface_type,
        solver="CVode",
        relative_tolerance=1e-10,
        input=table,
    )
    names = [s.name for s in original.component.interface.outputs] if arrays else None
    columns = [np.reshape(result[n], (len(result), -1)) for n in names or result.dtype.names[1:]]
    return np.hstack(columns)


@FMI
@pytest.mark.parametrize(("key", "name"), COMPONENTS)
def test_co_simulation_by_fmpy_alone_gives_what_the_component_gives(key, name, fmi, folder):
    """fmpy holds the inputs over a step, and interpolates them at its own times.

    These are 1e-16 s away from ours, which is 1e-13 of an input. theta errs by that times the
    condition of the little information that 0.7 s give: 1e6. Before the start time that may decide
    whether exact data exclude every other optimum, and so whether there is a theta.
    """
    original = case(key, name)
    _, named = rows(original)
    if fmi == "3" and len({size for _, size, _ in named}) > 1:
        pytest.skip("fmpy stacks the values of all inputs, which must have one size")
    y = by_fmpy(export(key, name, fmi, folder), "CoSimulation", original, named, STOP)
    component = original.component
    all_held = np.ones(original.u.shape[1], np.bool_)
    prepare(component, H, original.held if name == "identifier" else all_held, {})
    expected = [component.initialize(0.0, original.u[0])]
    for k in range(len(original.t) - 1):
        u = np.vstack([original.u[k], original.u[k]])
        expected.append(component.advance(original.t[k : k + 2], H, u)[0])
    steps = min(len(y), len(expected))
    assert steps >= len(expected) - 1
    y = y[:steps]
    expected = np.array(expected)[:steps]
    if name == "identifier":
        early = original.t[:steps] < START["identifier.start"]
        in_one = np.isnan(y) != np.isnan(expected)
        y[in_one & early[:, np.newaxis]] = np.nan
        expected[in_one & early[:, np.newaxis]] = np.nan
    assert relative(y, expected) <= (1e-7 if name == "identifier" else 1e-12)


@FMI
@LINEAR
def test_model_exchange_by_fmpy_alone_gives_what_the_component_gives(key, name, fmi, folder):
    """CVode at 1e-10 a step, with constant inputs, stays within 1e-6 of the exact solver.

    filter_rate is 1e3.
    """
    original = case(key, name)
    u, named = rows(original, np.linspace(0.5, 1.0, original.u.shape[1]))
    y = by_fmpy(export(key, name, fmi, folder), "ModelExchange", original, named, 0.5)
    exact = Linear(original.model)
    prepare(exact, H, np.zeros(u.shape[1], np.bool_), {})
    expected = np.vstack([exact.initialize(0.0, u[0]), exact.advance(original.t, H, u)])[: len(y)]
    assert relative(y, expected) <= 1e-6


@pytest.mark.slow
def test_adjoint_derivatives_are_the_transposed_matrices(folder):
    """Through fmpy's binding of FMI 3, as ours needs none."""
    original = case("academic", "observer")
    path = export("academic", "observer", "3", folder)
    description = fmpy.read_model_description(str(path))
    fmu = FMU3Slave(
        guid=description.guid,
        unzipDirectory=fmpy.extract(str(path), str(folder / "observer3")),
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="one",
    )
    fmu.instantiate()
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    outputs = [v.valueReference for v in description.modelVariables if v.causality == "output"]
    n_y, n_u = original.model.D.shape
    knowns = (c_uint32 * len(outputs))(*outputs), len(outputs), (c_uint32 * n_u)(*range(n_u)), n_u
    rows = []
    for seed in np.eye(n_y):
        row = (c_double * n_u)()
        fmu.fmi3GetAdjointDerivative(fmu.component, *knowns, (c_double * n_y)(*seed), n_y, row, n_u)
        rows.append(list(row))
    fmu.terminate()
    fmu.freeInstance()
    assert np.array_equal(np.array(rows), original.model.D)


@pytest.mark.slow
def test_every_fmu_takes_its_component_place(folder):
    """The whole method as FMUs, FMI 2 and 3 mixed, has the bits of the run with the components.

    NaN, which is no value yet, is compared too.
    """
    expected = cosim.run("academic", set=START)
    swaps = {
        name: export("academic", name, fmi, folder)
        for (_, name), fmi in zip(ACADEMIC, "3232", strict=True)
    }
    settings = {"scenario.stop": STOP, **{f"{name}.interface_type": "cs" for name in swaps}}
    run = cosim.run("academic", swap=swaps, set=settings)
    for signal in ("plant.y", "observer.delta", "regressor.mu", "identifier.theta"):
        assert np.array_equal(run[signal], expected[signal], equal_nan=True), signal


@pytest.mark.slow
def test_a_fixed_step_is_kept(folder):
    """Another communication step is refused: in FMI 3 before the run, in FMI 2 by the FMU.

    FMI 3 declares it.
    """
    original = case("academic", "regressor")
    with (
        load(export("academic", "regressor", "3", folder), FmuOptions(interface_type="cs")) as fmu,
        pytest.raises(CosimError, match=r"0\.001 s"),
    ):
        prepare(fmu.component, 0.0015, original.held, {})
    with load(export("academic", "regressor", "2", folder), FmuOptions(interface_type="cs")) as fmu:
        prepare(fmu.component, 0.002, original.held, {})
        fmu.component.initialize(0.0, original.u[0])
        message = (
            r"a communication step of 0\.002\d* s was asked for; needed 0\.001 s, "
            r"the step of this FMU"
        )
        with pytest.raises(CosimError, match=message):
            fmu.component.advance(np.array([0.0, 0.002]), 0.002, original.u[:2])


def test_an_impossible_export_is_refused(tmp_path):
    """Signal sources, and versions and platforms that are none: the message names what exists."""
    cases = [
        (
            {"component": "u"},
            "'u' is of kind 'sine', .* available: sum, gain",
        ),
        ({"fmi": "1"}, "FMI version '1'"),
        (
            {"platforms": ["x86_64-lnux"]},
            "'x86_64-lnux'; did you mean 'x86_64-linux'",
        ),
        ({"platforms": 2 * ["x86_64-linux"]}, "platform 'x86_64-linux' is given twice"),
    ]

    def act(options):
        name = options.get("component", "plant")
        others = {key: value for key, value in options.items() if key != "component"}
        export_component("academic", name, tmp_path / "x.fmu", **others)

    check_refused(cases, act, CosimError)
    long = cosim.load("academic").set({"scenario.name": 33 * "温"})
    with pytest.raises(CosimError, match=r"expected at most .* characters"):
        export_component(long, "plant", tmp_path / "x.fmu")
    assert list(tmp_path.iterdir()) == []


PARTS = """
scenario = { name = "small-parts", stop = 0.5, step = 1e-3 }
[components]
wave = { kind = "expression", y = ["sin(7*t)", "cos(9*t) + 0.3"]DISCRETE }
lag = { kind = "lag", time_constant = 0.05, size = 2, unit = "N" }
late = { kind = "delay", delay = 0.02, size = 2 }
early = { kind = "delay", delay = 0.001, initial = -2.0, size = 2 }
limit = { kind = "limit", lower = -0.5, upper = 0.75, size = 2 }
gain = { kind = "gain", K = [[1.0, 2.0], [0.5, -1.0], [0.0, 3.0]] }
sum = { kind = "sum", signs = [1.0, -0.1], size = 2 }
after = { kind = "lag", time_constant = 0.05, size = 3 }
[connections]
"lag.u" = "wave.y"
"late.u" = "wave.y"
"early.u" = "lag.y"
"limit.u" = "wave.y"
"gain.u" = "late.y"
"sum.u1" = "wave.y"
"sum.u2" = "limit.y"
"after.u" = "gain.y"
"""


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [pytest.param("2", marks=pytest.mark.campaign), "3"])
def test_small_parts_are_the_same_as_fmus(fmi, tmp_path):
    """Lag, delays, limit, gain and sum: a run with one as an FMU records what the run recorded."""
    scenario = tmp_path / "parts.toml"
    scenario.write_text(PARTS.replace("DISCRETE", ""))
    expected = cosim.run(scenario)
    for name in ("lag", "late", "early", "limit", "gain", "sum"):
        path = tmp_path / f"{name}.fmu"
        export_component(str(scenario), name, path, fmi=fmi)
        assert validate_fmu(str(path)) == []
        assert read(path).description.name == f"small_x2d_parts_{name}"  # small-parts in C
        run = cosim.run(scenario, swap={name: path}, set={f"{name}.interface_type": "cs"})
        assert relative(run[f"{name}.y"], expected[f"{name}.y"]) <= 1e-14, name


@pytest.mark.slow
def test_parts_that_inherit_discrete_variability_are_discrete(tmp_path):
    """The inputs that they drive must be held (zero-order hold).

    Linear interpolation is off by half a step's change. The inputs jump in an event at each
    communication point, and outputs that they feed show that there, bit for bit.
    """
    scenario = tmp_path / "held.toml"
    scenario.write_text(PARTS.replace("DISCRETE", ", discrete = true"))
    expected = cosim.run(scenario)
    for name in ("gain", "limit", "late"):
        export_component(str(scenario), name, tmp_path / f"{name}.fmu", fmi="3")
        description = read(tmp_path / f"{name}.fmu").description
        assert {description[port].variability for port in ("u", "y")} == {"discrete"}
        swap = {name: f"{tmp_path / name}.fmu#cs"}
        run = cosim.run(scenario, swap=swap)
        assert np.array_equal(run[f"{name}.y"], expected[f"{name}.y"]), name
        assert np.array_equal(run["after.y"], expected["after.y"]), name
        assert not [m for m in run.messages() if "by up to one step" in m.text], name
    lines = export_component(str(scenario), "gain", tmp_path / "gain2.fmu", fmi="2")
    assert "co-simulation in FMI 2.0 has no events, so they are declared cont" in lines[-1]


def test_an_export_needs_no_files_of_unrelated_components(tmp_path):
    """The observer needs its model, not the plant.

    The identifier takes rows as the plant makes them, and so needs that.
    """
    scenario = tmp_path / "academic.toml"
    plant = 'kind = "descriptor"\nmodel = "academic"\nx_a0 = [1.0, -1.0]'
    before, after = find("academic").text.split(plant)
    scenario.write_text(f'{before}kind = "fmu"\npath = "missing.fmu"{after}', encoding="utf-8")
    lines = export_component(str(scenario), "observer", tmp_path / "observer.fmu")
    assert "FMI 2.0, model exchange and co-simulation" in lines[0]
    with pytest.raises(CosimError, match=r"missing\.fmu"):
        export_component(str(scenario), "identifier", tmp_path / "identifier.fmu")
