"""Fixtures of the tests of reports."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def _verdicts_once(verdicts_once: None) -> None:
    """Assess equal runs once."""
