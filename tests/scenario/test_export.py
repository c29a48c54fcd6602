"""The components of the shipped scenarios as FMUs: the same numbers, by us and by fmpy."""

from contextlib import ExitStack
from ctypes import c_double, c_uint32
from dataclasses import dataclass
from functools import cache
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu

import cosim
from cosim.core.contracts import Component, prepare
from cosim.core.linear import LinearModel
from cosim.errors import CosimError
from cosim.fmi.component import ModelExchange
from cosim.fmi.component import load as load_fmu
from cosim.fmi.generated import GeneratedInstance
from cosim.fmi.options import FmuOptions
from cosim.fmi.reading.model_description import read
from cosim.scenario.building.build import Builder
from cosim.scenario.document.document import find
from cosim.scenario.exporting import export_component
from cosim.scenario.kinds.base import BuildContext
from cosim.scenario.running.execution import load
from tests.scenario.refusals import check_refused
from tests.scenario.signals import signals

H = 1e-3
STOP = 4.2  # s
# theta is there at the end, and the log has every row
START = {"scenario.stop": STOP, "identifier.start": 3.5, "identifier.period": H}
LEAST_SQUARES = {"identifier.method": "least-squares"}
RUNS = {
    "academic": ("academic", {}),
    "closed-loop": ("closed-loop", {}),
    "sampled": ("closed-loop", {"controller.period": 0.01}),
    "step": ("closed-loop", {"controller.period": H}),
    "slow": ("academic", {**LEAST_SQUARES, "identifier.period": 0.1}),
    "held": ("academic", {**LEAST_SQUARES, "scenario.input_interpolation": "zero-order"}),
    "online": ("academic-noisy", {"identifier.period": 0.1}),
}
ACADEMIC = [("academic", name) for name in ("plant", "observer", "regressor", "identifier")]
OTHERS = [
    *(("closed-loop", name) for name in ("feedback", "error", "controller")),
    ("sampled", "controller"),
    ("step", "controller"),
    ("slow", "identifier"),
    ("held", "identifier"),
    ("online", "identifier"),
]
# linear models that have states
STATES = [("academic", "plant"), ("academic", "observer"), ("closed-loop", "controller")]
# what drives those whose logs keep only the rows at their period
DRIVERS = {
    "sampled": ("error.y",),
    "slow": ("regressor.mu",),
    "online": ("regressor.mu", "observer.delta", "sensor.y", "u.y"),
}


@dataclass(frozen=True)
class Case:
    """A component with its inputs and outputs in a run."""

    component: Component
    model: LinearModel | None
    held: Any
    t: Any
    u: Any
    y: Any


@cache
def loaded(key: str) -> Any:
    name, changes = RUNS[key]
    return load(name).set({**START, **changes})


@cache
def recorded(key: str) -> Any:
    return signals(loaded(key))


@cache
def case(key: str, name: str) -> Case:
    """Return a component, built for a run, with its recorded inputs and outputs."""
    scenario = loaded(key)
    run = recorded(key)
    with ExitStack() as resources:
        graph = Builder(scenario, resources).experiment().graph
        context = BuildContext(scenario, resources)
        model = scenario.specs[name].linear_model(name, context) if (key, name) in STATES else None
    component = graph.components[name]
    t = np.arange(round(STOP / H) + 1) * 1_000_000 / 1e9
    if key in DRIVERS:
        prepare(component, H, graph.held[name], {})
        driving = [np.reshape(run[port], (len(t), -1)) for port in DRIVERS[key]]
        u = np.ascontiguousarray(np.hstack(driving))
        y = np.vstack([component.initialize(0.0, u[0]), component.advance(t, H, u)])
    else:
        u = columns(run, name, component.interface.inputs)
        y = columns(run, name, component.interface.outputs)
    return Case(component, model, graph.held[name], t, u, y)


def columns(run: Any, name: str, ports: Any) -> Any:
    """Return the signals of a component side by side, at every communication point."""
    arrays = []
    for signal in ports:
        rows = run[f"{name}.{signal.name}"]
        arrays.append(np.reshape(rows, (-1, signal.size)))
    return np.ascontiguousarray(np.hstack(arrays))


def export(key: str, name: str, fmi: str, folder: Any) -> Any:
    path = folder / f"{key}-{name}-{fmi}.fmu"
    if not path.exists():
        export_component(loaded(key), name, path, fmi=fmi)
    return path


