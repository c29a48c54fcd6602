"""An independent client: libcosim runs our co-simulation FMUs of FMI 2.0.

It holds inputs over its steps.
"""

from contextlib import ExitStack

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.scenario.exporting import export_component
from cosim.scenario.kinds.base import BuildContext
from cosim.scenario.running.execution import load

pytestmark = pytest.mark.slow

STOP = 2.0  # s
INPUTS = np.array([0.5, -1.0])  # u and delta of the plant
CHANGES = {"observer.filter_rate": 10.0}  # slow against the step, so that the order shows
PLANT = range(4)  # y, x_a, x_b, whose references begin at 2
OBSERVER = range(2, 9)  # references of x_a, delta, x_b, z, q


@pytest.fixture(scope="module")
def models():
    loaded = load("academic").set(CHANGES)
    with ExitStack() as resources:
        context = BuildContext(loaded, resources)
        return {
            name: loaded.specs[name].linear_model(name, context) for name in ("plant", "observer")
        }


@pytest.fixture(scope="module")
def fmus(tmp_path_factory):
    from libcosimpy.CosimLogging import CosimLogLevel, log_output_level

    log_output_level(CosimLogLevel.WARNING)
    folder = tmp_path_factory.mktemp("libcosim")
    paths = {name: folder / f"{name}.fmu" for name in ("plant", "observer")}
    for name, path in paths.items():
        export_component(load("academic").set(CHANGES), name, path)
    return paths


class Run:
    """An execution with its FMUs; libcosim keeps no reference to them."""

    def __init__(self, step):
        from libcosimpy.CosimExecution import CosimExecution
        from libcosimpy.CosimObserver import CosimObserver

        self.execution = CosimExecution.from_step_size(step_size=step * 1e9)
        self.observer = CosimObserver.create_last_value()
        self.execution.add_observer(self.observer)
        self.kept = []

    def add(self, path, values):
        from libcosimpy.CosimSlave import CosimLocalSlave

        self.kept.append(CosimLocalSlave(fmu_path=str(path), instance_name=path.stem))
        at = self.execution.add_local_slave(self.kept[-1])
        for reference, value in values.items():
            assert self.execution.real_initial_value(at, reference, value)
        return at

    def end(self):
        assert self.execution.simulate_until(round(STOP * 1e9))


def solution(models):
    """Return the outputs of both at the end.

    The connected system x' = F x + G u has a constant input, so one exponential.
    """
    plant = models["plant"]
    observer = models["observer"]
    n = len(plant.A)
    k = len(observer.A)
    sees = np.vstack([np.zeros(n), plant.C[0]])  # its inputs u, y from the plant's states ...
    fed = np.vstack([[1.0, 0.0], plant.D[0]])  # ... and from the plant's inputs
    F = np.block([[plant.A, np.zeros((n, k))], [observer.B @ sees, observer.A]])
    G = np.vstack([plant.B, observer.B @ fed])
    start = np.concatenate([plant.X0, observer.X0 + observer.Xu @ (sees @ plant.X0 + fed @ INPUTS)])
    steady = -np.linalg.solve(F, G @ INPUTS)
    x = steady + expm(F * STOP) @ (start - steady)
    seen = sees @ x[:n] + fed @ INPUTS
    return plant.C @ x[:n] + plant.D @ INPUTS, observer.C @ x[n:] + observer.D @ seen


def test_a_plant_with_constant_inputs_is_exact(models, fmus):
    """Held inputs are the inputs; rounding of 200 steps stays below 1e-12."""
    run = Run(0.01)
    at = run.add(fmus["plant"], dict(enumerate(INPUTS)))
    run.end()
    found = run.observer.last_real_values(at, [2 + k for k in PLANT])
    assert abs(found - solution(models)[0]).max() < 1e-12


def test_a_plant_and_its_observer_are_first_order_in_the_step(models, fmus):
    """The observer's input is held over a step, so late by half of it.

    Halving the step halves the error in x_a.
    """
    expected = solution(models)[1]
    errors = []
    for step in (0.02, 0.01, 0.005):
        run = Run(step)
        plant = run.add(fmus["plant"], dict(enumerate(INPUTS)))
        observer = run.add(fmus["observer"], {0: INPUTS[0]})
        assert run.execution.connect_real_variables(plant, 2, observer, 1) == 0
        run.end()
        found = run.observer.last_real_values(observer, list(OBSERVER))
        errors.append(np.linalg.norm((found - expected)[:2]))
    assert errors[0] < 0.05
    assert 1.8 < errors[0] / errors[1] < 2.2
    assert 1.9 < errors[1] / errors[2] < 2.1
