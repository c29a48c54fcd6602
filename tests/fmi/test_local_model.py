"""FMUs linearized where a run begins: their matrices, without a step, and without a trace."""

from itertools import pairwise

import numpy as np
import pytest

from cosim.core.contracts import linearized, prepare
from cosim.fmi.component import load
from cosim.fmi.driving.model_exchange import ModelExchange
from cosim.fmi.exporting.export import export
from cosim.fmi.generated import GeneratedInstance
from cosim.fmi.options import FmuOptions
from tests.fmi import plant
from tests.fmi.pendulum import jacobian, pendulum

H = 0.01
MATRICES = ("A", "B", "C", "D")


def begun(component, u):
    """Prepare and initialize a component; return it linearized there."""
    prepare(component, H, np.zeros(component.interface.n_u, np.bool_), {})
    component.initialize(0.0, u)
    component.outputs(0.0, u)
    return linearized(component, 0.0, u)


def check_matrices(found, rtol):
    """Compare with the plant of the exported FMU."""
    for name in MATRICES:
        expected = getattr(plant, name)
        np.testing.assert_allclose(getattr(found, name), expected, rtol=0, atol=rtol)


@pytest.mark.parametrize("solver", ["exact", "RK45", "euler"])
def test_a_model_whose_matrices_are_known_gives_them(solver):
    """Whatever solves it."""
    component = ModelExchange(GeneratedInstance.of(plant.model()), solver)
    check_matrices(begun(component, plant.U0), 0.0)


@pytest.mark.parametrize("solver", ["RK45", "BDF", "CVode"])
def test_a_model_exchange_fmu_is_linearized_by_differences(exported, solver):
    """Of a linear one only rounding remains: eps / 2^-17 = 3e-11 of values near 1."""
    with load(exported, FmuOptions(interface_type="me", solver=solver)) as fmu:
        found = begun(fmu.component, plant.U0)
    check_matrices(found, 1e-9)
    assert found.is_continuous


def test_a_co_simulation_fmu_is_linearized_by_directional_derivatives(exported):
    """Where it shows its states: to the last bits. Its outputs follow the inputs by D."""
    with load(exported, FmuOptions(interface_type="cs")) as fmu:
        found = begun(fmu.component, plant.U0)
    check_matrices(found, 1e-14)
    assert found.follows.all()


def test_a_nonlinear_fmu_is_linearized_where_it_begins(tmp_path):
    """Against its Jacobian in closed form; the second-order error is (2^-17)^2 of values near 1."""
    path = pendulum(tmp_path / "pendulum.fmu", derivatives=False)
    start = {"theta": 1.1, "omega": -0.7}
    with load(path, FmuOptions(interface_type="me", start=start)) as fmu:
        u = np.zeros(fmu.component.interface.n_u)
        names = [signal.name for signal in fmu.component.interface.inputs]
        u[names.index("torque")] = 3.0
        found = begun(fmu.component, u)
        outputs = [signal.name for signal in fmu.component.interface.outputs]
    A, B, C, D = jacobian(theta=1.1, omega=-0.7, torque=3.0)
    np.testing.assert_allclose(found.A, A, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.B[:, : B.shape[1]], B, rtol=0, atol=1e-8)
    rows = [outputs.index(name) for name in ("y", "reach", "power", "angle", "push")]
    np.testing.assert_allclose(found.C[rows], C, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.D[rows][:, : D.shape[1]], D, rtol=0, atol=1e-8)


def test_a_model_without_states_has_none_behind_its_steps_either(tmp_path):
    """There its matrices are those from before: D alone."""
    D = np.array([[1.0, 2.0], [0.0, -1.0]])
    path = export(plant.static(plant.STATIC, D), tmp_path / "static.fmu", name="static").path
    t = H * np.arange(3)
    u = np.column_stack([1.0 + t, np.cos(t)])
    with load(path, FmuOptions(interface_type="me", solver="RK45")) as fmu:
        component = fmu.component
        begun(component, u[0])
        y = component.advance(t, H, u)
        found = linearized(component, t[-1], u[-1])
    np.testing.assert_allclose(y, u[1:] @ D.T, rtol=1e-15)
    assert found.A.shape == (0, 0)
    assert (found.B.shape, found.C.shape) == ((0, 2), (2, 0))
    np.testing.assert_allclose(found.D, D, rtol=0, atol=1e-9)  # differences of a linear model


@pytest.mark.parametrize("interface_type", ["me", "cs"])
def test_to_be_linearized_leaves_no_trace(exported, interface_type):
    """The run that follows has the bits of one without."""
    rows = []
    for is_linearized in (True, False):
        with load(exported, FmuOptions(interface_type=interface_type)) as fmu:
            component = fmu.component
            prepare(component, H, np.zeros(2, np.bool_), {})
            t = H * np.arange(11)
            u = plant.inputs(t)
            component.initialize(0.0, u[0])
            component.outputs(0.0, u[0])
            if is_linearized:
                assert component.linearized(0.0, u[0]) is not None
            rows.append(
                [
                    component.advance(np.array(ends), H, plant.inputs(np.array(ends)))
                    for ends in pairwise(t)
                ]
            )
    assert np.array(rows[0]).tobytes() == np.array(rows[1]).tobytes()


def test_a_model_with_events_in_time_is_not_linearized(edited):
    """A real output that is discrete: matrices would say that it never changes."""
    continuous = 'name="y" valueReference="2" causality="output" variability="continuous"'
    path = edited((continuous, continuous.replace("continuous", "discrete")))
    with load(path, FmuOptions(interface_type="me")) as fmu:
        assert not fmu.component.interface.linearizable
