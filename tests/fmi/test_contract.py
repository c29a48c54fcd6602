"""FMUs keep the contract of a component, whatever the variability of their inputs."""

import numpy as np
import pytest

from cosim.core.contracts import Stopped
from cosim.core.linear import Linear
from cosim.fmi.component import ModelExchange, load
from cosim.fmi.exporting.export import export
from cosim.fmi.generated import GeneratedInstance
from cosim.fmi.options import FmuOptions
from cosim.testing import check_component, check_rollback
from tests.fmi.variabilities import VARIABILITIES, Watched, model


@pytest.fixture(scope="module", params=VARIABILITIES)
def inputs(request):
    return request.param


@pytest.fixture(scope="module")
def path(inputs, tmp_path_factory):
    folder = tmp_path_factory.mktemp(inputs)
    return export(model(inputs), folder / "model.fmu", name="model").path


@pytest.mark.fast("discrete-rk4", "continuous-exact")
@pytest.mark.parametrize("solver", ["exact", "rk4"])
def test_generated_models_keep_the_contract(inputs, solver):
    """With discrete inputs, continuous ones and both."""

    def make():
        return ModelExchange(GeneratedInstance.of(model(inputs)), solver)

    check_component(make)
    check_rollback(make)


@pytest.mark.fast("both-cs")
@pytest.mark.parametrize("interface_type", ["me", "cs"])
def test_loaded_fmus_keep_the_contract(path, interface_type):
    """With both interface types: in co-simulation D corrects the outputs, so that they follow."""
    loaded = []

    def make():
        loaded.append(load(path, FmuOptions(interface_type=interface_type)))
        return loaded[-1].component

    check_component(make, steps=15)
    check_rollback(make, steps=15)
    for fmu in loaded:
        fmu.close()


@pytest.mark.fast("neither D nor input derivatives")
@pytest.mark.parametrize("able", ["neither D nor input derivatives", "no D"])
def test_co_simulation_fmus_without_D_keep_the_contract(edited, able):
    """Their outputs do not follow the inputs at the end of a step.

    FMI 2.0.4 section 4.2.4 forbids setting inputs and reading outputs without a step between; so
    "outputs ignores" holds for all inputs, and that outputs follow those that feed through cannot
    be required (``notes`` says so).
    """
    removed = [(' providesDirectionalDerivative="true"', "")]
    if able != "no D":
        removed.append((' canInterpolateInputs="true"', ""))
    file = edited(*removed)
    loaded = []

    def make():
        loaded.append(load(file, FmuOptions(interface_type="cs")))
        return loaded[-1].component

    check_component(make)
    for fmu in loaded:
        fmu.close()


@pytest.mark.slow
def test_a_co_simulation_fmu_of_others_keeps_the_contract(foreign2):
    """By pythonfmu: integer and Boolean inputs, no D, no saved states."""
    loaded = []

    def make():
        loaded.append(load(foreign2))
        return loaded[-1].component

    check_component(make, steps=10)
    for fmu in loaded:
        fmu.close()


@pytest.mark.slow
@pytest.mark.parametrize("interface_type", ["me", "cs"])
def test_an_fmi_3_fmu_of_others_keeps_the_contract(foreign3, interface_type):
    """By pythonfmu3: dependencies unknown, no D, no saved states."""
    loaded = []

    def make():
        loaded.append(load(foreign3, FmuOptions(interface_type=interface_type)))
        return loaded[-1].component

    check_component(make, steps=10)
    for fmu in loaded:
        fmu.close()


def run_in_loop(component, u, held):
    """Advance as a loop does.

    A held input at the end of a step is that of its start; ``outputs`` repairs what feeds through.
    """
    t = np.arange(len(u)) * 0.01
    component.prepare(0.01, held, {})
    rows = [component.initialize(0.0, u[0])]
    for k in range(len(u) - 1):
        end = np.where(held, u[k], u[k + 1])
        component.advance(t[k : k + 2], 0.01, np.vstack([u[k], end]))
        rows.append(component.outputs(float(t[k + 1]), u[k + 1]))
    return np.array(rows)


