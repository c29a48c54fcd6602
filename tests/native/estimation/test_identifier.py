"""The compiled identifier: what it knows of the samples that it was given."""

from __future__ import annotations

import numpy as np

from tests.native.estimation.online import H, online
from tests.theory.closed_forms import static_plant

T = np.arange(401) * H


def test_initialized_again_it_knows_nothing_of_the_samples_before():
    """There is no value at first; then the theta, without error, of the samples of this run."""
    estimator = online(static_plant(1), count=1)
    interface = estimator.interface
    estimator.prepare(H, np.zeros(interface.n_u, np.bool_), {})
    columns = interface.input_columns()
    for theta in (-0.3, -0.8):
        u = np.full((len(T), interface.n_u), np.nan)
        y = 2.0 * (1.35 + 0.25 * np.sin(1.7 * T)) * np.exp(theta * T)
        u[:, columns["y"]] = y[:, np.newaxis]
        assert np.isnan(estimator.initialize(0.0, u[0])).all()
        outputs = estimator.advance(T, H, u)
        found = outputs[:, interface.output_columns()["theta"]]
        assert np.isnan(found[:99]).all()
        # the rounding of y, over what 400 samples say of theta
        np.testing.assert_allclose(found[-1], [theta], rtol=1e-12)
