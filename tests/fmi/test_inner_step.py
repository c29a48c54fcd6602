"""Outputs that change at every n-th step only, for the one reason that is looked for, and for others."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.fmi.driving.inner_step import InnerStep


def look(outputs, inputs, watch=None):
    """Give (number of the step, n) of what is found."""
    watch = watch or InnerStep(np.array([0]))
    found = [
        (k, watch.observe(np.array([y]), np.array([u])))
        for k, (y, u) in enumerate(zip(outputs, inputs, strict=True))
    ]
    return [(k, n) for k, n in found if n]


STEPS = np.arange(400)
STILL, MOVING = np.zeros(len(STEPS)), np.sin(STEPS)


@given(n=st.integers(2, 35), moves=st.booleans(), late=st.integers(0, 30))
def test_an_inner_step_is_found_once(n, moves, late):
    """Whatever the inputs do: with the spell that eight others have equalled, the first one not counted after a rest."""
    outputs = np.exp(-0.1 * np.maximum((STEPS - late) // n, 0))
    assert look(outputs, MOVING if moves else STILL) == [(late + 10 * n if late else 9 * n, n)]


@pytest.mark.parametrize(
    ("outputs", "inputs"),
    [
        (STILL, MOVING),
        (STILL, STILL),
        (MOVING, MOVING),
        (STEPS // 10, STEPS // 10),
        ((STEPS - 3) // 10, STEPS // 10),
        (STEPS // 10 % 2, STILL),
        (1.0 + 2.0**-52 * (STEPS // 10), STILL),
        (np.random.default_rng(1).poisson(0.5, len(STEPS)).cumsum(), STILL),
    ],
    ids=[
        "rest, moved",
        "rest",
        "lively",
        "held input",
        "held input, late",
        "pulse",
        "creeping",
        "irregular",
    ],
)
def test_nothing_else_is_taken_for_one(outputs, inputs):
    assert look(outputs.astype(float), inputs.astype(float)) == []


def test_what_was_seen_can_be_put_back():
    """A run that goes back and on again finds the same at the same step."""
    outputs = np.exp(-0.1 * (STEPS // 10))
    watch = InnerStep(np.array([0]))
    look(outputs[:55], MOVING[:55], watch)
    history = watch.history
    first = look(outputs[55:], MOVING[55:], watch)
    watch.history = history
    assert look(outputs[55:], MOVING[55:], watch) == first != []
    watch.reset()
    assert look(outputs, MOVING, watch) != []
