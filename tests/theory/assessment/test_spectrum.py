"""The spectrum of a residual: white noise is within its limits, what is not white is not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import periodogram

from cosim.errors import AssumptionError
from cosim.theory.assessment.spectrum import whiteness_spectrum


def test_it_is_the_mean_of_a_periodogram():
    """Of scipy's, over the same frequencies: the lowest stand alone, all together have mean 1."""
    noise = np.random.default_rng(1).standard_normal((2001, 2))
    found = whiteness_spectrum(noise, 0.01)
    f, density = periodogram(noise, fs=100.0, detrend=False, axis=0)
    assert found.frequency[:3] == pytest.approx(f[1:4])
    level = density[1:1001].mean(axis=0)
    np.testing.assert_allclose(found.power[:3], density[1:4] / level, rtol=1e-12)


def test_white_noise_is_within_the_limits_in_95_percent():
    """Of all bands and seeds; the bands are independent."""
    inside = []
    for seed in range(40):
        noise = np.random.default_rng(seed).standard_normal((4001, 1))
        found = whiteness_spectrum(noise, 1.0)
        power = found.power[:, 0]
        inside.append((found.lower <= power) & (power <= found.upper))
    assert np.mean(inside) == pytest.approx(0.95, abs=4.0 * np.sqrt(0.05 * 0.95 / np.size(inside)))


def test_a_sine_and_slow_noise_stand_out():
    """A sine of a tenth of the noise's deviation is far above the limit at its frequency."""
    rng = np.random.default_rng(2)
    t = np.arange(8000) * 0.01
    wave = 0.3 * np.sin(2.0 * np.pi * 0.5 * t)
    found = whiteness_spectrum((rng.standard_normal(8000) + wave)[:, np.newaxis], 0.01)
    place = int(np.argmax(found.power[:, 0] / found.upper))
    assert found.frequency[place] == pytest.approx(0.5, rel=0.1)
    assert found.power[place, 0] > 10.0 * found.upper[place]
    slow = np.cumsum(rng.standard_normal(8000))[:, np.newaxis]
    assert whiteness_spectrum(slow, 0.01).power[-1, 0] < 0.1


def test_a_residual_of_zeros_has_a_spectrum_of_zeros():
    """There is no level to divide by."""
    assert not whiteness_spectrum(np.zeros((100, 1)), 1.0).power.any()


def test_too_few_samples_are_refused():
    """Three make one ordinate."""
    assert len(whiteness_spectrum(np.ones((3, 1)), 1.0).power) == 1
    with pytest.raises(AssumptionError, match="2 samples; a spectrum needs at least 3"):
        whiteness_spectrum(np.ones((2, 1)), 1.0)
