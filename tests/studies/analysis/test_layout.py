"""Layouts follow from planned designs, and say what of them was drawn independently."""

import numpy as np
import pytest

import cosim
from cosim.studies.analysis.independence import StudyLayout, drawn_members, independence_of
from cosim.studies.analysis.sensitivity import sobol_indices
from cosim.studies.design.planning import plan_design
from cosim.studies.document.reading import read_study
from tests.studies.analysis.made import columns_of

THETA = {"delta.terms[0].theta": {"uniform": [-0.2, -0.1]}}
RATE = {"observer.filter_rate": [100.0, 300.0, 1000.0]}


def planned(**options):
    return plan_design(read_study("academic-noisy").with_options(**options), SCENARIO)


SCENARIO = cosim.load("academic-noisy")


@pytest.mark.parametrize(
    ("options", "text", "units"),
    [
        ({"vary": RATE}, "grid of 3", None),
        ({"vary": {}, "seeds": 5}, "5 seeds", 5),
        ({"vary": THETA, "samples": 1}, "random: 1 sample", 1),
        ({"vary": RATE, "seeds": 5}, "grid of 3 x 5 seeds", 5),
        ({"vary": {**THETA, **RATE}, "samples": 8}, "random: 8 samples x grid of 3", 8),
        (
            {"vary": {**THETA, **RATE}, "samples": 8, "seeds": 2, "sampling": "sobol"},
            "sobol: 8 samples x grid of 3 x 2 seeds",
            8,
        ),
        ({"vary": THETA, "samples": 4, "sampling": "saltelli"}, "saltelli: 4 base points x 3", 12),
    ],
)
def test_a_design_has_a_layout(options, text, units):
    """With as many independent units as were drawn."""
    design = planned(**options)
    layout = StudyLayout.of(design)
    assert layout.text == text
    assert StudyLayout.from_dict(layout.to_dict()) == layout
    independence = independence_of(layout)
    assert independence.is_drawn == (units is not None)
    if units is not None:
        numbers = np.arange(len(design))
        found = independence.units_of(numbers)
        assert len(np.unique(numbers if found is None else found)) == units


def test_members_of_one_unit_share_what_was_drawn():
    """Those of a sample its values; those of a seed of a grid their noise."""
    design = planned(vary={**THETA, **RATE}, samples=6, seeds=2)
    independence = independence_of(StudyLayout.of(design))
    units = independence.units_of(np.arange(len(design)))
    theta = np.array(design.column("delta.terms[0].theta"))
    assert len(np.unique(theta)) == 6
    for unit in np.unique(units):
        assert len(np.unique(theta[units == unit])) == 1
    layout = StudyLayout.of(planned(vary=RATE, seeds=4))
    design = planned(vary=RATE, seeds=4)
    (name, *_) = layout.noise_seeds
    seeds = np.array(design.column(name))
    units = independence_of(layout).units_of(np.arange(len(design)))
    for unit in range(4):
        assert len(np.unique(seeds[units == unit])) == 1
    assert len(np.unique(seeds)) == 4


def test_the_members_of_a_base_point_of_saltellis_design_have_one_noise():
    """So they count together in what is said of the mean."""
    design = planned(vary=THETA, samples=4, sampling="saltelli", seeds=2)
    layout = StudyLayout.of(design)
    units = independence_of(layout).units_of(np.arange(len(design)))
    assert units.tolist() == [0, 0, 1, 1, 2, 2, 3, 3] * 3
    (name, *_) = layout.noise_seeds
    seeds = np.array(design.column(name))
    for unit in range(4):
        assert len(np.unique(seeds[units == unit])) == 2


def test_sobol_indices_of_a_planned_design_are_those_of_the_closed_form():
    """The Ishigami function of the parameters of its members, within 0.02."""
    keys = ("delta.terms[0].theta", "delta.terms[1].theta", "observer.filter_rate")
    vary = {key: {"uniform": [-np.pi, np.pi]} for key in keys}
    design = planned(vary=vary, samples=4096, sampling="saltelli", seed=3)
    first, second, third = (np.array(design.column(key)) for key in keys)
    values = np.sin(first) + 7.0 * np.sin(second) ** 2 + 0.1 * third**4 * np.sin(first)
    layout = StudyLayout.of(design)
    found = sobol_indices(columns_of({"y": values}), layout, "y")
    assert found.parameters == keys
    # by the closed form of Ishigami and Homma, for a = 7 and b = 0.1
    assert np.abs(found.first_order - [0.313905, 0.442411, 0.0]).max() < 0.02
    assert np.abs(found.total_order - [0.557589, 0.442411, 0.243684]).max() < 0.02
    drawn = drawn_members(columns_of({"y": values}), layout)
    assert len(drawn.numbers) == 2 * 4096
    # the mean of the Ishigami function is a / 2
    assert drawn.metric("y").values.mean() == pytest.approx(3.5, abs=0.1)
