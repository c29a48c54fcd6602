"""Where a run was made: versions and processor, for whoever finds other bits elsewhere."""

from __future__ import annotations

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from cosim.core.contracts import Recording
from cosim.version import __version__

_PACKAGES = ("numpy", "scipy", "mcap")


@cache
def library() -> str:
    """Name the program in the header of a log."""
    return f"cosim/{__version__} mcap-python/{_version('mcap')}"


def environment() -> dict[str, str]:
    """Describe Python, the packages that compute, the platform and the processor."""
    packages = {"cosim": __version__, **{name: _version(name) for name in _PACKAGES}}
    return {
        **packages,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": _processor(),
    }


@cache  # reading it takes a millisecond
def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


@cache
def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.machine())


def other_environment(recording: Recording) -> dict[str, tuple[str, str]]:
    """Give what was different on the machine that wrote a log: name, then and now."""
    then, now = recording.metadata.get("cosim.env", {}), environment()
    return {
        key: (str(then[key]), value)
        for key, value in now.items()
        if key in then and then[key] != value
    }
