"""An independent client: libcosim runs our co-simulation FMUs of FMI 2.0."""

from contextlib import ExitStack

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.scenario.exporting import export_component
from cosim.scenario.kinds.base import BuildContext
from cosim.scenario.running.execution import load

STOP = 2.0  # s
STEP = 0.01
INPUTS = np.array([0.5, -1.0])  # u and delta of the plant, which libcosim holds over its steps
OUTPUTS = [2, 3, 4, 5]  # references of y, x_a, x_b


def outputs_at_the_end(path):
    """Run an FMU in libcosim, which keeps no reference to what it is made of."""
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimLogging import CosimLogLevel, log_output_level
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    log_output_level(CosimLogLevel.WARNING)
    execution = CosimExecution.from_step_size(step_size=STEP * 1e9)
    observer = CosimObserver.create_last_value()
    execution.add_observer(observer)
    slave = CosimLocalSlave(fmu_path=str(path), instance_name="plant")
    at = execution.add_local_slave(slave)
    for reference, value in enumerate(INPUTS):
        assert execution.real_initial_value(at, reference, value)
    assert execution.simulate_until(round(STOP * 1e9))
    return observer.last_real_values(at, OUTPUTS)


@pytest.mark.slow
def test_a_plant_with_constant_inputs_is_exact(tmp_path):
    """Held inputs are the inputs; rounding of 200 steps stays below 1e-12."""
    loaded = load("academic")
    with ExitStack() as resources:
        plant = loaded.specs["plant"].linear_model("plant", BuildContext(loaded, resources))
    export_component(loaded, "plant", tmp_path / "plant.fmu")
    steady = -np.linalg.solve(plant.A, plant.B @ INPUTS)
    x = steady + expm(plant.A * STOP) @ (plant.X0 - steady)
    found = outputs_at_the_end(tmp_path / "plant.fmu")
    assert abs(found - (plant.C @ x + plant.D @ INPUTS)).max() < 1e-12