def test_extrapolated_inputs_that_are_corrected_reach_the_fmu(inputs, path):
    """Solver rk4 at 10 ms errs by h^5/5! a step, 1e-12, for inputs near 1.

    Linear has no instance that could miss an input.
    """
    u = np.random.default_rng(1).standard_normal((40, len(VARIABILITIES[inputs])))
    held = np.ones(u.shape[1], np.bool_)
    expected = run_in_loop(Linear(model(inputs)), u, held)
    exact = ModelExchange(GeneratedInstance.of(model(inputs)), "exact")
    assert np.array_equal(run_in_loop(exact, u, held), expected)
    rk4 = ModelExchange(GeneratedInstance.of(model(inputs)), "rk4")
    assert abs(run_in_loop(rk4, u, held) - expected).max() < 1e-8
    with load(path) as fmu:
        y = run_in_loop(fmu.component, u, held)
        assert abs(y[:, :2] - expected).max() < 1e-8


def test_discrete_inputs_are_held_whoever_drives_them(path, inputs):
    """A discrete input cannot be interpolated: its value from the start of the step counts."""
    names = VARIABILITIES[inputs]
    u = np.random.default_rng(2).standard_normal((40, len(names)))
    discrete = np.array([name == "discrete" for name in names])
    free = np.zeros(len(names), np.bool_)
    t = np.arange(40) * 0.01

    def run(component, held):
        component.prepare(0.01, held, {})
        component.initialize(0.0, u[0])
        return component.advance(t, 0.01, u)[:, :2]

    expected = run(Linear(model(inputs)), discrete)
    for solver in ("exact", "rk4"):
        generated = ModelExchange(GeneratedInstance.of(model(inputs)), solver)
        assert abs(run(generated, free) - expected).max() < 1e-8
    for interface_type in ("me", "cs"):
        with load(path, FmuOptions(interface_type=interface_type)) as fmu:
            assert abs(run(fmu.component, free) - expected).max() < 1e-8


def test_discrete_inputs_are_set_in_event_mode_only(inputs):
    """FMI 2.0.4 section 3.2.3: in continuous-time mode only continuous inputs may be set."""
    instance = Watched(inputs)
    u = np.random.default_rng(3).standard_normal((10, len(VARIABILITIES[inputs])))
    run_in_loop(ModelExchange(instance, "rk4"), u, np.ones(u.shape[1], np.bool_))
    assert instance.misplaced == []


@pytest.mark.parametrize("solver", ["exact", "rk4"])
def test_a_request_for_the_end_is_followed_in_every_event(solver):
    """In the first one no step is made; in one that a changed input makes the run ends at once."""
    t = np.arange(4) * 0.01
    u = np.zeros((4, 1))
    for call in ("advance", "outputs"):
        component = ModelExchange(Watched("discrete", end_at=1), solver)
        component.prepare(0.01, np.ones(1, np.bool_), {})
        component.initialize(0.0, u[0])
        if call == "outputs":
            component.outputs(0.0, u[0])
        with pytest.raises(Stopped, match="the FMU requests the end of the run") as stop:
            component.advance(t, 0.01, u)
        assert (stop.value.failed, stop.value.outputs.shape) == (False, (0, 2))
    component = ModelExchange(Watched("discrete", end_at=2), solver)
    component.prepare(0.01, np.ones(1, np.bool_), {})
    component.initialize(0.0, u[0])
    component.advance(t[:2], 0.01, u[:2])
    with pytest.raises(Stopped, match="the FMU requests the end of the run") as stop:
        component.advance(t[1:], 0.01, u[1:] + 1.0)
    assert (stop.value.failed, stop.value.steps) == (False, 0)
    component.initialize(0.0, u[0])
    assert len(component.advance(t, 0.01, u)) == 3, "a new run has no end yet"
