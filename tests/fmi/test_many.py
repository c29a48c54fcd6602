"""An FMU with very many variables is read at least as quickly as FMPy reads it."""

from pathlib import Path
from time import process_time

import fmpy
import pytest

from cosim.fmi.checking.check import check
from cosim.fmi.reading.model_description import read
from tests.fmi.many import many


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    return many(tmp_path_factory.mktemp("many") / "many.fmu", 20_000)


def seconds(function, path):
    """Return the processor time of the quickest of three calls."""
    times = []
    for _ in range(3):
        began = process_time()
        function(str(path))
        times.append(process_time() - began)
    return min(times)


@pytest.mark.slow
@pytest.mark.usefixtures("frozen_heap")
def test_reading_takes_no_longer_than_fmpy(path):
    """Both in one process, by processor time; measured: two thirds.

    In one of five attempts, as another process can make either slower.
    """
    ratios = []
    for _ in range(5):
        ratios.append(seconds(read, path) / seconds(fmpy.read_model_description, path))
        if ratios[-1] < 1.0:
            return
    raise AssertionError(f"reading takes {ratios} times as long as FMPy's")


@pytest.mark.slow
@pytest.mark.usefixtures("frozen_heap")
def test_the_time_of_a_check_is_proportional_to_the_size(tmp_path, path, monkeypatch):
    """Eight times the variables take about eight times as long, 64 times where a list is searched.

    What does not depend on the size makes the ratio smaller.
    """
    monkeypatch.setattr("cosim.fmi.checking.check._run_trials", lambda *_: [])
    small = many(tmp_path / "small.fmu", 2_500)
    assert seconds(check, path) < 20.0 * seconds(check, small)


@pytest.mark.slow
def test_all_of_it_is_read(path):
    """Nothing is left out: 20000 variables, one input, ten outputs, nothing to find."""
    description = read(path).description
    assert len(description.variables) == 20_000
    assert (description.interface.n_u, description.interface.n_y) == (1, 10)
    assert check(path) == ()
