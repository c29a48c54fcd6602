"""Rows of several components are joined on time: tables of pandas, polars and xarray."""

from __future__ import annotations

import sys
from itertools import count, islice, pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.core.recorded.joined_rows import joined_rows
from cosim.core.recorded.selection import select_signals, selected_columns
from cosim.core.signals import Channel, Interface, Signal
from cosim.errors import UnknownSignalError, UsageError
from tests.log.recordings import STEP_NS, numbered, same_bits


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


# --- frames ---


FAST = ["plant.u", "plant.x_a[0]", "plant.x_a[1]", "plant.der(x)", "plant.n"]
SLOW = [*(f"identifier.y[{i}]" for i in range(3)), "identifier.theta[0]", "identifier.theta[1]"]


def test_signals_of_one_rate_are_a_frame_of_their_rows(two_rates):
    """Bit for bit, by the instants of that rate."""
    log, rows = two_rates
    frame = log.to_pandas("identifier.*")
    assert list(frame.columns) == SLOW
    assert frame.index.name == "t"
    assert np.array_equal(frame.index, log.time("identifier"))
    assert same_bits(frame.to_numpy(), rows[::5, 5:10])


def test_signals_of_several_rates_are_joined_on_time(two_rates):
    """With NaN in pandas where the slower one has no row; all its rows are there."""
    log, rows = two_rates
    frame = log.to_pandas()
    assert list(frame.columns) == FAST + SLOW
    assert np.array_equal(frame.index, log.t)
    assert same_bits(frame[FAST].to_numpy(), rows[:, :5])
    assert same_bits(frame[SLOW].to_numpy()[::5], rows[::5, 5:10])
    between = np.arange(1001) % 5 != 0
    assert frame[SLOW].to_numpy()[between].size == 800 * 5
    assert np.isnan(frame[SLOW].to_numpy()[between]).all()


@pytest.mark.slow
def test_polars_distinguishes_no_row_from_nan(two_rates):
    """Null is where there is no row, NaN is what was recorded."""
    log, rows = two_rates
    assert same_bits(log.to_polars("plant.*").drop("t").to_numpy(), rows[:, :5])
    assert log.window(5.0, 6.0).to_polars().shape == (0, 11)
    frame = log.to_polars(["identifier.y", "plant.x_a[0]"])
    assert frame.columns == ["t", *SLOW[:3], "plant.x_a[0]"]
    assert frame["t"].to_list() == log.t.tolist()
    nulls = frame["identifier.y[0]"].is_null().to_numpy()
    assert np.array_equal(nulls, np.arange(1001) % 5 != 0)
    kept = frame["identifier.y[0]"].drop_nulls().to_numpy()
    assert same_bits(kept, rows[::5, 5])
    assert frame["plant.x_a[0]"].null_count() == 0
    assert frame["plant.x_a[0]"].is_nan().any() == np.isnan(rows[:, 1]).any()


def test_xarray_has_units_and_elements(two_rates):
    """A signal of several elements has a dimension of its own."""
    log, rows = two_rates
    dataset = log.to_xarray()
    assert list(dataset.data_vars) == list(log)
    assert dataset["plant.u"].attrs["units"] == "m/s"
    assert dataset["plant.n"].attrs == {
        "role": "output",
        "variability": "discrete",
        "type": "integer",
    }
    assert dataset["plant.x_a"].dims == ("t", "element of plant.x_a")
    assert same_bits(dataset["plant.x_a"].to_numpy(), rows[:, 1:3])
    assert same_bits(dataset["plant.u"].to_numpy(), rows[:, 0])
    assert same_bits(dataset["identifier.y"][::5].to_numpy(), rows[::5, 5:8])
    assert np.array_equal(dataset["t"], log.t)
    assert dataset["t"].attrs["units"] == "s"
    assert dataset.attrs == {"source": log.label, "status": "complete"}
    chosen = log.to_xarray(["plant.x_a[1]", "plant.x_a[0:2]"])
    assert same_bits(chosen["plant.x_a[1]"].to_numpy(), rows[:, 2])
    assert same_bits(chosen["plant.x_a[0:2]"].to_numpy(), rows[:, 1:3])


def test_xarray_has_descriptions(in_memory):
    """Of signals that have one."""
    text = in_memory.to_xarray("observer.delta")["observer.delta"].attrs["long_name"]
    assert text == in_memory.signals["observer.delta"].description


def test_a_window_is_a_frame_of_its_rows(two_rates):
    """Also one without rows."""
    log, rows = two_rates
    frame = log.window(0.01, 0.02).to_pandas(["plant.u", "plant.n"])
    assert same_bits(frame.to_numpy(), rows[10:21, [0, 4]])
    assert frame.index[0] == 10 * STEP_NS / 1e9
    empty = log.window(5.0, 6.0)
    assert empty.to_pandas().shape == (0, 10)
    assert empty.to_xarray()["plant.x_a"].shape == (0, 2)


def test_unknown_signals_are_refused(two_rates):
    """By all alike."""
    log, _ = two_rates
    with pytest.raises(UnknownSignalError, match=r"no signal matches 'pant\.\*'"):
        log.to_pandas(["pant.*"])


@pytest.mark.parametrize("name", ["pandas", "polars", "xarray"])
def test_a_library_that_is_not_there_is_named(two_rates, monkeypatch, name):
    """With the way out."""
    log, _ = two_rates
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(UsageError, match=rf"to_{name} needs {name}, .* pip install -e '\.\[{name}"):
        getattr(log, f"to_{name}")()
