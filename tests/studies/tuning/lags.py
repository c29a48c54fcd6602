"""A scenario of one lag, and the rows of a dataset that do not depend on the machine."""

from cosim.studies.dataset import StudyDataset

VARYING = ("wall_time", "worker", "log")  # columns that differ from run to run
LAG = """
scenario = { name = "lag", stop = 2.0, step = 0.01 }
[components]
one = { kind = "constant", value = 1.0 }
plant = { kind = "lag", time_constant = 0.7, initial = 0.0 }
[connections]
"plant.u" = "one.y"
"""


def rows_of(place):
    """Return the rows of a dataset without the columns that vary."""
    table = StudyDataset.open(place).read()
    return table.drop_columns(list(VARYING)).to_pylist()
