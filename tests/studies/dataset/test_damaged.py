"""Full disks and damaged files: one clear error, and nothing is lost that was there."""

import json
import os
import re
import signal
import sys

import pyarrow
import pytest
from pyarrow import parquet

from cosim.digests import digest_of
from cosim.errors import DatasetError, DatasetWriteError, UsageError
from cosim.studies.dataset import local_storage
from cosim.studies.dataset import StudyDataset
from tests.studies.dataset.killed import complete, opened, processes
from tests.studies.dataset.outcomes import add, identity, member, outcome, parts

FULL = r"outcomes so far are saved: fix this and run the study again to continue"


class FullDisk:
    """Writes take so many bytes, a part of the last one, and then none."""

    def __init__(self, room):
        self.room = room
        self.write = os.write

    def __call__(self, descriptor, content):
        if self.room == 0:
            raise OSError(28, os.strerror(28))
        written = self.write(descriptor, content[: self.room])
        self.room -= written
        return written


@pytest.mark.parametrize("room", [1, 100, 150, 1000, 4000, 9000])
def test_a_full_disk_ends_a_study_that_goes_on_later(tmp_path, monkeypatch, room):
    """Wherever it is noticed: in the journal, or in a part."""
    with opened(tmp_path / "whole", 60, 10) as dataset:
        complete(dataset, seed=0)
    expected = StudyDataset.open(tmp_path / "whole").read().drop_columns(["wall_time", "worker"])
    added = []
    folder = tmp_path / "x"
    dataset = opened(folder, 60, 10)
    with monkeypatch.context() as patch:
        patch.setattr(local_storage.os, "write", FullDisk(room))
        with pytest.raises(DatasetWriteError, match=rf"No space left on device; all {FULL}"):
            complete(dataset, seed=1, report=added.append)
        dataset.close()
    with opened(folder, 60, 10) as dataset:
        left = dataset.read(["member"])["member"].to_pylist()
        assert set(added) <= set(left)
        assert left == sorted(set(left))
        assert len(left) <= len(added) + 1  # the member whose part could not be written
        complete(dataset, seed=2)
        table = dataset.read().drop_columns(["wall_time", "worker"])
    assert table.equals(expected)
    assert not [path for path in folder.rglob("*.tmp")]


def test_a_study_can_be_read_and_goes_on_after_a_write_that_failed(tmp_path, monkeypatch):
    """The member whose line could not be written has no outcome; the next try has room."""
    with StudyDataset.open_or_create(tmp_path, identity(10)) as dataset:
        add(dataset, range(3))
        with monkeypatch.context() as patch:
            patch.setattr(local_storage.os, "write", FullDisk(20))
            with pytest.raises(DatasetWriteError, match=r"_journal.jsonl: No space left on device"):
                add(dataset, [3])
        assert dataset.missing() == [range(3, 10)]
        assert len(StudyDataset.open(tmp_path)) == 3
        add(dataset, range(3, 10))
    assert len(StudyDataset.open(tmp_path)) == 10


def _limited(pipe, folder):
    """Write a dataset with files of at most 1500 bytes; send what came of it."""
    import resource

    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1500, 1500))
    try:
        with opened(folder, 60, 60) as dataset:
            complete(dataset, seed=1)
    except DatasetWriteError as error:
        pipe.send(str(error))


@pytest.mark.skipif(sys.platform == "win32", reason="no limits of files")
def test_a_limit_of_the_system_is_said(tmp_path):
    """As it is found by the system itself."""
    receiver, sender = processes.Pipe(duplex=False)
    process = processes.Process(target=_limited, args=(sender, tmp_path))
    process.start()
    sender.close()
    text = receiver.recv()
    process.join()
    assert text.startswith(f"{tmp_path / '_journal.jsonl'}: File too large; ")
    assert 0 < len(StudyDataset.open(tmp_path)) < 60


@pytest.fixture
def folder(tmp_path):
    """Return a study with two parts and a journal."""
    with StudyDataset.open_or_create(tmp_path, identity(30)) as dataset:
        add(dataset, range(25))
    return tmp_path


