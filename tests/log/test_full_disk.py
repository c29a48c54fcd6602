"""A run on a disk that gets full ends with an error, and leaves a log of all that was flushed."""

from __future__ import annotations

import contextlib
import io
import os
import re
import subprocess
import sys

import pytest

from cosim.cli import main
from cosim.log import open_log
from tests.log.killed import answer_of
from tests.log.recordings import same_bits

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="no limits of files"),
]

SCENARIO = """
[scenario]
name = "loop"
stop = 30.0
step = 1e-2
[components]
setpoint = { kind = "constant", value = 1.0 }
pid = { kind = "pid", gain = 2.0, integral_time = 1.0, lower = -3.0, upper = 3.0 }
plant = { kind = "lag", time_constant = 2.0, initial = 0.0 }
[connections]
"pid.setpoint" = "setpoint.y"
"pid.measurement" = "plant.y"
"plant.u" = "pid.y"
"""
ARGUMENTS = ["run", "loop.toml", "--force", "--flush"]
MESSAGE = r"cosim: \S*a\.mcap cannot be written further: .*; the log is valid up to t = ([\d.]+) s"
NO_ROOM = r"cosim: \S*a\.mcap cannot be (written|created): (File too large|No space left on device)"


def long(count):
    """Return the count of a test's long form."""
    return pytest.param(count, marks=pytest.mark.campaign)


@pytest.fixture
def scenario(tmp_path):
    """Write the scenario; return its folder, the rows of a whole run and the size of its log."""
    (tmp_path / "loop.toml").write_text(SCENARIO)
    out = tmp_path / "whole.mcap"
    code, _ = answer_of(_run, tmp_path, out, "1", None)
    assert code == 0
    log = open_log(out)
    return tmp_path, {name: log.rows(name) for name in log.channels}, out.stat().st_size


def _run(pipe, folder, out, flush, limit):
    """Run the scenario with files of at most ``limit`` bytes; send exit code and stderr."""
    import resource

    os.chdir(folder)
    if limit is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    errors = io.StringIO()
    code = 0
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        try:
            main([*ARGUMENTS, flush, "--out", str(out)])
        except SystemExit as end:
            code = end.code or 0
    pipe.send((code, errors.getvalue()))


def check(out, code, text, rows):
    """Check how a run ended and the log that it left; return the exit code."""
    if code == 2:
        assert re.search(NO_ROOM, text), text
        assert not list(out.parent.glob("*a.mcap*"))
        return code
    log = open_log(out)
    for name, expected in rows.items():
        found = log.rows(name)
        assert same_bits(found, expected[: len(found)])
        assert code or len(found) == len(expected)
    if code:
        assert code == 1
        match = re.search(MESSAGE, text)
        assert match, text
        end_ns = max([0, *log.time_ns("plant")])
        assert float(match[1]) * 1e9 == pytest.approx(end_ns)
    out.unlink()
    return code


@pytest.mark.parametrize("count", [10, long(50)])
def test_a_limit_of_files_ends_a_run_with_a_whole_log(scenario, count):
    """From where not even what precedes the rows has room to where all has."""
    folder, rows, _ = scenario
    out = folder / "a.mcap"
    codes = set()
    for number in range(count):
        limit = 1000 + 400_000 * number // (count - 1)
        flush = "1e-3" if number % 2 else "1"
        code, text = answer_of(_run, folder, out, flush, limit)
        codes.add(check(out, code, text, rows))
    assert codes == {0, 1, 2}


@pytest.fixture
def small_disk(tmp_path):
    """Mount a file system in memory, whose size is set by the function that is returned."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "cosim-test", str(disk)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no file system may be mounted here")

    def resize(size):
        options = f"remount,size={size}"
        subprocess.run(["mount", "-o", options, str(disk)], check=True, capture_output=True)
        return disk

    yield resize
    subprocess.run(["umount", str(disk)], check=True, capture_output=True)


@pytest.mark.parametrize("count", [10, long(50)])
def test_a_full_disk_ends_a_run_with_a_whole_log(scenario, small_disk, count):
    """Where there is no room left for a page of the file, which is sparse."""
    folder, rows, size = scenario
    codes = set()
    for number in range(count):
        out = small_disk(4096 + (size + 80_000) * number // (count - 1)) / "a.mcap"
        flush = "1e-3" if number % 2 else "1"
        code, text = answer_of(_run, folder, out, flush, None)
        codes.add(check(out, code, text, rows))
    assert codes == {0, 1, 2}
