"""Temporary folders: what a killed process leaves is removed, what a living one needs stays."""

import os
import signal
import subprocess
import sys
import tempfile

import pytest

from cosim import temporary
from cosim.temporary import TemporaryFolder, remove_abandoned, without_folders

HOLD = """
import sys
from cosim.temporary import TemporaryFolder
folder = TemporaryFolder("fmu")
(folder.path / "x.so").touch()
print(folder.path, flush=True)
sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def parent(tmp_path, monkeypatch):
    """Make temporary folders here, and remove at once what nobody needs."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(temporary, "_SETTLED", -60.0)
    return tmp_path


def test_a_folder_is_removed_at_the_end_of_its_block(parent):
    """With all that it holds, however the block ends; twice does no harm."""
    folder = TemporaryFolder("check")

    def fail():
        with folder as path:
            assert path.parent == parent
            assert path.name.startswith("cosim.check-")
            (path / "deep").mkdir()
            (path / "deep" / "file").touch()
            raise ValueError("x")

    with pytest.raises(ValueError, match="x"):
        fail()
    assert not list(parent.iterdir())
    folder.remove()


@pytest.mark.slow
def test_the_folder_of_a_killed_process_is_removed_by_the_next(parent):
    """Not before: as long as the process lives, it stays."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLD],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(parent)},
    ) as process:
        path = process.stdout.readline().strip()
        remove_abandoned(parent)
        assert os.listdir(path) == ["x.so"]
        process.send_signal(signal.SIGKILL)
    assert os.path.exists(path)
    with TemporaryFolder("fmu") as own:
        assert list(parent.iterdir()) == [own]


def test_nothing_else_is_removed(parent, monkeypatch):
    """No folder of another name, no file, no link, nothing young, nothing of this process."""
    (parent / "cosim-fmu-1").mkdir()
    (parent / "cosim.fmu-1").touch()
    (parent / "cosim.fmu-2").symlink_to(parent / "cosim-fmu-1")
    with TemporaryFolder("fmu") as own:
        before = set(parent.iterdir())
        remove_abandoned(parent)
        assert set(parent.iterdir()) == before
        assert own in before
    monkeypatch.setattr(temporary, "_SETTLED", 60.0)
    (parent / "cosim.fmu-3").mkdir()
    remove_abandoned(parent)
    assert (parent / "cosim.fmu-3").exists()


def test_texts_do_not_tell_where_temporary_folders_are(parent):
    """Their names are random; other paths stay."""
    with TemporaryFolder("fmu") as folder:
        text = f"{parent}/a.fmu: {folder}/binaries/x.so: too short; {folder.name}/"
        assert without_folders(text, "fmu") == (
            f"{parent}/a.fmu: binaries/x.so: too short; {folder.name}/"
        )
        assert without_folders(text, "workers") == text
