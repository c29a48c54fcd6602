"""The garbage collector of the command line's process."""

import gc
import subprocess
import sys

import pytest

from cosim.cli.command import start_collecting

CODE = """
import gc, sys
from cosim.__main__ import main
try:
    main()
except SystemExit:
    pass
print(gc.isenabled(), gc.get_freeze_count() > 0, file=sys.stderr)
"""


@pytest.mark.slow
@pytest.mark.parametrize("command", [["run", "academic", "--stop", "0.1"], ["list"]])
def test_a_command_starts_the_collector_behind_its_imports(command, tmp_path):
    """What they made is frozen: the collector never walks over it."""
    done = subprocess.run(
        [sys.executable, "-c", CODE, *command],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
        timeout=60,
    )
    assert done.stderr.splitlines()[-1] == "True True"


def test_a_running_collector_is_left_alone():
    """A command that is called from Python freezes nothing of its caller."""
    frozen = gc.get_freeze_count()
    assert gc.isenabled()
    start_collecting()
    assert gc.get_freeze_count() == frozen
