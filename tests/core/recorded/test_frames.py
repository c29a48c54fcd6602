"""Runs as tables of pandas, polars and xarray."""

import sys

import numpy as np
import pytest

import cosim
from cosim.errors import UnknownSignalError, UsageError
from tests.log.recordings import STEP_NS, same_bits

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
    with pytest.raises(UnknownSignalError, match=r"'pant\.\*'"):
        log.to_polars(["pant.*"])
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


def test_xarray_has_descriptions():
    """Of signals that have one."""
    log = cosim.run("academic", set={"scenario.stop": 0.01})
    dataset = log.to_xarray("observer.delta")
    assert dataset["observer.delta"].attrs["long_name"] == log.signals["observer.delta"].description


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
    """By both alike."""
    log, _ = two_rates
    for convert in (log.to_pandas, log.to_xarray):
        with pytest.raises(UnknownSignalError, match=r"no signal matches 'pant\.\*'"):
            convert(["pant.*"])


@pytest.mark.parametrize("name", ["pandas", "polars", "xarray"])
def test_a_library_that_is_not_there_is_named(two_rates, monkeypatch, name):
    """With the way out."""
    log, _ = two_rates
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(UsageError, match=rf"to_{name} needs {name}, .* pip install -e '\.\[{name}"):
        getattr(log, f"to_{name}")()
