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


def outputs_at_the_end(step, paths, starts, references, connection=None):
    """Run FMUs in libcosim; return outputs of the last one. libcosim keeps no reference to them."""
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    execution = CosimExecution.from_step_size(step_size=step * 1e9)
    observer = CosimObserver.create_last_value()
    execution.add_observer(observer)
    kept = []
    for path, values in zip(paths, starts, strict=True):
        kept.append(CosimLocalSlave(fmu_path=str(path), instance_name=path.stem))
        at = execution.add_local_slave(kept[-1])
        for reference, value in values.items():
            assert execution.real_initial_value(at, reference, value)
    if connection is not None:
        output, input_ = connection
        assert execution.connect_real_variables(at - 1, output, at, input_) == 0
    assert execution.simulate_until(round(STOP * 1e9))
    return observer.last_real_values(at, references)


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
    references = [2 + k for k in PLANT]
    found = outputs_at_the_end(0.01, [fmus["plant"]], [dict(enumerate(INPUTS))], references)
    assert abs(found - solution(models)[0]).max() < 1e-12


def test_a_plant_and_its_observer_are_first_order_in_the_step(models, fmus):
    """The observer's input is held over a step, so late by half of it.

    Halving the step halves the error in x_a.
    """
    expected = solution(models)[1]
    starts = [dict(enumerate(INPUTS)), {0: INPUTS[0]}]
    errors = []
    for step in (0.02, 0.01, 0.005):
        found = outputs_at_the_end(step, [*fmus.values()], starts, list(OBSERVER), (2, 1))
        errors.append(np.linalg.norm((found - expected)[:2]))
    assert errors[0] < 0.05
    assert 1.8 < errors[0] / errors[1] < 2.2
    assert 1.9 < errors[1] / errors[2] < 2.1
