"""A compiled step reads its inputs wherever they are in memory."""

import numpy as np

from cosim.blocks.arithmetic import sum_of


def test_inputs_may_have_any_order_in_memory():
    """Rows one behind the other, columns, or every other row of more."""
    u = np.random.default_rng(1).random((6, 2))
    every_other = np.repeat(u, 2, axis=0)[::2]
    t = 0.1 * np.arange(6)
    for given in (u, np.asfortranarray(u), every_other):
        component = sum_of([1.0, -2.0])
        component.initialize(0.0, given[0])
        y = component.native().advance(t, 0.1, given)
        assert np.array_equal(y[:, 0], u[1:, 0] - 2.0 * u[1:, 1])
