"""Fixtures of the tests of studies."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.studies.in_process import run_members_in_this_process, run_members_in_workers


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