def flips(content):
    """Yield contents with a byte flipped, and two that are cut."""
    for place in range(0, len(content), max(len(content) // 200, 1)):
        yield content[:place] + bytes([content[place] ^ 0x10]) + content[place + 1 :]
    yield content[: len(content) // 2]
    yield b""


@pytest.mark.slow
def test_a_damaged_part_is_named_and_its_members_run_anew_without_it(folder):
    """Whatever byte is damaged: there is an error, or the content is that which was written."""
    path = folder / "parts" / parts(folder)[1]
    expected = StudyDataset.open(folder).read()
    problem = r"part-0000000010-0000000019.parquet is (damaged|a part of another study); remove it"
    said = []
    content = path.read_bytes()
    for damaged in flips(content):
        path.write_bytes(damaged)
        try:
            assert StudyDataset.open(folder).read().equals(expected)
        except DatasetError as error:
            said.append(str(error))
    assert len(said) > 100
    assert all(re.search(problem, text) for text in said)
    path.unlink()
    with StudyDataset.open_or_create(folder, identity(30)) as dataset:
        assert dataset.missing() == [range(10, 20), range(25, 30)]
        add(dataset, range(10, 20))
        assert dataset.read().equals(expected)


def test_a_part_without_one_of_its_columns_is_damaged(folder):
    """Whichever column is asked for."""
    path = next((folder / "parts").iterdir())
    parquet.write_table(parquet.read_table(path).drop_columns(["error"]), path)
    with pytest.raises(DatasetError, match=r"is damaged; remove it and run the study again"):
        _ = StudyDataset.open(folder).failed


def test_a_part_whose_texts_are_no_texts_is_damaged(folder):
    """Arrow takes any bytes for a text until it is asked for it."""
    path = next((folder / "parts").iterdir())
    table = parquet.read_table(path)
    bad = pyarrow.Array.from_buffers(
        pyarrow.string(),
        len(table),
        pyarrow.array([b"\xff\xfe"] * len(table), pyarrow.binary()).buffers(),
    )
    place = table.schema.get_field_index("status")
    parquet.write_table(table.set_column(place, table.schema.field(place), bad), path)
    with pytest.raises(DatasetError, match=r"is damaged; remove it and run the study again"):
        StudyDataset.open(folder).read()


@pytest.mark.parametrize("content", ['{"a": 1}', "[]"])
def test_a_file_of_another_program_is_not_replaced(tmp_path, content):
    """Though it has the name of the description."""
    path = tmp_path / "study.json"
    path.write_text(content)
    text = r"study\.json is not that of a dataset; choose another folder, or remove it"
    with pytest.raises(DatasetError, match=text):
        StudyDataset.open_or_create(tmp_path, identity(3), new=True)
    assert path.read_text() == content
    path.write_text("{")  # one that is damaged
    StudyDataset.open_or_create(tmp_path, identity(3), new=True).close()


def test_an_empty_path_is_refused():
    """It would be the working directory."""
    with pytest.raises(UsageError, match="got an empty path"):
        StudyDataset.open_or_create("", identity(3))


def test_a_damaged_description_is_named(folder):
    """Whatever byte is damaged."""
    path = folder / "study.json"
    problem = r"study.json( is damaged; .* new=True|: expected dataset format 2, got )"
    for damaged in flips(path.read_bytes()):
        path.write_bytes(damaged)
        with pytest.raises(DatasetError, match=problem):
            StudyDataset.open(folder)
        with pytest.raises(DatasetError, match=problem):
            StudyDataset.open_or_create(folder, identity(30))
    with StudyDataset.open_or_create(folder, identity(30), new=True) as dataset:
        assert dataset.missing() == [range(30)]


def test_parts_without_a_description_are_refused(folder):
    """Nobody knows of which study they are."""
    (folder / "study.json").unlink()
    problem = r"0009.parquet belongs to a dataset, but no study.json says to which; "
    with pytest.raises(DatasetError, match=problem):
        StudyDataset.open_or_create(folder, identity(30))
    assert len(parts(folder)) == 2


@pytest.mark.parametrize("line", ["[1, 2", "{}", "[99]", "7", "[true]", "[" * 100_000])
def test_a_damaged_line_of_the_journal_is_named(folder, line):
    """But for the last one, which a kill may have cut: that is dropped."""
    path = folder / "_journal.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([lines[0], line + "\n", *lines[1:]]))
    problem = r"_journal.jsonl: line 2 is damaged; remove that line and run the study again"
    with pytest.raises(DatasetError, match=problem):
        StudyDataset.open(folder)
    path.write_text("".join([*lines, line]))
    assert len(StudyDataset.open(folder)) == 25
    with StudyDataset.open_or_create(folder, identity(30)) as dataset:
        add(dataset, [29])
    assert len(StudyDataset.open(folder)) == 26


def test_a_part_that_no_dataset_of_this_size_has_is_refused(folder):
    """As of a study that was planned otherwise."""
    (folder / "parts" / "part-0000000020-0000000023.parquet").touch()
    problem = r"0023.parquet: not a part of this dataset; remove it and run the st"
    with pytest.raises(DatasetError, match=problem):
        StudyDataset.open(folder)


def test_a_format_of_a_later_version_is_refused(folder):
    """With the version of cosim that reads it."""
    path = folder / "study.json"
    path.write_text(path.read_text().replace('"format": 2', '"format": 3'))
    problem = r"format 2, got 3; read it with cosim 1.0"
    with pytest.raises(DatasetError, match=problem):
        StudyDataset.open(folder)


def test_a_description_with_other_content_is_refused(folder):
    """It is whole, as its checksum says, and yet not as this state of the package writes it."""
    path = folder / "study.json"
    content = json.loads(path.read_text())
    del content["checksum"], content["designs"]
    path.write_text(json.dumps({**content, "checksum": digest_of(content)}))
    with pytest.raises(DatasetError, match=r"study.json: written by another revision of"):
        StudyDataset.open(folder)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("part_size", []),
        ("part_size", 0),
        ("lengths", []),
        ("lengths", [30, 3]),
        ("lengths", [10**30]),  # whose parts would be counted without end
        ("columns", [{"name": "a", "role": "parameter", "type": "x"}]),
        ("columns", 5),
        ("replay_designs", [["a"]]),
        ("study", None),
        ("digests", [1]),
    ],
)
def test_a_description_with_values_of_other_types_is_refused(folder, key, value):
    """Its checksum is right: somebody else wrote it."""
    path = folder / "study.json"
    content = json.loads(path.read_text())
    del content["checksum"]
    content[key] = value
    path.write_text(json.dumps({**content, "checksum": digest_of(content)}))
    with pytest.raises(DatasetError, match=r"study.json: written by another revision of"):
        StudyDataset.open(folder)


def test_json_without_end_is_damaged(folder):
    """It costs no traceback, in whichever file."""
    (folder / "_logs.jsonl").write_text("[" * 100_000)
    assert len(StudyDataset.open(folder)) == 25
    (folder / "study.json").write_text('{"a":' * 100_000)
    with pytest.raises(DatasetError, match=r"study.json is damaged"):
        StudyDataset.open(folder)


def test_a_row_of_the_journal_with_values_of_other_types_is_named(folder):
    """As many as a row has, so that only its use shows it."""
    path = folder / "_journal.jsonl"
    row = json.loads(path.read_text().splitlines()[0])
    path.write_text(json.dumps([row[0], *([["x"]] * (len(row) - 1))]) + "\n")
    with pytest.raises(DatasetError, match=r"_journal.jsonl: a row is damaged; remove the file"):
        StudyDataset.open(folder).read()


@pytest.mark.skipif(sys.platform == "win32" or os.getuid() == 0, reason="all is allowed to root")
def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    """As the system says it."""
    tmp_path.chmod(0o500)
    with pytest.raises(DatasetError, match="Permission denied; expected a writable folder"):
        StudyDataset.open_or_create(tmp_path, identity(5))


def test_a_part_that_is_removed_while_it_is_read_is_named(folder):
    """As by a study that begins anew."""
    dataset = StudyDataset.open(folder)
    (folder / "parts" / parts(folder)[0]).unlink()
    with pytest.raises(DatasetError, match=r"0009.parquet: removed while it was being read"):
        dataset.read()


def test_a_member_has_one_outcome(folder):
    """To add another is a bug of the caller, which the dataset does not take over."""
    with StudyDataset.open_or_create(folder, identity(30)) as dataset:
        for number in (3, 22):
            with pytest.raises(AssertionError):
                dataset.add(member(number), outcome(number))
    assert len(StudyDataset.open(folder)) == 25
