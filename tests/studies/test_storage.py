"""Datasets at URLs of fsspec are those of folders."""

import os
import sys

import fsspec
import pytest

from cosim.errors import DatasetError, DatasetWriteError, UsageError
from cosim.studies import storage
from cosim.studies.dataset import StudyDataset
from cosim.studies.storage import Storage
from tests.studies.test_dataset import add, content, identity, opened


@pytest.fixture
def memory():
    """Return a URL in this process."""
    yield "memory://studies"
    fsspec.filesystem("memory").rm("/studies", recursive=True)


@pytest.fixture(params=[pytest.param("bucket", marks=pytest.mark.slow), "memory"])
def place(request, parts_of_ten):
    """Return a place of each kind, for parts of ten members."""
    return f"{request.getfixturevalue(request.param)}/{request.node.name.partition('[')[0]}"


def test_a_dataset_elsewhere_is_that_of_a_folder(place, tmp_path):
    """The same table; it goes on where it was, with its journal; it grows."""
    for count, numbers in [(25, range(23)), (25, [24, 23]), (33, range(25, 30))]:
        for where in (place, tmp_path):
            with opened(where, count) as dataset:
                assert numbers[0] in [n for absent in dataset.missing() for n in absent]
                add(dataset, numbers)
    assert content(place).equals(content(tmp_path))
    files, root = fsspec.core.url_to_fs(place)
    assert len(files.ls(f"{root}/parts")) == 4
    part = min(files.ls(f"{root}/parts", detail=False))
    files.pipe_file(part, files.cat_file(part)[:-1])
    with pytest.raises(DatasetError, match=f"{part.rpartition('/')[2]}: damaged"):
        content(place)


def test_a_new_beginning_removes_the_objects_of_a_dataset_only(place, tmp_path):
    """Logs are put whole; the file here is gone then."""
    if place.startswith("s3"):
        with pytest.raises(DatasetWriteError, match=r"s3://nowhere/x/study.json: .*bucket"):
            opened("s3://nowhere/x", 5)
    with opened(place, 20) as dataset:
        add(dataset, range(15))
        (tmp_path / "3.mcap").write_bytes(b"log")
        dataset.storage.write("logs/3.mcap", tmp_path / "3.mcap")
        assert not (tmp_path / "3.mcap").exists()
    files, root = fsspec.core.url_to_fs(place)
    files.pipe_file(f"{root}/notes.txt", b"mine")
    assert StudyDataset.open(place).logs() == {3: f"{place}/logs/3.mcap"}
    with StudyDataset.open_or_create(place, identity(20, version="2.0"), new=True) as dataset:
        assert dataset.missing() == [range(20)]
        assert dataset.logs() == {}
    assert files.cat_file(f"{root}/notes.txt") == b"mine"


def test_a_journal_elsewhere_is_put_now_and_then(memory, monkeypatch):
    """With the first member after ten seconds, and in the end."""
    clock = [0.0]
    monkeypatch.setattr(storage, "monotonic", lambda: clock[0])
    found = []
    with opened(f"{memory}/x", 100) as dataset:
        for number in range(21):
            clock[0] = float(number)
            add(dataset, [number])
            found.append(len(StudyDataset.open(f"{memory}/x")))
    assert [*found, len(StudyDataset.open(f"{memory}/x"))] == [0] * 10 + [11] * 10 + [21, 21]


def test_kinds_of_storage_that_are_unknown_are_refused(tmp_path, monkeypatch):
    """With what is missing; a URL of a file is a folder."""
    with opened(f"file://{tmp_path}/x%20y", 5) as dataset:
        add(dataset, range(5))
    assert len(StudyDataset.open(tmp_path / "x y")) == 5
    with pytest.raises(DatasetError, match="nothing://x: Protocol not known: nothing"):
        StudyDataset.open("nothing://x")
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(UsageError, match=r"studies need fsspec, which is not installed"):
        StudyDataset.open("s3://x")


def test_files_that_cannot_be_used_are_said(tmp_path):
    """A folder in place of a file, a file in place of a folder."""
    (tmp_path / "study.json").mkdir()
    with pytest.raises(DatasetError, match=r"study.json: Is a directory"):
        Storage(tmp_path).read("study.json")
    (tmp_path / "file").touch()
    file = Storage(str(tmp_path / "file"))
    assert file.read("study.json") is None
    assert file.names("parts") == []
    with pytest.raises(DatasetWriteError, match=r"x: (Not a directory|File exists)"):
        file.write("x", b"")
    with pytest.raises(DatasetError, match="expected a writable folder"):
        file.lock()


@pytest.mark.skipif(sys.platform == "win32", reason="no such locks")
def test_a_file_system_without_locks_is_written_all_the_same(tmp_path, monkeypatch):
    """What a killed writer has left there is removed, and nothing of others."""
    for name in ("_x.cosim-tmp", "parts/_y.cosim-tmp", "_mine.tmp", "parts/_mine"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()

    def refuse(*_):
        raise OSError(38, os.strerror(38))

    monkeypatch.setattr("cosim.studies.storage.fcntl.flock", refuse)
    with opened(tmp_path, 5) as dataset:
        add(dataset, range(5))
    left = {path.name for path in tmp_path.rglob("_*") if path.is_file()}
    assert left == {"_mine.tmp", "_mine", "_lock", "_journal.jsonl"}
