"""Fixtures of the tests of commands."""

import pytest

from tests.studies.in_process import run_members_in_this_process


@pytest.fixture
def members_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run members where the command runs: for tests of what it reads and prints."""
    run_members_in_this_process(monkeypatch)
