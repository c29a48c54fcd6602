"""Runs that several test files read, in memory and from file."""

from __future__ import annotations

import pytest

import cosim
from cosim.core.recorders import Memory
from tests.log.recordings import blocks, layout, plan, record, table

SHORT = {"scenario.stop": 0.1}


@pytest.fixture(scope="package")
def in_memory():
    return cosim.run("academic", set=SHORT)


@pytest.fixture(scope="package")
def from_file(tmp_path_factory):
    return cosim.run("academic", set=SHORT, out=tmp_path_factory.mktemp("logs") / "academic.mcap")


@pytest.fixture(params=["in_memory", "from_file"])
def recorded(request):
    return request.getfixturevalue(request.param)


@pytest.fixture(params=["memory", "file"])
def two_rates(request, tmp_path):
    """Return a run of 1001 rows with a component that has every fifth, and its rows."""
    rows = table(layout(), 1000)
    if request.param == "file":
        record(tmp_path / "a.mcap", rows=rows)
        return cosim.open_log(tmp_path / "a.mcap"), rows
    with Memory() as memory:
        memory.begin(plan())
        for block, signals in blocks(rows, 100):
            memory.write(block, signals)
    return memory, rows
