"""Fixtures of the tests of studies."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import pytest

from cosim.studies import dataset
from tests.studies.in_process import run_members_in_this_process, run_members_in_workers

S3_SERVER = """
import sys
from moto.server import ThreadedMotoServer
server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
server.start()
print(server.get_host_and_port()[1], flush=True)
sys.stdin.read()
"""


@pytest.fixture(scope="package", autouse=True)
def members_in_this_process() -> Iterator[None]:
    """Run members where the test runs, unless it asks for ``worker_processes``."""
    with pytest.MonkeyPatch.context() as patch:
        run_members_in_this_process(patch)
        yield


@pytest.fixture
def worker_processes() -> Iterator[None]:
    """Run members in workers, as users do: for tests of crashes, hangs and pools."""
    with pytest.MonkeyPatch.context() as patch:
        run_members_in_workers(patch)
        yield


@pytest.fixture
def parts_of_ten(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let parts of datasets have ten members."""
    monkeypatch.setattr(dataset, "PART_SIZE", 10)


@pytest.fixture(scope="session")
def s3_server() -> Iterator[str]:
    """Serve S3 in a process of its own until its input ends; return the URL."""
    with subprocess.Popen(
        [sys.executable, "-c", S3_SERVER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        yield f"http://127.0.0.1:{process.stdout.readline().strip()}"
        process.stdin.close()


@pytest.fixture
def bucket(s3_server: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Return the URL of a bucket, with credentials of nobody."""
    import fsspec

    for name, value in {
        "ENDPOINT_URL": s3_server,
        "ACCESS_KEY_ID": "nobody",
        "SECRET_ACCESS_KEY": "nothing",
        "DEFAULT_REGION": "us-east-1",
        "CONFIG_FILE": "/nonexistent",
        "SHARED_CREDENTIALS_FILE": "/nonexistent",
        "EC2_METADATA_DISABLED": "true",
    }.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    files = fsspec.filesystem("s3", skip_instance_cache=True)
    if not files.exists("studies"):
        files.mkdir("studies")
    yield "s3://studies"
    fsspec.get_filesystem_class("s3").clear_instance_cache()
