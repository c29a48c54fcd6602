"""The noise of a residual is found whatever the record is interrupted by."""

import numpy as np
import pytest
from scipy.signal import lfilter

from cosim.scenario.kinds.identified_plant import residual_noise

SAMPLES = 2000
STEP = 0.01


@pytest.mark.parametrize("pause", [0.0, 1.0, 1000.0])
def test_a_pause_in_the_record_hides_no_color(pause):
    """AR(1) has (1 + a)/(1 - a) of its mean power at 0, known to 8 ((1 - a^2)/N)^1/2; four times.

    Also where the samples of the middle of the record, in time, are none.
    """
    noise = lfilter([1.0], [1.0, -0.5], np.random.default_rng(1).standard_normal(SAMPLES))
    t = STEP * np.arange(SAMPLES)
    t[SAMPLES // 2 :] += pause
    problem, power, _ = residual_noise(t, noise)
    assert problem == ""
    assert power == pytest.approx(3.0, abs=4.0 * 8.0 * np.sqrt(0.75 / SAMPLES))
