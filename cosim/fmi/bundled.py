"""Files of the standard that come with fmpy: headers and schemas."""

from __future__ import annotations

import importlib.util
from pathlib import Path


def bundled(*parts: str) -> Path:
    """Return a file or folder of fmpy's, without importing it: that may print on stdout."""
    package = importlib.util.find_spec("fmpy")
    assert package is not None  # a dependency
    assert package.origin is not None
    return Path(package.origin).parent.joinpath(*parts)
