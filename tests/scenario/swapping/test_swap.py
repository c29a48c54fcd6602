"""One plant for another, by name: generated, real FMUs of four makes, a recorded log."""

import json

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError
from tests.scenario.signals import COARSE


@pytest.fixture
def plant(folder):
    return folder / "plant.fmu"


@pytest.mark.parametrize(
    ("interface_type", "reference"), [("me", {"plant.solver": "rk4"}), ("cs", {})]
)
def test_an_exported_plant_has_the_bits_of_the_generated_one(plant, interface_type, reference):
    """They call the same C: the same solver, or the same discretization for co-simulation."""
    changes = {**COARSE, **reference, "plant.interface_type": interface_type}
    run = cosim.run("academic", swap={"plant": plant}, set=changes)
    assert cosim.diff(cosim.run("academic", set=COARSE | reference), run).equal


def test_a_log_of_an_fmu_replays_without_the_fmu(plant, tmp_path):
    """The FMU's signals come from the log."""
    copy = tmp_path / "copy.fmu"
    copy.write_bytes(plant.read_bytes())
    log = cosim.run("academic", swap={"plant": copy}, set=COARSE, out=tmp_path / "a.mcap")
    copy.unlink()
    assert cosim.diff(log, cosim.replay(tmp_path / "a.mcap")).equal
    assert "plant/modelDescription.xml" in log.attachments
    assert json.loads(log.metadata["cosim.component.plant"]["metadata"])["sha256"]


def test_an_fmu_keeps_the_tolerance_of_its_table(plant):
    """At 1e-3 RK45 crosses a step of 0.1 s at once, with some (2 h)^6/720 = 1e-7.

    At 1e-11 it is the exact solution to 1e-9.
    """
    changes = {"scenario.step": 0.1, "scenario.stop": 4.0}

    def run(tolerance):
        return cosim.run(
            "academic",
            swap={"plant": plant},
            set={**changes, "plant.solver": "RK45", "plant.tolerance": tolerance},
        )

    exact = cosim.run("academic", set=changes)["plant.y"]
    loose = run(1e-3)
    tight = run(1e-11)
    assert abs(tight["plant.y"] - exact).max() < 1e-9 < 1e-8 < abs(loose["plant.y"] - exact).max()
    assert json.loads(tight.metadata["cosim.component.plant"]["metadata"])["tolerance"] == 1e-11


@pytest.mark.usefixtures("without_verdicts")
def test_a_sampled_fmu_responds_at_its_own_step(plant, tmp_path):
    """With a period the FMU lives on that step.

    Its outputs hold between, and its channel keeps the rows of that step.
    """
    changes = {"plant.interface_type": "cs", "plant.period": 0.01, "scenario.stop": 1.0}
    log = cosim.run("academic", swap={"plant": plant}, set=changes, out=tmp_path / "a.mcap")
    assert np.array_equal(np.unique(np.diff(log.time_ns("plant"))), [10_000_000])
    assert cosim.diff(log, cosim.replay(tmp_path / "a.mcap")).equal


def test_a_start_value_of_the_fmu_can_be_set(plant):
    """Start values come from the FMU unless set; a misspelt variable is refused before the run."""
    short = {"scenario.stop": 0.01}
    changes = {**short, "plant.start": {"x_a[0]": 2.0}}
    run = cosim.run("academic", swap={"plant": plant}, set=changes)
    assert list(run["plant.x_a"][0]) == [2.0, -1.0]
    with pytest.raises(ScenarioError, match=r"x_a\[2\].*did you mean"):
        cosim.run("academic", swap={"plant": plant}, set={"plant.start": {"x_a[2]": 2.0}})
