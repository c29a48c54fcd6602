"""Fixtures of the tests of commands."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def _verdicts_once(verdicts_once: None) -> None:
    """Assess equal runs once."""
