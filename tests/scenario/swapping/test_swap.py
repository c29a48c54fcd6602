"""One plant for another, by name: generated, real FMUs of four makes, a recorded log."""

import json

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError
from tests.scenario.signals import COARSE, signals


@pytest.mark.parametrize("fmu", ["plant.fmu", pytest.param("plant3.fmu", marks=pytest.mark.slow)])
@pytest.mark.usefixtures("without_verdicts")
def test_an_exported_plant_has_the_bits_of_the_generated_one(folder, fmu):
    """They call the same C: the same solver, or the same discretization for co-simulation."""
    for interface_type, reference in (("me", {"plant.solver": "rk4"}), ("cs", {})):
        changes = {**COARSE, **reference, "scenario.stop": 2.0}
        generated = cosim.run("academic", set=changes)
        swap = {"plant": f"{folder / fmu}#{interface_type}"}
        assert cosim.diff(generated, cosim.run("academic", swap=swap, set=changes)).equal


def test_an_fmu_keeps_the_tolerance_of_its_table(folder):
    """At 1e-3 RK45 crosses a step of 0.1 s at once, with some (2 h)^6/720 = 1e-7.

    At 1e-11 it is the exact solution to 1e-9.
    """
    changes = {"scenario.step": 0.1, "scenario.stop": 4.0}

    def run(tolerance):
        return cosim.run(
            "academic",
            swap={"plant": folder / "plant.fmu"},
            set={**changes, "plant.solver": "RK45", "plant.tolerance": tolerance},
        )

    exact = cosim.run("academic", set=changes)["plant.y"]
    loose = run(1e-3)
    tight = run(1e-11)
    assert abs(tight["plant.y"] - exact).max() < 1e-9 < 1e-8 < abs(loose["plant.y"] - exact).max()
    assert json.loads(tight.metadata["cosim.component.plant"]["metadata"])["tolerance"] == 1e-11


@pytest.mark.usefixtures("without_verdicts")
def test_a_sampled_fmu_responds_at_its_own_step(folder, tmp_path):
    """With a period the FMU lives on that step.

    Its outputs hold between, and its channel keeps the rows of that step.
    """
    changes = {"plant.interface_type": "cs", "plant.period": 0.01, "scenario.stop": 1.0}
    log = cosim.run(
        "academic", swap={"plant": folder / "plant.fmu"}, set=changes, out=tmp_path / "a.mcap"
    )
    assert np.array_equal(np.unique(np.diff(log.time_ns("plant"))), [10_000_000])
    assert cosim.diff(log, cosim.replay(tmp_path / "a.mcap")).equal


def test_a_start_value_of_the_fmu_can_be_set(folder):
    """Start values come from the FMU unless set; a misspelt variable is refused before the run."""
    short = {"scenario.stop": 0.01}
    changes = {**short, "plant.start": {"x_a[0]": 2.0}}
    run = cosim.run("academic", swap={"plant": folder / "plant.fmu"}, set=changes)
    assert list(run["plant.x_a"][0]) == [2.0, -1.0]
    with pytest.raises(ScenarioError, match=r"x_a\[2\].*did you mean"):
        cosim.run(
            "academic", swap={"plant": folder / "plant.fmu"}, set={"plant.start": {"x_a[2]": 2.0}}
        )


# --- plants of other makes ---

SHORT = {"scenario.stop": 9.0}  # theta is there from 6.5 s on
INPUTS = {
    "components.one": {"kind": "constant", "value": 1.0},
    "connections.plant.gain": "one.y",
    "connections.plant.sign": "one.y",
}
# y = x1 - u of an FMU that holds its inputs belongs to their mean: late by half a step
LATE = {
    "components.late": {"kind": "expression", "y": "0.5*(sin(t) - sin(max(t - 0.001, -t)))"},
    "components.measured": {"kind": "sum", "signs": [1.0, 1.0]},
    "connections.measured.u1": "plant.y",
    "connections.measured.u2": "late.y",
}


def theta(run):
    return run["identifier.theta"][-1]


MAKES = {  # interface type, changes, which run is alike, how far from it theta may be
    "pythonfmu3 model exchange 3": ("me", {"plant.solver": "rk4"}, "rk4", 1e-9),
    "pythonfmu co-simulation 2": ("cs", INPUTS, "late", 7e-7),
    "pythonfmu3 co-simulation 3": ("cs", {}, "late", 7e-7),
}


@pytest.mark.slow
def test_a_plant_of_another_make_identifies_the_same(foreign2, foreign3):
    """With pythonfmu3's derivatives y differs by rounding, and theta with it.

    This is 2e-16, which the filter makes 1e3 times as much in delta_hat. In 2.5 s that is 3e-13,
    which the smallest eigenvalue of the information, 1.9e-5, makes 7e-11 in eta at most, and theta
    is its logarithm over 0.2 s or more: 1e-9 with room. The mean of the inputs leaves h^2/12 and
    pythonfmu's own solvers h^2/6 at most of signals up to 2.7: 7e-7 in y beside what is late. Both
    are at the rates of these signals, as the 5e-4 that are late: theta responds to both alike.

    The eigenvalues of A are -1.5 +- 0.87i. So rk4 errs by (sqrt(3) h)^4/120 = 8e-14 of signals up
    to 2.7, to which theta2 responds tenfold: 2e-12.
    """
    late = LATE | {"connections.observer.y": "measured.y"}
    forms = {"exact": {}, "rk4": {"plant.solver": "rk4"}, "late": late}
    generated = {form: theta(signals("academic", set=SHORT | forms[form])) for form in forms}
    assert abs(generated["rk4"] - generated["exact"]).max() <= 3e-12
    for name, (interface_type, changes, like, tolerance) in MAKES.items():
        swap = {"plant": f"{foreign3 if 'fmu3' in name else foreign2}#{interface_type}"}
        found = theta(signals("academic", swap=swap, set=SHORT | changes))
        if like == "late":
            tolerance *= abs(generated["late"] - generated["exact"]).max() / 5e-4
        assert abs(found - generated[like]).max() <= tolerance, name
