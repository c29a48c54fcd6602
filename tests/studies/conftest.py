"""Fixtures of the tests of studies."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from tests.studies.cluster.processes import cluster
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


@pytest.fixture(scope="session")
def s3_variables(s3_server: str) -> dict[str, str]:
    """Return the variables of the environment with which clients find the server."""
    return {
        "AWS_ENDPOINT_URL": s3_server,
        "AWS_ACCESS_KEY_ID": "nobody",
        "AWS_SECRET_ACCESS_KEY": "nothing",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_CONFIG_FILE": "/nonexistent",
        "AWS_SHARED_CREDENTIALS_FILE": "/nonexistent",
        "AWS_EC2_METADATA_DISABLED": "true",
    }


@pytest.fixture
def bucket(s3_variables: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Return the URL of a bucket, with credentials of nobody."""
    import fsspec

    for name, value in s3_variables.items():
        monkeypatch.setenv(name, value)
    files = fsspec.filesystem("s3", skip_instance_cache=True)
    if not files.exists("studies"):
        files.mkdir("studies")
    yield "s3://studies"
    fsspec.get_filesystem_class("s3").clear_instance_cache()


@pytest.fixture(scope="module")
def two_workers(
    tmp_path_factory: pytest.TempPathFactory, s3_variables: dict[str, str]
) -> Iterator[Any]:
    """Serve a scheduler of dask with two workers, which find the bucket; nobody ends them.

    For a module: idle, they take a tenth of a processor as long as they are there.
    """
    with cluster(tmp_path_factory.mktemp("cluster"), **s3_variables) as processes:
        yield processes
