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


@pytest.fixture(params=[pytest.param("bucket", marks=pytest.mark.slow), "memory"])
def place(request, parts_of_ten):
    """Return a URL of each kind, for parts of ten members."""
    if request.param == "bucket":
        yield f"{request.getfixturevalue('bucket')}/{request.node.originalname}"
    else:
        yield "memory://studies"
        fsspec.filesystem("memory").rm("/studies", recursive=True)


def test_a_dataset_elsewhere_is_that_of_a_folder(place, tmp_path):
    """The same table; it goes on where it was, with its journal; it grows; damage is found."""
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
    log = tmp_path / "3.mcap"
    log.write_bytes(b"log")
    with opened(place, 20) as dataset:
        add(dataset, range(15))
        dataset.storage.write("logs/3.mcap", log)
    assert not log.exists()
    files, root = fsspec.core.url_to_fs(place)
    files.pipe_file(f"{root}/notes.txt", b"mine")
    assert StudyDataset.open(place).logs() == {3: f"{place}/logs/3.mcap"}
    with opened(place, 20, identity=identity(20, version="2.0"), new=True) as dataset:
        assert (dataset.missing(), dataset.logs()) == ([range(20)], {})
    assert files.cat_file(f"{root}/notes.txt") == b"mine"


@pytest.mark.parametrize("place", ["memory"], indirect=True)
def test_a_journal_elsewhere_is_put_now_and_then(place, monkeypatch):
    """With the first member after ten seconds, and in the end."""
    clock = [0.0]
    monkeypatch.setattr(storage, "monotonic", lambda: clock[0])
    monkeypatch.setattr("cosim.studies.dataset.PART_SIZE", 1000)
    found = []
    with opened(place, 100) as dataset:
        for number in range(21):
            clock[0] = float(number)
            add(dataset, [number])
            found.append(len(StudyDataset.open(place)))
    assert [*found, len(StudyDataset.open(place))] == [0] * 10 + [11] * 10 + [21, 21]


def test_places_and_files_that_cannot_be_used_are_said(tmp_path, monkeypatch):
    """With what is missing; a URL of a file is a folder."""
    with opened(f"file://{tmp_path}/x%20y", 5) as dataset:
        add(dataset, range(5))
    assert len(StudyDataset.open(tmp_path / "x y")) == 5
    with pytest.raises(DatasetError, match="nothing://x: Protocol not known: nothing"):
        Storage("nothing://x")
    (tmp_path / "study.json").mkdir()
    with pytest.raises(DatasetError, match=r"study.json: Is a directory"):
        Storage(tmp_path).read("study.json")
    (tmp_path / "file").touch()
    file = Storage(tmp_path / "file")
    assert (file.read("study.json"), file.names("parts")) == (None, [])
    with pytest.raises(DatasetWriteError, match=r"x: (Not a directory|File exists)"):
        file.write("x", b"")
    with pytest.raises(DatasetError, match="expected a writable folder"):
        file.lock()
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(UsageError, match=r"studies need fsspec, which is not installed"):
        Storage("s3://x")


@pytest.mark.skipif(sys.platform == "win32", reason="no such locks")
def test_a_file_system_without_locks_is_written_all_the_same(tmp_path, monkeypatch):
    """What a killed writer has left there is removed, and nothing of others."""
    (tmp_path / "parts").mkdir()
    for name in ("_x.cosim-tmp", "parts/_y.cosim-tmp", "_mine.tmp", "parts/_mine"):
        (tmp_path / name).touch()

    def refuse(*_):
        raise OSError(38, os.strerror(38))

    monkeypatch.setattr("cosim.studies.storage.fcntl.flock", refuse)
    with opened(tmp_path, 5) as dataset:
        add(dataset, range(5))
    left = {path.name for path in tmp_path.rglob("_*") if path.is_file()}
    assert left == {"_mine.tmp", "_mine", "_lock", "_journal.jsonl"}
