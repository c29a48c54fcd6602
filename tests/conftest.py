"""Fixtures that every part of the suite may use."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

REFERENCE = Path(__file__).parent / "reference" / "cases.json"


@pytest.fixture(scope="session")
def case() -> Callable[[str], dict[str, Any]]:
    """Look up a case of `tests/reference/cases.json` by its id: `case("C01")`."""
    cases = {entry["id"]: entry for entry in json.loads(REFERENCE.read_text(encoding="utf-8"))["cases"]}
    return cases.__getitem__
