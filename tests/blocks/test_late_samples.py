"""Samples that come late: each in the row that ends the step of its instant."""

import numpy as np
import pytest

from cosim.blocks.dynamics import Delay
from cosim.blocks.late_samples import MOST_IN_A_STEP, LateSamples
from cosim.core.contracts import Stopped
from cosim.core.signals import Interface, Signal
from cosim.testing import check_component

H = 0.5
STEPS = 3


class Rows:
    """Returns the rows that it takes, and their times."""

    def __init__(self):
        self.interface = Interface(
            (
                Signal("samples", 2 * MOST_IN_A_STEP, optional=True),
                Signal("sample_times", MOST_IN_A_STEP, optional=True),
                Signal("u", 1),
            ),
            (Signal("row", 3 * MOST_IN_A_STEP + 2, optional=True),),
            delayed=("samples", "sample_times", "u"),
            rollback=True,
        )

    def initialize(self, t, u):
        self._last = np.full(3 * MOST_IN_A_STEP + 2, np.nan)
        return self._last.copy()

    def outputs(self, t, u):
        return self._last.copy()

    def advance(self, t, h, u):
        rows = np.column_stack([t[:-1], u[:-1]])
        self._last = rows[-1].copy()
        return rows

    def save(self):
        return self._last

    def restore(self, state):
        self._last = state


class CompiledRows(Delay):
    """Returns the rows that it takes, by a compiled step."""

    def __init__(self):
        super().__init__(1, initial=0.0, size=3 * MOST_IN_A_STEP + 1)
        row = Signal("row", 3 * MOST_IN_A_STEP + 1, optional=True)
        inputs = Rows().interface.inputs
        names = tuple(signal.name for signal in inputs)
        self.interface = Interface(inputs, (row,), delayed=names, rollback=True, native=True)


def inputs(count, delay, jitter=0.0, seed=3):
    """Return rows of two samples, their instant and u, one a step; none of before the start."""
    t = np.arange(count + 1) * H
    deviation = jitter * np.random.default_rng(seed).uniform(-1.0, 1.0, count + 1)
    instants = t - delay * H + deviation * H
    instants[instants < 0.0] = np.nan
    samples = np.where(np.isnan(instants), np.nan, np.arange(count + 1.0))
    return t, np.column_stack([samples, 10.0 * samples, instants, np.cos(t)])


@pytest.mark.parametrize(("delay", "jitter"), [(0.0, 0.0), (2.0, 0.0), (1.3, 0.0), (2.2, 0.5)])
def test_every_sample_stands_in_the_row_that_ends_its_step(delay, jitter):
    """Rows come STEPS later; by their own definition instants are in the step that they end."""
    t, u = inputs(40, delay, jitter)
    component = LateSamples(Rows(), steps=STEPS)
    component.initialize(0.0, u[0])
    rows = component.advance(t, H, u)
    assert np.isnan(rows[:STEPS, 0]).all()
    passed = rows[STEPS:]
    np.testing.assert_array_equal(passed[:, 0], t[: len(passed)])
    np.testing.assert_array_equal(passed[:, -1], u[: len(passed), -1])
    first = passed[:, 1 : 1 + MOST_IN_A_STEP]
    second = passed[:, 1 + MOST_IN_A_STEP : 1 + 2 * MOST_IN_A_STEP]
    instants = passed[:, 1 + 2 * MOST_IN_A_STEP : -1]
    is_there = np.isfinite(instants)
    number = first[is_there].astype(int)
    np.testing.assert_array_equal(second[is_there], 10.0 * number)
    np.testing.assert_array_equal(instants[is_there], u[number, 2])
    ends = np.broadcast_to(passed[:, :1], instants.shape)[is_there]
    assert (instants[is_there] <= ends).all()
    assert ((instants[is_there] > ends - H) | (ends == 0.0)).all()
    expected = np.flatnonzero(u[:, 2] <= t[len(passed) - 1])
    np.testing.assert_array_equal(np.sort(number), expected)


def test_the_contract_is_kept():
    """One call of many steps equals many calls of one step; a state goes back."""
    _, u = inputs(40, 2.2, 0.5)
    check_component(lambda: LateSamples(Rows(), steps=STEPS), inputs=u, h=H)
    check_component(lambda: LateSamples(CompiledRows(), steps=STEPS), inputs=u, h=H)


def test_a_sample_that_is_older_stops_the_run():
    """With the rows before it."""
    t, u = inputs(40, 2.0)
    u[20, 2] = t[20 - STEPS - 2]
    component = LateSamples(Rows(), steps=STEPS)
    component.initialize(0.0, u[0])
    with pytest.raises(Stopped, match=r"sample at 10\.0 s.*more than 3 communication") as stop:
        component.advance(t, H, u)
    assert len(stop.value.outputs) == 20
    compiled = LateSamples(CompiledRows(), steps=STEPS)
    compiled.initialize(0.0, u[0])
    step = compiled.native()
    assert len(step.advance(t, H, u)) == 20
    with pytest.raises(Stopped, match=r"sample at 10\.0 s.*more than 3 communication"):
        compiled.advance(t[20:], H, u[20:])
