"""Folders that one process writes, also on a file system without locks."""

import errno
import os

import pytest

from cosim.errors import DatasetError
from cosim.studies.dataset import file_locks
from cosim.studies.dataset.file_locks import EXCLUSIVE, FolderLock
from cosim.studies.dataset import StudyDataset
from tests.studies.dataset.outcomes import add, identity


@pytest.fixture(params=[errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK])
def _without_locks(request, monkeypatch):
    def refuse(descriptor, operation):
        raise OSError(request.param, os.strerror(request.param))

    monkeypatch.setattr(file_locks.fcntl, "flock", refuse)


@pytest.mark.usefixtures("_without_locks")
def test_a_folder_without_locks_is_written_by_one(tmp_path):
    """Until that ends; a killed one is named, with what to do."""
    with (
        StudyDataset.open_or_create(tmp_path, identity(30)),
        pytest.raises(
            DatasetError, match=rf"was killed \(process {os.getpid()} on .*\); this file system"
        ),
    ):
        StudyDataset.open_or_create(tmp_path, identity(30))
    with StudyDataset.open_or_create(tmp_path, identity(30)) as dataset:
        add(dataset, [1])
    (tmp_path / EXCLUSIVE).touch()
    with pytest.raises(
        DatasetError, match=r"process unknown.* if it has ended, remove .*lock-exclusive"
    ):
        StudyDataset.open_or_create(tmp_path, identity(30))
    assert len(StudyDataset.open(tmp_path)) == 1


@pytest.mark.usefixtures("_without_locks")
def test_without_locks_the_temporary_files_of_others_stay(tmp_path):
    """Nobody knows whether they are being written: to remove them would lose a part."""
    (tmp_path / "parts").mkdir()
    held = tmp_path / "parts" / "_part-0000000000-0000000009.parquet.00.tmp"
    held.touch()
    with StudyDataset.open_or_create(tmp_path, identity(30)):
        assert held.exists()


def test_a_lock_of_a_folder_is_of_one_process(tmp_path):
    """Another one is named; nothing is left of one that ends."""
    first = FolderLock(tmp_path)
    with pytest.raises(
        DatasetError, match=rf"another study .*\(process {os.getpid()} on .*\); wait until"
    ):
        FolderLock(tmp_path)
    first.close()
    FolderLock(tmp_path).close()
    assert not (tmp_path / EXCLUSIVE).exists()
