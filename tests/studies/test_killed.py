"""Whenever a study is killed: what was added is there, once, and the study goes on."""

import random
import shutil
import sys

import pytest

from cosim.studies import dataset
from cosim.studies.dataset import StudyDataset
from tests.studies.killed import begin_anew, complete, killed, opened, processes, write

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no signals to kill with")

COUNT = 400


@pytest.fixture(autouse=True)
def size_of_parts(monkeypatch):
    """Let the size of parts be as before after each test."""
    monkeypatch.setattr(dataset, "PART_SIZE", dataset.PART_SIZE)


SIZE = 20
SESSION = ("wall_time", "worker")  # what differs between sessions


def same(folder):
    """Return what must not depend on how a study was run, and the names of its files."""
    table = StudyDataset.open(folder).read()
    files = sorted(path.name[:27] for path in folder.rglob("*") if path.is_file())
    return table.drop_columns(list(SESSION)), files


def check(folder, reported):
    """Check what a kill has left, as a reader finds it."""
    left = StudyDataset.open(folder).read(["member"])["member"].to_pylist()
    assert left == sorted(set(left))
    assert set(reported) <= set(left)


@pytest.mark.parametrize("rounds", [1, pytest.param(20, marks=pytest.mark.campaign)])
def test_a_study_that_was_killed_twenty_times_has_the_rows_of_an_undisturbed_one(tmp_path, rounds):
    """Wall time and worker apart, in the same files."""
    with opened(tmp_path / "whole", COUNT, SIZE) as dataset:
        complete(dataset, seed=0)
    expected, files = same(tmp_path / "whole")
    assert expected["member"].to_pylist() == list(range(COUNT))
    for turn in range(rounds):
        chance = random.Random(turn)
        folder = tmp_path / str(turn)
        reported = []
        for seed in range(20):
            after = chance.randint(1, 2 * COUNT // 20 - 2)
            reported += killed(folder, COUNT, SIZE, seed, after=after)[0]
            check(folder, reported)
        assert len(set(reported)) == len(reported)
        with opened(folder, COUNT, SIZE) as dataset:
            complete(dataset, seed=20)
        found, names = same(folder)
        assert found.equals(expected)
        assert names == files


@pytest.mark.slow
@pytest.mark.parametrize("stride", [5, pytest.param(1, marks=pytest.mark.campaign)])
def test_a_kill_at_a_call_of_the_system_leaves_a_dataset(tmp_path, stride):
    """Before it, after it, in the middle of a write: at every call that changes a file."""
    count = 14
    size = 4
    with opened(tmp_path / "whole", count, size) as dataset:
        complete(dataset, seed=0)
    expected, files = same(tmp_path / "whole")
    for is_after in (False, True):
        is_complete = False
        number = 0
        while not is_complete:
            folder = tmp_path / f"{number}-{is_after}"
            reported, is_complete = killed(folder, count, size, seed=1, cut=(number, is_after))
            with opened(folder, count, size) as dataset:
                left = dataset.read(["member"])["member"].to_pylist()
                assert left == sorted(set(left))
                assert set(reported) <= set(left)
                complete(dataset, seed=2, most=2)
            with opened(folder, count, size) as dataset:  # which reads what stands after the cut
                complete(dataset, seed=3)
            found, names = same(folder)
            assert found.equals(expected)
            assert names == files
            number += stride
        assert number > 40


def test_a_new_beginning_that_is_killed_leaves_a_dataset_of_fewer_members(tmp_path):
    """What is left goes on as it was, to the rows of the whole study."""
    with opened(tmp_path / "whole", 14, 4) as dataset:
        complete(dataset, seed=0)
    expected, files = same(tmp_path / "whole")
    left = []
    is_complete = False
    while not is_complete:
        folder = tmp_path / str(len(left))
        shutil.copytree(tmp_path / "whole", folder)
        cut = (len(left), False)
        _, is_complete = killed(folder, 14, 4, seed=1, cut=cut, target=begin_anew)
        with opened(folder, 14, 4) as dataset:
            left.append(len(dataset))
            complete(dataset, seed=2)
        assert same(folder) == (expected, files)
    assert {0, 2, 6, 10, 14} == set(left)


@pytest.mark.parametrize("count", [COUNT, pytest.param(20_000, marks=pytest.mark.campaign)])
def test_who_reads_while_a_study_runs_misses_nothing_that_was_there_before(tmp_path, count):
    """Whatever moves from the journal into a part meanwhile."""
    with opened(tmp_path, count, SIZE):
        pass
    receiver, sender = processes.Pipe(duplex=False)
    process = processes.Process(target=write, args=(sender, tmp_path, count, SIZE, 1, None))
    process.start()
    sender.close()
    reported = set()
    while len(reported) < count:
        reported.add(receiver.recv())
        while len(reported) < count and receiver.poll():
            reported.add(receiver.recv())
        found = StudyDataset.open(tmp_path).read(["member"])["member"].to_pylist()
        assert found == sorted(set(found))
        assert reported <= set(found)
    process.join()
    assert process.exitcode == 0
