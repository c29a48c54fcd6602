"""Outputs that change at every n-th step only: because of an inner step, and for other reasons."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.fmi.driving.inner_step import InnerStep


def detections(outputs, inputs, watch=None):
    """Return (number of the step, n) where an inner step is detected."""
    inputs = np.reshape(inputs, (len(outputs), -1))
    watch = watch or InnerStep(np.array([0]), inputs.shape[1])
    detected = []
    for k, (y, u) in enumerate(zip(outputs, inputs, strict=True)):
        n = watch.observe(np.array([y]), u)
        if n:
            detected.append((k, n))
    return detected


STEPS = np.arange(400)
STILL = np.zeros(len(STEPS))
MOVING = np.sin(STEPS)


@given(n=st.integers(2, 35), moves=st.booleans(), rest=st.integers(0, 30))
def test_an_inner_step_is_detected_once(n, moves, rest):
    """It is detected at the spell that eight others have equaled, whatever the inputs do.

    After a rest the first spell does not count.
    """
    intervals = np.maximum((STEPS - rest) // n, 0)
    k = rest + 10 * n if rest else 9 * n
    assert detections(np.exp(-0.1 * intervals), MOVING if moves else STILL) == [(k, n)]


@given(n=st.floats(1.1, 9.0), begin=st.floats(0.0, 1.0))
def test_an_inner_step_that_the_step_does_not_divide_is_detected(n, begin):
    """Outputs change after 3, 2, 3, 2 steps where n is 2.5: what 32 intervals show of it."""
    intervals = np.floor(STEPS / n + begin)
    found = detections(np.exp(-0.01 * intervals), MOVING)
    uneven = np.unique(np.diff(np.flatnonzero(np.diff(intervals)))[:32]).size > 1
    assert len(found) == 1
    if uneven and found[0][1] != int(found[0][1]):
        assert found[0][1] == pytest.approx(n, abs=1.0 / 32)


def test_nothing_else_is_taken_for_one(subtests):
    for number, (outputs, inputs) in enumerate(
        [
            (STILL, MOVING),
            (STILL, STILL),
            (MOVING, MOVING),
            (STEPS // 10, STEPS // 10),
            ((STEPS - 3) // 10, STEPS // 10),
            (STEPS // 10 % 2, STILL),
            (1.0 + 2.0**-52 * (STEPS // 10), STILL),
            (np.random.default_rng(1).poisson(0.5, len(STEPS)).cumsum(), STILL),
            (
                np.random.default_rng(1).integers(2, 4, len(STEPS)).cumsum().searchsorted(STEPS),
                STILL,
            ),
            (np.exp(-0.1 * np.floor(STEPS / 2.5)), np.floor(STEPS / 2.5)),
            (np.floor(STEPS / 2.5), STILL),  # a quantized ramp
        ]
    ):
        with subtests.test(number=number):
            assert detections(outputs.astype(float), inputs.astype(float)) == []


@pytest.mark.parametrize(("outside", "found"), [(STILL, True), (STEPS // 10, False)])
def test_an_input_from_a_loop_of_its_own_hides_nothing(outside, found):
    """It changes with the output, as it follows it; another input every tenth step is a reason."""
    outputs = np.exp(-0.1 * (STEPS // 10))
    inputs = np.column_stack([-outputs, outside])
    assert detections(outputs, inputs) == []
    watch = InnerStep(np.array([0]), 2)
    watch.in_loop[0] = True
    assert detections(outputs, inputs, watch) == [(90, 10)] * found
    assert watch.is_shared == found


def test_an_inner_step_beside_a_loop_that_moves_is_its_own():
    watch = InnerStep(np.array([0]), 1)
    watch.in_loop[:] = True
    assert detections(np.exp(-0.1 * (STEPS // 10)), MOVING, watch) == [(90, 10)]
    assert not watch.is_shared


def test_the_history_can_be_restored():
    """A run that goes back and on again detects the same at the same step."""
    uneven = np.exp(-0.01 * np.floor(STEPS / 2.5))
    watch = InnerStep(np.array([0]), 1)
    detections(uneven[:55], MOVING[:55], watch)
    kept = watch.history
    first = detections(uneven[55:], MOVING[55:], watch)
    watch.history = kept
    assert detections(uneven[55:], MOVING[55:], watch) == first != []

    outputs = np.exp(-0.1 * (STEPS // 10))
    watch = InnerStep(np.array([0]), 1)
    detections(outputs[:55], MOVING[:55], watch)
    history = watch.history
    first = detections(outputs[55:], MOVING[55:], watch)
    watch.history = history
    assert detections(outputs[55:], MOVING[55:], watch) == first != []
    watch.reset()
    assert detections(outputs, MOVING, watch) != []
