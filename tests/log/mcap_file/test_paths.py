"""What can be the path of a log."""

from __future__ import annotations

import pytest

import cosim
from cosim.errors import CosimError
from cosim.log import McapRecorder, open_log


def test_wrong_paths_are_refused_by_all_that_takes_one(short_log, subtests):
    """A name too long, one with a NUL, no text, and half a character: before anything is done."""
    for bad in ["x" * 260 + ".mcap", "a\0b.mcap", 3, None, b"\xff.mcap", "\udcff\ud800.mcap"]:
        calls = {
            "open_log": lambda bad=bad: open_log(bad),
            "McapRecorder": lambda bad=bad: McapRecorder(bad),
            "replay": lambda bad=bad: cosim.replay(bad),
            "diff": lambda bad=bad: cosim.diff(open_log(short_log), bad),
        }
        if bad is not None:
            calls["run"] = lambda bad=bad: cosim.run("academic", out=bad)
        if isinstance(bad, str):
            calls["load"] = lambda bad=bad: cosim.load(bad)
        for name, call in calls.items():
            with subtests.test(case=(name, bad)), pytest.raises(CosimError):
                call()
