"""Datasets at URLs of fsspec: an S3 server on loopback, and what is in this process."""

import socket
import sys
from contextlib import closing

import fsspec
import pytest

import cosim
from cosim.errors import DatasetError, DatasetWriteError
from cosim.studies.dataset.log_files import LogRecord
from cosim.studies.dataset.object_storage import PutJournal
from cosim.studies.dataset import StudyDataset
from tests.studies.dataset.outcomes import add, design, identity, member, outcome


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
    """The same table; it goes on where it was, with its journal."""
    with StudyDataset.open_or_create(tmp_path, identity(25)) as dataset:
        add(dataset, range(23))
    with StudyDataset.open_or_create(place, identity(25), design=design(25)) as dataset:
        add(dataset, [*range(13)])
    with StudyDataset.open_or_create(place, identity(25), design=design(25)) as dataset:
        assert dataset.missing() == [range(13, 25)]
        add(dataset, range(13, 23))
    expected = StudyDataset.open(tmp_path).read()
    assert StudyDataset.open(place).read().equals(expected)
    study = cosim.open_study(place)
    assert len(study) == 23
    assert study.failures == {3: "NaN at 3 s", 10: "NaN at 10 s", 17: "NaN at 17 s"}


def test_logs_are_put_whole_and_belong_to_the_dataset(place, tmp_path):
    """The file here is gone then; to begin anew removes the logs and what is known of them."""
    log = tmp_path / "_3.unfinished.mcap"
    with (
        StudyDataset.open_or_create(place, identity(25)) as dataset,
        closing(dataset.log_files()) as logs,
    ):
        for content in (b"one", b"two"):
            log.write_bytes(content)
            logs.put(3, log)
            logs.note(LogRecord(3, "signals", is_same=True))
        assert not log.exists()
        assert logs.folder() is None
    files, root = fsspec.core.url_to_fs(place)
    assert files.cat_file(f"{root}/logs/3.mcap") == b"two"
    opened = StudyDataset.open(place)
    assert opened.logs() == {3: f"{place}/logs/3.mcap"}
    assert opened.log_files().records == {3: LogRecord(3, "signals", is_same=True, size=3)}
    with StudyDataset.open_or_create(place, identity(25), new=True) as dataset:
        assert dataset.log_files().records == dataset.logs() == {}


def test_tasks_write_parts_elsewhere(place):
    """Each opens the dataset by its URL; twice is once."""
    with StudyDataset.open_or_create(place, identity(20)) as dataset:
        for first in (10, 10, 0):
            task = StudyDataset.open(place, sha256=dataset.sha256)
            numbers = range(first, first + 10)
            task.write_part(first, [(member(number), outcome(number)) for number in numbers])
    opened = StudyDataset.open(place)
    assert opened.read(["member"])["member"].to_pylist() == list(range(20))
    assert opened.missing() == []


def test_another_study_elsewhere_is_refused_and_can_be_begun_anew(place):
    """New removes the objects of a dataset only."""
    with StudyDataset.open_or_create(place, identity(20)) as dataset:
        add(dataset, range(15))
    files, root = fsspec.core.url_to_fs(place)
    files.pipe_file(f"{root}/notes.txt", b"mine")
    with pytest.raises(DatasetError, match=f"{place} holds the dataset of another study: it was"):
        StudyDataset.open_or_create(place, identity(20, version="2.0"))
    with StudyDataset.open_or_create(place, identity(20, version="2.0"), new=True) as dataset:
        assert dataset.missing() == [range(20)]
    assert files.cat_file(f"{root}/notes.txt") == b"mine"


@pytest.mark.slow
def test_polars_reads_the_parts_from_the_server(bucket, s3_server):
    """By the same URL."""
    import polars

    place = f"{bucket}/read"
    with StudyDataset.open_or_create(place, identity(20)) as dataset:
        add(dataset, range(20))
    options = {"aws_endpoint_url": s3_server, "aws_allow_http": "true"}
    frame = polars.read_parquet(f"{place}/parts/*.parquet", storage_options=options)
    assert frame["member"].to_list() == list(range(20))


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
    """With what is missing."""
    with pytest.raises(DatasetError, match="nothing://x: Protocol not known: nothing"):
        StudyDataset.open("nothing://x")
    monkeypatch.setitem(sys.modules, "fsspec", None)
    problem = r"s3://x: a dataset outside of a local folder needs fsspec, which is not installed"
    with pytest.raises(DatasetError, match=problem):
        StudyDataset.open("s3://x")
    place = f"file://{tmp_path}/x%20y"
    with StudyDataset.open_or_create(place, identity(5)) as dataset:
        add(dataset, range(5))
    assert len(StudyDataset.open(tmp_path / "x y")) == 5


def test_a_journal_elsewhere_is_put_now_and_then(memory, monkeypatch):
    """Not for every member, but at the latest with the first after a few seconds."""
    clock = [0.0]
    monkeypatch.setattr("cosim.studies.dataset.object_storage.time.monotonic", lambda: clock[0])
    puts = []
    put = PutJournal._put
    monkeypatch.setattr(PutJournal, "_put", lambda journal: (puts.append(clock[0]), put(journal)))
    with StudyDataset.open_or_create(f"{memory}/x", identity(100, part_size=100)) as dataset:
        for number in range(40):
            clock[0] = float(number)
            add(dataset, [number])
            if number == 25:
                assert len(StudyDataset.open(f"{memory}/x")) == 21
    assert puts == [10.0, 20.0, 30.0, 39.0]
    assert len(StudyDataset.open(f"{memory}/x")) == 40
