"""Datasets at URLs of fsspec: an S3 server on loopback, and what is in this process."""

import socket
import sys

import fsspec
import pytest

import cosim
from cosim.errors import DatasetError, DatasetWriteError
from cosim.studies import storage
from cosim.studies.dataset import StudyDataset
from tests.studies.outcomes import add, design, identity

pytestmark = pytest.mark.usefixtures("parts_of_ten")


@pytest.fixture
def memory():
    """Return a URL in this process."""
    yield "memory://studies"
    fsspec.filesystem("memory").rm("/studies", recursive=True)


@pytest.fixture(params=[pytest.param("bucket", marks=pytest.mark.slow), "memory"])
def place(request):
    """Return a place of each kind."""
    return f"{request.getfixturevalue(request.param)}/{request.node.name.partition('[')[0]}"


def test_a_dataset_elsewhere_is_that_of_a_folder(place, tmp_path):
    """The same table; it goes on where it was, with its journal, and grows."""
    with StudyDataset.open_or_create(tmp_path, identity(25)) as dataset:
        add(dataset, range(23))
    with StudyDataset.open_or_create(place, identity(13), design=design(25)) as dataset:
        add(dataset, range(13))
    with StudyDataset.open_or_create(place, identity(25), design=design(25)) as dataset:
        assert dataset.missing() == [range(13, 25)]
        add(dataset, range(13, 23))
    assert StudyDataset.open(place).read().equals(StudyDataset.open(tmp_path).read())
    study = cosim.open_study(place)
    assert len(study) == 23
    assert study.failures == {3: "NaN at 3 s", 10: "NaN at 10 s", 17: "NaN at 17 s"}


def test_logs_are_put_whole_and_belong_to_the_dataset(place, tmp_path):
    """The file here is gone then; to begin anew removes them, and nothing of others."""
    log = tmp_path / "3.mcap"
    with StudyDataset.open_or_create(place, identity(25)) as dataset:
        for content in (b"one", b"two"):
            log.write_bytes(content)
            dataset.storage.put("logs/3.mcap", log)
    assert not log.exists()
    files, root = fsspec.core.url_to_fs(place)
    assert files.cat_file(f"{root}/logs/3.mcap") == b"two"
    files.pipe_file(f"{root}/notes.txt", b"mine")
    assert StudyDataset.open(place).logs() == {3: f"{place}/logs/3.mcap"}
    with pytest.raises(DatasetError, match=f"{place} holds the dataset of another study: it was"):
        StudyDataset.open_or_create(place, identity(25, version="2.0"))
    with StudyDataset.open_or_create(place, identity(25, version="2.0"), new=True) as dataset:
        assert dataset.logs() == {}
        assert dataset.missing() == [range(25)]
    assert files.cat_file(f"{root}/notes.txt") == b"mine"


@pytest.mark.slow
def test_storage_that_is_not_there_is_said(bucket, monkeypatch):
    """A bucket that is missing, a server that does not answer: at once, with its URL."""
    with pytest.raises(DatasetWriteError, match=r"s3://nowhere/x/study.json: .*bucket"):
        StudyDataset.open_or_create("s3://nowhere/x", identity(5))
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    with pytest.raises(DatasetError, match=r"s3://studies/x/study.json: .*onnect"):
        StudyDataset.open("s3://studies/x")


def test_kinds_of_storage_that_are_unknown_are_refused(tmp_path, monkeypatch):
    """With what is missing; a URL of a file is a folder."""
    with pytest.raises(DatasetError, match="nothing://x: Protocol not known: nothing"):
        StudyDataset.open("nothing://x")
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(DatasetError, match=r"s3://x: .* needs fsspec, which is not installed"):
        StudyDataset.open("s3://x")
    with StudyDataset.open_or_create(f"file://{tmp_path}/x%20y", identity(5)) as dataset:
        add(dataset, range(5))
    assert len(StudyDataset.open(tmp_path / "x y")) == 5


def test_a_journal_elsewhere_is_put_now_and_then(memory, monkeypatch):
    """Not for every member, but at the latest with the first after a few seconds."""
    clock = [0.0]
    monkeypatch.setattr(storage.time, "monotonic", lambda: clock[0])
    with StudyDataset.open_or_create(f"{memory}/x", identity(9)) as dataset:
        for number, seen in enumerate([0, 0, 3, 3, 5, 5]):
            clock[0] = 5.0 * number
            add(dataset, [number])
            assert len(StudyDataset.open(f"{memory}/x")) == seen
        add(dataset, [6])
    assert len(StudyDataset.open(f"{memory}/x")) == 7
