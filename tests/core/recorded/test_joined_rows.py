"""Rows of several components are joined on time."""

from __future__ import annotations

from itertools import count, islice, pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cosim.core.recorded.joined_rows import joined_rows
from cosim.core.recorded.selection import select_signals, selected_columns
from cosim.core.signals import Channel, Interface, Signal
from tests.log.recordings import numbered


class Rows:
    """What components have, in blocks: their instants, and numbers of their rows."""

    def __init__(self, components):
        self._components = components
        interface = Interface((), (Signal("x"), Signal("y")))
        self.channels = {name: Channel(name, interface, 0) for name in components}

    step_ns = 1

    def blocks_of(self, components):
        """Yield the blocks of the components by turns, as a file has them."""
        left = {name: list(self.blocks(name)) for name in components}
        while any(left.values()):
            for name, blocks in left.items():
                if blocks:
                    yield name, *blocks.pop(0)

    def blocks(self, component):
        times, cuts = self._components[component]
        for first, last in pairwise([0, *cuts, len(times)]):
            numbers = np.arange(first, last, dtype=float)[:, np.newaxis]
            yield np.array(times[first:last], np.int64), np.hstack([numbers, -numbers - 1.0])


@st.composite
def components(draw):
    """Draw some components' instants and the ends of their blocks; in a single one some twice."""
    drawn = {}
    for name in "abc"[: draw(st.integers(1, 3))]:
        in_blocks = draw(st.booleans())
        times = sorted(draw(st.lists(st.integers(0, 30), max_size=15, unique=in_blocks)))
        cuts = st.lists(st.integers(0, len(times)), max_size=5 if in_blocks else 0)
        drawn[name] = times, sorted(draw(cuts))
    return drawn


@given(components())
def test_a_table_has_each_row_once_and_nothing_else(drawn):
    """A dictionary of instants says the same, whatever the blocks are."""
    run = Rows(drawn)
    columns = selected_columns(select_signals(run.channels, None, source=""))
    needed = {}
    for place, column in enumerate(columns):
        for row, instant in enumerate(numbered(drawn[column.component][0])):
            value = float(row) if column.column == 0 else -row - 1.0
            needed.setdefault(instant, {})[place] = value
    found = []
    for part in joined_rows(run, columns):
        missing = np.zeros(part.values.shape, bool) if part.missing is None else part.missing
        assert len(part) == len(part.time_ns)
        for time, values, absent in zip(part.time_ns, part.values, missing, strict=True):
            assert np.array_equal(np.isnan(values), absent)
            own = {i: float(values[i]) for i in np.flatnonzero(~absent)}
            found.append((int(time), own))
    assert found == [(instant[0], needed[instant]) for instant in sorted(needed)]


def test_components_of_one_rate_have_no_missing_values():
    """And NaN of their own is kept."""
    times = list(range(100))
    run = Rows({"a": (times, [3, 50]), "b": (times, [40])})
    columns = selected_columns(select_signals(run.channels, ["b.y", "a.x"], source=""))
    parts = list(joined_rows(run, columns))
    assert all(part.missing is None for part in parts)
    values = np.concatenate([part.values for part in parts])
    assert np.array_equal(values[:, 0], -np.arange(100.0) - 1.0)
    assert np.array_equal(values[:, 1], np.arange(100.0))
    part = parts[-1].part(1, 3)
    assert np.array_equal(part.time_ns, parts[-1].time_ns[1:3])
    assert np.array_equal(part.values, parts[-1].values[1:3])
    assert len(part) == 2


class Endless:
    """A component that never ends, and one of which only the first row is due for long."""

    step_ns = 1

    def __init__(self):
        interface = Interface((), (Signal("x"),))
        self.channels = {
            "slow": Channel("slow", interface, 0, 10**9),
            "fast": Channel("fast", interface, 1),
        }

    def blocks_of(self, components):
        yield "slow", np.zeros(1, np.int64), np.full((1, 1), 7.0)
        for number in count():
            yield "fast", np.arange(100) + 100 * number, np.full((100, 1), float(number))


def test_rows_do_not_wait_for_a_component_that_has_none_for_long():
    """Its period says that none is due."""
    run = Endless()
    columns = selected_columns(select_signals(run.channels, None, source=""))
    parts = list(islice(joined_rows(run, columns), 50))
    assert sum(len(part) for part in parts) == 5000
    assert parts[0].values[0].tolist() == [7.0, 0.0]
    assert parts[0].missing[1].tolist() == [True, False]
