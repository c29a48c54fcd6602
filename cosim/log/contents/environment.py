"""The environment of a run: versions and processor, to explain other bits on another machine."""

from __future__ import annotations

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from cosim.core.recording import Recording
from cosim.version import __version__

WRITTEN = "cosim.written"  # the record that has the time at which a recording began
_PACKAGES = ("numpy", "scipy", "mcap")


@cache
def library_name() -> str:
    """Return the name of the program, for the header of a log."""
    return f"cosim/{__version__} mcap-python/{_version('mcap')}"


def environment() -> dict[str, str]:
    """Return the versions of Python and the packages that compute, the platform, the processor."""
    versions = {"cosim": __version__}
    for name in _PACKAGES:
        versions[name] = _version(name)
    return {
        **versions,
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
    for line in lines:
        key, _, value = line.partition(":")
        if key.startswith("model name"):
            return value.strip()
    return platform.machine()


def environment_changes(recording: Recording) -> dict[str, tuple[str, str]]:
    """Return what is different on this machine from the one that wrote a log.

    Returns
    -------
    dict of str to (str, str)
        By name the recorded value and the present one; what was not recorded is not compared.
    """
    recorded = recording.metadata.get("cosim.env", {})
    changes = {}
    for name, present in environment().items():
        if name in recorded and recorded[name] != present:
            changes[name] = (str(recorded[name]), present)
    return changes
