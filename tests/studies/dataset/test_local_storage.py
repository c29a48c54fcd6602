"""Files of a dataset in a folder: the journal stays short, and what others hold is left alone."""

import os

import pytest

from cosim.errors import DatasetError, DatasetWriteError
from cosim.studies.dataset import local_storage
from cosim.studies.dataset.file_locks import LockState, lock_file
from cosim.studies.dataset.local_storage import LocalStorage
from cosim.studies.dataset import StudyDataset
from tests.studies.dataset.outcomes import add, identity


def lines(folder):
    """Return how many lines the journal has."""
    return len((folder / "_journal.jsonl").read_text().splitlines())


def test_a_journal_has_no_more_than_twice_the_lines_that_count(tmp_path):
    """While parts are completed, with members of others under way."""
    longest = 0
    with StudyDataset.open_or_create(tmp_path, identity(1000)) as dataset:
        add(dataset, [990])  # a part that is open to the end
        for number in range(990):
            add(dataset, [number])
            longest = max(longest, lines(tmp_path))
        assert dataset.missing() == [range(991, 1000)]
    assert longest <= 2 * 11
    assert len(StudyDataset.open(tmp_path)) == 991


def test_a_journal_that_cannot_be_written_anew_stays_as_it_was(tmp_path, monkeypatch):
    """The part is there all the same, and no row twice; a later try goes on with the journal."""
    dataset = StudyDataset.open_or_create(tmp_path, identity(30))
    add(dataset, [25, *range(9)])
    replace = os.replace

    def full(source, target):
        if str(target).endswith("_journal.jsonl"):
            raise OSError(28, os.strerror(28))
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(local_storage.os, "replace", full)
        with pytest.raises(DatasetWriteError, match=r"_journal.jsonl: No space left on device"):
            add(dataset, [9])
    add(dataset, [26])
    dataset.close()
    opened = StudyDataset.open(tmp_path)
    assert opened.read(["member"])["member"].to_pylist() == [*range(10), 25, 26]
    assert not list(tmp_path.rglob("*.tmp"))


def test_nothing_is_appended_to_a_journal_that_was_replaced(tmp_path, monkeypatch):
    """Where it is interrupted just then, the next member is an error, not a loss."""
    dataset = StudyDataset.open_or_create(tmp_path, identity(30))
    add(dataset, [25, *range(9)])
    replace = os.replace

    def interrupted(source, target):
        replace(source, target)
        if str(target).endswith("_journal.jsonl"):
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(local_storage.os, "replace", interrupted)
        with pytest.raises(KeyboardInterrupt):
            add(dataset, [9])
    with pytest.raises(DatasetWriteError, match=r"_journal.jsonl: Bad file descriptor"):
        add(dataset, [26])
    dataset.close()
    dataset.close()
    assert len(StudyDataset.open(tmp_path)) == 11


def test_temporary_files_are_removed_but_those_that_are_being_written(tmp_path):
    """Who writes one holds a lock on it; the name says that it is no part yet."""
    with StudyDataset.open_or_create(tmp_path, identity(30)) as dataset:
        add(dataset, range(10))
    left = tmp_path / "parts" / "_part-0000000010-0000000019.parquet.00.tmp"
    held = tmp_path / "parts" / "_part-0000000020-0000000029.parquet.00.tmp"
    mine = tmp_path / "_mine.txt"
    for path in (left, held, mine):
        path.touch()
    with open(held) as file:
        assert lock_file(file.fileno()) is LockState.HELD
        with StudyDataset.open_or_create(tmp_path, identity(30)):
            assert (left.exists(), held.exists(), mine.exists()) == (False, True, True)
    with StudyDataset.open_or_create(tmp_path, identity(30)):
        assert not held.exists()


def test_files_that_cannot_be_read_are_said(tmp_path):
    """A folder in place of a file, a file in place of a folder of the dataset."""
    (tmp_path / "study.json").mkdir()
    with pytest.raises(DatasetError, match=r"study.json: Is a directory"):
        LocalStorage(tmp_path).read("study.json")
    file = tmp_path / "file"
    file.touch()
    assert LocalStorage(file).read("study.json") is None
    assert LocalStorage(file).names("parts") == []
    with pytest.raises(DatasetWriteError, match=r"x: (Not a directory|File exists)"):
        LocalStorage(file).write("x", b"")
