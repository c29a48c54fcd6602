"""Studies of a file that is edited: what has grown goes on, what was renumbered is refused."""

import pytest

import cosim
from cosim.errors import DatasetError
from cosim.studies.contracts import MemberOutcome
from cosim.studies.dataset import parameter_column
from cosim.studies.dataset import StudyIdentity
from cosim.studies.dataset import StudyDataset
from cosim.studies.design import plan_design
from cosim.studies.study_file import read_study

GRID = """
[study]
scenario = "academic"
[vary]
"observer.filter_rate" = {first}
"identifier.P0" = {second}
"""
SAMPLED = """
[study]
scenario = "academic"
sampling = "{sampling}"
samples = {samples}
seed = 3
[vary]
"observer.filter_rate" = {{ uniform = [10.0, 20.0] }}
"""


def opened(folder, text):
    """Open the dataset of a study, in parts of 4."""
    file = folder / "study.toml"
    file.write_text(text)
    study = read_study(str(file))
    design = plan_design(study, cosim.load(study.scenario))
    columns = tuple(parameter_column(name, design.column(name)) for name in design.names)
    identity = StudyIdentity("x", text, {}, columns, len(design), 4)
    return StudyDataset.open_or_create(folder / "x", identity, design=design), design


def complete(dataset, design):
    """Add what is missing; return the numbers."""
    added = []
    with dataset:
        for absent in dataset.missing():
            for member in design.members(absent.start, absent.stop):
                dataset.add(member, MemberOutcome(member.number, "complete"))
                added.append(member.number)
    return added


def test_a_grid_grows_at_the_end_of_its_first_key(tmp_path):
    """Only the members of the new value run."""
    complete(*opened(tmp_path, GRID.format(first=[10.0, 20.0], second=[1.0, 2.0, 3.0])))
    dataset, design = opened(tmp_path, GRID.format(first=[10.0, 20.0, 5.0], second=[1.0, 2.0, 3.0]))
    assert complete(dataset, design) == [6, 7, 8]
    table = cosim.open_study(tmp_path / "x").table()
    assert table["identifier.P0"].to_pylist() == [1.0, 2.0, 3.0] * 3
    assert table["observer.filter_rate"].to_pylist() == [10.0] * 3 + [20.0] * 3 + [5.0] * 3


@pytest.mark.parametrize(
    ("first", "second", "problem"),
    [
        ([10.0, 20.0], [1.0, 2.0, 3.0, 4.0], "member 3 was observer.filter_rate = 20.0, is 10.0"),
        ([5.0, 10.0, 20.0], [1.0, 2.0, 3.0], "member 0 was observer.filter_rate = 10.0, is 5.0"),
        ([10.0, 20.0], [1.0, 2.0, 3.5], "member 2 was identifier.P0 = 3.0, is 3.5"),
        ([10.0], [1.0, 2.0, 3.0], "member 5 is recorded, but only 3 members are planned"),
    ],
)
def test_a_grid_that_changed_otherwise_is_refused(tmp_path, first, second, problem):
    """By the first member that is another one, and the dataset is as it was."""
    complete(*opened(tmp_path, GRID.format(first=[10.0, 20.0], second=[1.0, 2.0, 3.0])))
    before = (tmp_path / "x" / "study.json").read_bytes()
    with pytest.raises(DatasetError, match=problem):
        opened(tmp_path, GRID.format(first=first, second=second))
    assert (tmp_path / "x" / "study.json").read_bytes() == before


@pytest.mark.parametrize("sampling", ["random", "sobol"])
def test_samples_grow_at_their_end(tmp_path, sampling):
    """Those that were drawn are drawn again, bit for bit."""
    complete(*opened(tmp_path, SAMPLED.format(sampling=sampling, samples=8)))
    dataset, design = opened(tmp_path, SAMPLED.format(sampling=sampling, samples=16))
    assert complete(dataset, design) == list(range(8, 16))


def test_a_latin_hypercube_of_more_samples_is_another_one(tmp_path):
    """Each of its samples is in another layer."""
    complete(*opened(tmp_path, SAMPLED.format(sampling="latin-hypercube", samples=8)))
    with pytest.raises(DatasetError, match=r"member 0 was observer.filter_rate = .*; members keep"):
        opened(tmp_path, SAMPLED.format(sampling="latin-hypercube", samples=16))
