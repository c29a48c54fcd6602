"""Conditions over the rows of a run: where they come true, whatever the blocks."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.core.conditions import Condition
from cosim.core.signals import Interface, Signal
from cosim.core.structure.ports import layout_of
from cosim.errors import UsageError
from tests.core.parts import Scripted, integrator

STEP_NS = 10**6


class Two:
    """A component with the outputs v, of two elements, and der(v)."""

    interface = Interface((), (Signal("v", 2), Signal("der(v)")))


LAYOUT = layout_of({"plant": integrator(), "two": Two(), "my-part": Scripted([0.0])})


def rows_of(values):
    """Return rows in which plant.y has these values."""
    rows = np.zeros((len(values), LAYOUT.width))
    rows[:, LAYOUT["plant"].outputs.start] = values
    return rows


def times(count, first=0):
    return np.arange(first, first + count) * STEP_NS / 1e9


def condition(text):
    return Condition(text, LAYOUT, STEP_NS)


def expected_row(holds, needed):
    """Return the first row at which the last ``needed`` rows hold, by looking at each."""
    for row in range(len(holds)):
        if row + 1 >= needed and all(holds[row + 1 - needed : row + 1]):
            return row
    return None


@given(st.lists(st.booleans(), max_size=30), st.integers(0, 4), st.data())
def test_it_comes_true_where_it_held_for_so_long_whatever_the_blocks(holds, steps, data):
    """``for n steps``: at n + 1 rows without a break; the first row counts as any other."""
    text = f"plant.y > 0 for {steps} ms" if steps else "plant.y > 0"
    watched = condition(text)
    rows = rows_of([1.0 if is_true else -1.0 for is_true in holds])
    at = 0
    found = None
    while at < len(holds) and found is None:
        size = data.draw(st.integers(1, 7))
        time = times(len(rows[at : at + size]), at)
        row = watched.comes_true(time, rows[at : at + size])
        found = None if row is None else at + row
        watched.pass_over(time, rows[at : at + size])
        at += size
    assert found == expected_row(holds, steps + 1)


@given(st.lists(st.booleans(), min_size=1, max_size=30), st.integers(0, 2))
def test_it_comes_true_again_only_after_it_was_false(holds, steps):
    """From row to row: a condition that stays true came true once."""
    text = f"plant.y > 0 for {steps} ms" if steps else "plant.y > 0"
    watched = condition(text)
    rows = rows_of([1.0 if is_true else -1.0 for is_true in holds])
    was_true = False
    for number in range(len(holds)):
        is_true = number >= steps and all(holds[number - steps : number + 1])
        part = rows[number : number + 1]
        comes_true = watched.comes_true(times(1, number), part) == 0
        watched.pass_over(times(1, number), part)
        assert comes_true == (is_true and not was_true)
        assert watched.is_true == is_true
        was_true = is_true


def test_looking_changes_nothing_and_it_can_go_back():
    """Until it is passed over the rows; ``held`` is all that there is to restore."""
    watched = condition("plant.y > 0 for 2 ms")
    rows = rows_of([1.0, 1.0, 1.0, 1.0])
    assert watched.comes_true(times(4), rows) == 2
    assert watched.comes_true(times(4), rows) == 2
    watched.pass_over(times(1), rows[:1])
    before = watched.held
    assert watched.comes_true(times(3, 1), rows[1:]) == 1
    watched.pass_over(times(3, 1), rows[1:])
    assert watched.is_true
    watched.held = before
    assert not watched.is_true
    assert watched.comes_true(times(3, 1), rows[1:]) == 1


def test_it_sees_time_elements_and_names_in_quotes():
    """As the columns of the row are."""
    rows = np.zeros((3, LAYOUT.width))
    outputs = LAYOUT["two"].outputs
    rows[:, outputs] = [[1.0, 2.0, 3.0], [1.0, 5.0, 3.0], [1.0, 5.0, 7.0]]
    rows[:, LAYOUT["my-part"].outputs.start] = [0.0, 0.0, 9.0]
    assert condition("two.v[1] == 5").comes_true(times(3), rows) == 1
    assert condition("'two.der(v)' == 7").comes_true(times(3), rows) == 2
    assert condition("'my-part.y' > two.v[0]").comes_true(times(3), rows) == 2
    assert condition("t >= 0.002").comes_true(times(3), rows) == 2
    assert condition("t >= 0.003").comes_true(times(3), rows) is None
    assert condition("plant.u < 0").comes_true(times(0), rows[:0]) is None


REFUSED = {
    "plnt.y > 0": "condition 'plnt.y > 0': the graph has no component 'plnt'; did you mean 'plant'",
    "plant.v > 0": "condition 'plant.v > 0': the graph has no 'plant.v': 'plant' has no signal 'v'",
    "two.v > 0": "'two.v > 0': expected one element, got 'two.v' with 2 elements",
    "two.v[2] > 0": "condition 'two.v[2] > 0': the graph: ",
    "two.v[0:2] > 0": "'two.v[0:2] > 0': expected one element, got 'two.v[0:2]' with 2 elements",
    "'two' > 0": "condition \"'two' > 0\": the graph: expected a port COMPONENT.SIGNAL",
    "plant.y > 0 for 1.5 ms": "'plant.y > 0 for 1.5 ms': for: 0.0015 s is not a whole number of "
    "0.001 s steps; nearest: 0.002 s",
}


@pytest.mark.parametrize("text", REFUSED)
def test_signals_that_are_not_in_the_graph_are_refused(text):
    """With the nearest name; a duration that is off the grid, too."""
    with pytest.raises(UsageError) as error:
        condition(text)
    assert REFUSED[text] in str(error.value)
