"""Every method of identification keeps the contract of an estimator, and the contract can fail."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cosim.arrays import NAN
from cosim.blocks.adaptive_identifier import AdaptiveIdentifier
from cosim.blocks.estimator import Estimator
from cosim.blocks.identification_problem import IdentificationProblem, IdentificationSchedule
from cosim.blocks.identifier import LeastSquaresIdentifier
from cosim.blocks.kalman_identifier import (
    AugmentedKalmanIdentifier,
    ExtendedKalmanIdentifier,
    check_positive,
)
from cosim.blocks.output_error_identifier import OutputErrorIdentifier
from cosim.blocks.projection_identifier import ProjectionIdentifier, RayleighIdentifier
from cosim.blocks.regressor import Regressor
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError
from cosim.native.numerics.expression import compile_expression
from cosim.testing import check_estimator
from cosim.theory.disturbances.families import group_by_alpha
from cosim.theory.disturbances.regression import expand
from cosim.theory.disturbed_plant import DisturbedPlant
from cosim.theory.estimators import defaults
from cosim.theory.estimators.least_squares import plan
from cosim.theory.estimators.rayleigh import rayleigh_constants
from tests.native.estimation.online import online

BOUNDS = np.full(2, np.inf)
GROWING = DisturbedPlant(
    A=[[1.0]], B=[[1.0]], Bd=[[1.0, 1.0]], C=[[1.0]], D=[[0.0]], Dd=[[0.0, 0.0]]
)


def regression(case):
    groups = group_by_alpha(case.alphas, case.families)
    return groups, expand(tuple(group.size for group in groups))


def problem(case):
    groups, terms = regression(case)
    programs = [compile_expression(group.alpha) for group in groups]
    steps = [round(delay / case.h) for delay in case.delays]
    products = Regressor(terms, alphas=programs, steps=steps, delays=case.delays).constants
    rayleigh = rayleigh_constants(case.families, groups, terms, case.delays)
    return IdentificationProblem(
        plant=case.plant,
        modes=np.zeros((0, 0)),
        row=np.zeros(0),
        rayleigh=rayleigh,
        products=products,
        alphas=[compile_expression(alpha) for alpha in case.alphas],
        families=case.families,
    )


def schedule(case):
    return IdentificationSchedule(
        period=10,
        steps=case.steps,
        average=50,
        window=0,
        forgetting=1.0,
        start=case.start,
        settled=0.0,
        lag=0.0,
    )


def least_squares(case):
    groups, terms = regression(case)
    recovery = plan(terms, groups, case.delays)
    return LeastSquaresIdentifier(recovery, start_time=case.start)


def adaptive(law, gain, forgetting=np.inf):
    def make(case):
        groups, terms = regression(case)
        recovery = plan(terms, groups, case.delays)
        method = AdaptiveIdentifier(
            law=law, recovery=recovery, start_time=case.start, gain=gain, forgetting=forgetting
        )
        return Estimator(method)

    return make


def output_error(case):
    method = OutputErrorIdentifier(
        problem(case), schedule(case), offset=False, lower=-BOUNDS, upper=BOUNDS
    )
    return Estimator(method)


def projection(case):
    return Estimator(ProjectionIdentifier(problem(case), schedule(case), -BOUNDS, BOUNDS))


def rayleigh(case):
    return Estimator(RayleighIdentifier(problem(case), schedule(case)))


def extended_kalman(case, inflation=100.0):
    method = ExtendedKalmanIdentifier(
        problem=problem(case), deviation=inflation * case.deviation, size=case.size
    )
    return Estimator(method)


def augmented_kalman(case):
    method = AugmentedKalmanIdentifier(
        problem=problem(case),
        schedule=schedule(case),
        deviation=case.deviation,
        size=case.size,
        intensity=case.size**2,
    )
    return Estimator(method)


# What each leaves of exact signals; the rows of the regression are exact.
ESTIMATORS = {
    "output-error": (output_error, 1e-9),
    "least-squares": (least_squares, 1e-9),
    "projection": (projection, 1e-9),
    "rayleigh": (rayleigh, 1e-6),
    "augmented-kalman": (augmented_kalman, 1e-3),
    "extended-kalman": (extended_kalman, 0.0),
    "drem": (adaptive("drem", defaults.DREM_GAIN, defaults.DREM_FORGETTING), 1e-6),
    "gradient": (adaptive("gradient", defaults.GRADIENT_GAIN), np.inf),
}


@pytest.mark.fast("extended-kalman", "gradient", "least-squares", "rayleigh", "drem")
@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_method_keeps_the_contract_of_an_estimator(name):
    """With the error that it is known to leave."""
    make, accuracy = ESTIMATORS[name]
    check_estimator(make, accuracy=accuracy)


@pytest.mark.parametrize("growth", [-0.5, 0.0, 0.01, 1.0])
def test_what_is_designed_for_a_run_does_not_depend_on_its_length(growth):
    """A mode that grows is always predicted; only longer data need all grids of starts."""
    plant = replace(GROWING, A=[[growth]])
    first, longer = (online(plant, steps=steps).method for steps in (100, 100_000))
    held = np.zeros(9, np.bool_)
    design = first.design(0.01, held)
    of_longer = longer.design(0.01, held)
    assert bool(of_longer["K"].any()) == (growth > 0.0)
    assert design.keys() == of_longer.keys()
    for name, value in design.items():
        np.testing.assert_array_equal(of_longer[name], value)
    # delays of 0.1, 0.2, 0.3 s: 0.2 s 4^2 > 1 s, 0.2 s 4^7 > 1000 s
    assert first.constants(0.01, held, design).reach == (20, 80, 320)
    assert len(longer.constants(0.01, held, design).reach) == 8


def test_an_older_design_has_one_grid_for_all_data():
    """As logs have it: what they replay is what they were."""
    component = online(GROWING)
    held = np.zeros(9, np.bool_)
    design = dict(component.method.design(0.01, held))
    del design["grids"]
    assert component.prepare(0.01, held, design) == design
    assert len(component.method.constants(0.01, held, design).grids) == 1


def test_grids_of_starts_cover_what_data_of_their_length_tell_apart():
    """The first has growth by ten over the delays, each other over four times as much data.

    Within bounds; where they leave a grid no width, it is that of the nearest that has one.
    """
    of = online(GROWING).method.problem  # delays of 0.1, 0.2, 0.3 s
    assert [of.reach(number) for number in range(3)] == pytest.approx([0.2, 0.8, 3.2])
    free = of.boxes(-BOUNDS, BOUNDS)[:3]
    assert free[:, 0] == pytest.approx(np.full((3, 2), -30.0))
    growth = np.log(10.0) / np.array([0.2, 0.8, 3.2])
    np.testing.assert_allclose(free[:, 1], np.column_stack([growth, growth]))
    bounded = of.boxes(np.array([2.0, -1.0]), np.array([4.0, 0.5]))[:3]
    np.testing.assert_allclose(bounded[:, 1, 0], [4.0, growth[1], growth[1]])
    np.testing.assert_allclose(bounded[:, 0], [[2.0, -1.0]] * 3)
    np.testing.assert_allclose(bounded[:, 1, 1], [0.5, 0.5, 0.5])


def test_the_extended_filter_is_overconfident():
    """Told the deviation of the noise itself, its standard errors do not hold its error."""
    with pytest.raises(AssertionError, match="theta from exact signals"):
        check_estimator(lambda case: extended_kalman(case, inflation=1.0))


class Guess:
    """An estimator that is wrong in a way of its own."""

    def __init__(self, *, first=NAN, later=NAN, unit=0.0, error=NAN, by_block=0.0):
        self._first = first
        self._values = later, unit, error, by_block
        inputs = (Signal("y", 1, role="input"),)
        outputs = (
            Signal("theta", 2, optional=True, role="estimate"),
            Signal("standard_error", 2, optional=True, role="estimate"),
        )
        self.interface = Interface(inputs, outputs, delayed=("y",))

    def initialize(self, t, u):
        self._last = np.array([self._first, self._first, NAN, NAN])
        return self._last.copy()

    def outputs(self, t, u):
        return self._last.copy()

    def advance(self, t, h, u):
        later, unit, error, by_block = self._values
        rows = np.empty((len(t) - 1, 4))
        for k in range(len(rows)):
            if u[k, 0] != 0.0:
                theta = later + unit * u[k, 0] + by_block * (k > 40)
                self._last = np.array([theta, 3.0 * theta, error, error])
            rows[k] = self._last
        return rows


@pytest.mark.parametrize(
    ("wrong", "law"),
    [
        ({"first": 1.0}, "theta at the start"),
        ({"first": NAN, "later": -0.2}, "theta from exact signals"),
        ({"later": -0.1, "unit": 1e-3}, "in units of 4096"),
        ({"later": -0.1, "unit": 1e-12, "by_block": 1e-3}, "blocks of 1"),
        ({"later": -0.1, "error": 1e-3}, "theta from noise alone, seed 0"),
    ],
)
def test_a_broken_law_is_named(wrong, law):
    """Each wrong estimator fails at its law."""
    with pytest.raises(AssertionError, match=law):
        check_estimator(lambda case: Guess(**wrong), accuracy=0.01)


def test_inputs_that_no_case_has_are_named():
    """With those that there are."""

    class Other(Guess):
        def __init__(self):
            super().__init__()
            self.interface = Interface((Signal("z", 1, role="input"),), self.interface.outputs)

    with pytest.raises(AssertionError, match=r"input 'z' of size 1: .* y \(1\), u \(1\)"):
        check_estimator(lambda case: Other())


def test_numbers_of_kalman_filters_are_positive_and_finite():
    for value in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(UsageError, match=f"drift: expected a finite number > 0, got {value}"):
            check_positive(drift=value)
    check_positive(drift=1e-300)
