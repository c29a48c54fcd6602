"""SHA-256 of files: of what they hold now, read again only where that may be something else."""

import os
import subprocess

import pytest

from cosim.digests import FileDigests, sha256_of


def test_it_is_that_of_sha256sum(tmp_path):
    """For an empty file, and for one of some megabytes."""
    for name, content in (("empty", b""), ("long", b"0123456789" * 500_000)):
        path = tmp_path / name
        path.write_bytes(content)
        answer = subprocess.run(["sha256sum", path], capture_output=True, text=True, check=True)
        assert sha256_of(path) == answer.stdout.split()[0]


def test_a_file_that_stays_is_read_once(tmp_path, monkeypatch):
    """One that was only touched is read again, and is the same."""
    path = tmp_path / "a"
    path.write_bytes(b"a")
    digests = FileDigests()
    monkeypatch.setattr("cosim.digests.SETTLED_NS", 0)
    known = digests.of(str(path))
    with monkeypatch.context() as patched:
        patched.setattr("cosim.digests.sha256_of", pytest.fail)
        assert digests.of(str(path)) == known
    os.utime(path, ns=(1, 1))
    assert digests.of(str(path)) == known


@pytest.mark.parametrize("how", ["in place", "with its old time", "by another file", "by a link"])
def test_another_content_is_found(tmp_path, how):
    """Of the same size, however it came."""
    path = tmp_path / "a"
    path.write_bytes(b"old")
    if how == "by a link":
        path = tmp_path / "link"
        path.symlink_to("a")
    digests = FileDigests()
    known = digests.of(str(path))
    status = path.stat()
    other = tmp_path / "b"
    other.write_bytes(b"new")
    match how:
        case "by another file":
            os.utime(other, ns=(status.st_mtime_ns, status.st_mtime_ns))
            other.replace(path)
        case "by a link":
            path.unlink()
            path.symlink_to("b")
        case _:
            path.write_bytes(b"new")
            if how == "with its old time":
                os.utime(path, ns=(status.st_mtime_ns, status.st_mtime_ns))
    assert digests.of(str(path)) != known
    assert digests.of(str(path)) == sha256_of(path)


def test_a_pipe_is_refused(tmp_path):
    """Reading it would never end."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="it is a pipe, not a regular file"):
        sha256_of(tmp_path / "pipe")
