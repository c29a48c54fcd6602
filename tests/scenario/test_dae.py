"""The descriptor plant as a DAE FMU in its scenario: both forms."""

import numpy as np
import pytest

import cosim
from cosim.errors import CosimError
from cosim.scenario.exporting import export_component

pytestmark = pytest.mark.usefixtures("without_verdicts")


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    path = tmp_path_factory.mktemp("dae") / "plant.fmu"
    export_component("academic", "plant", path, fmi="3", dae=True)
    return path


@pytest.mark.slow
def test_both_forms_give_the_plant_and_its_parameters(plant):
    """The residual form is as good as the exact solver.

    States: a step of the method at 1 ms is wrong by (3 h)^6 / 7200, 1e-19; what is seen is the
    rounding of 10 000 steps, each below 4e-16 and forgotten at the rate 1.5: 3e-13. The FMU's own
    form with rk4 is wrong by (3 h)^4 / 120, 7e-13.

    theta: an error of y becomes one of the reconstructed disturbance by the filter's rate, 1e3, and
    of theta by the condition of 7 s of least squares, some 10.
    """
    changes = {"scenario.stop": 10.0}
    expected = cosim.run("academic", set=changes)
    for dae in ("residual", "ode"):
        found = cosim.run("academic", swap={"plant": plant}, set={**changes, "plant.dae": dae})
        for signal in ("y", "x_a", "x_b"):
            assert np.abs(found[f"plant.{signal}"] - expected[f"plant.{signal}"]).max() < 1e-12
        assert found["identifier.theta"][-1] == pytest.approx(
            expected["identifier.theta"][-1], abs=1e-8
        )


@pytest.mark.slow
@pytest.mark.parametrize("interface_type", ["me", "cs"])
def test_its_ordinary_form_is_the_ordinary_export(plant, tmp_path, interface_type):
    """Bit for bit: the same C steps both, and the residual is beside it."""
    export_component("academic", "plant", tmp_path / "ordinary.fmu", fmi="3")
    runs = [
        cosim.run(
            "academic", swap={"plant": f"{path}#{interface_type}"}, set={"scenario.stop": 1.0}
        )
        for path in (plant, tmp_path / "ordinary.fmu")
    ]
    assert cosim.diff(*runs).equal


def test_a_form_that_there_is_not_is_refused():
    """Where the scenario is read, before the FMU is."""
    with pytest.raises(CosimError, match=r"plant\.dae'\]: .*'dae'.*did you mean 'ode'\?"):
        cosim.run("academic", swap={"plant": "plant.fmu"}, set={"plant.dae": "dae"})