def drive(component: Any, original: Case) -> Any:
    """Run a component on recorded inputs; return its outputs in the order of the original."""
    prepare(component, H, original.held, {})
    first = component.initialize(0.0, original.u[0])
    y = np.vstack([first, component.advance(original.t, H, original.u)])
    columns_of = component.interface.output_columns()
    outputs = original.component.interface.outputs
    return np.hstack([y[:, columns_of[signal.name]] for signal in outputs])


FMI = pytest.mark.parametrize("fmi", ["2", "3"])
EVERY = pytest.mark.parametrize(
    ("key", "name"),
    [ACADEMIC[0], *(pytest.param(*one, marks=pytest.mark.slow) for one in ACADEMIC[1:] + OTHERS)],
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
@EVERY
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
@EVERY
def test_co_simulation_by_us_gives_what_the_component_gave(key, name, fmi, folder):
    """Bit for bit where the inputs are interpolated linearly.

    In steps this small u0 + h (u1 - u0)/h is u1 but near its zeros, and there it is 1e-16. Held
    inputs cost rounding: their two columns of the discretization are added at each step, not once.
    """
    original = case(key, name)
    with load_fmu(export(key, name, fmi, folder), FmuOptions(interface_type="cs")) as fmu:
        y = drive(fmu.component, original)
    assert relative(y, original.y) <= 1e-12
    if not original.held.any():
        assert np.array_equal(y, original.y, equal_nan=True)


@pytest.mark.fast("academic-plant-3")
@FMI
@pytest.mark.parametrize(("key", "name"), STATES)
def test_model_exchange_by_us_has_the_bits_of_the_component_with_the_same_solver(
    key, name, fmi, folder
):
    """rk4 on the FMU and rk4 on the component call the same C."""
    original = case(key, name)
    expected = drive(ModelExchange(GeneratedInstance.of(original.model), "rk4"), original)
    with load_fmu(
        export(key, name, fmi, folder), FmuOptions(interface_type="me", solver="rk4")
    ) as fmu:
        assert np.array_equal(drive(fmu.component, original), expected)


def by_fmpy(path, original, named):
    """Co-simulate with fmpy alone; the outputs side by side."""
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
        stop_time=STOP,
        output_interval=H,
        fmi_type="CoSimulation",
        input=table,
    )
    names = [s.name for s in original.component.interface.outputs] if arrays else None
    columns = [np.reshape(result[n], (len(result), -1)) for n in names or result.dtype.names[1:]]
    return np.hstack(columns)


@FMI
@EVERY
def test_co_simulation_by_fmpy_alone_gives_what_the_component_gives(key, name, fmi, folder):
    """fmpy holds the inputs over a step, and interpolates them at its own times.

    These are 1e-16 s away from ours, which is 1e-13 of an input. theta errs by that times the
    condition of the little information that 0.7 s give: 1e6. Before the start time that may decide
    whether exact data exclude every other optimum, and so whether there is a theta.
    """
    original = case(key, name)
    columns_of = original.component.interface.input_columns()
    inputs = original.component.interface.inputs
    named = [(s.name, s.size, original.u[:, columns_of[s.name]]) for s in inputs]
    if fmi == "3" and len({size for _, size, _ in named}) > 1:
        pytest.skip("fmpy stacks the values of all inputs, which must have one size")
    y = by_fmpy(export(key, name, fmi, folder), original, named)
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
    """Another is refused: in FMI 3, which declares it, before the run, in FMI 2 by the FMU."""
    original = case("academic", "regressor")
    declared, checked = (export("academic", "regressor", fmi, folder) for fmi in "32")
    options = FmuOptions(interface_type="cs")
    with load_fmu(declared, options) as fmu, pytest.raises(CosimError, match=r"0\.001 s"):
        prepare(fmu.component, 0.0015, original.held, {})
    with load_fmu(checked, options) as fmu:
        prepare(fmu.component, 0.002, original.held, {})
        fmu.component.initialize(0.0, original.u[0])
        message = r"step of 0\.002\d* s was asked for; needed 0\.001 s, the step of this FMU"
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
        ({"dae": True}, "FMI 2.0 has no residual form"),
        ({"component": "observer", "fmi": "3", "dae": True}, "'observer' is of kind"),
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
