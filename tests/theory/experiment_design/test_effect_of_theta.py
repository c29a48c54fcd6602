"""How far theta shows in a disturbance, beyond what its constants make up for."""

import numpy as np
import pytest

from cosim.theory.disturbances.families import Exponential, Sine
from cosim.theory.experiment_design.effect_of_theta import effect_of_theta

T = np.linspace(0.0, 8.0, 10001)  # more than one block


def beyond(slopes, basis):
    """Return what of slopes no combination of basis makes."""
    found = np.linalg.lstsq(basis, slopes, rcond=None)[0]
    return slopes - basis @ found


def test_an_exponential_changes_by_what_its_amplitude_does_not_make_up_for():
    """Its derivative a t exp(theta t), less its part along exp(theta t); alpha times both."""
    theta = -0.3
    alpha = 1.0 + 0.5 * np.sin(T)
    function = alpha * np.exp(theta * T)
    left = beyond(2.0 * T * function, function[:, np.newaxis])
    expected = np.linalg.norm(left) / np.linalg.norm(2.0 * function) / 8.0
    found = effect_of_theta(
        [Exponential()], np.array([theta]), T, alpha[:, np.newaxis], 2.0 * function
    )
    assert found == pytest.approx(expected, rel=1e-9)


def test_the_weakest_direction_of_two_sines_counts():
    """Their derivatives a t cos(w t + p), less sines and cosines of both: a singular value."""
    rates = np.array([2.0, 1.7])
    delta = 0.7 * np.sin(2.0 * T + 0.4) + 0.2 * np.sin(1.7 * T)
    slopes = np.column_stack([0.7 * T * np.cos(2.0 * T + 0.4), 0.2 * T * np.cos(1.7 * T)])
    waves = [f(w * T) for w in rates for f in (np.sin, np.cos)]
    left = beyond(slopes, np.column_stack(waves))
    expected = np.linalg.svd(left, compute_uv=False)[-1] / np.linalg.norm(delta) / 8.0
    found = effect_of_theta([Sine(), Sine()], rates, T, np.ones((len(T), 2)), delta)
    assert found == pytest.approx(expected, rel=1e-7)


def test_a_sine_that_is_absent_or_twice_there_has_no_effect(subtests):
    """Nothing but rounding: the amplitude is 0, or each of the two may be either."""
    for second in [0.0, 1.0]:
        with subtests.test(second=second):
            delta = (1.0 + second) * np.sin(2.0 * T)
            rates = np.array([2.0, 2.0 if second else 1.0])
            found = effect_of_theta([Sine(), Sine()], rates, T, np.ones((len(T), 2)), delta)
            assert found < 1e-12
            assert (
                effect_of_theta([Sine()], np.array([2.0]), T, np.ones((len(T), 1)), 0.0 * T) == 0.0
            )
