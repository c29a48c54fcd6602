"""FMUs of other tools: whatever FMPy runs runs here, and gives the same numbers.

They are no part of the project: ``COSIM_FMU_COLLECTION`` is a folder with some, however deep.
``python -m tests.fmi.collection FOLDER`` prints the whole table.
"""

import os
from pathlib import Path

import pytest

from tests.fmi.collection import lines, summary

COLLECTION = os.environ.get("COSIM_FMU_COLLECTION")


@pytest.mark.campaign
@pytest.mark.skipif(not COLLECTION, reason="COSIM_FMU_COLLECTION is no folder of FMUs")
def test_fmus_have_the_numbers_that_fmpy_computes():
    """With finite results, constant inputs, the same communication step; no Scheduled Execution."""
    folder = Path(COLLECTION)
    table = []
    for line in lines(folder):
        print(line.text(folder))
        table.append(line)
    print(summary(table))
    assert table
    missing = [line for line in table if line.here.problem and not line.fmpy.problem]
    assert [
        line.text(folder) for line in missing if "scheduled execution only" not in line.here.problem
    ] == []
    assert [line.text(folder) for line in table if not line.agrees] == []
