"""One scenario on nine plants and one of other names.

The theta of each is within the tolerance derived for it.
"""

from dataclasses import replace

import pytest

import cosim
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import find
from cosim.scenario.exporting import export_component
from tests.scenario.signals import signals
from tests.scenario.swapping.renamed import MAP, renamed

pytestmark = pytest.mark.slow

SHORT = {"scenario.stop": 9.0}  # theta is there from 6.5 s on
RK4 = {"plant.solver": "rk4"}
ME = {"plant.interface_type": "me", "plant.solver": "rk4"}
CS = {"plant.interface_type": "cs"}
INPUTS = {
    "components.one": {"kind": "constant", "value": 1.0},
    "connections.plant.gain": "one.y",
    "connections.plant.sign": "one.y",
}
# y = x1 - u of an FMU that holds its inputs belongs to their mean: late by half a step
LATE = {
    "components.late": {
        "kind": "expression",
        "y": "0.5*(sin(t) - sin(max(t - 0.001, -t)))",
    },
    "components.measured": {"kind": "sum", "signs": [1.0, 1.0]},
    "connections.measured.u1": "plant.y",
    "connections.measured.u2": "late.y",
}
MATRIX = {  # plant: file, changes, how far from which run theta may be
    "model exchange 2": ("fmi2", ME, "rk4", 0.0),
    "model exchange 3": ("fmi3", ME, "rk4", 0.0),
    "co-simulation 2": ("fmi2", CS, "exact", 0.0),
    "co-simulation 3": ("fmi3", CS, "exact", 0.0),
    "recorded log": ("log", {}, "exact", 0.0),
    "other names": ("renamed", CS, "exact", 1e-9),
    "pythonfmu3 model exchange 3": ("foreign3", ME, "rk4", 1e-9),
    "pythonfmu co-simulation 2": ("foreign2", INPUTS, "late", 7e-7),
    "pythonfmu3 co-simulation 3": ("foreign3", CS, "late", 7e-7),
}


def theta(run):
    return run["identifier.theta"][-1]


@pytest.fixture(scope="module")
def files(tmp_path_factory, foreign2, foreign3):
    """Return what can take the plant's place."""
    folder = tmp_path_factory.mktemp("matrix")
    own = {f"fmi{version}": folder / f"fmi{version}.fmu" for version in "23"}
    for name, path in own.items():
        export_component("academic", "plant", path, fmi=name[-1])
    cosim.run("academic", set=SHORT, out=folder / "log.mcap")
    return {
        **own,
        "log": folder / "log.mcap",
        "renamed": renamed(folder / "x.fmu"),
        "foreign2": foreign2,
        "foreign3": foreign3,
    }


@pytest.fixture(scope="module")
def generated():
    """Return the runs of the generated plant.

    One solves it exactly, one by rk4, and one has y late by half a step.
    """
    text = find("academic")
    measured = replace(
        text, text=text.text.replace('"observer.y" = "plant.y"', '"observer.y" = "measured.y"')
    )
    return {
        "exact": signals("academic", set=SHORT),
        "rk4": signals("academic", set=SHORT | RK4),
        "late": signals(parse(measured.with_changes(SHORT | LATE))),
    }


@pytest.mark.parametrize("plant", MATRIX)
def test_a_plant_of_another_make_identifies_the_same(plant, files, generated):
    """The bits of theta are equal where the arithmetic is the same.

    This is so for rk4 on our derivatives, the exact discretization, and what was recorded.

    With the inputs added in another order, and with pythonfmu3's derivatives, y differs by
    rounding: 2e-16, which the filter makes 1e3 times as much in delta_hat. In 2.5 s that is 3e-13,
    which the smallest eigenvalue of the information, 1.9e-5, makes 7e-11 in eta at most, and theta
    is its logarithm over 0.2 s or more: 1e-9 with room. The mean of the inputs leaves h^2/12 and
    pythonfmu's own solvers h^2/6 at most of signals up to 2.7: 7e-7 in y beside what is late. Both
    are at the rates of these signals, as the 5e-4 that are late: theta responds to both alike.
    """
    file, changes, like, tolerance = MATRIX[plant]
    names = MAP if file == "renamed" else {}
    found = theta(signals("academic", swap={"plant": files[file]}, map=names, set=SHORT | changes))
    if like == "late":
        tolerance *= abs(theta(generated["late"]) - theta(generated["exact"])).max() / 5e-4
    assert abs(found - theta(generated[like])).max() <= tolerance


def test_rk4_identifies_what_the_exact_solver_does(generated):
    """The eigenvalues of A are -1.5 +- 0.87i.

    So rk4 errs by (sqrt(3) h)^4/120 = 8e-14 of signals up to 2.7, to which theta2 responds tenfold:
    2e-12.
    """
    assert abs(theta(generated["rk4"]) - theta(generated["exact"])).max() <= 3e-12
